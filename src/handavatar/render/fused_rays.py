"""Rays in Triton kernels, for NVIDIA GPUs: where they meet boxes, what is seen along them.

Optional, like :mod:`handavatar.field.fused`. A picture of a hand is a hundred thousand rays and
very little work for each: with torch's operations a GPU waits for Python most of the time. Each
function here is one kernel, without gradient, and does what it says for all rays at once. Along a
ray the kernels go sample by sample, in the order of the light.

Samples have numbers: that of their ray times the samples of a ray, plus their place in it.
"""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Rays

_RAYS = 128
"""At a time in one program."""
_ROWS = 32
"""At a time in one program that holds a number for every bone of each."""


@triton.jit(do_not_specialize=["count"])
def _intervals(
    origins, directions, shifts, lower, upper, near, far, count,
    BOXES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_ray = ray < count
    nearest = tl.full((BLOCK,), float("inf"), tl.float32)
    furthest = -nearest
    for box in tl.static_range(BOXES):
        enter, leave = tl.zeros((BLOCK,), tl.float32), tl.full((BLOCK,), float("inf"), tl.float32)
        for axis in tl.static_range(3):
            place = 3 * (box * count.to(tl.int64) + ray) + axis
            origin = tl.load(origins + place, mask=is_ray, other=0.0)
            origin += tl.load(shifts + 3 * box + axis)
            slope = tl.load(directions + place, mask=is_ray, other=1.0)
            slope = tl.where(tl.abs(slope) < 1e-12, 1e-12, slope)
            first = tl.div_rn(tl.load(lower + 3 * box + axis) - origin, slope)
            second = tl.div_rn(tl.load(upper + 3 * box + axis) - origin, slope)
            enter = tl.maximum(enter, tl.minimum(first, second))
            leave = tl.minimum(leave, tl.maximum(first, second))
        is_hit = enter < leave
        nearest = tl.minimum(nearest, tl.where(is_hit, enter, float("inf")))
        furthest = tl.maximum(furthest, tl.where(is_hit, leave, -float("inf")))
    tl.store(near + ray, nearest, mask=is_ray)
    tl.store(far + ray, furthest, mask=is_ray)


@triton.jit(do_not_specialize=["count"])
def _places(
    origins, directions, depths, samples, light, points, count, num_samples, stop,
    BLOCK: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_sample = index < count
    sample = tl.load(samples + index, mask=is_sample, other=0)
    ray = sample // num_samples
    depth = tl.load(depths + sample)
    # What is no number lies in no box.
    depth = tl.where(tl.load(light + ray) > stop, depth, float("nan"))
    for axis in tl.static_range(3):
        place = tl.load(origins + 3 * ray + axis) + depth * tl.load(directions + 3 * ray + axis)
        tl.store(points + 3 * index + axis, place, mask=is_sample)


@triton.jit(do_not_specialize=["count"])
def _dimmed(occupancy, window, light, count, num_samples, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_ray = ray < count
    row = occupancy + ray.to(tl.int64) * num_samples
    left = tl.load(light + ray, mask=is_ray, other=0.0)
    for number in tl.static_range(WIDTH):
        left *= 1 - tl.load(row + tl.load(window + number), mask=is_ray, other=0.0)
    tl.store(light + ray, left, mask=is_ray)


@triton.jit
def _reach(soft, sample, is_ray, BONES: tl.constexpr):
    """The largest soft occupancy of any part at samples."""
    place = soft + BONES * sample[:, None] + tl.arange(0, BONES)[None, :]
    return tl.max(tl.load(place, mask=is_ray[:, None], other=0.0), axis=1)


@triton.jit(do_not_specialize=["count"])
def _between(
    occupancy, soft, looked_at, is_between, count, num_samples, num_looked_at, near_above, stop,
    BONES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_ray = ray < count
    first = ray.to(tl.int64) * num_samples
    light = tl.full((BLOCK,), 1.0, tl.float32)
    sample = tl.load(looked_at)
    reach = _reach(soft, first + sample, is_ray, BONES)
    for number in range(1, num_looked_at):
        light *= 1 - tl.load(occupancy + first + sample, mask=is_ray, other=0.0)
        following = tl.load(looked_at + number)
        reach_there = _reach(soft, first + following, is_ray, BONES)
        is_near = (tl.maximum(reach, reach_there) > near_above) & (light > stop)
        for within in range(sample + 1, following):
            tl.store(is_between + first + within, is_near.to(tl.uint8), mask=is_ray)
        sample, reach = following, reach_there


@triton.jit(do_not_specialize=["count"])
def _weights(occupancy, weights, count, num_samples, BLOCK: tl.constexpr):
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_ray = ray < count
    first = ray.to(tl.int64) * num_samples
    light = tl.full((BLOCK,), 1.0, tl.float32)
    for sample in range(num_samples):
        here = tl.load(occupancy + first + sample, mask=is_ray, other=0.0)
        tl.store(weights + first + sample, light * here, mask=is_ray)
        light *= 1 - here


@triton.jit(do_not_specialize=["count"])
def _met(
    values, samples, found, count, num_samples, BONES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_row = index < count
    sample = tl.load(samples + index, mask=is_row, other=0)
    last = (sample % num_samples).to(tl.int32)
    first = sample - last
    bone = tl.arange(0, BONES)[None, :]
    largest = tl.full((BLOCK, BONES), -float("inf"), tl.float32)
    for place in range(tl.max(last, axis=0) + 1):
        is_before = is_row & (place <= last)
        at = values + BONES * (first + place)[:, None] + bone
        here = tl.load(at, mask=is_before[:, None], other=-float("inf"))
        largest = tl.maximum(largest, here)
    tl.store(found + BONES * index[:, None] + bone, largest, mask=is_row[:, None])


def box_intervals(
    rays: Rays,
    box_from_world: Float[Tensor, "boxes 4 4"],
    lower: Float[Tensor, "boxes 3"],
    upper: Float[Tensor, "boxes 3"],
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Near and far of :func:`handavatar.render.sampling.intervals_through_boxes`, to the last bit.

    Where a ray grazes a box, the last bit decides from where to where it is sampled.

    Returns:
        Where each ray enters the first box and leaves the last one; infinity and minus infinity
        where it meets none.
    """
    near = rays.origins.new_empty(len(rays.origins))
    far = torch.empty_like(near)
    if len(near):
        rotation = box_from_world[:, :3, :3]
        origins = torch.einsum("bij,rj->rbi", rotation, rays.origins)
        directions = torch.einsum("bij,rj->rbi", rotation, rays.directions)
        _intervals[(triton.cdiv(len(near), _RAYS),)](
            origins.transpose(0, 1).contiguous(), directions.transpose(0, 1).contiguous(),
            box_from_world[:, :3, 3].contiguous(), lower.contiguous(), upper.contiguous(), near,
            far, len(near), BOXES=len(lower), BLOCK=_RAYS,
        )  # fmt: skip
    return near, far


def sample_places(
    rays: Rays,
    depths: Float[Tensor, "rays samples"],
    samples: Int[Tensor, "chosen"],
    light: Float[Tensor, "rays"],
    stop: float,
) -> Float[Tensor, "chosen 3"]:
    """Where samples lie; not a number where their ray is dark.

    Args:
        rays: in the world, metres.
        depths: along them.
        samples: their numbers.
        light: what is left of each ray's light.
        stop: a ray with no more than that is dark.
    """
    points = depths.new_empty(len(samples), 3)
    if len(samples):
        _places[(triton.cdiv(len(samples), _RAYS),)](
            rays.origins.contiguous(), rays.directions.contiguous(), depths, samples, light,
            points, len(samples), depths.shape[1], stop, BLOCK=_RAYS,
        )  # fmt: skip
    return points


def dim(
    light: Float[Tensor, "rays"],
    occupancy: Float[Tensor, "rays samples"],
    window: Int[Tensor, "width"],
) -> None:
    """Takes from each ray's light what some samples of it hold back.

    Args:
        light: changed in place.
        occupancy: of all samples.
        window: which samples, the same of every ray.
    """
    if len(light):
        _dimmed[(triton.cdiv(len(light), _RAYS),)](
            occupancy, window, light, len(light), occupancy.shape[1], WIDTH=len(window),
            BLOCK=_RAYS,
        )  # fmt: skip


def samples_between(
    occupancy: Float[Tensor, "rays samples"],
    soft: Float[Tensor, "rays samples bones"],
    looked_at: Int[Tensor, "coarse"],
    near_above: float,
    stop: float,
) -> Int[Tensor, "found"]:
    """Samples between two that were looked at, where either is near the hand and light arrives.

    Args:
        occupancy: where it was looked at.
        soft: likewise, of each part.
        looked_at: which samples, ascending, the same of every ray, the first and the last among
            them.
        near_above: a sample with a larger soft occupancy is near.
        stop: no light arrives where no more than that is left.
    """
    num_rays, num_samples, num_bones = soft.shape
    is_between = torch.zeros(num_rays * num_samples, dtype=torch.uint8, device=soft.device)
    if num_rays:
        _between[(triton.cdiv(num_rays, _ROWS),)](
            occupancy, soft, looked_at, is_between, num_rays, num_samples, len(looked_at),
            near_above, stop, BONES=num_bones, BLOCK=_ROWS,
        )  # fmt: skip
    return is_between.nonzero()[:, 0]


def sample_weights(occupancy: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
    """The weights of :func:`handavatar.render.volume.visibility`."""
    weights = torch.empty_like(occupancy)
    if len(occupancy):
        _weights[(triton.cdiv(len(occupancy), _RAYS),)](
            occupancy, weights, len(occupancy), occupancy.shape[1], BLOCK=_RAYS
        )
    return weights


def largest_met(
    values: Float[Tensor, "rays samples bones"], samples: Int[Tensor, "chosen"]
) -> Float[Tensor, "chosen bones"]:
    """The largest value of each part that a sample's ray has met up to it, itself included.

    Args:
        values: of all samples.
        samples: numbers of those that are asked for.
    """
    found = values.new_empty(len(samples), values.shape[2])
    if len(samples):
        _met[(triton.cdiv(len(samples), _ROWS),)](
            values, samples, found, len(samples), values.shape[1], BONES=values.shape[2],
            BLOCK=_ROWS,
        )  # fmt: skip
    return found
