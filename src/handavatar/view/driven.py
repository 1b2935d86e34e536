"""An avatar that follows a hand before a camera: its picture from the baked mesh."""

import copy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8

from handavatar.avatar import HandAvatar
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.geometry.colors import eight_bits
from handavatar.geometry.rotations import invert_rigid
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import ShapedHand
from handavatar.jobs.threads import one_thread
from handavatar.view.baked import BakedAvatar
from handavatar.webcam.posing import LivePose

LONGER_SIDE = 320
"""Pixels of the picture along its longer side."""
_LIT_EVERY = 4
"""Pictures from one new light to the next: half of a picture's time would go into it."""


class DrivenAvatar:
    """An avatar in the poses of a hand before a camera; for one thread at a time."""

    def __init__(self, avatar: HandAvatar) -> None:
        """Bakes the skin's colour.

        Args:
            avatar: read only; its own edit is applied.
        """
        view = avatar.view()
        self._baked = BakedAvatar(copy.copy(avatar), start_of(view))
        self._camera_from_world = (
            torch.eye(4) if view is None else torch.tensor(view["camera_from_world"])
        )
        self._world_from_camera = invert_rigid(self._camera_from_world)
        self._lit: HandPose | None = None
        self._pictures = 0
        self.hand: ShapedHand = avatar.base_rig.to("cpu").shaped(avatar.coefficients.cpu())

    @one_thread()
    @torch.no_grad()
    def picture(
        self, live: LivePose, is_left: bool, longer_side: int = LONGER_SIDE
    ) -> UInt8[np.ndarray, "height width 3"]:
        """What the camera would see of the avatar: a left hand if a left one is before it.

        Args:
            live: of :attr:`hand`.
            is_left: whether the hand before the camera is a left one.
            longer_side: of the picture, pixels.
        """
        camera = live.camera
        scale = longer_side / max(camera.width, camera.height)
        camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
        # Light belongs to the world of the avatar's capture: the camera stands where it stood.
        pose = live.pose.moved_to(self._world_from_camera, self.hand.rest_joints[0])
        camera = replace(camera, camera_from_world=self._camera_from_world)
        if self._lit is None or self._pictures % _LIT_EVERY == 0:
            self._lit = pose
        self._pictures += 1
        rendering = self._baked.render(pose, camera, Edit(), self._lit)
        pixels = eight_bits(rendering.color.cpu()).numpy()
        return np.ascontiguousarray(pixels[:, ::-1]) if is_left else pixels
