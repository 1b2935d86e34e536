"""After the outlines, before the first step: the prior's decoder learns this person's hand.

The prior knows hands of the rig's shapes; of a person's own it misses the surface by half a
millimetre, which is half a pixel of the outline. Points around the personal mesh, whose inside is
known, tell it more for the same time than rays do.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.field.occupancy import HandCodes
from handavatar.geometry.meshes import is_inside
from handavatar.hand.pose import HandPose
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState
from handavatar.jobs.threads import mapped
from handavatar.train.labelled_poses import training_points
from handavatar.train.pretraining import OccupancyLoss, descend
from handavatar.train.stage_times import StageTimes

# Hands per step, points of each that a step draws, and points of each there are.
_HANDS = 2
_POINTS = 1024
_POOL = 8192
_RATE = 3e-3
_LAST_RATE = 1e-5
# Radians, at most: poses between and beside those of the training frames.
_POSE_NOISE = 0.08


@dataclass(frozen=True, eq=False)
class _KnownHand:
    """A personal hand in one pose, encoded, with points whose label is known."""

    codes: HandCodes
    points: Float[Tensor, "points 3"]
    is_inside: Bool[Tensor, "points"]


def fit_occupancy(
    avatar: HandAvatar,
    poses: list[HandPose],
    steps: int,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> None:
    """Trains the pair decoder on the personal hand in poses like the given ones.

    Args:
        avatar: only its pair decoder changes.
        poses: of the training frames, as the outlines have them.
        steps: of ``_HANDS`` hands and ``_POINTS`` labelled points of each.
        seed: of poses and points.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.

    Source: paper Sec. 3.2, L_PairOF, which the paper takes along in every step of the training.
    Departs: the authors leave the personal surface to the joint training, which in minutes sees
        too few points of it.
    """
    loss_of = OccupancyLoss(avatar.occupancy, avatar.parts, StageTimes())
    generator = torch.Generator().manual_seed(seed)
    # Hands and labels cost as much as a step: once for all steps, one of every pose.
    parts = progress.stages({"hands": 0.2 * len(poses), "occupancy": 0.13 * steps})
    hands = _known_hands(avatar, poses if steps else [], seed, parts["hands"])

    def loss_of_step() -> Float[Tensor, ""]:
        losses = []
        for number in torch.randint(len(hands), (_HANDS,), generator=generator).tolist():
            hand = hands[number]
            some = torch.randint(_POOL, (_POINTS,), generator=generator).to(avatar.device)
            losses.append(loss_of.of_codes(hand.codes, hand.points[some], hand.is_inside[some]))
        return torch.stack(losses).mean()

    descend(
        "occupancy",
        avatar.occupancy.decoder,
        steps,
        (_RATE, _LAST_RATE),
        loss_of_step,
        generator,
        parts["occupancy"],
        kept,
    )


def _known_hands(
    avatar: HandAvatar, poses: list[HandPose], seed: int, progress: Progress
) -> list[_KnownHand]:
    def known(number: int) -> _KnownHand:
        generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
        pose = _varied(poses[number], generator)
        posed = avatar.personal(pose).posed(pose)
        points = training_points(avatar.parts, posed, _POOL, avatar.occupancy.margin, generator)
        points = points.to(avatar.device)
        labels = is_inside(posed.sealed_vertices, avatar.rig.sealed_faces, points)
        return _KnownHand(avatar.occupancy.encode(avatar.parts, posed), points, labels)

    return mapped(known, range(len(poses)), progress=progress)


def _varied(pose: HandPose, generator: torch.Generator) -> HandPose:
    """The pose, every joint turned a little."""
    size = _POSE_NOISE * float(torch.rand((), generator=generator))
    noise = size * torch.randn(pose.rotations.shape, generator=generator)
    return HandPose(pose.rotations + noise.to(pose.rotations), pose.translation)
