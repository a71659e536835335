"""The program of the march: rays in, light and optical depth out, all in registers; and its adjoint.

`ops.cpu.traversal` finds runs of segments that may be seen, which are marched two at a time. For every two:

    where       ends, middles and lengths of the segments, in double precision; the middles as points of the grid
    taps        value, and with lights the gradient, from the same taps (`ops.cpu.taps`)
    optics      opacity α and optical depth τ; colour c, lit (`ops.cpu.optics`)
    compose     a_i = 1 − e^{−τ_i}; T_i = e^{−depth} (1 − a_0) … (1 − a_{i−1}), running products over the lanes
                of a run behind the depth of the runs before; weight w_i = T_i a_i; light += Σ w_i c_i, depth += Σ τ_i

What changes nothing is not computed: runs without opacity end after the look-up of their opacities, one behind an
opaque medium before its colours. Colours and lights take many registers: that is done for one run after the other, and
so is everything of the adjoint. A run has the lanes of two registers, as the sums over taps fill one.

The adjoint marches the same way again, front to back, and needs nothing but the result: what segment i changes behind
itself is the rest of the light, known from what has passed. With g the cotangent of the light, γ_i = g · c_i:

    τ̄_i = γ_i T_{i+1} − (g · light − Σ_{j≤i} w_j γ_j) + cotangent of the depth        c̄_i = w_i g

From there `ops.cpu.tape` goes back to value and gradient, and `Taps.spread` to the coefficients.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from llvmlite import ir

from filterlab.ops.cpu import frame, job, mathematics
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import DOUBLE, I64, POINTER, STORAGE, Lanes, Value
from filterlab.ops.cpu.optics import Lights, OnTable, Steps, TransferTable, optical_depth, shade
from filterlab.ops.cpu.sums import Sums, sums_of
from filterlab.ops.cpu.tape import Node, Tape
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.traversal import Ray, Run, Segments, State, Traversal
from filterlab.ops.march_derivatives import TABLE_ROW, gradient_columns
from filterlab.ops.tetrahedra import LoweredStencil, reads_more

TABLES = 2  # of derivatives by the transfer function, to be summed

# Arrays are contiguous. R rays, K lights; "number" is the type of the arithmetic, d a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "coefficients": ctypes.c_void_p,  # (D, H, W)
    "width": ctypes.c_int64,
    "height": ctypes.c_int64,
    "start": ctypes.c_int64,  # coordinate of coefficient 0
    **{f"low_{a}": ctypes.c_double for a in AXES},  # smallest and largest coordinate of a first tap
    **{f"high_{a}": ctypes.c_double for a in AXES},
    "entry": ctypes.c_void_p,  # (R, 3) d, where the ray enters, in coordinates of the grid
    "direction": ctypes.c_void_p,  # (R, 3) d, the step of the grid per length
    "length": ctypes.c_void_p,  # (R) d
    "offset": ctypes.c_void_p,  # (R) d
    "count": ctypes.c_void_p,  # (R) int64, segments
    "step": ctypes.c_double,  # length of a segment
    "per_unit": ctypes.c_double,  # 1 / the length that opacities are for
    "inner": ctypes.c_void_p,  # control points but the first and last, numbers
    "opacities": ctypes.c_void_p,  # (intervals, 4) numbers, see `optics`
    "colors": ctypes.c_void_p,  # (intervals, 8) numbers
    "intervals": ctypes.c_int64,
    "buckets": ctypes.c_void_p,  # (B, 8) numbers, see `optics`
    "steps_low": ctypes.c_double,  # of even intervals or of buckets, see `optics`
    "steps_scale": ctypes.c_double,
    "steps_last": ctypes.c_double,
    "world": ctypes.c_void_p,  # (3, 3) numbers: gradient in the world = gradient in the grid · matrix
    "shading": ctypes.c_void_p,  # (2 + 6 K) numbers: ambient, shininess, and D and S of every light
    "view": ctypes.c_void_p,  # (R, 6 K) numbers: l and h of every light
    "faint": ctypes.c_double,  # transmittance below which a segment has no weight
    "opaque": ctypes.c_double,  # optical depth beyond which a ray ends
    "light": ctypes.c_void_p,  # (R, 3) d; written by the march, read by its adjoint
    "depth": ctypes.c_void_p,  # (R) d, written by the march
    "bricks": ctypes.c_void_p,  # (bz, by, bx) bytes: distance to the nearest brick that is not empty
    **{f"bricks_{a}": ctypes.c_int64 for a in AXES},  # their number
    "edge": ctypes.c_int64,  # of a brick, log₂ of its cells
    "slack": ctypes.c_double,  # by how much a point may be rounded, in voxels
    "light_cotangent": ctypes.c_void_p,  # (R, 3) d
    "depth_cotangent": ctypes.c_void_p,  # (R) d
    "ray_gradient": ctypes.c_void_p,  # (R, 7) d, lit (R, 9 + 12 K), see `ops.march_derivatives`; added to
    "table_gradient": ctypes.c_void_p,  # (TABLES, intervals, 12) d, see there; added to
    "coefficient_gradient": ctypes.c_void_p,  # (D, H, W) numbers; added to
    "first": ctypes.c_int64,  # rays to be marched: from this one
    "last": ctypes.c_int64,  # to before this one
    "stride": ctypes.c_int64,  # chunk c has the blocks c, c + stride, c + 2 stride, …
    "chunks": ctypes.c_int64,  # `next` stops here
}


WRITTEN_OUT = 12  # rows times planes, see `Taps`


class MarchJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class MarchVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        gradients: the adjoint by these (of `ops.march_derivatives.GRADIENTS`); empty: the march.
        stencil: value, and gradient when lit.
        derivatives: the stencil of its rows' derivatives, and `raised` as in `Stencil.derivatives`; for "rays".
        lit: whether there is shading.
        lights: K.
        skipping: whether empty bricks are left out.
        interval: how a value's interval of the transfer function is found, of `optics.WAYS`.
        arithmetic: "float32" or "float64".
        storage: dtype of the coefficients.
        room: whether there is a number behind the last coefficient, in the same storage.
        lanes: of a register; a run has twice as many.
    """

    gradients: tuple[str, ...]
    stencil: LoweredStencil
    derivatives: tuple[LoweredStencil, tuple[tuple[int, ...], ...]] | None
    lit: bool
    lights: int
    skipping: bool
    interval: str
    arithmetic: str
    storage: str
    room: bool
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        (_Adjoint if self.gradients else _March)(self, function).write()


