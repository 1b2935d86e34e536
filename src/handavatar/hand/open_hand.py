"""The open hand: the default rig, shipped with the package under open licences.

Made by ``scripts/build_open_hand.py``; where it comes from stands in ``assets/NOTICE.md``.
"""

import json
from importlib import resources
from typing import Literal

from safetensors import torch as safetensors_torch

from handavatar.hand.rig import Rig, RigError

Level = Literal["full", "778"]

_FILES: dict[Level, str] = {"full": "open_hand.safetensors", "778": "open_hand_778.safetensors"}
_SET_PREFIX = "set_"


def load_open_hand(level: Level = "full") -> Rig:
    """Reads the open hand.

    Args:
        level: ``full`` has 1609 vertices with modelled nails and creases; ``778`` is thinned to
            MANO's size, so that two midpoint subdivisions give the paper's 12,337 vertices.

    Both levels share joints, shape coefficients and texture chart. One unit of a shape coefficient
    is one standard deviation of an adult population: 0 size, 1 finger length, 2 thickness,
    3 wrist girth, 4 finger spread, 5 to 9 what remains, by decreasing variance.

    Raises:
        RigError: unknown level, or the package was installed without its assets.
    """
    if level not in _FILES:
        raise RigError(f"open hand: found level {level!r}, expected one of {sorted(_FILES)}")
    asset = resources.files("handavatar") / "assets" / _FILES[level]
    try:
        content = asset.read_bytes()
    except FileNotFoundError as error:
        raise RigError(f"open hand: {asset} is missing; install handavatar again") from error
    arrays = safetensors_torch.load(content)
    return Rig(
        name=_metadata(content)["name"],
        template_vertices=arrays["template_vertices"],
        faces=arrays["faces"],
        skin_weights=arrays["skin_weights"],
        joint_regressor=arrays["joint_regressor"],
        shape_directions=arrays["shape_directions"],
        uv_coordinates=arrays["uv_coordinates"],
        uv_faces=arrays["uv_faces"],
        joint_axes=arrays["joint_axes"],
        vertex_sets={
            name.removeprefix(_SET_PREFIX): indices
            for name, indices in arrays.items()
            if name.startswith(_SET_PREFIX)
        },
    )


def _metadata(content: bytes) -> dict[str, str]:
    """Name, version, licence and source out of the file's header."""
    header_size = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + header_size])["__metadata__"]
