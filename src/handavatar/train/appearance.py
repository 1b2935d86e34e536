"""Appearance alone, on samples that stay: the first steps of a quick training.

As long as the geometry does not move, the samples that each pixel sees, their weights, their
anchors and what lies before them stay the same. They are found once; then a step costs the two
small networks and can look at pixels of all frames at once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Frame
from handavatar.field.anchors import Neighbours
from handavatar.geometry.cameras import pixel_centers, rays_through_pixels
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState, named_tensors
from handavatar.render.volume import composite_sparse
from handavatar.train.losses import color_loss


@dataclass(frozen=True, eq=False)
class SeenSamples:
    """What chosen pixels of all training frames see of a geometry that stays.

    Attributes:
        weights: of each sample in its pixel.
        directed: directed soft occupancy at each sample.
        neighbours: nearest anchors of each sample.
        normals: world normal at each sample.
        light: what a light in each direction brings to each sample; half precision.
        frames: frame number of each sample.
        starts: where each pixel's samples begin; its samples are neighbours in all of the above.
        colors: true colour of each pixel, in [0, 1], at the capture's average exposure.
        alpha: how much of each pixel the hand covers.
        points: mean place of each pixel's samples, metres, world.
        rotations: pose of each frame, axis-angle.
        clips: of each frame, the number of the recording that it comes from: of its light.
    """

    weights: Float[Tensor, "samples"]
    directed: Float[Tensor, "samples bones"]
    neighbours: Neighbours
    normals: Float[Tensor, "samples 3"]
    light: Float[Tensor, "samples directions"]
    frames: Int[Tensor, "samples"]
    starts: Int[Tensor, "pixels_and_one"]
    colors: Float[Tensor, "pixels 3"]
    alpha: Float[Tensor, "pixels"]
    points: Float[Tensor, "pixels 3"]
    rotations: Float[Tensor, "frames bones 3"]
    clips: Int[Tensor, "frames"]

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> "SeenSamples":
        """From what :meth:`tensors` gave."""
        own = {name: value for name, value in tensors.items() if "." not in name}
        near = named_tensors(tensors, "neighbours.")
        return cls(**own, neighbours=Neighbours(near["indices"], near["weights"]))

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name."""
        own = {name: value for name, value in vars(self).items() if name != "neighbours"}
        near = self.neighbours
        return own | {"neighbours.indices": near.indices, "neighbours.weights": near.weights}

    def moved_to(self, device: torch.device) -> "SeenSamples":
        """The same on a device."""
        return SeenSamples.of({name: value.to(device) for name, value in self.tensors().items()})


