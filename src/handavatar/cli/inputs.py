"""What a path is, before a command opens it: the one place that tells a run from a capture.

A path of the wrong kind is refused with what it is, what was expected, and which command takes it.
Only names and the first bytes are looked at; what a file holds is its reader's business.
"""

import difflib
import itertools
import json
import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from handavatar.capture.checks import OPTIONAL_FORMATS, PICTURE_FORMATS, is_pattern
from handavatar.errors import HandAvatarError

_HEAD = 64 * 1024
"""Bytes of a file that are looked at; of a safetensors file, its header."""
_MOST_HEADER = 16 * 2**20
_MOST_ENTRIES = 2000
"""Entries of a folder that are looked at, with those below it."""
_RUN_DEPTH = 4
"""``outputs/{capture}/{method}/{time}``: where runs lie below what a user may name."""
_PICTURES = tuple(PICTURE_FORMATS | OPTIONAL_FORMATS)
_VIDEOS = (
    *(".mp4", ".mov", ".mkv", ".webm", ".avi", ".ts", ".mts", ".gif", ".m4v", ".wmv", ".flv"),
    *(".mpg", ".mpeg", ".3gp", ".ogv", ".mxf"),
)
_ARRAYS = (".npz", ".npy")
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".joblib")
_STILL_BRANDS = (b"heic", b"heix", b"mif1", b"avif", b"hevc")


class WrongInput(HandAvatarError):
    """A path that a command cannot take: what it is, what was expected, what to do."""


@dataclass(frozen=True)
class Kind:
    """One kind of thing that a path can be.

    Attributes:
        name: for the program.
        noun: for people, with its article.
        advice: which command takes it; ``{path}`` stands for the path.
    """

    name: str
    noun: str
    advice: str


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "missing",
            "no such file or folder",
            "look for a slip in the name, and in which folder you are",
        ),
        Kind("empty folder", "an empty folder", "name one that holds something"),
        Kind("folder", "a folder that is neither run nor capture", ""),
        Kind("empty file", "an empty file (0 bytes)", "copy or make it again"),
        Kind("special", "neither a file nor a folder", "name a plain file or a folder"),
        Kind("other", "a file of another kind", ""),
        Kind("picture", "a picture", "pictures are taken by: handavatar edit RUN --paint {path}"),
        Kind("video", "a video", "make a capture of it: handavatar capture video {path} --out D"),
        Kind(
            "frames",
            "a folder of pictures",
            "make a capture of them: handavatar capture video {path} --out D",
        ),
        Kind(
            "pattern",
            "a pattern of pictures",
            "make a capture of them: handavatar capture video '{path}' --out D",
        ),
        Kind("capture", "a capture", "train an avatar of it first: handavatar train {path}"),
        Kind(
            "capture file",
            "the transforms.json of a capture",
            "name its folder: {parent}",
        ),
        Kind(
            "scene",
            "a folder of posed pictures without a hand (nerfstudio)",
            "give it as the camera of a video: handavatar capture video FILE --camera {path}",
        ),
        Kind(
            "cameras",
            "a model of COLMAP",
            "give it as the camera of a video: handavatar capture video FILE --camera {path}",
        ),
        Kind(
            "parent of captures",
            "a folder that holds captures",
            "name one of them: {example}",
        ),
        Kind("run", "the run folder of a finished training", "show it: handavatar view {path}"),
        Kind(
            "unfinished run",
            "the run folder of a training that is not finished",
            "go on with it: handavatar train CAPTURE --out {path} --resume auto",
        ),
        Kind("parent of runs", "a folder that holds runs", "name one of them: {example}"),
        Kind("avatar", "an avatar", "show it: handavatar view {path}"),
        Kind(
            "prior", "an occupancy prior", "train from it: handavatar train CAPTURE --prior {path}"
        ),
        Kind("rig", "a rig", "its facts: handavatar rig info --rig {path}"),
        Kind(
            "tracker",
            "a hand tracker's weights",
            "judge it: handavatar tracker evaluate --tracker {path}",
        ),
        Kind("skin", "skinning weights", ""),
        Kind(
            "checkpoint",
            "weights of a checkpoint",
            "name the run folder that it lies in",
        ),
        Kind("weights", "a safetensors file that cannot be read or is of another program", ""),
        Kind("motion", "a motion", "show it: handavatar render RUN --motion {path}"),
        Kind("JSON", "a JSON file that is no motion", ""),
        Kind(
            "arrays",
            "a file of arrays",
            "if it is another program's motion: handavatar motion from {path} --out M.json",
        ),
        Kind(
            "pickle",
            "a pickle",
            "if it is a MANO file: handavatar rig import-mano {path}; if another program's motion: "
            "handavatar motion from {path} --out M.json",
        ),
        Kind("mesh", "an exported mesh", "exports are for other programs: name the run"),
        Kind("page", "a page", "open it in a browser"),
        Kind("product", "a folder that handavatar wrote", "name the run folder, not its pictures"),
    )
}


