"""Registration to colours: it finds back, keeps to known pixels, and never makes it worse."""

from dataclasses import replace

import pytest
import torch
from conftest import bent_pose, camera_above
from torch import Tensor

from handavatar.avatar import HandAvatar, Rendering
from handavatar.capture.frames import Frame
from handavatar.evaluate.registered import registered_pose
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.render.rasterize import interpolate, rasterize

SIZE = 128


@pytest.fixture(scope="module")
def avatar() -> HandAvatar:
    torch.manual_seed(0)
    return HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=64)


def spotted(avatar: HandAvatar) -> Tensor:
    """A smooth pattern of colours on the skin, a wave each centimetre and a half."""
    places = avatar.rig.template_vertices
    waves = torch.sin(places @ torch.tensor([[400.0, 0, 90], [90, 0, 400], [280, 60, -280]]).T)
    return 0.5 + 0.25 * waves


def drawn(avatar: HandAvatar, pose: HandPose, camera: Camera) -> Rendering:
    """The mesh with its pattern, rasterised: what the avatar would look like."""
    posed = avatar.coarse_personal(pose).posed(pose)
    faces = posed.rig.faces
    fragments = rasterize(posed.vertices, faces, camera)
    alpha = fragments.mask.float()
    color = interpolate(fragments, faces, spotted(avatar)) * alpha[..., None]
    normal = interpolate(fragments, faces, vertex_normals(posed.vertices, faces))
    return Rendering(color, color, alpha, normal, fragments.depth.nan_to_num(posinf=0.0), alpha)


def photograph(avatar: HandAvatar, pose: HandPose) -> Frame:
    camera = camera_above(SIZE)
    rendering = drawn(avatar, pose, camera)
    return Frame(
        name="000000",
        image=(rendering.color * 255).round().byte(),
        coverage=(rendering.alpha * 255).byte(),
        camera=camera,
        pose=pose,
        confidence=0.9,
        split="test",
        time=0.0,
    )


def misread(pose: HandPose) -> HandPose:
    generator = torch.Generator().manual_seed(1)
    noise = 0.04 * torch.randn(pose.rotations.shape, generator=generator)
    return HandPose(pose.rotations + noise, pose.translation + torch.tensor([0.002, 0.0, -0.002]))


def distance(avatar: HandAvatar, first: HandPose, second: HandPose) -> float:
    """Mean distance of the vertices, metres."""
    places = [avatar.coarse_personal(pose).posed(pose).vertices for pose in (first, second)]
    return float((places[0] - places[1]).detach().norm(dim=-1).mean())


def test_a_misread_pose_is_drawn_to_the_picture(avatar: HandAvatar) -> None:
    true = bent_pose(2)
    frame, start = photograph(avatar, true), misread(true)
    found = registered_pose(avatar, frame, start, drawn(avatar, start, frame.camera))
    before, after = distance(avatar, start, true), distance(avatar, found, true)
    assert before > 0.003
    assert after < 0.5 * before
    # The prior keeps what the picture does not show.
    assert float((found.rotations - start.rotations).abs().max()) < 0.3


def test_turning_the_world_changes_nothing(avatar: HandAvatar) -> None:
    """How far a pose may be off depends on the line of sight, not on the world's axes."""
    true = bent_pose(2)
    frame, start = photograph(avatar, true), misread(true)
    # Little is seen, so that the expected errors have something to say.
    known = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    known[:45] = True
    frame = replace(frame, known=known)
    rendering = drawn(avatar, start, frame.camera)
    found = registered_pose(avatar, frame, start, rendering)

    turn = torch.tensor([0.4, 1.1, -0.7])
    world = torch.eye(4)
    world[:3, :3] = matrix_from_axis_angle(turn)
    wrist = avatar.coarse_personal(true).rest_joints[0].detach()
    rotations = start.rotations.clone()
    rotations[0] = axis_angle_from_matrix(world[:3, :3] @ matrix_from_axis_angle(rotations[0]))
    turned = HandPose(rotations, world[:3, :3] @ (wrist + start.translation) - wrist)
    placed = frame.camera.camera_from_world @ world.T
    view = replace(frame, camera=replace(frame.camera, camera_from_world=placed))
    again = registered_pose(avatar, view, turned, rendering)

    hand = avatar.coarse_personal(true)
    expected = hand.posed(found).vertices @ world[:3, :3].T
    apart = (hand.posed(again).vertices - expected).detach().norm(dim=-1)
    assert distance(avatar, start, found) > 1e-3
    # With errors along the world's axes, 3.1 mm; steps that end early leave 0.2.
    assert float(apart.mean()) < 4e-4


