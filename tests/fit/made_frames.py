"""A painted hand, rasterised: frames whose poses, shape, colours and outlines are known."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.fit.contact import fill_with_balls
from handavatar.fit.energy import HandPoints, Observation
from handavatar.fit.kinematics import NUM_UNKNOWNS, RestPoints, Skeleton, moved_pose
from handavatar.fit.landmarks import LandmarkSightings, landmark_rest
from handavatar.fit.pictures import FramePicture
from handavatar.fit.shape import ShapeSpace, fixed_shape
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.meshes import sample_surface_evenly, vertex_normals
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.render.rasterize import interpolate, rasterize

FINER = 4
"""Pictures are drawn so many times as large, and averaged: outlines cover pixels in part."""
NO_POINTS = RestPoints(torch.zeros(0, 3), torch.zeros(0, 16), torch.zeros(0, 3, 0))


def camera_over(size: int) -> Camera:
    """A square camera that looks at the back of the hand and a little from the side."""
    middle = torch.tensor([-0.08, 0.0, 0.0])
    eye = middle + torch.tensor([0.03, 0.5, 0.06])
    placed = look_at(eye, middle, torch.tensor([-1.0, 0.0, 0.0]))
    return Camera((1.9 * size, 1.9 * size), (size / 2, size / 2), size, size, placed)


def painted(rig: Rig) -> Float[Tensor, "vertices 3"]:
    """Skin with blotches of about 2 cm, so that colours tell places apart."""
    x, y, z = (rig.template_vertices * (2 * math.pi / 0.02)).unbind(-1)
    waves = torch.stack([torch.sin(x + 1), torch.sin(z + 0.6 * x), torch.cos(y - z)], dim=-1)
    return torch.tensor([0.75, 0.55, 0.45]) * (1 + 0.25 * waves)


def calm_poses(rig: Rig, count: int, seed: int = 3) -> HandPose:
    """Poses as hands take them, fingers not closed altogether, seen from about above."""
    generator = torch.Generator().manual_seed(seed)
    rotations = 0.6 * sample_poses(rig, count, generator)
    rotations[:, 0] = 0.25 * torch.randn(count, 3, generator=generator)
    return HandPose(rotations, 0.01 * torch.randn(count, 3, generator=generator))


def draw(
    hand: ShapedHand, pose: HandPose, camera: Camera
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Colours before a grey wall, and how much of each pixel the hand covers."""
    faces = hand.rig.faces
    vertices = hand.posed(pose).vertices
    large = camera.resized(camera.width * FINER, camera.height * FINER)
    fragments = rasterize(vertices, faces, large)
    values = torch.cat([painted(hand.rig), vertex_normals(vertices, faces)], dim=-1)
    albedo, normals = interpolate(fragments, faces, values).split(3, dim=-1)
    light = (normals @ torch.tensor([0.3, 0.5, 0.2])) * 0.4 + 0.6
    mask = fragments.mask[..., None].float()
    picture = albedo * light[..., None] * mask + 0.4 * (1 - mask)
    stacked = torch.cat([picture, mask], dim=-1)
    small = stacked.unflatten(1, (camera.width, FINER)).unflatten(0, (camera.height, FINER))
    small = small.mean((1, 3))
    return small[..., :3], small[..., 3]


def observed(
    hand: ShapedHand,
    pose: HandPose,
    camera: Camera,
    time: float = 0.0,
    known: Bool[Tensor, "height width"] | None = None,
) -> Observation:
    """What a picture of one pose says."""
    color, coverage = draw(hand, pose, camera)
    if known is None:
        known = torch.ones_like(coverage, dtype=torch.bool)
    picture = FramePicture.of(camera, color, coverage, known, torch.ones(3))
    return Observation(picture, time)


NO_SKIN = torch.zeros(0, dtype=torch.long)


