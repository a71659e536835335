"""The program that casts rays at a level: rays in, hits out; or the pieces that may hold one.

Rays that lie in rows, as those of an image do, go in packs of two rows where few lanes are wasted so: they stay
together for longer, and take a tenth less time than P of one row (Marschner-Lobb 128³, 512² rays).

For a pack of P rays, until all have ended:

    walk        every ray to its next cell that may hold the level (`ops.cpu.cells`); of splines on tetrahedra every one
                that does, of which a quadratic near the spline leaves over one in three
    restrict    the sum over taps on the ray's part in that cell, P at a time (`ops.cpu.restriction`)
    signs       one change of sign among the coefficients of f − level: there is the hit, the ray waits for the end
                several: the part that holds the first root is looked for at once (`ops.cpu.polynomials`)

and then one root search for all of them. Pieces that hold no level never come to it.

Where every crossing is asked for, a ray goes on with a part in which it has a root, and only when one comes to its next
root are those of the whole pack searched and written: a pack of rays costs about as many searches as one of them has
roots. A ray that has all that were asked for, when those it waits with are counted, waits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.cells import Found, Gathered, Walk
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import ARITHMETIC, DOUBLE, I8, I32, I64, STORAGE, Lanes, Value
from filterlab.ops.cpu.piece_roots import EveryRoot, Signs, first_root
from filterlab.ops.cpu.polynomials import FirstRoot, NextRoots, Part, Rows
from filterlab.ops.cpu.restriction import Restriction, Section
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.tetrahedral_restriction import Level, OffTrend, TetrahedralRestriction
from filterlab.ops.raycast import JUMP, PLACES_APART, REPEATED
from filterlab.ops.tetrahedra import LoweredStencil, TetrahedralStencil

PACKS_OF_A_CHUNK = 16

# Arrays are contiguous. R rays; "number" is the type of the arithmetic, d a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "coefficients": ctypes.c_void_p,  # the first tap of the first cell; rows together, planes as many rows as `height`
    "width": ctypes.c_int64,
    "height": ctypes.c_int64,
    **{f"cells_{a}": ctypes.c_int64 for a in AXES},  # their number
    "origins": ctypes.c_void_p,  # (R, 3) numbers, in the world
    "directions": ctypes.c_void_p,  # (R, 3) numbers
    "rows": ctypes.c_int64,  # rays are `rows` times `columns`, row after row
    "columns": ctypes.c_int64,
    "packs": ctypes.c_int64,
    "wide": ctypes.c_int64,  # log₂ of how many lanes of a pack lie in one row, before those of the next
    "origin": ctypes.c_void_p,  # (3) d: coordinates of cells are matrix · (world − origin) − offset
    "matrix": ctypes.c_void_p,  # (3, 3) d
    "offset": ctypes.c_void_p,  # (3) d
    "lower": ctypes.c_void_p,  # (3) d, corners of the domain in coordinates of cells
    "upper": ctypes.c_void_p,  # (3) d
    "scale": ctypes.c_double,  # f − level is scale · sum + shift
    "shift": ctypes.c_double,
    "margin": ctypes.c_double,  # that rounding may add to f − level
    "marks": ctypes.c_void_p,  # (bz, by, bx) 16 bits, see `ops.raycast.Raycast`
    "off_trend": ctypes.c_void_p,  # (pz, py, px) 32 bits, of parts of half a brick's edge, of splines on tetrahedra
    **{f"bricks_{a}": ctypes.c_int64 for a in AXES},  # their number
    "edge": ctypes.c_int64,  # of a brick, log₂ of its cells
    "t": ctypes.c_void_p,  # (R) d, written: where the first hit is; (R, k) where sheets are
    "sheets": ctypes.c_int64,  # k, places for sheets of a ray, which are written in a ring
    "most": ctypes.c_int64,  # sheets behind which no more are looked for
    "extent": ctypes.c_double,  # the diagonal of the domain, in the world
    "capacity": ctypes.c_int64,  # K, candidates of a ray that there is room for
    "count": ctypes.c_void_p,  # (R) int64, written: candidates or sheets of a ray, also those that there is no room for
    "places": ctypes.c_void_p,  # (R, K, 3) d, written: start, near, far of candidates
    "pieces": ctypes.c_void_p,  # (R, K, n + 1) numbers, written: Bernstein coefficients of f − level
    "flags": ctypes.c_void_p,  # (R, K) bytes, written: 1 the field jumps over the level, 2 the piece is a repetition
    "chunks": ctypes.c_int64,  # `next` stops here
}


class RaycastJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class RaycastVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        asked: "first", "candidates" or "sheets".
        stencil: the sum over taps, one row.
        degree: n, along a ray.
        continuous: whether polynomials of neighbouring cells agree where they meet.
        arithmetic: "float32" or "float64": of rays and polynomials.
        storage: dtype of the coefficients.
        room: whether there is a number behind the last coefficient, in the same storage.
        lanes: P.
    """

    asked: str
    stencil: LoweredStencil
    degree: int
    continuous: bool
    arithmetic: str
    storage: str
    room: bool
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _PROGRAMS[self.asked](self, function).write()