@dataclass(frozen=True)
class Expected:
    """What an argument may name.

    Attributes:
        noun: for people.
        kinds: names of :data:`KINDS` that are let through to their reader.
        remedy: where such a thing comes from.
        names: values that are no paths, such as the built-in motions.
    """

    noun: str
    kinds: tuple[str, ...]
    remedy: str
    names: tuple[str, ...] = ()


_OF_VIDEOS = ("video", "frames", "pattern")
CAPTURE = Expected(
    "the folder of a capture", ("capture",), "make one: handavatar capture video FILE --out D"
)
AVATAR = Expected(
    "a run folder or an avatar file",
    ("run", "avatar", "weights"),
    "train one: handavatar train CAPTURE",
)
SHOWN = Expected(
    "a run folder (its training may go on) or an avatar file",
    (*AVATAR.kinds, "unfinished run"),
    AVATAR.remedy,
)
VIDEO = Expected(
    "a video, a folder of pictures or a pattern such as frames/%04d.png",
    _OF_VIDEOS,
    "film one bare hand, or record it: handavatar capture webcam --out D",
)
MASKS = Expected("masks: a folder or pattern of pictures, or a video", _OF_VIDEOS, "white is hand")
CAMERAS = Expected(
    "cameras: nerfstudio's transforms.json, or the folder of a model of COLMAP",
    ("scene", "cameras", "capture", "capture file", "JSON", "folder"),
    "leave it out: the camera is then estimated",
)
PRIOR = Expected(
    "an occupancy prior", ("prior", "weights"), "train one: handavatar prior train --out P"
)
TRACKER = Expected(
    "a hand tracker's weights",
    ("tracker", "weights"),
    "train one: handavatar tracker train --out T",
)
PAINT = Expected(
    "a picture (PNG or JPEG)", ("picture",), "paint one in the page of handavatar view"
)
MOTION = Expected(
    "a motion file", ("motion", "JSON"), "make one: handavatar motion from SOURCE --out M.json"
)
CHECKED = Expected(
    # What is no capture at all is the check's own finding.
    CAPTURE.noun,
    (*CAPTURE.kinds, "scene", "folder", "empty folder"),
    CAPTURE.remedy,
)
MOTION_SOURCE = Expected(
    "a capture, a video or another program's motion",
    ("capture", *_OF_VIDEOS, "motion", "JSON", "arrays", "pickle", "folder", "other"),
    "docs/motions.md lists what is read",
)
MANO_FILE = Expected(
    "a MANO file (MANO_RIGHT.pkl or MANO_LEFT.pkl)",
    # One that is missing has an exit code of its own, and words on where to get it.
    ("missing", "pickle", "other"),
    "get it from https://mano.is.tue.mpg.de",
)


def named(expected: Expected, names: Iterable[str]) -> Expected:
    """The same, or one of these names.

    Args:
        expected: what else it may be.
        names: that mean something without a file.
    """
    names = tuple(names)
    return replace(expected, noun=f"{expected.noun}, or one of {', '.join(names)}", names=names)


def kind_of(path: Path) -> Kind:
    """What a path is.

    Args:
        path: as a user gives it; need not exist.

    Raises:
        OSError: it may not be looked at.
    """
    return KINDS[_kind(path)]


def require(path: Path, expected: Expected, argument: str) -> None:
    """Refuses a path that is not of the kinds that an argument takes.

    Args:
        path: as a user gave it.
        expected: what it may be.
        argument: its name, and the command's.

    Raises:
        WrongInput: what it is, what was expected, and what takes it.
        OSError: it may not be looked at.
    """
    if str(path) in expected.names:
        return
    kind = kind_of(path)
    if kind.name in expected.kinds:
        return
    facts = {"path": str(path), "parent": str(path.parent), "example": ""}
    if kind.name.startswith("parent of "):
        found = _children(path, "run.json" if kind.name == "parent of runs" else "transforms.json")
        facts["example"] = str(max(found, key=lambda folder: (folder.stat().st_mtime, folder)))
    lines = [f"{path}: {kind.noun}; {argument} expects {expected.noun}"]
    if kind.name == "missing":
        near = _near(path, expected.names)
        lines.append(f"did you mean {near}?" if near else kind.advice)
    elif kind.name == "run" and "capture" in expected.kinds:
        lines.append(f"its training is finished; {kind.advice.format(**facts)}")
    elif kind.advice:
        lines.append(kind.advice.format(**facts))
    if kind.name in ("missing", "folder", "other", "empty folder", "JSON") or len(lines) == 1:
        lines.append(expected.remedy)
    raise WrongInput("\n".join(lines))


def _kind(path: Path) -> str:
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "pattern" if _is_pattern(path) else "missing"
    except ValueError:  # a zero byte
        return "missing"
    if stat.S_ISDIR(mode):
        return _kind_of_folder(path)
    return _kind_of_file(path) if stat.S_ISREG(mode) else "special"


def _is_pattern(path: Path) -> bool:
    is_one = is_pattern(path.name) and path.parent.is_dir()
    return is_one and path.suffix.lower() not in _VIDEOS


# --- folders --------------------------------------------------------------------------------------