def sightings(
    hand: ShapedHand,
    pose: HandPose,
    camera: Camera,
    pixels_off: float = 3.0,
    vertices: Int[Tensor, "skin"] = NO_SKIN,
) -> LandmarkSightings:
    """What an exact tracker sees, moved by some pixels and two centimetres in depth."""
    space = fixed_shape(hand.rig)
    rest = landmark_rest(hand, space, torch.zeros(63), vertices)
    count = len(rest.positions)
    skeleton = Skeleton.of(hand, pose, space.joint_directions).padded(63)
    pixels, depths = project(camera, skeleton.positions(rest))
    generator = torch.Generator().manual_seed(5)
    pixels = pixels + pixels_off * torch.randn(count, 2, generator=generator)
    depths = depths + 0.02 * torch.randn(count, generator=generator)
    focal, center = torch.tensor(camera.focal), torch.tensor(camera.center)
    return LandmarkSightings(
        (pixels - center) / focal,
        (1 + 2 * torch.rand(count, generator=generator)) / focal[0],
        depths - depths.mean(),
        torch.full((count,), 0.02) * (1 + torch.arange(count) / count),
        torch.zeros(21, 3),
        vertices,
    )


def with_landmarks(points: HandPoints, vertices: Int[Tensor, "skin"] = NO_SKIN) -> HandPoints:
    """The same hand, with what a tracker's landmarks and points of the skin are on it."""
    rest = landmark_rest(points.hand, points.space, torch.zeros(63), vertices)
    return replace(points, landmarks=rest)


def observe_all(hand: ShapedHand, poses: HandPose, camera: Camera) -> list[Observation]:
    """All poses, a tenth of a second apart."""
    return [
        observed(hand, pose_at(poses, frame), camera, 0.1 * frame)
        for frame in range(len(poses.rotations))
    ]


def pose_at(poses: HandPose, frame: int) -> HandPose:
    """One of several poses."""
    return HandPose(poses.rotations[frame], poses.translation[frame])


def spoilt(poses: HandPose, degrees: float, seed: int = 0) -> HandPose:
    """Every joint turned by so many degrees (root mean square), moved by half as many mm."""
    generator = torch.Generator().manual_seed(seed)
    change = torch.randn(len(poses.rotations), NUM_UNKNOWNS, generator=generator)
    change[:, :-3] *= math.radians(degrees) / math.sqrt(3)
    change[:, -3:] *= 0.5e-3 * degrees
    return moved_pose(poses, change)


def points_on(hand: ShapedHand, space: ShapeSpace | None = None, count: int = 1500) -> HandPoints:
    """A hand to lay onto pictures, without landmarks."""
    rig = hand.rig
    generator = torch.Generator().manual_seed(0)
    surface = sample_surface_evenly(rig.template_vertices, rig.faces, count, generator)
    return HandPoints(hand, space or fixed_shape(rig), surface, fill_with_balls(rig), NO_POINTS)


def scribble(
    color: Float[Tensor, "height width 3"],
    coverage: Float[Tensor, "height width"],
    known: Bool[Tensor, "height width"],
    seed: int = 7,
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """The same picture and mask with noise wherever nothing is known."""
    noise = torch.rand(*known.shape, 4, generator=torch.Generator().manual_seed(seed))
    return (
        torch.where(known[..., None], color, noise[..., :3]),
        torch.where(known, coverage, noise[..., 3]),
    )


def moved_by(hand: ShapedHand, first: HandPose, second: HandPose) -> Float[Tensor, "frames"]:
    """Mean distance of the vertices in two poses, frame by frame, millimetres."""
    apart = hand.posed(first).vertices - hand.posed(second).vertices
    return 1000 * apart.norm(dim=-1).mean(-1)


def in_double(hand: ShapedHand) -> ShapedHand:
    """The same hand in float64."""
    fields = {
        name: value.double()
        for name, value in vars(hand.rig).items()
        if torch.is_tensor(value) and value.is_floating_point()
        if name in hand.rig.__dataclass_fields__
    }
    rig = replace(hand.rig, **fields)  # type: ignore[arg-type]
    return ShapedHand(rig, hand.rest_vertices.double(), hand.rest_joints.double())
