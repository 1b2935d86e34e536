"""The fast renderer against the slow, obvious one: values and gradients, wherever a ray may go."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from conftest import bent_pose, camera_above
from torch import Tensor

from handavatar.avatar import EXACT, HandAvatar, RayValues, RenderSettings
from handavatar.evaluate.speed_table import hand_camera
from handavatar.field.shading import CueSet, OrientedCues, PaperCues, TracedCues
from handavatar.geometry.cameras import Camera, Rays, pixel_centers, rays_through_pixels
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.plain import plain_rays

EVERYTHING = RenderSettings(
    num_samples=24, smallest_weight=0.0, stop=0.0, coarse=1, mask_margin=math.inf
)
"""Nothing is skipped that could weigh anything."""


def _rays(camera: Camera) -> Rays:
    return rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1))


def _gesture(avatar: HandAvatar, name: str) -> HandPose:
    return HandPose(gesture_rotations(avatar.base_rig, name), torch.zeros(3))


def _assert_alike(avatar: HandAvatar, pose: HandPose, camera: Camera) -> RayValues:
    """Fast equals plain at every ray; returns the plain values."""
    with torch.no_grad():
        state = avatar.prepare(pose)
        found = avatar.render_rays(state, _rays(camera), EVERYTHING)
        expected = plain_rays(avatar, state, _rays(camera), 24, points_at_once=512)
    for name, value in vars(expected).items():
        # Fast and plain occupancies differ by 2e-5 at most (tests/field/test_occupancy.py), and so
        # does each of the few samples of a ray that are neither empty nor behind the surface.
        torch.testing.assert_close(getattr(found, name), value, atol=5e-5, rtol=0)
        assert float((getattr(found, name) - value).abs().mean()) < 1e-6, name
    return expected


@pytest.mark.parametrize("gesture", ["flat", "fist", "pinch", "crossed_fingers"])
def test_skipping_nothing_equals_the_plain_renderer(small_avatar: HandAvatar, gesture: str) -> None:
    values = _assert_alike(small_avatar, _gesture(small_avatar, gesture), camera_above(10))
    assert 0.1 < float(values.alpha.mean()) < 0.9


@pytest.mark.parametrize("height", [0.0, 0.012, 0.05])
def test_so_it_is_in_and_at_the_hand(small_avatar: HandAvatar, height: float) -> None:
    values = _assert_alike(small_avatar, bent_pose(0), camera_above(6, max(height, 1e-3)))
    assert float(values.alpha.max()) > 0.9


def test_so_it_is_where_the_picture_cuts_the_hand(small_avatar: HandAvatar) -> None:
    camera = camera_above(10)
    cut = replace(camera, center=(1.0, 9.0))
    values = _assert_alike(small_avatar, bent_pose(2), cut).alpha.view(10, 10)
    border = torch.cat([values[0], values[-1], values[:, 0], values[:, -1]])
    assert float(border.max()) > 0.9 and float(values.min()) < 0.1


def test_where_no_hand_is_both_see_nothing(small_avatar: HandAvatar) -> None:
    values = _assert_alike(
        small_avatar, bent_pose(2), replace(camera_above(6), center=(900.0, 3.0))
    )
    assert not any(bool(value.any()) for value in vars(values).values())


@pytest.mark.parametrize("cues", [PaperCues(), OrientedCues(), TracedCues(20)])
def test_random_fields_are_rendered_alike_too(small_avatar: HandAvatar, cues: CueSet) -> None:
    """Half transparent everywhere: no ray ends early, and every sample weighs something."""
    torch.manual_seed(2)
    avatar = HandAvatar(
        small_avatar.base_rig,
        torch.zeros(10),
        rounds=0,
        num_anchors=64,
        cues=cues,
    )
    _assert_alike(avatar, bent_pose(2), camera_above(6))


@pytest.mark.parametrize("bound", [1e-3, 1e-2, 5e-2])
def test_what_is_skipped_costs_no_more_than_it_weighs(
    small_avatar: HandAvatar, bound: float
) -> None:
    """Colours lie in [0, 1]: a ray is off by at most the weight that it lacks."""
    camera, pose = camera_above(12), bent_pose(2)
    settings = replace(EVERYTHING, smallest_weight=bound, stop=bound)
    with torch.no_grad():
        state = small_avatar.prepare(pose)
        found = small_avatar.render_rays(state, _rays(camera), settings)
        whole = plain_rays(small_avatar, state, _rays(camera), 24)
    lacking = whole.alpha - found.alpha
    assert float(lacking.min()) > -5e-5 and float(lacking.max()) < 24 * bound + bound
    assert float(lacking.max()) > 0.1 * bound, "something is skipped"
    for name in ("color", "albedo", "illumination"):
        error = (getattr(found, name) - getattr(whole, name)).abs().view(144, -1).amax(1)
        assert bool((error <= lacking.clamp_min(0) + 5e-5).all()), name


def test_the_size_of_the_pieces_does_not_matter(small_avatar: HandAvatar) -> None:
    rays = _rays(camera_above(6))
    with torch.no_grad():
        state = small_avatar.prepare(bent_pose(1))
        first, second = (plain_rays(small_avatar, state, rays, 16, size) for size in (100, 4096))
    for name, value in vars(first).items():
        torch.testing.assert_close(value, getattr(second, name), atol=2e-5, rtol=0)


def test_the_default_settings_lose_less_than_can_be_seen(small_avatar: HandAvatar) -> None:
    """70 dB is an error of 0.08 of the 255 steps of a pixel."""
    pose, camera = bent_pose(2), camera_above(12)
    with torch.no_grad():
        state = small_avatar.prepare(pose)
        expected = plain_rays(small_avatar, state, _rays(camera), 64)
        found = small_avatar.render(pose, camera, settings=RenderSettings(edge_rays=1))
    for name in ("color", "albedo", "alpha"):
        seen = getattr(found, name).flatten(0, 1).view(144, -1)
        error = seen - getattr(expected, name).view(144, -1)
        assert -10 * math.log10(float(error.square().mean()) + 1e-12) > 70, name


@pytest.mark.parametrize("sharpness", [1.0, 3.0])
def test_what_is_thin_is_found_between_coarse_samples(
    small_avatar: HandAvatar, monkeypatch: pytest.MonkeyPatch, sharpness: float
) -> None:
    """The sharper the field, the shorter the tail that a coarse sample can see."""
    monkeypatch.setattr(small_avatar.occupancy, "sharpness", sharpness)
    # From the side, where fingers lie one behind the other, a ray is long and its samples sparse.
    for gesture in ("relaxed", "point"):
        pose = _gesture(small_avatar, gesture)
        with torch.no_grad():
            vertices = small_avatar.prepare(pose).posed.vertices
        camera = hand_camera(vertices, (0.3, 0.2, 1.0), 48)
        exact, found = (
            small_avatar.render(pose, camera, settings=replace(settings, edge_rays=1))
            for settings in (EXACT, RenderSettings())
        )
        assert float((exact.color - found.color).abs().max()) < 0.01, gesture


def _scalar(values: RayValues) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return sum(
        (torch.randn(value.shape, generator=generator) * value).sum()
        for value in vars(values).values()
    )


def test_the_two_pass_gradient_is_the_whole_gradient(small_avatar: HandAvatar) -> None:
    """Evaluated first without gradient, then again where it can be seen: nothing is lost."""
    rays = _rays(camera_above(8))
    parameters = dict(small_avatar.named_parameters())
    seen = small_avatar.render_rays(small_avatar.prepare(bent_pose(2)), rays, EVERYTHING)
    found = torch.autograd.grad(_scalar(seen), list(parameters.values()))
    state = small_avatar.prepare(bent_pose(2))
    plain = plain_rays(small_avatar, state, rays, 24)
    expected = torch.autograd.grad(_scalar(plain), list(parameters.values()))
    for name, ours, theirs in zip(parameters, found, expected, strict=True):
        assert float(theirs.norm()) > 0 or name.endswith("bias"), name
        # float32 through a dozen layers and back. The offsets' common shift is undone at the wrist:
        # its gradient (shape.mlp.output.bias) is a sum that cancels, known to 1e-5.
        assert float((ours - theirs).norm()) <= 1e-4 * float(theirs.norm()) + 1e-5, name


def test_so_it_is_with_detail(small_avatar: HandAvatar) -> None:
    avatar = copy.deepcopy(small_avatar)
    texture = avatar.give_texture(64)
    with torch.no_grad():
        texture.texels.copy_(0.2 * torch.randn(64, 64, 3))
        without = small_avatar.render_rays(
            small_avatar.prepare(bent_pose(0)), _rays(camera_above(6)), EVERYTHING
        )
    values = _assert_alike(avatar, bent_pose(0), camera_above(6))
    assert float((values.albedo - without.albedo).abs().max()) > 0.02
