"""Figures that a bench keeps: of which capture they are, and which commit measured them.

A kept table is worth what is known of where it comes from. Every file of figures carries the
fingerprint of its capture, and the commit of each row. Figures of another capture are refused, and
so are those of another commit, unless they are asked for: then the table says which they are. Of
files by versions that recorded neither, the table says that.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from handavatar import __version__
from handavatar.capture.checks import CaptureError, load_json
from handavatar.capture.frames import COVARIANCES, LANDMARKS
from handavatar.train.provenance import folder_sha256, source_commit
from handavatar.train.runs import write_json

_OF_A_CAPTURE = ("transforms.json", "images", "masks", "known", "truth", COVARIANCES, LANDMARKS)
_SHORT = 12
_DIGEST = "figures_sha256"
_ANEW = "name another folder for what is kept, or move this file away, to measure anew"


@cache
def present_commit() -> str:
    """Commit of this program; of an installed copy its version."""
    return source_commit() or f"version {__version__}"


def capture_fingerprint(folder: Path) -> str:
    """Of all that figures can depend on: poses, cameras, pictures, masks, truth.

    Args:
        folder: of a capture.
    """
    return folder_sha256(folder, tuple(n for n in _OF_A_CAPTURE if (folder / n).exists()))


def origin(sha256: str, rows: Iterable[str]) -> dict[str, Any]:
    """What a file of figures says of its origin, for rows that were measured now.

    Args:
        sha256: fingerprint of what they were measured on.
        rows: their names.
    """
    return {"capture_sha256": sha256, "commits": dict.fromkeys(rows, present_commit())}


def read_kept(path: Path, sha256: str, any_commit: bool) -> dict[str, Any]:
    """The figures of a file; nothing if there is none.

    Args:
        path: of the file.
        sha256: fingerprint of the capture, or whatever else, that figures are wanted of.
        any_commit: whether those that another commit measured are wanted too.

    Raises:
        CaptureError: if the file is damaged, of another capture, or of another commit.
    """
    if not path.is_file():
        return {}
    kept = load_json(path)
    known, commits = kept.get("capture_sha256"), kept.get("commits", {})
    if not isinstance(commits, dict) or not isinstance(known, str | None):
        raise CaptureError(f"{path}: does not say where its figures come from", _ANEW)
    if known is not None and known != sha256:
        raise CaptureError(
            f"{path}: its figures are of another capture: fingerprint {known[:_SHORT]}, that of "
            f"the capture given is {sha256[:_SHORT]}",
            _ANEW,
        )
    if _DIGEST in kept and kept[_DIGEST] != _digest(kept):
        raise CaptureError(f"{path}: its figures were changed after they were written", _ANEW)
    others = sorted({str(commit) for commit in commits.values()} - {present_commit()})
    if others and not any_commit:
        raise CaptureError(
            f"{path}: its figures were measured by commit {', '.join(others)[:200]}, this is "
            f"{present_commit()}",
            f"give `any_commit=True` to see them as they are, or {_ANEW}",
        )
    return kept


def write_kept(path: Path, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Writes figures with what tells whether they are still the same when they are read.

    Args:
        path: of the file.
        figures: with their origin, JSON.

    Returns:
        What :func:`read_kept` gives.
    """
    kept = json.loads(json.dumps(dict(figures), allow_nan=False))
    kept[_DIGEST] = _digest(kept)
    write_json(path, kept)
    return kept


def _digest(kept: Mapping[str, Any]) -> str:
    figures = {name: value for name, value in kept.items() if name != _DIGEST}
    return hashlib.sha256(json.dumps(figures, sort_keys=True).encode()).hexdigest()


def require_known_origin(path: Path, kept: Mapping[str, Any]) -> None:
    """Refuses to put figures that are measured now beside those of who knows what.

    Args:
        path: of the file.
        kept: its figures.

    Raises:
        CaptureError: if the file says of no capture.
    """
    if "capture_sha256" not in kept:
        raise CaptureError(
            f"{path}: was kept by a version that did not record of which capture its figures are: "
            "others cannot be put beside them",
            _ANEW,
        )


def origin_notes(kept: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """What a reader of a table must know of where its figures come from; nothing if all is usual.

    Args:
        kept: what was kept, by what it is of.
    """
    notes = []
    for name, figures in kept.items():
        if "capture_sha256" not in figures:
            notes.append(
                f"{name}: kept by a version that recorded neither the capture's fingerprint nor "
                f"the commit: measured by another commit than this ({present_commit()}), and not "
                "compared with the capture."
            )
            continue
        notes += commit_notes(name, figures["commits"])
    return tuple(notes)


def commit_notes(name: str, commits: Mapping[str, str]) -> list[str]:
    """Which figures other commits have measured; nothing if none have.

    Args:
        name: of what the figures are of.
        commits: by what each of them measured.
    """
    of_commits: dict[str, list[str]] = {}
    for what, commit in commits.items():
        of_commits.setdefault(commit, []).append(what)
    return [
        f"{name}: measured by commit {commit}, not by this one ({present_commit()}): "
        f"{', '.join(measured)}."
        for commit, measured in of_commits.items()
        if commit != present_commit()
    ]
