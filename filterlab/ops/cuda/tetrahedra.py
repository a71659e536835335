"""The sums of splines on tetrahedra in Triton: `ops.tetrahedra.Sum`, line by line; what `taps` is for sums over taps.

Each thread reads the blocks of samples that its own tetrahedron needs, one sample at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from filterlab.ops.cuda.source import Source, number
from filterlab.ops.cuda.taps import AXES, SIZES, first_taps
from filterlab.ops.tetrahedra import Block, Steps, Sum, TetrahedralStencil, Turned


class Text:
    """The arithmetic of names: every operation is a line that names its result."""

    def __init__(self, source: Source) -> None:
        self._source, self._count = source, 0

    def named(self, expression: str) -> str:
        self._count += 1
        name = f"t{self._count}"
        self._source.line(f"{name} = {expression}")
        return name

    def constant(self, value: float) -> str:
        return number(value)

    def add(self, a: str, b: str) -> str:
        return self.named(f"{a} + {b}")

    def subtract(self, a: str, b: str) -> str:
        return self.named(f"{a} - {b}")

    def multiply(self, a: str, b: str) -> str:
        return self.named(f"{a} * {b}")

    def multiply_add(self, a: str, b: str, c: str | None) -> str:
        return self.named(f"{a} * {b}" if c is None else f"{a} * {b} + {c}")

    def divide(self, a: str, b: str) -> str:
        return self.named(f"({a}) / {b}")

    def negate(self, a: str) -> str:
        return self.named(f"-{a}")

    def absolute(self, a: str) -> str:
        return self.named(f"tl.abs({a})")

    def floor(self, a: str) -> str:
        return self.named(f"tl.floor({a})")

    def less(self, a: str, b: str) -> str:
        return self.named(f"{a} < {b}")

    def both(self, a: str, b: str) -> str:
        return self.named(f"{a} & {b}")

    def where(self, mask: str, a: str, b: str) -> str:
        return self.named(f"tl.where({mask}, {a}, {b})")


class TetrahedralTaps:
    """Writes the sums of a stencil at the end of a source; see `Taps`."""

    def __init__(self, source: Source, stencil: TetrahedralStencil) -> None:
        self.source, self.stencil = source, stencil
        self.text = Text(source)
        self.sum = Sum(self.text, stencil)

    def locate(self, volume: str) -> None:
        """As `Taps.locate`, but that `first` is the address of the coefficient of the index of a point's cell."""
        line, (before, behind) = self.source.line, self.sum.spline.reach
        first_taps(self.source, self.stencil.supports)
        for axis, size, cell in zip(AXES, SIZES, self.sum.cells(AXES), strict=True):
            line(f"own = tl.where({cell} > start + {before}, {cell}, start + {before})  # NaN too")
            line(f"own = tl.where(own < start + {size} - {behind + 1}, own, start + {size} - {behind + 1})")
            line(f"u{axis} = {self.sum.local(axis, 'own')} + {axis} * 0.0")
            line(f"cell_{axis} = own.to(tl.int64) - start")
        line(f"first = {volume} + ((cell_z * height + cell_y) * width + cell_x)")
        line("nothing = ux * 0.0 + uy * 0.0 + uz * 0.0")

    def weigh(self) -> None:
        """The points in the cone, and where their samples lie."""
        self.turned = self.sum.turn([f"u{axis}" for axis in AXES])
        along = self.sum.along_cone(self.turned, self._signed_strides(self.turned))
        self.corners = self._corners([_diagonal(-self.sum.spline.before)], along)

    def at_sample(self, turned: Turned | None) -> list[str]:
        """Where blocks of points in the cubes about samples begin, from the first sample that a cube needs.

        Args:
            turned: the points from the centres of their cells; None of cubes, which need the same samples everywhere.
        """
        spline = self.sum.spline
        first = [_diagonal(spline.around - spline.before)]
        if turned is None:
            return first * len(spline.centres)
        strides = self._signed_strides(turned)  # the sample is ahead of the cell's centre
        first += [self.text.where(n, "0", f"-({s})") for n, s in zip(turned.negative, strides, strict=True)]
        return self._corners(first, self.sum.along_cone(turned, strides))

    def _signed_strides(self, turned: Turned) -> list[str]:
        """Along x, y, z away from the centre."""
        strides = zip(turned.negative, ("1", "width", "width * height"), strict=True)
        return [self.text.where(negative, f"-({s})", s) for negative, s in strides]

    def _corners(self, first: Sequence[str], along: Sequence[str]) -> list[str]:
        """Where blocks of samples begin: Σ first, and the steps to their centres."""
        return [
            self.text.named(
                " + ".join([*first, *(f"{step} * {axis}" for step, axis in zip(centre, along, strict=True) if step)])
            )
            for centre in self.sum.spline.centres
        ]

    def contract(self, tap: str, rows: str = "row") -> None:
        """See `Taps.contract`."""
        for r, row in enumerate(self.sum.contract(self.blocks(tap, self.corners), self.turned)):
            self.source.line(f"{rows}_{r} = {row}")

    def blocks(self, tap: str, corners: Sequence[str]) -> list[Block]:
        """All that a tetrahedron needs, as it lies in memory."""
        return [
            {at: self.text.named(f"tl.load({place}).to(arithmetic)") for at, place in self._places(tap, corner)}
            for corner in corners
        ]

    def spread(self, tap: str, mask: str, rows: str = "row") -> None:
        """See `Taps.spread`."""
        cotangents = [f"{rows}_{r}" for r in range(len(self.stencil.rows))]
        for corner, block in zip(self.corners, self.sum.spread(cotangents, self.turned), strict=True):
            for at, place in self._places(tap, corner):
                if block[at] is not None:
                    self.source.line(f'tl.atomic_add({place}, {block[at]}, {mask}, sem="relaxed")')

    def _places(self, tap: str, corner: str) -> Iterator[tuple[Steps, str]]:
        """The addresses of a block's samples."""
        for i, j, k in self.sum.places:
            yield (i, j, k), f"{tap} + {corner} + ({i} + {j} * width + {k} * (width * height))"


def _diagonal(steps: int) -> str:
    """So many steps along all three axes."""
    return f"{steps} * (1 + width + width * height)"
