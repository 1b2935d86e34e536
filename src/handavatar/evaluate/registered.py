"""Draws a held-out pose to the picture's colours, with the avatar frozen: protocol ``registered``.

Gauss-Newton steps with damping. The avatar is rendered once, at the pose to start from; points of
its coarse mesh take their colours from there and carry them to wherever the pose puts them.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, normalize, pad

from handavatar.avatar import HandAvatar, Rendering
from handavatar.capture.frames import Frame
from handavatar.evaluate.metrics import depth_inside, exposed
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import SurfacePoints, vertex_normals
from handavatar.hand.pose import (
    HandPose,
    bone_transforms,
    linear_blend_skinning,
    skinning_jacobian,
)
from handavatar.hand.rig import ShapedHand
from handavatar.render.rasterize import covered_pixels, rasterize

# Both pictures are blurred by so much, pixels of 256, and stepped on so many times.
_LEVELS = ((3.0, 3), (1.5, 3), (0.7, 2))
# Expected errors of the pose to start from: radians; metres across and along the line of sight.
_ROTATION_ERROR = math.radians(3)
_TRANSLATION_ERROR = (0.003, 0.003, 0.006)
# Of colours in [0, 1]: what light and albedo leave unexplained, and what is of another surface.
_EXPECTED = 0.03
_OUTLIER = 0.12
# Neighbouring points err together: all of them say as much as so many independent ones.
_INDEPENDENT_POINTS = 200
# Cosine to the line of sight, and how far behind the nearest surface a point is still visible.
_FACING = 0.25
_BEHIND = 0.003
_MOST_TURN, _MOST_SHIFT = 0.1, 0.01


@dataclass(frozen=True, eq=False)
class _Level:
    """One blur: the photograph, and what the chosen points look like in the avatar's colours."""

    photograph: Float[Tensor, "4 height width"]
    colors: Float[Tensor, "points 3"]


@dataclass(frozen=True, eq=False)
class _Points:
    """Chosen points of the rest hand, visible at the pose to start from."""

    hand: ShapedHand
    rest: Float[Tensor, "points 3"]
    weights: Float[Tensor, "points bones"]
    trust: Float[Tensor, "points"]
    camera: Camera


_LOST_OVERLAP = 0.003
"""Of the overlap of mesh and mask: so much may go for better colours."""


@torch.no_grad()
def registered_pose(
    avatar: HandAvatar, frame: Frame, start: HandPose, rendering: Rendering | None = None
) -> HandPose:
    """A pose near the start at which the frozen avatar's colours lie on the picture's.

    Unknown pixels say nothing. The start is returned as it is where the colours would not agree
    better, where the mesh would leave the mask for it, or where too little of the hand is visible.

    Args:
        avatar: its colours stay as they are.
        frame: picture, mask, camera and gain.
        start: e.g. the pose that fits the mask; about 3 degrees and 3 mm are allowed for.
        rendering: of the avatar at the start, if there is one already, on any device.
    """
    device = start.rotations.device
    if rendering is None:
        rendering = avatar.render(start.to(avatar.device), frame.camera.to(avatar.device))
    start = start.to("cpu")
    frame_camera = frame.camera.to("cpu")
    hand = _on_cpu(avatar.coarse_personal(start.to(avatar.device)))
    inside = depth_inside(frame.mask) > 1
    covered = rendering.alpha.cpu() > 0.95
    points, places = _visible_points(hand, start, frame_camera, covered)
    if len(places) < 50:
        return start.to(device)
    image, color = frame.image.float() / 255, exposed(rendering.color.cpu(), frame.gain)
    scale = frame_camera.width / 256
    found, last = start, None
    for sigma, steps in _LEVELS:
        photograph = _blurred_inside(image, inside, sigma * scale)
        model = _blurred_inside(color, covered, sigma * scale)
        level = _Level(photograph, _sampled(model, places)[0][:, :3])
        found, last = _descended(points, level, start, found, steps), level
    if last is None or not _photometric(points, last, found) < _photometric(points, last, start):
        return start.to(device)
    # Colours alone may drift across the outline, which they do not look at.
    before, after = (_overlap(hand, pose, frame) for pose in (start, found))
    return (found if after >= before - _LOST_OVERLAP else start).to(device)


