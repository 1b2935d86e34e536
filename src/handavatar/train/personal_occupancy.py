"""After the outlines, before the first step: the prior's decoder learns this person's hand.

The prior knows hands of the rig's shapes; of a person's own it misses the surface by half a
millimetre, which is half a pixel of the outline. Points around the personal mesh, whose inside is
known, tell it more for the same time than rays do.
"""

import math

import torch

from handavatar.avatar import HandAvatar
from handavatar.geometry.meshes import is_inside
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand
from handavatar.train.labelled_poses import LabelledPose, training_points
from handavatar.train.pretraining import OccupancyLoss, learning_rate, prior_optimizers, set_rate
from handavatar.train.progress import Progress
from handavatar.train.stage_times import StageTimes

_POINTS = 2048
_RATE = 1e-3
_LAST_RATE = 1e-5
# Radians, at most: poses between and beside those of the training frames.
_POSE_NOISE = 0.08


def fit_occupancy(avatar: HandAvatar, poses: list[HandPose], steps: int, seed: int) -> None:
    """Trains the pair decoder on the personal hand in poses like the given ones.

    Args:
        avatar: only its pair decoder changes.
        poses: of the training frames, as the outlines have them.
        steps: of one pose and ``_POINTS`` labelled points each.
        seed: of poses and points.

    Source: paper Sec. 3.2, L_PairOF, which the paper takes along in every step of the training.
    Departs: the authors leave the personal surface to the joint training, which in minutes sees
        too few points of it.
    """
    field = avatar.occupancy
    loss_of = OccupancyLoss(field, avatar.parts, StageTimes())
    optimizers = prior_optimizers(field.decoder)
    generator = torch.Generator().manual_seed(seed)
    average = math.nan
    with Progress("occupancy", steps) as progress:
        for step in range(1, steps + 1):
            set_rate(optimizers, learning_rate(step, steps, _RATE, _LAST_RATE))
            sample = _labelled(avatar, _varied(poses, generator), generator)
            for optimizer in optimizers.values():
                optimizer.zero_grad(set_to_none=True)
            loss = loss_of([sample])
            loss.backward()
            for optimizer in optimizers.values():
                optimizer.step()
            value = float(loss.detach())
            average = value if math.isnan(average) else 0.95 * average + 0.05 * value
            progress.update(step, loss=average)
    field.zero_grad(set_to_none=True)


def _varied(poses: list[HandPose], generator: torch.Generator) -> HandPose:
    """One of the poses, every joint turned a little."""
    pose = poses[int(torch.randint(len(poses), (), generator=generator))]
    size = _POSE_NOISE * float(torch.rand((), generator=generator))
    noise = size * torch.randn(pose.rotations.shape, generator=generator)
    return HandPose(pose.rotations + noise.to(pose.rotations), pose.translation)


@torch.no_grad()
def _labelled(avatar: HandAvatar, pose: HandPose, generator: torch.Generator) -> LabelledPose:
    posed: PosedHand = avatar.personal(pose).posed(pose)
    points = training_points(avatar.parts, posed, _POINTS, avatar.occupancy.margin, generator)
    points = points.to(avatar.device)
    labels = is_inside(posed.sealed_vertices, avatar.rig.sealed_faces, points)
    return LabelledPose(posed, points, labels)
