"""The webcam's server as its page, and as strangers, meet it: over its socket."""

import base64
import http.client
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from patience import PATIENCE
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.cli import main
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import axis_angle_from_matrix, invert_rigid
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rigs import load_rig
from handavatar.synthetic.truth import FilmTruth
from handavatar.tracker.model import shipped_tracker
from handavatar.view import recording
from handavatar.view.connections import MOST_CAMERA_BYTES, MOST_PIECE_BYTES
from handavatar.view.driven import DrivenAvatar
from handavatar.view.guard import guard_of
from handavatar.view.recording import RecordingFile
from handavatar.view.scene import SceneError
from handavatar.view.server import serving
from handavatar.view.webcam import WebcamServer
from handavatar.view.webcam_answers import WebcamAnswers
from handavatar.webcam.posing import LivePose
from handavatar.webcam.session import LiveSession

UPRIGHT = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "captures"


@pytest.fixture
def server(folder: Path) -> Iterator[WebcamServer]:
    """One that records; nobody has it yet."""
    session = LiveSession(load_rig("open-hand").shaped())
    answers = WebcamAnswers(session, None, RecordingFile(folder / "mine"), 60.0)
    with serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as running:
        yield running


def send(
    port: int, path: str, body: bytes | dict[str, Any] | None, kind: str = "application/json"
) -> tuple[int, Any]:
    """One request on a connection of its own: the status, and the JSON or bytes that came."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    try:
        data = json.dumps(body).encode() if isinstance(body, dict) else body
        headers = {} if body is None else {"Content-Type": kind}
        connection.request("GET" if body is None else "POST", path, data, headers)
        answer = connection.getresponse()
        content = answer.read()
        is_json = "json" in answer.headers.get("Content-Type", "")
        return answer.status, json.loads(content) if is_json else content
    finally:
        connection.close()


def refused(port: int, path: str, kind: str, length: int) -> int:
    """The status of a request that says how long its body is, and waits before it sends it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    try:
        connection.request(
            "POST", path, headers={"Content-Type": kind, "Content-Length": str(length)}
        )
        return connection.getresponse().status
    finally:
        connection.close()


