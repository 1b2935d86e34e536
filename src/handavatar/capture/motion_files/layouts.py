"""The layouts by name; which of them a file is of, where it tells for certain."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.body import is_amass, read_amass
from handavatar.capture.motion_files.mano_parameters import (
    HAND_NAMES,
    ROOT_NAMES,
    WHOLE_NAMES,
    is_interhand,
    read_interhand,
    read_parameters,
)
from handavatar.capture.motion_files.parameters import side_rows
from handavatar.capture.motion_files.soma import is_soma, read_soma
from handavatar.capture.motion_files.stored import Fields, Part, first_of, read_parts
from handavatar.capture.motion_files.track import (
    Conventions,
    HandTrack,
    LayoutName,
    ModelFinder,
)
from handavatar.capture.motion_files.trackers import OWN_NAMES, is_hawor, read_hamer, read_hawor


@dataclass(frozen=True)
class Layout:
    """One layout, and what is known of every file of it.

    Attributes:
        name: as ``--layout`` has it.
        writer: what is in such files.
        flat_hand_mean: whether its poses count from the flat hand; ``told``: the user must say.
    """

    name: LayoutName
    writer: str
    flat_hand_mean: Literal["true", "false", "told"]


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout("hamer", "HaMeR's or WiLoR's results", "true"),
        Layout("wilor", "WiLoR's results", "true"),
        Layout("wilor-mini", "WiLoR-mini's results", "true"),
        Layout("hawor", "HaWoR's cam_space", "true"),
        Layout("mano", "MANO's parameters as smplx names them", "told"),
        Layout("arctic", "ARCTIC's raw .mano.npy", "false"),
        Layout("interhand", "InterHand2.6M's or Re:InterHand's MANO fits", "false"),
        Layout("amass", "AMASS's SMPL+H bodies, the fingers alone", "true"),
        Layout("soma", "SOMA-X's npz", "true"),
    )
}


def read_track(
    source: Path, conventions: Conventions, find_model: ModelFinder
) -> tuple[HandTrack, Layout]:
    """One hand out of a file of any layout, and which layout it was taken for.

    Args:
        source: a file, or a folder of files of one kind.
        conventions: what the user says of it.
        find_model: gives the user's MANO file of a side.

    Raises:
        CaptureError: it cannot be read, contradicts what the user says, or does not say enough.
        LicensedRigMissing: a MANO file is needed.
    """
    is_folder_of_hawor = source.is_dir() and is_hawor(source, {})
    parts = [] if is_folder_of_hawor else read_parts(source)
    name = conventions.layout
    if name == "auto":
        name = "hawor" if is_folder_of_hawor else detect_layout(parts, conventions, source)
    elif is_folder_of_hawor and name != "hawor":
        raise CaptureError(
            f"{source}: it holds the folders 0 and 1 of HaWoR, `layout` says {name}",
            "leave `layout` out, or name a file",
        )
    layout = LAYOUTS[name]
    conventions = _with_mean(conventions, layout, source)
    return _read(name, parts, conventions, find_model, source), layout


def _read(
    name: str, parts: list[Part], conventions: Conventions, find_model: ModelFinder, source: Path
) -> HandTrack:
    if name in ("hamer", "wilor", "wilor-mini"):
        return read_hamer(parts, conventions, name != "wilor-mini", source)
    if name == "hawor":
        return read_hawor(source, conventions)
    if name == "interhand":
        return read_interhand(parts, conventions, find_model, source)
    if name in ("mano", "arctic"):
        return read_parameters(parts, conventions, find_model, source)
    if len(parts) > 1:
        raise CaptureError(f"{source}: {len(parts)} files", f"name one file of {name}")
    return (read_amass if name == "amass" else read_soma)(parts[0], conventions)


def _with_mean(conventions: Conventions, layout: Layout, source: Path) -> Conventions:
    """What the poses count from, by the layout or by the user; they must agree."""
    known = layout.flat_hand_mean
    if known == "told":
        return conventions
    if conventions.flat_hand_mean not in ("auto", known):
        counts_from = "the flat hand" if known == "true" else "MANO's mean pose"
        raise CaptureError(
            f"{source}: poses of {layout.writer} count from {counts_from}, "
            f"`flat_hand_mean` says {conventions.flat_hand_mean}",
            "leave `flat_hand_mean` out, or say `layout='mano'` for a file of your own",
        )
    if conventions.use_pca and known == "true":
        raise CaptureError(
            f"{source}: {layout.writer} hold no principal components, `use_pca` says so",
            "leave `use_pca` out, or say `layout='mano'` for a file of your own",
        )
    return replace(conventions, flat_hand_mean=known)


def detect_layout(parts: list[Part], conventions: Conventions, source: Path) -> LayoutName:
    """The layout of files that tell it for certain.

    Args:
        parts: of the source.
        conventions: the side, if the user says it.
        source: for messages.

    Raises:
        CaptureError: they do not: what was found, and what the user can say.
    """
    fields, path = parts[0].fields, parts[0].path
    if is_soma(fields):
        return "soma"
    if is_amass(fields):
        return "amass"
    if path.suffix.lower() == ".json" and is_hawor(path, fields):
        return "hawor"
    if path.suffix.lower() == ".json" and is_interhand(fields, path.stem):
        return "interhand"
    if _is_arctic(fields):
        return "arctic"
    if first_of(fields, ROOT_NAMES[:1]) and first_of(fields, HAND_NAMES[:1]):
        if first_of(fields, OWN_NAMES) or _has_matrices(fields):
            return _tracker(parts, conventions, source)
        return "mano"
    if first_of(fields, WHOLE_NAMES) or first_of(fields, ROOT_NAMES):
        return "mano"
    if {"schema", "rotations", "translations"} <= set(fields):
        raise CaptureError(
            f"{source}: it is a motion file already", "give it to handavatar render RUN as `motion`"
        )
    held = ", ".join(name for name in sorted(fields)[:12] if name) or "one array without a name"
    raise CaptureError(
        f"{source}: its layout is not known; it holds {held}",
        f"say what wrote it with `layout`: {', '.join(LAYOUTS)}",
    )


def _is_arctic(fields: Fields) -> bool:
    hands = [fields[side] for side in ("left", "right") if isinstance(fields.get(side), dict)]
    return bool(hands) and all({"rot", "pose", "trans", "shape"} <= set(hand) for hand in hands)


def _has_matrices(fields: Fields) -> bool:
    return np.shape(fields[first_of(fields, HAND_NAMES)])[-3:] == (15, 3, 3)


def _tracker(parts: list[Part], conventions: Conventions, source: Path) -> LayoutName:
    """HaMeR or WiLoR-mini: alike but for left hands, where the file cannot tell them apart."""
    for part in parts:
        sides = side_rows(part.fields, _count(part), part.path)
        is_right = conventions.side == "right" and (sides is None or bool((sides == 1).any()))
        if not is_right and (sides is None or bool((sides == 0).any())):
            raise CaptureError(
                f"{source}: a left hand of a tracker (or one of an unknown side), which HaMeR and "
                "WiLoR describe as a mirrored right hand, WiLoR-mini as a left one",
                "say which: `layout='hamer'`, wilor or wilor-mini",
            )
    return "hamer" if _has_matrices(parts[0].fields) else "wilor-mini"


def _count(part: Part) -> int:
    """Hands in a file, by its finger poses."""
    values = np.asarray(part.fields[first_of(part.fields, HAND_NAMES)])
    tail = 3 if values.shape[-3:] == (15, 3, 3) else 2 if values.shape[-2:] == (15, 3) else 1
    return int(np.prod(values.shape[: values.ndim - tail], dtype=np.int64))
