"""``handavatar bench --table registration``: found hands against true ones.

Two kinds of cases. In ``noise5`` a made capture's true poses are turned by 5 degrees, independently
from frame to frame; in ``noise5t`` the same noise lasts for a while. In ``video`` made films go the
way that a person's own video goes: tracked, masked, fitted. Rows are the stages of that way:

* ``tracked``: poses as given; of a film, the fit to the tracker's landmarks alone.
* ``fitted``: of a film, the landmarks and then the outlines of the first masks, by the weights
  that ``capture video`` had before there was :mod:`handavatar.fit`.
* ``outlines``: from there on to ``train.outlines``, as the method ``quick`` began before it.
* ``registered``: by :mod:`handavatar.fit`: of a film, what ``capture video`` makes of it; of a
  capture with noise, what training begins with.

All rows of a case are judged on the same frames: those of the training split of a capture; of a
film those that ``capture video`` keeps. In the cases with noise both hands have the true shape
coefficients, so that poses alone count. A film is brought to the true depth first, see
:func:`~handavatar.bench.measures.brought_to_depth`.
"""

import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.bench.measures import (
    COLUMNS,
    ClipScores,
    Figures,
    Hands,
    are_right,
    brought_to_depth,
    in_crop,
    joint_angles_apart,
    landmark_pixels_apart,
    measure_displacements,
    measure_overlap,
    mesh_pixels,
)
from handavatar.capture.checks import CaptureError
from handavatar.capture.clips import observations_of
from handavatar.capture.default import default_capture
from handavatar.capture.degraded import DegradeOptions, degrade_capture
from handavatar.capture.fitted_hand import HandFit
from handavatar.capture.fitting import Observations, fit_hands
from handavatar.capture.frames import Capture, Frame, read_capture
from handavatar.capture.masks import find_mask, learn_colors
from handavatar.capture.outlines import OutlineMatcher, mask_outline
from handavatar.capture.registration import register_capture
from handavatar.capture.tracking import Track
from handavatar.capture.video import (
    TrackerChoice,
    VideoOptions,
    capture_video,
    track_video,
)
from handavatar.errors import SEEDS, require_ranges
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import Cell, ResultTable, step_counter
from handavatar.geometry.cameras import Camera
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.hand.rigs import find_rig
from handavatar.jobs.progress import SILENT, Progress
from handavatar.synthetic.films import FILMS, make_film
from handavatar.synthetic.truth import FilmTruth, read_film_truth
from handavatar.train.kept import (
    capture_fingerprint,
    origin,
    origin_notes,
    read_kept,
    write_kept,
)
from handavatar.train.loop import METHODS, TrainOptions, begin_training
from handavatar.train.outlines import corrected_pose, fit_outlines
from handavatar.train.provenance import folder_sha256

ROWS = ("tracked", "fitted", "outlines", "registered")
CORRELATION = 0.5
"""Seconds: of the noise in cases whose name ends in ``t``."""
_NOISE_CASE = re.compile(r"noise(\d+(?:\.\d+)?)(t?)")


@dataclass(frozen=True)
class RegistrationTableOptions:
    """What is registered and judged."""

    captures: tuple[Path, ...] = ()
    """made captures whose poses are spoilt; none stands for the one that ships"""
    films: Path = Path("films")
    """folder of made films with their truth; where it holds none, they are made (some minutes)"""
    cases: tuple[str, ...] = ("noise2", "noise5", "noise10", "noise5t", "video")
    """noiseN: poses off by N degrees, with t the noise lasts half a second; video: the films"""
    rows: tuple[str, ...] = ROWS
    """tracked, fitted, outlines, registered"""
    seeds: tuple[int, ...] = (0,)
    """of the noise, one capture each"""
    tracker: TrackerChoice = "auto"
    """who finds the hand of films, as in capture video"""
    keep: Path | None = None
    """folder of results by clip, row and tracker: what lies there is not measured again; results of
    another capture or film are refused"""
    any_commit: bool = False
    """kept results that another commit measured are shown too, and the table says which"""

    def __post_init__(self) -> None:
        """Refuses cases and rows that there are not."""
        require_ranges(self, seeds=SEEDS)
        for case in self.cases:
            if case != "video" and not _NOISE_CASE.fullmatch(case):
                raise CaptureError(
                    f"there is no case {case!r}", "ask for noise2, noise5t or video, for example"
                )
        for row in self.rows:
            if row not in ROWS:
                raise CaptureError(f"there is no row {row!r}", f"choose among {', '.join(ROWS)}")
        if not self.cases or not self.rows or not self.seeds:
            raise CaptureError(
                "there is nothing to measure", "name a case, a row and a seed at least"
            )

    @property
    def total_steps(self) -> int:
        """Clips times rows, as far as is known before the films are looked for."""
        noisy = len([case for case in self.cases if case != "video"])
        clips = noisy * max(len(self.captures), 1) * len(self.seeds)
        clips += len(_film_paths(self.films)) if "video" in self.cases else 0
        return clips * len(self.rows)


