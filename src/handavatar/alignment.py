"""Draws a pose to the outline of a mask, never to the picture's colours.

Trackers are off by some pixels. Here the mesh's outline is laid onto the border of the mask by
Gauss-Newton steps: the residuals are the distances between the two along the outline, pixels, and
the unknowns are all joint rotations and the translation.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.hand.pose import (
    HandPose,
    bone_transforms,
    linear_blend_skinning,
    skinning_jacobian,
)
from handavatar.hand.rig import ShapedHand
from handavatar.render.rasterize import covered_pixels
from handavatar.render.silhouette import OutlinePoints, known_distance, outline_points

# Of the picture's width: how far apart outline and border are in a good fit, and how far apart
# they may be before something else than the pose is at fault.
_EXPECTED = 0.4 / 256
_OUTLIER = 1.5 / 256
# Neighbouring points err together: the whole outline says as much as so many independent ones.
_INDEPENDENT_POINTS = 200
# Expected errors of the pose to start from: radians; metres across and along the line of sight.
_ROTATION_ERROR = 0.12
_TRANSLATION_ERROR = (0.006, 0.006, 0.020)


@torch.no_grad()
def aligned_pose(
    hand_of: Callable[[HandPose], ShapedHand],
    pose: HandPose,
    camera: Camera,
    coverage: Float[Tensor, "height width"],
    steps: int = 16,
    start: HandPose | None = None,
    known: Bool[Tensor, "height width"] | None = None,
) -> HandPose:
    """A pose, moved a little so that the outline of the hand lies on the border of the mask.

    Where the mesh ends at the wrist, the mask was cut as the tracked pose had it, and this border
    counts like any other. The result covers the mask at least as well as what it began with.

    Args:
        hand_of: the rest hand of a pose.
        pose: as tracked; the result stays near it as far as the outline does not object.
        camera: of the picture.
        coverage: of each pixel by the hand in the picture, in [0, 1].
        steps: of Gauss-Newton.
        start: where to begin, if not at ``pose``.
        known: of the picture's pixels, those that show hand or background; None for all. Outline
            that lies elsewhere, or whose nearest border does, draws at nothing.
    """
    found = start or pose
    known = torch.ones_like(coverage, dtype=torch.bool) if known is None else known
    mask = (coverage >= 0.5) & known
    if not bool(mask.any()) or steps == 0:
        return found
    device = pose.rotations.device
    distance, was_seen = known_distance(coverage, known)
    distance, was_seen, known = (
        _smoothed(distance.to(device)),
        was_seen.to(device),
        known.to(device),
    )
    before = _overlap(hand_of(found), found, camera, mask, known)
    first = found
    for _ in range(steps):
        hand = hand_of(found)
        points = outline_points(hand.posed(found).vertices, hand.rig.faces, camera)
        if len(points.ends) == 0:
            return first
        found = _stepped(hand, points, pose, found, camera, distance, was_seen)
        if not bool(
            torch.isfinite(found.rotations).all() & torch.isfinite(found.translation).all()
        ):
            return first
    return found if _overlap(hand_of(found), found, camera, mask, known) >= before else first


def _stepped(
    hand: ShapedHand,
    points: OutlinePoints,
    tracked: HandPose,
    current: HandPose,
    camera: Camera,
    distance: Float[Tensor, "height width"],
    was_seen: Bool[Tensor, "height width"],
) -> HandPose:
    """One Gauss-Newton step from ``current``."""
    # What the pose adds to the rest vertices hardly changes within a step.
    rest = points.of(hand.rest_vertices + hand.rig.pose_offsets(current.rotations))
    weights = points.of(hand.rig.skin_weights)

    transforms = bone_transforms(current.rotations, hand.rest_joints)
    turning = skinning_jacobian(rest, weights, current.rotations, transforms, hand.rest_joints)
    with torch.enable_grad():
        placed = linear_blend_skinning(rest, weights, transforms, hand.rest_joints)
        placed = (placed + current.translation).requires_grad_()
        pixels = project(camera, placed)[0]
        residuals, slope = _sampled(distance, pixels.detach())
        # A pixel depends on its own point alone: one gradient of the sum has them all.
        (moving,) = torch.autograd.grad((pixels * slope).sum(), placed)
    turning = torch.einsum("pc,pcbk->pbk", moving, turning).flatten(1)
    jacobian = torch.cat([turning, moving], dim=1)
    values = torch.cat([current.rotations.flatten(), current.translation])
    # Geman and McClure's weights: what is far off has its own reasons.
    scale = camera.width * torch.tensor([_EXPECTED, _OUTLIER], device=values.device)
    trust = points.lengths / points.lengths.sum() * _INDEPENDENT_POINTS
    trust = trust / ((1 + (residuals / scale[1]).square()).square() * scale[0] ** 2)
    size = torch.tensor(was_seen.shape, device=values.device).flip(0)
    x, y = pixels.detach().floor().long().clamp_min(0).minimum(size - 1).unbind(-1)
    trust = trust * was_seen[y, x]
    moved = values - torch.cat([tracked.rotations.flatten(), tracked.translation])
    prior = _prior(len(values), camera)
    normal = torch.einsum("pu,p,pv->uv", jacobian, trust, jacobian) + prior
    gradient = torch.einsum("pu,p,p->u", jacobian, trust, residuals) + prior @ moved
    # On the CPU: for a GPU it is nothing, and torch's solver cannot begin in two threads at once.
    step = torch.linalg.solve(normal.cpu(), gradient.cpu())
    values = values - step.to(values.device)
    return HandPose(values[:-3].reshape(-1, 3), values[-3:])


def _prior(size: int, camera: Camera) -> Float[Tensor, "unknowns unknowns"]:
    """Inverse covariance of the tracked pose's errors."""
    rotation = camera.camera_from_world[:3, :3]
    prior = torch.eye(size, device=rotation.device) / _ROTATION_ERROR**2
    spread = torch.tensor(_TRANSLATION_ERROR, device=rotation.device)
    prior[-3:, -3:] = rotation.T @ torch.diag(spread**-2) @ rotation
    return prior


def _smoothed(distance: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Binomial filter of five pixels: the steps of the mask's border are not its shape."""
    kernel = distance.new_tensor([1.0, 4, 6, 4, 1]) / 16
    padded = torch.nn.functional.pad(distance[None, None], (2, 2, 2, 2), mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel[None, None, :, None])
    return torch.nn.functional.conv2d(rows, kernel[None, None, None, :])[0, 0]


def _sampled(
    image: Float[Tensor, "height width"], pixels: Float[Tensor, "points 2"]
) -> tuple[Float[Tensor, "points"], Float[Tensor, "points 2"]]:
    """Bilinear values and their slopes over one pixel; beyond the picture its border goes on."""
    size = pixels.new_tensor([image.shape[1], image.shape[0]])
    half = pixels.new_tensor([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    grid = (pixels + half[:, None]) / size * 2 - 1
    values = torch.nn.functional.grid_sample(
        image[None, None], grid[None], padding_mode="border", align_corners=False
    )[0, 0]
    return values[0], torch.stack([values[1] - values[2], values[3] - values[4]], dim=-1)


def _overlap(
    hand: ShapedHand,
    pose: HandPose,
    camera: Camera,
    mask: Bool[Tensor, "height width"],
    known: Bool[Tensor, "height width"],
) -> float:
    """Intersection over union of the posed hand and the mask, of the known pixels."""
    covered = covered_pixels(hand.posed(pose).vertices, hand.rig.faces, camera) & known
    mask = mask.to(covered.device)
    return int((covered & mask).sum()) / max(int((covered | mask).sum()), 1)
