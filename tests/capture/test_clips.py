"""Several recordings of one hand, and a camera that moves, are laid onto one hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import FOCAL, made_fit, made_hand
from told import Told

from handavatar.capture import video as video_module
from handavatar.capture.checks import CaptureError
from handavatar.capture.clips import (
    Clip,
    clip_of,
    lay_hand,
    one_after_the_other,
)
from handavatar.capture.fitted_hand import HandModel
from handavatar.capture.fitting import FitOptions
from handavatar.capture.masks import HandMask
from handavatar.capture.tracking import Track
from handavatar.capture.video import VideoOptions, capture_video
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.rotations import apply_rigid, matrix_from_axis_angle, rigid_transform
from handavatar.hand.open_hand import load_open_hand
from handavatar.jobs.progress import SILENT

FIT = FitOptions(landmark_steps=60)
REGISTER = RegisterOptions(restarts=0, texture_sigmas=())


def _clip(numbers: list[int], side: str = "right") -> Clip:
    """A recording whose masks are the true ones, as if the user gave them."""
    hands = [
        replace(made_hand(number)[0], index=place, time=place / 10)
        for place, number in enumerate(numbers)
    ]
    masks = [made_hand(number)[1] for number in numbers]
    size = hands[0].window.picture_size
    given = [HandMask(mask, mask.astype(np.float64), 1.0) for mask in masks]
    return replace(clip_of(Track(side, tuple(hands), {}, size)), masks=given)


@pytest.mark.slow
def test_two_recordings_have_one_shape_and_times_that_go_on() -> None:
    pytest.importorskip("cv2")
    rig = load_open_hand("778")
    clips = one_after_the_other([_clip([0, 1]), replace(_clip([2, 0]), focal=FOCAL)])
    assert [clip.start for clip in clips] == pytest.approx([0.0, 1.1])
    told = Told()
    laid = lay_hand(clips, rig, FIT, REGISTER, told.progress)
    assert told.shares == sorted(told.shares)
    first, second = (clip.fitted.fit for clip in laid)
    assert torch.equal(first.shape_coefficients, second.shape_coefficients)
    # What is known stays, to rounding.
    assert second.focal == pytest.approx(FOCAL, rel=1e-6) and first.focal != second.focal
    for clip, numbers in zip(laid, ([0, 1], [2, 0]), strict=True):
        for vertices, number in zip(clip.fitted.vertices, numbers, strict=True):
            truth = HandModel(rig).all_vertices(made_fit(number))[0]
            apart = (vertices - vertices.mean(0)) - (truth - truth.mean(0))
            assert float(apart.norm(dim=-1).mean()) < 0.012


@pytest.mark.slow
def test_poses_of_a_moving_camera_are_in_the_world() -> None:
    """The same pictures, once of a camera that stands still and once of one that moved."""
    pytest.importorskip("cv2")
    rig = load_open_hand("778")
    still = replace(_clip([0, 1, 0]), focal=FOCAL)
    turns = matrix_from_axis_angle(torch.tensor([[0.0, 0, 0], [0.2, 0.3, 0], [0.1, -0.2, 0.3]]))
    views = rigid_transform(turns, torch.tensor([[0.0, 0, 0], [1.0, 0, 0.5], [-1.0, 0.5, 0]]))
    moving = replace(still, camera_from_world=views, unit=0.1)
    # Without neighbours in time both fits are the same problem.
    apart = [replace(hand, time=float(place)) for place, hand in enumerate(still.track.hands)]
    for_both = replace(still.track, hands=tuple(apart))
    laid = [
        lay_hand([replace(clip, track=for_both)], rig, FIT, REGISTER, SILENT)[0]
        for clip in (still, moving)
    ]
    cameras = laid[1].clip.world_cameras
    assert cameras is not None
    hand = rig.shaped(laid[1].fitted.fit.shape_coefficients)
    for number in range(3):
        seen = laid[1].fitted.vertices[number]
        assert torch.allclose(seen, laid[0].fitted.vertices[number], atol=2e-3)
        alone = laid[0].world.pose(number)
        assert torch.equal(alone.translation, laid[0].fitted.fit.translation[number])
        posed = hand.posed(laid[1].world.pose(number)).vertices
        expected = hand.posed(alone).vertices
        assert torch.allclose(apply_rigid(cameras[number], posed), expected, atol=2e-3)


def test_videos_of_two_hands_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cv2")
    tracks = iter([_clip([0] * 8).track, replace(_clip([0] * 8).track, side="left")])
    monkeypatch.setattr(video_module, "track_hand", lambda *_: next(tracks))
    monkeypatch.setattr(video_module, "frames_of", lambda *_: iter(()))
    options = VideoOptions(
        Path("palm.mp4"), tmp_path / "out", more=(Path("back.mp4"),), tracker="mediapipe"
    )
    monkeypatch.setattr(video_module, "has_mediapipe", lambda: True)
    with pytest.raises(CaptureError, match=r"two hands \(palm.mp4: right, back.mp4: left\)"):
        capture_video(options, load_open_hand("778"))
    assert (tmp_path / "out.failed" / "overview.png").is_file()


def test_every_video_has_its_own_masks_and_camera() -> None:
    options = VideoOptions(
        Path("a.mp4"),
        Path("out"),
        more=(Path("b.mp4"),),
        masks=(Path("m"), Path("n")),
        camera=(Path("c"), Path("d")),
    )
    apart = options.of_each_clip()
    assert [(video.file, video.more) for video in apart] == [
        (Path("a.mp4"), ()),
        (Path("b.mp4"), ()),
    ]
    assert [(video.masks, video.camera) for video in apart] == [
        ((Path("m"),), (Path("c"),)),
        ((Path("n"),), (Path("d"),)),
    ]
    with pytest.raises(ValueError, match="`masks`: found 1, expected one for each of 2 videos"):
        replace(options, masks=(Path("m"),)).of_each_clip()
