"""Poses of an avatar in pictures: a silhouette's gradient is its motion's; a pose is found."""

import jaxtyping
import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above

from handavatar.avatar import HandAvatar, Rendering
from handavatar.errors import ArgumentError
from handavatar.evaluate.pose_fit import fit_pose
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.render.rasterize import interpolate, rasterize

SIZE = 96


def _moved(pose: HandPose, degrees: float, metres: tuple[float, float, float]) -> HandPose:
    turns = torch.randn(16, 3, generator=torch.Generator().manual_seed(1))
    turns = turns / turns.norm(dim=-1, keepdim=True) * torch.tensor(degrees).deg2rad()
    turned = matrix_from_axis_angle(pose.rotations) @ matrix_from_axis_angle(turns)
    return HandPose(axis_angle_from_matrix(turned), pose.translation + torch.tensor(metres))


def _across(avatar: HandAvatar, first: HandPose, second: HandPose) -> float:
    """Mean distance of vertices across the line of sight, nearly the y axis; millimetres."""
    posed = [avatar.coarse_personal(pose).posed(pose).vertices for pose in (first, second)]
    return float((posed[0] - posed[1])[:, ::2].norm(dim=-1).mean()) * 1000


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: what is wrong is refused by the library, not by the tests' type checks."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def test_the_silhouettes_gradient_is_that_of_its_motion(small_avatar: HandAvatar) -> None:
    """Against differences of half a millimetre, and of half a degree of a bent finger."""
    camera, pose = camera_above(SIZE), bent_pose(0)
    towards = torch.linspace(-1, 1, SIZE)[None].expand(SIZE, SIZE)

    def said(rotations: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
        coverage = small_avatar.silhouette(HandPose(rotations, translation), camera)
        return (coverage * towards).sum()

    rotations = pose.rotations.clone().requires_grad_(True)
    translation = pose.translation.clone().requires_grad_(True)
    said(rotations, translation).backward()
    step = 5e-4
    for axis in (0, 2):
        shift = torch.zeros(3)
        shift[axis] = step
        difference = said(pose.rotations, pose.translation + shift) - said(
            pose.rotations, pose.translation - shift
        )
        slope = float(difference.detach()) / (2 * step)
        assert abs(slope) > 100
        assert float(translation.grad[axis]) == pytest.approx(slope, rel=0.05, abs=20)
    turn = torch.zeros(16, 3)
    turn[0, 1] = np.radians(0.5)
    difference = said(pose.rotations + turn, pose.translation) - said(
        pose.rotations - turn, pose.translation
    )
    slope = float(difference.detach()) / float(2 * turn[0, 1])
    assert float(rotations.grad[0, 1]) == pytest.approx(slope, rel=0.1, abs=2)


def test_a_loss_of_ones_own_draws_the_hand_to_a_mask(small_avatar: HandAvatar) -> None:
    camera, truth = camera_above(SIZE), bent_pose(0)
    with torch.no_grad():
        mask = small_avatar.silhouette(truth, camera)
    translation = (truth.translation + torch.tensor([0.004, 0.0, -0.003])).requires_grad_(True)
    optimizer = torch.optim.Adam([translation], 1e-3)
    for _ in range(40):
        optimizer.param_groups[0]["lr"] *= 0.93
        optimizer.zero_grad()
        coverage = small_avatar.silhouette(HandPose(truth.rotations, translation), camera)
        (coverage - mask).square().mean().backward()
        optimizer.step()
    assert float((translation.detach() - truth.translation)[::2].norm()) < 5e-4


def _drawn(avatar: HandAvatar, pose: HandPose, camera: Camera, *_: object) -> Rendering:
    """The mesh with waves of colour a centimetre and a half long: as if the avatar had them."""
    posed = avatar.coarse_personal(pose).posed(pose)
    faces = posed.rig.faces
    fragments = rasterize(posed.vertices, faces, camera)
    waves = torch.tensor([[400.0, 0, 90], [90, 0, 400], [280, 60, -280]])
    colors = 0.5 + 0.25 * torch.sin(avatar.rig.template_vertices @ waves.T)
    alpha = fragments.mask.float()
    color = interpolate(fragments, faces, colors) * alpha[..., None]
    return Rendering(color, color, alpha, color, alpha, alpha)


@pytest.mark.slow
def test_a_pose_is_found_in_a_picture(
    small_avatar: HandAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the outline alone, and nearer by the colours; arrays of both kinds."""
    monkeypatch.setattr(HandAvatar, "render", _drawn)
    truth = bent_pose(0)
    # A small hand beside the middle of a larger picture, cut by its border.
    camera = camera_above(192).cropped(-150.0, -6.0, 420.0, 180.0)
    shown = small_avatar.render(truth, camera)
    start = _moved(truth, 4.0, (0.004, 0.0, -0.004))
    kept = small_avatar.coefficients.clone()
    outline = fit_pose(small_avatar, shown.color, shown.alpha, camera, start, uses_texture=False)
    levels = (shown.color.numpy() * 255).round().astype(np.uint8)
    colors = fit_pose(small_avatar, levels, shown.alpha.numpy() > 0.5, camera, start)
    across = [_across(small_avatar, pose, truth) for pose in (start, outline, colors)]
    assert across[0] > 5 and across[1] < 1 and across[2] < 0.5, across
    assert torch.equal(kept, small_avatar.coefficients)


def test_what_is_no_picture_is_refused_by_name(small_avatar: HandAvatar) -> None:
    camera, pose = camera_above(SIZE), bent_pose(0)
    image, mask = torch.rand(SIZE, SIZE, 3), torch.ones(SIZE, SIZE, dtype=torch.bool)
    for name, changed in {
        "image": {"image": image * 255},
        "image ": {"image": image.movedim(-1, 0)},
        "mask": {"mask": mask.byte()},
        "mask ": {"mask": mask & False},
        "camera": {"camera": "camera"},
        "start": {"start": pose.rotations},
        "pose_error": {"pose_error": 0.0},
        "Frame.coverage": {"mask": mask[:-1]},
    }.items():
        given = {"image": image, "mask": mask, "camera": camera, "start": pose} | changed
        with pytest.raises(ArgumentError) as caught:
            fit_pose(small_avatar, **given)
        assert caught.value.argument == name.strip()
    with pytest.raises(ArgumentError, match="camera"):
        small_avatar.silhouette(pose, None)  # type: ignore[arg-type]
