"""Everyday slips: a path of the wrong kind is named, with what was expected and what takes it."""

import dataclasses
import json
import os
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from conftest import write_tiny_capture
from PIL import Image
from safetensors.torch import save_file

from handavatar import cli
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import MOTIONS, Motion, write_motion
from handavatar.cli import arguments
from handavatar.cli.inputs import AVATAR, CAPTURE, KINDS, Expected, kind_of, require
from handavatar.errors import printable
from handavatar.train.prior import SHIPPED_PRIOR
from handavatar.train.runs import create_run


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, small_avatar: HandAvatar) -> Path:
    """A folder with one thing of every kind, named after it; read only."""
    place = tmp_path_factory.mktemp("kinds")
    write_tiny_capture(place / "captures/capture", "ab", size=24)
    facts = dict(seed=0, capture=place, capture_sha256="0", perceptual="none")
    for name in ("run", "begun"):
        create_run(place / "outputs/capture/quick" / name, {}, **facts)
    small_avatar.save(place / "outputs/capture/quick/run/avatar.safetensors")
    small_avatar.save(place / "avatar.safetensors")
    write_motion(place / "motion.json", Motion(30.0, torch.zeros(2, 16, 3), torch.zeros(2, 3)))
    (place / "scene").mkdir()
    (place / "scene/transforms.json").write_text('{"frames": []}')
    (place / "frames").mkdir()
    for number in range(2):
        Image.new("RGB", (8, 6)).save(place / f"frames/{number:04d}.png")
    (place / "model").mkdir()
    (place / "model/cameras.txt").write_text("")
    (place / "product").mkdir()
    (place / "product/.handavatar").write_text("{}")
    (place / "empty").mkdir()
    (place / "papers").mkdir()
    (place / "papers/letter.txt").write_text("dear")
    Image.new("RGB", (8, 6)).save(place / "picture.png")
    # Its name says something else than it is.
    Image.new("RGB", (8, 6)).save(place / "picture.mp4", format="JPEG")
    (place / "video.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(64))
    (place / "letter.txt").write_text("dear")
    (place / "nothing.mp4").write_bytes(b"")
    (place / "settings.json").write_text('{"a": 1}')
    (place / "damaged.safetensors").write_bytes(b"dear")
    (place / "hand.pkl").write_bytes(pickle.dumps({"a": 1}))
    np.savez(place / "arrays.npz", poses=np.zeros(3))
    save_file({"avatar.x": torch.zeros(1)}, place / "model.safetensors")
    save_file({"x": torch.zeros(1)}, place / "other.safetensors")
    return place


RUN = "outputs/capture/quick/run"
BEGUN = "outputs/capture/quick/begun"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("captures/capture", "capture"),
        ("captures/capture/transforms.json", "capture file"),
        ("captures", "parent of captures"),
        (RUN, "run"),
        (BEGUN, "unfinished run"),
        ("outputs", "parent of runs"),
        ("outputs/capture/quick", "parent of runs"),
        ("avatar.safetensors", "avatar"),
        (str(SHIPPED_PRIOR), "prior"),
        (str(SHIPPED_PRIOR.parent / "open_hand.safetensors"), "rig"),
        (str(SHIPPED_PRIOR.parent / "tracker.safetensors"), "tracker"),
        (str(SHIPPED_PRIOR.parent / "skin_full_2.safetensors"), "skin"),
        ("model.safetensors", "checkpoint"),
        ("other.safetensors", "weights"),
        ("damaged.safetensors", "weights"),
        ("motion.json", "motion"),
        ("settings.json", "JSON"),
        ("arrays.npz", "arrays"),
        ("hand.pkl", "pickle"),
        ("picture.png", "picture"),
        ("picture.mp4", "picture"),
        ("video.mp4", "video"),
        ("nothing.mp4", "empty file"),
        ("letter.txt", "other"),
        ("frames", "frames"),
        ("frames/%04d.png", "pattern"),
        ("frames/*.png", "pattern"),
        ("scene", "scene"),
        ("model", "cameras"),
        ("product", "product"),
        ("empty", "empty folder"),
        ("papers", "folder"),
        ("none", "missing"),
        ("letter.txt/none", "missing"),
        ("my hand[1].mp4", "missing"),
        ("a\0b", "missing"),
        ("/dev/null", "special"),
    ],
)
def test_a_path_is_what_it_is(place: Path, name: str, kind: str) -> None:
    assert kind_of(place / name).name == kind


