"""``handavatar bench --table lift``: a lifted shadow against a hand whose finger casts none.

The truth is path traced once more without the lifted bones' skin. Where both pictures show the same
point of the hand, one holds the light with the finger's shadow, the other the light without it.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture.checks import CaptureError, load_json
from handavatar.capture.frame_sequence import spread_numbers
from handavatar.capture.frames import Capture, Frame, read_capture
from handavatar.capture.synthetic import Subject, SynthOptions, lifted_truths, make_subject
from handavatar.edit import Edit, bones_named
from handavatar.errors import require_ranges
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.metrics import psnr
from handavatar.evaluate.tables import Cell, ResultTable, step_counter
from handavatar.hand.detail import subdivided
from handavatar.hand.rigs import load_rig
from handavatar.jobs.progress import SILENT, Progress

CHANGED = 4 / 255
"""A pixel counts as shaded by the finger if its true colour changes by more, in any channel."""
_FEWEST = 30
"""Frames in which fewer pixels change are left out."""


@dataclass(frozen=True)
class LiftTableOptions:
    """What is lifted, and which avatars are judged.

    Attributes:
        capture: a made capture.
        avatars: run folders or avatar files of its subject, one after the other.
        lift: fingers or bones, comma-separated; several with ``+`` are lifted together.
        frames: of the test split, evenly spread.
        samples: light paths per pixel of the truth.
    """

    capture: Path
    avatars: tuple[Path, ...]
    lift: tuple[str, ...] = ("thumb", "middle+ring")
    frames: int = 8
    samples: int = 144

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, frames=(1, 10**5), samples=(1, 65_536))

    @property
    def total_steps(self) -> int:
        """Truths, and pictures of all avatars with and without the edit."""
        return self.frames * len(self.lift) * (1 + len(self.avatars))


@dataclass(frozen=True, eq=False)
class LiftedFrame:
    """The truth of one frame.

    Attributes:
        frame: as it was captured.
        lifted: the colours without the shadow, sRGB in [0, 1].
        is_changed: pixels that show the same skin in both and whose colour the finger changes.
    """

    frame: Frame
    lifted: Float[Tensor, "height width 3"]
    is_changed: Bool[Tensor, "height width"]


def lift_table(options: LiftTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Renders truths and avatars, and compares them where the finger's shadow falls.

    Args:
        options: what to compare.
        progress: told the number of pieces of work done.

    Raises:
        CaptureError: if the capture is none that was made here.
        CheckpointError: if an avatar cannot be read.
        ValueError: for a name that is no finger or bone.

    Source: paper supplement (texture editing), Fig. 1b.
    """
    groups = {name: bones_named(tuple(name.split("+"))) for name in options.lift}
    capture = read_capture(options.capture)
    subject, made = _subject(capture)
    avatars = {path: HandAvatar.load(path) for path in options.avatars}
    names = [path.name for path in avatars]
    # Two runs may end in the same word; then their whole paths tell them apart.
    labels = {path: path.name if names.count(path.name) == 1 else str(path) for path in avatars}
    finished = step_counter(progress, options.total_steps)
    test = capture.split("test")
    frames = [capture.frame(test[place]) for place in spread_numbers(len(test), options.frames)]
    truths: dict[str, list[LiftedFrame]] = {}
    for name, bones in groups.items():
        truths[name] = []
        pictures = lifted_truths(subject, frames, made, bones, options.samples)
        for frame, (picture, is_same) in zip(frames, pictures, strict=True):
            before = frame.image.float() / 255
            is_changed = is_same & ((picture - before).abs().amax(-1) > CHANGED)
            truths[name].append(LiftedFrame(frame, picture, is_changed))
            finished()
    rows: dict[str, dict[str, Cell]] = {}
    for path, avatar in avatars.items():
        # As it is, once for all that is lifted.
        plain = [avatar.render(frame.pose, frame.camera).color.clamp(0, 1) for frame in frames]
        for name, bones in groups.items():
            rows[f"{name}: {labels[path]}"] = _judged(avatar, plain, truths[name], bones)
            for _ in frames:
                finished()
    rows = {
        f"{name}: {label}": rows[f"{name}: {label}"] for name in groups for label in labels.values()
    }
    notes = (
        f"{options.capture.name}, {len(frames)} test frames; PSNR over the pixels that the shadow "
        f"darkens or brightens by more than {CHANGED * 255:.0f}/255 in truth (frames with fewer "
        f"than {_FEWEST} are left out). Left as it is: the unedited picture against the same truth."
        " Best possible: the avatar's error where nothing is lifted, on the same pixels.",
    )
    return ResultTable("Lifted shadows", rows, notes)


def _judged(
    avatar: HandAvatar,
    plain: list[Float[Tensor, "height width 3"]],
    truths: list[LiftedFrame],
    bones: tuple[int, ...],
) -> dict[str, Cell]:
    lifted, left, unedited = [], [], []
    for truth, picture in zip(truths, plain, strict=True):
        frame, where = truth.frame, truth.is_changed
        if int(where.sum()) < _FEWEST:
            continue
        edit = Edit(lifted_bones=bones)
        edited = avatar.render(frame.pose, frame.camera, edit).color.clamp(0, 1)
        lifted.append(psnr(edited[where], truth.lifted[where]))
        left.append(psnr(picture[where], truth.lifted[where]))
        unedited.append(psnr(picture[where], frame.image.float()[where] / 255))
    gain: str | None = None
    if len(lifted) > 1:
        gain = mean_interval(torch.tensor(lifted) - torch.tensor(left)).of_difference()
    return {
        "frames": len(lifted),
        "lifted": _mean(lifted),
        "left as it is": _mean(left),
        "gain": gain,
        "best possible": _mean(unedited),
    }


def _mean(values: list[float]) -> float | None:
    return round(sum(values) / len(values), 2) if values else None


def _subject(capture: Capture) -> tuple[Subject, SynthOptions]:
    """The hand of a made capture, from its recorded options."""
    path = capture.folder / "truth" / "truth.json"
    if not path.is_file():
        raise CaptureError(
            f"{capture.folder}: has no truth/truth.json",
            "name a capture of `handavatar capture synth`",
        )
    stored = load_json(path)["options"]
    known = {field.name for field in fields(SynthOptions)}
    made = SynthOptions(**{name: value for name, value in stored.items() if name in known})
    return make_subject(subdivided(load_rig(made.rig), made.subdivisions), made), made
