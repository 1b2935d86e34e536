"""Motions to pictures and videos: what is written, and what is refused."""

import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above
from PIL import Image
from two_processes import ended, two_begun

from handavatar import cli
from handavatar.animate import (
    PASSES,
    RenderOptions,
    _what_frames_depend_on,
    camera_on,
    orbited,
    pass_pictures,
    posed_as_seen,
    render_motion,
    rendering_error,
)
from handavatar.avatar import CheckpointError, HandAvatar, Rendering, RenderSettings
from handavatar.capture.frames import CaptureError
from handavatar.capture.motion import gesture, named_motion
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.geometry.cameras import project
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import MARKER, FolderInUse
from handavatar.train.runs import create_run

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
    names = {*PASSES, *(f"{name}.mp4" for name in PASSES), MARKER}
    assert {path.name for path in out.iterdir()} == names
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
    with pytest.raises(FolderInUse, match="not empty"):
        render_motion(options)
    with pytest.raises(FolderInUse, match="holds no pictures of this program's making"):
        render_motion(replace(options, overwrite=True))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["precious.txt"]
    assert (tmp_path / "out" / "precious.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_pictures_are_replaced_when_told_but_not_with_a_file_that_is_not_theirs(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    options = _options(avatar_file, motion_file, tmp_path / "out", frames=1)
    bright = replace(options, light_gain=1.5, overwrite=True)
    dark = _contents(render_motion(options))
    with pytest.raises(FolderInUse, match="not empty"):
        render_motion(replace(bright, overwrite=False))
    assert _contents(options.out) == dark
    (options.out / "rgb" / "notes.txt").write_text("mine")
    with pytest.raises(FolderInUse, match=r"holds rgb/notes\.txt, not written by this program"):
        render_motion(bright)
    assert (options.out / "rgb" / "notes.txt").read_text() == "mine"
    (options.out / "rgb" / "notes.txt").unlink()
    assert _contents(options.out) == dark
    assert _contents(render_motion(bright)) != dark
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_run_is_not_replaced_by_its_pictures(
    avatar_file: Path, motion_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = create_run(
        tmp_path / "run", {}, seed=1, capture=tmp_path, capture_sha256="", perceptual="x"
    ).folder
    shutil.copyfile(avatar_file, run / "avatar.safetensors")
    before = _contents(run)
    words = ["render", str(run), "--motion", str(motion_file), "--out", str(run), "--overwrite"]
    assert cli.main(words) == 2
    assert f"{run} is what is read: {run}" in capsys.readouterr().err
    words[1] = str(run / "avatar.safetensors")
    assert cli.main(words) == 2
    assert f"{run} holds what is read: {run}" in capsys.readouterr().err
    words[1] = str(avatar_file)
    assert cli.main(words) == 2
    assert "is marked as run, not as pictures" in capsys.readouterr().err
    (run / MARKER).unlink()
    assert cli.main(words) == 2
    assert "name another folder" in capsys.readouterr().err
    assert _contents(run) == before and not list(tmp_path.glob("*.unfinished"))


def test_another_ones_unfinished_folder_stays(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    other = tmp_path / "K.unfinished"
    other.mkdir()
    (other / "f").write_text("hi")
    options = _options(avatar_file, motion_file, tmp_path / "K", frames=1)
    for overwrite in (False, True):
        with pytest.raises(FolderInUse, match=r"K\.unfinished is in the way"):
            render_motion(replace(options, overwrite=overwrite))
    assert (other / "f").read_text() == "hi" and not options.out.exists()


def test_a_failure_on_the_way_leaves_nothing(
    avatar_file: Path, motion_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(HandAvatar, "render", failing)
    with pytest.raises(MemoryError):
        render_motion(_options(avatar_file, motion_file, tmp_path / "out"))
    assert not list(tmp_path.iterdir())


def test_what_was_rendered_before_the_end_is_kept_and_used(
    avatar_file: Path, motion_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = _options(avatar_file, motion_file, tmp_path / "out", frames=3)
    whole = render_motion(replace(options, out=tmp_path / "whole"))
    rendered: list[HandPose] = []
    render = HandAvatar.render

    def killed_at_the_third(self: HandAvatar, pose: HandPose, *rest: Any) -> Rendering:
        if len(rendered) == 2:
            raise KeyboardInterrupt
        rendered.append(pose)
        return render(self, pose, *rest)

    monkeypatch.setattr(HandAvatar, "render", killed_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        render_motion(options)
    assert not options.out.exists()
    left = tmp_path / "out.unfinished" / "rgb"
    assert sorted(path.name for path in left.iterdir()) == ["000000.png", "000001.png"]
    (left / ".tmp-1-000002.png").write_bytes(b"half")

    rendered.clear()
    assert render_motion(options) == options.out
    assert len(rendered) == 1, "only the frame that was missing"
    assert _contents(options.out) == _contents(whole)
    assert not (tmp_path / "out.unfinished").exists()


def test_frames_of_another_work_are_not_used(
    avatar_file: Path, motion_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = _options(avatar_file, motion_file, tmp_path / "out")

    def disk_full(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patched:
        patched.setattr("handavatar.animate.VideoWriter", disk_full)
        with pytest.raises(OSError, match="no space"):
            render_motion(options)
    assert (tmp_path / "out.unfinished" / "rgb" / "000001.png").is_file()
    bright = replace(options, light_gain=1.5)
    assert _contents(render_motion(bright)) == _contents(
        render_motion(replace(bright, out=tmp_path / "fresh"))
    )


@pytest.mark.slow
def test_two_processes_share_the_frames(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    alone = render_motion(_options(avatar_file, motion_file, tmp_path / "alone", frames=3))
    words = ["render", str(avatar_file), "--motion", str(motion_file), "--size", str(SIZE)]
    words += ["--frames", "3", "--num-samples", "16", "--out", str(tmp_path / "shared")]
    # The second process dies at its first frame; its frames are done by the rerun.
    dying = [
        "-c",
        "import os, sys\n"
        "from handavatar import cli\n"
        "from handavatar.avatar import HandAvatar\n"
        "if os.environ['RANK'] == '1':\n"
        "    HandAvatar.render = lambda *_: os._exit(9)\n"
        "sys.exit(cli.main(sys.argv[1:]))\n",
    ]
    codes, _ = ended(two_begun(words, dying))
    assert codes[1] == 9 and codes[0] != 0
    left = tmp_path / "shared.unfinished" / "rgb"
    assert sorted(path.name for path in left.iterdir()) == ["000000.png", "000002.png"]
    codes, text = ended(two_begun(words))
    assert codes == [0, 0], text
    assert _contents(tmp_path / "shared") == _contents(alone)


def test_the_error_of_every_frame_is_stated_on_request(
    avatar_file: Path, motion_file: Path, tmp_path: Path
) -> None:
    options = replace(_options(avatar_file, motion_file, tmp_path / "near"), check=30)
    exact = replace(options, out=tmp_path / "exact", quality="exact")
    near, none = (
        json.loads((render_motion(chosen) / "errors.json").read_text())
        for chosen in (options, exact)
    )
    assert len(near["frames"]) == 2 and near["frames"][0]["pixels"] == 30
    assert 0 < near["max_error"] < 0.01 and near["worst_psnr"] > 60
    assert none["max_error"] == 0
    assert not (tmp_path / "near" / "errors").exists()


@pytest.mark.slow
def test_what_coarse_samples_miss_is_found_out(small_avatar: HandAvatar) -> None:
    camera = camera_above(32)
    settings = RenderSettings(mask_margin=2 / 32)
    good = rendering_error(small_avatar, bent_pose(1), camera, settings, 1000)
    # Two or three looks along a ray, between which fingers lie.
    blind = rendering_error(small_avatar, bent_pose(1), camera, replace(settings, coarse=32), 1000)
    assert good["psnr"] > 60 > blind["psnr"]


def _contents(folder: Path) -> dict[str, bytes]:
    """Of the files but for the marker, which says when it was written."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != MARKER)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"check": -1}, "check"),
        ({"passes": "rgb,depht"}, "depht"),
        ({"passes": ""}, "passes"),
        ({"albedo_shift": "0.1,0"}, "three numbers"),
        ({"albedo_shift": "0.1,0,nan"}, "expected -1 to 1"),
        ({"light_gain": -1.0}, "`light_gain`: found -1.0, expected 0 to 1000"),
        ({"lift_shadow": "pinky"}, "neither a finger nor a bone"),
        ({"size": 0}, "size"),
        ({"frames": 0}, "frames"),
        ({"kernel": "triton", "device": "cpu"}, "kernel"),
    ],
)
def test_bad_options_are_errors_before_any_work(
    avatar_file: Path, motion_file: Path, tmp_path: Path, change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        render_motion(replace(_options(avatar_file, motion_file, tmp_path / "out"), **change))
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


def test_the_camera_holds_the_hand_in_every_pose(small_avatar: HandAvatar) -> None:
    poses = [bent_pose(step) for step in (0, 4, 8)]
    camera = camera_on(small_avatar, poses, 100)
    for pose in poses:
        vertices = small_avatar.rig.shaped(small_avatar.coefficients).posed(pose).vertices
        pixels, depths = project(camera, vertices)
        assert float(pixels.min()) > 0 and float(pixels.max()) < 100 and float(depths.min()) > 0


def test_a_camera_leaves_the_room_it_is_asked_for(small_avatar: HandAvatar) -> None:
    vertices = small_avatar.rig.shaped(small_avatar.coefficients).posed(bent_pose(3)).vertices
    for room in (0.0, 0.15, 1.0):
        pixels, _ = project(camera_on(small_avatar, [bent_pose(3)], 100, room), vertices)
        lower, upper = pixels.amin(0), pixels.amax(0)
        assert float((upper - lower).max()) == pytest.approx(100 / (1 + room), abs=1e-3)
        torch.testing.assert_close((lower + upper) / 2, torch.tensor([50.0, 50.0]))


def test_a_gesture_stands_where_the_capture_saw_the_hand(small_avatar: HandAvatar) -> None:
    avatar = copy.copy(small_avatar)
    avatar.info = {"view": {"rotations": [[0.1, 0.2, 0.3]] * 16, "translation": [1.0, 2.0, 3.0]}}
    pose = posed_as_seen(avatar, "victory")
    assert pose.translation.tolist() == [1.0, 2.0, 3.0]
    torch.testing.assert_close(pose.rotations[0], torch.tensor([0.1, 0.2, 0.3]))
    fingers = gesture(avatar.base_rig, "victory")
    assert torch.equal(pose.rotations[1:], fingers[1:])
    own = posed_as_seen(avatar, fingers)
    assert torch.equal(own.rotations, pose.rotations)
    assert not fingers[0].any()  # What was given stays as it was.
    assert torch.equal(posed_as_seen(small_avatar, fingers).rotations, fingers)
    with pytest.raises(CaptureError, match="no gesture"):
        posed_as_seen(avatar, "none")


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


def test_a_motion_is_rendered_in_the_light_and_the_view_of_a_clip(
    two_lights: HandAvatar, tmp_path: Path
) -> None:
    two_lights.save(tmp_path / "two.safetensors")
    plain = _options(tmp_path / "two.safetensors", Path("turn"), tmp_path / "plain", frames=1)
    second = replace(plain, out=tmp_path / "second", light=1)
    edit = Edit(light=1)
    for options, look in ((plain, Edit()), (second, edit)):
        found = np.asarray(Image.open(render_motion(options) / "rgb" / "000000.png"))
        start = start_of(two_lights.view(look))
        pose = named_motion(two_lights.base_rig, "turn", start).pose(0)
        camera = camera_on(two_lights, [pose], SIZE, edit=look)
        view = two_lights.info["views"][0 if look.light is None else 1]
        assert camera.camera_from_world.tolist() == view["camera_from_world"]
        settings = RenderSettings(num_samples=16)
        rendering = two_lights.render(pose, camera, look, settings)
        assert np.array_equal(found, pass_pictures(rendering)["rgb"])
    with pytest.raises(ValueError, match=r"`light`: .* of number 2; choose from 0, 1"):
        render_motion(replace(plain, out=tmp_path / "third", light=2))
    assert not (tmp_path / "third").exists()
    # What an interrupted command left is not taken for another light's.
    told = [
        _what_frames_depend_on(two_lights, Edit(light=light), plain, [], [])["sha256"]
        for light in (0, 1, None)
    ]
    assert told[0] == told[2] != told[1]
