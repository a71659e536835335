"""Can a reconstruction filter be learned that beats the named ones at equal cost? On which signals, and by how much?

Kernels with short prefilters are fitted to training members of a class of signals, stopped and chosen by validation
members, and compared with the named methods on test members. Cost is taps: the coefficients that one sample of the
field reads. A prefilter is paid once per voxel, so it is stated apart.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments import fir
from experiments.comparison import QUANTITIES, chosen, compared, pooled
from experiments.config import ExperimentConfig, Recipe, Recipes, number
from experiments.descent import Parameters, Stage, State, minimize
from experiments.fitting import Candidate, Fit, Objective, distinct, parameters_of
from experiments.members import (
    ROLES,
    MarschnerLobbClass,
    Members,
    Role,
    Sampling,
    ScanClass,
    Source,
    WavesClass,
    least_extent,
    seed_of,
)
from experiments.runs import Record, Run, Unit
from filterlab import prefilters
from filterlab.io.config import ConfigError, Problem
from filterlab.methods import tensor_product
from filterlab.scenes.model import Positive
from filterlab.spectrum import kernel_response

AnyClass = Annotated[MarschnerLobbClass | WavesClass | ScanClass, Field(discriminator="kind")]
Count = Annotated[int, Field(ge=1, le=1000)]

NAMED, FIT, VERDICT, SPECTRUM, ELSEWHERE = "named", "fit", "verdict", "spectrum", "elsewhere"
UPPER = 2.0  # Nyquist frequencies that responses are drawn up to
FREQUENCIES = 257  # of the curves


class Config(ExperimentConfig):
    """Classes of signals, filters to be learned for each, and named methods to be beaten.

    Attributes:
        classes: what members are drawn from.
        candidates: what is learned, once for every class and repetition.
        methods: the named ones.
        reference: the objective is relative to the errors of this one.
        gradient_weight: of the gradient's error in the objective, beside 1 for the value's.
        resolution: voxels of a member along each axis; a scan's are less where it is small.
        training, validation, test: how many members of each. The first two are other ones in every repetition.
        points, test_points: at which a member is known.
        inner: points of signals are drawn from the box shrunk to this fraction, away from its ends.
        repetitions: how often everything is learned anew, from other members.
        family: B and C that a descent begins with; a prefilter begins as the one that changes nothing.
        record_every: steps between looks at the validation members.
    """

    experiment: Literal["fit_kernel"]
    classes: Annotated[list[AnyClass], Field(min_length=1)]
    candidates: Annotated[list[Candidate], Field(min_length=1), AfterValidator(distinct)]
    methods: Recipes
    reference: Recipe = Recipe(name="triquadratic")
    gradient_weight: Annotated[float, Field(ge=0)] = 1.0
    resolution: Annotated[int, Field(ge=4, le=256)] = 24
    training: Count = 4
    validation: Count = 4
    test: Count = 8
    points: Annotated[int, Field(ge=10, le=10**6)] = 512
    test_points: Annotated[int, Field(ge=10, le=10**6)] = 2048
    inner: Annotated[float, Field(gt=0, le=1)] = 0.55
    repetitions: Count = 3
    iterations: Annotated[int, Field(ge=1, le=10**6)] = 120
    learning_rate: Positive = 0.05
    family: tuple[float, float] = (1 / 3, 1 / 3)
    record_every: Annotated[int, Field(ge=1)] = 5
    boundary: Literal["mirror", "reflect", "wrap"] = "reflect"

    @model_validator(mode="after")
    def _titled(self) -> Config:
        titles = [c.title for c in self.classes]
        if repeated := {t for t in titles if titles.count(t) > 1}:
            raise ValueError(f"expected classes with different titles; got twice: {', '.join(sorted(repeated))}")
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless every scan is there and large enough to be parted."""
    for i, source in enumerate(config.classes):
        check_class(source, f"{path}classes[{i}]")


def check_class(source: AnyClass, path: str) -> None:
    """Raises ConfigError, for the key of the class at `path`, unless its scan is there and can be parted."""
    if not isinstance(source, ScanClass):
        return
    domain = source.volume.check(f"{path}.volume")
    shape = [round(b - a) for a, b in zip(domain.lower, domain.upper, strict=True)]
    if least_extent(shape) < 2 or min(shape) < 3:
        message = f"expected a volume that can be halved and parted; got {shape} voxels along x, y, z"
        raise ConfigError([Problem(source.volume.file, f"{path}.volume", message)])


