"""Files laid out as MANO's, made of the open hand and random pose blend shapes.

Python 2 wrote the real files: text and bytes were one type there. ``Python2Pickler`` writes so.
Classes are named as the real files name them, through modules that exist only while writing.
"""

import io
import pickle
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from scipy import sparse

from handavatar.hand.mano import FINGERTIPS
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import BONE_PARENTS

MIRROR = np.array([-1.0, 1.0, 1.0])


class Ch:
    """As chumpy's variable: its state is a dictionary, its value ``x``."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


class Select(Ch):
    """As chumpy's choice of elements."""


class csc_matrix:
    """As scipy's under its old module path."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        self.__dict__.update(
            _shape=matrix.shape,
            indices=matrix.indices,
            indptr=matrix.indptr,
            data=matrix.data,
            maxprint=50,
        )


_OLD_PLACES = {Ch: "chumpy.ch", Select: "chumpy.reordering", csc_matrix: "scipy.sparse.csc"}


@contextmanager
def old_modules() -> Iterator[None]:
    """Lets the pickler find the classes where the real files say they are."""
    before = {name: sys.modules.get(name) for name in ["chumpy", *_OLD_PLACES.values()]}
    places = {kind: kind.__module__ for kind in _OLD_PLACES}
    try:
        for name in before:
            sys.modules[name] = types.ModuleType(name)
        for kind, name in _OLD_PLACES.items():
            setattr(sys.modules[name], kind.__name__, kind)
            kind.__module__ = name
        yield
    finally:
        for kind, place in places.items():
            kind.__module__ = place
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


class Python2Pickler(pickle._Pickler):  # type: ignore[name-defined]
    """Writes text and bytes as Python 2 did: as one kind of string."""

    dispatch: ClassVar[dict[type, Any]] = dict(pickle._Pickler.dispatch)  # type: ignore[attr-defined]

    def save_old_string(self, value: str | bytes) -> None:
        raw = value.encode("latin-1") if isinstance(value, str) else value
        if self.proto == 0:
            escaped = "".join(
                chr(byte) if 32 <= byte < 127 and byte not in b"'\\" else f"\\x{byte:02x}"
                for byte in raw
            )
            self.write(b"S'" + escaped.encode("ascii") + b"'\n")
        elif len(raw) < 256:
            self.write(b"U" + bytes([len(raw)]) + raw)
        else:
            self.write(b"T" + len(raw).to_bytes(4, "little") + raw)
        self.memoize(value)

    dispatch[str] = save_old_string
    dispatch[bytes] = save_old_string


def python2_pickle(value: Any, protocol: int = 2) -> bytes:
    """As Python 2 would have written it, with numpy's and scipy's names of that time."""
    file = io.BytesIO()
    with old_modules():
        Python2Pickler(file, protocol, fix_imports=True).dump(value)
    # Numpy 2 calls its core _core; the old name is shorter, and names are not counted by length.
    return file.getvalue().replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def hand_fields(side: str = "right", seed: int = 0, has_flaw: bool = True) -> dict[str, Any]:
    """Plain arrays by MANO's names, the tips of the fingers where MANO has them.

    Args:
        side: ``left`` gives the mirror image.
        seed: of the pose blend shapes and the mean pose.
        has_flaw: a left hand with the right one's shape directions, as it was released.
    """
    rig = load_open_hand("778")
    order = np.arange(778)
    for tip, place in zip(rig.vertex_sets["fingertips"].tolist(), FINGERTIPS.values(), strict=True):
        here = int(np.flatnonzero(order == tip)[0])
        order[[here, place]] = order[[place, here]]
    renamed = np.argsort(order)
    random = np.random.default_rng(seed)
    fields: dict[str, Any] = {
        "v_template": rig.template_vertices.double().numpy()[order] + [0.0957, 0.0064, 0.0062],
        "shapedirs": rig.shape_directions.double().numpy()[order],
        "posedirs": 1e-3 * random.standard_normal((778, 3, 135)),
        "J_regressor": rig.joint_regressor.double().numpy()[:, order],
        "weights": rig.skin_weights.double().numpy()[order],
        "f": renamed[rig.faces.numpy()].astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *BONE_PARENTS[1:]], range(16)], dtype=np.uint32),
        "hands_mean": 0.2 * random.standard_normal(45),
        "hands_components": np.linalg.qr(random.standard_normal((45, 45)))[0],
    }
    return mirrored_fields(fields, has_flaw) if side == "left" else fields


def mirrored_fields(fields: dict[str, Any], has_flaw: bool) -> dict[str, Any]:
    """The other hand: displacements mirror in x, rotation matrices on both sides of them."""
    pairs = np.array([MIRROR[row] * MIRROR[column] for row in range(3) for column in range(3)])
    rotation = np.tile([1.0, -1.0, -1.0], 15)
    return fields | {
        "v_template": fields["v_template"] * MIRROR,
        "shapedirs": fields["shapedirs"] * (1 if has_flaw else MIRROR[:, None]),
        "posedirs": fields["posedirs"] * MIRROR[:, None] * np.tile(pairs, 15),
        "f": fields["f"][:, ::-1].copy(),
        "hands_mean": fields["hands_mean"] * rotation,
        "hands_components": fields["hands_components"] * rotation,
    }


def as_released(fields: dict[str, Any]) -> dict[str, Any]:
    """The same with chumpy's and scipy's objects, and what else the real file holds."""
    random = np.random.default_rng(9)
    wide = np.concatenate([fields["shapedirs"], random.standard_normal((778, 3, 10))], axis=-1)
    places = np.arange(wide.size).reshape(wide.shape)[:, :, :10].ravel()
    habits = {
        "_dirty_vars": {"x"},
        "_itr": None,
        "_depends_on_deps": {},
        "_make_dense": False,
        "_status": "new",
    }
    variable = Ch(x=wide, **habits)
    regressor = sparse.csc_matrix(np.asarray(fields["J_regressor"]))
    return fields | {
        "shapedirs": Select(a=variable, idxs=places, preferred_shape=(778, 3, 10), **habits),
        "posedirs": Ch(x=np.asfortranarray(fields["posedirs"]), **habits),
        "J_regressor": csc_matrix(regressor),
        "hands_coeffs": random.standard_normal((20, 45)),
        "J": np.asarray(fields["J_regressor"]) @ np.asarray(fields["v_template"]),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
    }


def write_mano(path: Path, side: str = "right", protocol: int = 2, **changes: Any) -> Path:
    """A file laid out as ``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl``.

    Args:
        path: to write.
        side: of the hand.
        protocol: of Python 2.
        changes: fields that replace others; None takes the field away.
    """
    fields = as_released(hand_fields(side)) | changes
    fields = {name: value for name, value in fields.items() if value is not None}
    path.write_bytes(python2_pickle(fields, protocol))
    return path


def as_tensor(values: Any) -> torch.Tensor:
    """Single precision, as a rig has it."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
