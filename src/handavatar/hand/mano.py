"""A user's own MANO file, ``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl``, made into a rig.

Neither chumpy nor pickle is needed: :mod:`handavatar.hand.inert_pickle` reads the file without
running anything in it. What comes out is checked before it is believed. MANO's axes are this
project's (a right hand: fingers along -x, back +y, thumb side +z), and so are its metres and the
order of its bones; its wrist lies some ten centimetres from the origin and stays there, so that
translations of data sets keep their meaning. A left hand becomes the right hand that it mirrors.

MANO (Romero, Tzionas and Black 2017) is licensed: nothing here holds any of its numbers but the
names of five vertices.
"""

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.hand.inert_pickle import PickleError, read_pickle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pickled_arrays import ARRAY_NAMES, array_of, text_of
from handavatar.hand.pose import BONE_PARENTS, FINGER_BONES, NUM_BONES
from handavatar.hand.rig import LicensedRigMissing, Rig, RigError

Side = Literal["left", "right"]
LeftShape = Literal["auto", "kept", "mirrored"]

FINGERTIPS: dict[str, int] = {
    "thumb": 744,
    "index": 320,
    "middle": 443,
    "ring": 554,
    "little": 671,
}
"""Vertices at the ends of MANO's fingers, as everyone who adds tips to its joints takes them."""
WHERE_TO_GET_IT = (
    "MANO is licensed and does not ship: register at https://mano.is.tue.mpg.de, download\n"
    "'Models & Code', unpack it, then: handavatar rig import-mano mano_v1_2/models/MANO_RIGHT.pkl"
)
LICENCE = "MANO licence (https://mano.is.tue.mpg.de/license): do not redistribute"

_MAX_BYTES = 64 * 2**20
_REMEDY = "take the file afresh from https://mano.is.tue.mpg.de (MANO_RIGHT.pkl or MANO_LEFT.pkl)"
_VERTICES, _FACES, _SHAPES = 778, 1538, 10
_RIM = 16
_POSES = 9 * (NUM_BONES - 1)
_ANGLES = 3 * (NUM_BONES - 1)
_ARRAYS: dict[str, tuple[int, ...]] = {
    "v_template": (_VERTICES, 3),
    "shapedirs": (_VERTICES, 3, _SHAPES),
    "posedirs": (_VERTICES, 3, _POSES),
    "J_regressor": (NUM_BONES, _VERTICES),
    "weights": (_VERTICES, NUM_BONES),
    "kintree_table": (2, NUM_BONES),
    "f": (_FACES, 3),
    "hands_mean": (_ANGLES,),
    "hands_components": (_ANGLES, _ANGLES),
}
_TEXTS = {"bs_type": "lrotmin", "bs_style": "lbs"}
_ROOTS = (-1, 2**32 - 1, 2**64 - 1)


@dataclass(frozen=True, eq=False)
class ManoModel:
    """What a MANO file holds, as a right hand.

    Attributes:
        rig: the hand; of a left one, its mirror image.
        side: of the file.
        hands_mean: MANO's mean pose of the finger bones, axis-angle in radians. The rig's zero
            pose is flat; poses of data sets that count from the mean are made absolute by
            :func:`absolute_rotations`.
        hands_components: rows are MANO's principal components of finger poses.
        left_shape: what was done about the sign of a left hand's shape directions, see
            :func:`read_mano`; ``kept`` for a right hand.
        sha256: of the file.
    """

    rig: Rig
    side: Side
    hands_mean: Float[Tensor, "15 3"]
    hands_components: Float[Tensor, "45 15 3"]
    left_shape: LeftShape
    sha256: str


