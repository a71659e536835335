"""What quadrics are cut off at: a ball, a tetrahedron, a convex polyhedron, for each its own.

Every one of them is a ball that planes cut: the ball around a tetrahedron, and its four faces. The centre of the ball
is where rays are measured from (`ops.quadrics`). Planes are n, d: n·x + d ≤ 0 is kept. Bounds have no derivatives, for
hits do not move with them: they come and go.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from filterlab.ops.tree import Boxes

_LEAST = 1e-12  # of a determinant or a product of unit normals, that is not 0 by rounding
_CLOSED = 1e-9  # by how much of its size a vertex of planes may lie behind another one
_AT_ONCE = 1 << 20  # numbers of planes and vertices


class Bounds:
    """Balls cut by planes, one for each of M quadrics.

    Attributes:
        centers: (M, 3) float64, in the world. radii: (M,).
        planes: (M, H, 4): n, d of n·x + d ≤ 0, in the world; n of any length, 0 0 0 −1 for no plane.
        boxes: axis-aligned boxes around what is kept.
        corners: (M, C, 3) of polyhedra; None: only the ball is known.
    """

    def __init__(
        self,
        centers: Tensor,
        radii: Tensor,
        planes: Tensor | None = None,
        boxes: Boxes | None = None,
        corners: Tensor | None = None,
    ) -> None:
        self.centers, self.radii, self.corners = centers, radii, corners
        self.planes = centers.new_zeros(len(centers), 0, 4) if planes is None else planes
        self.boxes = Boxes(centers - radii[:, None], centers + radii[:, None]) if boxes is None else boxes

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)})"

    def __len__(self) -> int:
        return len(self.centers)

    def distances(self, points: Tensor, piece: Tensor) -> Tensor:
        """(..., 1 + H) of world points (..., 3) from ball and planes of those numbered (...), negative within."""
        off = (points - self.centers[piece]).norm(dim=-1) - self.radii[piece]
        return torch.cat((off[..., None], plane_distances(points, self.planes[piece])), -1)

    def cut(self, planes: Tensor) -> Bounds:
        """The same, with (M, K, 4) or (M, 4) more planes: n·x + d ≤ 0 is kept. Raises as `Planes` does."""
        planes = planes[:, None] if isinstance(planes, Tensor) and planes.ndim == 2 else planes
        more = _unit_planes("cuts", planes, len(self)).to(self.planes)
        return Bounds(self.centers, self.radii, torch.cat((self.planes, more), 1), self.boxes, self.corners)

    def to(self, device: torch.device) -> Bounds:
        """The same there; themselves, if that is where they are."""
        if self.centers.device == device:
            return self
        boxes = Boxes(*(ends.to(device) for ends in self.boxes))
        corners = None if self.corners is None else self.corners.to(device)
        return Bounds(self.centers.to(device), self.radii.to(device), self.planes.to(device), boxes, corners)

    @staticmethod
    def joined(parts: list[Bounds]) -> Bounds:
        """One after the other."""
        most = max(part.planes.shape[1] for part in parts)
        planes = torch.cat([_with_planes(part.planes, most) for part in parts])
        boxes = Boxes(*(torch.cat(ends) for ends in zip(*(part.boxes for part in parts), strict=True)))
        centers, radii = (torch.cat([getattr(part, name) for part in parts]) for name in ("centers", "radii"))
        return Bounds(centers, radii, planes, boxes)


class Spheres(Bounds):
    """Balls.

    Args:
        centers: (M, 3), in the world.
        radii: (M,), or a number for all of them; positive.

    Raises:
        TypeError, ValueError: no such tensors; numbers that are not finite; radii that are not positive.
    """

    def __init__(self, centers: Tensor, radii: Tensor | float) -> None:
        centers = _checked("centers", centers, (None, 3))
        radii = torch.as_tensor(radii, dtype=torch.float64, device=centers.device).detach()
        radii = _checked("radii", radii.expand(len(centers)) if not radii.ndim else radii, (len(centers),))
        check_positive("radii", radii)
        super().__init__(centers, radii.contiguous())


class Tetrahedra(Bounds):
    """Tetrahedra, whichever way their corners go round.

    Args:
        corners: (M, 4, 3), in the world.

    Raises:
        TypeError, ValueError: no such tensor; numbers that are not finite; corners in one plane.
    """

    def __init__(self, corners: Tensor) -> None:
        corners = _checked("corners", corners, (None, 4, 3))
        center = corners.mean(1)
        local = corners - center[:, None]
        radii = local.norm(dim=-1).amax(1)
        edges = local[:, 1:] - local[:, :1]
        flat = ~(torch.linalg.det(edges).abs() > _LEAST * edges.norm(dim=-1).prod(-1))
        if n := int(flat.sum()):
            raise ValueError(f"corners of a tetrahedron must not lie in one plane; {n} of {len(corners)} do")
        faces = torch.stack([_face(local, face) for face in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))], 1)
        boxes = Boxes(corners.amin(1), corners.amax(1))
        super().__init__(center, radii, _in_world(faces, center), boxes, corners)


class Planes(Bounds):
    """Convex polyhedra between planes.

    Args:
        halfspaces: (M, H, 4): n, d of the sides n·x + d ≤ 0 that are kept; n of any length.

    Raises:
        TypeError, ValueError: no such tensor; numbers that are not finite; normals of 0; planes that leave nothing, or
            something without an end.
    """

    def __init__(self, halfspaces: Tensor) -> None:
        planes = _unit_planes("halfspaces", halfspaces, None)
        numbers = planes.shape[1] ** 4
        parts = [_vertices(some) for some in planes.split(max(1, _AT_ONCE // max(numbers, 1)))]
        lower, upper = (torch.cat(ends) for ends in zip(*parts, strict=True))
        center = (lower + upper) / 2
        super().__init__(center, (upper - lower).norm(dim=-1) / 2, planes, Boxes(lower, upper))


def plane_distances(points: Tensor, planes: Tensor) -> Tensor:
    """n·x + d (..., H) of points (..., 3) and planes (..., H, 4)."""
    return (planes[..., :3] * points[..., None, :]).sum(-1) + planes[..., 3]


def check_positive(name: str, numbers: Tensor) -> None:
    """Raises ValueError unless all are."""
    if n := int((~(numbers > 0)).sum()):
        raise ValueError(f"{name} must be positive; {n} of {numbers.numel()} are not")


def _checked(name: str, x: Tensor, shape: tuple[int | None, ...]) -> Tensor:
    """In float64, without derivatives. Raises unless it is finite and of a shape, None for any number."""
    return check_rows(name, x, shape).detach().double()


def check_rows(name: str, x: Tensor, shape: tuple[int | None, ...]) -> Tensor:
    """The same tensor. Raises TypeError, ValueError unless it is finite and of a shape; None is any number."""
    if not isinstance(x, Tensor) or not x.dtype.is_floating_point:
        raise TypeError(f"{name} must be a floating-point torch.Tensor; got {getattr(x, 'dtype', type(x).__name__)}")
    if x.ndim != len(shape) or any(n not in (None, own) for n, own in zip(shape, x.shape, strict=True)):
        wanted = ", ".join("…" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} must have shape ({wanted}); got {tuple(x.shape)}")
    if n := int((~x.detach().isfinite()).sum()):
        raise ValueError(f"{name} must be finite; {n} of its {x.numel()} numbers are not")
    return x


def _unit_planes(name: str, planes: Tensor, count: int | None) -> Tensor:
    """The same with normals of length 1. Raises unless they are (count, H, 4), finite, with normals."""
    planes = _checked(name, planes, (count, None, 4))
    size = planes[..., :3].norm(dim=-1, keepdim=True)
    if n := int((size == 0).sum()):
        raise ValueError(f"normals of {name} must not be 0; {n} are")
    return planes / size


def _face(corners: Tensor, face: tuple[int, int, int]) -> Tensor:
    """The plane (M, 4) through three corners of tetrahedra around 0, which it keeps."""
    a, b, c = (corners[:, i] for i in face)
    normal = torch.linalg.cross(b - a, c - a)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    d = -(normal * a).sum(-1, keepdim=True)
    return torch.where(d > 0, -1, 1) * torch.cat((normal, d), -1)


def _in_world(planes: Tensor, center: Tensor) -> Tensor:
    """Planes (M, H, 4) that are measured from centres (M, 3)."""
    d = planes[..., 3] - (planes[..., :3] * center[:, None]).sum(-1)
    return torch.cat((planes[..., :3], d[..., None]), -1)


def _with_planes(planes: Tensor, count: int) -> Tensor:
    """(M, count, 4), those that are missing none."""
    none = planes.new_tensor([0.0, 0.0, 0.0, -1.0])
    return torch.cat((planes, none.expand(len(planes), count - planes.shape[1], 4)), 1)


def _vertices(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Corners (M, 3) of the boxes around what planes (M, H, 4) with unit normals keep."""
    normal, d = planes[..., :3], planes[..., 3]
    count = planes.shape[1]
    if count < 4 or _open(normal):
        raise ValueError("halfspaces must leave something with an end on every side; some of them do not")
    triples = torch.tensor(list(itertools.combinations(range(count), 3)), device=planes.device)
    matrix = normal[:, triples]
    det = torch.linalg.det(matrix)
    meets = det.abs() > _LEAST
    safe = torch.where(meets[..., None, None], matrix, torch.eye(3, dtype=matrix.dtype, device=matrix.device))
    vertex = torch.linalg.solve(safe, -d[:, triples])
    size = d.abs().amax(1)[:, None, None]
    inside = (vertex @ normal.mT + d[:, None] <= _CLOSED * size).all(-1) & meets
    if n := int((~inside.any(1)).sum()):
        raise ValueError(f"halfspaces must leave something; {n} of {len(planes)} polyhedra are empty")
    lower = torch.where(inside[..., None], vertex, torch.inf).amin(1)
    return lower, torch.where(inside[..., None], vertex, -torch.inf).amax(1)


def _open(normal: Tensor) -> bool:
    """Whether some of those (M, H, 3) leave a way v ≠ 0 without an end: n·v ≤ 0 for all.

    If normals span space, such ways are a cone whose edges lie in two of the planes each.
    """
    if bool((torch.linalg.matrix_rank(normal) < 3).any()):
        return True
    pairs = torch.tensor(list(itertools.combinations(range(normal.shape[1]), 2)), device=normal.device)
    edge = torch.linalg.cross(normal[:, pairs[:, 0]], normal[:, pairs[:, 1]])
    size = edge.norm(dim=-1, keepdim=True)
    edge = edge / torch.where(size > _LEAST, size, torch.inf)
    along = torch.cat((edge, -edge), 1) @ normal.mT
    return bool(((along <= _LEAST).all(-1) & (size > _LEAST).squeeze(-1).repeat(1, 2)).any())
