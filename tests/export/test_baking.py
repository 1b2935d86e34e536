"""What stands in the textures is what the fields say."""

import io
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from mano_files import write_mano
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import middle_of_hand
from handavatar.edit import Edit, Paint
from handavatar.export.baking import (
    anchors_near,
    baked_textures,
    colors_at_vertices,
    mean_light,
)
from handavatar.export.surface import average_hand
from handavatar.field.anchors import nearest_anchors
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.colors import linear_from_srgb
from handavatar.geometry.meshes import SurfacePoints
from handavatar.hand.mano import read_mano
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.render.chart import charted
from handavatar.train.prior import load_prior

SIZE = 64
HALF_STEP = 0.5 / 255 + 1e-4


def _pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)))


@pytest.fixture(scope="module")
def hand(small_avatar: HandAvatar) -> ShapedHand:
    return average_hand(small_avatar, 4)


def _even_light(avatar: HandAvatar, value: float) -> None:
    torch.nn.init.zeros_(avatar.illumination.mlp.output.weight)
    torch.nn.init.constant_(avatar.illumination.mlp.output.bias, math.log(value / (1 - value)))


def _slow_face_at(rig: Rig, place: torch.Tensor) -> tuple[int, torch.Tensor]:
    """The face of the chart at a place, and where on it, looked for one by one."""
    for face, corners in enumerate(rig.uv_coordinates[rig.uv_faces].double()):
        system = torch.cat([corners.T, torch.ones(1, 3)])
        weights = torch.linalg.solve(system, torch.cat([place.double(), torch.ones(1)]))
        if float(weights.min()) >= 0:
            return face, weights.float()
    raise AssertionError("no face there")


@torch.no_grad()
def test_texels_hold_the_albedo_of_their_place_on_the_skin(
    small_avatar: HandAvatar, hand: ShapedHand
) -> None:
    pixels = _pixels(baked_textures(small_avatar, hand, Edit(), SIZE, False, False).base_color)
    assert pixels.shape == (SIZE, SIZE, 3)
    rig = hand.rig
    middle = rig.uv_coordinates[rig.uv_faces].mean(1)
    anchors = SurfacePoints(small_avatar.anchor_corners, small_avatar.anchor_barycentric)
    places = anchors.positions(hand.rest_vertices)
    for face in range(0, len(rig.faces), 150):
        column, row = (middle[face] * SIZE).long().tolist()
        centre = torch.tensor([column + 0.5, row + 0.5]) / SIZE
        found, weights = _slow_face_at(rig, centre)
        point = (hand.rest_vertices[rig.faces[found]] * weights[:, None]).sum(0)
        albedo = small_avatar.albedo(nearest_anchors(places, point[None]))[0]
        np.testing.assert_allclose(pixels[row, column] / 255, albedo, atol=HALF_STEP)


def test_stored_colours_are_written_as_they_are(small_avatar: HandAvatar, hand: ShapedHand) -> None:
    color, count = torch.tensor([0.5, 0.2, 0.8]), len(small_avatar.anchor_corners)
    paint = Paint(color.expand(count, 3), torch.ones(count))
    pixels = _pixels(
        baked_textures(small_avatar, hand, Edit(paint=paint), 32, has_occlusion=False).base_color
    )
    # 0.5 would be 188 if it were encoded once more, and 55 if it were decoded.
    assert np.array_equal(np.unique(pixels.reshape(-1, 3), axis=0), [[128, 51, 204]])


def test_a_stored_edit_and_one_on_top_are_in_the_texture(
    small_avatar: HandAvatar, hand: ShapedHand
) -> None:
    def baked(edit: Edit) -> np.ndarray:
        return _pixels(baked_textures(small_avatar, hand, edit, 32, False, False).base_color)

    plain, shifted = baked(Edit()), baked(Edit(albedo_shift=(0.1, 0.0, -0.1)))
    shift = np.array([25.5, 0, -25.5])
    expected = np.clip(plain + shift, 0, 255)
    assert np.abs(shifted - expected).max() <= 1
    before = small_avatar.edit
    small_avatar.edit = Edit(albedo_shift=(0.1, 0.0, 0.0))
    try:
        assert np.array_equal(baked(Edit(albedo_shift=(0.0, 0.0, -0.1))), shifted)
    finally:
        small_avatar.edit = before


