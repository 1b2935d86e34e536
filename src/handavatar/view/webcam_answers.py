"""What the page of a webcam asks for: from requests that were let in to answers."""

import base64
import io
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from jaxtyping import UInt8

from handavatar.capture.checks import CaptureError, decoded, picture_in
from handavatar.jobs.threads import step_back
from handavatar.view.answers import client_in, order_in
from handavatar.view.connections import MOST_PIECE_BYTES, Answer, json_answer, page_file
from handavatar.view.driven import DrivenAvatar
from handavatar.view.guard import Refused
from handavatar.view.recording import RecordingFile
from handavatar.view.scene import SceneError, fields, number, read_json, whole
from handavatar.view.studio import encoded
from handavatar.view.turns import Busy, Overtaken
from handavatar.webcam.coverage import STEPS
from handavatar.webcam.session import LiveSession

LONGER_SIDE = 640
"""Pixels of the pictures that a page sends, along their longer side."""
_MOST_PIXELS = 1 << 21
_LONGEST_RATIO = 8
_MOST_WAITING = 4
"""Pictures that wait for their turn; more are asked to try again."""
_FORGOTTEN = 3.0
"""Seconds without a picture after which another page may have the camera."""
_LOW_PRIORITY = 10
"""Of what sees pictures while a recording may be made: a browser that has to wait drops pictures of
it. A priority is a thread's own on Linux."""
_EVERY = 0.1
"""Seconds from one picture to the next, at least, where none has to be drawn."""
_NOTHING = "there is no such thing"


