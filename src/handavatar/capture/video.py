"""A person's own video of one hand, made into a capture: track, mask, fit, crop, write."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import save

from handavatar.capture.checks import CaptureError
from handavatar.capture.clip_gains import match_clips
from handavatar.capture.clips import (
    Clip,
    LaidClip,
    clip_of,
    lay_hand,
    on_all_cores,
    one_after_the_other,
    see_skin,
)
from handavatar.capture.decoding import Sampling, VideoFrame
from handavatar.capture.fitted_frames import FittedFrame, box_in_front, crop_frame, stored_size
from handavatar.capture.fitting import FitOptions
from handavatar.capture.frames import MAX_CLIPS, Capture, CaptureWriter, read_capture
from handavatar.capture.given_masks import give_masks
from handavatar.capture.left_out import NO_CAMERA
from handavatar.capture.own_finder import OwnFinder
from handavatar.capture.picture_folders import frames_of, is_picture_source
from handavatar.capture.seen_skin import count_seen_skin
from handavatar.capture.tracking import (
    Finder,
    Track,
    UnusableTrackError,
    has_mediapipe,
    track_hand,
)
from handavatar.capture.video_cameras import KnownCamera, Pinhole, pinhole_of, read_camera
from handavatar.capture.video_report import (
    MIN_KEPT,
    TriedClip,
    agreement,
    failure,
    kept_frames,
    overview,
    save_json,
    skipped,
    summary,
    too_few,
    with_common_gain,
)
from handavatar.errors import ArgumentError, require_ranges
from handavatar.fit.energy import VIDEO_TEXTURE_SHARE, EnergyOptions
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.rotations import mirror_rigid
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import files_named
from handavatar.jobs.progress import SILENT, Progress

TrackerChoice = Literal["auto", "own", "mediapipe", "both"]
"""Who finds hands and their landmarks in a video."""


@dataclass(frozen=True)
class VideoOptions:
    """From a video file to a capture."""

    file: Path
    """The video (mp4, mov, mkv, webm, avi, ts, gif), or its pictures: a folder, or a pattern such
    as frames/%04d.png. One bare hand, whole, well lit."""
    out: Path
    """Folder of the capture."""
    more: tuple[Path, ...] = ()
    """Further videos of the same hand, as of its back: one shape, one albedo, a light each."""
    fps: float = 10.0
    """Pictures taken per second of video: the nearest frame to each of these times."""
    max_frames: int = 600
    """Stop after this many pictures."""
    start: float = 0.0
    """Seconds of the video from which pictures are taken."""
    end: float | None = None
    """Seconds until which they are; the end of the video by default."""
    side: Literal["auto", "left", "right"] = "auto"
    """Which hand it is; auto takes the video as not mirrored."""
    hand: Literal["only", "left", "right", "larger", "both"] = "only"
    """Which of two hands that are seen together is taken; only: there is one; both: two captures,
    OUT-left and OUT-right."""
    tracker: TrackerChoice = "auto"
    """Who finds the hand and tells where its landmarks are: our own tracker, mediapipe, or both,
    mediapipe finding the hand; auto: mediapipe where it is installed, else our own."""
    masks: tuple[Path, ...] = ()
    """Masks of the hand, white on black, for each of the videos: a folder or pattern of pictures,
    or a video. They are believed; without them they are found."""
    camera: tuple[Path, ...] = ()
    """The camera of each of the videos: nerfstudio's transforms.json, or the folder of a text model
    of COLMAP. Its lens is used, and where it was in each picture of a folder."""
    camera_unit: float | None = None
    """Metres that the unit of the cameras' positions is long; found from the hand, which then has
    to be held still, if left out."""
    size: int | None = None
    """Side of the stored pictures, pixels; by default 512 where hands are as large, else 256."""
    min_confidence: float = 0.5
    """Frames whose pose is less sure are left out, by name."""
    subject: str = "unnamed"
    """Whose hand it is."""
    licence: str = "private"
    """Terms under which the video may be used."""
    overwrite: bool = False
    """Replace a capture that is already in the folder."""
    rig: str = "open-hand"
    """The hand to lay onto the pictures: open-hand, an imported one (mano-right) or its file."""
    fit: FitOptions = field(default_factory=FitOptions)
    """How the hand is first fitted, to landmarks alone."""
    register: RegisterOptions = field(
        default_factory=lambda: RegisterOptions(
            coefficient_sigma=1.0,
            tilts=(25.0,),
            restarts=1,
            texture_rounds=2,
            energy=EnergyOptions(texture_share=VIDEO_TEXTURE_SHARE),
        )
    )
    """How the hand is laid onto masks and texture."""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, camera_unit=(1e-6, 1e6), size=(16, 4096), min_confidence=(0, 1))
        self.sampling()  # Refuses what selects nothing.

    def sampling(self) -> Sampling:
        """Which pictures of the video are taken.

        Raises:
            ValueError: none would be.
        """
        return Sampling(self.fps, self.max_frames, self.start, self.end)

    def of_each_clip(self) -> list["VideoOptions"]:
        """One for every video, of itself alone.

        Raises:
            ArgumentError: masks or cameras are given for some of the videos only.
        """
        files = (self.file, *self.more)
        for name, given in (("masks", self.masks), ("camera", self.camera)):
            if given and len(given) != len(files):
                raise ArgumentError(name, str(len(given)), f"one for each of {len(files)} videos")
        return [
            replace(
                self,
                file=file,
                more=(),
                masks=self.masks[number : number + 1],
                camera=self.camera[number : number + 1],
            )
            for number, file in enumerate(files)
        ]

    def of_each_hand(self) -> list["VideoOptions"]:
        """One for every capture that is asked for."""
        if self.hand != "both":
            return [self]
        sides: tuple[Literal["left", "right"], ...] = ("left", "right")
        return [
            replace(self, hand=side, out=self.out.with_name(f"{self.out.name}-{side}"))
            for side in sides
        ]


def capture_video(
    options: VideoOptions,
    rig: Rig | None = None,
    progress: Progress = SILENT,
    track: Track | None = None,
    open_finder: Callable[[], Finder] | None = None,
) -> Capture:
    """Makes a capture of a video of one hand, or of several of the same hand.

    Poses come from landmarks, masks and texture, in held-out frames as in all others. World axes
    are those of the camera, which is taken as standing still, unless its way is given.

    Args:
        options: which video, where to, how.
        rig: the hand to lay onto the pictures; the one that the options name if None.
        progress: told how far it is.
        track: what the tracker found in the one video already; it is tracked if None.
        open_finder: gives what finds the hand in a video, once for each; the tracker that the
            options name if None.

    Returns:
        The capture as written. Frames that were left out stand with their reason in its
        ``skipped.json``, the agreement of every frame and a summary in ``fit.json``.

    Raises:
        CaptureError: the video cannot be used, the folder is in use, or an extra is missing. If the
            pictures are the cause, a folder beside the would-be capture shows them.
    """
    stages = progress.stages(
        {"finding the hand": 30.0, "laying the hand": 350.0, "cropping": 20.0, "writing": 5.0}
    )
    videos = options.of_each_clip()
    if len(videos) > MAX_CLIPS:
        raise ArgumentError("more", f"{len(videos)} videos", f"at most {MAX_CLIPS} of one hand")
    cameras = [read_camera(video.camera[0]) if video.camera else None for video in videos]
    rig = rig or load_rig(options.rig)
    header = _header(options, rig)
    CaptureWriter(options.out, **header)  # type: ignore[arg-type]  # refuses a folder in use now
    clips: list[Clip] = []
    parts = stages["finding the hand"].equal_parts(len(videos))
    for number, (video, camera) in enumerate(zip(videos, cameras, strict=True)):
        try:
            clips.append(_tracked_clip(video, rig, camera, parts[number], track, open_finder))
        except UnusableTrackError as error:
            unusable = TriedClip(video.file.name, error.track, number=number)
            raise failure(options.out, error.what, error.remedy, [unusable]) from error
    clips = one_after_the_other(clips)
    tried = [
        TriedClip(video.file.name, clip.track, number=number)
        for number, (video, clip) in enumerate(zip(videos, clips, strict=True))
    ]
    try:
        _check_one_side(tried)
        laid = lay_hand(clips, rig, options.fit, options.register, stages["laying the hand"])
    except CaptureError as error:
        raise failure(options.out, error.what, error.remedy, tried) from error
    results = _cropped(laid, rig, options, stages["cropping"])
    tried = [
        replace(clip, track=hands.clip.track, results=found, focal=hands.fitted.fit.focal)
        for clip, found, hands in zip(tried, results, laid, strict=True)
    ]
    stages["writing"](0.0)
    frames = kept_frames(tried)
    if len(frames) < MIN_KEPT:
        raise failure(options.out, *too_few(tried, len(frames)), tried)
    shape = laid[0].fitted.fit.shape_coefficients
    if len(clips) > 1:
        frames, alone = match_clips(frames, rig, shape)
        tried = [_told_alone(clip) if clip.number in alone else clip for clip in tried]
    frames = with_common_gain(frames)
    seen = count_seen_skin(rig, shape, frames)
    with CaptureWriter(
        options.out,
        side=tried[0].track.side,
        shape_coefficients=shape,
        **header,  # type: ignore[arg-type]
    ) as writer:
        for number, frame in enumerate(frames):
            writer.add(frame)
            stages["writing"](number + 1, len(frames))
        save_json(writer.file("skipped.json"), skipped(tried))
        about = agreement(tried) | {"summary": summary(tried, frames, seen)}
        save_json(writer.file("fit.json"), about)
        writer.file("seen.safetensors").write_bytes(save({"counts": seen.counts.int()}))
        overview(tried, writer.file("overview.png"))
    return read_capture(options.out)


def refuse_capture_in_use(options: VideoOptions) -> None:
    """Refuses what :func:`capture_video` would refuse, before there is a video.

    Raises:
        CaptureError: the folder is in use.
        RigError: there is no such rig.
        ValueError: no picture would be selected.
    """
    options.sampling()
    CaptureWriter(options.out, **_header(options, load_rig(options.rig)))  # type: ignore[arg-type]


def _header(options: VideoOptions, rig: Rig) -> dict[str, object]:
    """What a capture says of itself, and what it may not be written over."""
    files = (options.file, *options.more)
    return {
        "rig_name": rig.name,
        "rig_sha256": rig.sha256,
        "subject": options.subject,
        "source": ", ".join(file.name for file in files),
        "licence": options.licence,
        "overwrite": options.overwrite,
        "inputs": (*files, *options.masks, *options.camera, *files_named(options.rig)),
    }


def _told_alone(clip: TriedClip) -> TriedClip:
    note = "it shows no skin that the others show: its exposure could not be brought to theirs"
    return replace(clip, track=replace(clip.track, notes=(*clip.track.notes, note)))


def _check_one_side(clips: Sequence[TriedClip]) -> None:
    """Refuses recordings of two hands."""
    if len({clip.track.side for clip in clips}) > 1:
        sides = ", ".join(f"{clip.file}: {clip.track.side}" for clip in clips)
        raise CaptureError(
            f"the videos show two hands ({sides})",
            "give videos of one hand, or name its side with `side`",
        )


def _cropped(
    laid: Sequence[LaidClip], rig: Rig, options: VideoOptions, progress: Progress
) -> list[list[FittedFrame]]:
    """All pictures of all recordings, of one size."""
    boxes = [
        [box_in_front(clip, number, rig) for number in range(len(clip.masks))] for clip in laid
    ]
    size = options.size or stored_size([box.side for of_clip in boxes for box in of_clip])

    parts = progress.equal_parts(len(laid))

    def of_clip(number: int) -> list[FittedFrame]:
        clip = laid[number]
        return on_all_cores(
            lambda hand: crop_frame(
                clip, hand, boxes[number][hand], rig, size, options.min_confidence, number
            ),
            range(len(clip.masks)),
            parts[number],
        )

    return [of_clip(number) for number in range(len(laid))]


def track_video(
    options: VideoOptions,
    progress: Progress = SILENT,
    open_finder: Callable[[], Finder] | None = None,
) -> Track:
    """Finds the hand in the pictures of a video.

    Args:
        options: which video, pictures and hand.
        progress: told how far it is.
        open_finder: as for :func:`capture_video`.

    Raises:
        UnusableTrackError: there is no hand to go on with.
        CaptureError: the video cannot be read, or an extra is missing.
    """
    return _tracked(options, None, progress, open_finder).track


@dataclass(eq=False)
class _Tracked:
    """A track, and what has been learned of the pictures on the way."""

    track: Track
    names: dict[int, str]
    pinhole: Pinhole | None


def _tracked(
    options: VideoOptions,
    camera: KnownCamera | None,
    progress: Progress,
    open_finder: Callable[[], Finder] | None,
) -> _Tracked:
    if options.hand == "both":
        raise ArgumentError(
            "hand", "both makes two captures: ask for one of VideoOptions.of_each_hand"
        )
    notes: list[str] = []
    is_own = open_finder is None and (
        options.tracker == "own" or (options.tracker == "auto" and not has_mediapipe())
    )
    if is_own and options.tracker == "auto":
        notes.append(
            "MediaPipe is not installed, so our own tracker alone finds the hand, less exactly "
            "(with Python 3.12 or older: pip install 'handavatar[video]')"
        )
    names: dict[int, str] = {}
    pinhole: Pinhole | None = None

    def seen(frame: VideoFrame) -> VideoFrame:
        nonlocal pinhole
        if frame.name:
            names[frame.index] = frame.name
        if camera is None:
            return frame
        size = (frame.image.shape[1], frame.image.shape[0])
        pinhole = pinhole or pinhole_of(camera.lens, size, camera.source, notes.append)
        return replace(frame, image=pinhole.straighten(frame.image))

    frames = map(seen, frames_of(options.file, options.sampling(), notes.append))
    finder = open_finder() if open_finder else OwnFinder() if is_own else None
    try:
        track = track_hand(frames, options.side, progress, options.hand, finder)
    except UnusableTrackError as error:
        told = replace(error.track, notes=tuple(notes))
        raise UnusableTrackError(error.what, error.remedy, told) from error
    return _Tracked(replace(track, notes=tuple(notes), is_own=is_own), names, pinhole)


def _tracked_clip(
    options: VideoOptions,
    rig: Rig,
    camera: KnownCamera | None,
    progress: Progress,
    track: Track | None,
    open_finder: Callable[[], Finder] | None,
) -> Clip:
    """One recording, with all that the user says of it."""
    has_moved = camera is not None and bool(camera.camera_from_world)
    if has_moved and not is_picture_source(options.file):
        raise CaptureError(
            f"{options.camera[0]}: it says where the camera was in each picture by its name, and "
            f"the pictures of {options.file.name} have none",
            "give the folder of the pictures that the cameras were found for; or a file without "
            "frames, if the camera stands still",
        )
    found = _Tracked(track, {}, None) if track else _tracked(options, camera, progress, open_finder)
    track, pinhole = found.track, found.pinhole
    if camera is not None and has_moved:
        track = _of_known_cameras(track, found.names, camera)
    masks = None
    if options.masks:
        track, masks = give_masks(
            track,
            options.masks[0],
            found.names,
            options.sampling(),
            pinhole.straighten if pinhole else lambda image: image,
        )
    views = None
    if camera is not None and has_moved:
        views = torch.stack(
            [camera.camera_from_world[found.names[hand.index]] for hand in track.hands]
        )
        # Left hands were mirrored, and so is their world.
        views = mirror_rigid(views) if track.side == "left" else views
    if pinhole is not None:
        track = track.with_principal_point(pinhole.principal_point)
    if track.is_own or options.tracker == "both":
        track = see_skin(track, rig)
    return replace(
        clip_of(track),
        focal=None if pinhole is None else pinhole.focal,
        camera_from_world=views,
        unit=options.camera_unit,
        masks=masks,
    )


def _of_known_cameras(track: Track, names: dict[int, str], camera: KnownCamera) -> Track:
    """The pictures whose camera is known; the others are skipped by that name."""
    known = {
        hand.index for hand in track.hands if names.get(hand.index) in camera.camera_from_world
    }
    if not known:
        raise CaptureError(
            f"{camera.source}: none of its {len(camera.camera_from_world)} cameras has the name of "
            "a picture",
            "give the folder of the pictures that the cameras were found for",
        )
    lacking = {hand.index: NO_CAMERA for hand in track.hands if hand.index not in known}
    kept = tuple(hand for hand in track.hands if hand.index in known)
    return replace(track, hands=kept, skipped=track.skipped | lacking)
