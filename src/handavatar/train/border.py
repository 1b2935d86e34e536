"""Beside the border of a mask: where the field ends in the picture.

Occupancy points say where the surface is; along a grazing ray their uncertainty adds up, and the
picture's outline lies outside of it. Rays beside the border see the sum itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Frame
from handavatar.field.occupancy import HandCodes
from handavatar.geometry.cameras import Rays, pixel_centers, rays_through_pixels
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState
from handavatar.jobs.threads import mapped
from handavatar.render.silhouette import known_distance
from handavatar.train.losses import border_loss
from handavatar.train.pretraining import descend

BORDER_REACH = 4.0
"""Pixels."""
# Frames per step, and pixels of each.
_FRAMES = 2
_PIXELS = 256
_RATE = 4e-4
_LAST_RATE = 1e-5


@dataclass(frozen=True, eq=False)
class _Border:
    """An encoded hand and rays through the pixels beside the border of its mask."""

    codes: HandCodes
    rays: Rays
    coverage: Float[Tensor, "rays"]


def fit_border(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    steps: int,
    settings: RenderSettings,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> None:
    """Trains the pair decoder until its outlines lie on the borders of the masks.

    Args:
        avatar: only its pair decoder changes.
        frames: of training, with their poses as the outlines have them.
        steps: of ``_FRAMES`` frames and ``_PIXELS`` rays of each; none if no mask has a border.
        settings: of the rays.
        seed: of frames, rays and samples.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.

    Departs: the authors leave the outline to the colours; see
        :func:`~handavatar.train.losses.border_loss`.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = progress.stages({"borders": 0.11 * len(frames), "border": 0.55 * steps})
    borders = _borders(avatar, frames if steps else [], parts["borders"])

    def loss_of_step() -> Float[Tensor, ""]:
        losses = []
        for number in torch.randint(len(borders), (_FRAMES,), generator=generator).tolist():
            border = borders[number]
            some = torch.randint(len(border.coverage), (_PIXELS,), generator=generator)
            some = some.to(avatar.device)
            rays = Rays(border.rays.origins[some], border.rays.directions[some])
            alpha = avatar.alpha(border.codes, rays, settings, generator)
            losses.append(border_loss(alpha, border.coverage[some]))
        return torch.stack(losses).mean()

    decoder, steps = avatar.occupancy.decoder, steps if borders else 0
    rates = (_RATE, _LAST_RATE)
    descend("border", decoder, steps, rates, loss_of_step, generator, parts["border"], kept)


def _borders(avatar: HandAvatar, frames: Sequence[Frame], progress: Progress) -> list[_Border]:
    def border(frame: Frame) -> _Border:
        pose, camera = frame.pose.to(avatar.device), frame.camera.to(avatar.device)
        codes = avatar.occupancy.encode(avatar.parts, avatar.personal(pose).posed(pose))
        x, y = _beside(frame.alpha, frame.known).unbind(-1)
        rays = rays_through_pixels(camera, pixel_centers(camera)[y, x])
        return _Border(codes, rays, frame.alpha[y, x].to(avatar.device))

    found = mapped(border, frames, progress=progress)
    return [border for border in found if len(border.coverage)]


def _beside(
    coverage: Float[Tensor, "height width"], known: Bool[Tensor, "height width"] | None
) -> Int[Tensor, "pixels 2"]:
    distance, was_seen = known_distance(coverage, known)
    y, x = (was_seen & (distance.abs() < BORDER_REACH)).nonzero().unbind(-1)
    return torch.stack([x, y], dim=-1)


def border_pixels(
    coverage: Float[Tensor, "height width"],
    count: int,
    generator: torch.Generator,
    known: Bool[Tensor, "height width"] | None = None,
) -> Int[Tensor, "pixels 2"]:
    """Pixels (x, y) at most ``BORDER_REACH`` from the border of the mask, drawn evenly.

    As many as asked for, or as there are. Where a mask ends because nothing is known beside it, it
    has no border; None stands for a mask that is known everywhere.
    """
    pixels = _beside(coverage, known)
    return pixels[torch.randperm(len(pixels), generator=generator)[:count]]
