"""Motions to pictures and videos: what is written, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above
from PIL import Image

from handavatar.animate import (
    PASSES,
    RenderOptions,
    camera_on,
    edit_from,
    orbited,
    pass_pictures,
    render_motion,
)
from handavatar.avatar import CheckpointError, HandAvatar
from handavatar.capture.frames import CaptureError
from handavatar.edit import Edit
from handavatar.geometry.cameras import project

SIZE = 16


@pytest.fixture(scope="module")
def avatar_file(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("animate") / "avatar.safetensors"
    small_avatar.save(path)
    return path


@pytest.fixture(scope="module")
def motion_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = [bent_pose(step) for step in range(4)]
    path = tmp_path_factory.mktemp("motion") / "motion.json"
    motion = {
        "schema": 1,
        "fps": 10,
        "rotations": [pose.rotations.tolist() for pose in poses],
        "translations": [pose.translation.tolist() for pose in poses],
    }
    path.write_text(json.dumps(motion))
    return path


def _options(avatar_file: Path, motion_file: Path, out: Path, frames: int = 2) -> RenderOptions:
    return RenderOptions(
        avatar_file,
        str(motion_file),
        out,
        size=SIZE,
        frames=frames,
        num_samples=16,
        device="cpu",
    )


def _video(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_motion_becomes_pictures_and_a_video_that_plays(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "render"
    passes = ",".join(PASSES)
    options = replace(_options(avatar_file, motion_file, out, frames=3), passes=passes)
    assert render_motion(options) == out
    assert {path.name for path in out.iterdir()} == {*PASSES, *(f"{name}.mp4" for name in PASSES)}
    for name in PASSES:
        files = sorted((out / name).iterdir())
        assert [file.name for file in files] == ["000000.png", "000001.png", "000002.png"]
        pictures = np.stack([np.asarray(Image.open(file)) for file in files])
        assert pictures.shape == (3, SIZE, SIZE, 3) and pictures.any()
        frames = _video(out / f"{name}.mp4")
        assert len(frames) == 3 and frames[0].shape == (SIZE, SIZE, 3)
    alpha = np.stack([np.asarray(Image.open(file)) for file in sorted((out / "alpha").iterdir())])
    assert (alpha[0] != alpha[2]).any() and alpha.max() > 250
    # Grey without chroma: the video differs from the pictures by its compression alone.
    video = np.stack(_video(out / "alpha.mp4")).astype(float)
    assert np.abs(video - alpha).mean() < 12
    assert not list(out.parent.glob("*.unfinished"))


def test_orbiting_and_editing_change_the_pictures(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    plain = _options(avatar_file, motion_file, tmp_path / "plain")
    orbit = replace(plain, out=tmp_path / "orbit", orbit=True)
    bright = replace(plain, out=tmp_path / "bright", light_gain=1.6)
    first, second, third = (
        [np.asarray(Image.open(out / "rgb" / f"00000{i}.png")).astype(int) for i in (0, 1)]
        for out in map(render_motion, (plain, orbit, bright))
    )
    assert (first[0] == second[0]).all() and (first[1] != second[1]).any()
    assert third[0].sum() > 1.3 * first[0].sum()


def test_a_folder_that_is_not_empty_is_refused_unless_told(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious.txt").write_text("mine")
    options = _options(avatar_file, motion_file, tmp_path / "out", frames=1)
    with pytest.raises(ValueError, match="not empty"):
        render_motion(options)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["precious.txt"]
    render_motion(replace(options, overwrite=True))
    assert (tmp_path / "out" / "rgb.mp4").is_file()


def test_a_failure_on_the_way_leaves_nothing(
    avatar_file: Path, motion_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(HandAvatar, "render", failing)
    with pytest.raises(MemoryError):
        render_motion(_options(avatar_file, motion_file, tmp_path / "out"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"passes": "rgb,depht"}, "depht"),
        ({"passes": ""}, "passes"),
        ({"albedo_shift": "0.1,0"}, "three numbers"),
        ({"albedo_shift": "0.1,0,nan"}, "finite"),
        ({"light_gain": -1.0}, "gain not below 0"),
        ({"lift_shadow": "pinky"}, "neither a finger nor a bone"),
        ({"size": 0}, "size"),
        ({"frames": 0}, "frames"),
    ],
)
def test_bad_options_are_errors_before_any_work(
    avatar_file: Path, motion_file: Path, tmp_path: Path, change: dict[str, object], message: str
) -> None:
    options = replace(_options(avatar_file, motion_file, tmp_path / "out"), **change)
    with pytest.raises(ValueError, match=message):
        render_motion(options)
    assert not list(tmp_path.iterdir())


def test_missing_avatars_and_motions_are_errors(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(CheckpointError, match=r"holds no avatar\.safetensors"):
        HandAvatar.load(tmp_path)
    with pytest.raises(CheckpointError, match="no such file"):
        HandAvatar.load(tmp_path / "nothing")
    with pytest.raises(CaptureError):
        render_motion(_options(avatar_file, tmp_path / "none.json", tmp_path / "out"))
    assert not list(tmp_path.iterdir())


def test_a_left_hand_is_mirrored_back(small_avatar: HandAvatar) -> None:
    rendering = small_avatar.render(bent_pose(1), camera_above(SIZE))
    right, left = pass_pictures(rendering, "right"), pass_pictures(rendering, "left")
    assert set(right) == set(PASSES)
    for name in PASSES:
        assert (left[name] == right[name][:, ::-1]).all()
        assert left[name].dtype == np.uint8 and left[name].flags["C_CONTIGUOUS"]
    assert (left["rgb"] != right["rgb"]).any()


def test_edit_flags_become_an_edit() -> None:
    assert edit_from(1.0, "0,0,0", "") == Edit()
    assert edit_from(1.5, "0.1, -0.2,0", "thumb, index1") == Edit(
        1.5, (0.1, -0.2, 0.0), (13, 14, 15, 1)
    )


def test_the_camera_holds_the_hand_in_every_pose(small_avatar: HandAvatar) -> None:
    poses = [bent_pose(step) for step in (0, 4, 8)]
    camera = camera_on(small_avatar, poses, 100)
    for pose in poses:
        vertices = small_avatar.rig.shaped(small_avatar.coefficients).posed(pose).vertices
        pixels, depths = project(camera, vertices)
        assert float(pixels.min()) > 0 and float(pixels.max()) < 100 and float(depths.min()) > 0


def test_orbiting_keeps_the_centre_in_place_and_comes_round() -> None:
    camera, center = camera_above(32), torch.tensor([-0.08, 0.01, 0.02])
    there, depth = project(camera, center)
    for angle in (0.5, 2.0, 4.0):
        pixels, far = project(orbited(camera, center, angle), center)
        torch.testing.assert_close(pixels, there, atol=1e-3, rtol=0)
        torch.testing.assert_close(far, depth, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        orbited(camera, center, 2 * torch.pi).camera_from_world,
        camera.camera_from_world,
        atol=1e-5,
        rtol=0,
    )