def _kind_of_folder(folder: Path) -> str:
    if (folder / "run.json").is_file() or (folder / "avatar.safetensors").is_file():
        is_finished = (folder / "avatar.safetensors").is_file()
        return "run" if is_finished else "unfinished run"
    if (folder / "transforms.json").is_file():
        return "capture" if _says_hand(folder / "transforms.json") else "scene"
    names = [entry.name for entry in _entries(folder)]
    if ".handavatar" in names:
        return "product"
    if {"cameras.txt", "cameras.bin"} & set(names):
        return "cameras"
    if any(_children(folder, "run.json")):
        return "parent of runs"
    if any(_children(folder, "transforms.json")):
        return "parent of captures"
    if any(name.lower().endswith(_PICTURES) for name in names):
        return "frames"
    return "folder" if names else "empty folder"


def _says_hand(file: Path) -> bool:
    """Whether a transforms.json has this program's block, or may have it: its reader says more."""
    if file.stat().st_size > 64 * 2**20:
        return True
    return b'"handavatar"' in file.read_bytes()


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    with os.scandir(folder) as entries:
        return list(itertools.islice(entries, _MOST_ENTRIES))


def _children(folder: Path, name: str) -> list[Path]:
    """Folders below that hold a file, as far down as runs lie; not all of very many."""

    def walk(where: Path, depth: int) -> Iterator[Path]:
        for entry in _entries(where):
            if entry.name.startswith(".") or not entry.is_dir(follow_symlinks=False):
                continue
            child = Path(entry.path)
            yield child
            if depth > 1:
                yield from walk(child, depth - 1)

    looked_at = itertools.islice(walk(folder, _RUN_DEPTH), _MOST_ENTRIES)
    return [child for child in looked_at if (child / name).is_file()]


# --- files ----------------------------------------------------------------------------------------


def _kind_of_file(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    suffix = path.suffix.lower()
    if not head:
        return "empty file"
    if suffix == ".safetensors" or _is_safetensors(head, path):
        return _kind_of_tensors(path)
    kind = _kind_of_head(head)
    if kind:
        return kind
    if head.lstrip()[:1] in (b"{", b"["):
        return _kind_of_json(path, head)
    for kind, suffixes in (
        ("picture", _PICTURES),
        ("video", _VIDEOS),
        ("arrays", _ARRAYS),
        ("pickle", _PICKLES),
        ("mesh", (".obj", ".ply")),
        ("page", (".html", ".htm")),
        ("JSON", (".json",)),
    ):
        if suffix in suffixes:
            return kind
    return "other"


def _kind_of_head(head: bytes) -> str:
    """By the bytes that files of a kind begin with; empty if they tell nothing."""
    if head[4:8] == b"ftyp":
        return "picture" if head[8:12] in _STILL_BRANDS else "video"
    if head[:4] == b"RIFF":
        return "picture" if head[8:12] == b"WEBP" else "video"
    for kind, beginnings in (
        ("picture", (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*")),
        ("video", (b"\x1aE\xdf\xa3", b"GIF8", b"\0\0\x01\xba", b"OggS", b"FLV\x01", b"0&\xb2u")),
        ("arrays", (b"\x93NUMPY",)),
        ("mesh", (b"glTF", b"ply\n", b"ply\r")),
        ("pickle", (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")),
    ):
        if head.startswith(beginnings):
            return kind
    return ""


def _kind_of_json(path: Path, head: bytes) -> str:
    if path.name == "transforms.json":
        return "capture file"
    return "motion" if b'"rotations"' in head else "JSON"


def _is_safetensors(head: bytes, path: Path) -> bool:
    size = int.from_bytes(head[:8], "little")
    return 8 <= size <= min(_MOST_HEADER, path.stat().st_size) and head[8:9] == b"{"


def _kind_of_tensors(path: Path) -> str:
    """By the names of a safetensors file's tensors, and what it says of itself."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        header = file.read(size) if size <= _MOST_HEADER else b""
    try:
        names = json.loads(header)
        facts = set(names.pop("__metadata__", None) or {})
    except (ValueError, RecursionError, AttributeError, TypeError):
        return "weights"
    if "handavatar" in facts:
        return "avatar"
    if {"schema", "name", "sha256"} <= facts or "template_vertices" in names:
        return "rig"
    if {"rig_sha256", "vertices"} <= facts:
        return "tracker"
    if {"shares", "bones"} == set(names):
        return "skin"
    if any(name.startswith("avatar.") for name in names):
        return "checkpoint"
    if any(name.startswith("decoder.") for name in names):
        return "prior"
    return "weights"


def _near(path: Path, names: tuple[str, ...]) -> str:
    """A name that is like a missing one, or one that lies beside it; empty if there is none."""
    near = difflib.get_close_matches(str(path), names, n=1)
    if near:
        return near[0]
    try:
        beside = [entry.name for entry in _entries(path.parent)]
    except OSError:
        return ""
    near = difflib.get_close_matches(path.name, beside, n=1, cutoff=0.8)
    return str(path.parent / near[0]) if near else ""
