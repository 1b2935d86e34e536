"""Edits from the command line, paint from pictures, avatars that keep both."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above
from PIL import Image

from handavatar.avatar import HandAvatar, Rendering, RenderSettings
from handavatar.capture.checks import CaptureError
from handavatar.edit import Edit
from handavatar.field.shading import TracedCues
from handavatar.jobs.files import FolderInUse
from handavatar.retouch import EditOptions, Look, anchor_places, paint_from, save_edited

FEW = RenderSettings(num_samples=24)


def _seen(avatar: HandAvatar, edit: Edit | None = None) -> Rendering:
    return avatar.render(bent_pose(2), camera_above(24), edit, FEW)


@pytest.fixture
def stripes(tmp_path: Path) -> Path:
    """Opaque blue where u is below one half, nothing elsewhere."""
    pixels = np.zeros((64, 64, 4), dtype=np.uint8)
    pixels[:, :32] = (0, 0, 255, 255)
    Image.fromarray(pixels).save(tmp_path / "stripes.png")
    return tmp_path / "stripes.png"


def test_flags_become_an_edit(small_avatar: HandAvatar) -> None:
    assert Look().edit_on(small_avatar) == Edit()
    assert Look(light_gain=1.5, albedo_shift="0.1, -0.2,0", lift_shadow="thumb, index1").edit_on(
        small_avatar
    ) == Edit(1.5, (0.1, -0.2, 0.0), (13, 14, 15, 1))


@pytest.mark.parametrize("traced", [False, True])
def test_it_is_said_where_lifting_a_shadow_changes_next_to_nothing(
    small_avatar: HandAvatar, traced: bool, caplog: pytest.LogCaptureFixture
) -> None:
    avatar = small_avatar
    if traced:
        avatar = HandAvatar(avatar.base_rig, torch.zeros(10), 0, 64, cues=TracedCues(8))
    with caplog.at_level("WARNING"):
        Look(light_gain=1.5).edit_on(avatar)
        assert not caplog.records
        Look(lift_shadow="thumb").edit_on(avatar)
    said = [record.getMessage() for record in caplog.records]
    assert [("not traced" in one and "`method='best'`" in one) for one in said] == [True] * (
        not traced
    )


def test_anchors_lie_in_the_chart_where_their_face_does(small_avatar: HandAvatar) -> None:
    rig = small_avatar.rig
    corners, weights = small_avatar.anchor_corners, small_avatar.anchor_barycentric
    found = anchor_places(rig, corners, weights)
    for anchor in range(0, len(corners), 7):
        face = int((rig.faces == corners[anchor]).all(-1).nonzero()[0, 0])
        expected = sum(
            float(weight) * rig.uv_coordinates[corner]
            for weight, corner in zip(weights[anchor], rig.uv_faces[face], strict=True)
        )
        torch.testing.assert_close(found[anchor], expected)


def test_paint_lies_where_the_picture_has_it(small_avatar: HandAvatar, stripes: Path) -> None:
    paint = paint_from(stripes, small_avatar)
    u = anchor_places(
        small_avatar.rig, small_avatar.anchor_corners, small_avatar.anchor_barycentric
    )[:, 0]
    assert torch.equal(paint.opacity, (u < 0.5).float())
    assert 0.1 < float(paint.opacity.mean()) < 0.9
    torch.testing.assert_close(paint.colors[u < 0.5].mean(0), torch.tensor([0.0, 0.0, 1.0]))
    before, after = _seen(small_avatar), _seen(small_avatar, Edit(paint=paint))
    assert torch.equal(before.illumination, after.illumination)
    assert float((after.albedo - before.albedo)[..., 2].amax()) > 0.3


def test_an_edit_is_saved_into_an_avatar_and_the_next_comes_on_top(
    small_avatar: HandAvatar, stripes: Path, tmp_path: Path
) -> None:
    small_avatar.save(tmp_path / "plain.safetensors")
    saved = save_edited(
        EditOptions(
            tmp_path / "plain.safetensors",
            tmp_path / "edited.safetensors",
            light_gain=1.5,
            albedo_shift="0.1,0,-0.1",
            lift_shadow="thumb",
            paint=stripes,
        )
    )
    look = Look(
        light_gain=1.5, albedo_shift="0.1,0,-0.1", lift_shadow="thumb", paint=stripes
    ).edit_on(small_avatar)
    edited = HandAvatar.load(saved)
    expected = _seen(small_avatar, look)
    for name, value in vars(_seen(edited)).items():
        torch.testing.assert_close(value, getattr(expected, name), msg=name)
    again = save_edited(EditOptions(saved, tmp_path / "twice.safetensors", light_gain=0.5))
    assert HandAvatar.load(again).edit.light_gain == 0.75
    assert torch.equal(_seen(HandAvatar.load(again)).albedo, _seen(edited).albedo)
    # What was there is not touched.
    assert HandAvatar.load(tmp_path / "plain.safetensors").edit == Edit()
    with pytest.raises(FolderInUse, match=r"edited.safetensors exists"):
        save_edited(EditOptions(tmp_path / "plain.safetensors", saved))


def test_a_picture_that_is_no_paint_is_refused(small_avatar: HandAvatar, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "solid.png")
    with pytest.raises(CaptureError, match="no transparency"):
        paint_from(tmp_path / "solid.png", small_avatar)
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(CaptureError, match="not a PNG"):
        paint_from(tmp_path / "text.png", small_avatar)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"albedo_shift": "1,2"}, "expected three numbers"),
        ({"light_gain": -1.0}, "`light_gain`: found -1.0, expected 0 to 1000"),
        ({"albedo_shift": "nan,0,0"}, "`albedo_shift`: found nan, expected -1 to 1"),
        ({"lift_shadow": "pinky"}, "neither a finger nor a bone"),
    ],
)
def test_words_that_mean_nothing_are_refused(words: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Look(**words).check_look()


def test_the_light_of_a_clip_is_saved_and_another_one_shown_on_top(
    two_lights: HandAvatar, small_avatar: HandAvatar, tmp_path: Path
) -> None:
    two_lights.save(tmp_path / "two.safetensors")
    saved = save_edited(
        EditOptions(tmp_path / "two.safetensors", tmp_path / "second.safetensors", light=1)
    )
    second = HandAvatar.load(saved)
    assert torch.equal(_seen(second).color, _seen(two_lights, Edit(light=1)).color)
    # Other edits leave the light; another light takes its place.
    dimmed = EditOptions(saved, tmp_path / "dimmed.safetensors", light_gain=0.5)
    assert HandAvatar.load(save_edited(dimmed)).edit == Edit(0.5, light=1)
    assert torch.equal(_seen(second, Look(light=0).edit_on(second)).color, _seen(two_lights).color)
    out = tmp_path / "third.safetensors"
    with pytest.raises(ValueError, match=r"`light`: .* of number 2; choose from 0, 1"):
        save_edited(EditOptions(saved, out, light=2))
    assert not out.exists()
    with pytest.raises(ValueError, match=r"`light`: .* of number 1; choose from 0 "):
        Look(light=1).edit_on(small_avatar)