def units(config: Config) -> list[Unit]:
    """For each class the named methods, all fits, the verdict and the curves; at the end, filters of other classes."""
    work = []
    for i, source in enumerate(config.classes):
        work.append(Unit(f"{i}/{NAMED}", f"{source.title}, named methods", 0.5))
        work += [
            Unit(
                f"{i}/{FIT}/{r}/{c.key}",
                f"{source.title}, {c.key}, {r + 1} of {config.repetitions}",
                _seconds(config, c),
            )
            for r in range(config.repetitions)
            for c in config.candidates
        ]
        work.append(Unit(f"{i}/{VERDICT}", f"{source.title}, verdict", 0.01))
        work.append(Unit(f"{i}/{SPECTRUM}", f"{source.title}, responses", 0.3))
    if len(config.classes) > 1:
        work += [Unit(f"{i}/{ELSEWHERE}", f"{s.title}, filters of others", 0.3) for i, s in enumerate(config.classes)]
    return work


def _seconds(config: Config, candidate: Candidate) -> float:
    """Of a fit on one core: every step prefilters all voxels and reads the taps of all points, forth and back."""
    voxels = config.training * config.resolution**3 * (candidate.prefilter > 1) * candidate.prefilter
    reads = config.training * config.points * candidate.taps * (4 if candidate.kernel == "bc" else 1)
    return 0.2 + config.iterations * (voxels * 1e-8 + reads * 1e-8)


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, what, *rest = unit.key.split("/")
    i = int(index)
    common = {"kind": what, "class": i, "title": config.classes[i].title}
    match what:
        case "named":
            return {**common, **_named(config, i, run)}
        case "fit":
            candidate = next(c for c in config.candidates if c.key == rest[1])
            return {**common, "repetition": int(rest[0]), **candidate.record(), **_fit(config, i, candidate, unit, run)}
        case "verdict":
            return {**common, "choices": _verdict(config, i, run)}
        case "spectrum":
            return {**common, **_spectrum(config, i, run)}
        case _:
            return {**common, "filters": _elsewhere(config, i, run)}


# --- members ----------------------------------------------------------------------------------------------------------


def _members(config: Config, index: int, role: Role, repetition: int, run: Run) -> Members:
    """Members of a class."""
    count = {"training": config.training, "validation": config.validation, "test": config.test}[role]
    points = config.test_points if role == "test" else config.points
    sampling = Sampling(config.resolution, config.inner, config.device)

    def make() -> Members:
        source: Source = run.memo(f"source:{index}", lambda: config.classes[index].open(sampling))
        return source.members(role, count, points, seed_of(config.seed, index, repetition))

    return run.memo(f"{role}:{index}/{repetition}", make)


def _test(config: Config, index: int, run: Run) -> Members:
    """The test members of a class: the same in all repetitions."""
    return _members(config, index, "test", 0, run)


# --- records ----------------------------------------------------------------------------------------------------------


def _named(config: Config, index: int, run: Run) -> Record:
    members = _test(config, index, run)
    value, gradient = members.scales
    return {
        "scales": {"value": number(value), "gradient": number(gradient)},
        "methods": [
            {
                **recipe.record(),
                "taps": fl.METHODS[recipe.name].facts.taps,
                **_facts(recipe),
                "test": members.errors(recipe.build(members.volume, config.boundary)),
            }
            for recipe in config.methods
        ],
    }


def _facts(recipe: Recipe) -> Record:
    """What the prefilter of a named method costs, and the measures of the whole, where it is separable."""
    if (method := tensor_product(recipe.name)) is None:
        return {}
    used = method.prefilter if recipe.prefilter else prefilters.IDENTITY
    measures = fir.measures(method.kernel, used.response) if method.terms is None else {}
    return {"poles": len(used.poles), "multiplications": fir.multiplications(used), **measures}


def _fit(config: Config, index: int, candidate: Candidate, unit: Unit, run: Run) -> Record:
    repetition = int(unit.key.split("/")[2])
    training, validation = (
        Objective.of(
            _members(config, index, role, repetition, run), config.boundary, config.gradient_weight, config.reference
        )
        for role in ROLES[:2]
    )
    state = minimize(
        Fit.of(candidate, training, validation, candidate.start(config.family, config.device)),
        [Stage(iterations=config.iterations, learning_rate=config.learning_rate)],
        run.folder / "files" / f"{run.prefix}{unit.key}.state.pt".replace("/", "--"),
        observe_every=config.record_every,
        checkpoint_every=config.iterations,
        device=config.device,
        progress=run.advance,
    )
    best = min(state.observations, key=lambda o: o["validation"])
    test = _test(config, index, run)
    field = candidate.reconstruct(parameters_of(best["parameters"], config.device), test.volume, config.boundary)
    learned = parameters_of(best["parameters"])
    measures = fir.measures(candidate.built(learned), lambda omega: _prefiltering(learned, omega))
    return {**_course(state), **best, **measures, "test": test.errors(field)}