@dataclass(frozen=True)
class RegistrationTable(ResultTable):
    """The table, with figures by case, row and column for programs.

    Attributes:
        cases: figures, see :data:`~handavatar.bench.measures.COLUMNS`, and ``interval``.
    """

    cases: Mapping[str, Mapping[str, Figures]] = None  # type: ignore[assignment]

    def record(self) -> dict[str, object]:
        """Figures by case, row and column; what does not apply is None."""
        return {case: dict(rows) for case, rows in self.cases.items()}


def registration_table(
    options: RegistrationTableOptions, progress: Progress = SILENT
) -> RegistrationTable:
    """Spoils, tracks, fits, registers and judges.

    Args:
        options: what.
        progress: told the number of clips and rows done.

    Raises:
        CaptureError: a capture or film that cannot be used, or mediapipe is missing.
    """
    finished = step_counter(progress, options.total_steps)
    cases: dict[str, dict[str, Figures]] = {}
    results = _Results(options.keep, options.any_commit)
    for case in options.cases:
        is_film = case == "video"
        clips = _film_scores(options, results) if is_film else _noise_scores(case, options, results)
        of_clips: dict[str, dict[str, ClipScores]] = {}
        for clip, row, scores in clips:
            of_clips.setdefault(clip, {})[row] = scores
            finished()
        rows = {row: [s[row] for s in of_clips.values() if row in s] for row in options.rows}
        cases[case] = {row: summarised(scores) for row, scores in rows.items() if scores}
        if len(of_clips) > 1:
            for clip, of_rows in of_clips.items():
                cases[f"{case}/{clip}"] = {row: summarised([s]) for row, s in of_rows.items()}
    return RegistrationTable(
        title="Registration: found hands against true ones",
        rows={
            f"{case}, {row}": {name: _cell(figures[name]) for name in (*COLUMNS, "interval")}
            for case, rows in cases.items()
            for row, figures in rows.items()
        },
        notes=(*_NOTES, *origin_notes(results.kept)),
        cases=cases,
    )


_NOTES = (
    "Vertices: mean distance from the true skin, mm; lateral is what the camera sees, sight along "
    "its rays; constant is the part that stays per vertex in its bone's axes (a texture moves "
    "along), varying what is left. Worst twentieth: of all vertices of all frames. Angle: root mean"
    " square of 16 bones. Pixels are those of a crop of 256 around the hand. Size error and focal "
    "error: found over true, minus one. Mask: the mesh against the true mask within the picture; "
    "cut mask: the capture's own mask against it. Interval: 95 % of vertices_mm over clips and "
    "stretches of ten frames.",
    "Films are brought to the true depth first (one camera tells neither size nor focal length). "
    "Frames kept, rejected although right, kept although wrong: shares of the film's pictures; "
    "right is a mean lateral distance up to 8 mm after a similarity.",
)


def summarised(clips: list[ClipScores]) -> Figures:
    """Means over clips, and the interval of ``vertices_mm`` over their stretches of time."""
    result: Figures = {}
    for column in COLUMNS:
        values = [clip.figures[column] for clip in clips]
        known = [value for value in values if value is not None]
        result[column] = round(sum(known) / len(known), 4) if known else None
    blocks = torch.tensor([block for clip in clips for block in clip.blocks()])
    result["interval"] = None
    if len(blocks) >= 2:
        interval = mean_interval(blocks)
        result["interval"] = [round(interval.low, 3), round(interval.high, 3)]
    return result


