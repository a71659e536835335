"""Surfaces of many pieces in a tree of boxes, each with a function of its own: what casts rays at them, and when."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Sequence
from typing import Generic, Self, TypeVar

from torch import Tensor

from filterlab.fields.base import Domain
from filterlab.ops.differentiable import quadrics as ops
from filterlab.ops.quadrics import InLeaves
from filterlab.ops.tree import Boxes
from filterlab.surfaces.base import Hits, Surface

_MARGIN = 1e-4  # of the diagonal, around all: rays begin outside of what they hit
_FINEST = 1e-3  # of the diagonal: as the smallest radius counts what is smaller


Leaves = TypeVar("Leaves", bound=InLeaves)


class InTree(Surface, Generic[Leaves]):
    """The tree is built at the first hit, and again when numbers were changed in place."""

    max_order = 2
    in_pieces = True
    _built: tuple[tuple[int, ...], Leaves] | None = None

    @property
    @abstractmethod
    def tensors(self) -> tuple[Tensor, ...]: ...

    @abstractmethod
    def with_tensors(self, tensors: Sequence[Tensor]) -> Self: ...

    @abstractmethod
    def _described(self) -> Leaves:
        """The tree, and the numbers in it as they are now."""

    @property
    def described(self) -> Leaves:
        """What rays are cast at."""
        versions = tuple(x._version for x in self.tensors)
        if self._built is None or self._built[0] != versions:
            self._built = versions, self._described()
        return self._built[1]

    def _casting(self, found: Leaves) -> Self:
        """The same surface, whose rays are cast at those."""
        other = copy.copy(self)
        other._built = tuple(x._version for x in self.tensors), found
        return other

    @property
    def detached(self) -> Self:
        return self.with_tensors([x.detach() for x in self.tensors])._casting(self.described)

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        found = self._sheets(origins, directions, 1, False)
        assert found.piece is not None
        return Hits(found.t[:, 0], found.piece[:, 0])

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        return Hits(*ops.hits(self.described, origins.reshape(-1, 3), directions.reshape(-1, 3), sheets, farthest))


def domain_around(boxes: Boxes, radii: Tensor) -> Domain:
    """A box around all, with room; the smallest radius stands for a voxel."""
    lower, upper = (x.cpu() for x in boxes.around())
    diagonal = float((upper - lower).norm())
    lower, upper = lower - _MARGIN * diagonal, upper + _MARGIN * diagonal
    finest = max(float(radii.min()), _FINEST * diagonal)
    return Domain(tuple(lower.tolist()), tuple(upper.tolist()), voxel_size=finest)
