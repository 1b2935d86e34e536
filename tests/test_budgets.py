"""Every size that comes from outside has a budget: small files never cost much time or memory."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import write_tiny_capture
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from handavatar.avatar import CheckpointError, HandAvatar
from handavatar.capture.checks import (
    MAX_JSON_CONTAINERS,
    CaptureError,
    decoded,
    load_json,
    open_picture,
)
from handavatar.capture.frames import read_capture
from handavatar.capture.motion import read_motion
from handavatar.capture.soundness import find_problems
from handavatar.capture.video_cameras import read_camera
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.rig import RigError

_SECONDS = 5.0
"""Far more than any of these takes, and far less than what they took."""


def _refused_soon(call: Callable[[], Any], kind: type[Exception], says: str) -> None:
    begin = time.process_time()
    with pytest.raises(kind, match=says):
        call()
    assert time.process_time() - begin < _SECONDS


@pytest.fixture
def avatar_file(tmp_path: Path, small_avatar: HandAvatar) -> Path:
    small_avatar.save(tmp_path / "avatar.safetensors")
    return tmp_path / "avatar.safetensors"


def _rewritten(path: Path, **about: Any) -> None:
    with safe_open(path, "pt") as file:
        facts = json.loads(file.metadata()["handavatar"])
    save_file(load_file(path), path, {"handavatar": json.dumps({**facts, **about})})


@pytest.mark.parametrize("rounds", [7, 10**9, -1, 2.5, "7", None, [7]])
def test_an_avatar_of_too_many_rounds_is_refused(avatar_file: Path, rounds: object) -> None:
    _rewritten(avatar_file, rounds=rounds)
    _refused_soon(lambda: HandAvatar.load(avatar_file), CheckpointError, "not a complete avatar")


def test_an_avatar_of_too_many_directions_of_light_is_refused(avatar_file: Path) -> None:
    tensors = load_file(avatar_file)
    tensors["avatar.illumination.directions"] = torch.zeros(100_000, 3)
    with safe_open(avatar_file, "pt") as file:
        facts = file.metadata()
    save_file(tensors, avatar_file, facts)
    _refused_soon(lambda: HandAvatar.load(avatar_file), CheckpointError, "directions|complete")


def test_rigs_are_subdivided_within_reason() -> None:
    rig = load_open_hand("778")
    _refused_soon(lambda: subdivided(rig, 7), RigError, "7 rounds .* more than 1,000,000 faces")
    assert len(subdivided(rig, 1).faces) == 4 * len(rig.faces)


def _large(path: Path, size: int) -> None:
    """A file of nothing, which takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(size)


def test_files_of_tensors_may_be_so_large_and_no_larger(tmp_path: Path) -> None:
    _large(tmp_path / "avatar.safetensors", (1 << 30) + 1)
    _refused_soon(lambda: HandAvatar.load(tmp_path), CheckpointError, "avatars have at most 1")
    folder = write_tiny_capture(tmp_path / "capture", "ab", size=24)
    for name in ("covariances", "landmarks"):
        _large(folder / f"{name}.safetensors", (1 << 30) + 1)
        _refused_soon(lambda: read_capture(folder).frame(0), CaptureError, f"{name}.* 1024 MiB")
        (folder / f"{name}.safetensors").unlink()


@pytest.mark.parametrize("place", ["first", "last"])
def test_repeated_keys_are_found_at_once(tmp_path: Path, place: str) -> None:
    keys = [f'"key{number}": 0' for number in range(100_000)]
    keys.insert(0 if place == "first" else len(keys), '"key99999":0')
    (tmp_path / "a.json").write_text("{" + ",".join(keys) + "}")
    assert (tmp_path / "a.json").stat().st_size > 1.3e6
    _refused_soon(lambda: load_json(tmp_path / "a.json"), CaptureError, "'key99999' appears twice")


