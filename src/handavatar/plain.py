"""The slow, obvious rendering: every sample of every ray, every pair of parts, nothing skipped.

What the fast one (:meth:`handavatar.avatar.HandAvatar.render_rays`) is tested and measured against.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.avatar import HandAvatar, HandState, RayValues
from handavatar.field.anchors import NUM_NEIGHBOURS, Neighbours, inverse_distance_weights
from handavatar.geometry.cameras import Rays
from handavatar.render.sampling import depths_along, intervals_through_boxes
from handavatar.render.volume import composite, visibility


def plain_rays(
    avatar: HandAvatar,
    state: HandState,
    rays: Rays,
    num_samples: int = 64,
    points_at_once: int = 1024,
) -> RayValues:
    """Equations 2 to 4 at every sample; with gradient where gradients are enabled.

    A ray that meets no part box is evaluated like the others, between two arbitrary depths, and
    then counts as empty: outside the boxes there is no hand by definition.

    Args:
        avatar: whose fields.
        state: of the pose.
        rays: world rays.
        num_samples: per ray, at the depths of the fast evaluation.
        points_at_once: bounds the memory of single operations; the result is the same.

    Source: paper Sec. 3.2 and 3.3, Eq. 1 to 4.
    """
    boxes = state.codes.boxes
    near, far, is_hit = intervals_through_boxes(
        rays, boxes.bone_from_world, boxes.lower - boxes.margin, boxes.upper + boxes.margin
    )
    near, far = torch.where(is_hit, near, 0.1), torch.where(is_hit, far, 0.2)
    depths = depths_along(near, far, num_samples)
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    pieces = points.flatten(0, 1).split(points_at_once)

    decoded = [avatar.occupancy.plain(state.codes, piece) for piece in pieces]
    occupancy = torch.cat([whole for whole, _ in decoded]).view(depths.shape)
    soft = torch.cat([parts for _, parts in decoded]).detach()
    soft = soft.view(*depths.shape, soft.shape[-1])
    met = [soft[:, 0]]
    for sample in range(1, num_samples):
        met.append(torch.maximum(met[-1], soft[:, sample]))
    directed = torch.stack(met, dim=1).flatten(0, 1).split(points_at_once)

    shaded = torch.cat(
        [_shaded(avatar, state, *piece) for piece in zip(pieces, directed, strict=True)]
    )
    values = torch.cat(
        [
            shaded[:, :3] * shaded[:, 3:4],
            shaded,
            depths.flatten()[:, None],
            torch.ones_like(shaded[:, :1]),
        ],
        dim=-1,
    )
    total = composite(visibility(occupancy), values.view(*depths.shape, -1)) * is_hit[:, None]
    color, albedo, light, normal, depth, alpha = total.split([3, 3, 1, 3, 1, 1], dim=-1)
    return RayValues(color, albedo, light[:, 0], normal, depth[:, 0], alpha[:, 0])


def _shaded(
    avatar: HandAvatar,
    state: HandState,
    points: Float[Tensor, "points 3"],
    directed: Float[Tensor, "points bones"],
) -> Float[Tensor, "points 7"]:
    """Albedo, illumination and normal at every point; all distances to all anchors."""
    distances = (points[:, None].detach() - state.anchors.detach()).norm(dim=-1)
    indices = distances.topk(NUM_NEIGHBOURS, largest=False).indices
    weights = inverse_distance_weights(state.anchors, points, indices)
    neighbours = Neighbours(indices, weights)
    normals = (weights[..., None] * state.anchor_normals[indices]).sum(1)
    albedo = avatar.albedo(neighbours, avatar.detail_near(state.posed.vertices, points, neighbours))
    traced = (weights[..., None] * state.light[indices]).sum(1)
    light = avatar.illumination(
        state.posed.pose.rotations, neighbours, directed, normals, traced, avatar.light_of()
    )
    return torch.cat([albedo, light[:, None], normals], dim=-1)
