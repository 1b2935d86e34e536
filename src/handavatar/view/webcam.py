"""``handavatar capture webcam``: the page of a live hand; the browser opens the camera.

What is recorded is sent in pieces while it is recorded, and put in place when it is whole. The
pictures that the hand is followed in are small ones of the same camera, and are kept nowhere.
"""

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from handavatar.avatar import HandAvatar
from handavatar.errors import require_ranges
from handavatar.hand.rigs import load_rig
from handavatar.jobs.signals import awaited_signals
from handavatar.tracker.model import shipped_tracker
from handavatar.view.driven import DrivenAvatar
from handavatar.view.guard import Guard
from handavatar.view.recording import RecordingFile
from handavatar.view.server import PageServer, checked_guard, greet, serving
from handavatar.view.webcam_answers import WebcamAnswers
from handavatar.webcam.session import LiveSession

_MOST_POSTED = 4
"""Pictures and pieces of a recording that are received at a time; more are asked to try again."""
_LAST_ANSWER = 0.5
"""Seconds in which the page still gets the answer that all is whole."""


@dataclass(frozen=True)
class WebcamOptions:
    """A page that follows a hand live.

    Attributes:
        out: folder that will be made of the recording, which gets the same name with an ending;
            None records nothing.
        drive: run folder or file of an avatar that follows the hand; None for none.
        side: of the hand.
        focal_share: focal length over the longer side of the picture.
        longest: seconds of a recording that are used.
        port: of the page; if it is taken, the next free one.
        host: where to listen. Beyond this machine a token is needed; without ``token`` one is made.
        token: letters, digits, - and _; who does not know it is not served.
    """

    out: Path | None
    drive: Path | None = None
    side: Literal["auto", "left", "right"] = "auto"
    focal_share: float = 1.0
    longest: float = 60.0
    port: int = 7007
    host: str = "127.0.0.1"
    token: str = ""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, focal_share=(0.05, 50), longest=(0.1, 1e6), port=(0, 65_535))


class WebcamServer(PageServer):
    """The page, and what it asks for."""

    def __init__(self, answers: WebcamAnswers, guard: Guard, port: int) -> None:
        """Binds the port; :meth:`serve` answers.

        Args:
            answers: to requests.
            guard: who is let in, and where to listen.
            port: the first to try; 0 is any.

        Raises:
            OSError: if no port is free, or there is no such host.
        """
        super().__init__(guard, port)
        self.answers = answers
        self._http.answers = answers
        # Two pictures on their way, a piece of a recording, and what another page may try.
        self._http.pictures = threading.BoundedSemaphore(_MOST_POSTED)

    def close(self) -> None:
        """Stops answering, removes what is not whole, frees the port."""
        super().close()
        self.answers.close()


def webcam_answers(options: WebcamOptions) -> WebcamAnswers:
    """The session, the avatar and the recording of a page.

    Raises:
        CheckpointError: if the avatar cannot be read.
    """
    avatar = None if options.drive is None else DrivenAvatar(HandAvatar.load(options.drive))
    tracked = shipped_tracker().points
    hand = load_rig(tracked.rig_name).shaped() if avatar is None else avatar.hand
    session = LiveSession(hand, options.side, options.focal_share)
    recording = None if options.out is None else RecordingFile(options.out.absolute())
    return WebcamAnswers(session, avatar, recording, options.longest)


def record_webcam(options: WebcamOptions) -> Path | None:
    """Serves the page until a recording is whole, or Ctrl-C; for the main thread.

    Returns:
        The video; None if nothing was to be recorded.

    Raises:
        CheckpointError: if the avatar cannot be read.
        ValueError: for a port or token that cannot be.
        OSError: if no port is free, or there is no such host.
        KeyboardInterrupt: if a recording was wanted and there is none.
    """
    guard = checked_guard(options.host, options.port, options.token)
    answers = webcam_answers(options)
    server = WebcamServer(answers, guard, options.port)
    greet(server, options.port)
    with awaited_signals() as is_stopped, serving(server):
        if options.out is None:
            print("the avatar follows the hand; Ctrl-C ends it", flush=True)
        else:
            print("record there and press stop; Ctrl-C ends it without", flush=True)
        while not is_stopped() and answers.recorded is None:
            time.sleep(0.1)
        if answers.recorded is not None:
            time.sleep(_LAST_ANSWER)
    if answers.recorded is None and options.out is not None:
        raise KeyboardInterrupt("nothing was recorded, nothing was written")
    return answers.recorded
