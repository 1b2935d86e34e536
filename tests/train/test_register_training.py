"""What training asks of registration."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import write_tiny_capture

from handavatar.capture.frames import read_capture
from handavatar.fit.energy import VIDEO_TEXTURE_SHARE, EnergyOptions
from handavatar.fit.register import RegisterOptions
from handavatar.train import registration
from handavatar.train.loop import METHODS, TrainOptions, begin_training


class _AskedError(Exception):
    """Ends a registration that is only asked for."""


@pytest.mark.parametrize("is_video", [False, True])
def test_frames_of_a_video_are_drawn_to_their_texture_as_capture_drew_them(
    is_video: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lighter texture let training undo what `capture video` had found: frames agreed less."""
    capture = read_capture(write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.8))
    frames = [capture.frame(index) for index in capture.split("train")]
    if is_video:
        frames = [replace(frame, covariance=torch.eye(51)) for frame in frames]
    asked: list[RegisterOptions] = []

    def asks(hands: object, frames: object, options: RegisterOptions, **other: object) -> None:
        asked.append(options)
        raise _AskedError

    monkeypatch.setattr(registration, "register_frames", asks)
    training = begin_training(capture, frames, METHODS["quick"], TrainOptions(capture.folder))
    assert training.corrections is not None
    with pytest.raises(_AskedError):
        registration.register_training(
            training.avatar, training.corrections, frames, RegisterOptions()
        )
    (options,) = asked
    share = VIDEO_TEXTURE_SHARE if is_video else EnergyOptions().texture_share
    assert options.energy.texture_share == share
    assert options.restarts == (1 if is_video else RegisterOptions().restarts)
