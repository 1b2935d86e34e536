"""Surfaces as PLY and Wavefront OBJ, which hold one pose and no bones."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.colors import eight_bits


class ObjFiles(NamedTuple):
    """The two texts of an OBJ; the picture that they name is the third file."""

    mesh: bytes
    material: bytes


def ply_bytes(
    vertices: Float[Tensor, "vertices 3"],
    normals: Float[Tensor, "vertices 3"],
    colors: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    comments: tuple[str, ...] = (),
) -> bytes:
    """A binary PLY with a colour per vertex.

    Args:
        vertices: metres.
        normals: unit, outwards.
        colors: sRGB in [0, 1], stored with 8 bits.
        faces: counter-clockwise seen from outside.
        comments: lines for the header.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    rows = np.empty(len(vertices), dtype=[("at", "<f4", 6), ("color", "u1", 3)])
    rows["at"] = torch.cat([vertices, normals], dim=-1).numpy()
    rows["color"] = eight_bits(colors).numpy()
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    corners["count"] = 3
    corners["corners"] = faces.numpy()
    return ("\n".join(header) + "\n").encode() + rows.tobytes() + corners.tobytes()


def obj_bytes(
    vertices: Float[Tensor, "vertices 3"],
    normals: Float[Tensor, "vertices 3"],
    places: Float[Tensor, "places 2"],
    faces: Int[Tensor, "faces 3"],
    place_faces: Int[Tensor, "faces 3"],
    stem: str,
) -> ObjFiles:
    """An OBJ with its material; the texture is expected as ``STEM.png`` beside them.

    Args:
        vertices: metres.
        normals: unit, outwards, one a vertex.
        places: texture coordinates, (0, 0) the upper left corner of the picture; OBJ counts v
            from below.
        faces: counter-clockwise seen from outside.
        place_faces: for each face corner, its texture coordinate.
        stem: of the three files' names.
    """
    upright = torch.stack([places[:, 0], 1 - places[:, 1]], dim=-1)
    lines = ["# metres, +y up", f"mtllib {stem}.mtl", "o hand"]
    for word, rows in (("v", vertices), ("vt", upright), ("vn", normals)):
        lines += [f"{word} " + " ".join(f"{value:.7g}" for value in row) for row in rows.tolist()]
    lines.append("usemtl skin")
    for corners, where in zip((faces + 1).tolist(), (place_faces + 1).tolist(), strict=True):
        pairs = zip(corners, where, strict=True)
        lines.append("f " + " ".join(f"{corner}/{place}/{corner}" for corner, place in pairs))
    material = f"newmtl skin\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {stem}.png\n"
    return ObjFiles(("\n".join(lines) + "\n").encode(), material.encode())
