"""The program that casts rays at quadrics, eight at a time: what `ops.reference.quadrics` says, in float64."""

from __future__ import annotations

from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu.lanes import Value
from filterlab.ops.cpu.quadric_leaves import Met, QuadricLeaves
from filterlab.ops.cpu.tree_walk import Ray, Rows, RowsVariant


@dataclass(frozen=True)
class QuadricsVariant(RowsVariant):
    """See `quadric_leaves.QuadricLeavesVariant`."""

    planes: int

    def program(self, function: ir.Function) -> Rows:
        return _Program(self, function)


class _Program(QuadricLeaves, Rows):
    def leaf(self, ray: Ray, leaf: Value) -> None:
        self.quadrics(ray, leaf, self._take)

    def _take(self, _ray: Ray, met: Met, root: Value, hit: Value) -> None:
        self.take(met.leaf, self.lanes.add(root, met.behind), hit)
