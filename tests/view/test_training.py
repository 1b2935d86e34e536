"""A training, as its page sees it: how far it is, its frames, its losses, its avatar."""

import http.client
import io
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import write_tiny_capture
from live import FEW
from patience import PATIENCE, until
from PIL import Image

from handavatar import cli
from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame, read_capture
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train import live
from handavatar.train.live import live_folder, shown_live
from handavatar.train.runs import Run, append_log, create_run, truncate_log
from handavatar.view import server as view_server
from handavatar.view.beside import PageOptions, page_beside
from handavatar.view.guard import guard_of
from handavatar.view.scene import SceneError, View
from handavatar.view.server import ViewServer, serving
from handavatar.view.studio import Interrupted, Studio
from handavatar.view.training import MOST_POINTS, Watch, _Curve


def never() -> bool:
    return False


@dataclass
class Trainer:
    """What a trainer does, on demand."""

    run: Run
    avatar: HandAvatar
    frames: list[Frame]
    border: Progress
    progress: Progress
    watch: Watch

    def step(self, number: int, **figures: float) -> None:
        """A step is done, and the onlooker looks."""
        append_log(self.run, number, figures)
        self.progress(number, 100, **figures)
        self.look()

    def look(self) -> None:
        self.watch.about()  # As a page that asks.
        self.watch.refresh()


