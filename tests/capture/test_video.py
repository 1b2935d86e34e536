"""A video becomes a capture."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import CORNER, FOCAL, PICTURE, SIDE, made_fit, made_hand
from PIL import Image
from safetensors.torch import load_file
from scipy import ndimage
from told import Told
from videos import REAL_VIDEO, grey_levels, needs_real_video, save_video

from handavatar.capture import clips as clips_module
from handavatar.capture import video as video_module
from handavatar.capture.checks import CaptureError
from handavatar.capture.clips import FittedHands
from handavatar.capture.fitted_frames import Box, stored_size
from handavatar.capture.fitted_hand import HandModel
from handavatar.capture.fitting import FitOptions
from handavatar.capture.soundness import find_problems
from handavatar.capture.tracking import Glance, Track
from handavatar.capture.video import VideoOptions, capture_video, track_video
from handavatar.capture.video_report import TriedClip, held_out_splits, summary_lines
from handavatar.capture.windows import (
    FINE_SIDE,
    MASK_SIDE,
    Window,
    resampled,
    window_around,
)
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.geometry.cameras import project
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.rig import Rig
from handavatar.jobs.files import read_marker


@pytest.mark.parametrize("count", [8, 30, 207, 600])
def test_two_blocks_of_time_are_held_out(count: int) -> None:
    splits = held_out_splits(count)
    assert len(splits) == count and set(splits) == {"train", "test"}
    assert 0.15 <= splits.count("test") / count <= 0.3
    changes = sum(a != b for a, b in pairwise(splits))
    assert changes == 4 and splits[0] == splits[-1] == "train"


def _track(num_hands: int, num_skipped: int, reason: str = "no hand found") -> Track:
    """A video in which every other picture shows no hand, as long as there are such."""
    hands, skipped, glances = [], {}, []
    for number in range(num_hands + num_skipped):
        image = np.full((9, 16, 3), 100, dtype=np.uint8)
        glances.append(Glance(number, number / 10, image))
        if len(skipped) < num_skipped and number % 2 == 0:
            skipped[number] = reason
        else:
            hands.append(replace(made_hand(0)[0], index=number, time=number / 10))
    return Track("right", tuple(hands), skipped, PICTURE, tuple(glances))


def test_what_is_held_out_does_not_depend_on_what_was_found() -> None:
    found, hardly = (
        TriedClip("made.mp4", _track(*counts)).splits() for counts in ((40, 0), (22, 18))
    )
    assert found == hardly and list(found) == [f"{number:06d}" for number in range(40)]
    assert list(found.values()) == held_out_splits(40)


def test_a_video_without_a_hand_says_so_and_shows_its_pictures(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe")
    video = save_video(tmp_path / "wall.mp4", grey_levels(12))
    for folder in ("out.failed", "out.failed-2"):
        with pytest.raises(CaptureError, match="a hand was found in 0 of 4") as caught:
            capture_video(VideoOptions(video, tmp_path / "out"))
        assert f"{folder}/overview.png" in caught.value.remedy
        assert Image.open(tmp_path / folder / "overview.png").size[0] > 1000
        reasons = json.loads((tmp_path / folder / "reasons.json").read_text())
        assert reasons["reasons"] == {"no hand found": 4} and len(reasons["frames"]) == 4
        assert read_marker(tmp_path / folder)["kind"] == "failed capture"
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"wall.mp4", "out.failed", "out.failed-2"}


def test_both_hands_are_two_captures() -> None:
    options = VideoOptions(Path("a.mp4"), Path("x/out"), hand="both")
    asked = options.of_each_hand()
    assert [(each.hand, each.out) for each in asked] == [
        ("left", Path("x/out-left")),
        ("right", Path("x/out-right")),
    ]
    alone = replace(options, hand="larger")
    assert alone.of_each_hand() == [alone]
    with pytest.raises(ValueError, match="`hand`: both makes two captures"):
        track_video(options)


def test_what_was_guessed_of_a_video_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cv2")
    monkeypatch.setattr(video_module, "has_mediapipe", lambda: False)
    monkeypatch.setattr(video_module, "OwnFinder", _Blind)
    video = save_video(tmp_path / "wall.mp4", grey_levels(12))
    with pytest.raises(CaptureError, match="a hand was found in 0 of 2"):
        capture_video(VideoOptions(video, tmp_path / "out", max_frames=2))
    notes = json.loads((tmp_path / "out.failed" / "reasons.json").read_text())["notes"]
    assert "MediaPipe is not installed" in notes[0]
    assert "2 pictures were taken, up to 0.1 s" in notes[1]


class _Blind:
    """Finds no hands."""

    def track(self, image: np.ndarray) -> list[object]:
        return []

    def look_closely(self, *_: object) -> None:
        return None


def test_a_hand_wholly_in_the_picture_is_kept_and_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cv2")
    options, rig = _made_video(tmp_path, monkeypatch, PICTURE[0])
    capture = capture_video(options, rig)
    summary = json.loads((capture.folder / "fit.json").read_text())["summary"]
    assert summary["kept"] == summary["pictures"] == _MADE
    assert sum(split["pictures"] for split in summary["splits"].values()) == _MADE
    assert summary["border"]["frames"] == 0
    # Where MediaPipe is not installed, the first line says so.
    side, kept, *_ = [line for line in summary_lines(summary) if not line.startswith("note: Med")]
    assert "`side='left'` overrules it" in side
    assert kept == f"frames: {_MADE} of {_MADE} kept"
    frame = capture.frame(0)
    # All but the cut across the wrist.
    assert 0.97 < float(frame.known.float().mean()) < 1
    assert 0.1 < float(frame.mask.float().mean()) < 0.6
    counts = load_file(capture.folder / "seen.safetensors")["counts"]
    assert len(counts) == rig.num_vertices and int(counts.max()) == _MADE


@pytest.mark.slow
def test_a_hand_that_leaves_the_picture_is_rejected_by_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture ends in the middle of the hand; what the window shows beyond repeats it."""
    pytest.importorskip("cv2")
    options, rig = _made_video(tmp_path, monkeypatch, 205)
    seen = []
    crop = video_module.crop_frame
    monkeypatch.setattr(video_module, "crop_frame", lambda *a: seen.append(crop(*a)) or seen[-1])
    with pytest.raises(CaptureError, match="the hand leaves the picture") as caught:
        capture_video(options, rig)
    assert "step back" in caught.value.remedy
    reasons = json.loads((tmp_path / "out.failed" / "reasons.json").read_text())
    assert reasons["reasons"] == {"border": _MADE}
    assert all(
        text.endswith(" % of the hand is in the picture") for text in reasons["frames"].values()
    )
    for result in seen:
        frame = result.frame
        right = (torch.arange(256) + 1 - frame.camera.center[0]) / frame.camera.focal[0] * FOCAL
        beyond = right + 205 / 2 > 205 + 0.01
        assert bool(beyond.any()) and not bool(frame.known[:, beyond].any())
        assert not bool(frame.coverage[~frame.known].any())
        assert bool((frame.image[:, beyond] == 128).all())


