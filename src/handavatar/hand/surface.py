"""The mesh of a posed hand's occupancy: which box, which seeds, and an even cut at the wrist."""

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.extraction import ExtractedSurface, Field, extract_surface, logits_of
from handavatar.geometry.rotations import apply_rigid, invert_rigid
from handavatar.hand.parts import PartBoxes
from handavatar.hand.rig import PosedHand

CUT_SLOPE = 1000.0
"""Logits per metre at the wrist's cut: a few per voxel, as the field has at the skin."""

CORRECTIONS = 2
"""A decoder's logits bend within a voxel of a millimetre: uncorrected, smooth skin has terraces."""


def extract_hand(
    occupancy_of: Field, boxes: PartBoxes, posed: PosedHand, resolution: int = 256
) -> ExtractedSurface:
    """The closed surface of an occupancy field around a posed hand.

    The box is that of the posed vertices, padded as the authors pad it; its longest side has
    ``resolution`` cells. The vertices are seeds: no finger is too thin for the coarse grid. The
    field ends at the plane that cuts the wrist, where it jumps to nothing; here it is continued
    evenly beyond the plane, so that the mesh ends in a flat face and not in stairs.

    Args:
        occupancy_of: occupancy in [0, 1] at world points, metres, surface at 0.5.
        boxes: of the same posed hand; only the wrist's cut is used.
        posed: the hand; its vertices must be finite.
        resolution: best a power of two.

    Raises:
        ValueError: vertices or occupancies that are not finite.
    """
    vertices = posed.sealed_vertices.detach()
    lower, upper = vertices.amin(0), vertices.amax(0)
    # The authors' box: 1.1 times the longest side of the posed vertices.
    padding = 0.05 * (upper - lower).max()
    wrist_from_world = boxes.bone_from_world[0]
    world_from_wrist = invert_rigid(wrist_from_world)
    point = apply_rigid(world_from_wrist, boxes.cut_point[None])[0]
    normal = world_from_wrist[:3, :3] @ boxes.cut_normal
    logits = logits_of(occupancy_of)

    def values_of(points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        beyond = (points - point) @ normal
        # A hair before the plane, where the field still answers.
        answered = points - (beyond + 1e-5).clamp_min(0)[:, None] * normal
        return torch.minimum(logits(answered), -CUT_SLOPE * beyond)

    return extract_surface(
        values_of,
        lower - padding,
        upper + padding,
        resolution,
        seeds=vertices,
        corrections=CORRECTIONS,
    )
