"""The high-resolution rig ("MANO-HD"): midpoint subdivision that carries everything."""

from dataclasses import replace
from importlib import resources
from pathlib import Path

import torch

from handavatar.geometry.meshes import Subdivision, subdivide_midpoint
from handavatar.hand.rig import Rig, RigError
from handavatar.hand.sparse_skin import SparseSkin

_MAX_FACES = 1_000_000
"""Of a subdivided rig: 4 rounds of the open hand are 0.8 million, and each takes 1 kB and more."""
_SHIPPED = ("skin_full_2.safetensors", "skin_778_2.safetensors")
"""Made with ``handavatar rig refine --level full`` and ``--level 778``."""


def subdivided(rig: Rig, rounds: int = 2) -> Rig:
    """A finer rig: template, weights, blend shapes and UV at edge midpoints.

    Old vertices keep their indices; the joint regressor gets zero columns for the new ones, so
    joints stay where they were.

    Args:
        rig: any rig.
        rounds: each multiplies the faces by four; the paper uses two.

    Raises:
        RigError: there would be more than a million faces.

    Source: paper Sec. 3.1. Refined skinning weights are another step: :func:`refined`.
    """
    faces = len(rig.faces)
    # Beyond 16 rounds the very number is not worth working out.
    if not 0 <= rounds <= 16 or faces * 4**rounds > _MAX_FACES:
        raise RigError(
            f"{rounds} rounds of subdivision make more than {_MAX_FACES:,} faces of {faces:,} of "
            f"{rig.name}\nthe method takes 2"
        )
    for _ in range(rounds):
        rig = _subdivided_once(rig)
    return rig


def refined(rig: Rig, rounds: int = 2, file: Path | None = None, fine: Rig | None = None) -> Rig:
    """A finer rig with refined skinning weights, at most four bones per vertex.

    Without ``file`` it takes the weights that ship for this very rig and number of rounds; where
    none do, it is :func:`subdivided`, with averaged weights.

    Args:
        rig: any rig.
        rounds: midpoint subdivisions.
        file: weights written by ``handavatar rig refine``.
        fine: the subdivided rig, where it is at hand.

    Raises:
        RigError: if the file is damaged or was made for another rig.

    Source: paper appendix A, optimization of MANO-HD.
    """
    fine = fine or subdivided(rig, rounds)
    if file is not None:
        skin = SparseSkin.load(file)
        if not skin.fits(rig, rounds):
            raise RigError(
                f"{file}: made for a rig with fingerprint {skin.rig_sha256[:12]} and "
                f"{skin.rounds} rounds, expected {rig.sha256[:12]} ({rig.name}) and {rounds}; "
                "make them with `handavatar rig refine`"
            )
        if len(skin.bones) != fine.num_vertices:
            raise RigError(
                f"{file}: weights of {len(skin.bones)} vertices, expected {fine.num_vertices}; "
                "make them again with `handavatar rig refine`"
            )
        return replace(fine, skin_weights=skin.dense().to(fine.skin_weights))
    for name in _SHIPPED:
        with resources.as_file(resources.files("handavatar") / "assets" / name) as path:
            skin = SparseSkin.load(path)
        if skin.fits(rig, rounds):
            return replace(fine, skin_weights=skin.dense().to(fine.skin_weights))
    return fine


def _subdivided_once(rig: Rig) -> Rig:
    mesh = subdivide_midpoint(rig.faces, rig.num_vertices)
    texture = subdivide_midpoint(rig.uv_faces, len(rig.uv_coordinates))
    num_new = len(mesh.edges)
    padding = rig.joint_regressor.new_zeros(len(rig.joint_regressor), num_new)
    return replace(
        rig,
        template_vertices=mesh.carried(rig.template_vertices),
        faces=mesh.faces,
        skin_weights=mesh.carried(rig.skin_weights),
        joint_regressor=torch.cat([rig.joint_regressor, padding], dim=1),
        shape_directions=mesh.carried(rig.shape_directions),
        pose_directions=mesh.carried(rig.pose_directions),
        uv_coordinates=texture.carried(rig.uv_coordinates),
        uv_faces=texture.faces,
        vertex_sets={name: _carried_set(mesh, s, rig) for name, s in rig.vertex_sets.items()},
    )


def _carried_set(mesh: Subdivision, members: torch.Tensor, rig: Rig) -> torch.Tensor:
    """A midpoint belongs to a set if both its ends do."""
    is_member = torch.zeros(rig.num_vertices, dtype=torch.bool, device=members.device)
    is_member[members] = True
    joined = is_member[mesh.edges].all(-1).nonzero()[:, 0] + rig.num_vertices
    return torch.cat([members, joined])