def _cell(value: float | list[float] | None) -> Cell:
    if isinstance(value, list):
        return f"{value[0]:.2f} to {value[1]:.2f}"
    return value if value is None else float(f"{value:.3g}")


# --------------------------------------------------------------------------------- results kept


class _Results:
    """Results of clips: those that are kept in a folder, or that are measured and left there.

    Attributes:
        kept: what was found in the folder, by name.
    """

    def __init__(self, folder: Path | None, any_commit: bool) -> None:
        self.kept: dict[str, dict[str, Any]] = {}
        self._folder = folder
        self._any_commit = any_commit

    def of(
        self, name: str, sha256: str, measure: Callable[[], ClipScores | None]
    ) -> ClipScores | None:
        """The result of a name, of a capture or film with that fingerprint."""
        if self._folder is None:
            return measure()
        path = self._folder / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}.json"
        content = read_kept(path, sha256, self._any_commit)
        if content:
            self.kept[name] = content
            return ClipScores(content["figures"], tuple(content["of_frames"]))
        scores = measure()
        if scores is not None:
            content = {"figures": dict(scores.figures), "of_frames": list(scores.of_frames)}
            write_kept(path, content | origin(sha256, content))
        return scores


# ------------------------------------------------------------------------------- poses with noise


def _noise_scores(
    case: str, options: RegistrationTableOptions, results: _Results
) -> Iterator[tuple[str, str, ClipScores]]:
    named = _NOISE_CASE.fullmatch(case)
    assert named is not None
    sources = [read_capture(path) for path in options.captures] or [default_capture()]
    for source in sources:
        sha256 = capture_fingerprint(source.folder)
        for seed in options.seeds:
            clip = f"{source.folder.resolve().name}-{seed}"
            with tempfile.TemporaryDirectory(prefix="handavatar-bench-") as folder:
                how = DegradeOptions(
                    source.folder,
                    pose_noise=float(named[1]),
                    pose_noise_correlation=CORRELATION if named[2] else 0.0,
                    seed=seed,
                )
                spoilt = degrade_capture(Path(folder) / "spoilt", how)
                for row in options.rows:
                    scores = results.of(
                        f"{case}-{clip}-{row}",
                        sha256,
                        partial(_noisy_row, row, source, spoilt),
                    )
                    if scores is not None:
                        yield clip, row, scores


def _noisy_row(row: str, source: Capture, spoilt: Capture) -> ClipScores | None:
    """One row of a capture with noise; None where the row does not apply."""
    indices = list(spoilt.split("train")) or list(range(len(spoilt.records)))
    frames = [spoilt.frame(index) for index in indices]
    if row == "tracked":
        poses = [frame.pose for frame in frames]
    elif row == "outlines":
        poses = outlined_poses(spoilt, frames)
    elif row == "registered":
        registered = register_capture(spoilt)
        poses = [registered[index] for index in indices]
    else:
        return None
    return judge_poses(source, indices, poses)


def judge_poses(source: Capture, indices: list[int], poses: list[HandPose]) -> ClipScores:
    """Poses of some frames of a capture whose own poses are true, its shape in both."""
    rig = find_rig(source.rig_sha256, source.rig_name)
    rest = rig.shaped(source.shape_coefficients)
    frames = [source.frame(index) for index in indices]
    views = torch.stack([frame.camera.camera_from_world for frame in frames])
    truth = hands_in_view(rest, [frame.pose for frame in frames], views)
    found = hands_in_view(rest, poses, views)
    overlaps, pixels = [], []
    for number, frame in enumerate(frames):
        camera = replace(frame.camera, camera_from_world=torch.eye(4))
        mesh = mesh_pixels(rig.sealed(found.vertices[number]), rig.sealed_faces, camera)
        mask = frame.mask.numpy()
        overlaps.append(measure_overlap(mesh, mask, np.ones_like(mask)))
        pixels.append(
            landmark_pixels_apart(found.landmarks[number], camera, truth.landmarks[number], camera)
        )
    figures, of_frames = _hand_figures(found, truth, rig)
    figures["landmarks_px"] = _mean(pixels)
    figures["mask_iou"] = _mean([overlap.iou for overlap in overlaps])
    figures["border_px"] = _mean([overlap.border for overlap in overlaps])
    return ClipScores(figures, of_frames)