def read_mano(path: Path, left_shape: LeftShape = "auto") -> ManoModel:
    """Reads, checks and converts a MANO file; nothing in it is run.

    The left hand's file as released has the right hand's shape directions, not their mirror
    image: the same coefficient that makes the right hand longer makes the left one shorter, while
    width and thickness grow in both (https://github.com/vchoutas/smplx/issues/48). Their
    x components must change sign before the hand is mirrored.

    Args:
        path: ``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl``.
        left_shape: ``mirrored`` changes that sign of a left hand, ``kept`` does not, ``auto``
            does so unless length, width and thickness grow together already.

    Raises:
        LicensedRigMissing: there is no such file.
        RigError: it is not MANO's, damaged, or contains something that no MANO file does.
    """
    content = _content(path)
    try:
        fields = read_pickle(content, ARRAY_NAMES)
        arrays = _arrays(fields)
    except PickleError as error:
        raise RigError(f"{path}: not read, {error}\n{_REMEDY}") from error
    try:
        _check(arrays)
        side = _side(arrays)
        treatment: LeftShape = "kept"
        if side == "left":
            treatment = left_shape if left_shape != "auto" else _treatment(arrays)
            arrays = _mirrored(arrays, treatment == "mirrored")
        rig = _rig(f"mano-{side}", arrays)
    except RigError as error:
        raise RigError(f"{path}: {error}\n{_REMEDY}") from error
    return ManoModel(
        rig=rig,
        side=side,
        hands_mean=_tensor(arrays["hands_mean"].reshape(-1, 3)),
        hands_components=_tensor(arrays["hands_components"].reshape(_ANGLES, -1, 3)),
        left_shape=treatment,
        sha256=sha256(content).hexdigest(),
    )


def absolute_rotations(
    rotations: Float[Tensor, "*batch bones 3"], hands_mean: Float[Tensor, "15 3"]
) -> Float[Tensor, "*batch bones 3"]:
    """Poses that count from MANO's mean pose (``flat_hand_mean=False``), counted from flat.

    Args:
        rotations: axis-angle, radians; the wrist's first, which has no mean.
        hands_mean: of the same side's file, see :class:`ManoModel`.
    """
    return torch.cat([rotations[..., :1, :], rotations[..., 1:, :] + hands_mean], dim=-2)


def _content(path: Path) -> bytes:
    if not path.exists():
        raise LicensedRigMissing(f"{path}: no such file\n{WHERE_TO_GET_IT}")
    if not path.is_file():
        raise RigError(f"{path}: not a file\nname MANO_RIGHT.pkl or MANO_LEFT.pkl in it")
    with path.open("rb") as file:
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise RigError(
            f"{path}: larger than {_MAX_BYTES // 2**20} MB, a MANO file has about 4\n{_REMEDY}"
        )
    if content.startswith(b"PK\x03\x04"):
        raise RigError(f"{path}: a zip archive\nunpack it and name models/MANO_RIGHT.pkl in it")
    return content


def _arrays(fields: Any) -> dict[str, np.ndarray]:
    """The file's arrays by name, of the right shapes."""
    if not isinstance(fields, dict):
        raise PickleError(f"it holds no dictionary but something of type {type(fields).__name__}")
    named = {text_of(name): value for name, value in fields.items() if not isinstance(name, int)}
    missing = sorted(set(_ARRAYS) - set(named))
    if missing:
        raise PickleError(f"it lacks {', '.join(missing)}")
    arrays = {}
    for name, shape in _ARRAYS.items():
        try:
            arrays[name] = array_of(named[name], shape)
        except PickleError as error:
            raise PickleError(f"{name}: {error}") from error
    for name, expected in _TEXTS.items():
        if name in named and text_of(named[name]) != expected:
            raise PickleError(f"{name} is {text_of(named[name])[:40]!a}, expected {expected}")
    return arrays


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Refuses numbers that cannot be a hand's."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise RigError(f"{name} holds NaN or infinity")
        # Metres, radians, weights and indices are all far below; float32 must hold them.
        if name != "kintree_table" and np.abs(values.astype(np.float64)).max() > 1e6:
            raise RigError(f"{name} holds numbers above a million")
    weights = arrays["weights"]
    if weights.min() < -1e-6 or np.abs(weights.sum(1) - 1).max() > 1e-4:
        raise RigError(
            f"weights: rows sum to {weights.sum(1).min():.4f} to {weights.sum(1).max():.4f}, the "
            f"least is {weights.min():.2g}; expected sums of 1 and nothing below 0"
        )
    sums = arrays["J_regressor"].sum(1)
    if np.abs(sums - 1).max() > 1e-3:
        raise RigError(f"J_regressor: rows sum to {sums.min():.4f} to {sums.max():.4f}, expected 1")
    _check_tree(arrays["kintree_table"])
    faces = arrays["f"]
    if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= _VERTICES:
        raise RigError(
            f"f: faces of type {faces.dtype} name vertices {faces.min()} to {faces.max()}, "
            f"expected integers from 0 to {_VERTICES - 1}"
        )


