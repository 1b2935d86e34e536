"""A video that a page sends in pieces while it is recorded; it is at its place only when whole."""

import os
from pathlib import Path

from handavatar.view.scene import SceneError

MOST_BYTES = 2 << 30
"""Of a recording: a quarter of an hour at 18 million bits a second."""
MOST_NAMES = 1000
ENDINGS = {"video/webm": ".webm", "video/mp4": ".mp4"}
"""Of the kinds of video that browsers record."""


class RecordingFile:
    """One recording at a time; for one thread at a time."""

    def __init__(self, beside: Path) -> None:
        """Nothing is written yet.

        Args:
            beside: folder that is made of the recording; the video gets its name and an ending.
        """
        self._beside = beside
        self._ending = ""
        self._size = 0
        self._aside: Path | None = None

    def begin(self, kind: str) -> None:
        """Begins anew; what was sent before is gone.

        Args:
            kind: media type.

        Raises:
            SceneError: of a kind that no browser records.
            OSError: if nothing can be written there.
        """
        self.abandon()
        if kind not in ENDINGS:
            raise SceneError(f"kind: expected one of {', '.join(ENDINGS)}, found {kind!a:.40}")
        self._ending, self._size = ENDINGS[kind], 0
        aside = self._beside.with_name(f".tmp-{os.getpid()}-{self._beside.name}{self._ending}")
        aside.parent.mkdir(parents=True, exist_ok=True)
        self._aside = aside
        aside.write_bytes(b"")

    def add(self, at: int, piece: bytes) -> int:
        """Takes the next piece.

        Args:
            at: bytes that came before it.
            piece: of the file.

        Returns:
            How many bytes there are now.

        Raises:
            SceneError: if nothing was begun, a piece is missing, or the video is too large.
        """
        if self._aside is None:
            raise SceneError("no recording was begun")
        if at != self._size:
            raise SceneError(f"at: expected {self._size}, found {at}: a piece is missing")
        if self._size + len(piece) > MOST_BYTES:
            raise SceneError(f"a recording has at most {MOST_BYTES} bytes: record a shorter one")
        with self._aside.open("ab") as file:
            file.write(piece)
        self._size += len(piece)
        return self._size

    def finish(self, size: int) -> Path:
        """Puts the video at its place, under a name that is free; no file is replaced.

        If that cannot be, what was sent is gone.

        Args:
            size: of the whole, bytes.

        Raises:
            SceneError: if it is not whole, or no name is free.
        """
        aside = self._aside
        if aside is None:
            raise SceneError("no recording was begun")
        try:
            if size != self._size or not size:
                raise SceneError(f"bytes: {self._size} have come of {size}: record it again")
            with aside.open("rb") as file:
                os.fsync(file.fileno())
            for number in range(1, MOST_NAMES):
                count = "" if number == 1 else f"-{number}"
                path = self._beside.with_name(f"{self._beside.name}{count}{self._ending}")
                try:
                    os.link(aside, path)  # which fails where a file is
                except FileExistsError:
                    continue
                return path
            raise SceneError(f"no name beside {self._beside} is free: move recordings away")
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Removes what is not whole."""
        if self._aside is not None:
            self._aside.unlink(missing_ok=True)
            self._aside = None
