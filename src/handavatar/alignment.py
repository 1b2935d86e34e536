"""Fits the pose of a held-out frame to its mask, never to its colours."""

import torch
from jaxtyping import Bool
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.geometry.cameras import Camera
from handavatar.hand.pose import HandPose
from handavatar.render.silhouette import resized_mask, silhouette_loss, soft_silhouette


def aligned_pose(
    avatar: HandAvatar,
    pose: HandPose,
    camera: Camera,
    mask: Bool[Tensor, "height width"],
    steps: int = 20,
    size: int = 192,
) -> HandPose:
    """A pose, moved a little so that the personal mesh covers the frame's mask.

    Training corrects the poses of its own frames; held-out frames get the same chance here, with
    nothing but the outline to go by.

    Args:
        avatar: whose mesh is fitted; it is not changed.
        pose: to start from.
        camera: of the frame.
        mask: of the frame.
        steps: of gradient descent.
        size: pixels along a side of the compared masks.
    """
    device = avatar.device
    pose = pose.to(device)
    camera = camera.to(device).resized(size, size)
    small_mask = resized_mask(mask, size).to(device)
    with torch.no_grad():
        rest = avatar.personal(pose)
    change = torch.zeros_like(pose.rotations, requires_grad=True)
    shift = torch.zeros_like(pose.translation, requires_grad=True)
    optimizer = torch.optim.Adam(
        [{"params": [change], "lr": 0.01}, {"params": [shift], "lr": 1e-3}]
    )
    best, best_value = pose, float("inf")
    with torch.enable_grad():
        for _ in range(steps + 1):
            trial = HandPose(pose.rotations + change, pose.translation + shift)
            coverage = soft_silhouette(rest.posed(trial).vertices, avatar.rig.faces, camera)
            loss = silhouette_loss(coverage, small_mask)
            # Keeps the pose plausible: an outline alone says little of what lies within it.
            loss = loss + 0.1 * change.square().sum() + 100 * shift.square().sum()
            if float(loss.detach()) < best_value:
                best_value = float(loss.detach())
                best = HandPose(trial.rotations.detach(), trial.translation.detach())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return best