# ------------------------------------------------------------------------------------------ films


def _film_paths(folder: Path) -> list[Path]:
    """The films of a folder, or those that will be made there."""
    made = sorted(path for path in folder.glob("*.mp4") if path.with_suffix(".json").is_file())
    return made or [folder / f"{film.name}.mp4" for film in FILMS]


def _film_scores(
    options: RegistrationTableOptions, results: _Results
) -> Iterator[tuple[str, str, ClipScores]]:
    paths = _film_paths(options.films)
    for path in paths:
        film = next((film for film in FILMS if film.name == path.stem), None)
        if not path.is_file() and film is not None:
            make_film(film, options.films)
    for path in paths:
        sha256 = folder_sha256(path.parent, (path.name, path.with_suffix(".json").name))
        with tempfile.TemporaryDirectory(prefix="handavatar-bench-") as folder:
            road = FilmRoad(path, Path(folder), options.tracker)
            for row in options.rows:
                scores = results.of(
                    f"video-{path.stem}-{row}"
                    + ("" if options.tracker == "auto" else f"-{options.tracker}"),
                    sha256,
                    partial(road.scores, row),
                )
                if scores is not None:
                    yield path.stem, row, scores


@dataclass(frozen=True, eq=False)
class FoundClip:
    """What was found in a film.

    Attributes:
        hand: in the zero pose.
        pictures: numbers of the pictures in the film.
        poses: one for each of them, camera axes.
        focal: pixels of the film.
        crops: of the same pictures; their cameras have the focal length times a zoom.
        is_kept: whether the capture keeps the picture.
        masks: the capture's own, in the crops, where there are any.
    """

    hand: ShapedHand
    pictures: list[int]
    poses: list[HandPose]
    focal: float
    crops: list[Camera]
    is_kept: list[bool]
    masks: list[Bool[np.ndarray, "side side"]] | None = None


