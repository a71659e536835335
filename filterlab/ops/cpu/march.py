"""The program of the march: rays in, light and optical depth out, all in registers; and its adjoint.

A pack (`ops.cpu.lanes`) is P consecutive segments of *one* ray: they enter and leave the volume together, read
neighbouring coefficients, and no lane waits for another. For every pack:

    where       ends, middles and lengths of the segments, in double precision; the middles as points of the grid
    taps        value, and with lights the gradient, from the same taps (`ops.cpu.taps`)
    optics      opacity α and optical depth τ; colour c, lit (`ops.cpu.optics`)
    compose     T_i = exp(−τ_0 − … − τ_{i−1}) from running sums over the lanes behind the depth of the packs before,
                weight w_i = T_i (1 − e^{−τ_i}); light += Σ w_i c_i, depth += Σ τ_i

What changes nothing is not computed: a pack without opacity ends after the look-up of its opacities, one behind an
opaque medium before its colours. Empty space is left out before anything is computed at all (`render.bricks` explains
the bricks): if the nearest brick that is not empty is d bricks away, nothing comes within d − 1 bricks.

The adjoint marches the same way again, front to back, and needs nothing but the result: what segment i changes behind
itself is the rest of the light, known from what has passed. With g the cotangent of the light, γ_i = g · c_i:

    τ̄_i = γ_i T_{i+1} − (g · light − Σ_{j≤i} w_j γ_j) + cotangent of the depth        c̄_i = w_i g

From there `ops.cpu.tape` goes back to value and gradient, and `Taps.spread` to the coefficients.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, mathematics
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import DOUBLE, I8, I32, I64, STORAGE, Lanes, Value, Variable
from filterlab.ops.cpu.optics import Buckets, Lights, Located, TransferTable, optical_depth, shade
from filterlab.ops.cpu.tape import Node, Tape
from filterlab.ops.cpu.taps import Grid, Taps
from filterlab.ops.derivatives import TABLE_ROW, gradient_columns
from filterlab.ops.stencil import Lowered

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
    "bucket_low": ctypes.c_double,
    "bucket_scale": ctypes.c_double,
    "bucket_last": ctypes.c_double,  # B − 1
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
    "ray_gradient": ctypes.c_void_p,  # (R, 7) d, lit (R, 9 + 12 K), see `ops.derivatives`; written
    "table_gradient": ctypes.c_void_p,  # (intervals, 12) d, see there; added to
    "coefficient_gradient": ctypes.c_void_p,  # (D, H, W) numbers; added to
    "first": ctypes.c_int64,  # rays to be marched: from this one
    "last": ctypes.c_int64,  # to before this one
    "block": ctypes.c_int64,  # rays of a block
    "stride": ctypes.c_int64,  # chunk c has the blocks c, c + stride, c + 2 stride, …
    "chunks": ctypes.c_int64,  # `next` stops here
}


class Job(ctypes.Structure):
    _fields_ = list(FIELDS.items())


@dataclass(frozen=True)
class Recipe:
    """Everything the program depends on, apart from the machine.

    Attributes:
        gradients: the adjoint by these (of `ops.derivatives.GRADIENTS`); empty: the march.
        stencil: value, and gradient when lit.
        derivatives: the stencil of its rows' derivatives, and `raised` as in `Stencil.derivatives`; for "rays".
        lit: whether there is shading.
        lights: K.
        skipping: whether empty bricks are left out.
        bucketed: whether the transfer function has a table of buckets.
        arithmetic: "float32" or "float64".
        storage: dtype of the coefficients.
        lanes: P.
    """

    gradients: tuple[str, ...]
    stencil: Lowered
    derivatives: tuple[Lowered, tuple[tuple[int, ...], ...]] | None
    lit: bool
    lights: int
    skipping: bool
    bucketed: bool
    arithmetic: str
    storage: str
    lanes: int

    def generate(self) -> str:
        """The program as LLVM IR text."""
        module, function = frame.new_module()
        (_Adjoint if self.gradients else _March)(self, function).write()
        return str(module)


@dataclass
class _Ray:
    """One ray: what is the same for all of its packs.

    Attributes:
        number: of the ray.
        entry, direction: three doubles each.
        length, offset: doubles.
        count: segments.
        leap: how many segments there are, at least, to a voxel (double); for skipping.
        uniform: by name of `ops.derivatives.gradient_columns`, packs.
    """

    number: Value
    entry: list[Value]
    direction: list[Value]
    length: Value
    offset: Value
    count: Value
    leap: Value | None
    uniform: dict[str, list[Value]]


@dataclass(frozen=True)
class _Segments:
    """P segments of a ray.

    Attributes:
        real: a mask of those that the ray has.
        last: a mask of the one that ends where the ray does.
        middle: distance from the entry, numbers.
        points: their middles in coordinates of the grid, numbers.
        thickness: their lengths in units of the opacity, numbers.
    """

    real: Value
    last: Value
    middle: Value
    points: list[Value]
    thickness: Value


_LocatedTaps = list[tuple[Value, list[Value]]]
"""For both halves of a pack where their taps are, and their local coordinates."""


class _Halves:
    """The sums over taps of a pack, in halves.

    The sums need most registers, so that a pack of them fills one register with every number. All else is chains of
    operations that wait for one another; there two registers are worked on at a time. Measured: 0.8 times the time.
    """

    def __init__(self, lanes: Lanes, half: Lanes, taps: Taps) -> None:
        self.lanes, self.half, self.taps = lanes, half, taps
        self.supports = taps.supports

    def cells(self, points: Sequence[Value]) -> list[Value]:
        """Along x, y, z: every lane's first tap, counted from coefficient 0 (32 bits)."""
        halves = [[cell for cell, _ in self.taps.cells(own)] for own in self._split(points)]
        return self._joined(halves)

    def locate(self, points: Sequence[Value]) -> _LocatedTaps:
        return [self.taps.locate(own) for own in self._split(points)]

    def contract(self, located: _LocatedTaps, volume: Value) -> list[Value]:
        """The rows of the stencil."""
        halves = []
        for offset, u in located:
            addresses = self.taps.addresses(offset, volume)
            halves.append(self.taps.contract(addresses, I64(0), self.taps.weigh(u), u))
        return self._joined(halves)

    def spread(self, located: _LocatedTaps, volume: Value, cotangents: Sequence[Value]) -> None:
        """The adjoint of that: add into the volume."""
        for (offset, u), own in zip(located, self._split(cotangents), strict=True):
            self.taps.spread(self.taps.addresses(offset, volume), I64(0), self.taps.weigh(u), own)

    def _split(self, packs: Sequence[Value]) -> list[list[Value]]:
        count = self.half.count
        return [[self.lanes.shuffle(p, p, range(first, first + count)) for p in packs] for first in (0, count)]

    def _joined(self, halves: Sequence[Sequence[Value]]) -> list[Value]:
        return [self.half.shuffle(a, b, range(self.lanes.count)) for a, b in zip(*halves, strict=True)]