def _overlap(hand: ShapedHand, pose: HandPose, frame: Frame) -> float:
    """Intersection over union of the posed mesh and the mask, known pixels alone."""
    covered = covered_pixels(hand.posed(pose).vertices, hand.rig.faces, frame.camera.to("cpu"))
    covered = covered & frame.known
    return int((covered & frame.mask).sum()) / max(int((covered | frame.mask).sum()), 1)


def _on_cpu(hand: ShapedHand) -> ShapedHand:
    return ShapedHand(hand.rig.to("cpu"), hand.rest_vertices.cpu(), hand.rest_joints.cpu())


def _visible_points(
    hand: ShapedHand, pose: HandPose, camera: Camera, covered: Bool[Tensor, "height width"]
) -> tuple[_Points, Float[Tensor, "points 2"]]:
    """Middles of faces that face the camera, are hidden by nothing, and that the avatar covers."""
    faces = hand.rig.faces
    middles = SurfacePoints(faces, torch.full(faces.shape, 1 / 3))
    vertices = hand.posed(pose).vertices
    places = middles.positions(vertices)
    normals = normalize(middles.positions(vertex_normals(vertices, faces)), dim=-1)
    rotation, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    facing = (normals * normalize(-(shift @ rotation) - places, dim=-1)).sum(-1)
    pixels, depths = project(camera, places)
    size = torch.tensor([camera.width, camera.height])
    is_in = ((pixels >= 0) & (pixels < size)).all(-1) & (depths > 0)
    x, y = pixels.nan_to_num().long().clamp_min(0).minimum(size - 1).unbind(-1)
    nearest = rasterize(vertices, faces, camera).depth[y, x]
    is_seen = is_in & (facing > _FACING) & (depths < nearest + _BEHIND) & covered[y, x]
    chosen = SurfacePoints(faces[is_seen], middles.barycentric[is_seen])
    corners = places.new_zeros(0) if not len(chosen.faces) else vertices[chosen.faces]
    area = facing[is_seen]
    if len(chosen.faces):
        edges = corners[:, 1:] - corners[:, :1]
        area = area * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=-1)
    rest = hand.rest_vertices + hand.rig.pose_offsets(pose.rotations)
    points = _Points(
        hand,
        chosen.positions(rest),
        chosen.positions(hand.rig.skin_weights),
        area / area.sum().clamp_min(1e-12) * _INDEPENDENT_POINTS,
        camera,
    )
    return points, pixels[is_seen]


def _descended(
    points: _Points, level: _Level, start: HandPose, current: HandPose, steps: int
) -> HandPose:
    """Levenberg and Marquardt's steps; a step that makes the energy worse is not taken."""
    prior = _prior(points.camera)
    origin, values = _as_vector(start), _as_vector(current)
    damping = 1e-2

    def energy(trial: Float[Tensor, "unknowns"]) -> float:
        moved = trial - origin
        return _photometric(points, level, _as_pose(trial)) + float(moved @ prior @ moved)

    least = energy(values)
    for _ in range(steps):
        normal, gradient = _normal_equations(points, level, _as_pose(values))
        normal, gradient = normal + prior, gradient + prior @ (values - origin)
        for _ in range(3):
            damped = normal + damping * torch.diag(normal.diagonal())
            step = torch.linalg.solve(damped, gradient)
            step[:-3] = step[:-3].clamp(-_MOST_TURN, _MOST_TURN)
            step[-3:] = step[-3:].clamp(-_MOST_SHIFT, _MOST_SHIFT)
            trial = values - step
            reached = energy(trial) if bool(torch.isfinite(trial).all()) else math.inf
            if reached < least:
                values, least, damping = trial, reached, damping / 5
                break
            damping *= 10
        else:
            break
    return _as_pose(values)


def _photometric(points: _Points, level: _Level, pose: HandPose) -> float:
    """Geman and McClure's energy of the colour residuals; off the hand a point is an outlier."""
    hand = points.hand
    transforms = bone_transforms(pose.rotations, hand.rest_joints)
    placed = linear_blend_skinning(points.rest, points.weights, transforms, hand.rest_joints)
    pixels, _ = project(points.camera, placed + pose.translation)
    found, _ = _sampled(level.photograph, pixels)
    squared = (found[:, :3] - level.colors).square().mean(-1)
    robust = squared / (1 + squared / _OUTLIER**2)
    on_hand = found[:, 3].clamp(0, 1)
    robust = on_hand * robust + (1 - on_hand) * _OUTLIER**2
    return float((points.trust * robust).sum()) / _EXPECTED**2


