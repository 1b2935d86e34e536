"""Which skin an avatar guesses, since no training frame saw it: in figures and in pictures."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from handavatar.animate import camera_on, orbited
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import middle_of_hand
from handavatar.capture.seen_skin import unseen_regions
from handavatar.capture.view import start_of
from handavatar.evaluate.report import picture
from handavatar.field.anchors import nearest_anchors
from handavatar.render.shaded import shaded_mesh
from handavatar.retouch import tint_unseen

VIEWS = ("as in the video", "from the right", "from behind", "from the left")
"""Where the camera stands, a quarter of a turn apart."""
_ROOM = 0.6
_SKIN = 0.8


def unseen_figures(avatar: HandAvatar) -> dict[str, Any] | None:
    """``share`` of the skin that no training frame saw, and ``regions`` of which most was not.

    Both in [0, 1]; None if the avatar does not know.
    """
    if avatar.seen_frames is None:
        return None
    unseen = (avatar.seen_frames == 0).float().cpu()
    # Anchors are spread evenly, so each stands for the same area.
    corners = avatar.anchor_corners[:, 0].cpu()
    nothing = unseen.new_zeros(avatar.rig.num_vertices)
    area = nothing.index_add(0, corners, torch.ones_like(unseen))
    regions = unseen_regions(avatar.rig.to("cpu"), area, nothing.index_add(0, corners, unseen))
    return {"share": round(float(unseen.mean()), 4), "regions": regions}


@torch.no_grad()
def unseen_pictures(avatar: HandAvatar, size: int) -> dict[str, UInt8[np.ndarray, "size size 3"]]:
    """The avatar's mesh in the first pose of pages, unseen skin violet, from the four ``VIEWS``.

    Args:
        avatar: that knows what was seen.
        size: pixels along a side.
    """
    pose = start_of(avatar.view())
    camera = camera_on(avatar, [pose], size, _ROOM)
    middle = middle_of_hand(avatar.base_rig.to("cpu"), pose)
    template = avatar.rig.template_vertices
    neighbours = nearest_anchors(avatar.anchors.positions(template), template)
    colors = tint_unseen(avatar).painted(torch.full_like(template, _SKIN), neighbours)
    pose = pose.to(avatar.device)
    vertices = avatar.personal(pose).posed(pose).vertices
    is_left = avatar.info.get("side") == "left"
    turn = math.pi / 2 if is_left else -math.pi / 2
    pictures = {}
    for number, name in enumerate(VIEWS):
        seen_from = orbited(camera, middle, number * turn).to(avatar.device)
        shaded = shaded_mesh(vertices, avatar.rig.faces, seen_from, colors=colors)
        pictures[name] = picture(shaded.flip(1) if is_left else shaded)
    return pictures