class WebcamAnswers:
    """The page's; one page at a time is followed."""

    def __init__(
        self,
        session: LiveSession,
        avatar: DrivenAvatar | None,
        recording: RecordingFile | None,
        longest: float,
    ) -> None:
        """Joins the parts.

        Args:
            session: sees the pictures.
            avatar: follows the hand, if one is to.
            recording: what is recorded; None if nothing is to be.
            longest: seconds of a recording that are used.
        """
        self._session = session
        self._avatar = avatar
        self._recording = recording
        self._longest = longest
        self._seeing, self._drawing = threading.Lock(), threading.Lock()
        self._writing = threading.Lock()
        self._priorities = threading.local()
        self._places = threading.BoundedSemaphore(_MOST_WAITING)
        self._owner, self._last, self._order = "", -np.inf, -1
        self._is_left = False
        self.recorded: Path | None = None
        """The video, once it is whole."""

    def get(self, path: str, query: dict[str, str]) -> Answer:
        """Answers a GET request.

        Raises:
            Refused: 404 for what there is not.
        """
        del query
        if path == "/":
            return page_file("webcam.html", "text/html; charset=utf-8")
        if path == "/about":
            return json_answer(self._about())
        if path == "/map":
            with self._seeing:
                pixels = self._session.coverage.picture(self._is_left)
            return Answer(encoded(pixels, "PNG"), "image/png")
        raise Refused(404, _NOTHING)

    def post(self, path: str, body: bytes, is_gone: Callable[[], bool]) -> Answer:
        """Answers a POST request.

        Args:
            path: which, with its query.
            body: JSON, a picture, or a piece of a video.
            is_gone: whether the client has hung up; nothing here takes long enough to ask.

        Raises:
            Refused: 404 for what there is not, 409 while another page has the camera.
            SceneError: for a body that means nothing.
            Overtaken: if a newer picture was seen already.
            Busy: if too many wait.
        """
        del is_gone
        try:
            parts = urlsplit(path)
            given = parse_qs(parts.query, max_num_fields=8)
        except ValueError as error:
            raise SceneError("this address means nothing") from error
        query = {name: values[0] for name, values in given.items()}
        if parts.path == "/look":
            return self._look(body, query)
        if self._recording is not None:
            if parts.path == "/recording":
                with self._writing:
                    self._own(client_in(dict(query)))
                    at = _whole_in(query, "at")
                    return json_answer({"bytes": self._recording.add(at, body)})
            known = {
                "/recording/begin": self._begin,
                "/recording/end": self._end,
                "/recording/drop": self._drop,
            }
            if parts.path in known:
                with self._writing:
                    return known[parts.path](self._recording, read_json(body))
        raise Refused(404, _NOTHING)

    def close(self) -> None:
        """Ends what is going on, and removes a recording that is not whole."""
        # A thread that computes while the program ends would take it down.
        for _ in range(_MOST_WAITING):
            self._places.acquire()
        if self._recording is not None:
            with self._writing:
                self._recording.abandon()

    def _about(self) -> dict[str, Any]:
        return {
            "records": self._recording is not None,
            "drives": self._avatar is not None,
            "steps": [{"name": step.name, "instruction": step.instruction} for step in STEPS],
            "longer_side": LONGER_SIDE,
            "most_piece_bytes": MOST_PIECE_BYTES,
            "longest": self._longest,
            # One is seen while the other is drawn.
            "at_once": 1 if self._avatar is None else 2,
            "every": _EVERY if self._avatar is None else 0.0,
        }

    def _look(self, body: bytes, query: dict[str, str]) -> Answer:
        client = client_in(dict(query))
        order = order_in({"order": _whole_in(query, "order")})
        moment = number(_float_in(query, "time"), "time", 0.0, 1e9)
        if not self._places.acquire(blocking=False):
            raise Busy
        try:
            self._step_back()
            image = read_picture(body)
            with self._seeing:
                self._own(client)
                if order <= self._order:
                    raise Overtaken
                self._order = order
                begin = time.perf_counter()
                seen = self._session.see(image, moment)
                took = {"see": time.perf_counter() - begin}
                if seen.followed is not None:
                    self._is_left = seen.followed.is_mirrored
            answer = seen.as_json() | {"order": order, "avatar": None}
            if self._avatar is not None and seen.live is not None and seen.followed is not None:
                with self._drawing:
                    begin = time.perf_counter()
                    pixels = self._avatar.picture(seen.live, seen.followed.is_mirrored)
                    took["draw"] = time.perf_counter() - begin
                answer["avatar"] = base64.b64encode(encoded(pixels, "JPEG")).decode()
            answer["milliseconds"] = {name: round(1000 * each) for name, each in took.items()}
            return json_answer(answer)
        finally:
            self._places.release()

    def _step_back(self) -> None:
        """Leaves the cores to the browser, once in a connection's thread."""
        if self._recording is not None and not hasattr(self._priorities, "is_low"):
            self._priorities.is_low = True
            step_back(_LOW_PRIORITY)

    def _own(self, client: str) -> None:
        """Gives the camera to a page, unless another one has it."""
        now = time.monotonic()
        if client != self._owner:
            if now - self._last < _FORGOTTEN:
                raise Refused(409, "another page has the camera: close that one")
            self._owner, self._order = client, -1
        self._last = now

    def _begin(self, recording: RecordingFile, content: dict[str, Any]) -> Answer:
        fields(content, "begin", ("client", "kind"))
        self._own(client_in(content))
        recording.begin(str(content.get("kind", "")))
        with self._seeing:
            self._session.coverage.reset()
        return json_answer({})

    def _end(self, recording: RecordingFile, content: dict[str, Any]) -> Answer:
        fields(content, "end", ("client", "bytes"))
        self._own(client_in(content))
        path = recording.finish(whole(content.get("bytes"), "bytes", 0, 2**53))
        self.recorded = path
        return json_answer({"path": str(path)})

    def _drop(self, recording: RecordingFile, content: dict[str, Any]) -> Answer:
        fields(content, "drop", ("client",))
        self._own(client_in(content))
        recording.abandon()
        return json_answer({})


def read_picture(content: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """A camera's picture.

    Raises:
        SceneError: if it is no JPEG, too large, or a strip.
    """
    try:
        picture = picture_in(io.BytesIO(content), "the picture", ("JPEG",), _MOST_PIXELS)
        width, height = picture.size
        # Hands are looked for along the longer side: in a strip of pixels for ten seconds.
        if max(width, height) > _LONGEST_RATIO * min(width, height):
            raise SceneError(f"the picture is {width} x {height}, which no camera takes")
        return decoded(picture, "the picture", "RGB")
    except CaptureError as error:
        raise SceneError(f"{error.what}: {error.remedy}") from error


def _whole_in(query: dict[str, str], name: str) -> int:
    text = query.get(name, "")
    if not text.isdecimal() or len(text) > 16:
        raise SceneError(f"{name}: expected a whole number")
    return int(text)


def _float_in(query: dict[str, str], name: str) -> float:
    try:
        return float(query.get(name, "")[:32])
    except ValueError as error:
        raise SceneError(f"{name}: expected a number") from error
