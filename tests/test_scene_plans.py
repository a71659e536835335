"""Plans: what a scene takes, from the job that renders it; and `method: auto`, which is settled first."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

import filterlab as fl
from filterlab.cli import main
from filterlab.fields.base import Field
from filterlab.io.config import ConfigError, loads_config
from filterlab.scenes import build as building
from filterlab.scenes.build import build
from filterlab.scenes.model import Scene
from filterlab.scenes.plan import SurfacePlan, plan
from filterlab.scenes.plan_report import table
from tests import resident

BASE = """
signal: {name: sphere, samples: 24}
method: triquadratic
transfer: {unit: 0.1, points: [
  {value: 0.2, color: [1, 0.5, 0.2], opacity: 0},
  {value: 0.7, color: [1, 0.9, 0.2], opacity: 0.5}]}
size: [20, 16]
"""


def scene(more: str = "") -> Scene:
    return loads_config(BASE + more, Scene)


class Counting(Field):
    """A field that notes how often it is asked, and for which derivatives."""

    def __init__(self, field: Field) -> None:
        self.field, self.domain, self.max_order = field, field.domain, field.max_order
        self.samples, self.orders = 0, set()

    def jet(self, points: torch.Tensor, order: int) -> tuple[torch.Tensor, ...]:
        if order == 0 or not self.orders:
            self.samples += points.shape[:-1].numel()
        self.orders.add(order)
        return self.field.jet(points, order)


@pytest.mark.parametrize(
    "more", ["", "lighting: {}\n", "jitter: 3\nstep: 1.3\n", "region: {lower: [-1, -1, -1], upper: [0, 1, 1]}\n"]
)
def test_a_plan_says_what_the_renderer_does(more: str) -> None:
    """The plain marcher, which skips nothing, takes as many samples, and asks for no other derivatives."""
    prepared = build(scene(more))
    found = plan(prepared)
    counting = Counting(prepared.field)
    other = replace(prepared, field=counting)
    with torch.no_grad():
        other.render()
        told = []
        prepared.render(lambda done, total: told.append(total))
    assert found.samples == counting.samples == told[-1]
    assert found.order == max(counting.orders)
    assert found.rays == 20 * 16
    assert found.marcher == "fused"
    assert plan(other).marcher == "plain"
    assert "a Counting" in str(plan(other).not_fused)
    assert plan(other).skipped is None


def test_what_is_skipped_is_what_the_renderer_leaves_out() -> None:
    """Samples in empty bricks, counted one by one over all rays."""
    text = BASE.replace("samples: 24", "samples: 40, parameters: {radius: 0.3, edge: 0.05}")
    prepared = build(loads_config(text, Scene))
    found = plan(prepared)
    assert found.empty_bricks is not None
    assert found.skipped is not None
    assert 0.3 < found.empty_bricks < 1
    assert 0.3 < found.skipped < 1
    from filterlab.render.fused import empty_bricks

    frame = prepared.frame()
    bricks = empty_bricks(frame.media[0])
    assert bricks is not None
    inside = 2 * torch.rand(4000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    lying = inside[bricks.empty(inside)]
    values = prepared.field(lying)
    assert len(lying) > 1000
    assert float(prepared.transfer.opacity(prepared.transfer.locate(values.double())).max()) == 0


def test_a_volume_without_empty_space_has_none_to_skip() -> None:
    opaque = BASE.replace("opacity: 0}", "opacity: 0.1}")
    found = plan(build(loads_config(opaque, Scene)))
    assert found.empty_bricks == found.skipped == 0


def test_what_is_absent_is_listed_and_what_is_there_is_not() -> None:
    bare = " ".join(plan(build(scene())).absent)
    for word in ("lighting", "region", "jitter", "termination"):
        assert word in bare
    full = scene("lighting: {}\njitter: 1\ntermination: 0.01\nregion: {lower: [-1, -1, -1], upper: [1, 1, 1]}\n")
    assert plan(build(full)).absent == ()


def test_a_signal_is_planned_too() -> None:
    text = BASE.replace(", samples: 24", "").replace("method: triquadratic", "")
    found = plan(build(loads_config(text, Scene)))
    assert (found.method, found.taps, found.volume_bytes, found.coefficient_bytes) == ("exact", None, 0, 0)
    assert found.marcher == "plain"
    assert table(found).row_count > 5


# --- method: auto -----------------------------------------------------------------------------------------------------

AUTO = BASE.replace("method: triquadratic", "method: {name: auto, max_error: 60%}")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Costs are measured for less long, and of fewer methods."""
    whole = building.recommend

    def recommend(*arguments, **options):
        return whole(*arguments, methods=["trilinear", "notch"], seconds=0.05, **options)

    monkeypatch.setattr(building, "recommend", recommend)


def test_auto_is_the_scene_that_it_stands_for() -> None:
    prepared = build(loads_config(AUTO, Scene))
    method = prepared.scene.method
    assert method is not None
    assert method.name in ("trilinear", "notch")
    assert method.max_error is None
    assert prepared.scene.step == prepared.sampling.step == 1.0
    with torch.no_grad():
        assert torch.equal(prepared.render(), build(prepared.scene).render())
    assert any("Recommended" in sentence for sentence in plan(prepared).chosen)


