"""The check of captures: everything wrong with one, before anybody works on it for minutes.

Files and ranges first, then what only shows in pixels: the posed mesh is projected into every frame
and laid on its mask, and the mask's border on the picture's edges. Where they disagree, what could
have happened to a mask, picture, pose or camera is tried, and whatever makes them agree is named.

The limits stand between what was measured on good captures (the shipped one; its copies whose
poses are off by 2, 5 and 10 degrees; fitted clips of real hands) and on bad ones.
"""

import math
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.capture.agreement import (
    TURNED_BACK,
    TURNS,
    SkinColors,
    SmallFrame,
    edge_scores,
    overlap,
    shifted,
    shifted_border,
    shifted_overlap,
    small_camera,
    small_frame,
    small_side,
    turned,
)
from handavatar.capture.frames import (
    Capture,
    CaptureError,
    Frame,
    FrameRecord,
    Problem,
    examine_files,
)
from handavatar.geometry.cameras import project
from handavatar.hand.rig import RigError, ShapedHand
from handavatar.hand.rigs import find_rig
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.threads import one_thread
from handavatar.render.rasterize import covered_pixels

_MOST_PIXELS = 2**24
"""Of all small pictures together: where there are more frames, every so-manieth is compared."""

_EXACT = (0.6, 0.8)
_TRACKED = (0.15, 0.6)
"""Least and largest overlap (intersection over union) of mask and mesh that is asked of a frame
whose pose is known or estimated. Exact ones have 0.94 and more; off by 10 degrees, 0.25."""
_SPREAD = 5.0
"""What a frame may lack in overlap, in units of what the capture's median lacks."""
_HALF_WRONG = 0.5
"""If the median overlap is smaller, every frame below this is wrong, estimated or not."""
_GAIN = 0.15
"""Overlap by which an explanation must be better than what is found. Chance reaches 0.12."""
_CONVINCING = 0.85
"""Of the median overlap of the frames that agree: what an explanation must reach."""
_TELLING = 1.3
"""Edges along another border must be so many times as strong. Chance reaches 0.8."""
_FAINT = 0.6
"""Of what pictures usually have along the mask that fits them best: a border with fewer edges may
not be the picture's own. Good frames have 0.7."""
_WHOLE = 0.97
"""Share of a picture that a white mask covers."""
_NOTHING = 0.35
"""Of the median: edges along a border that mean nothing."""
_CHANCE = 1.15
"""Median of the edges along the borders, against those of the whole pictures: no capture that has
a hand in its pictures is below it. Masks of other frames reach 2."""
_SHIFT = {True: 0.06, False: 0.15}
"""In hands (the square root of the mesh's area): how far all masks may lie to one side where poses
are exact, or not. Found: 0.02 and 0.03."""
_GROWTH = {True: 0.25, False: 0.4}
"""Logarithm of the masks' area, against the meshes'. Found: 0.05 and 0.16."""
_SAME_MASK = 0.9
"""Overlap of two masks of the same hand in the same picture."""
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_MOST_SHAPE = 10.0
_MOVED = 2.0
"""Small pixels: a picture that lies less far beside its mask is not called shifted."""


def find_problems(folder: Path, progress: Progress = SILENT) -> list[Problem]:
    """Everything wrong with a capture folder, pixels included; empty if it is sound.

    Whether there is a hand, and whether it agrees with the pictures, is looked at only where all
    else is sound.

    Args:
        folder: of the capture.
        progress: told how many of how many frames have been read.
    """
    capture, problems = examine_files(Path(folder))
    if capture is None or not capture.records:
        return problems
    try:
        hand = shaped_hand(capture)
    except (CaptureError, RigError) as error:
        problems += _problems_of_frames(capture, None, progress)
        what, _, remedy = str(error).partition("\n")
        return problems or [Problem("transforms.json", "", what, remedy)]
    return [*problems, *_problems_of_frames(capture, None if problems else hand, progress)]


def require_sound(capture: Capture, progress: Progress = SILENT) -> None:
    """Refuses a capture that nothing good can be learned from.

    Args:
        capture: as read.
        progress: told how many frames have been read.

    Raises:
        CaptureError: the first problem with its frame, its cause and a remedy, and how many more.
        RigError: the rig of its poses is not here.
    """
    try:
        hand = shaped_hand(capture)
    except CaptureError as error:
        what = f"{capture.folder / 'transforms.json'}: {error.what}"
        raise CaptureError(what, error.remedy) from error
    problems = _problems_of_frames(capture, hand, progress)
    if problems:
        rest = len(problems) - 1
        more = f"\nand {rest} more: handavatar capture check {capture.folder}" if rest else ""
        raise CaptureError(f"{capture.folder}\n{problems[0]}{more}")


