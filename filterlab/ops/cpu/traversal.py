"""The way through the rays: which segments are marched next, and which are left out as nothing is to be seen there.

A *run* is a number of consecutive segments of one ray: they enter and leave the volume together, read neighbouring
coefficients, and none waits for another. Rays are taken in blocks, and of all rays of a block one run in turn:
neighbours find in the cache what the others have read.

Most of a march is chains of operations that wait for one another, so that two runs are marched at a time: one waits
for the next one, of whatever ray, and both make a pack (`ops.cpu.lanes`). Runs are composed one after the other, and it
changes no bit of a ray which runs its own were marched with.

Empty space is left out before anything is computed (`render.bricks` explains the bricks): if the nearest brick that is
not empty is d bricks away, nothing comes within d − 1 bricks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.lanes import DOUBLE, I8, I32, I64, Value, Variable
from filterlab.ops.cpu.taps import Location

RAYS_OF_A_BLOCK = 16


@dataclass(frozen=True)
class State:
    """How far a ray has come, in memory.

    Attributes:
        next: number of its next segment.
        kept: doubles by name.
    """

    next: Variable
    kept: dict[str, Variable]


@dataclass(frozen=True)
class Ray:
    """What is the same for all runs of a ray.

    Attributes:
        number: of the ray.
        entry, direction: three doubles each.
        length, offset: doubles.
        count: segments.
        state: how far it has come.
    """

    number: Value
    entry: list[Value]
    direction: list[Value]
    length: Value
    offset: Value
    count: Value
    state: State


@dataclass(frozen=True)
class Run:
    """Segments of a ray from number `first` on."""

    ray: Ray
    first: Value


@dataclass(frozen=True)
class Segments:
    """Packs of segments.

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