@pytest.mark.slow
def test_pictures_are_stored_as_large_as_the_video_shows_the_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the fine surroundings, not from those in which the mask is found."""
    pytest.importorskip("cv2")
    assert [stored_size(sides) for sides in ([300.0, 511.0], [511.0, 600.0, 700.0])] == [256, 512]
    options, rig = _made_video(tmp_path, monkeypatch, PICTURE[0])
    track = video_module.track_hand()
    striped = []
    for hand in track.hands:
        image = hand.window.image.repeat(2, 0).repeat(2, 1)
        image[:, ::2] = 0  # finer than the window can show
        fine = Window(image, CORNER, 2.0, hand.window.picture_size)
        striped.append(replace(hand, fine=fine))
    fine_track = replace(track, hands=tuple(striped))
    monkeypatch.setattr(video_module, "track_hand", lambda *_: fine_track)
    for asked, expected in ((None, 256), (512, 512)):
        out = tmp_path / f"stored{expected}"
        frame = capture_video(replace(options, out=out, size=asked), rig).frame(0)
        assert frame.camera.width == frame.image.shape[1] == expected
        colors = frame.image[frame.mask].float()
        # A pixel of 512 is less than two of the fine stripes wide: some are nearly black.
        assert 40 < float(colors.mean()) < 110
    assert float((colors.mean(-1) < 20).float().mean()) > 0.1


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_picture_and_mask_are_cut_from_the_same_square(is_mirrored: bool) -> None:
    """Of a hand of which the mask's window has fewer pixels than the video."""
    y, x = np.mgrid[:1000, :1400]
    image = np.stack([x / 6, y / 5, 120 + 60 * np.sin(x / 9) * np.sin(y / 11)], axis=-1)
    image = image.astype(np.uint8)
    landmarks = np.random.default_rng(0).uniform((480.0, 300.0), (820.0, 700.0), (21, 2))
    windows = [window_around(image, landmarks, side) for side in (MASK_SIDE, FINE_SIDE)]
    hand = replace(made_hand(0)[0], window=windows[0], fine=windows[1], landmarks=landmarks)
    hand = hand.mirrored() if is_mirrored else hand
    assert hand.window.scale < 0.7 < 1 == pytest.approx(hand.stored_from.scale, abs=0.01)
    box = Box((420.5, 260.25), 500.0)
    direct = image[:, ::-1] if is_mirrored else image
    cuts = []
    for window in (hand.window, hand.stored_from):
        corner, side = box.seen_in(window)
        zoom = np.eye(2) * (side / 128)
        cuts.append(resampled(window.image, zoom, np.array(corner), 128).astype(float))
    cuts.append(resampled(direct, np.eye(2) * (500 / 128), np.array(box.corner), 128).astype(float))
    for cut in cuts[:2]:
        # A pixel beside would be three steps in the first two channels.
        assert np.abs(cut - cuts[2])[8:-8, 8:-8, :2].mean() < 0.7
        assert abs((cut - cuts[2])[8:-8, 8:-8, :2].mean()) < 0.5


