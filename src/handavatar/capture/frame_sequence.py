"""Frames that are read when they are needed, so that a long recording needs no more memory."""

import threading
from collections.abc import Callable, Sequence
from typing import overload

import torch

from handavatar.capture.frames import Frame

MOST_KEPT_BYTES = 512 * 2**20
"""Of decoded pictures that are kept: 1,600 of 256 pixels along a side, 400 of 512."""


class FrameSequence(Sequence[Frame]):
    """Frames of which the first ones are kept, as many as there is room for; for any thread.

    Whoever goes through all of them again and again, in order or not, finds most of them kept.
    """

    def __init__(
        self, read: Callable[[int], Frame], count: int, room: int = MOST_KEPT_BYTES
    ) -> None:
        """Reads nothing yet.

        Args:
            read: gives a frame by its number.
            count: of frames.
            room: for the frames that are kept, bytes; 0 keeps none.
        """
        self._read, self._count, self._room = read, count, room
        self._kept: dict[int, Frame] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Number of frames."""
        return self._count

    @overload
    def __getitem__(self, number: int) -> Frame: ...

    @overload
    def __getitem__(self, number: slice) -> list[Frame]: ...

    def __getitem__(self, number: int | slice) -> Frame | list[Frame]:
        """A frame, or a list of some.

        Raises:
            IndexError: if there is none of that number.
            CaptureError: if its files were damaged since the capture was read.
        """
        if isinstance(number, slice):
            return [self[each] for each in range(*number.indices(self._count))]
        if not -self._count <= number < self._count:
            raise IndexError(number)
        number %= self._count
        frame = self._kept.get(number)
        if frame is None:
            frame = self._read(number)
            self._keep(number, frame)
        return frame

    def _keep(self, number: int, frame: Frame) -> None:
        size = frame.image.nbytes + frame.coverage.nbytes + frame.known.nbytes
        with self._lock:
            if number not in self._kept and size <= self._room:
                self._room -= size
                self._kept[number] = frame


def change_frames(
    frames: Sequence[Frame], change: Callable[[int, Frame], Frame]
) -> Sequence[Frame]:
    """The same frames with something changed, whenever one of them is needed.

    Args:
        frames: to change; those that are kept stay so.
        change: of a frame and its number; its pixels stay or are read anew.
    """
    return FrameSequence(lambda number: change(number, frames[number]), len(frames), room=0)


def choose_frames(frames: Sequence[Frame], numbers: Sequence[int]) -> Sequence[Frame]:
    """Some of the frames, whenever one of them is needed.

    Args:
        frames: to choose from; those that are kept stay so.
        numbers: of those that are wanted.
    """
    return FrameSequence(lambda place: frames[numbers[place]], len(numbers), room=0)


def spread_numbers(count: int, most: int | None) -> list[int]:
    """Numbers of some of a row, evenly spread, the first and the last among them.

    Args:
        count: of the row.
        most: that are wanted; all if None or more than there are.
    """
    if most is None or most >= count:
        return list(range(count))
    return torch.linspace(0, count - 1, most).round().long().tolist()