class FilmRoad:
    """A made film on its way to a capture; what is slow is done once, when it is first needed."""

    def __init__(self, path: Path, folder: Path, tracker: TrackerChoice = "auto") -> None:
        """Reads the truth.

        Args:
            path: of the film.
            folder: where captures may be written.
            tracker: who finds the hand.

        Raises:
            CaptureError: if the truth is missing or damaged.
        """
        self.path, self.folder = path, folder
        self.truth = read_film_truth(path)
        # Which hand it is is not in question here.
        self.options = VideoOptions(
            path, folder / "fitted", side="right", tracker=tracker, min_confidence=0.0
        )
        self._track: Track | None = None
        self._capture: Capture | None = None

    def track(self) -> Track:
        """What the tracker saw."""
        if self._track is None:
            self._track = track_video(self.options)
        return self._track

    def capture(self) -> Capture:
        """What ``capture video`` makes of the film, its unsure pictures kept."""
        if self._capture is None:
            self._capture = capture_video(self.options, self.truth.rig, track=self.track())
        return self._capture

    def scores(self, row: str) -> ClipScores | None:
        """One row; None where it does not apply."""
        registered = self.found(self.capture())
        if row == "registered":
            return judge_film(self.truth, registered, self._tried())
        rig, seen = self.truth.rig, observations_of(self.track())
        matcher = None if row == "tracked" else self._matcher(seen)
        found = self._of_fit(registered, fit_hands(rig, seen, self.options.fit, matcher))
        if row == "outlines":
            found = self._outlined(found)
        return judge_film(self.truth, found, self._tried())

    def _matcher(self, seen: Observations) -> OutlineMatcher:
        """Outlines of the first masks, as the fit before this one was drawn to them."""
        hands = self.track().hands
        colors = learn_colors(hands)
        outlines = [
            mask_outline(find_mask(hand, colors).pixels, hand.window, float(scale))
            for hand, scale in zip(hands, seen.scale, strict=True)
        ]
        return OutlineMatcher(self.truth.rig, outlines, seen.principal_point)

    def _tried(self) -> int:
        """Pictures that were looked at."""
        return len(self.track().hands) + len(self.track().skipped)

    def found(self, capture: Capture) -> FoundClip:
        """A capture of the film, as the table judges it."""
        fit = json.loads((capture.folder / "fit.json").read_text("utf-8"))
        frames = [capture.frame(index) for index in range(len(capture.records))]
        least = VideoOptions.min_confidence
        return FoundClip(
            hand=self.truth.rig.shaped(capture.shape_coefficients),
            pictures=[int(frame.name) for frame in frames],
            poses=[frame.pose for frame in frames],
            focal=float(fit["focal_pixels"]),
            crops=[frame.camera for frame in frames],
            is_kept=[frame.confidence >= least for frame in frames],
            masks=[frame.mask.numpy() for frame in frames],
        )

    def _of_fit(self, fitted: FoundClip, fit: HandFit) -> FoundClip:
        """The poses of another fit, in the crops of the capture."""
        number = {hand.index: place for place, hand in enumerate(self.track().hands)}
        zoom = fit.focal / fitted.focal
        return replace(
            fitted,
            hand=self.truth.rig.shaped(fit.shape_coefficients),
            poses=[fit.pose(number[picture]) for picture in fitted.pictures],
            focal=fit.focal,
            crops=[_zoomed(camera, zoom) for camera in fitted.crops],
        )

    def _outlined(self, fitted: FoundClip) -> FoundClip:
        """After what training begins with, on the pictures that are kept."""
        capture = self.capture()
        kept = [index for index, is_kept in enumerate(fitted.is_kept) if is_kept]
        if not kept:
            return fitted
        poses = list(fitted.poses)
        frames = [replace(capture.frame(index), pose=poses[index]) for index in kept]
        for index, pose in zip(kept, outlined_poses(capture, frames), strict=True):
            poses[index] = pose
        return replace(fitted, poses=poses)


def judge_film(truth: FilmTruth, clip: FoundClip, tried: int) -> ClipScores:
    """A found clip against the film's truth, once it is brought to the true depth.

    Errors are those of the frames that are kept; the shares are of all that were tried.

    Args:
        truth: of the film.
        clip: what was found.
        tried: pictures that were looked at.
    """
    rig = truth.rig
    all_truths = true_hands(truth, clip.pictures)
    views = torch.eye(4).expand(len(clip.poses), 4, 4)
    raw = hands_in_view(clip.hand, clip.poses, views)
    found = brought_to_depth(raw, all_truths, clip.focal, truth.camera.focal[0])
    is_right = are_right(found.vertices, all_truths.vertices)
    is_kept = torch.tensor(clip.is_kept)
    figures: dict[str, float | None] = dict.fromkeys(COLUMNS)
    of_frames: tuple[float, ...] = ()
    kept = is_kept.nonzero()[:, 0].tolist()
    if kept:
        figures, of_frames = _hand_figures(found.chosen(kept), all_truths.chosen(kept), rig)
        overlaps, cuts, pixels = [], [], []
        for number in kept:
            camera = clip.crops[number]
            true_camera = _zoomed(camera, truth.camera.focal[0] / clip.focal)
            mask, inside = in_crop(
                truth.mask(clip.pictures[number]).numpy(), truth.camera, true_camera
            )
            mesh = mesh_pixels(rig.sealed(raw.vertices[number]), rig.sealed_faces, camera)
            overlaps.append(measure_overlap(mesh, mask > 0.5, inside))
            if clip.masks is not None:
                cuts.append(measure_overlap(clip.masks[number], mask > 0.5, inside).iou)
            pixels.append(
                landmark_pixels_apart(
                    raw.landmarks[number], camera, all_truths.landmarks[number], true_camera
                )
            )
        figures["landmarks_px"] = _mean(pixels)
        figures["mask_iou"] = _mean([overlap.iou for overlap in overlaps])
        figures["border_px"] = _mean([overlap.border for overlap in overlaps])
        figures["cut_mask_iou"] = _mean(cuts)
    figures["size_error"] = raw.spread / all_truths.spread - 1
    figures["focal_error"] = clip.focal / truth.camera.focal[0] - 1
    figures["frames_kept"] = float(is_kept.sum()) / tried
    figures["rejected_right"] = float((is_right & ~is_kept).sum()) / tried
    figures["kept_wrong"] = float((~is_right & is_kept).sum()) / tried
    return ClipScores(figures, of_frames)


