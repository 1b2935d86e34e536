"""From a function of space to a mesh: marching cubes, coarse to fine, only near the surface.

A grid of N intervals has N + 1 samples; sample ``i`` lies at ``lower + i * voxel``, exactly. Values
are greater inside. The mesh is closed and wound counter-clockwise seen from outside.
"""

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from handavatar.errors import HandAvatarError

Field = Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]
"""A value at each point in metres, greater inside."""

POINTS_AT_ONCE = 1 << 17
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]] * 2)
_CORNERS[4:, 2] = 1
"""Corners of a cell in the order of libigl's tables: around the bottom, then around the top."""
_FACES = [
    (axis, side, np.flatnonzero(_CORNERS[:, axis] == side)) for axis in range(3) for side in (0, 1)
]


@dataclass(frozen=True, eq=False)
class ExtractedSurface:
    """A closed mesh and what it cost.

    Attributes:
        vertices: metres.
        faces: outward winding; none if the field is nowhere above the level.
        voxel: edge of a cell of the finest grid, metres.
        num_evaluations: points at which the field was asked.
        num_dense: samples of the whole finest grid.
    """

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    voxel: float
    num_evaluations: int
    num_dense: int


def logits_of(occupancy_of: Field) -> Field:
    """The logits of an occupancy: nearly linear across the surface, where occupancy is a step.

    Marching cubes interpolates linearly, so that it finds the surface in logits (level 0) far
    better than in occupancies (level 0.5). Beyond 13.8 logits are cut off.
    """
    return lambda points: torch.special.logit(occupancy_of(points), eps=1e-6)


@torch.no_grad()
def extract_surface(
    values_of: Field,
    lower: Float[Tensor, "3"],
    upper: Float[Tensor, "3"],
    resolution: int,
    level: float = 0.0,
    coarsest: int = 32,
    seeds: Float[Tensor, "seeds 3"] | None = None,
    corrections: int = 0,
) -> ExtractedSurface:
    """The level set of a field inside a box.

    The coarsest grid is evaluated everywhere. Cells that the surface crosses, their neighbours and
    the cells that hold seeds are halved, again and again (without the neighbours the last time);
    on each grid the surface is followed from cell to cell wherever it leaves what has been
    evaluated. The result equals that of the whole finest grid but for separate pieces so small
    that no sample of a coarser grid lies in them.

    Args:
        values_of: greater inside; asked for at most ``POINTS_AT_ONCE`` points at a time.
        lower: smallest corner of the box, metres.
        upper: greatest corner; the box grows there to whole cells of the coarsest grid.
        resolution: cells along the longest side on the finest grid.
        level: value at the surface.
        coarsest: the grid is halved while it has more cells than this along the longest side.
        seeds: points near the surface, such as a posed mesh's vertices, so that nothing thin is
            lost between coarse samples.
        corrections: how often the field is asked at the vertices, each of which then moves along
            its grid edge to where the answer says; worth it for fields that bend within a voxel.

    Raises:
        ValueError: an empty box, a resolution below 2, or a field that answers NaN.

    Source: paper Sec. 4.1 (meshes are extracted by marching cubes).
    Departs: the authors divide by the number of samples less two, which enlarges every mesh by
        0.4 percent; here samples lie where they are asked. Where the box cuts the inside, the mesh
        is closed half a cell before its border.
    """
    sides = (upper - lower).double().cpu().numpy()
    if resolution < 2 or not (np.isfinite(sides).all() and (sides > 0).all()):
        raise HandAvatarError(
            f"extraction: found a box with sides {sides.tolist()} m and resolution {resolution}; "
            "expected positive sides and at least 2 cells"
        )
    halvings = 0
    while resolution >> halvings > coarsest and (resolution >> halvings) % 2 == 0:
        halvings += 1
    voxel = float(sides.max()) / resolution
    # A hair less than whole: rounding must not add a layer of cells.
    cells = np.maximum(np.ceil(sides / (voxel * 2**halvings) - 1e-6).astype(int), 1)
    origin = lower.double().cpu().numpy()
    grid = _Grid(values_of, origin, cells, voxel * 2**halvings, level, lower)
    grid.examine(np.arange(int(cells.prod())))
    for left in reversed(range(halvings)):
        grid = grid.halved(seeds, neighbours=left > 0)
    vertices, faces = grid.marched(corrections)
    num_dense = int((np.array(grid.cells) + 1).prod())
    return ExtractedSurface(
        torch.from_numpy(vertices).to(lower),
        torch.from_numpy(faces).to(lower.device),
        voxel,
        grid.num_evaluations,
        num_dense,
    )


