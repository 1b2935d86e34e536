"""``handavatar rig``: facts of a rig."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class _InfoOptions:
    """Prints the facts of the open hand.

    Attributes:
        level: ``full`` is the default rig, ``778`` the one of MANO's size.
    """

    level: Literal["full", "778"] = "full"


def info(words: list[str]) -> int:
    """Facts of the shipped rig: counts, size, fingerprint."""
    from handavatar.cli.arguments import JSON, parse_with, print_figures, print_json
    from handavatar.hand.detail import subdivided
    from handavatar.hand.open_hand import load_open_hand

    options, extras = parse_with(_InfoOptions, (JSON,), words, "rig info")
    rig = load_open_hand(options.level)
    fine = subdivided(rig)
    extent = rig.template_vertices.amax(0) - rig.template_vertices.amin(0)
    facts = {
        "name": rig.name,
        "vertices": rig.num_vertices,
        "faces": len(rig.faces),
        "bones": rig.skin_weights.shape[1],
        "shape_directions": rig.shape_directions.shape[-1],
        "size_metres": [round(value, 4) for value in extent.tolist()],
        "vertex_sets": {name: len(members) for name, members in rig.vertex_sets.items()},
        "high_resolution": {"vertices": fine.num_vertices, "faces": len(fine.faces)},
        "sha256": rig.sha256,
    }
    (print_json if extras["json"] else print_figures)(facts)
    return 0