def true_hands(truth: FilmTruth, pictures: list[int]) -> Hands:
    """The hands of some pictures of a film."""
    views = torch.eye(4).expand(len(pictures), 4, 4)
    return hands_in_view(truth.rest_hand, [truth.pose(picture) for picture in pictures], views)


# ------------------------------------------------------------------------------------------ parts


def hands_in_view(
    rest: ShapedHand, poses: list[HandPose], views: Float[Tensor, "frames 4 4"]
) -> Hands:
    """Posed hands in camera axes.

    Args:
        rest: the hand in the zero pose.
        poses: of each frame, world.
        views: ``camera_from_world`` of each frame.
    """
    rotations = torch.stack([pose.rotations for pose in poses])
    translations = torch.stack([pose.translation for pose in poses])
    posed = rest.posed(HandPose(rotations, translations))
    tips = rest.rig.vertex_sets["fingertips"]
    landmarks = torch.cat([posed.joints, posed.vertices[:, tips]], dim=1)
    flat = torch.cat([rest.rest_joints, rest.rest_vertices[tips]])
    turn, shift = views[:, :3, :3], views[:, None, :3, 3]
    return Hands(
        vertices=posed.vertices @ turn.mT + shift,
        landmarks=landmarks @ turn.mT + shift,
        rotations=rotations,
        bones=turn[:, None] @ posed.world_from_bone[..., :3, :3],
        spread=float((flat - flat.mean(0)).norm(dim=-1).mean()),
    )


def outlined_poses(capture: Capture, frames: list[Frame]) -> list[HandPose]:
    """Poses after ``train.outlines``, with the rounds of the method ``quick``, on a new avatar."""
    method = METHODS["quick"]
    with tempfile.TemporaryDirectory(prefix="handavatar-bench-") as folder:
        options = TrainOptions(capture.folder, out=Path(folder), method="quick", device="cpu")
        training = begin_training(capture, frames, method, options)
    fit_outlines(
        training.avatar,
        training.corrections,
        frames,
        method.outline_rounds,
        method.outline_visits,
        method.silhouette_size,
        seed=0,
    )
    device = training.avatar.device
    with torch.no_grad():
        return [
            corrected_pose(training.corrections, frame, number, device)
            for number, frame in enumerate(frames)
        ]


def _hand_figures(
    found: Hands, truth: Hands, rig: Rig
) -> tuple[dict[str, float | None], tuple[float, ...]]:
    """The figures that need the two hands alone, and the mean distance in every frame."""
    apart = measure_displacements(
        found.vertices, truth.vertices, truth.bones, rig.skin_weights.argmax(-1)
    )
    figures: dict[str, float | None] = dict.fromkeys(COLUMNS)
    figures |= {
        "vertices_mm": apart.mean,
        "worst_twentieth_mm": apart.worst,
        "lateral_mm": apart.lateral,
        "sight_mm": apart.sight,
        "constant_mm": apart.constant,
        "varying_mm": apart.varying,
        "angle_deg": float(joint_angles_apart(found.rotations, truth.rotations).mean()),
        "landmarks_mm": 1000 * float((found.landmarks - truth.landmarks).norm(dim=-1).mean()),
    }
    return figures, apart.of_frames


def _zoomed(camera: Camera, factor: float) -> Camera:
    """The camera of the same crop of a picture whose focal length is another."""
    return replace(camera, focal=(camera.focal[0] * factor, camera.focal[1] * factor))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