def _normal_equations(
    points: _Points, level: _Level, pose: HandPose
) -> tuple[Float[Tensor, "unknowns unknowns"], Float[Tensor, "unknowns"]]:
    hand, camera = points.hand, points.camera
    transforms = bone_transforms(pose.rotations, hand.rest_joints)
    turning = skinning_jacobian(
        points.rest, points.weights, pose.rotations, transforms, hand.rest_joints
    )
    placed = linear_blend_skinning(points.rest, points.weights, transforms, hand.rest_joints)
    placed = placed + pose.translation
    pixels, _ = project(camera, placed)
    found, slopes = _sampled(level.photograph, pixels)
    moving = torch.einsum("pci,piw->pcw", slopes[:, :3], _pixel_slopes(camera, placed))
    jacobian = torch.cat([torch.einsum("pcw,pwbk->pcbk", moving, turning).flatten(2), moving], -1)
    residuals = found[:, :3] - level.colors
    squared = residuals.square().mean(-1)
    trust = points.trust * found[:, 3].clamp(0, 1) / (1 + squared / _OUTLIER**2).square()
    trust = trust / (3 * _EXPECTED**2)
    weighted = jacobian * trust[:, None, None]
    normal = torch.einsum("pcu,pcv->uv", weighted, jacobian)
    return normal, torch.einsum("pcu,pc->u", weighted, residuals)


def _pixel_slopes(camera: Camera, places: Float[Tensor, "points 3"]) -> Float[Tensor, "points 2 3"]:
    """How image positions move with places in the world, pixels per metre."""
    rotation, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    x, y, depth = (places @ rotation.T + shift).unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack([1 / depth, zero, -x / depth**2], -1) * camera.focal[0]]
    rows.append(torch.stack([zero, 1 / depth, -y / depth**2], -1) * camera.focal[1])
    return torch.stack(rows, dim=1) @ rotation


def _prior(camera: Camera) -> Float[Tensor, "unknowns unknowns"]:
    """Inverse covariance of the errors of the pose to start from."""
    rotation = camera.camera_from_world[:3, :3]
    spread = torch.tensor(_TRANSLATION_ERROR)
    prior = torch.eye(51) / _ROTATION_ERROR**2
    prior[-3:, -3:] = rotation.T @ torch.diag(spread**-2) @ rotation
    return prior


def _as_vector(pose: HandPose) -> Float[Tensor, "unknowns"]:
    return torch.cat([pose.rotations.flatten(), pose.translation])


def _as_pose(values: Float[Tensor, "unknowns"]) -> HandPose:
    return HandPose(values[:-3].reshape(-1, 3), values[-3:])


def _blurred_inside(
    image: Float[Tensor, "height width 3"], mask: Bool[Tensor, "height width"], sigma: float
) -> Float[Tensor, "4 height width"]:
    """Colours blurred inside the mask, carried a little beyond; how far a pixel is inside."""
    weight = mask.float()[None]
    values = torch.where(mask, image.movedim(-1, 0), torch.zeros(()))
    radius = max(1, math.ceil(3 * sigma))
    places = torch.arange(-radius, radius + 1).float()
    kernel = torch.exp(-0.5 * (places / sigma).square())
    kernel = kernel / kernel.sum()
    padded = pad(torch.cat([values, weight])[:, None], (radius,) * 4)
    rows = conv2d(padded, kernel[None, None, :, None])
    blurred = conv2d(rows, kernel[None, None, None, :])[:, 0]
    return torch.cat([blurred[:3] / blurred[3:].clamp_min(1e-4), weight])


def _sampled(
    image: Float[Tensor, "channels height width"], pixels: Float[Tensor, "points 2"]
) -> tuple[Float[Tensor, "points channels"], Float[Tensor, "points channels 2"]]:
    """Bilinear values and their slopes over one pixel; beyond the picture there is nothing."""
    size = pixels.new_tensor([image.shape[2], image.shape[1]])
    half = pixels.new_tensor([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    grid = (pixels + half[:, None]) / size * 2 - 1
    values = grid_sample(image[None], grid[None], padding_mode="zeros", align_corners=False)[0]
    values = values.permute(1, 2, 0)
    return values[0], torch.stack([values[1] - values[2], values[3] - values[4]], dim=-1)
