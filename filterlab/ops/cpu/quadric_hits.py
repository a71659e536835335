"""The program that casts rays at quadrics, eight at a time: what `ops.reference.quadrics` says, in float64."""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.ops.cpu import frame
from filterlab.ops.cpu.lanes import Value
from filterlab.ops.cpu.quadric_leaves import Met, QuadricLeaves
from filterlab.ops.cpu.tree_walk import Ray, Rows
from filterlab.ops.quadrics import Kept


@dataclass(frozen=True)
class QuadricsVariant:
    """Everything the program depends on, apart from the machine; see `quadric_leaves.QuadricLeavesVariant`."""

    planes: int
    kept: Kept
    reversed: bool
    fused: bool

    def generate(self) -> str:
        """The program as LLVM IR text."""
        module, function = frame.new_module()
        _Program(self, function).write()
        return str(module)


class _Program(QuadricLeaves, Rows):
    def leaf(self, ray: Ray, leaf: Value) -> None:
        self.quadrics(ray, leaf, self._take)

    def _take(self, _ray: Ray, met: Met, root: Value, hit: Value) -> None:
        self.take(met.leaf, self.lanes.add(root, met.behind), hit)
