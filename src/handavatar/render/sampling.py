"""Where to look along each ray."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.geometry.cameras import Rays


def intervals_through_boxes(
    rays: Rays,
    box_from_world: Float[Tensor, "boxes 4 4"],
    lower: Float[Tensor, "boxes 3"],
    upper: Float[Tensor, "boxes 3"],
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"], Bool[Tensor, "rays"]]:
    """Where each ray enters the first and leaves the last of several oriented boxes.

    Returns:
        near, far (metres along the ray, not before its origin) and whether any box is hit.

    Departs: the authors take one axis-aligned box of the whole hand; the parts' own boxes are
        tighter and never cut a hand that has grown beyond its template.
    """
    rotation = box_from_world[:, :3, :3]
    origins = torch.einsum("bij,rj->rbi", rotation, rays.origins) + box_from_world[:, :3, 3]
    directions = torch.einsum("bij,rj->rbi", rotation, rays.directions)
    is_flat = directions.abs() < 1e-12
    safe = torch.where(is_flat, torch.full_like(directions, 1e-12), directions)
    first, second = (lower - origins) / safe, (upper - origins) / safe
    enter = torch.minimum(first, second).amax(-1).clamp_min(0)
    leave = torch.maximum(first, second).amin(-1)
    is_hit = enter < leave
    near = torch.where(is_hit, enter, torch.inf).amin(-1)
    far = torch.where(is_hit, leave, -torch.inf).amax(-1)
    return near, far, is_hit.any(-1)


def depths_along(
    near: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    num_samples: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "rays samples"]:
    """Sample positions between near and far, metres along the ray, ascending.

    Args:
        near: start of the interval.
        far: end of the interval.
        num_samples: the paper's N^q, 64.
        generator: jitters each sample inside its bin (training); without one, bin centres.

    Source: paper Sec. 3.3 (volume rendering), uniform queries.
    """
    steps = torch.arange(num_samples, device=near.device, dtype=near.dtype)
    if generator is None:
        place = (steps + 0.5).expand(len(near), -1)
    else:
        noise = torch.rand(len(near), num_samples, generator=generator, dtype=near.dtype)
        place = steps + noise.to(near.device)
    return near[:, None] + (far - near)[:, None] * place / num_samples