class _Program:
    """What march and adjoint have in common."""

    def __init__(self, recipe: Recipe, function: ir.Function) -> None:
        self.recipe, self.function = recipe, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.half = Lanes(self.builder, recipe.arithmetic, recipe.lanes // 2)
        self.lanes = Lanes(self.builder, recipe.arithmetic, recipe.lanes)
        self.wide = Lanes(self.builder, "float64", recipe.lanes // 2)
        self.storage = STORAGE[recipe.storage]

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.grid = Grid.of(j)
        self.taps = _Halves(e, self.half, Taps(self.half, self.recipe.stencil, self.storage, self.grid))
        buckets = Buckets(j.buckets, j.bucket_low, j.bucket_scale, j.bucket_last) if self.recipe.bucketed else None
        self.table = TransferTable(e, j.inner, j.opacities, j.colors, j.intervals, buckets)
        self.prepare()
        with frame.every_chunk(e, j) as chunk:
            blocks = b.udiv(b.add(b.sub(j.last, j.first), b.sub(j.block, I64(1))), j.block)
            turns = b.udiv(b.add(b.sub(blocks, chunk), b.sub(j.stride, I64(1))), j.stride)
            with e.repeat(I64(0), turns) as turn:
                first = b.add(j.first, b.mul(b.add(chunk, b.mul(turn, j.stride)), j.block))
                with e.repeat(first, e.smaller(b.add(first, j.block), j.last)) as number:
                    self.march(self._load_ray(number))
        b.ret_void()

    def prepare(self) -> None:
        """Reserve what has to be reserved before any loop."""

    def march(self, ray: _Ray) -> None:
        raise NotImplementedError

    # --- rays ---

    def _load_ray(self, number: Value) -> _Ray:
        b, j = self.builder, self.job
        entry, direction = (
            [self._double(array, b.add(b.mul(number, I64(3)), I64(axis))) for axis in range(3)]
            for array in (j.entry, j.direction)
        )
        length, offset = (self._double(array, number) for array in (j.length, j.offset))
        count = b.load(self.lanes.advance(j.count, number, I64), typ=I64)
        leap = self._segments_per_voxel(direction) if self.recipe.skipping else None
        return _Ray(number, entry, direction, length, offset, count, leap, self._load_uniform(number))

    def _load_uniform(self, number: Value) -> dict[str, list[Value]]:
        """The numbers that are the same in every lane, as packs."""
        if not self.recipe.lit:
            return {}
        b, j, columns = self.builder, self.job, gradient_columns(self.recipe.lights)
        shading, view = (columns[name].stop - columns[name].start for name in ("shading", "view"))
        return {
            "shading": [self._everywhere(j.shading, I64(i)) for i in range(shading)],
            "view": [self._everywhere(j.view, b.add(b.mul(number, I64(view)), I64(i))) for i in range(view)],
        }

    def _double(self, array: Value, index: Value) -> Value:
        return self.builder.load(self.lanes.advance(array, index, DOUBLE), typ=DOUBLE)

    def _everywhere(self, array: Value, index: Value) -> Value:
        e = self.lanes
        return e.everywhere(self.builder.load(e.advance(array, index, e.number), typ=e.number))

    def widen(self, number: Value) -> Value:
        """A number of the arithmetic, or half a pack of them, as doubles."""
        if self.lanes.number == DOUBLE:
            return number
        return self.builder.fpext(number, self.wide.pack if isinstance(number.type, ir.VectorType) else DOUBLE)

    # --- segments ---

    def segments(self, ray: _Ray, first: Value) -> _Segments:
        """P segments from number `first` on, as `render.rays.segments` cuts them.

        Only the place of the pack is computed in doubles. Lane i is i steps further; the first and the last segment of
        a ray are shorter by what is cut off them at their start and end, and their middle moves by half of that.
        """
        e, b = self.lanes, self.builder
        step = e.everywhere(e.scalar(self.job.step))
        lane = ir.Constant(e.pack, [float(i) for i in range(e.count)])
        middle = self._regular_middle(ray, first)
        half = b.fmul(self.job.step, DOUBLE(0.5))
        to_start = e.everywhere(e.scalar(b.fsub(half, middle)))  # from the middle of lane 0, moved by half a step
        to_end = e.everywhere(e.scalar(b.fsub(b.fsub(ray.length, middle), half)))
        along = e.multiply(lane, step)
        nothing = e.constant(0)
        before = e.minimum(e.maximum(e.subtract(to_start, along), nothing), step)
        after = e.minimum(e.maximum(e.subtract(along, to_end), nothing), step)
        moved = e.multiply_add(e.subtract(before, after), e.constant(0.5), along)
        points = [
            e.multiply_add(moved, e.everywhere(e.scalar(way)), e.everywhere(e.scalar(b.fadd(b.fmul(middle, way), at))))
            for at, way in zip(ray.entry, ray.direction, strict=True)
        ]
        left = b.trunc(e.smaller(b.sub(ray.count, first), I64(e.count + 1)), I32)
        numbers = ir.Constant(ir.VectorType(I32, e.count), list(range(e.count)))
        return _Segments(
            real=b.icmp_signed("<", numbers, e.everywhere(left)),
            last=b.icmp_signed("==", numbers, e.everywhere(b.sub(left, I32(1)))),
            middle=e.add(moved, e.everywhere(e.scalar(middle))),
            points=points,
            thickness=e.multiply(
                e.maximum(e.subtract(e.subtract(step, before), after), nothing),
                e.everywhere(e.scalar(self.job.per_unit)),
            ),
        )

    def _regular_middle(self, ray: _Ray, number: Value) -> Value:
        """Distance of a segment's middle from the entry, were it a whole step long."""
        b = self.builder
        steps = b.fadd(b.fsub(b.sitofp(number, DOUBLE), DOUBLE(0.5)), ray.offset)
        return b.fmul(steps, self.job.step)

    @contextmanager
    def every_pack(self, ray: _Ray, depth: Variable) -> Iterator[Value]:
        """The first segment of one pack after the other, until the ray ends or is opaque."""
        b = self.builder
        first = self.lanes.variable(I64(0))

        def goes_on() -> Value:
            transparent = b.fcmp_unordered("<=", depth.value, self.job.opaque)  # NaN goes on
            return b.and_(b.icmp_signed("<", first.value, ray.count), transparent)

        with self.lanes.repeat_while(goes_on):
            here = first.value
            if self.recipe.skipping:
                with self._unless_empty(ray, first):
                    yield here
            else:
                yield here
            first.value = b.add(first.value, I64(self.lanes.count))

    # --- empty space ---

    def _segments_per_voxel(self, direction: Sequence[Value]) -> Value:
        """1 / (the longest way along an axis that a segment goes), a double."""
        b = self.builder
        longest = None
        for step in direction:
            size = b.call(self._scalar_function("llvm.fabs.f64"), [step])
            longest = size if longest is None else b.select(b.fcmp_ordered(">", size, longest), size, longest)
        return b.fdiv(DOUBLE(1.0), b.fmul(longest, self.job.step))

    def _scalar_function(self, name: str) -> Value:
        module = self.builder.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(DOUBLE, [DOUBLE]), name)

    @contextmanager
    def _unless_empty(self, ray: _Ray, first: Variable) -> Iterator[None]:
        """The with-block, unless all of the pack lies in empty bricks; `first` leaps over packs that do as well.

        From a point in a brick at distance d, steps of together less than d − 1 bricks along every axis stay within
        bricks at a distance of at least 1. Where that is not one whole pack, every lane looks for itself.
        """
        b, e = self.builder, self.lanes
        assert ray.leap is not None
        distance = self._distance_of_first(ray, first.value)
        near = b.append_basic_block("near")
        look, compute, done = (b.append_basic_block(name) for name in ("look", "compute", "done"))
        b.cbranch(b.icmp_unsigned("==", distance, I64(0)), compute, near)

        b.position_at_end(near)
        cells = b.shl(b.sub(distance, I64(1)), self.job.edge)
        reach = b.fsub(b.sitofp(cells, DOUBLE), self.job.slack)
        steps = self._smaller(b.fmul(reach, ray.leap), DOUBLE(2.0**40))  # a ray may hardly move
        packs = b.ashr(b.add(b.fptosi(steps, I64), I64(1)), I64(e.count.bit_length() - 1))  # + 1: where it stands
        far = b.append_basic_block("far")
        leaps = b.and_(b.icmp_signed(">", packs, I64(0)), b.fcmp_ordered(">=", reach, DOUBLE(0.0)))
        b.cbranch(leaps, far, look)

        b.position_at_end(far)
        first.value = b.add(first.value, b.mul(b.sub(packs, I64(1)), I64(e.count)))
        b.branch(done)

        b.position_at_end(look)
        points = self.segments(ray, first.value).points
        b.cbranch(self._all_empty(points), done, compute)

        b.position_at_end(compute)
        yield
        b.branch(done)
        b.position_at_end(done)

    def _distance_of_first(self, ray: _Ray, first: Value) -> Value:
        """The distance at the middle of one segment, an integer."""
        b, j = self.builder, self.job
        one = DOUBLE(1.0)
        index = b.sitofp(first, DOUBLE)
        end = self._smaller(b.fmul(b.fadd(index, ray.offset), j.step), ray.length)
        start = self._smaller(b.fmul(b.fadd(b.fsub(index, one), ray.offset), j.step), ray.length)
        start = b.select(b.fcmp_ordered(">", start, DOUBLE(0.0)), start, DOUBLE(0.0))
        middle = b.fmul(b.fadd(start, end), DOUBLE(0.5))
        bricks = []
        for axis in range(3):
            at = b.fadd(b.fmul(middle, ray.direction[axis]), ray.entry[axis])
            shifted = b.fsub(at, DOUBLE(self.taps.supports[axis] / 2 - 1))
            cell = b.call(self._scalar_function("llvm.floor.f64"), [shifted])
            low, high = self.grid.low[axis], self.grid.high[axis]
            cell = b.select(b.fcmp_ordered(">", cell, low), cell, low)
            cell = b.sub(b.fptosi(self._smaller(cell, high), I64), j.start)
            bricks.append(b.ashr(cell, j.edge))
        x, y, z = bricks
        index = b.add(b.mul(b.add(b.mul(z, j.bricks_y), y), j.bricks_x), x)
        return b.zext(b.load(self.lanes.advance(j.bricks, index, I8), typ=I8), I64)

    def _smaller(self, a: Value, b: Value) -> Value:
        """Of two doubles."""
        return self.builder.select(self.builder.fcmp_ordered("<", a, b), a, b)

    def _all_empty(self, points: Sequence[Value]) -> Value:
        """Whether every point lies in an empty brick."""
        e, b, j = self.lanes, self.builder, self.job
        edge, by, bx = (e.everywhere(b.trunc(n, I32)) for n in (j.edge, j.bricks_y, j.bricks_x))
        x, y, z = (b.ashr(cell, edge) for cell in self.taps.cells(points))
        index = b.add(b.mul(b.add(b.mul(z, by), y), bx), x)
        empty = None
        for lane in range(e.count):
            place = e.advance(j.bricks, b.zext(e.lane(index, lane), I64), I8)
            away = b.icmp_unsigned("!=", b.load(place, typ=I8), I8(0))
            empty = away if empty is None else b.and_(empty, away)
        return empty

    # --- samples ---

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
        shading, view, count = uniform["shading"], uniform["view"], self.recipe.lights
        tints = [shading[2 + 3 * i : 5 + 3 * i] for i in range(2 * count)]
        vectors = [view[3 * i : 3 * i + 3] for i in range(2 * count)]
        return Lights(shading[0], shading[1], vectors[::2], vectors[1::2], tints[::2], tints[1::2])

    def weights(self, tau: Value, depth: Value, real: Value) -> tuple[Value, Value]:
        """Transmittances T and weights w of segments of optical depths τ behind an optical depth (a double)."""
        e = self.lanes
        before = e.add(e.delayed(e.running_sums(tau), 1), e.everywhere(e.scalar(depth)))
        transmittance = mathematics.exp(e, e.negate(before))
        weight = e.multiply(transmittance, e.negate(mathematics.expm1(e, e.negate(tau))))
        faint = self.builder.fcmp_ordered("<", transmittance, e.everywhere(e.scalar(self.job.faint)))
        none = self.builder.or_(faint, self.builder.not_(real))
        return transmittance, e.where(none, e.constant(0), weight)


@dataclass(frozen=True)
class _Sample:
    """What was computed for a pack, as nodes whose adjoints are asked.

    Attributes:
        segments, located: where it is, in space and in the transfer function.
        thickness: lengths in units of the opacity.
        tau: optical depths.
        ends: of the interval's colours, r₀ r₁ g₀ g₁ b₀ b₁.
        color: red, green and blue, lit.
        uniform: what is the same all along the ray, by name.
    """

    segments: _Segments
    located: Located
    thickness: Node
    tau: Node
    ends: list[Node]
    color: list[Node]
    uniform: dict[str, list[Node]]


class _March(_Program):
    def march(self, ray: _Ray) -> None:
        e, b, d = self.lanes, self.builder, self.wide
        depth = e.variable(DOUBLE(0.0))
        light = [e.variable(d.constant(0)) for _ in range(3)]
        with self.every_pack(ray, depth) as first:
            segments = self.segments(ray, first)
            rows = [Node(row) for row in self.taps.contract(self.taps.locate(segments.points), self.job.coefficients)]
            tape = Tape(e)
            located = self.table.locate(tape, rows[0])
            opacity = self.table.opacity(tape, located)
            tau = optical_depth(tape, opacity, Node(segments.thickness)).value
            tau = e.where(segments.real, tau, e.constant(0))
            with b.if_then(e.any(e.differs(tau))):
                _, weight = self.weights(tau, depth.value, segments.real)
                depth.value = b.fadd(depth.value, self.widen(e.total(tau)))
                seen = e.differs(weight)
                with b.if_then(e.any(seen)):
                    self._add_light(ray, tape, located, rows, weight, seen, light)
        for k in range(3):
            place = e.advance(self.job.light, b.add(b.mul(ray.number, I64(3)), I64(k)), DOUBLE)
            b.store(d.total(light[k].value), place)
        b.store(depth.value, e.advance(self.job.depth, ray.number, DOUBLE))

    def _add_light(
        self,
        ray: _Ray,
        tape: Tape,
        located: Located,
        rows: list[Node],
        weight: Value,
        seen: Value,
        light: list[Variable],
    ) -> None:
        e, d = self.lanes, self.wide
        color = self.table.color(tape, located, self.table.color_ends(located))
        if self.recipe.lit:
            uniform = {name: [Node(pack) for pack in packs] for name, packs in ray.uniform.items()}
            color = shade(tape, color, self.world_gradient(tape, rows[1:4]), self.lights(uniform))
        for own, total in zip(color, light, strict=True):
            emitted = e.where(seen, e.multiply(weight, own.value), e.constant(0))
            first, second = (e.shuffle(emitted, emitted, range(k, k + self.half.count)) for k in (0, self.half.count))
            total.value = d.add(total.value, self.widen(self.half.add(first, second)))


class _Adjoint(_Program):
    def prepare(self) -> None:
        e, recipe = self.lanes, self.recipe
        number = STORAGE[recipe.arithmetic]
        self.spreading = self.taps
        if number != self.storage:  # derivatives by the coefficients are kept in the arithmetic's type
            self.spreading = _Halves(e, self.half, Taps(self.half, recipe.stencil, number, self.grid))
        if recipe.derivatives is not None:
            self.raised = recipe.derivatives[1]
            self.differentiating = _Halves(
                e, self.half, Taps(self.half, recipe.derivatives[0], self.storage, self.grid)
            )
        self.columns = gradient_columns(recipe.lights if recipe.lit else None)

    def wants(self, name: str) -> bool:
        return name in self.recipe.gradients

    def march(self, ray: _Ray) -> None:
        e, b = self.lanes, self.builder
        depth = e.variable(DOUBLE(0.0))
        cotangent = [self._double(self.job.light_cotangent, self._place(ray, 3, k)) for k in range(3)]
        rest = e.variable(self._behind_everything(ray, cotangent))
        sums = {
            name: [e.variable(e.constant(0)) for _ in range(columns.stop - columns.start)]
            for name, columns in self.columns.items()
        }
        with self.every_pack(ray, depth) as first:
            segments = self.segments(ray, first)
            located_taps = self.taps.locate(segments.points)
            rows = [Node(row) for row in self.taps.contract(located_taps, self.job.coefficients)]
            tape = Tape(e)
            located = self.table.locate(tape, rows[0])
            with self._if_it_counts(located, segments):
                sample = self._sample(tape, ray, located, rows, segments)
                self._compose_back(sample, [e.scalar(g) for g in cotangent], ray, depth, rest)
                tape.backward()
                self._add_to_ray(sample, sums)
                if self.wants("table"):
                    self._add_to_table(sample)
                adjoints = [self._of_real(row.adjoint, segments) for row in rows]
                if self.wants("coefficients"):
                    self._spread(adjoints, segments, located_taps)
                if self.wants("rays"):
                    self._add_to_rays(sample, adjoints, sums, ray)
        for name, columns in self.columns.items():
            for index, total in zip(range(columns.start, columns.stop), sums[name], strict=True):
                place = self._place(ray, self._width(), index)
                b.store(self.widen(e.total(total.value)), e.advance(self.job.ray_gradient, place, DOUBLE))

    def _place(self, ray: _Ray, width: int, column: int) -> Value:
        return self.builder.add(self.builder.mul(ray.number, I64(width)), I64(column))

    def _width(self) -> int:
        return max(columns.stop for columns in self.columns.values())

    def _behind_everything(self, ray: _Ray, cotangent: list[Value]) -> Value:
        """g · light, of all the ray."""
        b, total = self.builder, DOUBLE(0.0)
        for k in range(3):
            light = self._double(self.job.light, self._place(ray, 3, k))
            total = b.fadd(total, b.fmul(cotangent[k], light))
        return total

    @contextmanager
    def _if_it_counts(self, located: Located, segments: _Segments) -> Iterator[None]:
        """The with-block, unless the pack has neither opacity nor derivatives."""
        if self.wants("table"):  # a control point's opacity counts where it is 0, too
            yield
        else:
            colored = self.builder.and_(located.colored(self.lanes), segments.real)
            with self.builder.if_then(self.lanes.any(colored)):
                yield

    def _of_real(self, adjoint: Value | None, segments: _Segments) -> Value:
        """0 in lanes without a segment."""
        e = self.lanes
        return e.constant(0) if adjoint is None else e.where(segments.real, adjoint, e.constant(0))

    # --- forwards again ---

    def _sample(self, tape: Tape, ray: _Ray, located: Located, rows: list[Node], segments: _Segments) -> _Sample:
        thickness = Node(segments.thickness)
        tau = optical_depth(tape, self.table.opacity(tape, located), thickness)
        ends = self.table.color_ends(located)
        color = self.table.color(tape, located, ends)
        uniform = {name: [Node(pack) for pack in packs] for name, packs in ray.uniform.items()}
        if self.recipe.lit:
            color = shade(tape, color, self.world_gradient(tape, rows[1:4]), self.lights(uniform))
        return _Sample(segments, located, thickness, tau, ends, color, uniform)

    def _compose_back(
        self, sample: _Sample, cotangent: list[Value], ray: _Ray, depth: Variable, rest: Variable
    ) -> None:
        """Adjoints of τ and of the colour, and depth and rest of the light behind the pack."""
        e, b, segments = self.lanes, self.builder, sample.segments
        tau = e.where(segments.real, sample.tau.value, e.constant(0))
        transmittance, weight = self.weights(tau, depth.value, segments.real)
        g = [e.everywhere(k) for k in cotangent]
        shown = None
        for own, color in zip(g, sample.color, strict=True):
            shown = e.multiply_add(own, color.value, shown)
        passed = e.running_sums(e.where(segments.real, e.multiply(weight, shown), e.constant(0)))
        behind = e.subtract(e.everywhere(e.scalar(rest.value)), passed)
        after = e.subtract(transmittance, weight)
        to_depth = e.everywhere(e.scalar(self._double(self.job.depth_cotangent, ray.number)))
        adjoint = e.add(e.subtract(e.multiply(shown, after), behind), to_depth)
        sample.tau.adjoint = e.where(segments.real, adjoint, e.constant(0))
        for own, color in zip(g, sample.color, strict=True):
            color.adjoint = e.multiply(weight, own)
        rest.value = b.fsub(rest.value, self.widen(e.lane(passed, e.count - 1)))
        depth.value = b.fadd(depth.value, self.widen(e.total(tau)))

    # --- backwards ---

    def _add_to_ray(self, sample: _Sample, sums: dict[str, list[Variable]]) -> None:
        """Derivatives by what is the same all along a ray."""
        if self.wants("shading"):
            for name, nodes in sample.uniform.items():
                for node, total in zip(nodes, sums[name], strict=True):
                    if node.adjoint is not None:
                        self._add(total, self._of_real(node.adjoint, sample.segments))

    def _add(self, total: Variable, more: Value) -> None:
        total.value = self.lanes.add(total.value, more)

    def _add_to_table(self, sample: _Sample) -> None:
        """Derivatives by the ends of the intervals: 12 numbers of every lane's row."""
        packs = [self._of_real(node.adjoint, sample.segments) for node in (*sample.located.ends, *sample.ends)]
        for first in (0, 4, 8):
            own = packs[first : first + 4]
            self.table.add_to_rows(self.job.table_gradient, sample.located.interval, own, TABLE_ROW, first)

    def _spread(self, adjoints: list[Value], segments: _Segments, located: _LocatedTaps) -> None:
        if self.spreading is not self.taps:
            located = self.spreading.locate(segments.points)
        self.spreading.spread(located, self.job.coefficient_gradient, adjoints)

    def _add_to_rays(self, sample: _Sample, adjoints: list[Value], sums: dict[str, list[Variable]], ray: _Ray) -> None:
        """Derivatives by entry, direction and length: points are entry + t direction, and the last t ends there."""
        e, segments = self.lanes, sample.segments
        located = self.differentiating.locate(segments.points)
        derivatives = self.differentiating.contract(located, self.job.coefficients)
        to_length = None
        for axis in range(3):
            total = None
            for row, adjoint in zip(self.raised[axis], adjoints, strict=True):
                total = e.multiply_add(adjoint, derivatives[row], total)
            total = self._of_real(total, segments)
            self._add(sums["entry"][axis], total)
            self._add(sums["direction"][axis], e.multiply(total, segments.middle))
            along = e.everywhere(e.scalar(ray.direction[axis]))
            to_length = e.multiply_add(total, along, to_length)
        per_unit = e.everywhere(e.scalar(self.job.per_unit))
        thickness = self._of_real(sample.thickness.adjoint, segments)
        to_length = e.multiply_add(thickness, per_unit, e.multiply(to_length, e.constant(0.5)))
        self._add(sums["length"][0], e.where(segments.last, to_length, e.constant(0)))
