"""What the page of a training asks for: from requests that were let in to answers."""

from collections.abc import Callable

from handavatar.view.answers import client_in, order_in, waited
from handavatar.view.connections import Answer, json_answer, page_file
from handavatar.view.guard import Refused
from handavatar.view.scene import fields, read_json, read_view, whole
from handavatar.view.studio import STAGES, Pixels, encoded
from handavatar.view.training import Watch
from handavatar.view.turns import Job, Turns


class TrainingAnswers:
    """As :class:`~handavatar.view.answers.AvatarAnswers`, of a run that is being trained."""

    def __init__(self, watch: Watch, turns: Turns) -> None:
        """Joins the parts.

        Args:
            watch: looks on at the run.
            turns: with lanes ``fluid`` and ``field``.
        """
        self._watch = watch
        self._turns = turns

    def get(self, path: str, query: dict[str, str]) -> Answer:
        """Answers a GET request.

        Raises:
            Refused: 404 for what there is not.
        """
        if path == "/":
            return page_file("training.html", "text/html; charset=utf-8")
        if path == "/training":
            return json_answer(self._watch.about())
        if path == "/curves":
            return json_answer(self._watch.curves())
        raise Refused(404, "there is no such thing")

    def post(self, path: str, body: bytes, is_gone: Callable[[], bool]) -> Answer:
        """Answers a POST request.

        Args:
            path: which.
            body: JSON.
            is_gone: whether the client has hung up.

        Raises:
            Refused: 404 for what there is not.
            SceneError: for a body that means nothing.
            Overtaken: if the client has asked for something newer, or is gone.
            Busy: if too many ask.
        """
        if path not in ("/frame", "/picture"):
            raise Refused(404, "there is no such thing")
        content = fields(read_json(body), "picture", ("client", "order", "stage", "view"))
        view = read_view(content.get("view", {}))
        stage = STAGES[whole(content.get("stage", 0), "stage", 0, len(STAGES) - 1)]

        def work(job: Job) -> Answer:
            if path == "/frame":
                return _jpeg(self._watch.picture(view))
            if stage == STAGES[0]:
                shown = self._watch.fluid(view)
            else:
                shown = self._watch.refined(view, stage, job.is_to_end)
            return _jpeg(shown.pixels, ("Avatar", shown.label))

        lane = "fluid" if path == "/frame" or stage == STAGES[0] else "field"
        client = f"{path} {client_in(content)}"
        job = self._turns.submit(lane, client, order_in(content), work)
        answer: Answer = waited(job, is_gone)
        return answer


def _jpeg(pixels: Pixels, *headers: tuple[str, str]) -> Answer:
    return Answer(encoded(pixels, "JPEG"), "image/jpeg", headers)