class Traversal:
    """Writes the loops over rays and their runs. Make it before any loop: it reserves memory.

    Args:
        location: where points of a run lie among the coefficients.
        job: fields of `ops.cpu.march.FIELDS`.
        kept: names of the doubles that are kept of every ray from run to run; "depth" is one of them.
        skipping: whether empty bricks are left out.
    """

    def __init__(self, location: Location, job: SimpleNamespace, kept: Sequence[str], skipping: bool) -> None:
        self.location, self.job, self.skipping = location, job, skipping
        self.lanes = lanes = location.lanes
        self.builder = lanes.builder
        self._next = lanes.reserve(I64, RAYS_OF_A_BLOCK)
        self._kept = {name: lanes.reserve(DOUBLE, RAYS_OF_A_BLOCK) for name in kept}

    # --- blocks and turns ---

    @contextmanager
    def every_block(self, chunk: Value) -> Iterator[None]:
        """for the blocks chunk, chunk + stride, …: the with-block; what follows is about the rays of that block."""
        e, b, j = self.lanes, self.builder, self.job
        size = I64(RAYS_OF_A_BLOCK)
        blocks = b.udiv(b.add(b.sub(j.last, j.first), I64(RAYS_OF_A_BLOCK - 1)), size)
        turns = b.udiv(b.add(b.sub(blocks, chunk), b.sub(j.stride, I64(1))), j.stride)
        with e.repeat(I64(0), turns) as turn:
            first = b.add(j.first, b.mul(b.add(chunk, b.mul(turn, j.stride)), size))
            self._first, self._end = first, e.smaller(b.add(first, size), j.last)
            yield

    @contextmanager
    def every_ray(self) -> Iterator[tuple[Value, State]]:
        """for every ray of the block: the with-block, given its number and state."""
        with self.lanes.repeat(self._first, self._end) as number:
            yield number, self._state(number)

    def every_run(self, march: Callable[[Run], None]) -> None:
        """while a ray of the block has segments left: what `march` writes, given a run."""
        with self._every_turn(self._end) as (turn, going):
            found = self._next_run(self.ray(turn), going)
            with self._if_number(found):
                march(Run(self.ray(turn), found.value))

    def every_pair(self, march: Callable[[Run, Run, Value], None]) -> None:
        """The same with two runs at a time, and whether they are of the same ray.

        After the last ray it is nobody's turn. If there was no run in all of a turn, the one that still waits is
        marched with one beyond the end of its own ray.
        """
        e, b = self.lanes, self.builder
        waiting, since = e.variable(I64(-1)), e.variable(I64(0))
        with self._every_turn(b.add(self._end, I64(1))) as (turn, going):
            number, found = e.variable(turn), e.variable(I64(-1))
            with b.if_else(b.icmp_signed("<", turn, self._end)) as (somebody, nobody):
                with somebody:
                    found.value = self._next_run(self.ray(turn), going).value
                with nobody, b.if_then(b.icmp_signed("==", going.value, I64(0))), self._if_number(waiting):
                    number.value = waiting.value
                    found.value = self.ray(waiting.value).count
            with self._if_number(found), b.if_else(b.icmp_signed("<", waiting.value, I64(0))) as (alone, together):
                with alone:
                    waiting.value, since.value = number.value, found.value
                with together:
                    other = Run(self.ray(waiting.value), since.value)
                    run = Run(self.ray(number.value), found.value)
                    march(other, run, b.icmp_signed("==", waiting.value, number.value))
                    waiting.value = I64(-1)

    @contextmanager
    def _every_turn(self, stop: Value) -> Iterator[tuple[Value, Variable]]:
        """again and again for every number from the first ray's to before `stop`, until nobody sets `going` to 1."""
        e, b = self.lanes, self.builder
        with self.every_ray() as (_, state):
            state.next.value = I64(0)
        going = e.variable(I64(1))
        with e.repeat_while(lambda: b.icmp_signed("!=", going.value, I64(0))):
            going.value = I64(0)
            with e.repeat(self._first, stop) as turn:
                yield turn, going

    @contextmanager
    def _if_number(self, found: Variable) -> Iterator[None]:
        """if found ≥ 0: the with-block."""
        with self.builder.if_then(self.builder.icmp_signed(">=", found.value, I64(0))):
            yield

    def _next_run(self, ray: Ray, going: Variable) -> Variable:
        """The first segment of a ray's next run, or −1: it has ended, or leapt. `going`: it has not ended."""
        b, state, found = self.builder, ray.state, self.lanes.variable(I64(-1))
        transparent = b.fcmp_unordered("<=", state.kept["depth"].value, self.job.opaque)  # NaN goes on
        with b.if_then(b.and_(b.icmp_signed("<", state.next.value, ray.count), transparent)):
            going.value = I64(1)
            if self.skipping:
                with self._unless_empty(ray):
                    found.value = state.next.value
            else:
                found.value = state.next.value
            state.next.value = b.add(state.next.value, I64(self.lanes.count))
        return found

    # --- rays ---

    def _state(self, number: Value) -> State:
        e, place = self.lanes, self.builder.sub(number, self._first)
        kept = {name: e.at(e.advance(array, place, DOUBLE), DOUBLE) for name, array in self._kept.items()}
        return State(e.at(e.advance(self._next, place, I64), I64), kept)

    def ray(self, number: Value) -> Ray:
        b, j = self.builder, self.job
        entry, direction = self.triple(j.entry, number), self.triple(j.direction, number)
        length, offset = self.double(j.length, number), self.double(j.offset, number)
        count = b.load(self.lanes.advance(j.count, number, I64), typ=I64)
        return Ray(number, entry, direction, length, offset, count, self._state(number))

    def triple(self, array: Value, number: Value) -> list[Value]:
        """Three doubles of a ray."""
        b = self.builder
        return [self.double(array, b.add(b.mul(number, I64(3)), I64(k))) for k in range(3)]

    def double(self, array: Value, index: Value) -> Value:
        return self.builder.load(self.lanes.advance(array, index, DOUBLE), typ=DOUBLE)

    # --- segments ---

    def segments(self, ray: Ray, first: Value) -> Segments:
        """Those from number `first` on, as `render.rays.segments` cuts them.

        Only the place of the run is computed in doubles. Lane i is i steps further; the first and the last segment of
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
        return Segments(
            real=b.icmp_signed("<", numbers, e.everywhere(left)),
            last=b.icmp_signed("==", numbers, e.everywhere(b.sub(left, I32(1)))),
            middle=e.add(moved, e.everywhere(e.scalar(middle))),
            points=points,
            thickness=e.multiply(
                e.maximum(e.subtract(e.subtract(step, before), after), nothing),
                e.everywhere(e.scalar(self.job.per_unit)),
            ),
        )

    def _regular_middle(self, ray: Ray, number: Value) -> Value:
        """Distance of a segment's middle from the entry, were it a whole step long."""
        b = self.builder
        steps = b.fadd(b.fsub(b.sitofp(number, DOUBLE), DOUBLE(0.5)), ray.offset)
        return b.fmul(steps, self.job.step)

    # --- empty space ---

    @contextmanager
    def _unless_empty(self, ray: Ray) -> Iterator[None]:
        """The with-block, unless all of the next run lies in empty bricks; the ray leaps over those that do as well.

        From a point in a brick at distance d, steps of together less than d − 1 bricks along every axis stay within
        bricks at a distance of at least 1. From the middle of a run half as many steps as it has segments lead to its
        first one, and one less to its last. Where that is too far every lane looks for itself.
        """
        b, e, following = self.builder, self.lanes, ray.state.next
        half = I64(e.count // 2)
        distance = self._distance(ray, b.add(following.value, half))
        near, far, look, compute, done = (
            b.append_basic_block(name) for name in ("near", "far", "look", "compute", "done")
        )
        b.cbranch(b.icmp_unsigned("==", distance, I64(0)), compute, near)

        b.position_at_end(near)
        cells = b.shl(b.sub(distance, I64(1)), self.job.edge)
        reach = b.fsub(b.sitofp(cells, DOUBLE), self.job.slack)
        steps = self._smaller(b.fmul(reach, self._segments_per_voxel(ray.direction)), DOUBLE(2.0**40))
        runs = b.ashr(b.add(b.fptosi(steps, I64), half), I64(e.count.bit_length() - 1))
        leaps = b.and_(b.icmp_signed(">", runs, I64(0)), b.fcmp_ordered(">=", reach, DOUBLE(0.0)))
        b.cbranch(leaps, far, look)

        b.position_at_end(far)
        following.value = b.add(following.value, b.mul(b.sub(runs, I64(1)), I64(e.count)))
        b.branch(done)

        b.position_at_end(look)
        b.cbranch(self._all_empty(self.segments(ray, following.value).points), done, compute)

        b.position_at_end(compute)
        yield
        b.branch(done)
        b.position_at_end(done)

    def _segments_per_voxel(self, direction: Sequence[Value]) -> Value:
        """1 / (the longest way along an axis that a segment goes), a double; a ray may hardly move."""
        b = self.builder
        longest = None
        for step in direction:
            size = b.call(self._scalar_function("llvm.fabs.f64"), [step])
            longest = size if longest is None else b.select(b.fcmp_ordered(">", size, longest), size, longest)
        return b.fdiv(DOUBLE(1.0), b.fmul(longest, self.job.step))

    def _scalar_function(self, name: str) -> Value:
        module = self.builder.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(DOUBLE, [DOUBLE]), name)

    def _distance(self, ray: Ray, segment: Value) -> Value:
        """That of the brick at the middle of a segment, an integer; of one beyond the last, at the end of the ray."""
        b, j = self.builder, self.job
        one = DOUBLE(1.0)
        index = b.sitofp(segment, DOUBLE)
        end = self._smaller(b.fmul(b.fadd(index, ray.offset), j.step), ray.length)
        start = self._smaller(b.fmul(b.fadd(b.fsub(index, one), ray.offset), j.step), ray.length)
        start = b.select(b.fcmp_ordered(">", start, DOUBLE(0.0)), start, DOUBLE(0.0))
        middle = b.fmul(b.fadd(start, end), DOUBLE(0.5))
        grid, bricks = self.location.grid, []
        for axis in range(3):
            at = b.fadd(b.fmul(middle, ray.direction[axis]), ray.entry[axis])
            shifted = b.fsub(at, DOUBLE(self.location.supports[axis] / 2 - 1))
            cell = b.call(self._scalar_function("llvm.floor.f64"), [shifted])
            low, high = grid.low[axis], grid.high[axis]
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
        x, y, z = (b.ashr(cell, edge) for cell, _ in self.location.cells(points))
        index = b.add(b.mul(b.add(b.mul(z, by), y), bx), x)
        empty = None
        for lane in range(e.count):
            place = e.advance(j.bricks, b.zext(e.lane(index, lane), I64), I8)
            away = b.icmp_unsigned("!=", b.load(place, typ=I8), I8(0))
            empty = away if empty is None else b.and_(empty, away)
        return empty
