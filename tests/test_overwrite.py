"""Whatever a command is told to replace: what is somebody else's stays, and so does what is beside.

Of every command that writes where it is told, through the command line.
"""

import os
from pathlib import Path

import pytest
import torch
from conftest import write_tiny_capture

from handavatar import cli
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import Motion, write_motion
from handavatar.train.runs import create_run

FOLDERS = [
    "render RUN --frames 1 --size 16",
    "export RUN web",
    "capture video video.mp4",
    "capture synth",
    "capture degrade capture",
    "capture benchmark",
    "train capture",
    "evaluate RUN --capture capture",
    "demo",
]
FILES = [
    "export RUN glb",
    "export RUN ply",
    "export RUN obj",
    "edit RUN",
    "motion from capture",
    "motion to motion.json --side right",
    "prior train",
    "tracker train",
    "rig refine",
    "bench --table skin",
]
ENDINGS = {"glb": ".glb", "ply": ".ply", "obj": ".obj", "to": ".npz", "from": ".json"}


@pytest.fixture
def place(tmp_path: Path, small_avatar: HandAvatar, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A desk with a run, a capture and a motion; the folder that the commands are started in."""
    write_tiny_capture(tmp_path / "capture", "ab", size=24)
    run = create_run(
        tmp_path / "run",
        {},
        seed=0,
        capture=tmp_path / "capture",
        capture_sha256="",
        perceptual="x",
    ).folder
    small_avatar.save(run / "avatar.safetensors")
    write_motion(tmp_path / "motion.json", Motion(30.0, torch.zeros(2, 16, 3), torch.zeros(2, 3)))
    (tmp_path / "video.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(64))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    """All files below, with their numbers on the disk: the very same ones, not copies."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {str(path): (path.lstat().st_ino, path.read_bytes()) for path in files}


def folder_of(path: Path, texts: dict[str, str]) -> Path:
    """A folder of somebody's files."""
    path.mkdir()
    for name, text in texts.items():
        (path / name).write_text(text)
    return path


def refused(words: str, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    code = cli.main([*words.replace("RUN", "run").split(), "--out", str(out), *_overwrite(words)])
    said = capsys.readouterr().err
    assert code in (2, 3), said
    assert "mistake" not in said
    return said


def _overwrite(words: str) -> list[str]:
    """Of those that have it: a training, an evaluation and others go on in their own folder."""
    has_none = ("train", "evaluate", "demo", "capture benchmark")
    return [] if words.startswith(has_none) else ["--overwrite"]


@pytest.mark.parametrize("words", FOLDERS)
def test_a_folder_of_a_stranger_is_not_replaced(
    words: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    documents = folder_of(place / "Documents", {"letter.txt": "dear"})
    folder_of(place / "Documents.unfinished", {"f": "hi"})
    before = contents(place)
    said = refused(words, documents, capsys)
    assert "Documents" in said
    assert contents(place) == before


@pytest.mark.parametrize("words", FOLDERS)
def test_a_scene_a_run_and_the_place_itself_are_not_replaced(
    words: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = folder_of(place / "scene", {"transforms.json": "{}", "notes": "hi"})
    before = contents(place)
    for out in (scene, place / "run", place, Path(".")):
        if (words, out) != ("evaluate RUN --capture capture", place / "run"):
            refused(words, out, capsys)
        assert contents(place) == before, out


@pytest.mark.parametrize("words", FILES)
def test_a_folder_or_a_link_is_no_file_to_be_replaced(
    words: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = [word for word in words.split() if word in ENDINGS]
    ending = ENDINGS[kinds[0]] if kinds else ""
    folder = folder_of(place / f"folder{ending}", {"letter.txt": "dear"})
    (place / f"there{ending}").write_text("mine")
    link = place / f"link{ending}"
    link.symlink_to(place / f"there{ending}")
    before = contents(place)
    for out in (folder, link):
        refused(words, out, capsys)
        assert contents(place) == before, out
        assert os.readlink(link) == str(place / f"there{ending}")


@pytest.mark.parametrize(
    "words",
    [
        "edit RUN --out run/avatar.safetensors",
        "edit run/avatar.safetensors --out run/avatar.safetensors",
        "motion to motion.json --side right --out motion.json",
        "motion from motion.json --out motion.json",
    ],
)
def test_what_is_read_is_not_written_over(
    words: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(place)
    out = Path(words.rpartition(" ")[2])
    assert "is what is read" in refused(words.partition(" --out")[0], out, capsys)
    assert contents(place) == before