def test_landmarks_of_the_frame_are_not_asked(avatar: HandAvatar) -> None:
    true = bent_pose(2)
    frame, start = photograph(avatar, true), misread(true)
    rendering = drawn(avatar, start, frame.camera)
    places, sure = torch.zeros(21, 2), torch.full((21,), 1e-3)
    landmarks = LandmarkSightings(places, sure, torch.zeros(21), sure, torch.zeros(21, 3))
    found = [
        registered_pose(avatar, picture, start, rendering)
        for picture in (frame, replace(frame, landmarks=landmarks))
    ]
    assert torch.equal(found[0].rotations, found[1].rotations)


def test_gain_is_not_taken_for_a_pose_error(avatar: HandAvatar) -> None:
    true = bent_pose(2)
    frame, start = photograph(avatar, true), misread(true)
    gain = torch.tensor([1.15, 1.0, 0.85])
    image = (frame.image.float() * gain).clamp(0, 255).round().byte()
    frame = replace(frame, image=image, gain=gain)
    found = registered_pose(avatar, frame, start, drawn(avatar, start, frame.camera))
    assert distance(avatar, found, true) < 0.6 * distance(avatar, start, true)


def test_what_is_unknown_says_nothing(avatar: HandAvatar) -> None:
    true = bent_pose(2)
    frame, start = photograph(avatar, true), misread(true)
    rendering = drawn(avatar, start, frame.camera)
    known = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known[:, 70:] = False
    found = []
    for seed in (0, 1):
        noise = torch.randint(
            0, 256, frame.image.shape, generator=torch.Generator().manual_seed(seed)
        ).byte()
        image = torch.where(known[..., None], frame.image, noise)
        coverage = torch.where(known, frame.coverage, noise[..., 0])
        scribbled = replace(frame, image=image, coverage=coverage, known=known)
        found.append(registered_pose(avatar, scribbled, start, rendering))
    assert torch.equal(found[0].rotations, found[1].rotations)
    assert torch.equal(found[0].translation, found[1].translation)


def test_the_start_stays_where_colours_agree_no_better(avatar: HandAvatar) -> None:
    true = bent_pose(2)
    frame = photograph(avatar, true)
    # Nothing of the hand is seen.
    unseen = replace(frame, known=torch.zeros(SIZE, SIZE, dtype=torch.bool))
    nothing = replace(drawn(avatar, true, frame.camera), alpha=torch.zeros(SIZE, SIZE))
    assert registered_pose(avatar, frame, true, nothing) is not None
    for other, rendering in ((unseen, drawn(avatar, true, frame.camera)), (frame, nothing)):
        found = registered_pose(avatar, other, true, rendering)
        assert torch.equal(found.rotations, true.rotations)
        assert torch.equal(found.translation, true.translation)
    # What is right already hardly moves.
    found = registered_pose(avatar, frame, true, drawn(avatar, true, frame.camera))
    assert distance(avatar, found, true) < 3e-4


@pytest.mark.slow
def test_without_a_rendering_the_avatar_makes_one(avatar: HandAvatar) -> None:
    true = bent_pose(1)
    frame = photograph(avatar, true)
    with torch.no_grad():
        ready = avatar.render(true, frame.camera)
    found = [registered_pose(avatar, frame, true, picture) for picture in (None, ready)]
    assert torch.equal(found[0].rotations, found[1].rotations)