class Parts:
    """The sums over taps of a pack, part by part.

    The sums need most registers, so that a part of them fills one register with every number. All else is chains of
    operations that wait for one another; there several registers are worked on at a time. A loop goes through the
    parts: programs that are much longer are slow to read for a processor.
    """

    def __init__(self, lanes: Lanes, taps: Sums) -> None:
        self.lanes, self.builder, self.taps = lanes, lanes.builder, taps
        self.location = taps.location(lanes)

    def contract(self, points: Sequence[Value], volume: Value) -> list[Value]:
        """The rows of the stencil."""
        rows = [self.lanes.kept() for _ in self.taps.stencil.rows]
        with self._every_part(points, volume) as (i, addresses, u):
            found = self.taps.contract(addresses, I64(0), self.taps.weigh(u), u)
            for row, value in zip(rows, found, strict=True):
                row.set_part(i, value)
        return [row.all(self.lanes.count) for row in rows]

    def spread(self, points: Sequence[Value], volume: Value, cotangents: Sequence[Value]) -> None:
        """The adjoint of that: add into the volume."""
        given = [self.lanes.kept(cotangent) for cotangent in cotangents]
        with self._every_part(points, volume) as (i, addresses, u):
            own = [cotangent.part(i, self.taps.lanes.count) for cotangent in given]
            self.taps.spread(addresses, I64(0), self.taps.weigh(u), own)

    @contextmanager
    def _every_part(self, points: Sequence[Value], volume: Value) -> Iterator[tuple[Value, list[Value], list[Value]]]:
        """For every part its number, the addresses of its lanes' first taps, and their local coordinates."""
        b, count = self.builder, self.taps.lanes.count
        first, u = self.location.locate(points, volume)
        addresses, local = self.lanes.kept(first), [self.lanes.kept(own) for own in u]
        with self.lanes.repeat(I64(0), I64(self.lanes.count // count)) as i:
            numbers = [b.add(b.mul(i, I64(count)), I64(lane)) for lane in range(count)]
            pointers = [b.inttoptr(addresses.number(number), POINTER) for number in numbers]
            yield i, pointers, [own.part(i, count) for own in local]


class _Program:
    """What march and adjoint have in common.

    Attributes:
        runs: marched at a time.
        kept: names of what is kept of a ray from run to run.
    """

    runs: int
    kept: tuple[str, ...]

    def __init__(self, variant: MarchVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.part = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.run = Lanes(self.builder, variant.arithmetic, 2 * variant.lanes)
        self.lanes = Lanes(self.builder, variant.arithmetic, self.runs * self.run.count)
        self.few = Lanes(self.builder, variant.arithmetic, 4)  # for single numbers
        self.storage = STORAGE[variant.storage]

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.grid = Grid.of(j)
        taps = self.of_coefficients(self.variant.stencil)
        self.taps = Parts(e, taps)
        steps = Steps(j.steps_low, j.steps_scale, j.steps_last)
        tables = j.opacities, j.colors, j.intervals, j.buckets
        self.table, self.table_of_run = (
            TransferTable(lanes, self.variant.interval, j.inner, *tables, steps) for lanes in (e, self.run)
        )
        self.traversal = Traversal(taps.location(self.run), j, self.kept, self.variant.skipping)
        self.prepare()
        with frame.every_chunk(e, j) as chunk, self.traversal.every_block(chunk):
            self._march_block()
        b.ret_void()

    def of_coefficients(self, stencil: LoweredStencil) -> Sums:
        return sums_of(self.part, stencil, self.storage, self.grid, self.variant.room, WRITTEN_OUT)

    def _march_block(self) -> None:
        with self.traversal.every_ray() as (number, state):
            self.begin(number, state)
        self.march_runs()
        with self.traversal.every_ray() as (number, state):
            self.finish(number, state)

    def prepare(self) -> None:
        """Reserve what has to be reserved before any loop."""

    def begin(self, number: Value, state: State) -> None:
        """What is kept of a ray before its first run."""
        raise NotImplementedError

    def march_runs(self) -> None:
        """All runs of a block's rays."""
        raise NotImplementedError

    def finish(self, number: Value, state: State) -> None:
        """What is written when a block is done."""

    # --- runs ---

    def uniform(self, ray: Ray) -> dict[str, list[Node]]:
        """What is the same all along a ray, by name of `march_derivatives.gradient_columns`; for a run."""
        if not self.variant.lit:
            return {}
        b, j, columns = self.builder, self.job, gradient_columns(self.variant.lights)
        shading, view = (columns[name].stop - columns[name].start for name in ("shading", "view"))
        row = b.mul(ray.number, I64(view))
        return {
            "shading": [Node(self._everywhere(j.shading, I64(i))) for i in range(shading)],
            "view": [Node(self._everywhere(j.view, b.add(row, I64(i)))) for i in range(view)],
        }

    def _everywhere(self, array: Value, index: Value) -> Value:
        """A number of an array in all lanes of a run."""
        e = self.run
        return e.everywhere(self.builder.load(e.advance(array, index, e.number), typ=e.number))

    def everywhere(self, number: Value) -> Value:
        """A double in all lanes of a run."""
        return self.run.everywhere(self.run.scalar(number))

    def total(self, run: Value) -> Value:
        """The sum of all lanes of a run, a double; halves are added first."""
        return self.widened(self.part.total(self.part.add(*self.run.parts(run, self.part.count))))

    def widened(self, number: Value) -> Value:
        return number if self.lanes.number == DOUBLE else self.builder.fpext(number, DOUBLE)

    # --- samples ---

    def sampled(self, segments: Segments) -> list[Node]:
        """Rows of the stencil in the middle of segments."""
        return [Node(row) for row in self.taps.contract(segments.points, self.job.coefficients)]

    def known(self, segments: Segments, rows: Sequence[Node]) -> Segments:
        """Those are real where no row is NaN: else nothing is there."""
        b, real = self.builder, segments.real
        for row in rows:
            real = b.and_(real, b.fcmp_ordered("ord", row.value, row.value))
        return replace(segments, real=real)

    def world_gradient(self, tape: Tape, gradient: Sequence[Node]) -> list[Node]:
        """Gradients of the grid in the world: Σ_i gradient_i matrix_ij."""
        matrix = [[self._everywhere(self.job.world, I64(3 * i + k)) for k in range(3)] for i in range(3)]
        world = []
        for k in range(3):
            total = tape.scale(gradient[0], matrix[0][k])
            for i in (1, 2):
                total = tape.add(total, tape.scale(gradient[i], matrix[i][k]))
            world.append(total)
        return world

    def lights(self, uniform: dict[str, list[Node]]) -> Lights:
        shading, view, count = uniform["shading"], uniform["view"], self.variant.lights
        tints = [shading[2 + 3 * i : 5 + 3 * i] for i in range(2 * count)]
        vectors = [view[3 * i : 3 * i + 3] for i in range(2 * count)]
        return Lights(shading[0], shading[1], vectors[::2], vectors[1::2], tints[::2], tints[1::2])

    def transmittances(self, absorbed: Value, depth: Value) -> Value:
        """T of the segments of a run that absorb so much each, behind an optical depth."""
        e, few = self.run, self.few
        passed = e.delayed(e.running_products(e.subtract(e.constant(1), absorbed)), 1, first=1)
        arriving = few.lane(mathematics.exp(few, few.negate(few.everywhere(few.scalar(depth)))), 0)
        return e.multiply(passed, e.everywhere(arriving))

    def weights(self, transmittance: Value, absorbed: Value) -> Value:
        e = self.run
        faint = self.builder.fcmp_ordered("<", transmittance, self.everywhere(self.job.faint))
        return e.where(faint, e.constant(0), e.multiply(transmittance, absorbed))


@dataclass(frozen=True)
class _Sample:
    """What was computed for a run, as nodes whose adjoints are asked.

    Attributes:
        segments, located: where it is, in space and in the transfer function.
        thickness: lengths in units of the opacity.
        tau: optical depths.
        ends: of the interval's colours, r₀ r₁ g₀ g₁ b₀ b₁.
        color: red, green and blue, lit.
        uniform: what is the same all along the ray, by name.
    """

    segments: Segments
    located: OnTable
    thickness: Node
    tau: Node
    ends: list[Node]
    color: list[Node]
    uniform: dict[str, list[Node]]


class _March(_Program):
    runs = 2
    kept = ("depth", "red", "green", "blue")

    def begin(self, number: Value, state: State) -> None:
        for name in self.kept:
            state.kept[name].value = DOUBLE(0.0)

    def march_runs(self) -> None:
        self.traversal.every_pair(self._march)

    def _march(self, first: Run, second: Run, same: Value) -> None:
        e, b = self.lanes, self.builder
        segments = self._segments(first, second)
        rows = self.sampled(segments)
        if reads_more(self.variant.stencil):  # else a gradient is NaN where the value is
            segments = self.known(segments, rows[1:])
        tape = Tape(e)
        located = self.table.locate(tape, rows[0])
        opacity = self.table.opacity(tape, located)
        tau = optical_depth(tape, opacity, Node(segments.thickness)).value
        tau = e.where(segments.real, e.maximum(tau, e.constant(0)), e.constant(0))  # 0 where it is NaN
        with b.if_then(e.any(e.differs(tau))):
            absorbed = self._parts(e.negate(mathematics.expm1(e, e.negate(tau))))
            weights = self._compose(first, second, same, self._parts(tau), absorbed)
            with self._every_run(first, second, weights, located, rows[1:]) as (ray, weight, own, gradient):
                seen = self.run.differs(weight)
                with b.if_then(self.run.any(seen)):
                    self._add_light(ray, own, gradient, weight, seen)

    @contextmanager
    def _every_run(
        self, first: Run, second: Run, weights: list[Value], located: OnTable, gradient: list[Node]
    ) -> Iterator[tuple[Ray, Value, OnTable, list[Node]]]:
        """For either run: the with-block, given its ray and its part of what was computed for both."""
        b, e, count = self.builder, self.lanes, self.run.count
        weight, place = e.kept(self.run.join(weights)), located.kept(e)
        rows = [e.kept(row.value) for row in gradient]
        with e.repeat(I64(0), I64(2)) as i:
            number = b.select(b.icmp_signed("==", i, I64(0)), first.ray.number, second.ray.number)
            own = [Node(row.part(i, count)) for row in rows]
            yield self.traversal.ray(number), weight.part(i, count), place(i, count), own

    def _parts(self, pack: Value) -> list[Value]:
        """The runs of a pack."""
        return self.lanes.parts(pack, self.run.count)

    def _segments(self, *runs: Run) -> Segments:
        own, join = [self.traversal.segments(run.ray, run.first) for run in runs], self.run.join
        return Segments(
            real=join([one.real for one in own]),
            last=join([one.last for one in own]),
            middle=join([one.middle for one in own]),
            points=[join(axis) for axis in zip(*(one.points for one in own), strict=True)],
            thickness=join([one.thickness for one in own]),
        )

    def _compose(self, first: Run, second: Run, same: Value, tau: list[Value], absorbed: list[Value]) -> list[Value]:
        """The weights of two runs; adds their optical depths τ to those of their rays.

        The second begins where the first one of the same ray ends, and has no weight where that ray is opaque.
        """
        e, b, depths = self.run, self.builder, [run.ray.state.kept["depth"] for run in (first, second)]
        before, behind = depths[0].value, b.fadd(depths[0].value, self.total(tau[0]))
        at_second = b.select(same, behind, depths[1].value)
        goes_on = b.fcmp_unordered("<=", at_second, self.job.opaque)  # NaN goes on
        depths[0].value = behind
        depths[1].value = b.select(goes_on, b.fadd(at_second, self.total(tau[1])), at_second)
        weights = [
            self.weights(self.transmittances(own, depth), own)
            for own, depth in zip(absorbed, (before, at_second), strict=True)
        ]
        return [weights[0], e.where(e.everywhere(goes_on), weights[1], e.constant(0))]

    def _add_light(self, ray: Ray, located: OnTable, gradient: list[Node], weight: Value, seen: Value) -> None:
        e, b, tape, table = self.run, self.builder, Tape(self.run), self.table_of_run
        color = table.color(tape, located, table.color_ends(located))
        if self.variant.lit:
            color = shade(tape, color, self.world_gradient(tape, gradient), self.lights(self.uniform(ray)))
        for name, own in zip(("red", "green", "blue"), color, strict=True):
            light = ray.state.kept[name]
            light.value = b.fadd(light.value, self.total(e.where(seen, e.multiply(weight, own.value), e.constant(0))))

    def finish(self, number: Value, state: State) -> None:
        e, b = self.lanes, self.builder
        for k, name in enumerate(("red", "green", "blue")):
            place = e.advance(self.job.light, b.add(b.mul(number, I64(3)), I64(k)), DOUBLE)
            b.store(state.kept[name].value, place)
        b.store(state.kept["depth"].value, e.advance(self.job.depth, number, DOUBLE))


class _Adjoint(_Program):
    runs = 1
    kept = ("depth", "rest")

    def prepare(self) -> None:
        e, variant = self.lanes, self.variant
        number = STORAGE[variant.arithmetic]
        self.spreading = self.taps
        if number != self.storage:  # derivatives by the coefficients are kept in the arithmetic's type
            self.spreading = Parts(e, sums_of(self.part, variant.stencil, number, self.grid))
        if variant.derivatives is not None:
            self.raised = variant.derivatives[1]
            self.differentiating = Parts(e, self.of_coefficients(variant.derivatives[0]))
        self.columns = gradient_columns(variant.lights if variant.lit else None)

    def wants(self, name: str) -> bool:
        return name in self.variant.gradients

    def begin(self, number: Value, state: State) -> None:
        state.kept["depth"].value = DOUBLE(0.0)
        state.kept["rest"].value = self._behind_everything(number)

    def march_runs(self) -> None:
        self.traversal.every_run(self._march)

    def _march(self, run: Run) -> None:
        ray = run.ray
        segments = self.traversal.segments(ray, run.first)
        rows = self.sampled(segments)
        segments = self.known(segments, rows)
        tape = Tape(self.lanes)
        located = self.table.locate(tape, rows[0])
        with self._if_it_counts(located, segments):
            sample = self._sample(tape, ray, located, rows, segments)
            self._compose_back(sample, ray)
            tape.backward()
            self._add_uniform(sample, ray)
            if self.wants("table"):
                self._add_to_table(sample)
            adjoints = [self._of_real(row.adjoint, segments) for row in rows]
            if self.wants("coefficients"):
                self.spreading.spread(segments.points, self.job.coefficient_gradient, adjoints)
            if self.wants("rays"):
                self._add_to_rays(sample, adjoints, ray)

    def _behind_everything(self, number: Value) -> Value:
        """g · light, of all the ray."""
        b, total = self.builder, DOUBLE(0.0)
        triple = self.traversal.triple
        for cotangent, light in zip(
            triple(self.job.light_cotangent, number), triple(self.job.light, number), strict=True
        ):
            total = b.fadd(total, b.fmul(cotangent, light))
        return total

    @contextmanager
    def _if_it_counts(self, located: OnTable, segments: Segments) -> Iterator[None]:
        """The with-block, unless the run has neither opacity nor derivatives."""
        if self.wants("table"):  # a control point's opacity counts where it is 0, too
            yield
        else:
            colored = self.builder.and_(located.colored(self.lanes), segments.real)
            with self.builder.if_then(self.lanes.any(colored)):
                yield

    def _of_real(self, adjoint: Value | None, segments: Segments) -> Value:
        """0 in lanes without a segment."""
        e = self.lanes
        return e.constant(0) if adjoint is None else e.where(segments.real, adjoint, e.constant(0))

    # --- forwards again ---

    def _sample(self, tape: Tape, ray: Ray, located: OnTable, rows: list[Node], segments: Segments) -> _Sample:
        thickness = Node(segments.thickness)
        tau = optical_depth(tape, self.table.opacity(tape, located), thickness)
        ends = self.table.color_ends(located)
        color = self.table.color(tape, located, ends)
        uniform = self.uniform(ray)
        if self.variant.lit:
            color = shade(tape, color, self.world_gradient(tape, rows[1:4]), self.lights(uniform))
        return _Sample(segments, located, thickness, tau, ends, color, uniform)

    def _compose_back(self, sample: _Sample, ray: Ray) -> None:
        """Adjoints of τ and of the colour; depth and rest of the light behind the run."""
        e, b, j, real = self.lanes, self.builder, self.job, sample.segments.real
        depth, rest, traversal = ray.state.kept["depth"], ray.state.kept["rest"], self.traversal
        tau = e.where(real, sample.tau.value, e.constant(0))
        absorbed = e.negate(mathematics.expm1(e, e.negate(tau)))
        transmittance = self.transmittances(absorbed, depth.value)
        weight = self.weights(transmittance, absorbed)
        depth.value = b.fadd(depth.value, self.total(tau))
        g = [self.everywhere(own) for own in traversal.triple(j.light_cotangent, ray.number)]
        shown = None
        for own, color in zip(g, sample.color, strict=True):
            shown = e.multiply_add(own, color.value, shown)
        passed = e.running_sums(e.where(real, e.multiply(weight, shown), e.constant(0)))
        behind = e.subtract(self.everywhere(rest.value), passed)
        after = e.subtract(transmittance, weight)
        to_depth = self.everywhere(traversal.double(j.depth_cotangent, ray.number))
        adjoint = e.add(e.subtract(e.multiply(shown, after), behind), to_depth)
        sample.tau.adjoint = e.where(real, adjoint, e.constant(0))
        for own, color in zip(g, sample.color, strict=True):
            color.adjoint = e.multiply(weight, own)
        rest.value = b.fsub(rest.value, self.widened(e.lane(passed, e.count - 1)))

    # --- backwards ---

    def _add_uniform(self, sample: _Sample, ray: Ray) -> None:
        """Derivatives by what is the same all along a ray."""
        if self.wants("shading"):
            for name, nodes in sample.uniform.items():
                for index, node in enumerate(nodes):
                    if node.adjoint is not None:
                        self._add(ray, name, index, self._of_real(node.adjoint, sample.segments))

    def _add(self, ray: Ray, name: str, index: int, more: Value) -> None:
        """Add the sum of a run to one of a ray's derivatives."""
        b, width = self.builder, max(columns.stop for columns in self.columns.values())
        column = b.add(b.mul(ray.number, I64(width)), I64(self.columns[name].start + index))
        place = self.lanes.advance(self.job.ray_gradient, column, DOUBLE)
        b.store(b.fadd(b.load(place, typ=DOUBLE), self.total(more)), place)

    def _add_to_table(self, sample: _Sample) -> None:
        """Derivatives by the ends of the intervals: 12 numbers of every lane's row."""
        packs = [self._of_real(node.adjoint, sample.segments) for node in (*sample.located.ends, *sample.ends)]
        size = self.builder.mul(self.job.intervals, I64(TABLE_ROW))
        tables = [
            self.lanes.advance(self.job.table_gradient, self.builder.mul(size, I64(i)), DOUBLE) for i in range(TABLES)
        ]
        for first in (0, 4, 8):
            own = packs[first : first + 4]
            self.table.add_to_rows(tables, sample.located.interval, own, TABLE_ROW, first)

    def _add_to_rays(self, sample: _Sample, adjoints: list[Value], ray: Ray) -> None:
        """Derivatives by entry, direction and length: points are entry + t direction, and the last t ends there."""
        e, segments = self.lanes, sample.segments
        derivatives = self.differentiating.contract(segments.points, self.job.coefficients)
        to_length = None
        for axis in range(3):
            total = None
            for row, adjoint in zip(self.raised[axis], adjoints, strict=True):
                total = e.multiply_add(adjoint, derivatives[row], total)
            total = self._of_real(total, segments)
            self._add(ray, "entry", axis, total)
            self._add(ray, "direction", axis, e.multiply(total, segments.middle))
            along = self.everywhere(ray.direction[axis])
            to_length = e.multiply_add(total, along, to_length)
        per_unit = e.everywhere(e.scalar(self.job.per_unit))
        thickness = self._of_real(sample.thickness.adjoint, segments)
        to_length = e.multiply_add(thickness, per_unit, e.multiply(to_length, e.constant(0.5)))
        self._add(ray, "length", 0, e.where(segments.last, to_length, e.constant(0)))
