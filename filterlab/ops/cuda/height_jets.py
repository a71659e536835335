"""Splines of heights as Triton programs: what `ops.cpu.height_jets` is for a processor, a point for every thread.

A launch has ⌈M / BLOCK⌉ programs for every grid. In the last block of a grid the points beyond M stand at 0, where they
read heights that exist; they write nothing.
"""

from __future__ import annotations

from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.tetrahedra import Text
from filterlab.ops.heights import Masks, Pattern, rows

NUMBERS = tuple(f"{name}_{axis}" for axis in "xy" for name in ("origin", "step", "low", "high"))
"""What `frame` holds, float64: of cells, and of their first data."""

SIZES = ("count", "width", "height", "column_zero", "line_zero", "values_entry", "points_entry")
PARAMETERS = ("values", "points", "rows", "column", "line", "frame", *SIZES, "BLOCK: tl.constexpr")
"""values (N, H, W), points (N, M, 2), rows (N, R, M) contiguous; column, line: tables of `ops.heights.Places`."""


def jet(pattern: Pattern, order: int, periodic: bool, zeros: bool) -> Source:
    """rows[n, :, m] = the jet at points[n, m]."""
    program = _Program("jet", pattern, order, periodic, zeros)
    program.write_jet()
    return program.source


def splat(pattern: Pattern, order: int, periodic: bool, zeros: bool) -> Source:
    """values += the transpose of `jet` applied to the rows. A point that is not finite adds nothing."""
    program = _Program("splat", pattern, order, periodic, zeros)
    program.write_splat()
    return program.source


class _Program:
    def __init__(self, name: str, pattern: Pattern, order: int, periodic: bool, zeros: bool) -> None:
        self.source = Source(name, PARAMETERS)
        self.text = Text(self.source)
        self.pattern, self.order, self.rows, self.periodic, self.zeros = pattern, order, rows(order), periodic, zeros
        self.masks = Masks(self.text, pattern)
        self._head()
        self._locate()
        self.addresses = self._addresses()

    def write_jet(self) -> None:
        e, line = self.text, self.source.line
        data = [e.subtract(self._read(address, mask), "base") for address, mask in self._after_base()]
        found = self.masks.derivatives(self.masks.coefficients(data), ["l0", "l1", "l2"], self.order)
        for n, (own, factor) in enumerate(zip(found, self._factors(), strict=True)):
            line(f"row_{n} = {own} * {factor}" + (" + base" if n == 0 else " + row_0 * 0.0"))  # in holes all are NaN
            line(f"tl.store(here + {n} * count, row_{n}, inside)")

    def write_splat(self) -> None:
        e, named = self.text, self.source.named
        self.source.line("known = inside & (l1 == l1) & (l2 == l2)")
        barycentric = [named(f"tl.where(known, {own}, 0.0)") for own in ("l0", "l1", "l2")]  # 0 · NaN is NaN
        given = [named(f"tl.load(here + {n} * count, known, 0.0)") for n in range(len(self.rows))]
        scaled = [e.multiply(own, factor) for own, factor in zip(given, self._factors(), strict=True)]
        spread = self.masks.spread(scaled, barycentric, self.order)
        for own, (address, mask) in zip(spread, self.addresses, strict=True):
            kept = f"known & {mask}" if mask else "known"
            self.source.line(f"tl.atomic_add({address}, {own}, {kept})")

    def _head(self) -> None:
        line = self.source.line
        for size in SIZES:
            line(f"{size} = {size}.to(tl.int64)")
        for n, name in enumerate(NUMBERS):
            line(f"{name} = tl.load(frame + {n})")
        line("arithmetic = points.dtype.element_ty")
        line("blocks = (count + BLOCK - 1) // BLOCK")
        line("entry = tl.program_id(0) // blocks")
        line("i = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)")
        line("inside = i < count")
        line("point = points + (entry * points_entry + 2 * i)")
        line(f"here = rows + (entry * {len(self.rows)} * count + i)")
        line("values = values + entry * values_entry")

    def _locate(self) -> None:
        """l0, l1, l2, the signs and V0: as in `ops.cpu.height_jets`."""
        line, m = self.source.line, self.pattern.steps
        for n, (axis, local, first) in enumerate((("x", "s", "column_0"), ("y", "t", "line_0"))):
            low, high = f"low_{axis}", f"high_{axis}"
            line(f"place_{axis} = (tl.load(point + {n}, inside, 0.0).to(tl.float64) - origin_{axis}) / step_{axis}")
            line(f"finite_{axis} = tl.abs(place_{axis}) < float('inf')")
            line(f"place_{axis} = tl.where(finite_{axis}, place_{axis}, 0.0)")
            line(f"cell_{axis} = tl.floor(place_{axis})")
            line(f"{local} = tl.where(finite_{axis}, place_{axis} - cell_{axis}, float('nan')).to(arithmetic)")
            line(f"f = cell_{axis} * {float(m)!r}")
            if self.periodic:
                line(f"f = f - tl.floor(f / {high}) * {high}")
                line(f"f = tl.where(f < {low}, f + {high}, f)")
                line(f"f = tl.where(f < {high}, f, f - {high})")
            line(f"f = tl.where(f > {low}, f, {low})")
            line(f"{first} = tl.where(f < {high}, f, {high}).to(tl.int64)")
        if self.pattern.mirrored:
            line("s = 1.0 - s")
        line("up = s + t <= 1.0")
        line("l1 = tl.where(up, s, 1.0 - s)")
        line("l2 = tl.where(up, t, 1.0 - t)")
        line("l0 = 1.0 - l1 - l2")
        line("sign_y = tl.where(up, 1, -1).to(tl.int64)")
        line("sign_x = -sign_y" if self.pattern.mirrored else "sign_x = sign_y")
        line(f"column_0 = column_0 + tl.where(sign_x < 0, {m}, 0)")
        line(f"line_0 = line_0 + tl.where(sign_y < 0, {m}, 0)")

    def _addresses(self) -> list[tuple[str, str | None]]:
        """For every datum where it is, and whether it is one."""
        named, places = self.source.named, {}
        for name, axis, sign, size, which in (
            ("column", 0, "sign_x", "width", "column_zero"),
            ("line", 1, "sign_y", "height", "line_zero"),
        ):
            for step in sorted({offset[axis] for offset in self.pattern.offsets}):
                index = named(f"{name}_0 + {sign} * {step}")
                within = named(f"({index} >= 0) & ({index} < {size})") if self.zeros else None
                places[name, step] = named(f"tl.load({name} + ({which} + {index}))"), within
        found = []
        for a, b in self.pattern.offsets:
            (column, in_column), (row, in_row) = places["column", a], places["line", b]
            found.append((named(f"values + ({column} + {row})"), f"{in_column} & {in_row}" if self.zeros else None))
        return found

    def _after_base(self) -> list[tuple[str, str | None]]:
        """All data, of which that at V0 is named `base` first."""
        address, mask = self.addresses[self.masks.first]
        self.source.line(f"base = {self._read(address, mask)}")
        return self.addresses

    def _read(self, address: str, mask: str | None) -> str:
        one = self.source.named(f"tl.load({address}).to(arithmetic)")
        return one if mask is None else self.source.named(f"tl.where({mask}, {one}, 0.0)")

    def _factors(self) -> list[str]:
        """By what derivatives along λ1 and λ2 are those along x and y, row by row."""
        for axis in "xy":
            self.source.line(f"along_{axis} = (sign_{axis}.to(tl.float64) / step_{axis}).to(arithmetic)")
        return [" * ".join(["1.0", *["along_x"] * i, *["along_y"] * j]) for i, j in self.rows]