def shaped_hand(capture: Capture) -> ShapedHand:
    """The rest hand of a capture.

    Args:
        capture: as read.

    Raises:
        CaptureError: its shape coefficients do not fit its rig, or make no hand.
        RigError: its rig is not here.
    """
    rig = find_rig(capture.rig_sha256, capture.rig_name)
    found, expected = len(capture.shape_coefficients), rig.shape_directions.shape[-1]
    # Captures that do not know the shape may say nothing of it.
    if found not in (0, expected):
        raise CaptureError(
            f"shape_coefficients has {found} numbers, the rig {rig.name} has {expected}",
            "write those of this rig, or leave them out",
        )
    largest = float(capture.shape_coefficients.abs().amax()) if found else 0.0
    if not largest <= _MOST_SHAPE:
        raise CaptureError(
            f"a shape coefficient is {largest:.3g} standard deviations, at most {_MOST_SHAPE:g} "
            "make sense",
            "write those of this rig, or leave them out",
        )
    return rig.shaped(capture.shape_coefficients if found else None)


# --- one frame after the other ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is kept of a frame that was decoded.

    Attributes:
        record: of the frame.
        small: picture, mask and mesh in few pixels.
        fingerprint: of the picture's pixels.
        overlap: of mask and mesh.
    """

    record: FrameRecord
    small: SmallFrame
    fingerprint: str
    overlap: float

    @cached_property
    def centre_offset(self) -> tuple[float, float]:
        """From the mesh's centre to the mask's: right and down, small pixels."""
        centres = []
        for covered in (self.small.mask, self.small.mesh):
            places = covered.nonzero().float().mean(0)
            centres.append((float(places[1]), float(places[0])))
        return centres[0][0] - centres[1][0], centres[0][1] - centres[1][1]

    @cached_property
    def growth(self) -> float:
        """Logarithm of the mask's area, against the mesh's."""
        areas = [float(covered.sum()) for covered in (self.small.mask, self.small.mesh)]
        return math.log(areas[0] / areas[1])

    @property
    def extent(self) -> float:
        """Square root of the mesh's area, small pixels."""
        return float(self.small.mesh.sum()) ** 0.5


