"""Draws a held-out pose to the picture's texture, with the avatar frozen: protocol ``registered``.

The avatar is rendered once, at the pose to start from, which tells how each point of the skin looks
there. The one fit (:mod:`fit`) then lays the hand onto outline and texture of the picture.
"""

import math

import torch

from handavatar.avatar import HandAvatar, Rendering
from handavatar.capture.frames import Frame
from handavatar.capture.registration import observe_frame
from handavatar.edit import Edit
from handavatar.fit.energy import EnergyOptions
from handavatar.fit.kinematics import NUM_UNKNOWNS
from handavatar.fit.pictures import FramePicture
from handavatar.fit.register import RegisterOptions, follow_picture
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import ShapedHand

# Expected errors of the pose to start from: radians of a joint about each axis; metres
# across and along the line of sight. Half a pixel by which outlines of avatar and picture differ
# all around would move the hand by millimetres along it: it stays where outlines have put it.
_ROTATION_ERROR = math.radians(3) / 3**0.5
_TRANSLATION_ERROR = (0.003, 0.003, 0.0005)
# Of independent observations in each blurred pixel. With more, as much as videos have, the texture
# draws hands off their outlines.
_TEXTURE_SHARE = 0.5


@torch.no_grad()
def registered_pose(
    avatar: HandAvatar, frame: Frame, pose: HandPose, rendering: Rendering | None = None
) -> HandPose:
    """The pose by which the avatar agrees best with a picture's outline and texture.

    Args:
        avatar: stays as it is.
        frame: the picture, and what of it is known; its own pose is not asked.
        pose: to start from.
        rendering: of the avatar in this pose, from the frame's camera; made if None, or if it is
            larger than pictures are compared.
    """
    seen = observe_frame(frame)
    if rendering is None or rendering.alpha.shape != seen.picture.known.shape:
        rendering = avatar.render(pose, seen.picture.camera, Edit(light=frame.clip))
    start = pose.to("cpu")
    shown = FramePicture.of(
        seen.picture.camera,
        rendering.color.cpu(),
        rendering.alpha.cpu(),
        torch.ones_like(seen.picture.known),
        torch.ones(3),
    )
    view = frame.camera.camera_from_world[:3, :3].cpu()
    information = torch.eye(NUM_UNKNOWNS) / _ROTATION_ERROR**2
    information[-3:, -3:] = view.T @ torch.diag(torch.tensor(_TRANSLATION_ERROR) ** -2) @ view
    options = RegisterOptions(energy=EnergyOptions(texture_share=_TEXTURE_SHARE))
    followed = follow_picture(
        fitted_hand(avatar, pose),
        seen,
        shown,
        start,
        information,
        options,
    )
    return followed.to(pose.rotations.device)


def fitted_hand(avatar: HandAvatar, pose: HandPose) -> ShapedHand:
    """The avatar's coarse rest hand as a fit takes it: with what this pose adds, on the CPU.

    Args:
        avatar: whose shape it is.
        pose: that decides the offsets of the skin.
    """
    hand = avatar.coarse_personal(pose.to(avatar.device))
    # A rig that stays where it is stays the same object: what a fit has found of it is kept.
    rig = hand.rig.to("cpu") if avatar.device.type != "cpu" else hand.rig
    return ShapedHand(rig, hand.rest_vertices.cpu(), hand.rest_joints.cpu())
