"""What an avatar's page asks for: from requests that were let in to answers."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from handavatar.view.connections import Answer, json_answer, page_file
from handavatar.view.films import FilmOrder, Films
from handavatar.view.guard import Refused
from handavatar.view.scene import (
    MOST_STEPS,
    Moment,
    SceneError,
    fields,
    number,
    read_json,
    read_scene,
    read_touches,
    whole,
)
from handavatar.view.studio import STAGES, Studio, encoded
from handavatar.view.turns import Job, Turns

_NOTHING = "there is no such thing"


class AvatarAnswers:
    """The ordinary page's."""

    def __init__(self, studio: Studio, turns: Turns, films: Films, out: Path) -> None:
        """Joins the parts."""
        self._studio = studio
        self._turns = turns
        self._films = films
        self._out = out
        self._saving = threading.Lock()

    def get(self, path: str, query: dict[str, str]) -> Answer:
        """Answers a GET request.

        Raises:
            Refused: 404 for what there is not.
            SceneError: for a query that means nothing.
        """
        if path == "/":
            return page_file("index.html", "text/html; charset=utf-8")
        if path == "/about":
            return json_answer(self._studio.about())
        if path == "/motion":
            motion = self._studio.motion(query.get("name", ""))
            return json_answer({"fps": motion.fps, "steps": len(motion)})
        if path == "/angles":
            text = query.get("step", "")
            step = int(text) if text.isdecimal() and len(text) <= 7 else -1
            moment = Moment(query.get("motion", ""), whole(step, "step", 0, MOST_STEPS))
            return json_answer({"angles": self._studio.angles(moment)})
        if path == "/film":
            progress = self._films.progress(query.get("name", ""))
            if progress is not None:
                return json_answer(progress)
        if path == "/film.mp4":
            film = self._films.file(query.get("name", ""))
            if film is not None:
                return Answer(film, "video/mp4")
        raise Refused(404, _NOTHING)

    def post(self, path: str, body: bytes, is_gone: Callable[[], bool]) -> Answer:
        """Answers a POST request.

        Args:
            path: which.
            body: JSON, or the picture of a paint.
            is_gone: whether the client has hung up.

        Raises:
            Refused: 404 for what there is not.
            SceneError: for a body that means nothing.
            Overtaken: if the client has asked for something newer, or is gone.
            Busy: if too many ask.
        """
        if path == "/paint":
            return json_answer({"picture": self._studio.coat(body)})
        known = {
            "/picture": self._picture,
            "/pick": self._pick,
            "/avatar": self._avatar,
            "/film": self._film,
            "/film/cancel": self._cancel_film,
        }
        if path not in known:
            raise Refused(404, _NOTHING)
        return known[path](read_json(body), is_gone)

    def _picture(self, content: dict[str, Any], is_gone: Callable[[], bool]) -> Answer:
        fields(content, "picture", ("client", "order", "stage", "scene"))
        scene = read_scene(content.get("scene", {}))
        stage = STAGES[whole(content.get("stage", 0), "stage", 0, len(STAGES) - 1)]
        self._studio.shot(scene)  # What it names that there is not is refused before it waits.

        def work(job: Job) -> bytes:
            if stage == STAGES[0]:
                return encoded(self._studio.fluid(scene), "JPEG")
            pixels = self._studio.refined(scene, stage, job.is_stale)
            return encoded(pixels, "PNG" if stage == STAGES[-1] else "JPEG")

        lane = "fluid" if stage == STAGES[0] else "field"
        job = self._turns.submit(lane, client_in(content), order_in(content), work)
        kind = "image/png" if stage == STAGES[-1] else "image/jpeg"
        return Answer(waited(job, is_gone), kind)

    def _pick(self, content: dict[str, Any], is_gone: Callable[[], bool]) -> Answer:
        fields(content, "pick", ("client", "order", "scene", "x", "y"))
        scene = read_scene(content.get("scene", {}))
        x, y = (number(content.get(name), name, 0.0, 1.0) for name in ("x", "y"))
        self._studio.shot(scene)
        client = f"pick {client_in(content)}"
        job = self._turns.submit(
            "fluid", client, order_in(content), lambda _: self._studio.nearest_anchor(scene, x, y)
        )
        return json_answer({"anchor": waited(job, is_gone)})

    def _avatar(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        fields(content, "avatar", ("touches",))
        with self._saving:
            path = self._studio.save(read_touches(content.get("touches", {})), self._out)
        return json_answer({"path": str(path)})

    def _film(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        fields(content, "film", ("scene", "stage", "every"))
        scene = read_scene(content.get("scene", {}))
        if scene.moment is None:
            raise SceneError("a video needs a motion: choose one")
        stage = STAGES[whole(content.get("stage", 0), "stage", 0, len(STAGES) - 1)]
        every = whole(content.get("every", 1), "every", 1, 1000)
        return json_answer({"name": self._films.start(FilmOrder(scene, stage, every))})

    def _cancel_film(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        self._films.cancel(str(content.get("name", ""))[:64])
        return json_answer({})


def client_in(content: dict[str, Any]) -> str:
    """Who asks.

    Raises:
        SceneError: if no name is given.
    """
    client = content.get("client")
    if not isinstance(client, str) or not 0 < len(client) <= 64:
        raise SceneError("client: expected a name of at most 64 letters")
    return client


def order_in(content: dict[str, Any]) -> int:
    """Of the client's wishes, which.

    Raises:
        SceneError: if it is no number.
    """
    return whole(content.get("order", 0), "order", 0, 2**53)


def waited(job: Job, is_gone: Callable[[], bool]) -> Any:
    """What a job makes, unless the client hangs up, which ends the job.

    Raises:
        ConnectionResetError: then.
    """
    while not job.is_done(0.1):
        if is_gone():
            job.drop()
            raise ConnectionResetError
    return job.result()
