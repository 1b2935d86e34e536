"""One colour and density field of the rest hand, reached by inverse skinning: HumanNeRF's idea.

A point of a ray is taken back to the rest pose by the blended bone motions of the skin near it,
moved a little by a network of the pose, and looked up in a field that knows colour and density
together. Shape, skin and light are one thing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.evaluate.descent import descend
from handavatar.field.anchors import nearest_anchors
from handavatar.field.layers import MLP, positional_encoding
from handavatar.field.shading import POSITION_SCALE
from handavatar.geometry.cameras import pixel_centers, rays_through_pixels
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand, ShapedHand
from handavatar.render.rasterize import covered_pixels
from handavatar.render.volume import composite_sparse, visibility

REACH = 0.008
"""Metres off the skin beyond which nothing is looked up."""
NUM_SAMPLES = 64
_FREQUENCIES = 6
_MARGIN = 6
"""Pixels around the mesh that are looked at."""
_FRAMES, _PIXELS, _RATE = 8, 1536, 2e-3
_DENSITY_SCALE = 500.0
"""Per metre and unit of the network: a millimetre of flesh hides two fifths of what is behind."""


class CanonicalField(nn.Module):
    """Colour and density of the rest hand, and how the pose bends it."""

    def __init__(self) -> None:
        """Nearly empty and grey."""
        super().__init__()
        width = 3 + 6 * _FREQUENCIES
        self.bending = MLP(width + 48, 128, 2, 3)
        self.field = MLP(width, 256, 4, 4)
        nn.init.zeros_(self.bending.output.weight)
        nn.init.zeros_(self.bending.output.bias)

    def forward(
        self, places: Float[Tensor, "points 3"], rotations: Float[Tensor, "points 48"]
    ) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
        """Colour in [0, 1] and density per metre.

        Args:
            places: in the rest pose, metres.
            rotations: the whole pose of each point's hand.
        """
        scaled = places / POSITION_SCALE
        encoded = positional_encoding(scaled, _FREQUENCIES)
        bent = scaled + 0.05 * self.bending(torch.cat([encoded, rotations], dim=-1))
        values = self.field(positional_encoding(bent, _FREQUENCIES))
        return values[:, :3].sigmoid(), _DENSITY_SCALE * nn.functional.softplus(values[:, 3])


def rest_places(
    hand: ShapedHand,
    posed: PosedHand,
    skin_weights: Float[Tensor, "points bones"],
    points: Float[Tensor, "points 3"],
) -> Float[Tensor, "points 3"]:
    """Where points of the posed hand's surroundings are in the rest pose, metres.

    Args:
        hand: at rest.
        posed: the same hand in the world.
        skin_weights: of each point, those of the skin beside it; rows sum to 1.
        points: metres, world.
    """
    rotation = posed.world_from_bone[:, :3, :3]
    shift = posed.world_from_bone[:, :3, 3] - (rotation @ hand.rest_joints[..., None])[..., 0]
    blended = torch.einsum("pb,bij->pij", skin_weights, rotation)
    moved = points - skin_weights @ shift
    return torch.linalg.solve(blended, moved[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Samples near the skin of one picture's rays.

    Attributes:
        pixels: of the rays, row by row.
        rays: ray of each sample.
        steps: number of each sample along its ray.
        places: in the rest pose, metres.
        spacing: metres between samples of each ray.
    """

    pixels: Int[Tensor, "rays"]
    rays: Int[Tensor, "samples"]
    steps: Int[Tensor, "samples"]
    places: Float[Tensor, "samples 3"]
    spacing: Float[Tensor, "rays"]


@torch.no_grad()
def ray_samples(
    avatar: HandAvatar, frame: Frame, stride: int = 1, only_known: bool = False
) -> RaySamples:
    """Looks along every ``stride``-th pixel near the personal mesh, in both directions.

    On request only along those of which the frame knows what they show.
    """
    camera, pose = frame.camera, frame.pose
    hand = avatar.personal(pose)
    posed = hand.posed(pose)
    covered = covered_pixels(posed.vertices, avatar.rig.faces, camera)[None, None].float()
    size = 2 * _MARGIN + 1
    near = nn.functional.max_pool2d(covered, size, stride=1, padding=_MARGIN)[0, 0] > 0
    grid = torch.zeros_like(near)
    grid[::stride, ::stride] = True
    if only_known:
        grid &= frame.known
    pixels = (near & grid).flatten().nonzero()[:, 0]
    rays = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1)[pixels])
    along = (posed.vertices - rays.origins[:1]) @ camera.camera_from_world[2, :3]
    first, last = float(along.min()) - REACH, float(along.max()) + REACH
    # The same planes of depth for all rays; a ray that leans takes longer steps.
    lean = 1 / (rays.directions @ camera.camera_from_world[2, :3])
    middles = (torch.arange(NUM_SAMPLES) + 0.5) / NUM_SAMPLES * (last - first) + first
    depths = lean[:, None] * middles
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    places = avatar.anchors.positions(posed.vertices)
    neighbours = nearest_anchors(places, points.flatten(0, 1))
    nearest = (points.flatten(0, 1) - places[neighbours.indices[:, 0]]).norm(dim=-1)
    kept = (nearest < REACH).nonzero()[:, 0]
    weights = avatar.anchors.positions(avatar.rig.skin_weights)
    of_kept = neighbours.interpolated(weights)[kept]
    return RaySamples(
        pixels,
        kept // NUM_SAMPLES,
        kept % NUM_SAMPLES,
        rest_places(hand, posed, of_kept, points.flatten(0, 1)[kept]),
        lean * (last - first) / NUM_SAMPLES,
    )


