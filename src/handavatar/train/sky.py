"""Where the light comes from: directions for the shadows, denser where the sky is bright.

Sharp shadows come from a small part of the sky. Directions spread evenly are 20 degrees apart, and
a shadow that is cast from the wrong one of two lies millimetres off. So a first, rough sky is
fitted to the training pictures, and most directions are placed where it is bright. Where there are
several clips, each has a sky of its own, and they share the directions.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.field.anchors import Neighbours
from handavatar.jobs.finite import require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import stop_point
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState
from handavatar.jobs.threads import mapped
from handavatar.render.skylight import even_directions
from handavatar.render.volume import composite_sparse
from handavatar.train.appearance import SeenSamples, chosen_samples

EVEN_SHARE = 3 / 7
"""Of the directions: these stay evenly spread, for light from everywhere."""
_LATTICE = 512
"""The others are points of an even lattice of so many: 9 degrees apart."""
_BLUR = 0.25
"""Radians by which the rough sky is blurred before they are chosen."""
_STEPS, _PIXELS, _RATE = 150, 4096, 5e-2
_AT_ONCE = 8
"""Frames whose light is traced before it is told."""


def place_directions(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    seen: SeenSamples,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> SeenSamples:
    """Moves the avatar's directions of light to where the light is.

    Args:
        avatar: with evenly spread directions; these are replaced.
        frames: of training, their poses as training sees them.
        seen: of these frames, with the light from the even directions.
        seed: of the pixels that are looked at.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Returns:
        The same samples with the light from the new directions.
    """
    directions = avatar.illumination.directions
    parts = progress.stages({"sky": 8.0 * avatar.num_lights, "tracing light": 1.7 * len(frames)})
    skies = []
    for clip in range(avatar.num_lights):
        skies.append(fit_sky(seen, len(avatar.anchor_corners), seed, clip))
        parts["sky"](clip + 1, avatar.num_lights)
    directions.copy_(bright_directions(directions, _joined_skies(skies)))
    return relit(avatar, frames, seen, parts["tracing light"], kept)


@torch.enable_grad()
def fit_sky(
    seen: SeenSamples, num_anchors: int, seed: int, clip: int = 0
) -> Float[Tensor, "directions"]:
    """Brightness of a sky that, with a grey tone per anchor, explains a clip's training pictures.

    Light adds up, stored colours are a power of it; the exponent is fitted as well.

    Args:
        seen: of the training frames.
        num_anchors: of the avatar.
        seed: of the pixels that are looked at.
        clip: whose pictures.

    Raises:
        NotFinite: if what was fitted is NaN or infinite.
    """
    device = seen.weights.device
    sky = torch.full((seen.light.shape[1],), -3.0, device=device, requires_grad=True)
    ambient = torch.full((), -3.0, device=device, requires_grad=True)
    exponent = torch.full((), 0.5, device=device, requires_grad=True)
    tones = torch.zeros(num_anchors, 1, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([sky, ambient, exponent, tones], lr=_RATE)
    generator = torch.Generator().manual_seed(seed)
    grey = seen.colors.mean(-1)
    own = (seen.clips[seen.frames[seen.starts[:-1]]] == clip).nonzero()[:, 0]
    for _ in range(_STEPS):
        stop_point()
        pixels = own[torch.randint(len(own), (_PIXELS,), generator=generator).to(device)]
        sample, ray = chosen_samples(seen, pixels)
        neighbours = Neighbours(seen.neighbours.indices[sample], seen.neighbours.weights[sample])
        arriving = seen.light[sample].float() @ nn.functional.softplus(sky)
        arriving = arriving + nn.functional.softplus(ambient)
        value = neighbours.interpolated(tones)[:, 0].sigmoid() * arriving ** exponent.clamp(0.2, 1)
        found = composite_sparse(seen.weights[sample], ray, value[:, None], len(pixels))[:, 0]
        loss = (found / seen.alpha[pixels] - grey[pixels]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    require_finite({"brightness": sky}, f"sky of clip {clip}")
    return nn.functional.softplus(sky.detach())


def _joined_skies(skies: list[Float[Tensor, "directions"]]) -> Float[Tensor, "directions"]:
    """Of several clips, as if their lights shone together, each as brightly as any other."""
    if len(skies) == 1:
        return skies[0]
    return torch.stack([sky / sky.sum() for sky in skies]).sum(0)


def bright_directions(
    directions: Float[Tensor, "directions 3"], brightness: Float[Tensor, "directions"]
) -> Float[Tensor, "directions 3"]:
    """As many directions: some spread evenly, the others around the brightest part of the sky."""
    num_even = round(EVEN_SHARE * len(directions))
    fine = even_directions(_LATTICE).to(directions)
    angle = (fine @ directions.T).clamp(-1, 1).acos()
    blurred = torch.exp(-0.5 * (angle / _BLUR).square()) @ brightness
    brightest = blurred.argsort(descending=True)[: len(directions) - num_even]
    return torch.cat([even_directions(num_even).to(directions), fine[brightest]])


@torch.no_grad()
def relit(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    seen: SeenSamples,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> SeenSamples:
    """The same samples with the light from the avatar's directions as they are now.

    Args:
        avatar: that knows the directions.
        frames: of training, their poses as training sees them.
        seen: of these frames.
        progress: told how many frames are done.
        kept: where it goes on, if it was interrupted.
    """

    def light_of(number: int) -> Tensor:
        state = avatar.prepare(frames[number].pose.to(avatar.device))
        mine = seen.frames == number
        neighbours = Neighbours(seen.neighbours.indices[mine], seen.neighbours.weights[mine])
        return neighbours.interpolated(state.light).half()

    light: list[Tensor] = []
    if (begun := kept.read()) is not None:
        count = int(begun.facts["frames"])
        light = [begun.tensors[str(number)].to(avatar.device) for number in range(count)]
    progress.skip(len(light), len(frames))

    def state() -> WorkState:
        return WorkState({str(n): v for n, v in enumerate(light)}, {"frames": len(light)})

    with kept.kept(state):
        for some in torch.arange(len(light), len(frames)).split(_AT_ONCE):
            light += mapped(light_of, some.tolist())
            progress(len(light), len(frames))
    return replace(seen, light=torch.cat(light))
