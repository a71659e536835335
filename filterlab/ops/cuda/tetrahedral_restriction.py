"""Splines on tetrahedra along rays in Triton: `ops.cpu.tetrahedral_restriction` says what is computed.

Each thread has a way of its own; a warp goes on to the next part as long as one of its rays has one. All of a part is
written out; the samples of a cube of `qss` and `cubic-c1` are read once. Programs for first hits, Triton 3.7.1, sm_90:

| | qss | cubic-c1 | quadratic-c1 |
|---|---|---|---|
| instructions of PTX, float32 | 1,412 | 1,633 | 1,694 |
| samples read | 27 of a cube | 27 of a cube | 32 of a part |
| registers, float32; float64 (none is spilled) | 164; 248 | 166; 253 | 149; 248 |
| to compile, once, one core | 6 s | 9 s | 12 s |

Triton takes nearly all of that time to look which loads of neighbouring threads could be one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from filterlab.ops.cubes import Cubes
from filterlab.ops.cuda.restriction import Section
from filterlab.ops.cuda.source import Source, any_of
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.cuda.tetrahedra import TetrahedralTaps
from filterlab.ops.tetrahedra import TetrahedralStencil


class TetrahedralRestriction:
    """Writes restrictions of a spline to polynomials, at the end of a source; see `Restriction`."""

    def __init__(self, source: Source, stencil: TetrahedralStencil) -> None:
        self.source, self.line = source, source.line
        self.taps = TetrahedralTaps(source, stencil)
        self.spline, self.cubes = stencil.spline, Cubes(self.taps.sum)

    @contextmanager
    def every(self, into: str, mask: str, waiting: str) -> Iterator[Section]:
        """The with-block for the next part of every ray under the mask, until it waits; see `Restriction.every`."""
        line, octahedral = self.line, self.spline.octahedral
        odd = [self.taps.text.named(f"(at_{a} & 1) > 0") for a in AXES] if octahedral else []
        way = self.cubes.way([f"u_{a}" for a in AXES], [f"v_{a}" for a in AXES], odd)
        cuts = self.cubes.cuts(way)
        same = None if octahedral else self.taps.blocks("first", self.taps.at_sample(None))
        line(f"section, section_start, section_near = {mask}, nothing, near")
        with self.source.block(f"while {any_of('section')}"):
            line(f"section_end = {self.cubes.following(cuts, 'section_start')}")
            line("section_far = section_end.to(tl.float64) * (far - near) + near")
            line("section_far = tl.where(section_end < 1.0, section_far, far)  # to the bit")
            part = self.cubes.part(way, "section_start", "section_end")
            blocks = same or self.taps.blocks("first", self.taps.at_sample(part.turned))
            for i, row in enumerate(self.taps.sum.restrict(blocks, part.turned, part.start, part.end)):
                line(f"{into}_{i} = {row}")
            yield Section("section", "section_near", "section_far")
            line("section_start, section_near = section_end, section_far")
            line(f"section = section & (section_end < 1.0) & ~{waiting}")