def _course(state: State) -> Record:
    """How the descent went; `falling` is the part of the objective that its last tenth still took off."""
    course = state.misfits
    before = course[-max(len(course) // 10, 1) - 1 :][0]
    observations = [{"iteration": o["iteration"], "validation": o["validation"]} for o in state.observations]
    return {"training": course, "observations": observations, "falling": number(1 - course[-1] / before)}


def _prefiltering(parameters: Parameters, omega: Tensor) -> Tensor:
    return fir.response(parameters["taps"], omega) if "taps" in parameters else torch.ones_like(omega)


def _fits(index: int, run: Run) -> list[Record]:
    return [r for r in run.records.values() if r["kind"] == FIT and r["class"] == index]


def _verdict(config: Config, index: int, run: Run) -> list[Record]:
    """The chosen filter of every cost, against every named method."""
    fits, named = _fits(index, run), run.records[f"{index}/{NAMED}"]["methods"]
    choices = []
    for taps, key in chosen(fits).items():
        learned = [f["test"] for f in fits if f["candidate"] == key]
        against = [
            {
                "recipe": method["recipe"],
                "equal_cost": method["taps"] == taps,
                **{quantity: compared(learned, method["test"], quantity) for quantity in QUANTITIES},
            }
            for method in named
        ]
        candidate = next(c for c in config.candidates if c.key == key)
        choices.append({**candidate.record(), "against": against})
    return choices


def _spectrum(config: Config, index: int, run: Run) -> Record:
    """Response and error kernel of the chosen filters and of the named methods that cost as much."""
    omega = torch.linspace(0, UPPER * math.pi, FREQUENCIES, dtype=torch.float64)
    rows, curves = [], []
    fits = _fits(index, run)
    for choice in run.records[f"{index}/{VERDICT}"]["choices"]:
        for fit in fits:
            if fit["candidate"] == choice["candidate"]:
                curves.append({"taps": choice["taps"], "candidate": fit["candidate"], "repetition": fit["repetition"]})
                rows.append(_learned_curves(config, fit, omega))
        for against in choice["against"]:
            method = tensor_product(against["recipe"].partition("+")[0])
            if against["equal_cost"] and method is not None and method.terms is None:
                recipe = next(r for r in config.methods if r.key == against["recipe"])
                prefiltering = method.prefilter.response(omega) if recipe.prefilter else torch.ones_like(omega)
                curves.append({"taps": choice["taps"], **recipe.record()})
                rows.append(_curves(method.kernel, prefiltering, omega))
    file = run.save_array(f"{index}-spectrum", torch.cat((omega[None], *rows)))
    return {"curves": curves, "array": file, "files": [file]}


def _learned_curves(config: Config, fit: Record, omega: Tensor) -> Tensor:
    candidate = next(c for c in config.candidates if c.key == fit["candidate"])
    parameters = parameters_of(fit["parameters"])
    return _curves(candidate.built(parameters), _prefiltering(parameters, omega), omega)


def _curves(kernel: Any, prefiltering: Tensor, omega: Tensor) -> Tensor:
    """Two rows: the response P(ω)Φ(ω) and the error kernel."""
    return torch.stack((prefiltering * kernel_response(kernel, omega), fir.error_kernel(kernel, prefiltering, omega)))


def _elsewhere(config: Config, index: int, run: Run) -> list[Record]:
    """The chosen filters of every class on the test members of this one, relative to the best named of equal cost."""
    test, named = _test(config, index, run), run.records[f"{index}/{NAMED}"]["methods"]
    listed = []
    for other in range(len(config.classes)):
        for choice in run.records[f"{other}/{VERDICT}"]["choices"]:
            rivals = [m for m in named if m["taps"] == choice["taps"]]
            if not rivals:
                continue
            candidate = next(c for c in config.candidates if c.key == choice["candidate"])
            fits = [f for f in _fits(other, run) if f["candidate"] == candidate.key]
            fields = [
                candidate.reconstruct(parameters_of(f["parameters"], config.device), test.volume, config.boundary)
                for f in fits
            ]
            errors = [test.errors(field) for field in fields]
            best = {q: min(rivals, key=lambda m, q=q: pooled(m["test"][q])) for q in QUANTITIES}
            listed.append(
                {
                    "learned_on": other,
                    "taps": choice["taps"],
                    "candidate": candidate.key,
                    **{q: {"rival": best[q]["recipe"], **compared(errors, best[q]["test"], q)} for q in QUANTITIES},
                }
            )
    return listed