@pytest.mark.parametrize(
    ("words", "says"),
    [
        # A folder for a file, and the other way round.
        ("capture video papers --out O", "a folder that is neither.*a video, a folder of pict"),
        ("capture video empty --out O", "an empty folder"),
        ("edit papers --out O", "a folder that is neither run nor capture; RUN of handavatar edit"),
        ("edit RUN --out O --paint papers", "--paint of handavatar edit expects a picture"),
        ("render RUN --motion papers", "--motion of handavatar render expects a motion file"),
        ("train captures/capture/transforms.json", "name its folder: .*captures/capture"),
        # A picture for a video.
        ("capture video picture.png --out O", "a picture; FILE of handavatar capture video"),
        ("capture video picture.mp4 --out O", "a picture; FILE"),
        ("capture video letter.txt --out O", "a file of another kind; FILE"),
        ("capture video nothing.mp4 --out O", "an empty file"),
        ("capture video video.mp4 --out O --masks letter.txt", "--masks of .* expects masks"),
        # A capture for a run or an avatar, and the other way round.
        *(
            (f"{words} --out O", "a capture; RUN .*\n.*handavatar train .*captures/capture")
            for words in (
                "render captures/capture",
                "edit captures/capture",
                "evaluate captures/capture",
                "export captures/capture glb",
                "view captures/capture",
            )
        ),
        ("train RUN", "finished training; CAPTURE .*\n.*its training is finished"),
        ("train BEGUN", "not finished; CAPTURE"),
        ("train avatar.safetensors", "an avatar; CAPTURE"),
        ("capture check RUN", "finished training; CAPTURE of handavatar capture check"),
        ("capture degrade RUN --out O", "finished training; SOURCE"),
        ("evaluate RUN --capture RUN", "finished training; --capture"),
        ("train video.mp4", "a video; CAPTURE .*\n.*handavatar capture video .*video.mp4 --out"),
        ("train frames", "a folder of pictures; CAPTURE"),
        ("train scene", "without a hand .nerfstudio.; CAPTURE"),
        # The folder above what was meant.
        ("render outputs", "holds runs; RUN .*\n.*name one of them: .*quick/(run|begun)"),
        ("train captures", "holds captures; CAPTURE .*\n.*name one of them: .*captures/capture"),
        ("evaluate outputs/capture", "holds runs"),
        # What is not there.
        ("render RUN --motion gesturs", "built|one of gestures(.|\n)*did you mean gestures?"),
        ("render RUN --motion x.json", "no such file or folder; --motion"),
        ("export RUN glb --out O --motion none.json", "no such file or folder; --motion"),
        ("render RUN --paint none.png", "no such file or folder; --paint"),
        (
            "edit RUN --out O --paint pictur.png",
            "no such file or folder; --paint(.|\n)*did you mean .*picture.png",
        ),
        ("train captures/captur", "did you mean .*captures/capture"),
        ("render outputs/none", "no such file or folder; RUN"),
        ("capture check none", "no such file or folder; CAPTURE"),
        ("capture webcam --drive none", "no such file or folder; --drive"),
        # Weights of another kind.
        ("render PRIOR", "an occupancy prior; RUN"),
        ("view PRIOR", "an occupancy prior; RUN"),
        ("train captures/capture --prior avatar.safetensors", "an avatar; --prior"),
        ("prior evaluate --prior RUN", "finished training; --prior"),
        ("tracker evaluate --tracker PRIOR", "an occupancy prior; --tracker"),
        ("render model.safetensors", "weights of a checkpoint; RUN"),
        ("render BEGUN", "not finished; RUN .*\n.*--resume auto"),
        # Motions.
        ("render RUN --motion arrays.npz", "a file of arrays; .*\n.*handavatar motion from"),
        ("view RUN --motion video.mp4", "a video; --motion"),
        ("motion to captures/capture --out O --side left", "a capture; SOURCE"),
        ("motion from RUN --out O", "finished training; SOURCE"),
        ("motion from avatar.safetensors --out O", "an avatar; SOURCE"),
        ("rig import-mano RUN", "finished training; FILE"),
        ("bench --table lift --capture RUN --avatars RUN", "finished training; --capture"),
        ("bench --table speed --avatar captures/capture", "a capture; --avatar"),
    ],
)
def test_a_slip_is_named(
    words: str,
    says: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    meant = {"RUN": RUN, "BEGUN": BEGUN, "PRIOR": str(SHIPPED_PRIOR)}
    assert cli.main([meant.get(word, word) for word in words.split()]) == 3
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert captured.out == "" and 2 <= len(lines) <= 4
    assert re.search(says, captured.err), captured.err
    assert "mistake" not in captured.err and sorted(place.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("render RUN --device mps", 2, "--device: found mps, expected auto, cpu, cuda"),
        ("render RUN --device gpu", 2, "--device: found gpu, expected auto, cpu, cuda"),
        ("view RUN --device cuda:x", 2, "--device: found cuda:x, expected"),
        ("render RUN --device cuda:99", 2, "--device: .*cuda:99, (but no CUDA device|expected)"),
        ("capture video video.mp4 --out O --fps 0", 2, "--fps: found 0.0, expected"),
        ("capture video video.mp4 --out O --max-frames 0", 2, "--max-frames: found 0, expected"),
        ("edit RUN --out O --light-gain -1", 2, "--light-gain: found -1.0, expected"),
        ("capture degrade captures/capture --out .", 3, "the command was started in"),
        ("render RUN --out .", 2, "the command was started in"),
        ("train captures/capture --steps 0", 2, "--steps: found 0, expected at least 1"),
    ],
)
def test_a_value_that_makes_no_sense_is_named(
    words: str,
    code: int,
    says: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(place)
    assert cli.main([{"RUN": RUN}.get(word, word) for word in words.split()]) == code
    shown = capsys.readouterr().err
    assert re.search(says, shown), shown
    assert "mistake" not in shown


@pytest.mark.parametrize("value", ["2", "two", "0"])
def test_an_environment_of_several_processes_that_nobody_started_is_named(
    value: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setenv("WORLD_SIZE", value)
    assert cli.main(["render", RUN, "--out", "pictures", "--size", "16", "--frames", "1"]) == 3
    shown = capsys.readouterr().err
    assert f"WORLD_SIZE={value}" in shown and "unset WORLD_SIZE" in shown
    assert not (place / "pictures").exists()


def test_every_path_that_a_command_reads_is_asked_first_what_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An option that holds a path is either read, and declared, or known to be written."""
    written = {
        *("out", "keep", "folder", "pictures", "films", "kept"),
        *("page",),
    }
    seen: dict[str, set[str]] = {}

    def watched(
        options: type[Any],
        extras: tuple[arguments.Extra, ...],
        words: list[str],
        command: str,
        positional: tuple[str, ...] = (),
        given: Mapping[str, Any] | None = None,
        about: str = "",
        reads: Mapping[str, Expected] | None = None,
    ) -> Any:
        kinds = {field.name: field.type for field in dataclasses.fields(options)}
        kinds |= {extra.name: extra.kind for extra in extras}
        kinds = {name: kind for name, kind in kinds.items() if name not in (given or {})}
        paths = {n for n, kind in kinds.items() if Path in (kind, *get_args(kind))}
        seen[command] = paths - set(reads or {}) - written
        raise SystemExit(0)

    monkeypatch.setattr(arguments, "parse_with", watched)
    for command in cli.COMMANDS:
        words = command.split()
        tables = ("lift", "speed", "ablation", "peers", "registration", "training")
        for table in tables if command == "bench" else ("",):
            cli.main([*words, *(["--table", table] if table else [])])
    capsys.readouterr()
    assert len(seen) >= len(cli.COMMANDS) - 1
    assert not any(seen.values()), {command: names for command, names in seen.items() if names}


def test_whatever_fits_is_let_through(place: Path) -> None:
    require(place / "captures/capture", CAPTURE, "CAPTURE")
    require(place / RUN, AVATAR, "RUN")
    require(place / "avatar.safetensors", AVATAR, "RUN")
    # Damaged weights are their reader's business.
    require(place / "damaged.safetensors", AVATAR, "RUN")
    assert all(set(expected.kinds) <= set(KINDS) for expected in (CAPTURE, AVATAR))
    assert "gestures" in MOTIONS


def test_a_folder_of_very_many_files_is_looked_at_in_time(tmp_path: Path) -> None:
    for number in range(3000):
        (tmp_path / f"{number}").mkdir()
    assert kind_of(tmp_path).name == "folder"


def test_a_folder_that_may_not_be_read_is_said(tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir(mode=0)
    try:
        if os.access(folder, os.R_OK):
            pytest.skip("root may read everything")
        with pytest.raises(OSError, match="closed"):
            kind_of(folder)
    finally:
        folder.chmod(0o755)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain ä 日本\nnext", "plain ä 日本\nnext"),
        ("\x1b[31mRED\x1b]0;pwned\x07", r"\x1b[31mRED\x1b]0;pwned\x07"),
        ("\ud800x", r"\ud800x"),
        ("a\x9bm\u202eb\r", r"a\x9bm\u202eb\r"),
    ],
)
def test_a_terminal_obeys_nothing_that_comes_from_a_file(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_names_that_are_no_text_are_shown_as_codes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = os.fsdecode(b"hand\xff\x1b[31m.mp4")
    assert cli.main(["capture", "video", str(tmp_path / name), "--out", str(tmp_path / "o")]) == 3
    shown = capsys.readouterr().err
    assert r"hand\udcff\x1b[31m.mp4: no such file" in shown and "\x1b" not in shown


@pytest.mark.parametrize("case", ["frames", "rotations"])
def test_hostile_json_reaches_no_terminal(
    case: str, tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hostile = "\x1b[31mRED\x1b]0;pwned\x07\ud800"
    if case == "frames":
        folder = write_tiny_capture(tmp_path / "capture", "ab", size=24)
        content = json.loads((folder / "transforms.json").read_text())
        content["frames"][0]["file_path"] = f"images/{hostile}.png"
        content["frames"][1]["split"] = hostile
        (folder / "transforms.json").write_text(json.dumps(content))
        assert cli.main(["capture", "check", str(folder)]) == 3
        assert cli.main(["train", str(folder), "--out", str(tmp_path / "run")]) == 3
    else:
        motion = {"schema": 1, "fps": 30, "rotations": [hostile], "translations": [[0, 0, 0]]}
        (tmp_path / "motion.json").write_text(json.dumps(motion))
        words = ["render", str(place / RUN), "--motion", str(tmp_path / "motion.json")]
        assert cli.main([*words, "--out", str(tmp_path / "r")]) == 3
    captured = capsys.readouterr()
    shown = captured.out + captured.err
    assert "x1b[31mRED" in shown and not {"\x1b", "\x07", "\ud800"} & set(shown)
    assert "mistake" not in shown