def seen_along(
    field: CanonicalField,
    samples: RaySamples,
    rotations: Float[Tensor, "samples 48"],
) -> Float[Tensor, "rays 4"]:
    """Colour on black and coverage of every ray."""
    color, density = field(samples.places, rotations)
    count = len(samples.pixels)
    hidden = 1 - torch.exp(-density * samples.spacing[samples.rays])
    occupancy = hidden.new_zeros(count, NUM_SAMPLES)
    occupancy = occupancy.index_put((samples.rays, samples.steps), hidden)
    weights = visibility(occupancy)[samples.rays, samples.steps]
    values = torch.cat([color, torch.ones_like(color[:, :1])], dim=-1)
    return composite_sparse(weights, samples.rays, values, count)


def fit_inverse_skinning(
    avatar: HandAvatar, frames: Sequence[Frame], steps: int, seed: int, stride: int = 2
) -> Callable[[Frame], Float[Tensor, "height width 4"]]:
    """Fits the field to colours and masks.

    Args:
        avatar: its personal skinned mesh tells where the skin is; its fields play no part.
        frames: of training.
        steps: of Adam.
        seed: of weights and pixels.
        stride: every so-manieth pixel is learned from, in both directions.

    Returns:
        Colour on black and coverage of another frame's pose and camera.
    """
    torch.manual_seed(seed)
    field, generator = CanonicalField(), torch.Generator().manual_seed(seed)
    known = [ray_samples(avatar, frame, stride, only_known=True) for frame in frames]

    def loss() -> Tensor:
        chosen = torch.randint(len(frames), (_FRAMES,), generator=generator).tolist()
        parts, poses, truths = [], [], []
        for number in chosen:
            part = some_rays(known[number], _PIXELS // _FRAMES, generator)
            frame = frames[number]
            parts.append(part)
            poses.append(_rotations(frame.pose, len(part.places)))
            coverage = frame.alpha.flatten()[part.pixels][:, None]
            image = frame.colors.flatten(0, 1)[part.pixels]
            truths.append(torch.cat([image * coverage, coverage], dim=-1))
        found = seen_along(field, joined(parts), torch.cat(poses))
        return (found - torch.cat(truths)).abs().mean()

    descend(field, loss, steps, _RATE)

    @torch.no_grad()
    def picture(frame: Frame) -> Tensor:
        samples = ray_samples(avatar, frame)
        values = seen_along(field, samples, _rotations(frame.pose, len(samples.places)))
        flat = values.new_zeros(frame.camera.height * frame.camera.width, 4)
        flat = flat.index_copy(0, samples.pixels, values)
        return flat.view(frame.camera.height, frame.camera.width, 4)

    return picture


def some_rays(samples: RaySamples, count: int, generator: torch.Generator) -> RaySamples:
    """A random choice of a picture's rays."""
    chosen = torch.randperm(len(samples.pixels), generator=generator)[:count]
    number = torch.full((len(samples.pixels),), -1)
    number[chosen] = torch.arange(len(chosen))
    kept = number[samples.rays] >= 0
    return RaySamples(
        samples.pixels[chosen],
        number[samples.rays[kept]],
        samples.steps[kept],
        samples.places[kept],
        samples.spacing[chosen],
    )


def joined(parts: list[RaySamples]) -> RaySamples:
    """Rays of several pictures as if of one."""
    begin = torch.tensor([0] + [len(part.pixels) for part in parts[:-1]]).cumsum(0).tolist()
    return RaySamples(
        torch.cat([part.pixels for part in parts]),
        torch.cat([part.rays + first for part, first in zip(parts, begin, strict=True)]),
        torch.cat([part.steps for part in parts]),
        torch.cat([part.places for part in parts]),
        torch.cat([part.spacing for part in parts]),
    )


def _rotations(pose: HandPose, count: int) -> Float[Tensor, "count 48"]:
    return pose.rotations.flatten().expand(count, -1)