def test_a_step_of_the_scene_is_kept() -> None:
    assert build(loads_config(AUTO + "step: 0.3\n", Scene)).sampling.step == 0.3


def test_auto_counts_the_errors_of_what_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, quick = [], building.recommend

    def recommend(*arguments, **options):
        asked.append(options)
        return quick(*arguments, **options)

    monkeypatch.setattr(building, "recommend", recommend)
    start = AUTO[: AUTO.index("transfer:")]
    for shown in ("surface: 0.25", "surface: {level: 0.5, axis: normalized}", "slice: z"):
        build(loads_config(f"{start}{shown}\nsize: [4, 4]\n", Scene))
    build(loads_config(AUTO, Scene))
    middle = pytest.approx(sum(float(end) for end in fl.signals.sphere().sample(24).samples.aminmax()) / 2, abs=1e-6)
    assert [(a["task"], a.get("level")) for a in asked] == [
        ("isosurface", 0.25),
        ("isosurface", middle),
        ("resample", None),
        ("dvr", None),
    ]


def test_auto_says_when_nothing_is_within_the_budget() -> None:
    text = AUTO.replace("60%", "0.000001")
    with pytest.raises(ValueError, match=r"found none within max_error 0.0001 %; the most accurate: "):
        build(loads_config(text, Scene))


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("auto", "max_error goes with the name auto"),
        ("{name: notch, max_error: 0.1}", "max_error goes with the name auto"),
        ("{name: auto, max_error: 1%, scheme: direct}", "auto settles scheme"),
        ("{name: auto, max_error: lots}", "a part like 0.005 or 0.5%; got 'lots'"),
        ("{name: auto, max_error: 0}", "greater than 0"),
        ("{name: autop, max_error: 1%}", "did you mean 'auto'?"),
    ],
)
def test_mistakes(method: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loads_config(BASE.replace("method: triquadratic", f"method: {method}"), Scene)


def test_the_command(tmp_path, capsys) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(BASE)
    assert main(["render", str(path), "--explain", "--step", "0.25"]) == 0
    shown = capsys.readouterr().out
    assert "triquadratic (fused)" in shown
    assert "at a step of 0.25 voxels" in shown
    assert "lighting: no gradient is computed" in shown
    assert main(["render", str(path)]) == 2
    assert main(["render", str(path), "--explain", "-o", str(tmp_path / "p.png")]) == 2
    assert "expected either -o FILE.png or --explain; got both" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [path]


GROWTH = """
import sys

import torch
from filterlab.methods import reconstruct
from filterlab.render import PerspectiveCamera, TransferFunction
from filterlab.render.dvr import prepare
from filterlab.render.sampling import Sampling
from tests import resident

field = reconstruct(torch.rand(3, 3, 3), "trilinear")
transfer = TransferFunction([0.0, 1.0], [[1.0, 0.5, 0.2]] * 2, [0.1, 0.2])
camera = PerspectiveCamera.framing(field.domain, margin=3.0)
for memory in map(int, sys.argv[1:]):
    sampling = Sampling(step=10.0, memory=memory)
    prepare(field, camera, transfer, size=(64, 64), sampling=sampling).run()  # what is compiled is there now
    frame = prepare(field, camera, transfer, size=(800, 700), sampling=sampling)
    said, image = (frame.image_bytes, frame.ray_bytes), None
    del frame
    before = resident.begin()
    image = prepare(field, camera, transfer, size=(800, 700), sampling=sampling).run()
    print(field.scheme.name, image.nbytes, *said, resident.highest() - before)
"""


@pytest.mark.skipif(not resident.CAN_BE_TOLD, reason="the system does not tell the peak of a part")
def test_an_image_takes_the_memory_that_is_said() -> None:
    """16 bytes a pixel and the rays in work or kept; in a process of its own, which has no memory of its past."""
    command = [sys.executable, "-c", GROWTH, str(2**22), str(2**28)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=resident.ENVIRONMENT)
    for line in done.stdout.splitlines():
        scheme, *numbers = line.split()
        image, image_said, rays_said, peak = map(int, numbers)
        assert scheme == "fused"
        assert image == image_said == 16 * 800 * 700
        # 16 MiB for what the allocator and the threads take
        assert 0.5 * image < peak <= image + rays_said + 2**24
    assert len(done.stdout.splitlines()) == 2


def test_the_plan_of_a_surface_counts_what_may_hold_the_level() -> None:
    text = "signal: {name: marschner-lobb, samples: 16}\nsurface: {level: 0.5, material: {kind: toon, contour: 0.1}}\n"
    prepared = build(loads_config(text + "size: [40, 30]\n", Scene))
    found = plan(prepared)
    assert isinstance(found, SurfacePlan)
    assert (found.method, found.degree, found.order, found.rays) == ("triquadratic", 6, 2, 1200)
    assert 16**2 < found.cells <= found.pieces < 17**3
    assert found.seconds.low > 0
    assert found.image_bytes == 1200 * 16
    assert any("shadows" in line for line in found.absent)
    assert table(found).row_count > 6
