"""What the paper says about cost and quality, beside what was measured here.

Csébfalvi, One Step Further Beyond Trilinear Interpolation and Central Differences, measured frames of a GPU. Here a
claim is a ratio with a limit, taken at every resolution (and signal) measured; it holds, holds in part, or does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from experiments.runs import Record
from experiments.timing import ratio

TRILINEAR, CENTRAL = "trilinear", "trilinear+central"
GRADIENT, VALUE = "gradient-rays", "value-rays"
Found = dict[str, float]
"""Where it was measured (`64³`, `sphere 64³`) -> the number."""


@dataclass(frozen=True)
class Evidence:
    """The records of a run, as questions that claims ask.

    Attributes:
        records: by key, those of `speed_accuracy`.
        resolutions: that were measured, increasing.
        signals: names, in the order of the config.
    """

    records: Mapping[str, Record]
    resolutions: Sequence[int]
    signals: Sequence[str]

    def time(self, above: str, below: str, work: str = GRADIENT, work_below: str | None = None) -> Found:
        """Time per sample of a candidate in units of another's (or of its own at other work), at every resolution."""
        found = {}
        for n in self.resolutions:
            first = self._costs(n, work).get(above)
            second = self._costs(n, work_below or work).get(below)
            if first and second:
                together = work_below is None
                within = ratio(first, second)[1] if together else first["ns_per_sample"][1] / second["ns_per_sample"][1]
                found[f"{n}³"] = within
        return found

    def _costs(self, n: int, work: str) -> Mapping[str, Record]:
        return self.records.get(f"cost/{n}/{work}", {}).get("costs", {})

    def error(self, above: str, below: Sequence[str], quantity: str, resolutions: Sequence[int] | None = None) -> Found:
        """An error of a candidate in units of the least one of others, for every signal and resolution."""
        found = {}
        for i, signal in enumerate(self.signals):
            for n in resolutions or self.resolutions:
                known = [self.records.get(f"error/{i}/{n}/{key}", {}).get(quantity) for key in (above, *below)]
                errors = [e for e in known if e]
                if len(errors) == len(known):
                    found[f"{signal} {n}³"] = errors[0] / min(errors[1:])
        return found

    def image(self, better: str, worse: str) -> Found:
        """PSNR of one method's image less another's, in dB, with the shortest step of the study."""
        found = {}
        for key, record in self.records.items():
            if key.startswith("images/"):
                entries = {(e["recipe"], e["step"]): e["psnr"] for e in record["entries"]}
                step = min(s for _, s in entries)
                pair = entries.get((better, step)), entries.get((worse, step))
                if pair[0] is not None and pair[1] is not None:
                    where = f"{self.signals[record['source']]} {record['resolution']}³"
                    found.setdefault(where, pair[0] - pair[1])
        return found


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper as a number with a limit.

    Attributes:
        said: what the paper says.
        paper: its number.
        measured: what the numbers here are.
        of: evidence -> the numbers.
        limit: which they must not exceed (`at_most`), or must reach.
        unit: "×" for ratios, "dB".
    """

    said: str
    paper: str
    measured: str
    of: Callable[[Evidence], Found]
    limit: float
    at_most: bool = True
    unit: str = "×"


CLAIMS = (
    Claim(
        "Triquadratic value and gradient are nearly as fast as trilinear with central differences",
        "1.07 × (6.69 and 7.14 frames/s)",
        "time of triquadratic ÷ trilinear with central differences, each by the fastest scheme",
        lambda e: e.time("triquadratic", CENTRAL),
        1.07,
    ),
    Claim(
        "… in the paper's own scheme: eight samples in place of seven",
        "1.07 ×; 8/7 by the samples",
        "the same, both from trilinear samples in plain torch",
        lambda e: e.time("triquadratic+sampled", f"{CENTRAL}+sampled"),
        8 / 7,
    ),
    Claim(
        "Eight trilinear samples are the fast way to a triquadratic value and gradient",
        "on a texture unit",
        "eight samples ÷ sum over 27 taps, both in plain torch",
        lambda e: e.time("triquadratic+sampled", "triquadratic+direct"),
        1.0,
    ),
    Claim(
        "… against compiled sums",
        "–",
        "eight samples in plain torch ÷ fused sum over 27 taps",
        lambda e: e.time("triquadratic+sampled", "triquadratic"),
        1.0,
    ),
    Claim(
        "The gradient comes for free with the value",
        "no further sample",
        "triquadratic value and gradient ÷ value alone, fused",
        lambda e: e.time("triquadratic", "triquadratic", GRADIENT, VALUE),
        1.1,
    ),
    Claim(
        "NCRSI costs what trilinear with central differences costs",
        "1.00 × (7.17 and 7.14 frames/s)",
        "time of ncrsi ÷ trilinear with central differences, fused",
        lambda e: e.time("ncrsi", CENTRAL),
        1.05,
    ),
    Claim(
        "The notch filter is as fast as the triquadratic",
        "0.99 × (6.74 and 6.69 frames/s)",
        "time of notch ÷ triquadratic, fused",
        lambda e: e.time("notch", "triquadratic"),
        1.05,
    ),
    Claim(
        "Tricubic value and gradient take four times the samples: no reasonable trade",
        "4 × (32 and 8 samples)",
        "time of tricubic ÷ triquadratic, fused",
        lambda e: e.time("tricubic", "triquadratic"),
        2.0,
        at_most=False,
    ),
    Claim(
        "Catmull-Rom with gradients is very expensive",
        "8 × (56 and 7 samples)",
        "time of catmull-rom, analytic gradient ÷ trilinear with central differences, fused",
        lambda e: e.time("catmull-rom", CENTRAL),
        2.0,
        at_most=False,
    ),
    Claim(
        "NCRSI improves the value over trilinear at no cost",
        "order three in place of two",
        "RMS of the value, ncrsi ÷ trilinear",
        lambda e: e.error("ncrsi", [CENTRAL], "value_rms"),
        1.0,
    ),
    Claim(
        "The prefiltered triquadratic has the least asymptotic error (of trilinear, NCRSI, notch and itself)",
        "figure 6",
        "RMS of the value at the finest resolution, triquadratic ÷ the best of the others",
        lambda e: e.error("triquadratic", [CENTRAL, "ncrsi", "notch"], "value_rms", e.resolutions[-1:]),
        1.0,
    ),
    Claim(
        "… and a gradient of higher quality than central differences",
        "figures 5, 8",
        "RMS of the gradient, triquadratic ÷ central differences",
        lambda e: e.error("triquadratic", [CENTRAL], "gradient_rms"),
        1.0,
    ),
    Claim(
        "Triquadratic images are better than those of trilinear with central differences",
        "figures 5, 8",
        "PSNR, triquadratic less trilinear with central differences",
        lambda e: e.image("triquadratic", CENTRAL),
        1.0,
        at_most=False,
        unit="dB",
    ),
    Claim(
        "… and than those of NCRSI",
        "figures 5, 8",
        "PSNR, triquadratic less ncrsi",
        lambda e: e.image("triquadratic", "ncrsi"),
        0.0,
        at_most=False,
        unit="dB",
    ),
    Claim(
        "Without its prefilter the triquadratic smooths severely",
        "figure 9",
        "RMS of the value, without ÷ with prefilter",
        lambda e: e.error("triquadratic+unprefiltered", ["triquadratic"], "value_rms"),
        1.5,
        at_most=False,
    ),
    Claim(
        "The prefiltered notch does not compromise high frequencies",
        "figure 8",
        "RMS of the value, notch ÷ trilinear",
        lambda e: e.error("notch", [CENTRAL], "value_rms"),
        1.0,
    ),
)


def judged(evidence: Evidence) -> list[Record]:
    """Every claim with its numbers and verdict; those without a number are left out."""
    found = [(claim, claim.of(evidence)) for claim in CLAIMS]
    return [
        {
            "said": claim.said,
            "paper": claim.paper,
            "measured": claim.measured,
            "found": numbers,
            "limit": claim.limit,
            "at_most": claim.at_most,
            "unit": claim.unit,
            "verdict": verdict(claim, numbers.values()),
        }
        for claim, numbers in found
        if numbers
    ]


def verdict(claim: Claim, numbers: Iterable[float]) -> str:
    """`holds` where every number keeps to the limit, `does not hold` where none does, else `in part`."""
    kept = [(x <= claim.limit) if claim.at_most else (x >= claim.limit) for x in numbers]
    return "holds" if all(kept) else "in part" if any(kept) else "does not hold"
