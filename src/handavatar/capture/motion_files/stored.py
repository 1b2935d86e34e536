"""Arrays by name out of npz, npy, JSON and pickle files; nothing in a file is run.

A file becomes nested dictionaries of numpy arrays and text. A folder's files are its parts, in the
order of the numbers in their names.
"""

import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handavatar.capture.checks import CaptureError, load_json
from handavatar.hand.inert_pickle import InertObject, PickleError, read_pickle
from handavatar.hand.pickled_arrays import ARRAY_NAMES, dense_array, single_object

SUFFIXES = (".npz", ".npy", ".json", ".pkl")
_PROGRAMS = (".pt", ".pth", ".pickle", ".joblib")
MAX_BYTES = 512 * 2**20
_MAX_FILES = 200_000
_MAX_DEPTH = 6
_MOST_ROWS = 200_000
"""Of frames or hands: 28 minutes at 120 a second."""
_MOST_NUMBERS = 160 * _MOST_ROWS
"""Of an array; whole bodies have 156 a row."""

Fields = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Part:
    """One file.

    Attributes:
        path: where it lies.
        number: the last whole number in its name; -1 if there is none.
        fields: what it holds: arrays, text, None, and dictionaries of these.
    """

    path: Path
    number: int
    fields: Fields


def is_motion_file(path: Path) -> bool:
    """Whether a path is a file that is read here, or refused by name, or a folder of such files."""
    if path.is_file():
        return path.suffix.lower() in (*SUFFIXES, *_PROGRAMS)
    if not path.is_dir():
        return False
    names = [child for child in path.iterdir() if child.is_file()]
    return bool(names) and all(name.suffix.lower() in SUFFIXES for name in names)


def read_parts(source: Path) -> list[Part]:
    """A file, or all files of a folder.

    Raises:
        CaptureError: there are none, or one cannot be read.
    """
    if source.is_file():
        return [read_part(source)]
    paths = [path for path in source.iterdir() if path.suffix.lower() in SUFFIXES]
    if not 0 < len(paths) <= _MAX_FILES:
        raise CaptureError(
            f"{source}: {len(paths)} files of the kinds {', '.join(SUFFIXES)}",
            "name a file, or a folder that holds one of them for each frame",
        )
    kinds = sorted({path.suffix.lower() for path in paths})
    if len(kinds) > 1:
        raise CaptureError(
            f"{source}: files of the kinds {', '.join(kinds)} lie side by side",
            "keep one kind in the folder",
        )
    return [read_part(path) for path in sorted(paths, key=_order)]


def read_part(path: Path) -> Part:
    """One file.

    Raises:
        CaptureError: it is missing, too large, damaged, or holds something that would have to be
            run to be read.
    """
    suffix = path.suffix.lower()
    if path.is_symlink() or not path.is_file():
        raise CaptureError(f"{path}: no such file", "name a file; links are not followed")
    if suffix not in SUFFIXES:
        raise CaptureError(
            f"{path}: files of the kinds {', '.join(SUFFIXES)} are read",
            "torch's and joblib's files are programs: save their arrays with numpy.savez",
        )
    if path.stat().st_size > MAX_BYTES:
        raise CaptureError(
            f"{path}: larger than {MAX_BYTES // 2**20} MB", "save the hand's parameters alone"
        )
    try:
        if suffix == ".npz":
            fields = _read_npz(path)
        elif suffix == ".npy":
            fields = _read_npy(path)
        elif suffix == ".pkl":
            fields = _plain_fields(read_pickle(path.read_bytes(), ARRAY_NAMES))
        else:
            fields = _json_fields(load_json(path, MAX_BYTES), path, 0)
    except PickleError as error:
        raise CaptureError(
            f"{path}: not read, {error}",
            "a pickle is a program and is not run: save its arrays with numpy.savez",
        ) from error
    return Part(path, _number(path), fields)


def _order(path: Path) -> list[tuple[int, int, str]]:
    """Names in the order of the numbers in them."""
    pieces = re.split(r"(\d+)", path.stem)
    return [(1, int(p), "") if p.isdigit() and p.isascii() else (0, 0, p) for p in pieces]


def _number(path: Path) -> int:
    found = re.findall(r"[0-9]{1,15}", path.stem)
    return int(found[-1]) if found else -1


def _read_npz(path: Path) -> Fields:
    try:
        with zipfile.ZipFile(path) as archive:
            members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            if sum(member.file_size for member in members) > MAX_BYTES:
                raise CaptureError(
                    f"{path}: unpacks to more than {MAX_BYTES // 2**20} MB",
                    "save the hand's parameters alone",
                )
            return {
                member.filename.removesuffix(".npy"): _member(archive, member, path)
                for member in members
            }
    except (CaptureError, MemoryError):
        raise
    except Exception as error:  # Of whatever kind: numpy and zipfile stumble in many ways.
        raise CaptureError(f"{path}: not a whole npz file ({error})", "save it again") from error


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path) -> np.ndarray:
    with archive.open(member) as file:
        kind = _npy_type(file, member.file_size)
    if kind.hasobject:
        name = member.filename.removesuffix(".npy")
        raise CaptureError(
            f"{path}: {name} cannot be read without running a pickle",
            f"save {name} as an array of numbers",
        )
    with archive.open(member) as file:
        found: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return found