def test_lists_of_nothing_are_counted_before_they_are_made(tmp_path: Path) -> None:
    count = MAX_JSON_CONTAINERS + 1
    (tmp_path / "a.json").write_text('{"a":[' + "[]," * count + "[]]}")
    _refused_soon(lambda: load_json(tmp_path / "a.json"), CaptureError, "lists and objects")
    (tmp_path / "c.json").write_text('{"a":[' + "0," * 20_000_001 + "0]}")
    _refused_soon(lambda: load_json(tmp_path / "c.json"), CaptureError, "20000001 values")
    (tmp_path / "b.json").write_text("[" * 1_000_000)
    _refused_soon(lambda: load_json(tmp_path / "b.json"), CaptureError, "not JSON")


def test_frames_and_steps_are_counted(tmp_path: Path) -> None:
    folder = write_tiny_capture(tmp_path / "capture", "ab", size=24)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"] = [5] * 100_001
    (folder / "transforms.json").write_text(json.dumps(content))
    _refused_soon(lambda: read_capture(folder), CaptureError, "1 to 100000 frames")
    motion = {"schema": 1, "fps": 30, "rotations": [5] * 100_001, "translations": []}
    (tmp_path / "m.json").write_text(json.dumps(motion))
    _refused_soon(lambda: read_motion(tmp_path / "m.json"), CaptureError, "100001 steps")


def test_what_all_frames_have_in_common_may_be_much(tmp_path: Path) -> None:
    """It was copied for each of the frames."""
    folder = write_tiny_capture(tmp_path / "capture", "ab", size=24)
    content = json.loads((folder / "transforms.json").read_text())
    much = {f"key{number}": 0 for number in range(300_000)}
    entry = content["frames"][0] | {"mask_path": "masks/none.png"}
    (folder / "transforms.json").write_text(json.dumps(much | content | {"frames": [entry] * 2000}))
    _refused_soon(lambda: read_capture(folder), CaptureError, "masks/none.png")
    entry = {"w": 24, "h": 24, "fl_x": 30.0, "k3": 1.0}
    frames = [entry | {"k3": 0.0}] * 2000 + [entry]
    (folder / "transforms.json").write_text(json.dumps(much | {"frames": frames}))
    _refused_soon(lambda: read_camera(folder), CaptureError, "k3 is not zero")
    (folder / "transforms.json").write_text(json.dumps({"frames": [entry] * 100_001}))
    _refused_soon(lambda: read_camera(folder), CaptureError, "100001 frames")


def test_pixels_of_all_pictures_together_are_counted(tmp_path: Path) -> None:
    folder = write_tiny_capture(tmp_path / "capture", "a", size=24)
    side, count = 7900, 17
    for kind, mode in (("images", "RGB"), ("masks", "L")):
        first = folder / kind / "000000.png"
        Image.new(mode, (side, side)).save(first, compress_level=1)
        for number in range(1, count):
            os.link(first, folder / kind / f"{number:06d}.png")
    content = json.loads((folder / "transforms.json").read_text())
    (entry,) = content["frames"]
    entry.update(w=side, h=side)
    content["frames"] = [
        {**entry, "file_path": f"images/{n:06d}.png", "mask_path": f"masks/{n:06d}.png"}
        for n in range(count)
    ]
    (folder / "transforms.json").write_text(json.dumps(content))
    _refused_soon(lambda: read_capture(folder), CaptureError, "1,061 megapixels together")


def test_large_pictures_are_checked_in_few_pixels(tmp_path: Path) -> None:
    folder = write_tiny_capture(tmp_path / "capture", "ab", size=1200)
    begin = time.process_time()
    assert find_problems(folder) == []
    assert time.process_time() - begin < _SECONDS


def test_whatever_a_decoder_stumbles_over_is_damage() -> None:
    # Pillow raises an IndexError.
    case = Path(__file__).parents[2] / "shared/cases/hostile/png-indexerror.png"
    if not case.is_file():
        pytest.skip("the cases are not here")
    with pytest.raises(CaptureError, match="is damaged"):
        decoded(open_picture(case), "picture")