def _problems_of_frames(
    capture: Capture,
    hand: ShapedHand | None,
    progress: Progress,
) -> list[Problem]:
    """What is wrong with splits, pixels and, if there is a hand, its agreement with the frames."""
    problems = _problems_of_splits(capture)
    count = len(capture.records)
    side = small_side(hand, capture.records) if hand else 1
    stride = -(-count * side**2 // _MOST_PIXELS)
    seen: list[_Seen] = []
    with one_thread():
        for index, record in enumerate(capture.records):
            try:
                frame = capture.frame(index)
                frame.require_finite()
                problem = _problem_of_pixels(frame, record)
            except CaptureError as error:
                problem = Problem(record.file_path, record.name, error.what, error.remedy)
                hand = None
            if problem is not None:
                problems.append(problem)
            elif hand and index % stride == 0:
                small = small_frame(frame, hand, side)
                fingerprint = sha256(frame.image.numpy().tobytes()).hexdigest()
                seen.append(
                    _Seen(record, small, fingerprint, float(overlap(small.mask, small.mesh)))
                )
            progress(index + 1, count)
        if hand and seen:
            problems += _Comparison(hand, seen).problems()
    order = {record.name: index for index, record in enumerate(capture.records)}
    return sorted(problems, key=lambda problem: order.get(problem.frame, count))


def _problems_of_splits(capture: Capture) -> list[Problem]:
    problems = []
    for split, purpose in (("train", "learned from"), ("test", "judged by")):
        if not capture.split(split):
            what = f"no frame of split '{split}', that an avatar is {purpose}"
            problems.append(
                Problem("transforms.json", "", what, f"mark some frames as split: {split}")
            )
    learned = {record.clip for record in capture.records if record.split == "train"}
    for clip in sorted(set(range(capture.num_clips)) - learned):
        what = f"clip {clip} has no frame of split 'train', from which its light could be learned"
        remedy = "mark some of its frames as split: train, and number the clips from 0 without gaps"
        problems.append(Problem("transforms.json", "", what, remedy))
    return problems


def _problem_of_pixels(frame: Frame, record: FrameRecord) -> Problem | None:
    """What is wrong with one frame's pixels, whatever the hand does."""
    pixels = frame.image.flatten(0, 1)
    if bool((pixels.amax(0) - pixels.amin(0) <= 1).all()):
        what = f"the picture is blank: all its pixels are about {pixels[0].tolist()}"
        return Problem(record.file_path, record.name, what, "restore it, or drop the frame")
    if not bool(frame.known.any()):
        what = "nothing of the picture is known: the file known_path is black"
        return Problem(record.known_path, record.name, what, "white is known; or drop the frame")
    largest = int(frame.coverage.max())
    if bool(frame.mask.any()):
        return None
    if largest == 0 or largest > 127:
        hidden = largest > 127
        what = "the mask is empty" + (": all of it is where nothing is known" if hidden else "")
        remedy = "drop the frame"
    else:
        what = f"the mask's largest value is {largest}, expected 255 where the hand is"
        remedy = f"multiply the mask by {255 // largest}"
    return Problem(record.mask_path, record.name, what, remedy)


# --- all frames together ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cause:
    """Why a frame's parts disagree.

    Attributes:
        is_mask: the mask's file is named, else the picture's.
        what: was found.
        remedy: what to do.
    """

    is_mask: bool
    what: str
    remedy: str


@dataclass(frozen=True)
class _Explanation:
    """What could have happened to a frame.

    Attributes:
        reached: overlap of mask and mesh, were it undone.
        of_mask: the cause, if the picture's edges follow the mesh.
        of_both: the cause, if they follow the mask.
    """

    reached: float
    of_mask: _Cause
    of_both: _Cause


_POSE_REMEDY = (
    "check pose and camera: the order of the joints (wrist, index, middle, little, ring, thumb), "
    "axis-angle in radians, metres, camera-to-world in OpenGL axes; a left hand is stored mirrored"
)


class _Comparison:
    """Frames beside each other."""

    def __init__(self, hand: ShapedHand, seen: Sequence[_Seen]) -> None:
        self._hand = hand
        self._seen = seen
        self._masks = torch.stack([each.small.mask for each in seen])
        self._meshes = torch.stack([each.small.mesh for each in seen])
        self._edges = torch.stack([each.small.edges for each in seen])
        self._scores = edge_scores(self._edges, self._masks)
        self._skin = SkinColors([each.small for each in seen])
        self._own = self._scores.diag()
        overlaps = torch.tensor([each.overlap for each in seen])
        # Masks that lie on the hand tell how clearly pictures show their borders.
        good = overlaps >= _HALF_WRONG
        agreeing = good if bool(good.any()) else torch.ones_like(good)
        self._usual_own = float(self._own[agreeing].median())
        self._usual_best = float(self._scores.amax(1).median())
        self._usual = float(overlaps.median())
        self._usual_good = float(overlaps[good].median()) if bool(good.any()) else 0.0
        self._shifts = [shifted_border(each.small.edges, each.small.mask) for each in seen]
        self._usual_shift = [
            statistics.median(shift[axis] for _, shift in self._shifts) for axis in range(2)
        ]

    def problems(self) -> list[Problem]:
        found: dict[int, _Cause] = self._repeated()
        for number in range(len(self._seen)):
            if number not in found:
                cause = self._cause(number)
                if cause is not None:
                    found[number] = cause
        problems = [self._problem(number, cause) for number, cause in found.items()]
        if not problems:
            problems += self._systematic()
        return problems

    def _problem(self, number: int, cause: _Cause) -> Problem:
        record = self._seen[number].record
        file = record.mask_path if cause.is_mask else record.file_path
        return Problem(file, record.name, cause.what, cause.remedy)

    def _name(self, number: int) -> str:
        return self._seen[number].record.name

    # --- the same picture

    def _repeated(self) -> dict[int, _Cause]:
        """Frames whose picture is pixel by pixel that of an earlier one, though the hand moved."""
        groups: dict[str, list[int]] = defaultdict(list)
        for number, each in enumerate(self._seen):
            groups[each.fingerprint].append(number)
        found = {}
        for numbers in groups.values():
            first = max(numbers, key=lambda number: float(self._own[number]))
            moved = [
                number
                for number in numbers
                if number != first
                and min(
                    float(overlap(values[number], values[first]))
                    for values in (self._masks, self._meshes)
                )
                < _SAME_MASK
            ]
            for number in moved:
                is_all = len(moved) == len(self._seen) - 1
                what = (
                    "all frames have the same picture"
                    if is_all
                    else f"its picture is the same, pixel by pixel, as that of {self._name(first)}"
                )
                what += ", but mask or pose differ"
                found[number] = _Cause(False, what, "give every frame its own picture")
        return found

    # --- one frame

    def _limit(self, record: FrameRecord) -> float:
        """Overlap that a frame must have."""
        least, most = _EXACT if record.confidence >= 1 else _TRACKED
        limit = min(max(1 - _SPREAD * (1 - self._usual), least), most)
        return max(limit, _HALF_WRONG) if self._usual < _HALF_WRONG else limit

    def _cause(self, number: int) -> _Cause | None:
        """What is wrong with a frame, if anything is."""
        seen = self._seen[number]
        cause = self._white(number) or self._inverted(number)
        if cause is not None:
            return cause
        least = max(seen.overlap + _GAIN, _HALF_WRONG, _CONVINCING * self._usual_good)
        if seen.overlap >= self._limit(seen.record):
            cause = self._wrong_picture(number)
            if cause is None or not self._follows_mesh(number):
                return cause
            least = seen.overlap
        else:
            cause = self._outside(number)
            if cause is not None:
                return cause
        explanations = (
            self._turned(number),
            self._exchanged(number),
            self._shifted(number),
            self._scaled(number),
        )
        best = max(explanations, key=lambda each: each.reached)
        is_mask_wrong = self._follows_mesh(number)
        if best.reached > least:
            return best.of_mask if is_mask_wrong else best.of_both
        what = (
            f"the projected hand and the mask share {seen.overlap:.0%} of their area "
            f"(the median of the capture is {self._usual:.0%})"
        )
        if is_mask_wrong:
            return _Cause(
                True,
                f"{what}; the picture's edges follow the hand and not the mask",
                "make the mask again: white where the hand is, cut at the wrist",
            )
        return _Cause(False, what, _POSE_REMEDY)

    def _follows_mesh(self, number: int) -> bool:
        """Whether the picture's edges lie along the mesh's border rather than the mask's."""
        score = edge_scores(self._edges[number][None], self._meshes[number][None])
        return float(score) > _TELLING * float(self._own[number])

    def _white(self, number: int) -> _Cause | None:
        small = self._seen[number].small
        share, hand = (
            float(covered.sum()) / float(small.known.sum()) for covered in (small.mask, small.mesh)
        )
        if share < _WHOLE or hand > _WHOLE - _GAIN:
            return None
        return _Cause(
            True,
            f"the mask is white: {share:.0%} of the picture, of which the hand covers {hand:.0%}",
            "make the mask again: white where the hand is, black elsewhere",
        )

    def _inverted(self, number: int) -> _Cause | None:
        small = self._seen[number].small
        inverted = float(overlap(~small.mask & small.known, small.mesh))
        if inverted < max(self._seen[number].overlap + _GAIN, _HALF_WRONG):
            return None
        return _Cause(
            True,
            "the mask is inverted: it is white where the hand is not",
            "invert it: white (255) is hand, black (0) is background",
        )

    def _outside(self, number: int) -> _Cause | None:
        """The posed hand is hardly to be seen in the picture."""
        seen = self._seen[number]
        if seen.small.mesh.sum() > 0.1 * seen.small.mask.sum():
            return None
        record = seen.record
        for unit, factor in _UNITS.items():
            pose = replace(record.pose, translation=record.pose.translation * factor)
            if self._overlap_of(number, replace(record, pose=pose)) > seen.overlap + _GAIN:
                return _Cause(
                    False,
                    f"the translation is in {unit}: {_listed(record.pose.translation)}",
                    "write metres",
                )
        camera = record.camera
        pixels, depths = project(camera, self._hand.posed(record.pose).vertices)
        is_before = bool((depths > 0).all())
        middle = pixels.mean(0)
        extent = float((pixels.amax(0) - pixels.amin(0)).amax())
        size = torch.tensor([camera.width, camera.height])
        if is_before and bool(((middle >= 0) & (middle < size)).all()):
            rows, columns = seen.small.mask.nonzero().unbind(-1)
            mask = max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) + 1
            return _Cause(
                False,
                f"the projected hand is {extent:.0f} pixels long, the mask "
                f"{mask * seen.small.scale:.0f}",
                f"check fl_x and fl_y, found {camera.focal[0]:.4g} (pixels, not millimetres), and "
                "the hand's distance (metres)",
            )
        place = f"its middle falls on pixel {middle[0]:.0f}, {middle[1]:.0f}"
        return _Cause(
            False,
            f"the posed hand is not in the picture, which is {camera.width} x {camera.height}: "
            + (place if is_before else "part of it lies behind the camera"),
            "check cx and cy (pixels), fl_x and fl_y (pixels), transform_matrix (camera-to-world, "
            "OpenGL axes, metres) and the hand's translation (metres)",
        )

    def _turned_masks(self, number: int) -> Iterator[tuple[str, Bool[Tensor, "side side"]]]:
        """The mask in every turn that keeps the picture's shape, and the turn's name."""
        small = self._seen[number].small
        for turn, function in TURNS.items():
            mask = turned(small.mask, function, small.height, small.width)
            if mask is not None:
                yield turn, mask

    def _turned(self, number: int) -> _Explanation:
        """The turn of the mask that lies best on the mesh."""
        mesh = self._seen[number].small.mesh
        found = [(float(overlap(mask, mesh)), turn) for turn, mask in self._turned_masks(number)]
        best, turn = max(found, key=lambda each: each[0])
        name = TURNED_BACK.get(turn, turn)
        remedy = "turn picture and mask back, or write pose and camera of the turned ones"
        if name == "mirrored left to right":
            remedy = "mirror both; a left hand is stored mirrored to a right one, with side: left"
        return _Explanation(
            best,
            _Cause(True, f"the mask is {name}, unlike picture and pose", "turn the mask back"),
            _Cause(False, f"picture and mask are {name} against pose and camera", remedy),
        )

    def _exchanged(self, number: int) -> _Explanation:
        """The mask of another frame that lies best on the mesh."""
        found = overlap(self._masks, self._meshes[number].expand_as(self._masks))
        other = int(found.argmax())
        name = self._name(other)
        return _Explanation(
            float(found[other]),
            _Cause(
                True,
                f"the mask belongs to another frame; that of {name} fits this one's hand",
                "give every frame its own mask",
            ),
            _Cause(
                False,
                f"picture and mask belong to another pose; those of {name} fit this one's",
                "give every frame its own pose and camera",
            ),
        )

    def _shifted(self, number: int) -> _Explanation:
        """The shift of the mask that lies best on the mesh."""
        small = self._seen[number].small
        best, (right, down) = shifted_overlap(small.mesh, small.mask)
        place = _offset(right * small.scale, down * small.scale)
        return _Explanation(
            best,
            _Cause(
                True,
                f"the mask lies {place} of picture and pose",
                "make the mask in the picture's own pixels",
            ),
            _Cause(
                False,
                f"picture and mask lie {place} of where pose and camera put the hand",
                "check cx and cy, which are pixels of this very picture, and the hand's "
                "translation",
            ),
        )

    def _scaled(self, number: int) -> _Explanation:
        """The focal length with which the mesh is as large as the mask."""
        seen = self._seen[number]
        factor = math.exp(seen.growth / 2)
        camera = seen.record.camera
        focal = (camera.focal[0] * factor, camera.focal[1] * factor)
        record = replace(seen.record, camera=replace(camera, focal=focal))
        cause = _Cause(
            False,
            f"the projected hand is {1 / factor:.2f} times as large as the mask",
            f"check fl_x and fl_y, found {camera.focal[0]:.0f} pixels (they change when pictures "
            "are scaled), and the hand's distance in metres",
        )
        return _Explanation(self._overlap_of(number, record), cause, cause)

    def _overlap_of(self, number: int, record: FrameRecord) -> float:
        """Of the frame's mask with another pose or camera than its own."""
        small = self._seen[number].small
        side = small.mask.shape[-1]
        vertices = self._hand.posed(record.pose).vertices
        mesh = covered_pixels(vertices, self._hand.rig.faces, small_camera(record.camera, side))
        mask, known = (each[: small.height, : small.width] for each in (small.mask, small.known))
        return float(overlap(mask, mesh & known))

    def _wrong_picture(self, number: int) -> _Cause | None:
        """The picture's edges lie along another border than that of the mask."""
        own, small = float(self._own[number]), self._seen[number].small
        edges = self._edges[number][None]
        is_faint = own < _FAINT * self._usual_best
        found: list[tuple[float, Tensor, str, str]] = []
        for turn, mask in self._turned_masks(number):
            if float(overlap(mask, small.mask)) < _SAME_MASK:
                score = float(edge_scores(edges, mask[None]))
                found.append((score, mask, f"is {turn} against its mask", "turn its pixels back"))
        best, shift = self._shifts[number]
        is_common = math.dist(shift, self._usual_shift) < _MOVED
        if math.hypot(*shift) > _MOVED and (is_common or is_faint):
            place = _offset(shift[0] * small.scale, shift[1] * small.scale)
            what = f"shows the hand {place} of its mask"
            moved = shifted(small.mask, *shift)
            found.append((best, moved, what, "crop and pad picture and mask alike"))
        other = int(self._scores[number].argmax())
        if is_faint:
            what = f"belongs to another mask; that of {self._name(other)} fits it"
            remedy = "give every frame its own picture"
            found.append((float(self._scores[number, other]), self._masks[other], what, remedy))
        # Backgrounds have edges too; what lies within them has not the colours of this hand.
        telling = [each for each in found if each[0] > _TELLING * max(own, 1.0)]
        for _, mask, what, remedy in sorted(telling, key=lambda each: -each[0]):
            if self._skin.contrast(small, mask) > self._skin.contrast(small, small.mask):
                return _Cause(False, f"the picture {what}", remedy)
        if own < _NOTHING * self._usual_own or self._usual_own < _CHANCE:
            return _Cause(
                False,
                "the mask's border follows no edge of the picture",
                "check that picture and mask belong together",
            )
        return None

    # --- small errors of all frames

    def _systematic(self) -> list[Problem]:
        """What no single frame shows: all masks lie a little to one side, or are too large."""
        seen = [each for each in self._seen if each.small.mesh.any()]
        is_exact = all(each.record.confidence >= 1 for each in seen)
        shift = [
            _sure_median([each.centre_offset[axis] / each.extent for each in seen])
            for axis in range(2)
        ]
        growth = _sure_median([each.growth for each in seen])
        example = f"as in {seen[0].record.name}"
        if max(abs(value) for value in shift) > _SHIFT[is_exact]:
            size = statistics.median(each.extent * each.small.scale for each in seen)
            place = _offset(shift[0] * size, shift[1] * size)
            return [
                Problem(
                    "transforms.json",
                    seen[0].record.name,
                    f"in all frames, {example}, the masks lie {place} of where pose and camera put "
                    "the hand",
                    "check cx and cy, which are pixels of these very pictures, the hand's "
                    "translation, and that the masks are those of the pictures",
                )
            ]
        if abs(growth) > _GROWTH[is_exact]:
            times = math.exp(growth / 2)
            return [
                Problem(
                    "transforms.json",
                    seen[0].record.name,
                    f"in all frames, {example}, the masks are {times:.2f} times as large as the "
                    "projected hand",
                    "check fl_x and fl_y in pixels, the hand's distance and shape, and that masks "
                    "end at the skin and at the wrist",
                )
            ]
        if is_exact and self._usual < _EXACT[1]:
            worst = min(seen, key=lambda each: each.overlap)
            return [
                Problem(
                    "transforms.json",
                    worst.record.name,
                    f"projected hand and masks share {self._usual:.0%} of their area (the median; "
                    f"{worst.overlap:.0%} in this frame), although the poses are called exact",
                    _POSE_REMEDY + "; the confidence of estimated poses is below 1",
                )
            ]
        return []


def _sure_median(values: Sequence[float]) -> float:
    """The median, drawn to zero by three times its standard error."""
    median = statistics.median(values)
    spread = 1.4826 * statistics.median(abs(value - median) for value in values)
    error = 3 * 1.2533 * spread / len(values) ** 0.5
    return max(abs(median) - error, 0.0) * (1 if median > 0 else -1)


def _offset(right: float, down: float) -> str:
    parts = []
    if abs(right) >= 0.5:
        parts.append(f"{abs(right):.0f} pixels {'right' if right > 0 else 'left'}")
    if abs(down) >= 0.5:
        parts.append(f"{abs(down):.0f} pixels {'below' if down > 0 else 'above'}")
    return " and ".join(parts) or "0 pixels beside"


def _listed(values: Float[Tensor, "values"]) -> str:
    return ", ".join(f"{value:.3g}" for value in values.tolist())