def jpeg(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


def look(
    server: WebcamServer, image: np.ndarray, order: int, client: str = "me"
) -> tuple[int, Any]:
    query = f"client={client}&order={order}&time={order / 10:.3f}"
    return send(server.port, f"/look?{query}", jpeg(image), "image/jpeg")


def piece(server: WebcamServer, at: int, data: bytes, client: str = "me") -> tuple[int, Any]:
    return send(server.port, f"/recording?client={client}&at={at}", data, "video/webm")


def post(server: WebcamServer, path: str, **content: Any) -> tuple[int, Any]:
    return send(server.port, path, {"client": "me", **content})


def test_a_posted_picture_is_answered_with_the_hand(
    server: WebcamServer, hand_film: FilmTruth, hand_pictures: list[np.ndarray]
) -> None:
    for order in range(0, 24, 2):
        status, told = look(server, hand_pictures[0], order)
        assert status == 200
    tracked = shipped_tracker().points.positions(hand_film.rest_hand, hand_film.pose(0))
    focal, center = hand_film.camera.focal[0], torch.tensor(hand_film.camera.center)
    wanted = tracked[:, :2] / tracked[:, 2:] * focal + center
    apart = np.array(told["landmarks"]) - wanted[:NUM_LANDMARKS].numpy()
    assert np.linalg.norm(apart, axis=-1).mean() < 0.06 * hand_film.camera.height
    assert told["side"] == "right" and told["warnings"] == [] and told["avatar"] is None
    assert told["steps"]["palm"] == 1 and "back" in told["instruction"]
    status, dark = look(server, (hand_pictures[0] * 0.2).astype(np.uint8), 24)
    assert [warning["kind"] for warning in dark["warnings"]] == ["dark"]
    assert "light" in dark["warnings"][0]["remedy"]
    status, data = send(server.port, "/map", None)
    drawn = np.asarray(Image.open(io.BytesIO(data))).astype(int)
    is_green = drawn[..., 1] > drawn[..., 0] + 30
    # Four views in a row: the palm is green, the back is not.
    assert is_green[:, :150].sum() > 1000 and is_green[:, 150:300].sum() < 200


def test_the_page_and_what_it_needs_to_know(server: WebcamServer) -> None:
    status, page = send(server.port, "/", None)
    assert status == 200 and b"webcam.js" in page
    assert send(server.port, "/webcam.js", None)[0] == 200
    status, about = send(server.port, "/about", None)
    assert about["records"] and not about["drives"] and len(about["steps"]) == 6
    assert about["longest"] == 60 and about["most_piece_bytes"] == MOST_PIECE_BYTES
    for path in ("/angles", "/film", "/nothing"):
        assert send(server.port, path, None)[0] == 404
    assert post(server, "/picture")[0] == 404


def test_pictures_that_are_none_are_refused(
    server: WebcamServer, hand_pictures: list[np.ndarray]
) -> None:
    good = jpeg(hand_pictures[0])
    query = "/look?client=me&order=1&time=0.1"

    def status(path: str, body: bytes, kind: str = "image/jpeg") -> int:
        return send(server.port, path, body, kind)[0]

    assert status(query, b"no picture") == 400
    assert status(query, good[: len(good) // 2]) == 400
    buffer = io.BytesIO()
    Image.fromarray(hand_pictures[0]).save(buffer, "PNG")
    assert status(query, buffer.getvalue()) == 400
    assert status(query, jpeg(np.zeros((1500, 1500, 3), np.uint8))) == 400
    assert refused(server.port, query, "image/jpeg", MOST_CAMERA_BYTES + 1) == 413
    for kind in ("image/png", "application/json", "text/plain", "application/octet-stream"):
        assert status(query, good, kind) == 415
    for wrong in ("/look", "/look?client=me", "/look?client=me&order=x&time=1"):
        assert status(wrong, good) == 400
    assert status("/look?client=me&order=1&time=nan", good) == 400
    assert status("/look?" + "&".join(f"a{n}=1" for n in range(20)), good) == 400
    assert status("/look?client=&order=1&time=1", good) == 400
    assert status(query, good) == 200


def test_an_older_picture_is_dropped_and_a_second_page_waits(
    server: WebcamServer, hand_pictures: list[np.ndarray]
) -> None:
    assert look(server, hand_pictures[0], 5)[0] == 200
    assert look(server, hand_pictures[0], 5)[0] == 204
    status, told = look(server, hand_pictures[0], 1, "another")
    assert status == 409 and "another page" in told["error"]
    server.answers._last -= 10  # as if it had been closed a while ago
    assert look(server, hand_pictures[0], 1, "another")[0] == 200


def test_a_recording_is_at_its_place_when_it_is_whole(server: WebcamServer, folder: Path) -> None:
    content = np.random.default_rng(0).bytes(100_000)
    for expected in ("mine.webm", "mine-2.webm"):
        assert post(server, "/recording/begin", kind="video/webm")[0] == 200
        assert piece(server, 0, content[:60_000]) == (200, {"bytes": 60_000})
        there = {path.name for path in folder.iterdir() if not path.name.startswith(".tmp-")}
        assert expected not in there
        assert piece(server, 60_000, content[60_000:])[0] == 200
        status, told = post(server, "/recording/end", bytes=len(content))
        assert status == 200 and told["path"] == str(folder / expected)
        assert server.answers.recorded == folder / expected
        assert (folder / expected).read_bytes() == content
    assert len(list(folder.iterdir())) == 2


def test_what_is_not_whole_is_refused_and_removed(server: WebcamServer, folder: Path) -> None:
    assert piece(server, 0, b"x")[0] == 400  # nothing was begun
    assert post(server, "/recording/end", bytes=1)[0] == 400
    assert post(server, "/recording/begin", kind="text/html")[0] == 400
    assert post(server, "/recording/begin", kind="video/webm", name="../x")[0] == 400
    assert not folder.exists()
    assert post(server, "/recording/begin", kind="video/mp4")[0] == 200
    assert piece(server, 0, b"abc")[0] == 200
    status, told = piece(server, 9, b"abc")
    assert status == 400 and "a piece is missing" in told["error"]
    assert send(server.port, "/recording?client=me&at=3", b"x", "text/plain")[0] == 415
    query = "/recording?client=me&at=3"
    assert refused(server.port, query, "video/webm", MOST_PIECE_BYTES + 1) == 413
    status, told = post(server, "/recording/end", bytes=4)
    assert status == 400 and "3 have come of 4" in told["error"]
    assert list(folder.iterdir()) == []
    assert post(server, "/recording/begin", kind="video/mp4")[0] == 200
    assert post(server, "/recording/drop")[0] == 200
    assert list(folder.iterdir()) == []
    assert server.answers.recorded is None
    assert send(server.port, "/recording/begin", {"client": "other", "kind": "video/mp4"})[0] == 409


def test_a_recording_has_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "MOST_BYTES", 10)
    file = RecordingFile(tmp_path / "mine")
    file.begin("video/webm")
    file.add(0, bytes(10))
    with pytest.raises(SceneError, match="at most 10 bytes"):
        file.add(10, b"x")
    assert file.finish(10) == tmp_path / "mine.webm"


def test_closing_removes_what_was_begun(folder: Path) -> None:
    session = LiveSession(load_rig("open-hand").shaped())
    answers = WebcamAnswers(session, None, RecordingFile(folder / "mine"), 60.0)
    with serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as running:
        post(running, "/recording/begin", kind="video/webm")
        piece(running, 0, b"abc")
        assert len(list(folder.iterdir())) == 1
    assert list(folder.iterdir()) == []


def test_the_token_is_asked_for(hand_pictures: list[np.ndarray], folder: Path) -> None:
    session = LiveSession(load_rig("open-hand").shaped())
    answers = WebcamAnswers(session, None, None, 60.0)
    with serving(WebcamServer(answers, guard_of("127.0.0.1", "secret"), 0)) as running:
        assert look(running, hand_pictures[0], 1)[0] == 401
        query = "/look?client=me&order=1&time=0.1&token=secret"
        body = jpeg(hand_pictures[0])
        assert send(running.port, query, body, "image/jpeg")[0] == 200
        # It records nothing.
        begin = {"client": "me", "kind": "video/webm"}
        assert send(running.port, "/recording/begin?token=secret", begin)[0] == 404


@pytest.fixture(scope="module")
def driven(small_avatar: HandAvatar) -> DrivenAvatar:
    return DrivenAvatar(small_avatar)


def live_pose(driven: DrivenAvatar, shift: float = 0.0) -> LivePose:
    rotations = gesture_rotations(driven.hand.rig, "spread").clone()
    rotations[0] = axis_angle_from_matrix(UPRIGHT)
    camera = Camera((320.0, 320.0), (160.0, 120.0), 320, 240, torch.eye(4))
    return LivePose(driven.hand, HandPose(rotations, torch.tensor([shift, 0.06, 0.4])), camera, 0.0)


def test_the_avatar_is_where_the_hand_is(driven: DrivenAvatar) -> None:
    for shift in (-0.05, 0.05):
        live = live_pose(driven, shift)
        picture = driven.picture(live, False)
        assert picture.shape == (240, 320, 3)
        columns = np.nonzero(picture.any(-1).any(0))[0]
        vertices = driven.hand.posed(live.pose).vertices
        seen = vertices[:, 0] / vertices[:, 2] * 320 + 160
        assert abs(columns.min() - float(seen.min())) < 4
        assert abs(columns.max() - float(seen.max())) < 4
    assert driven.picture(live_pose(driven), False, 64).shape == (48, 64, 3)


def test_a_left_hand_drives_it_mirrored(driven: DrivenAvatar, small_avatar: HandAvatar) -> None:
    """The pose is of the right hand in the mirror, and so is the picture before it is turned."""
    live = live_pose(driven, 0.03)
    # Both are the first pictures of an avatar: later ones may have the light of one before.
    right, left = (DrivenAvatar(small_avatar).picture(live, is_left) for is_left in (False, True))
    assert (left == right[:, ::-1]).all() and not (left == right).all()


def test_a_pose_in_the_world_is_seen_at_the_same_place(driven: DrivenAvatar) -> None:
    view = torch.eye(4)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)))[0]
    view[:3, :3] = turn * torch.linalg.det(turn)
    view[:3, 3] = torch.tensor([0.1, -0.2, 0.5])
    pose = live_pose(driven).pose
    moved = pose.moved_to(invert_rigid(view), driven.hand.rest_joints[0])
    world = driven.hand.posed(moved).vertices
    seen = world @ view[:3, :3].T + view[:3, 3]
    torch.testing.assert_close(seen, driven.hand.posed(pose).vertices, atol=1e-5, rtol=0)