@torch.no_grad()
def find_seen_samples(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    settings: RenderSettings,
    stride: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> SeenSamples:
    """Evaluates every ``stride``-th pixel of the hand, in both directions, of every frame.

    Pixels at the hand's border are left out: what they mix with the background is unknown. So are
    those of which nothing is known.

    Args:
        avatar: whose geometry.
        frames: of training, their poses as training sees them.
        settings: of the rays.
        stride: pixels between two that are evaluated.
        progress: told how many frames are done.
        kept: where it goes on, if it was interrupted.

    Raises:
        Interrupted: if the command was told to stop.
    """
    pieces: list[dict[str, Tensor]] = []
    if (begun := kept.read()) is not None:
        pieces = [named_tensors(begun.tensors, f"{n}.") for n in range(int(begun.facts["frames"]))]
        pieces = [{k: v.to(avatar.device) for k, v in piece.items()} for piece in pieces]
    progress.skip(len(pieces), len(frames))

    def state() -> WorkState:
        parts = {f"{n}.{k}": v for n, piece in enumerate(pieces) for k, v in piece.items()}
        return WorkState(parts, {"frames": len(pieces)})

    with kept.kept(state):
        for number in range(len(pieces), len(frames)):
            pieces.append(_seen_in_frame(avatar, frames[number], number, settings, stride))
            progress(number + 1, len(frames))
    joined = {name: torch.cat([piece[name] for piece in pieces]) for name in pieces[0]}
    starts = joined.pop("counts").cumsum(0)
    joined["starts"] = torch.cat([torch.zeros_like(starts[:1]), starts])
    joined["rotations"] = torch.stack([f.pose.rotations for f in frames]).to(avatar.device)
    joined["clips"] = torch.tensor([frame.clip for frame in frames], device=avatar.device)
    return SeenSamples.of(joined)


def _seen_in_frame(
    avatar: HandAvatar, frame: Frame, number: int, settings: RenderSettings, stride: int
) -> dict[str, Tensor]:
    """What :class:`SeenSamples` joins, of one frame; and the number of each pixel's samples."""
    state = avatar.prepare(frame.pose.to(avatar.device))
    camera = frame.camera.to(avatar.device)
    grid = torch.zeros_like(frame.mask)
    grid[number % stride :: stride, (number // stride) % stride :: stride] = True
    y, x = (frame.mask & grid).nonzero().unbind(-1)
    rays = rays_through_pixels(camera, pixel_centers(camera)[y, x])
    seen = avatar.visible_samples(state, rays, settings)
    alpha = composite_sparse(
        seen.weights, seen.rays, torch.ones_like(seen.weights)[:, None], len(x)
    )[:, 0]
    is_covered = alpha > 0.98
    is_kept = is_covered[seen.rays]
    mean = composite_sparse(seen.weights, seen.rays, seen.points, len(x)) / alpha[:, None]
    return {
        "weights": seen.weights[is_kept],
        "directed": seen.directed[is_kept],
        "neighbours.indices": seen.neighbours.indices[is_kept],
        "neighbours.weights": seen.neighbours.weights[is_kept],
        "normals": seen.neighbours.interpolated(state.anchor_normals)[is_kept],
        "light": seen.neighbours.interpolated(state.light)[is_kept].half(),
        "frames": torch.full_like(seen.rays[is_kept], number),
        "counts": torch.bincount(seen.rays, minlength=len(x))[is_covered],
        "colors": frame.colors[y, x].to(alpha)[is_covered],
        "alpha": alpha[is_covered],
        "points": mean[is_covered],
    }


def chosen_samples(
    seen: SeenSamples, pixels: Int[Tensor, "pixels"]
) -> tuple[Int[Tensor, "samples"], Int[Tensor, "samples"]]:
    """The samples of some pixels, and which of these pixels each belongs to, ascending."""
    begin, count = seen.starts[pixels], seen.starts[pixels + 1] - seen.starts[pixels]
    ray = torch.arange(len(pixels), device=pixels.device).repeat_interleave(count)
    first = count.cumsum(0) - count
    return begin[ray] + torch.arange(len(ray), device=pixels.device) - first[ray], ray


def samples_of_frames(seen: SeenSamples, numbers: Sequence[int]) -> SeenSamples:
    """What pixels of some of the frames see.

    Args:
        seen: of all frames.
        numbers: of the frames that are wanted, ascending; they are counted anew.
    """
    device = seen.frames.device
    places = torch.full((len(seen.rotations),), -1, device=device)
    places[torch.tensor(numbers, device=device)] = torch.arange(len(numbers), device=device)
    counts = seen.starts.diff()
    # A pixel has at least one sample.
    pixels = (places[seen.frames[seen.starts[:-1]]] >= 0).nonzero()[:, 0]
    samples, _ = chosen_samples(seen, pixels)
    starts = counts[pixels].cumsum(0)
    near = seen.neighbours
    return SeenSamples(
        weights=seen.weights[samples],
        directed=seen.directed[samples],
        neighbours=Neighbours(near.indices[samples], near.weights[samples]),
        normals=seen.normals[samples],
        light=seen.light[samples],
        frames=places[seen.frames[samples]],
        starts=torch.cat([torch.zeros_like(starts[:1]), starts]),
        colors=seen.colors[pixels],
        alpha=seen.alpha[pixels],
        points=seen.points[pixels],
        rotations=seen.rotations[torch.tensor(numbers, device=device)],
        clips=seen.clips[torch.tensor(numbers, device=device)],
    )


def with_hidden_poses(seen: SeenSamples, share: float, generator: torch.Generator) -> SeenSamples:
    """The same samples; a share of the frames, drawn anew, shows zeros in place of its pose."""
    if not share:
        return seen
    is_known = torch.rand(len(seen.rotations), generator=generator) >= share
    return replace(seen, rotations=seen.rotations * is_known.to(seen.rotations)[:, None, None])


def appearance_loss(
    avatar: HandAvatar, seen: SeenSamples, pixels: Int[Tensor, "pixels"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Colour loss and mean squared error of some pixels.

    Source: paper Sec. 3.3, the l1 term of L_SelF; same volume rendering as everywhere, with
        weights that do not move.
    """
    sample, ray = chosen_samples(seen, pixels)
    neighbours = Neighbours(seen.neighbours.indices[sample], seen.neighbours.weights[sample])
    albedo = avatar.albedo(neighbours)
    frames = seen.frames[sample]
    light = avatar.illumination(
        seen.rotations[frames],
        neighbours,
        seen.directed[sample],
        seen.normals[sample],
        seen.light[sample].float(),
        seen.clips[frames],
    )
    color = composite_sparse(seen.weights[sample], ray, albedo * light[:, None], len(pixels))
    color = color / seen.alpha[pixels][:, None]
    truth = seen.colors[pixels]
    return color_loss(color, truth), (color.detach() - truth).square().mean()
