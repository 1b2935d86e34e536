"""What became of a video's pictures: splits, reasons, agreement, a summary, a contact sheet."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.fitted_frames import FittedFrame, picture_name
from handavatar.capture.frames import SPLITS, Frame
from handavatar.capture.left_out import CAUSES, LeftOut
from handavatar.capture.overview import Tile, contact_sheet, outlined
from handavatar.capture.seen_skin import SeenSkin
from handavatar.capture.tracking import DARK, NO_HAND, Track
from handavatar.jobs.files import FolderKind, mark_folder, write_atomically

_HELD_OUT = ((0.28, 0.08), (0.68, 0.08))
# Of the mesh: as much of it beyond the picture is contact with the border.
_TOUCHES = 0.01
# Of the tracker's votes for one side.
_CLEAR_VOTE = 0.75

MIN_KEPT = 8
"""Pictures that a capture needs."""

FAILED_CAPTURE = FolderKind("failed capture", ("overview.png", "reasons.json"))
"""The folder that shows why a video could not be used."""


@dataclass(frozen=True, eq=False)
class TriedClip:
    """A recording, and what became of its pictures.

    Attributes:
        file: its name.
        track: the hand in its pictures.
        results: pictures in which it was found; none where it did not come that far.
        number: of the recording.
        focal: length, pixels of its pictures.
    """

    file: str
    track: Track
    results: Sequence[FittedFrame] = ()
    number: int = 0
    focal: float = 0.0

    @property
    def indices(self) -> list[int]:
        """Of all pictures that were looked at, growing."""
        return sorted([hand.index for hand in self.track.hands] + list(self.track.skipped))

    def splits(self) -> dict[str, str]:
        """The split of every picture that was looked at, with a hand or without, by its name."""
        names = [picture_name(self.number, index) for index in self.indices]
        return dict(zip(names, held_out_splits(len(names)), strict=True))

    def left_out(self) -> dict[str, LeftOut]:
        """The reason of every picture that is not kept, by its name, in the order of time."""
        found = {
            picture_name(self.number, index): LeftOut(
                reason if reason in CAUSES else "pose", reason
            )
            for index, reason in self.track.skipped.items()
        }
        for result in self.results:
            if result.reason is not None:
                found[result.frame.name] = result.reason
        return dict(sorted(found.items()))

    def tiles(self) -> list[Tile]:
        """All pictures in the order of time: the fitted crop where there is one, else the whole."""
        tiles = {}
        for glance in self.track.glances:
            name = picture_name(self.number, glance.index)
            tiles[name] = Tile(name, glance.image, self.track.skipped.get(glance.index, ""))
        for result in self.results:
            frame = result.frame
            title = f"{frame.name}  {frame.confidence:.2f}"
            text = "" if result.reason is None else result.reason.text
            tiles[frame.name] = Tile(title, outlined(frame, result.mesh), text)
        return [tiles[name] for name in sorted(tiles)]


def held_out_splits(count: int) -> list[str]:
    """Two stretches of time are held out for tests, together at least 15 % of the frames."""
    splits = ["train"] * count
    for start, share in _HELD_OUT:
        first, length = round(start * count), int(np.ceil(share * count))
        splits[first : first + length] = ["test"] * length
    return splits


def kept_frames(clips: Sequence[TriedClip]) -> list[Frame]:
    """The frames to write, with their splits."""
    frames = []
    for clip in clips:
        splits, left_out = clip.splits(), clip.left_out()
        frames += [
            replace(result.frame, split=splits[result.frame.name])
            for result in clip.results
            if result.frame.name not in left_out
        ]
    return frames


def with_common_gain(frames: Sequence[Frame]) -> list[Frame]:
    """The gains relative to the average of all frames."""
    mean = torch.stack([frame.gain.double().log() for frame in frames]).mean(0)
    return [
        replace(frame, gain=((frame.gain.double().log() - mean).exp() * 1e4).round().float() / 1e4)
        for frame in frames
    ]


def skipped(clips: Sequence[TriedClip]) -> dict[str, Any]:
    """Pictures that were left out, as JSON: the reason of each, and how many have which."""
    left_out = _all_left_out(clips)
    return {
        "frames": {name: reason.text for name, reason in left_out.items()},
        "reasons": dict(Counter(reason.kind for reason in left_out.values()).most_common()),
    }


def _all_left_out(clips: Sequence[TriedClip]) -> dict[str, LeftOut]:
    return {name: reason for clip in clips for name, reason in clip.left_out().items()}


def too_few(clips: Sequence[TriedClip], num_kept: int) -> tuple[str, str]:
    """What to say where too few pictures are left: what was most often in the way."""
    kinds = Counter(reason.kind for reason in _all_left_out(clips).values())
    kind, count = kinds.most_common(1)[0]
    brightness = [float(glance.image.mean()) for clip in clips for glance in clip.track.glances]
    votes = float(np.mean([clip.track.votes_right for clip in clips]))
    if kind in ("pose", NO_HAND) and brightness and float(np.median(brightness)) < DARK:
        kind = "dark"
    elif kind == "pose" and 1 - _CLEAR_VOTE < votes < _CLEAR_VOTE:
        kind = "side"
    total = sum(len(clip.indices) for clip in clips)
    cause, remedy = CAUSES[kind]
    files = ", ".join(clip.file for clip in clips)
    return (
        f"{files}: only {num_kept} of {total} pictures can be used, at least {MIN_KEPT} "
        f"are needed; in {count} of the others {cause}",
        remedy,
    )


def failure(out: Path, what: str, remedy: str, clips: Sequence[TriedClip]) -> CaptureError:
    """The error to raise; all pictures and their reasons lie beside the would-be capture.

    Args:
        out: folder of the capture.
        what: was found.
        remedy: what to do.
        clips: as far as they came.
    """
    folder = _fresh_folder(out)
    mark_folder(folder, FAILED_CAPTURE)
    overview(clips, folder / "overview.png")
    said = {"failed": what, "remedy": remedy, "notes": _notes(clips)}
    save_json(folder / "reasons.json", said | skipped(clips))
    return CaptureError(what, f"{remedy}\neach picture and its reason: {folder / 'overview.png'}")


def _notes(clips: Sequence[TriedClip]) -> list[str]:
    """What was told of each recording, by its name where there are several."""
    if len(clips) == 1:
        return list(clips[0].track.notes)
    return [f"{clip.file}: {note}" for clip in clips for note in clip.track.notes]


def _fresh_folder(out: Path) -> Path:
    """A folder beside a name that nobody has used yet: with ``.failed``, or a number behind it."""
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        ending = ".failed" if number == 1 else f".failed-{number}"
        folder = out.with_name(out.name + ending)
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            continue
        return folder


def overview(clips: Sequence[TriedClip], path: Path) -> None:
    """Writes a contact sheet of all pictures."""
    contact_sheet([tile for clip in clips for tile in clip.tiles()]).save(path)


def agreement(clips: Sequence[TriedClip]) -> dict[str, Any]:
    """How well hand and pictures agree, frame by frame and on average, as JSON."""
    results = [result for clip in clips for result in clip.results]
    return {
        "focal_pixels": clips[0].focal,
        "mean_mask_iou": float(np.mean([result.mask_iou for result in results])),
        "mean_landmark_error_pixels": float(np.mean([r.landmark_error for r in results])),
        "frames": {
            result.frame.name: {
                "confidence": round(result.frame.confidence, 4),
                "mask_iou": round(result.mask_iou, 4),
                "mask_quality": round(result.mask_quality, 4),
                "landmark_error_pixels": round(result.landmark_error, 3),
                "outside_share": round(result.outside_share, 4),
                "unknown_share": round(result.unknown_share, 4),
            }
            for result in results
        },
    }


def summary(clips: Sequence[TriedClip], kept: Sequence[Frame], seen: SeenSkin) -> dict[str, Any]:
    """What a person wants to know of the capture, as JSON.

    Args:
        clips: all recordings.
        kept: frames that are written.
        seen: how often each part of the skin was.
    """
    names = {frame.name for frame in kept}
    gains = torch.stack([frame.gain for frame in kept])
    splits = [split for clip in clips for split in clip.splits().values()]
    of_splits = {
        split: {
            "pictures": splits.count(split),
            "kept": sum(frame.split == split for frame in kept),
        }
        for split in SPLITS
        if split in splits
    }
    outside = [
        result.outside_share
        for clip in clips
        for result in clip.results
        if result.frame.name in names
    ]
    side = clips[0].track.side
    counts = [len(clip.track.hands) for clip in clips]
    votes = float(np.average([clip.track.votes_right for clip in clips], weights=counts))
    found: dict[str, Any] = {
        "notes": _notes(clips),
        "side": side,
        # Of the side that was taken: low where --side overruled the tracker.
        "side_votes": round(votes if side == "right" else 1 - votes, 3),
        "pictures": len(splits),
        "kept": len(kept),
        "left_out": skipped(clips)["reasons"],
        "splits": of_splits,
        "border": {
            "frames": sum(share > _TOUCHES for share in outside),
            "largest_share": round(max(outside), 4),
        },
        "gain": {
            "smallest": [round(value, 4) for value in gains.amin(0).tolist()],
            "largest": [round(value, 4) for value in gains.amax(0).tolist()],
        },
        "skin_never_seen": {
            "share": round(seen.unseen_share, 4),
            "regions": seen.unseen_regions,
        },
    }
    if len(clips) > 1:
        found["clips"] = [
            {
                "file": clip.file,
                "pictures": len(clip.indices),
                "kept": sum(frame.clip == clip.number for frame in kept),
                "focal_pixels": clip.focal,
            }
            for clip in clips
        ]
    return found


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """A capture's summary, as ``fit.json`` has it, for people to read.

    Args:
        summary: side, frames kept and left out, border, exposure, skin that nobody saw.
    """
    other = {"left": "right", "right": "left"}[summary["side"]]
    sure = round(100 * summary["side_votes"])
    lines = [
        *(f"note: {note}" for note in summary.get("notes", [])),
        f"hand: {summary['side']} ({sure} % of the tracker's votes; `side={other!r}` overrules it)",
        f"frames: {summary['kept']} of {summary['pictures']} kept",
    ]
    for kind, count in summary["left_out"].items():
        lines.append(f"  {count} left out: {CAUSES[kind][0]}")
    parts = [
        f"{split} {counts['kept']} of {counts['pictures']}"
        for split, counts in summary["splits"].items()
    ]
    for clip in summary.get("clips", []):
        lines.append(f"  {clip['file']}: {clip['kept']} of {clip['pictures']} kept")
    lines.append(f"splits: {', '.join(parts)}")
    border = summary["border"]
    lines.append(
        f"border: the hand reaches beyond the picture in {border['frames']} kept frames, by at "
        f"most {100 * border['largest_share']:.0f} % of it"
    )
    gain = summary["gain"]
    low, high = min(gain["smallest"]), max(gain["largest"])
    lines.append(f"exposure and white balance: {low:.2f} to {high:.2f} of the average")
    skin = summary["skin_never_seen"]
    names = "; ".join(skin["regions"])
    lines.append(
        f"skin never seen: {100 * skin['share']:.0f} %" + (f" (most of: {names})" if names else "")
    )
    return lines


def save_json(path: Path, content: object) -> None:
    """Writes JSON that people may read."""
    write_atomically({path: json.dumps(content, indent=1, allow_nan=False).encode()})