def _check_tree(table: np.ndarray) -> None:
    """The bones must be ours, in our order: poses are lists of rotations without names."""
    parents = [int(parent) for parent in table[0]]
    bones = [int(bone) for bone in table[1]]
    if bones != list(range(NUM_BONES)):
        raise RigError(f"kintree_table numbers the bones {bones}, expected 0 to {NUM_BONES - 1}")
    if parents[0] not in _ROOTS:
        raise RigError(f"kintree_table: bone 0 hangs on bone {parents[0]}, expected none")
    for bone in range(1, NUM_BONES):
        if not 0 <= parents[bone] < bone:
            raise RigError(
                f"kintree_table is no tree: bone {bone} hangs on {parents[bone]}, "
                "expected a bone before it"
            )
        if parents[bone] != BONE_PARENTS[bone]:
            raise RigError(
                f"kintree_table: bone {bone} hangs on {parents[bone]}, expected "
                f"{BONE_PARENTS[bone]} as in MANO"
            )


def _side(arrays: dict[str, np.ndarray]) -> Side:
    """Which hand it is, by where its fingers point."""
    wrist = arrays["J_regressor"][0] @ arrays["v_template"]
    tips = {name: arrays["v_template"][vertex] - wrist for name, vertex in FINGERTIPS.items()}
    owners = {name: int(arrays["weights"][vertex].argmax()) for name, vertex in FINGERTIPS.items()}
    strangers = [name for name, owner in owners.items() if owner != FINGER_BONES[name][2]]
    if strangers:
        raise RigError(
            f"vertex {FINGERTIPS[strangers[0]]} is not the tip of the {strangers[0]}: it moves "
            f"with bone {owners[strangers[0]]}; the vertices are not in MANO's order"
        )
    length = float(np.abs(tips["middle"][0]))
    if not 0.1 < length < 0.3 or tips["thumb"][2] <= tips["little"][2]:
        raise RigError(
            f"the middle fingertip lies {tips['middle'].round(3).tolist()} from the wrist and the "
            "thumb not on the +z side; expected metres in MANO's axes"
        )
    return "right" if tips["middle"][0] < 0 else "left"


def _treatment(arrays: dict[str, np.ndarray]) -> LeftShape:
    """Whether a left hand's shape directions are to be mirrored."""
    return "kept" if growth_agreement(arrays["v_template"], arrays["shapedirs"]) > 0 else "mirrored"


def growth_agreement(
    template: Float[np.ndarray, "vertices 3"], directions: Float[np.ndarray, "vertices 3 shapes"]
) -> float:
    """Whether shape coefficients lengthen a hand as they widen and thicken it, in [-1, 1].

    The largest differences between hands are of size, so the sum over the coefficients, weighted
    by how much each does, is positive; with the sign of x wrong in all of them it is negative.
    """
    centred = template - template.mean(0)
    # Slope of each component of the displacement along its own axis: relative growth.
    growth = np.einsum("vc,vcs->cs", centred, directions) / (centred**2).sum(0)[:, None]
    products = growth[0] * (growth[1] + growth[2])
    return float(products.sum() / max(np.abs(products).sum(), 1e-12))