@dataclass(frozen=True)
class Piece:
    """Pieces of a pack of rays.

    Attributes:
        found: where they are.
        rows: coefficients of f − level.
        whole: a mask of those that are finite.
        joined: a mask of those that begin where the piece before ended.
        before: the value with which that one ended.
    """

    found: Found
    rows: Rows
    whole: Value
    joined: Value
    before: Value


class _Program:
    """What both have in common: packs of rays, cells, pieces."""

    def __init__(self, variant: RaycastVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.places = Lanes(self.builder, "float64", variant.lanes)
        self.number, self.storage = ARITHMETIC[variant.arithmetic], STORAGE[variant.storage]

    def write(self) -> None:
        e, b, v = self.lanes, self.builder, self.variant
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        no_ends = DOUBLE(0.0), DOUBLE(0.0), DOUBLE(0.0)
        grid = Grid(j.width, j.height, I64(0), no_ends, no_ends)
        self.level = Level(*(e.everywhere(e.scalar(x)) for x in (j.scale, j.shift, j.margin)))
        self.restriction = self._restriction_of(v.stencil, grid)
        self.walk = Walk(self.places, j)
        self._ended_at = self.places.variable(self.places.constant(-1))
        self._ended_with = e.variable(e.constant(0))
        self._gathered = Gathered(self.places)
        self.prepare()
        with frame.every_chunk(e, j) as chunk:
            first = b.mul(chunk, I64(PACKS_OF_A_CHUNK))
            with e.repeat(first, e.smaller(b.add(first, I64(PACKS_OF_A_CHUNK)), j.packs)) as pack:
                self._cast(self._rays_of(pack))
        b.ret_void()

    def _restriction_of(self, stencil: LoweredStencil, grid: Grid) -> Restriction | TetrahedralRestriction:
        e, v = self.lanes, self.variant
        if isinstance(stencil, TetrahedralStencil):
            return TetrahedralRestriction(
                e, stencil, self.storage, grid, v.room, self.level, OffTrend(self.places, self.job)
            )
        return Restriction(e, stencil, v.degree, self.storage, grid, v.room)

    def _rays_of(self, pack: Value) -> list[Value]:
        """The numbers of a pack's rays; beyond the last row or column that one's again, which ends as it does."""
        e, b, j = self.lanes, self.builder, self.job
        across = b.shl(I64(1), j.wide)
        packs_across = b.udiv(b.add(j.columns, b.sub(across, I64(1))), across)
        top = b.mul(b.udiv(pack, packs_across), b.lshr(I64(e.count), j.wide))
        left = b.mul(b.urem(pack, packs_across), across)
        found = []
        for lane in range(e.count):
            row = b.add(top, b.lshr(I64(lane), j.wide))
            column = b.add(left, b.and_(I64(lane), b.sub(across, I64(1))))
            row, column = (e.smaller(x, b.sub(n, I64(1))) for x, n in ((row, j.rows), (column, j.columns)))
            found.append(b.add(b.mul(row, j.columns), column))
        return found

    def prepare(self) -> None:
        """Make what is needed of variables."""

    def begin(self) -> None:
        """Before a pack's first cell."""

    def waiting(self) -> Value:
        """A mask of rays that need not go on."""
        return self.lanes.mask(False)

    def done(self) -> Value:
        """A mask of rays that want no more pieces, not even of the cell that they are in."""
        return self.waiting()

    def take(self, rays: Sequence[Value], piece: Piece) -> None:
        """Pieces that were found, of rays of those numbers."""
        raise NotImplementedError

    def finish(self, rays: Sequence[Value]) -> None:
        """A pack has ended."""

    # --- a pack of rays ---

    def _cast(self, rays: Sequence[Value]) -> None:
        self.begin()
        self._ended_at.value = self.places.constant(-1)
        origins, directions = (self._vectors(array, rays) for array in (self.job.origins, self.job.directions))
        self.walk.begin(origins, directions)
        self.along(rays, directions)
        self.finish(rays)

    def along(self, rays: Sequence[Value], directions: Sequence[Value]) -> None:
        """Take all pieces of a pack of rays, those of a ray in order, until it ends or waits."""
        e, b = self.lanes, self.builder
        with e.repeat_while(lambda: e.any(b.and_(self.walk.going.value, b.not_(self.waiting())))):
            found = self._next_cells()
            with (
                b.if_then(e.any(found.mask)),
                self.restriction.every(*self._place(found), found.mask, self.done) as section,
            ):
                self.take(rays, self._piece(found, section))

    def _next_cells(self) -> Found:
        """To the next cell of every ray that may hold the level; of splines on tetrahedra, that does near its way."""
        if not isinstance(self.restriction, TetrahedralRestriction):
            return self.walk.next_cells(self.waiting())
        e, b, gathered = self.lanes, self.builder, self._gathered
        gathered.clear()
        waiting = lambda: b.or_(self.waiting(), gathered.mask)  # noqa: E731
        with e.repeat_while(lambda: e.any(b.and_(self.walk.going.value, b.not_(waiting())))):
            found = self.walk.next_cells(waiting())
            with b.if_then(e.any(found.mask)):
                gathered.add(self.restriction.look(*self._place(found), found.mask), found)
        return gathered.found

    def _place(self, found: Found) -> tuple[list[Value], list[Value], list[Value], list[Value]]:
        """First taps, cells, and where rays enter and leave them."""
        start, end = (self._within(found.cell, s) for s in (found.near, found.far))
        return self._taps(found.cell), found.cell, start, end

    def _vectors(self, array: Value, rays: Sequence[Value]) -> list[Value]:
        """x, y, z of a pack of rays as doubles."""
        e, b = self.lanes, self.builder
        packs: list[Value] = [self.places.constant(0) for _ in AXES]
        for lane, ray in enumerate(rays):
            for axis in range(3):
                place = e.advance(array, b.add(b.mul(ray, I64(3)), I64(axis)), self.number)
                number = b.load(place, typ=self.number)
                number = number if self.number == DOUBLE else b.fpext(number, DOUBLE)
                packs[axis] = b.insert_element(packs[axis], number, I32(lane))
        return packs

    # --- pieces ---

    def _piece(self, found: Found, section: Section) -> Piece:
        e, b, p, v = self.lanes, self.builder, self.places, self.variant
        found = self._of_section(found, section)
        rows = [e.multiply_add(c, self.level.scale, self.level.shift) for c in section.rows]
        sum_ = rows[0]
        for r in rows[1:]:
            sum_ = e.add(sum_, r)
        whole = b.fcmp_ordered("<", e.absolute(sum_), e.constant(float("inf")))
        before = self._ended_with.value
        joined = b.and_(found.mask, b.fcmp_ordered("==", found.near, self._ended_at.value))
        joined = b.and_(joined, b.fcmp_ordered("<", e.absolute(before), e.constant(float("inf"))))
        if v.continuous:
            rows[0] = e.where(joined, before, rows[0])
        self._ended_at.value = p.where(found.mask, found.far, self._ended_at.value)
        self._ended_with.value = e.where(found.mask, rows[-1], before)
        return Piece(found, rows, whole, joined, before)

    def _of_section(self, found: Found, section: Section) -> Found:
        near, far = self._along(found, section.start, found.near), self._along(found, section.end, found.far)
        return Found(section.mask, found.cell, near, far)

    def _along(self, found: Found, part: Value | None, if_all: Value) -> Value:
        """Where so much of a ray's part in a cell is behind; its ends to the bit."""
        if part is None:
            return if_all
        p, b = self.places, self.builder
        part = part if self.number == DOUBLE else b.fpext(part, p.pack)
        between = p.multiply_add(part, p.subtract(found.far, found.near), found.near)
        behind = p.where(p.less(part, p.constant(1)), between, found.far)
        return p.where(p.less(p.constant(0), part), behind, found.near)

    def _within(self, cell: Sequence[Value], s: Value) -> list[Value]:
        """Where rays are in their cells at s, in [0, 1]."""
        p, b, walk = self.places, self.builder, self.walk
        zero, one, out = p.constant(0), p.constant(1), []
        for own, entry, direction in zip(cell, walk.entry, walk.direction, strict=True):
            at = p.add(entry.value, p.multiply(s, direction.value))
            place = p.clamp(p.subtract(at, b.sitofp(own, p.pack)), zero, one)
            out.append(place if self.number == DOUBLE else b.fptrunc(place, self.lanes.pack))
        return out

    def _taps(self, cell: Sequence[Value]) -> list[Value]:
        """The address of every lane's first tap."""
        e, b, j = self.lanes, self.builder, self.job
        x, y, z = cell
        line = b.add(b.mul(z, e.everywhere(b.trunc(j.height, I32))), y)
        offset = b.add(b.mul(e.widen(line), e.everywhere(j.width)), e.widen(x))
        return [e.advance(j.coefficients, e.lane(offset, lane), self.storage.raw) for lane in range(e.count)]

    def holds(self, piece: Piece, jump: Value) -> Value:
        """A mask of pieces with coefficients on both sides of 0, or on it, or that the field jumps to."""
        e, b = self.lanes, self.builder
        low = high = piece.rows[0]
        for r in piece.rows[1:]:
            low, high = e.minimum(low, r), e.maximum(high, r)
        zero = e.constant(0)
        straddles = b.and_(b.fcmp_ordered("<=", low, zero), b.fcmp_ordered(">=", high, zero))
        return b.and_(b.and_(piece.found.mask, piece.whole), b.or_(straddles, jump))

    def jumps(self, piece: Piece) -> Value:
        """A mask of pieces that begin on the other side of the level than the one before ended on."""
        e, b = self.lanes, self.builder
        if self.variant.continuous:
            return self.lanes.mask(False)
        zero, begin, before = e.constant(0), piece.rows[0], piece.before
        up = b.and_(b.fcmp_ordered("<", before, zero), b.fcmp_ordered(">", begin, zero))
        down = b.and_(b.fcmp_ordered(">", before, zero), b.fcmp_ordered("<", begin, zero))
        return b.and_(piece.joined, b.or_(up, down))

    def store(self, pack: Value, array: Value, element: ir.Type, rays: Sequence[Value]) -> None:
        """A number of each ray."""
        for lane, ray in enumerate(rays):
            self.builder.store(self.lanes.lane(pack, lane), self.lanes.advance(array, ray, element))

    def length(self, s: Value) -> Value:
        """In units of a ray's direction."""
        return self.places.multiply(s, self.walk.scale.value)


class _Located(_Program):
    """Rays keep the part of a piece that has their root, and those of a pack are searched together.

    While a piece is taken `rays` and `piece` are its own.
    """

    rays: Sequence[Value]
    piece: Piece

    def prepare(self) -> None:
        e, p = self.lanes, self.places
        self.search = self.search_of(self.variant.degree)
        self.part = Part.of(e, self.variant.degree)
        self._near, self._far = p.variable(p.constant(0)), p.variable(p.constant(0))
        self.hit, self._at_start, self._at_end = (e.variable(self.lanes.mask(False)) for _ in range(3))

    def search_of(self, degree: int) -> FirstRoot:
        """Of roots in a piece."""
        return FirstRoot(self.lanes, degree)

    def begin(self) -> None:
        self.hit.value = self._at_start.value = self._at_end.value = self.lanes.mask(False)

    def waiting(self) -> Value:
        return self.hit.value

    def take(self, rays: Sequence[Value], piece: Piece) -> None:
        e, b = self.lanes, self.builder
        jump = self.jumps(piece)
        holds = b.and_(self.holds(piece, jump), b.not_(self.done()))
        with b.if_then(e.any(holds)):
            self.rays, self.piece = rays, piece
            self.roots(Signs.of(self.search, piece.rows, holds, jump))

    def roots(self, signs: Signs) -> None:
        """Keep parts of `piece` that have a root."""
        raise NotImplementedError

    def keep(self, mask: Value, rows: Rows, a: Value, h: Value) -> None:
        """Parts that have a root."""
        self.part.assign(self.lanes, mask, rows, a, h)

    def note(self, hit: Value, at_start: Value, at_end: Value) -> None:
        """That rays have hit, and where their pieces are."""
        b, p, found = self.builder, self.places, self.piece.found
        for kept, mask in ((self.hit, hit), (self._at_start, at_start), (self._at_end, at_end)):
            kept.value = b.or_(kept.value, mask)
        self._near.value = p.where(hit, found.near, self._near.value)
        self._far.value = p.where(hit, found.far, self._far.value)

    def located(self) -> Value:
        """t of the hits that were noted, doubles."""
        e, b, p = self.lanes, self.builder, self.places
        at_start, at_end = self._at_start.value, self._at_end.value
        t = e.variable(e.constant(0))
        inner = b.and_(self.hit.value, b.not_(b.or_(at_start, at_end)))
        with b.if_then(e.any(inner)):
            within = self.search.root([r.value for r in self.part.rows], inner)
            t.value = e.multiply_add(within, self.part.h.value, self.part.a.value)
        own = e.where(at_start, e.constant(0), e.where(at_end, e.constant(1), t.value))
        own = own if self.number == DOUBLE else b.fpext(own, p.pack)
        near, far = self._near.value, self._far.value
        s = p.multiply_add(p.subtract(far, near), own, near)
        return self.length(p.add(self.walk.start.value, p.minimum(p.maximum(s, near), far)))


class _First(_Located):
    """Every ray waits at its first hit."""

    def roots(self, signs: Signs) -> None:
        first_root(self.search, signs, self.keep, self.note)

    def finish(self, rays: Sequence[Value]) -> None:
        p = self.places
        found = p.where(self.hit.value, self.located(), p.constant(float("inf")))
        self.store(found, self.job.t, DOUBLE, rays)


class _Sheets(_Located):
    """Every ray keeps one root until it comes to the next; hits that rounding alone has apart are one."""

    search: NextRoots

    def prepare(self) -> None:
        super().prepare()
        e, p = self.lanes, self.places
        self._none = ir.Constant(ir.VectorType(I64, e.count), [0] * e.count)
        self._one = ir.Constant(self._none.type, [1] * e.count)
        self._count = e.variable(self._none)
        self._last, self._extent = p.variable(p.constant(0)), p.variable(p.constant(0))
        self._every = EveryRoot(self.search, self._room, self.keep, self.note)

    def search_of(self, degree: int) -> NextRoots:
        return NextRoots(self.lanes, degree)

    def begin(self) -> None:
        super().begin()
        self._count.value, self._last.value = self._none, self.places.constant(float("-inf"))

    def waiting(self) -> Value:
        return self._has(self.builder.select(self.hit.value, self._one, self._none))

    def done(self) -> Value:
        return self._has(self._none)

    def _has(self, more: Value) -> Value:
        """A mask of rays that have all sheets, with so many more."""
        count = self.builder.add(self._count.value, more)
        return self.builder.icmp_signed(">=", count, self.lanes.everywhere(self.job.most))

    def along(self, rays: Sequence[Value], directions: Sequence[Value]) -> None:
        e, b, p = self.lanes, self.builder, self.places
        x, y, z = (p.absolute(d) for d in directions)
        self._extent.value = p.divide(p.everywhere(self.job.extent), p.maximum(p.maximum(x, y), z))
        with e.repeat_while(lambda: e.any(b.and_(self.walk.going.value, b.not_(self.done())))):
            super().along(rays, directions)
            self._write(rays)

    def roots(self, signs: Signs) -> None:
        piece, b = self.piece, self.builder
        on_level = b.fcmp_ordered("==", piece.before, self.lanes.constant(0))
        self._every.write(piece.rows, signs, b.and_(piece.joined, on_level))

    def _room(self, left: Value) -> Value:
        """Rays keep one root; those under the mask that have all sheets want no more."""
        e, b, wanting = self.lanes, self.builder, self.lanes.variable(left)
        with b.if_then(e.any(b.and_(self.hit.value, left))):
            self._write(self.rays)
            wanting.value = b.and_(left, b.not_(self.done()))
        return wanting.value

    def _write(self, rays: Sequence[Value]) -> None:
        """Search the roots that are kept, and write them over those that are k before."""
        e, b, p, j = self.lanes, self.builder, self.places, self.job
        t, hit, count, last = self.located(), self.hit.value, self._count.value, self._last.value
        apart = p.multiply(p.add(t, self._extent.value), p.constant(PLACES_APART * 2.0**-52))
        new = b.and_(hit, b.fcmp_ordered(">", p.subtract(t, last), apart))
        for lane, ray in enumerate(rays):
            with b.if_then(e.lane(new, lane)):
                place = b.add(b.mul(ray, j.sheets), b.urem(e.lane(count, lane), j.sheets))
                b.store(e.lane(t, lane), e.advance(j.t, place, DOUBLE))
        self._count.value = b.add(count, b.zext(new, count.type))
        self._last.value = p.where(hit, t, last)
        self.hit.value = self._at_start.value = self._at_end.value = self.lanes.mask(False)

    def finish(self, rays: Sequence[Value]) -> None:
        self.store(self._count.value, self.job.count, I64, rays)


class _Candidates(_Program):
    """Every piece that may hold a hit is written down, as far as there is room; all are counted."""

    def prepare(self) -> None:
        self._none = ir.Constant(ir.VectorType(I64, self.lanes.count), [0] * self.lanes.count)
        self._count = self.lanes.variable(self._none)

    def begin(self) -> None:
        self._count.value = self._none

    def take(self, rays: Sequence[Value], piece: Piece) -> None:
        e, b, walk = self.lanes, self.builder, self.walk
        jump = self.jumps(piece)
        holds = self.holds(piece, jump)
        with b.if_then(e.any(holds)):
            flags = self._flags(piece, jump)
            places = [self.length(s) for s in (walk.start.value, piece.found.near, piece.found.far)]
            for lane in range(e.count):
                with b.if_then(e.lane(holds, lane)):
                    self._write(rays[lane], lane, places, piece.rows, flags)
            count = self._count.value
            self._count.value = b.add(count, b.zext(holds, count.type))

    def _flags(self, piece: Piece, jump: Value) -> Value:
        e, b = self.lanes, self.builder
        zero, kind = e.constant(0), ir.VectorType(I8, e.count)
        on_it = b.and_(b.fcmp_ordered("==", piece.before, zero), b.fcmp_ordered("==", piece.rows[0], zero))
        nothing, jumped, again = (ir.Constant(kind, [flag] * e.count) for flag in (0, JUMP, REPEATED))
        return b.or_(b.select(jump, jumped, nothing), b.select(b.and_(piece.joined, on_it), again, nothing))

    def _write(self, ray: Value, lane: int, places: Sequence[Value], rows: Rows, flags: Value) -> None:
        """One lane's piece, if there is room."""
        e, b, j = self.lanes, self.builder, self.job
        count = e.lane(self._count.value, lane)
        with b.if_then(b.icmp_signed("<", count, j.capacity)):
            index = b.add(b.mul(ray, j.capacity), count)
            arrays = ((j.places, places, DOUBLE), (j.pieces, rows, self.number), (j.flags, [flags], I8))
            for array, packs, kind in arrays:
                for i, pack in enumerate(packs):
                    place = e.advance(array, b.add(b.mul(index, I64(len(packs))), I64(i)), kind)
                    b.store(e.lane(pack, lane), place)

    def finish(self, rays: Sequence[Value]) -> None:
        self.store(self._count.value, self.job.count, I64, rays)


_PROGRAMS: dict[str, type[_Program]] = {"first": _First, "candidates": _Candidates, "sheets": _Sheets}