def test_an_answer_carries_the_avatars_picture(
    driven: DrivenAvatar, hand_pictures: list[np.ndarray]
) -> None:
    answers = WebcamAnswers(LiveSession(driven.hand), driven, None, 60.0)
    with serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as running:
        for order in range(6):
            status, told = look(running, hand_pictures[0], order)
        assert status == 200 and set(told["milliseconds"]) == {"see", "draw"}
        drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(told["avatar"]))))
        assert drawn.shape == (240, 320, 3)
        x, y = np.array(told["landmarks"]).astype(int).T
        # Joints lie inside the hand; around it the picture is black.
        assert (drawn[y, x].max(-1) > 20).mean() > 0.8 and (drawn.max(-1) > 20).mean() < 0.4
        assert send(running.port, "/about", None)[1]["at_once"] == 2


def started(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "handavatar", "capture", "webcam", "--port", "0", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


@pytest.mark.slow
def test_interrupted_the_command_leaves_nothing(tmp_path: Path) -> None:
    process = started("--out", str(tmp_path / "mine"))
    try:
        assert process.stdout is not None
        port = int(process.stdout.readline().split()[1].rstrip("/").rpartition(":")[2])
        begin = {"client": "me", "kind": "video/webm"}
        assert send(port, "/recording/begin", begin)[0] == 200
        assert send(port, "/recording?client=me&at=0", b"abc", "video/webm")[0] == 200
        assert len(list(tmp_path.iterdir())) == 1
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "nothing was recorded, nothing was written" in errors and "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_is_said_before_the_page_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("dear diary")
    for words, why in (
        (("--out", str(tmp_path / "mine")), "mine"),
        ((), "--out"),
        (("--out", str(tmp_path / "new"), "--fps", "0"), "--fps"),
        (("--drive", str(tmp_path / "no_run")), "no_run"),
    ):
        assert main(["capture", "webcam", *words]) in (2, 3)
        said = capsys.readouterr()
        assert "open http" not in said.out
        assert why in said.err and "mistake in handavatar" not in said.err
    assert (tmp_path / "mine" / "diary.txt").read_text() == "dear diary"
