"""A tree of boxes over many small things, which rays walk down: built by sorting, with no links but one for each node.

Things are sorted along Morton's curve through the middles of their boxes; eight in a row are a leaf, eight leaves in a
row a node, eight nodes the node above. Sorting and the boxes of every level are few calls of torch, which run on all
threads. Memory: 24 bytes for every leaf and node, 4 for every node, 8 for every thing.

Source: Morton, A computer oriented geodetic data base, 1966; Lauterbach et al., Fast BVH construction on GPUs, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

WIDTH = 8
"""Children of a node, and things of a leaf."""

_BITS = 21  # of Morton's code, along an axis
_GROWN = 1e-6  # of the diagonal, by what boxes are larger: float32 arithmetic of rays and boxes is off by a third of it
_SPREADS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F))
_SPREADS += ((4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))


class Boxes(NamedTuple):
    """Axis-aligned boxes: lower and upper corners (M, 3), float64."""

    lower: Tensor
    upper: Tensor

    def around(self) -> tuple[Tensor, Tensor]:
        """Corners (3,) of the box around all; 0 of none."""
        if not len(self.lower):
            return self.lower.new_zeros(3), self.lower.new_zeros(3)
        return self.lower.amin(0), self.upper.amax(0)

    def some(self, which: Tensor) -> Boxes:
        return Boxes(self.lower[which], self.upper[which])


@dataclass(frozen=True, eq=False)
class Tree:
    """Boxes within boxes.

    Attributes:
        order: (M,) int64, which thing stands in each place: leaf g has the places 8 g … 8 g + 7.
        own: the boxes of things, place by place.
        center: (3,) float64, what `boxes` are measured from.
        radius: no corner is farther away from there.
        boxes: (N, 6, 8) float32: lower x, y, z, upper x, y, z of the children of each node; where there is none, lower
            is ∞ and upper −∞. Node 0 is the root.
        children: (N,) int32: number of the first child, a node; or −1 − g, of a leaf.
    """

    order: Tensor
    own: Boxes
    center: Tensor
    radius: float
    boxes: Tensor
    children: Tensor

    @classmethod
    def over(cls, boxes: Boxes) -> Tree:
        """The tree of all boxes."""
        lower, upper = boxes.around()
        middle = (boxes.lower + boxes.upper) / 2
        scale = (upper - lower).amax()
        order = _morton((middle - lower) / torch.where(scale > 0, scale, 1)).argsort()
        return cls._of_places(order, boxes.some(order), (lower + upper) / 2, float((upper - lower).norm() / 2))

    def some(self, kept: Tensor) -> Tree:
        """Of a mask of things (M,): the others are left out, places move up; center and radius stay."""
        place = kept[self.order]
        return Tree._of_places(self.order[place], self.own.some(place), self.center, self.radius)

    @classmethod
    def _of_places(cls, order: Tensor, own: Boxes, center: Tensor, radius: float) -> Tree:
        grown = 2 * _GROWN * radius
        rows = torch.cat((own.lower - center - grown, own.upper - center + grown), 1)
        levels, children = _levels(_together(rows)), []
        begin = 0
        for level in levels[:-1]:  # the root first: children lie behind all of their parents
            begin += len(level)
            children.append(begin + WIDTH * torch.arange(len(level), device=rows.device))
        children.append(-1 - WIDTH * torch.arange(len(levels[-1]), device=rows.device))
        boxes = torch.cat(levels).transpose(1, 2)
        return cls(order, own, center, radius, boxes.float().contiguous(), torch.cat(children).int())

    def to(self, device: torch.device) -> Tree:
        own = Boxes(*(x.to(device) for x in self.own))
        moved = {name: getattr(self, name).to(device) for name in ("order", "center", "boxes", "children")}
        return replace(self, own=own, **moved)

    def numbers(self, place: Tensor) -> Tensor:
        """Of the things in places; −1 of none, the place −1."""
        return torch.nn.functional.pad(self.order, (0, 1), value=-1)[place]


def in_leaves(rows: Tensor, missing: float) -> Tensor:
    """Rows (M, K) of things, place by place, as (leaves, K, 8); places without a thing get a number."""
    groups = max(1, -(-len(rows) // WIDTH))
    padded = rows.new_full((groups * WIDTH, rows.shape[1]), missing)
    padded[: len(rows)] = rows
    return padded.view(groups, WIDTH, -1).transpose(1, 2).contiguous()


def _together(rows: Tensor) -> Tensor:
    """Of boxes (M, 6) those around eight in a row, (⌈M/8⌉, 6)."""
    lower, upper = in_leaves(rows[:, :3], torch.inf).amin(-1), in_leaves(rows[:, 3:], -torch.inf).amax(-1)
    return torch.cat((lower, upper), 1)


def _levels(boxes: Tensor) -> list[Tensor]:
    """From the root's on, the boxes of the children (n, 8, 6) of every node of a level."""
    lower, upper = in_leaves(boxes[:, :3], torch.inf), in_leaves(boxes[:, 3:], -torch.inf)
    level = torch.cat((lower, upper), 1).transpose(1, 2)
    return [level] if len(level) == 1 else [*_levels(_together(boxes)), level]


def _morton(places: Tensor) -> Tensor:
    """The number (M,) on Morton's curve of places (M, 3) in [0, 1]."""
    x, y, z = (_spread((axis * (2**_BITS - 1)).long()) for axis in places.unbind(-1))
    return x | (y << 1) | (z << 2)


def _spread(number: Tensor) -> Tensor:
    """Its bits, with room for two others between any two."""
    for shift, mask in _SPREADS:
        number = (number | (number << shift)) & mask
    return number