_MADE = 9


def _made_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int
) -> tuple[VideoOptions, Rig]:
    """A video of made hands whose pictures end at a column; tracker and fit know the truth."""
    rig, hands, vertices = load_open_hand("778"), [], []
    size = (width, PICTURE[1])
    for number in range(_MADE):
        hand, _ = made_hand(number % 3)
        image = hand.window.image.copy()
        if width < SIDE + CORNER[0]:
            inside = int(width - CORNER[0])
            image[:, inside:] = image[:, inside - 1 : inside]
        window = Window(image, CORNER, 1.0, size)
        hands.append(replace(hand, index=number, time=number / 10, window=window))
        # The principal point is the middle of the narrower picture.
        posed = HandModel(rig).all_vertices(made_fit(number % 3))[0]
        aside = (PICTURE[0] - width) / 2 / FOCAL * posed[:, 2:]
        vertices.append(posed + aside * torch.tensor([1.0, 0, 0]))
    fit = made_fit(0)
    several = replace(
        fit,
        rotations=fit.rotations.expand(_MADE, -1, -1),
        translation=torch.cat([made_fit(number % 3).translation for number in range(_MADE)]),
    )
    track = Track("right", tuple(hands), {}, size)
    covariances = (1e-6 * torch.eye(51)).expand(_MADE, -1, -1)
    errors = torch.full((_MADE,), 0.002)
    nothing = torch.zeros(21)
    sighting = LandmarkSightings(
        torch.zeros(21, 2), nothing + 0.1, nothing, nothing + 0.1, torch.zeros(21, 3)
    )
    fitted = FittedHands(several, torch.stack(vertices), errors, covariances, [sighting] * _MADE)
    monkeypatch.setattr(video_module, "track_hand", lambda *_: track)
    monkeypatch.setattr(video_module, "frames_of", lambda *_: iter(()))
    monkeypatch.setattr(clips_module, "_found_masks", lambda *_: [])
    monkeypatch.setattr(clips_module, "_fitted_to_landmarks", lambda *_: [fitted])
    monkeypatch.setattr(clips_module, "_registered", lambda *_: [fitted])
    return VideoOptions(tmp_path / "made.mp4", tmp_path / "out"), rig


def test_a_folder_in_use_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(CaptureError, match="not empty"):
        capture_video(VideoOptions(Path("no.mp4"), tmp_path))
    assert (tmp_path / "mine.txt").read_text() == "keep me"


@pytest.mark.slow
@pytest.mark.real
@needs_real_video
def test_the_real_hand_becomes_a_sound_capture(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe")
    told = Told()
    options = VideoOptions(
        REAL_VIDEO,
        tmp_path / "out",
        max_frames=10,
        fit=FitOptions(landmark_steps=120, outline_steps=90, retry_steps=20),
    )
    capture = capture_video(options, progress=told.progress)
    assert find_problems(capture.folder) == []
    assert capture.side == "right" and len(capture.records) == 10
    assert told.shares == sorted(told.shares) and told.shares[-1] == 1.0
    skipped = json.loads((capture.folder / "skipped.json").read_text())
    assert skipped == {"frames": {}, "reasons": {}}
    fit = json.loads((capture.folder / "fit.json").read_text())
    assert fit["mean_mask_iou"] > 0.88
    assert fit["mean_landmark_error_pixels"] < 6
    assert fit["summary"]["splits"]["test"] == {"pictures": 2, "kept": 2}
    assert "back" in fit["summary"]["skin_never_seen"]["regions"]
    assert len(load_file(capture.folder / "seen.safetensors")["counts"]) > 778
    assert Image.open(capture.folder / "overview.png").size[0] > 1000

    hand = load_open_hand().shaped(capture.shape_coefficients)
    frame = capture.frame(0)
    # The mean hand is 184 mm from wrist to fingertip; nobody's is a quarter off.
    assert 0.14 < float(hand.rest_vertices[:, 0].abs().max()) < 0.23
    vertices, depth = project(frame.camera, hand.posed(frame.pose).vertices)
    assert 0.4 < float(depth.mean()) < 1.5
    x, y = vertices.round().long().clamp(0, 255).unbind(-1)
    near = torch.from_numpy(ndimage.binary_dilation(frame.mask.numpy(), iterations=4))
    assert near[y, x].float().mean() > 0.95
    # A box of 1.3 times the hand: the mask touches no side and fills the middle.
    rows, columns = np.nonzero(frame.mask.numpy())
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    assert 0.7 < extent / 256 < 0.85