@pytest.fixture
def trainer(
    small_avatar: HandAvatar,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Iterator[Trainer]:
    """At work on a tiny capture; of a left hand if that is asked for."""
    for name, value in (("_TELL_EVERY", 0.0), ("_SHOW_EVERY", 0.0), ("_MOST_SHARE", 1e9)):
        monkeypatch.setattr(live, name, value)
    side = getattr(request, "param", "right")
    folder = write_tiny_capture(tmp_path / "capture", side=side)
    capture = read_capture(folder)
    run = create_run(
        tmp_path / "run", {}, seed=0, capture=folder, capture_sha256="x", perceptual="none"
    )
    avatar = HandAvatar(
        small_avatar.base_rig, torch.zeros(10), rounds=0, num_anchors=256, info={"side": side}
    )
    avatar.load_state_dict(small_avatar.state_dict())
    frames = [capture.frame(index) for index in capture.split("train")]
    with ExitStack() as stack:
        heard = stack.enter_context(shown_live(run, avatar, None, frames, SILENT))
        border, progress = heard.stages({"border": 10.0, "train": 90.0}).values()
        yield Trainer(run, avatar, frames, border, progress, Watch(run.folder, FEW))


def ask(port: int, path: str, content: Any = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    try:
        if content is None:
            connection.request("GET", path, headers=headers)
        else:
            kind = {"Content-Type": "application/json"}
            connection.request("POST", path, json.dumps(content), kind | headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_how_far_it_is(trainer: Trainer) -> None:
    assert trainer.watch.about()["phase"] == "waiting"
    trainer.step(7, loss=0.5, psnr=20.0)
    about = trainer.watch.about()
    assert (about["phase"], about["job"], about["step"], about["total"]) == (
        *("training", "train"),
        *(7, 100),
    )
    assert about["figures"] == {"loss": 0.5, "psnr": 20.0} and about["frames"] == 3
    assert about["steps_per_second"] > 0 and about["seconds_left"] is not None
    assert about["avatar"] is None
    trainer.step(8, loss=0.4, psnr=21.0)
    about = trainer.watch.about()
    assert about["avatar"] is not None
    assert trainer.watch.fluid(View(0, "mesh", 64)).label == "train 8"
    json.dumps(about)


def test_the_avatar_is_left_anew_only_while_a_page_asks(
    trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer.step(1)
    trainer.step(2)
    before = trainer.watch.about()["avatar"]
    trainer.step(3)
    assert trainer.watch.about()["avatar"] != before
    monkeypatch.setattr(live, "_PATIENCE", 0.0)
    before = trainer.watch.about()["avatar"]
    trainer.progress(4, 100)
    assert trainer.watch.about()["avatar"] == before


@pytest.mark.parametrize("trainer", ["right", "left"], indirect=True)
def test_a_frame_and_the_avatar_in_its_pose_cover_each_other(trainer: Trainer) -> None:
    trainer.step(1)
    trainer.step(2)
    seen = []
    for number in range(3):
        view = View(number, "mesh", 64)
        frame = trainer.watch.picture(view)
        hand = frame.max(-1) > 25
        mesh = (trainer.watch.fluid(view).pixels < 250).any(-1)
        assert (hand & mesh).sum() / (hand | mesh).sum() > 0.75
        color = trainer.watch.refined(View(number, "rgb", 64), "full", never).pixels
        field = color.max(-1) > 25
        assert (hand & field).sum() / (hand | field).sum() > 0.75
        # Its shape is a random one. The hand lies in the middle, with room around.
        assert not np.concatenate([hand[0], hand[-1], hand[:, 0], hand[:, -1]]).any()
        rows, columns = hand.nonzero()
        assert max(np.ptp(rows), np.ptp(columns)) == pytest.approx(64 / 1.25, abs=4)
        seen.append(frame.tobytes())
        half = trainer.watch.refined(View(number, "rgb", 64), "half", never).pixels
        assert half.shape == (32, 32, 3)
    assert len(set(seen)) == 3


def test_a_left_hand_is_mirrored_back(trainer: Trainer) -> None:
    trainer.step(1)
    trainer.step(2)
    view = View(0, "rgb", 64)
    right = [trainer.watch.picture(view), trainer.watch.fluid(view).pixels]
    capture = trainer.watch._capture
    assert capture is not None
    object.__setattr__(capture, "side", "left")
    left = [trainer.watch.picture(view), trainer.watch.fluid(view).pixels]
    for one, other in zip(right, left, strict=True):
        assert np.array_equal(one[:, ::-1], other)


def test_the_picture_changes_with_the_avatar(trainer: Trainer) -> None:
    trainer.step(1)
    trainer.step(2)
    view = View(1, "albedo", 64)
    before = trainer.watch.fluid(view).pixels
    with torch.no_grad():
        trainer.avatar.albedo.mlp.output.bias.add_(torch.tensor([2.0, 0.0, -2.0]))
    time.sleep(0.01)
    trainer.step(3)
    after = trainer.watch.fluid(view).pixels
    assert after[..., 0].sum() > 1.2 * before[..., 0].sum()
    fresh = HandAvatar.load(live.live_avatar(trainer.run))
    seen = trainer.watch._seen
    assert seen is not None
    for name, value in fresh.state_dict().items():
        assert torch.equal(value, seen.avatar.state_dict()[name]), name


def test_a_newer_avatar_that_comes_in_mid_picture_can_be_seen(trainer: Trainer) -> None:
    trainer.step(1)
    trainer.step(2)
    view = View(0, "rgb", 32)
    trainer.watch.fluid(view)
    labels: list[str] = []

    def is_stale() -> bool:
        """In the middle of a picture a newer avatar is taken up, then the picture is dropped."""
        if not labels:
            trainer.step(3)
            labels.append(trainer.watch.fluid(view).label)
        return True

    with pytest.raises(Interrupted):
        trainer.watch.refined(view, "half", is_stale)
    assert labels == ["train 3"]
    # What ended that picture has not come along.
    assert trainer.watch.fluid(view).pixels.any()
    assert trainer.watch.refined(view, "half", never).label == "train 3"


def test_what_there_is_not_is_refused(trainer: Trainer) -> None:
    with pytest.raises(SceneError, match="again"):
        trainer.watch.fluid(View(0, "rgb", 64))
    trainer.step(1)
    trainer.step(2)
    with pytest.raises(SceneError, match="below 3, found 3"):
        trainer.watch.picture(View(3, "rgb", 64))
    with pytest.raises(Interrupted):
        trainer.watch.refined(View(0, "rgb", 64), "full", lambda: True)


def test_losses_are_those_of_the_log_and_of_what_was_told(trainer: Trainer) -> None:
    for step in range(1, 6):
        trainer.border(step, 5, loss=1 / step)
        trainer.look()
    for step in range(1, 6):
        trainer.step(step, loss=2.0 / step, color=1.0)
    jobs = trainer.watch.curves()["jobs"]
    assert list(jobs) == ["border", "train"]
    assert jobs["border"]["loss"][-1][0] == 5.0
    assert jobs["train"]["loss"] == [[float(n), float(f"{2 / n:.5g}")] for n in range(1, 6)]
    assert [value for _, value in jobs["train"]["color"]] == [1.0] * 5
    # Lines that are being written wait; a resumed training begins its log again.
    with open(trainer.run.log, "ab") as file:
        file.write(b'{"step": 6, "lo')
    trainer.look()
    assert len(trainer.watch.curves()["jobs"]["train"]["loss"]) == 5
    truncate_log(trainer.run, 2)
    trainer.step(3, loss=9.0)
    assert trainer.watch.curves()["jobs"]["train"]["loss"][-1] == [3.0, 9.0]
    assert len(trainer.watch.curves()["jobs"]["train"]["loss"]) == 3


def test_lines_of_a_log_that_are_damaged_are_passed_over(trainer: Trainer) -> None:
    trainer.step(1, loss=1.0)
    lines = (b"5", b"[]", b"{}", b"[" * 100_000, b'{"step": "2", "loss": 2}', b"\xff")
    lines += (b'{"step": -1, "loss": 2}', b'{"step": 2, "loss": "x", "color": 1e999}')
    lines += (b'{"step": 2, "loss": 1' + b"0" * 400 + b"}",)
    with open(trainer.run.log, "ab") as file:
        file.write(b"\n".join(lines) + b"\n")
    trainer.step(3, loss=3.0)
    assert trainer.watch.curves()["jobs"]["train"] == {"loss": [[1.0, 1.0], [3.0, 3.0]]}


def test_a_long_curve_is_thinned_by_means() -> None:
    curve = _Curve()
    for step in range(1, 5001):
        curve.add(step, float(step))
    points = curve.points()
    assert MOST_POINTS / 2 < len(points) <= MOST_POINTS
    for step, value in points:
        assert value == pytest.approx(step, rel=1e-4, abs=0.06)
    assert points[-1][0] > 4975


def test_what_an_earlier_trainer_left_is_not_news(trainer: Trainer) -> None:
    trainer.step(5)
    path = live_folder(trainer.run) / "progress.json"
    state = json.loads(path.read_text())
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for change in ({"process": dead.pid}, {"phase": "finished"}, {"phase": "stopped"}):
        path.write_text(json.dumps(state | change))
        watch = Watch(trainer.run.folder)
        watch.refresh()
        assert watch.about()["phase"] == "waiting" and not watch.has_ended
    # One that is killed while one looks on is said to have stopped.
    path.write_text(json.dumps(state | {"process": dead.pid, "time": time.time() + 9}))
    trainer.watch.refresh()
    assert trainer.watch.about()["phase"] == "stopped"


def test_a_damaged_avatar_is_an_error_that_the_next_one_mends(trainer: Trainer) -> None:
    trainer.step(1)
    trainer.step(2)
    view = View(0, "mesh", 64)
    assert trainer.watch.fluid(view).label == "train 2"
    live.live_avatar(trainer.run).unlink()  # It is mapped into memory.
    live.live_avatar(trainer.run).write_bytes(b"half")
    with pytest.raises(ValueError, match="damaged"):
        trainer.watch.fluid(view)
    trainer.step(3)
    assert trainer.watch.fluid(view).label == "train 3"


# --- the server -----------------------------------------------------------------------------------


@pytest.fixture
def without_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many pictures at the share of the cores that a page has would take minutes."""
    monkeypatch.setattr(view_server, "_SHARE", 100.0)


@pytest.fixture
def server(trainer: Trainer, tmp_path: Path) -> Iterator[ViewServer]:
    trainer.step(1, loss=0.5)
    trainer.step(2, loss=0.4)
    with serving(ViewServer(trainer.watch, guard_of("127.0.0.1", ""), 0, tmp_path)) as running:
        yield running


def test_the_page_and_what_it_asks_for(without_rests: None, server: ViewServer) -> None:
    status, page = ask(server.port, "/")
    assert status == 200 and b"training.js" in page
    assert ask(server.port, "/training.js")[0] == ask(server.port, "/page.css")[0] == 200
    assert json.loads(ask(server.port, "/training")[1])["step"] == 2
    assert json.loads(ask(server.port, "/curves")[1])["jobs"]["train"]["loss"] == [
        [1, 0.5],
        [2, 0.4],
    ]
    view = {"frame": 1, "size": 64}
    for path, stage, size in (("/frame", 0, 64), ("/picture", 0, 64), ("/picture", 1, 32)):
        content = {"client": "a", "order": 1, "stage": stage, "view": view}
        status, data = ask(server.port, path, content)
        assert status == 200 and Image.open(io.BytesIO(data)).size == (size, size)
    for path in ("/about", "/avatar", "/no"):
        assert ask(server.port, path)[0] == 404
    assert ask(server.port, "/avatar", {})[0] == 404


def test_strangers_are_refused(server: ViewServer, trainer: Trainer, tmp_path: Path) -> None:
    for path in ("/", "/training", "/curves", "/training.js"):
        assert ask(server.port, path, Host="evil.example")[0] == 403
        assert ask(server.port, path, Origin="http://evil.example")[0] == 403
    for path in ("/frame", "/picture"):
        content = {"client": "a", "view": {"size": 64}}
        assert ask(server.port, path, content, Host="evil.example")[0] == 403
        assert ask(server.port, path, content, Origin="null")[0] == 403
    guarded = ViewServer(trainer.watch, guard_of("127.0.0.1", "secret"), 0, tmp_path)
    with serving(guarded) as other:
        assert ask(other.port, "/training")[0] == 401
        assert ask(other.port, "/training?token=wrong")[0] == 401
        assert ask(other.port, "/training", Cookie=f"{other.guard.cookie}=secret")[0] == 200


@pytest.mark.usefixtures("without_rests")
def test_malformed_wishes_are_refused_and_many_clients_are_served(
    server: ViewServer, capfd: pytest.CaptureFixture[str]
) -> None:
    chance = random.Random(0)
    strange = [None, True, -1, 1e300, "x" * 300, [], {}, [[[]]], "NaN", 10**25, "../../x"]
    for _ in range(300):
        content: dict[str, Any] = {"client": "m", "order": 1, "stage": 0}
        content["view"] = {name: chance.choice(strange) for name in ("frame", "layer", "size")}
        content[chance.choice(["view", "stage", "order", "client", "x"])] = chance.choice(strange)
        status, data = ask(server.port, chance.choice(["/frame", "/picture"]), content)
        assert status in (200, 400), data
    assert capfd.readouterr().err == ""

    def look(client: int) -> list[int]:
        wish = {"client": f"c{client}", "order": 1, "view": {"frame": client % 3, "size": 64}}
        return [ask(server.port, path, wish)[0] for path in ("/frame", "/picture", "/picture")]

    with ThreadPoolExecutor(20) as pool:
        assert all(statuses == [200] * 3 for statuses in pool.map(look, range(20)))


def test_a_tab_closed_in_mid_frame_ends_its_picture(server: ViewServer) -> None:
    content = json.dumps({"client": "t", "order": 1, "stage": 2, "view": {"size": 512}}).encode()
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    connection.request("POST", "/picture", content, {"Content-Type": "application/json"})
    until(lambda: server.turns._running["field"] is not None)
    running = server.turns._running["field"]
    assert running is not None and not running.is_stale()
    connection.close()
    until(lambda: server.turns._running["field"] is not running)
    assert running.is_stale()
    assert ask(server.port, "/training")[0] == 200


def test_it_goes_over_to_the_avatar(
    server: ViewServer, trainer: Trainer, small_avatar: HandAvatar
) -> None:
    server.show(Studio(small_avatar, settings=FEW))
    assert b"page.js" in ask(server.port, "/")[1]
    assert ask(server.port, "/training")[0] == 404
    assert json.loads(ask(server.port, "/about")[1])["side"] == "right"
    content = {"client": "o", "order": 1, "stage": 0, "scene": {"size": 64}}
    assert ask(server.port, "/picture", content)[0] == 200


# --- beside a training ----------------------------------------------------------------------------


def test_options_of_the_page_are_refused_without_it_or_if_they_mean_nothing(
    tiny_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(tiny_capture), "--out", str(tmp_path / "run")]
    for more, why in (
        (["--port", "8000"], "--port: only with --view"),
        (["--token", "x"], "--token: only with --view"),
        (["--view", "--port", "70000"], "--port: found 70000"),
        (["--view", "--token", "a b"], "expected letters"),
    ):
        assert cli.main([*words, *more]) == 2
        assert why in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_page_that_dies_is_said_and_ends_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []

    def has_said(words: str) -> bool:
        said.append(capfd.readouterr().err)
        return words in "".join(said)

    with page_beside(PageOptions(tmp_path / "none", 0, "127.0.0.1", "")) as page:
        until(lambda: has_said("open http://127.0.0.1:"))
        port = int("".join(said).split("127.0.0.1:")[1].split("/")[0])
        assert json.loads(ask(port, "/training")[1])["phase"] == "waiting"
        priorities = []
        for thread in Path(f"/proc/{page._process.pid}/task").iterdir():
            with suppress(ProcessLookupError):  # One that answered has ended meanwhile.
                priorities.append(os.getpriority(os.PRIO_PROCESS, int(thread.name)))
        assert priorities.count(14) == 2
        os.kill(page._process.pid or 0, signal.SIGKILL)
        until(lambda: has_said("the page has ended (exit code -9)"))
        page.stay()  # There is nothing to wait for.
    with page_beside(PageOptions(tmp_path / "none", 0, "127.0.0.1", "")) as page:
        until(lambda: has_said("open http://127.0.0.1:"))
        process = page._process
    assert process.exitcode is not None
    assert "exit code 0" not in capfd.readouterr().err