def _read_npy(path: Path) -> Fields:
    with path.open("rb") as file:
        try:
            kind = _npy_type(file, path.stat().st_size)
        except Exception as error:  # Of whatever kind: numpy parses the header as Python.
            raise CaptureError(
                f"{path}: not an npy file ({str(error)[:80]})", "save it again"
            ) from error
        if kind.hasobject:
            return _plain_fields(single_object(read_pickle(file.read(), ARRAY_NAMES)))
    try:
        return {"": np.load(path, allow_pickle=False)}
    except MemoryError:
        raise
    except Exception as error:  # Of whatever kind, as in :func:`_read_npz`.
        raise CaptureError(f"{path}: not a whole npy file ({error})", "save it again") from error


def _npy_type(file: Any, size: int) -> np.dtype:
    """The type of the array that begins here; the file stands behind its header afterwards.

    Raises:
        ValueError: it is not an npy file, or says that it holds more than it has bytes, for which
            numpy would make room.
    """
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, kind = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, kind = np.lib.format.read_array_header_2_0(file)
    if math.prod(shape) * kind.itemsize > size and not kind.hasobject:
        raise ValueError(f"of shape {shape} and type {kind} in {size} bytes")
    return kind


def _plain_fields(value: Any, depth: int = 0) -> Fields:
    """A pickled dictionary as arrays and text."""
    if not isinstance(value, dict) or depth > _MAX_DEPTH:
        raise PickleError(f"it holds no dictionary but something of type {type(value).__name__}")
    fields: Fields = {}
    for name, member in value.items():
        key = name.decode("latin-1") if isinstance(name, bytes) else str(name)
        if isinstance(member, dict):
            fields[key] = _plain_fields(member, depth + 1)
        elif isinstance(member, InertObject):
            fields[key] = dense_array(member)
        elif isinstance(member, list | tuple):
            fields[key] = _array(list(member), key)
        elif member is None or isinstance(member, str):
            fields[key] = member
        elif isinstance(member, bool | int | float):
            fields[key] = np.asarray(member)
        else:
            raise PickleError(f"{key[:40]} is of type {type(member).__name__}, expected an array")
    return fields


def _array(values: list[Any], key: str) -> np.ndarray:
    try:
        found = np.asarray(values)
    except (ValueError, OverflowError) as error:
        raise PickleError(f"{key[:40]} is a list whose rows differ in length") from error
    if found.dtype.kind not in "fiubU":
        raise PickleError(f"{key[:40]} is a list of something else than numbers")
    return found


def _json_fields(content: dict[str, Any], path: Path, depth: int) -> Fields:
    fields: Fields = {}
    for key, value in content.items():
        if isinstance(value, dict) and depth < _MAX_DEPTH:
            fields[key] = _json_fields(value, path, depth + 1)
        elif isinstance(value, list):
            try:
                fields[key] = _array(value, key)
            except PickleError as error:
                raise CaptureError(f"{path}: {error}", f"write {key} as numbers") from error
        elif value is None or isinstance(value, str):
            fields[key] = value
        elif isinstance(value, bool | int | float):
            fields[key] = np.asarray(value)
        else:
            raise CaptureError(f"{path}: {key[:40]} is nested too deeply", "flatten it")
    return fields


# --- fields ---------------------------------------------------------------------------------------


def first_of(fields: Fields, names: tuple[str, ...]) -> str:
    """The first of several names under which a quantity is known; empty if none is there."""
    return next((name for name in names if fields.get(name) is not None), "")


def array_field(fields: Fields, names: tuple[str, ...], path: Path) -> np.ndarray:
    """Finite numbers under one of several names, in double precision.

    Raises:
        CaptureError: there is none of them, or it holds no finite numbers.
    """
    name = first_of(fields, names)
    if not name:
        have = ", ".join(sorted(fields)[:12]) or "nothing"
        raise CaptureError(
            f"{path}: there is no {' or '.join(names)}; it holds {have}",
            f"save {names[0]}, or say with `layout` what wrote the file",
        )
    value = fields[name]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        raise CaptureError(f"{path}: {name} is no array of numbers", f"save {name} as numbers")
    if not value.size:
        raise CaptureError(f"{path}: {name} is empty", "give at least one frame")
    if value.size > _MOST_NUMBERS:
        raise CaptureError(
            f"{path}: {name} has {value.size:,} numbers, at most {_MOST_NUMBERS:,} are read",
            "save a part of the recording, and the hand's parameters alone",
        )
    numbers = value.astype(np.float64)
    if not np.isfinite(numbers).all():
        where = np.argwhere(~np.isfinite(numbers))[0]
        raise CaptureError(
            f"{path}: {name} is NaN or infinite at {where.tolist()}",
            "leave such frames out, or write zeros where no hand was seen",
        )
    return numbers


def rows_of(values: np.ndarray, shape: tuple[int, ...], name: str, path: Path) -> np.ndarray:
    """An array as rows of one shape; leading axes of one hand or one frame are folded together.

    Raises:
        CaptureError: its last axes are others.
    """
    if values.shape[values.ndim - len(shape) :] != shape or values.ndim < len(shape):
        raise CaptureError(
            f"{path}: {name} has shape {values.shape}, expected it to end with {shape}",
            "save it as the program gave it",
        )
    leading = values.shape[: values.ndim - len(shape)]
    if sum(size > 1 for size in leading) > 1:
        raise CaptureError(
            f"{path}: {name} has shape {values.shape}: it is not told which axis counts the frames",
            f"save one hand, of shape (frames, {', '.join(map(str, shape))})",
        )
    if math.prod(leading) > _MOST_ROWS:
        raise CaptureError(
            f"{path}: {name} has {math.prod(leading):,} rows, at most {_MOST_ROWS:,} are read",
            "save a part of the recording",
        )
    return values.reshape(math.prod(leading), *shape)


def text_value(value: Any) -> str:
    """Text that stands alone or in an array of no dimension; empty if it is something else."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "US" and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value) if isinstance(value, str) else ""
