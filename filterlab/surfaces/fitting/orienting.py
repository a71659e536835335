"""Which side of scanned points is outside: normals turned to agree with those of their neighbours.

Normals that are known up to their sign are turned along a tree that spans the points. On an arc from p to q, along the
unit vector e, the normal n at p becomes m at q as in a mirror between both,

    m = n − 2 (n·e) e

on a circle exactly, across sharp edges, convex or concave, and from one wall of a thin plate to the other; m is turned
to agree with that. Edges of the tree have the least 1 − |m·(n − 2 (n·e) e)|. Then each connected part is turned as a
whole so that its outermost points in many directions look outwards. The inner wall of a hollow body, where nothing
connects it to the outer one, is turned outwards like a body of its own: give normals for that.

Source: Hoppe et al., Surface reconstruction from unorganized points, 1992; with the mirror of König & Gumhold,
Consistent propagation of normal orientations in point clouds, 2009.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from filterlab.surfaces.fitting.graphs import unit

_LEAST = 1e-6  # of an edge: 0 is no edge


def oriented(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """Normals (N, 3), some of them turned.

    Args:
        near: (N, k) numbers of neighbours.
    """
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    count = len(points)
    edges = _edges(near)
    costs = (1 + _LEAST - _agreement(points, normals, edges).abs()).clamp_min(_LEAST)
    tree = minimum_spanning_tree(_matrix(edges, costs.numpy(), count)).tocoo()
    edges = np.stack((tree.row, tree.col)).astype(np.int64)
    parts, part = connected_components(_matrix(edges, np.ones(edges.shape[1]), count), directed=False)
    normals = _along_tree(points, normals, edges, part)
    return normals * _outwards(points, normals, torch.from_numpy(part).long(), parts)[:, None]


def _edges(near: Tensor) -> np.ndarray:
    """(2, E), each once, the smaller number first."""
    pairs = np.stack((np.repeat(np.arange(len(near)), near.shape[1]), near.numpy().ravel()))
    low, high = pairs.min(0), pairs.max(0)
    keys = np.unique(low * len(near) + high)
    keys = keys[keys // len(near) != keys % len(near)]
    return np.stack((keys // len(near), keys % len(near)))


def _agreement(points: Tensor, normals: Tensor, edges: np.ndarray) -> Tensor:
    """(E,) of the normals at both ends, one of them mirrored; −1 … 1."""
    i, j = torch.from_numpy(edges)
    along = unit(points[j] - points[i])
    mirrored = normals[i] - 2 * (normals[i] * along).sum(-1, keepdim=True) * along
    return (mirrored * normals[j]).sum(-1)


def _matrix(edges: np.ndarray, values: np.ndarray, count: int):
    from scipy.sparse import coo_matrix

    return coo_matrix((values, (edges[0], edges[1])), shape=(count, count)).tocsr()


def _along_tree(points: Tensor, normals: Tensor, edges: np.ndarray, part: np.ndarray) -> Tensor:
    """Turned to agree along the edges (2, E) of trees, from the first point of each part on."""
    from scipy.sparse.csgraph import breadth_first_order

    count = len(normals)
    roots = np.unique(part, return_index=True)[1]
    both = np.concatenate((edges, edges[::-1], np.stack((np.full(len(roots), count), roots))), 1)
    graph = _matrix(both, np.ones(both.shape[1]), count + 1)  # one more point leads to all parts
    order, before = breadth_first_order(graph, count, directed=True)
    agrees = np.ones(count + 1)
    own = order[1:]
    known = own[before[own] < count]
    agrees[known] = np.where(_agreement(points, normals, np.stack((before[known], known))) < 0, -1, 1)
    return normals * torch.from_numpy(_products(agrees, before, count)[:count, None])


def _products(signs: np.ndarray, before: np.ndarray, root: int) -> np.ndarray:
    """Of the signs of a point and all before it, up to the root: each step looks twice as far."""
    signs, before = signs.copy(), np.where(before < 0, root, before)
    while (before != root).any():
        signs, before = signs * signs[before], before[before]
    return signs


def _outwards(points: Tensor, normals: Tensor, part: Tensor, parts: int) -> Tensor:
    """(N,) 1 or −1, the same for all of a part: by its outermost points in 26 directions."""
    votes = torch.zeros(parts, dtype=points.dtype)
    for direction in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        if any(direction):
            along = torch.tensor(direction, dtype=points.dtype)
            along = along / along.norm()
            height = (points * along).sum(-1)
            outermost = _last_of_parts(height, part, parts)
            votes += (normals[outermost] * along).sum(-1)
    return torch.where(votes < 0, -1.0, 1.0).to(points)[part]


def _last_of_parts(height: Tensor, part: Tensor, parts: int) -> Tensor:
    """(parts,) the number of the highest point of each."""
    order = np.lexsort((height.numpy(), part.numpy()))
    ends = np.cumsum(np.bincount(part.numpy(), minlength=parts)) - 1
    return torch.from_numpy(order[ends])