def largest_component(surface: ExtractedSurface) -> ExtractedSurface:
    """Only the piece with most faces: the hand without what may float about it."""
    if len(surface.faces) == 0:
        return surface
    faces = surface.faces.cpu().numpy()
    piece = _pieces(faces, len(surface.vertices))
    kept = piece[faces[:, 0]] == np.bincount(piece[faces[:, 0]]).argmax()
    used, renumbered = np.unique(faces[kept], return_inverse=True)
    return ExtractedSurface(
        surface.vertices[torch.from_numpy(used).to(surface.faces.device)],
        torch.from_numpy(renumbered.reshape(-1, 3)).to(surface.faces.device),
        surface.voxel,
        surface.num_evaluations,
        surface.num_dense,
    )


def num_components(surface: ExtractedSurface) -> int:
    """Separate pieces of the surface."""
    if len(surface.faces) == 0:
        return 0
    faces = surface.faces.cpu().numpy()
    return len(np.unique(_pieces(faces, len(surface.vertices))[faces[:, 0]]))


def _pieces(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    first, second = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    links = coo_array((np.ones(len(first), bool), (first, second)), (num_vertices, num_vertices))
    return connected_components(links, directed=False)[1]


class _Grid:
    """One grid of the pyramid: the samples known so far and the cells that the surface crosses."""

    def __init__(
        self,
        values_of: Field,
        origin: np.ndarray,
        cells: np.ndarray,
        voxel: float,
        level: float,
        like: Tensor,
        num_evaluations: int = 0,
    ) -> None:
        self.values_of, self.origin, self.voxel, self.level = values_of, origin, voxel, level
        self.cells, self.like, self.num_evaluations = (
            tuple(int(n) for n in cells),
            like,
            num_evaluations,
        )
        self.samples = tuple(n + 1 for n in self.cells)
        self.values = np.full(self.samples, np.nan, np.float32)
        self.is_examined = np.zeros(self.cells, bool)
        self.is_crossed = np.zeros(self.cells, bool)

    def examine(self, cells: np.ndarray) -> None:
        """Evaluates the corners of these cells, and of those into which the surface leads on."""
        while len(cells):
            self.is_examined.reshape(-1)[cells] = True
            places = np.stack(np.unravel_index(cells, self.cells), axis=-1)
            corners = self._corners(places)
            self._evaluate(np.unique(corners))
            is_inside = self.values.reshape(-1)[corners] > self.level
            crossed = is_inside.any(1) & ~is_inside.all(1)
            self.is_crossed.reshape(-1)[cells[crossed]] = True
            places, is_inside = places[crossed], is_inside[crossed]
            ahead = []
            for axis, side, face in _FACES:
                on_face = is_inside[:, face]
                leads = on_face.any(1) & ~on_face.all(1)
                beyond = places[leads]
                beyond[:, axis] += 2 * side - 1
                is_there = (beyond[:, axis] >= 0) & (beyond[:, axis] < self.cells[axis])
                ahead.append(np.ravel_multi_index(tuple(beyond[is_there].T), self.cells))
            cells = np.unique(np.concatenate(ahead))
            cells = cells[~self.is_examined.reshape(-1)[cells]]

    def halved(self, seeds: Tensor | None, neighbours: bool) -> "_Grid":
        """The grid of half the voxel, examined where the surface and the seeds are, or near."""
        marked = self.is_crossed.copy()
        if seeds is not None and len(seeds):
            places = np.floor((seeds.double().cpu().numpy() - self.origin) / self.voxel).astype(int)
            places = places[((places >= 0) & (places < self.cells)).all(1)]
            marked[tuple(places.T)] = True
        if neighbours:
            marked = binary_dilation(marked, np.ones((3, 3, 3), bool))
        near = np.argwhere(marked)
        finer = _Grid(
            self.values_of,
            self.origin,
            2 * np.array(self.cells),
            self.voxel / 2,
            self.level,
            self.like,
            self.num_evaluations,
        )
        finer.values[::2, ::2, ::2] = self.values
        children = (2 * near[:, None] + _CORNERS).reshape(-1, 3)
        finer.examine(np.ravel_multi_index(tuple(children.T), finer.cells))
        return finer

    def marched(self, corrections: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and outward faces of the crossed cells."""
        crossed = np.argwhere(self.is_crossed)
        if len(crossed) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        used, corners = np.unique(self._corners(crossed), return_inverse=True)
        places = np.stack(np.unravel_index(used, self.samples), axis=-1)
        values = self.values.reshape(-1)[used].astype(np.float64) - self.level
        # A sample exactly on the surface would make triangles without area.
        smallest = 1e-4 * np.abs(values).mean()
        values = np.where(values > 0, np.maximum(values, smallest), np.minimum(values, -smallest))
        vertices, faces, _ = igl.marching_cubes(
            values, places.astype(np.float64), corners.reshape(-1, 8).astype(np.int64), 0.0
        )
        if corrections:
            vertices = self._corrected(vertices, corrections)
        # libigl winds for a field that is greater outside.
        return self.origin + self.voxel * vertices, np.ascontiguousarray(faces[:, ::-1])

    def _corrected(self, vertices: np.ndarray, corrections: int) -> np.ndarray:
        """Every vertex at the zero along its edge of the grid, by false position; in voxels."""
        row, axis = np.arange(len(vertices)), np.abs(vertices - np.rint(vertices)).argmax(1)
        start = np.rint(vertices).astype(int)
        start[row, axis] = np.floor(vertices[row, axis])
        direction = np.eye(3, dtype=int)[axis]
        end = np.minimum(start + direction, self.cells)
        # The field was not asked for what closes the mesh at the border.
        is_asked = ((start > 0) & (end < self.cells)).all(1)
        start, end, direction = start[is_asked], end[is_asked], direction[is_asked]
        low, high = np.zeros(len(start)), np.ones(len(start))
        at_low, at_high = (self.values[tuple(side.T)] - float(self.level) for side in (start, end))
        along = ((vertices[is_asked] - start) * direction).sum(1)
        for _ in range(corrections):
            found = self._answers(start + along[:, None] * direction) - self.level
            is_low = (found > 0) == (at_low > 0)
            low, at_low = np.where(is_low, along, low), np.where(is_low, found, at_low)
            high, at_high = np.where(is_low, high, along), np.where(is_low, at_high, found)
            along = low + (high - low) * (at_low / (at_low - at_high)).clip(1e-4, 1 - 1e-4)
        corrected = vertices.copy()
        corrected[is_asked] = start + along[:, None] * direction
        return corrected

    def _corners(self, places: np.ndarray) -> np.ndarray:
        corners = places[:, None] + _CORNERS
        return np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), self.samples)

    def _evaluate(self, samples: np.ndarray) -> None:
        values = self.values.reshape(-1)
        unknown = samples[np.isnan(values[samples])]
        places = np.stack(np.unravel_index(unknown, self.samples), axis=-1)
        answers = self._answers(places)
        is_border = ((places == 0) | (places == np.array(self.cells))).any(1)
        distance = np.abs(answers - self.level)
        values[unknown] = np.where(is_border, self.level - distance, answers)

    def _answers(self, places: np.ndarray) -> np.ndarray:
        """What the field answers at these places, in voxels."""
        answers = np.empty(len(places))
        for start in range(0, len(places), POINTS_AT_ONCE):
            chosen = places[start : start + POINTS_AT_ONCE]
            points = torch.from_numpy(self.origin + self.voxel * chosen).to(self.like)
            values = self.values_of(points).double().cpu().numpy()
            if np.isnan(values).any():
                where = points[int(np.isnan(values).argmax())].tolist()
                raise HandAvatarError(
                    f"extraction: the field answers NaN at {where} m, and at "
                    f"{int(np.isnan(values).sum())} of {len(values)} points; expected numbers: "
                    "check the weights and the posed vertices for NaN"
                )
            # Infinity has no place between two samples; this keeps its side.
            answers[start : start + len(chosen)] = values.clip(self.level - 1e3, self.level + 1e3)
        self.num_evaluations += len(places)
        return answers
