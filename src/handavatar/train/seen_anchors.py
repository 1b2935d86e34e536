"""What skin the training frames have seen: what none has, the avatar guesses."""

from collections.abc import Sequence

import torch

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.capture.seen_skin import seen_vertices
from handavatar.geometry.meshes import carried_to_fine, subdivision_levels


@torch.no_grad()
def count_seen_anchors(avatar: HandAvatar, frames: Sequence[Frame]) -> None:
    """Sets the avatar's ``seen_frames``: how many frames see each anchor from the front, unhidden.

    The mesh before subdivision is asked; an anchor counts as seen where most of what surrounds it
    is.

    Args:
        avatar: trained; its personal hand decides what hides what.
        frames: with their poses as training has corrected them.
    """
    base = avatar.base_rig
    levels = subdivision_levels(base.faces, base.num_vertices, avatar.rounds)
    counts = torch.zeros(len(avatar.anchor_corners), dtype=torch.int32, device=avatar.device)
    for frame in frames:
        pose = frame.pose.to(avatar.device)
        vertices = avatar.coarse_personal(pose).posed(pose).vertices
        seen = seen_vertices(vertices, base.faces, frame.camera, frame.known).to(vertices)
        share = avatar.anchors.positions(carried_to_fine(seen[:, None], levels))[:, 0]
        counts += (share > 0.5).int()
    avatar.seen_frames = counts