def _mirrored(arrays: dict[str, np.ndarray], mirrors_shape: bool) -> dict[str, np.ndarray]:
    """The right hand that is a left one's mirror image in x.

    A rotation R becomes M R M with M = diag(-1, 1, 1): of an axis-angle, y and z change sign.
    """
    sign = np.array([-1.0, 1.0, 1.0])
    rotated = -sign
    features = np.tile(np.outer(sign, sign).ravel(), NUM_BONES - 1)
    shape = arrays["shapedirs"] * (sign[:, None] if mirrors_shape else 1)
    return arrays | {
        "v_template": arrays["v_template"] * sign,
        # Of the file's directions first mended, if they need it, then mirrored as all else.
        "shapedirs": shape * sign[:, None],
        "posedirs": arrays["posedirs"] * sign[:, None] * features,
        "hands_mean": arrays["hands_mean"] * np.tile(rotated, NUM_BONES - 1),
        "hands_components": arrays["hands_components"] * np.tile(rotated, NUM_BONES - 1),
    }


def _rig(name: str, arrays: dict[str, np.ndarray]) -> Rig:
    template = arrays["v_template"]
    joints = arrays["J_regressor"] @ template
    faces = _wound_outwards(template - joints[0], arrays["f"].astype(np.int64))
    coordinates, corners = _two_sided_chart(template, faces)
    rig = Rig(
        name=name,
        template_vertices=_tensor(template),
        faces=torch.from_numpy(faces),
        skin_weights=_tensor(arrays["weights"]),
        joint_regressor=_tensor(arrays["J_regressor"]),
        shape_directions=_tensor(arrays["shapedirs"]),
        uv_coordinates=_tensor(coordinates),
        uv_faces=torch.from_numpy(corners),
        joint_axes=_tensor(_joint_axes(joints, template)),
        vertex_sets={"fingertips": torch.tensor(list(FINGERTIPS.values()))},
        pose_directions=_tensor(arrays["posedirs"]),
        is_licensed=True,
    )
    owners = set(rig.skin_weights.argmax(-1).tolist())
    if len(owners) < NUM_BONES:
        idle = sorted(set(range(NUM_BONES)) - owners)
        raise RigError(f"weights: bones {idle} move no vertex more than other bones do")
    _check_rim(rig)
    return rig


def _wound_outwards(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces counter-clockwise seen from outside; mirroring turns them round.

    Args:
        vertices: from the wrist, whose missing faces then hold next to no volume.
        faces: all of them wound alike.
    """
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    volume = (first * np.cross(second, third)).sum()
    return faces if volume > 0 else np.ascontiguousarray(faces[:, ::-1])


def _check_rim(rig: Rig) -> None:
    try:
        found = len(rig.rim)
    except (KeyError, ValueError) as error:
        raise RigError(f"f: {error}") from error
    if found != _RIM:
        raise RigError(f"f: the wrist has a rim of {found} edges, expected {_RIM}")


def _joint_axes(joints: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Flexion, abduction and twist of every bone, rest axes.

    Twist is the bone's own direction; abduction is the open hand's, made perpendicular to it,
    since both hands lie flat in the same axes; flexion is perpendicular to both.
    """
    axes = load_open_hand().joint_axes.double().numpy().copy()
    for finger, chain in FINGER_BONES.items():
        points = [*joints[list(chain)], template[FINGERTIPS[finger]]]
        for step, bone in enumerate(chain):
            along = _unit(points[step + 1] - points[step])
            dorsal = _unit(axes[bone, 1] - (axes[bone, 1] @ along) * along)
            axes[bone] = np.cross(dorsal, along), dorsal, along
    return axes


def _two_sided_chart(template: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A texture chart: the back of the hand seen from above on the left, the palm on the right.

    Every vertex has a place on both halves. Where the surface stands upright the chart is thin.
    """
    low, size = template.min(0), np.ptp(template, axis=0).max()
    flat = 0.02 + 0.46 * (template[:, [2, 0]] - low[[2, 0]]) / size
    coordinates = np.concatenate([flat, flat + np.array([0.5, 0.0])])
    first, second, third = (template[faces[:, corner]] for corner in range(3))
    is_palm = np.cross(second - first, third - first)[:, 1] < 0
    return coordinates, faces + len(template) * is_palm[:, None]


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        raise RigError("two joints lie on top of each other")
    return vector / length


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
