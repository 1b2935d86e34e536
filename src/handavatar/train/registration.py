"""Poses and shape of a tracked capture, laid onto its frames before anything is learned."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.capture.registration import poses_of, register_frames
from handavatar.fit.energy import VIDEO_TEXTURE_SHARE
from handavatar.fit.register import Registered, RegisterOptions
from handavatar.geometry.rotations import nearest_rotations
from handavatar.hand.pose import HandPose
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState
from handavatar.train.corrections import PoseCorrections

_SHAPE_STEPS = 300
_SHAPE_RATE = 3e-3
_FEW_RESTARTS = 1


def register_training(
    avatar: HandAvatar,
    corrections: PoseCorrections,
    frames: Sequence[Frame],
    options: RegisterOptions,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> Registered:
    """Gives an avatar that has not learned yet the shape, and its frames the poses, that fit.

    Args:
        avatar: its shape coefficients and shape offsets are set.
        corrections: of the tracked poses, set as well.
        frames: of training.
        options: expected errors, rounds; frames of a video, which know their covariances, get the
            texture's weight of a video and few restarts.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        Interrupted: if the command was told to stop.
    """
    if all(frame.covariance is not None for frame in frames):
        # Whoever knows these has looked for other poses already, and has drawn them to the texture.
        energy = replace(options.energy, texture_share=VIDEO_TEXTURE_SHARE)
        options = replace(options, restarts=min(options.restarts, _FEW_RESTARTS), energy=energy)
    parts = progress.stages({"poses": 2.0 * len(frames), "offsets": 0.03 * _SHAPE_STEPS})
    rig = avatar.coarse_rig.to("cpu")
    hand = rig.shaped(avatar.coefficients.cpu())
    found = register_frames([hand], frames, options, progress=parts["poses"], kept=kept)
    for number, (frame, pose) in enumerate(zip(frames, poses_of(found), strict=True)):
        rotations = nearest_rotations(pose.rotations, frame.pose.rotations)
        corrections.set(
            number,
            frame.pose.to(avatar.device),
            HandPose(rotations, pose.translation).to(avatar.device),
        )
    avatar.coefficients += found.shape_change.to(avatar.coefficients)
    _fit_offsets(avatar, found, parts["offsets"])
    return found


@torch.enable_grad()
def _fit_offsets(avatar: HandAvatar, found: Registered, progress: Progress) -> None:
    """Teaches the shape's network the skin that registration found, in all of its poses."""
    rest = avatar.coarse_rig.shaped(avatar.coefficients)
    target = found.hand.rest_vertices.to(avatar.device) - rest.rest_vertices
    optimizer = torch.optim.Adam(avatar.shape.parameters(), lr=_SHAPE_RATE)
    rotations = found.poses.rotations.to(avatar.device)
    for step in range(_SHAPE_STEPS):
        optimizer.param_groups[0]["lr"] = _SHAPE_RATE * 0.05 ** (step / _SHAPE_STEPS)
        offsets = avatar.shape(rest, rotations[step % len(rotations)])
        # Millimetres: of the order of one.
        loss = (1e3 * (offsets - target)).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        progress(step + 1, _SHAPE_STEPS)
    optimizer.zero_grad(set_to_none=True)
