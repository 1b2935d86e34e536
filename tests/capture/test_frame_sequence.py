"""Frames that are read when they are needed."""

from dataclasses import replace
from pathlib import Path

import pytest

from handavatar.capture.frame_sequence import FrameSequence, change_frames, choose_frames
from handavatar.capture.frames import Frame, read_capture


@pytest.fixture(scope="module")
def stored(tiny_capture: Path) -> list[Frame]:
    capture = read_capture(tiny_capture)
    return [capture.frame(index) for index in range(len(capture.records))]


def _size(frame: Frame) -> int:
    return frame.image.nbytes + frame.coverage.nbytes + frame.known.nbytes


def test_the_first_frames_are_kept_and_the_others_read_again(stored: list[Frame]) -> None:
    read: list[int] = []

    def of(number: int) -> Frame:
        read.append(number)
        return stored[number]

    frames = FrameSequence(of, len(stored), room=2 * _size(stored[0]) + 1)
    for _ in range(2):
        assert [frame.name for frame in frames] == [frame.name for frame in stored]
    assert read == [0, 1, 2, 3, 4, 2, 3, 4]
    assert frames[-1] is stored[-1] and frames[1:3] == stored[1:3]
    for number in (len(stored), -len(stored) - 1):
        with pytest.raises(IndexError):
            frames[number]


def test_changed_and_chosen_frames_hold_none_of_their_own(stored: list[Frame]) -> None:
    read: list[int] = []

    def of(number: int) -> Frame:
        read.append(number)
        return stored[number]

    frames = FrameSequence(of, len(stored), room=0)
    later = change_frames(frames, lambda number, frame: replace(frame, time=frame.time + number))
    assert len(read) < len(stored), "not all: the check of types looks at one or two"
    assert [frame.time for frame in later] == [f.time + n for n, f in enumerate(stored)]
    some = choose_frames(later, [3, 1])
    read.clear()
    assert [frame.name for frame in some] == [stored[3].name, stored[1].name] and read == [3, 1]
    assert some[0].time == stored[3].time + 3 and len(some) == 2
