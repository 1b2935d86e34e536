"""The high-resolution rig ("MANO-HD"): midpoint subdivision that carries everything."""

from dataclasses import replace

import torch

from handavatar.geometry.meshes import Subdivision, subdivide_midpoint
from handavatar.hand.rig import Rig


def subdivided(rig: Rig, rounds: int = 2) -> Rig:
    """A finer rig: template, weights, blend shapes and UV at edge midpoints.

    Old vertices keep their indices; the joint regressor gets zero columns for the new ones, so
    joints stay where they were.

    Args:
        rig: any rig.
        rounds: each multiplies the faces by four; the paper uses two.

    Source: paper Sec. 3.1. Refined skinning weights are another step (appendix A).
    """
    for _ in range(rounds):
        rig = _subdivided_once(rig)
    return rig


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