def test_an_even_light_is_found_everywhere_and_its_gain_too(hand: ShapedHand) -> None:
    avatar = HandAvatar(hand.rig, torch.zeros(10), rounds=0, num_anchors=128)
    load_prior(avatar.occupancy)
    _even_light(avatar, 0.6)
    plain = mean_light(avatar, hand, Edit(), 3)
    torch.testing.assert_close(plain.anchors, torch.full((128,), 0.6), atol=1e-4, rtol=0)
    torch.testing.assert_close(plain.occlusion, torch.ones(128), atol=1e-3, rtol=0)
    dimmed = mean_light(avatar, hand, Edit(light_gain=0.5), 3)
    torch.testing.assert_close(dimmed.anchors, torch.full((128,), 0.3), atol=1e-4, rtol=0)
    half = linear_from_srgb(torch.tensor(0.5))
    torch.testing.assert_close(dimmed.occlusion, half.expand(128), atol=1e-3, rtol=0)


def test_light_that_is_baked_multiplies_the_colours(
    small_avatar: HandAvatar, hand: ShapedHand
) -> None:
    light = mean_light(small_avatar, hand, Edit(), 2)
    near = anchors_near(small_avatar, hand, hand.rest_vertices)
    plain = colors_at_vertices(small_avatar, hand, Edit())
    lit = colors_at_vertices(small_avatar, hand, Edit(), has_light_baked=True, light_poses=2)
    torch.testing.assert_close(lit, plain * near.interpolated(light.anchors[:, None]))
    assert not baked_textures(small_avatar, hand, Edit(), 32, True, light_poses=1).occlusion


@pytest.mark.slow
def test_the_light_of_a_pose_is_what_its_picture_shows(
    small_avatar: HandAvatar, hand: ShapedHand
) -> None:
    rig = small_avatar.base_rig
    fingers = sample_poses(rig, 1, torch.Generator().manual_seed(1))
    pose = HandPose(resolve_penetration(rig, fingers)[0], torch.zeros(3))
    light = mean_light(small_avatar, hand, Edit(light_gain=2.0), count=1).anchors
    middle = middle_of_hand(rig, pose)
    view = look_at(middle + torch.tensor([0.0, 0.6, 0.0]), middle, torch.tensor([-1.0, 0.0, 0.0]))
    camera = Camera((200.0, 200.0), (40.0, 40.0), 80, 80, view)
    picture = small_avatar.render(pose, camera, Edit(light_gain=2.0))
    state = small_avatar.prepare(pose)
    pixels, depths = project(camera, state.anchors.detach())
    column, row = pixels.long().unbind(-1)
    is_seen = (picture.alpha[row, column] > 0.99) & (state.anchor_normals[:, 1] > 0.5)
    is_seen &= (picture.depth[row, column] - depths).abs() < 4e-3
    assert int(is_seen.sum()) > 25
    # Half a pixel beside the anchor, a millimetre, the light of this avatar is another.
    shown = picture.illumination[row, column][is_seen]
    assert float((light[is_seen] - shown).abs().median()) < 0.02


def test_the_occlusion_is_a_grey_picture_of_half_the_size(
    small_avatar: HandAvatar, hand: ShapedHand
) -> None:
    grey = _pixels(baked_textures(small_avatar, hand, Edit(), SIZE, light_poses=2).occlusion)
    assert grey.shape == (SIZE // 2, SIZE // 2)
    assert grey.max() == 255 and grey.min() < 200


@pytest.mark.slow
@torch.no_grad()
def test_an_atlas_carries_the_same_colours_as_the_vertices(tmp_path: Path) -> None:
    mano = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl")).rig
    avatar = HandAvatar(mano, torch.zeros(10), rounds=0, num_anchors=128)
    avatar.albedo.codes.mul_(10)
    hand = average_hand(avatar, 3)
    rig = charted(mano, hand.rig, 0)
    hand = ShapedHand(rig, hand.rest_vertices, hand.rest_joints)
    pixels = _pixels(baked_textures(avatar, hand, Edit(), 512, False, False).base_color)
    middle = (rig.uv_coordinates[rig.uv_faces].mean(1) * 512).long()
    found = torch.from_numpy(pixels[middle[:, 1], middle[:, 0]] / 255).float()
    centres = hand.rest_vertices[rig.faces].mean(1)
    expected = avatar.albedo(anchors_near(avatar, hand, centres))
    # A texel off the middle of its face, where colours change from anchor to anchor.
    assert float((found - expected).abs().mean()) < 0.02


def test_the_light_of_a_clip_is_baked_as_its_camera_saw_it(
    two_lights: HandAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = average_hand(two_lights)
    first, second = (mean_light(two_lights, hand, Edit(light=light), 2) for light in (0, 1))
    assert float((first.anchors - second.anchors).abs().mean()) > 0.05
    # As an avatar of this light alone would be baked, in the view of this clip.
    monkeypatch.setattr(two_lights, "edit", Edit(light=1))
    monkeypatch.setattr(two_lights, "info", {"view": two_lights.info["views"][1]})
    alone = mean_light(two_lights, hand, Edit(), 2)
    assert torch.equal(alone.anchors, second.anchors)
