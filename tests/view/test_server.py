"""The server as a stranger meets it: over its socket."""

import contextlib
import errno
import http.client
import io
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from live import live_server, wave
from patience import PATIENCE, until
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import write_motion
from handavatar.view.connections import MOST_BYTES
from handavatar.view.guard import guard_of
from handavatar.view.limits import Connections
from handavatar.view.server import ViewServer, serving
from handavatar.view.studio import Studio

SCENE = {"size": 64}


@pytest.fixture(scope="module")
def server(
    small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ViewServer]:
    with live_server(small_avatar, tmp_path_factory.mktemp("view") / "edited") as running:
        yield running


def ask(
    server: ViewServer,
    path: str,
    content: Any = None,
    method: str = "",
    headers: dict[str, str] | None = None,
) -> tuple[int, bytes, dict[str, str]]:
    """One request on a connection of its own."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    try:
        body = None if content is None else json.dumps(content).encode()
        kind = {} if content is None else {"Content-Type": "application/json"}
        method = method or ("GET" if content is None else "POST")
        connection.request(method, path, body, kind | (headers or {}))
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def picture(server: ViewServer, client: str, order: int, stage: int = 0, **scene: Any) -> Any:
    content = {"client": client, "order": order, "stage": stage, "scene": SCENE | scene}
    status, data, _ = ask(server, "/picture", content)
    return np.asarray(Image.open(io.BytesIO(data))) if status == 200 else status


def raw(server: ViewServer, data: bytes, wait: float = 2.0) -> bytes:
    """Whatever comes back for whatever is sent; empty where the server hangs up or waits."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=wait) as connection:
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            return connection.recv(4096)
        except OSError:
            return b""


def assert_alive(server: ViewServer) -> None:
    assert picture(server, "alive", time.monotonic_ns() // 1000).shape == (64, 64, 3)


def test_the_page_comes_with_all_it_needs_and_loads_nothing_else(server: ViewServer) -> None:
    for path, kind in (("/", "html"), ("/page.js", "javascript"), ("/page.css", "css")):
        status, data, headers = ask(server, path)
        assert status == 200 and kind in headers["Content-Type"]
        assert b"://" not in data.replace(b"http://www.w3.org", b"")
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert headers["Cache-Control"] == "no-store"
    about = json.loads(ask(server, "/about")[1])
    assert about["motions"][0] == "wave" and len(about["angles"]) == 16
    assert len(about["joints"]) == 21 and "fist" in about["gestures"]


def test_pictures_of_every_stage(server: ViewServer) -> None:
    assert picture(server, "a", 1).shape == (64, 64, 3)
    assert picture(server, "a", 1, 1).shape == (32, 32, 3)
    assert picture(server, "a", 1, 2).shape == (64, 64, 3)
    moved = picture(server, "a", 2, orbit={"azimuth": 60})
    assert (moved != picture(server, "a", 2)).any()
    assert picture(server, "a", 1) == 204  # it has asked for something newer


def test_motions_and_their_poses(server: ViewServer) -> None:
    assert json.loads(ask(server, "/motion?name=wave")[1]) == {"fps": 10.0, "steps": 5}
    angles = json.loads(ask(server, "/angles?motion=wave&step=4")[1])["angles"]
    assert angles[1] != angles[13] == [0, 0, 0]
    for path in ("/motion?name=none", "/angles?motion=wave&step=5", "/angles?motion=wave&step=x"):
        assert ask(server, path)[0] == 400
    assert picture(server, "m", 1, moment={"motion": "wave", "step": 9}) == 400


def test_a_click_finds_an_anchor_or_nothing(server: ViewServer) -> None:
    where = {"client": "p", "order": 1, "scene": SCENE}
    assert json.loads(ask(server, "/pick", where | {"x": 0.0, "y": 0.0})[1]) == {"anchor": None}
    rows, columns = picture(server, "p", 1).max(-1).__gt__(60).nonzero()
    x, y = (columns[len(rows) // 2] + 0.5) / 64, (rows[len(rows) // 2] + 0.5) / 64
    anchor = json.loads(ask(server, "/pick", where | {"order": 2, "x": x, "y": y})[1])["anchor"]
    assert 0 <= anchor < 256
    stroke = {"anchor": anchor, "radius": 20, "color": [0, 0, 1]}
    painted = picture(server, "p", 2, touches={"strokes": [stroke]}, layer="albedo")
    assert (painted != picture(server, "p", 2, layer="albedo")).any()
    assert ask(server, "/pick", where | {"order": 3, "x": 2, "y": 0})[0] == 400


def test_an_edited_avatar_is_saved_and_nothing_is_replaced(server: ViewServer) -> None:
    touches = {"light_gain": 1.25, "lift_shadow": ["thumb"]}
    paths = [
        Path(json.loads(ask(server, "/avatar", {"touches": touches})[1])["path"]) for _ in range(2)
    ]
    assert paths[0] != paths[1] and all(path.parent == server.out for path in paths)
    assert HandAvatar.load(paths[1]).edit.lifted_bones == (13, 14, 15)
    # A page cannot say where.
    for name in ("path", "out"):
        assert ask(server, "/avatar", {"touches": touches | {name: "/tmp/x"}})[0] == 400
        assert ask(server, "/avatar", {"touches": touches, name: "/tmp/x"})[0] == 400


def test_a_video_of_a_motion(server: ViewServer) -> None:
    moving = {"scene": SCENE | {"moment": {"motion": "wave", "step": 0}}, "stage": 0}
    assert ask(server, "/film", {"scene": SCENE})[0] == 400
    status, data, _ = ask(server, "/film", moving)
    assert status == 200
    name = json.loads(data)["name"]

    def progress() -> dict[str, Any]:
        found: dict[str, Any] = json.loads(ask(server, f"/film?name={name}")[1])
        return found

    until(lambda: progress()["state"] != "running")
    assert progress() == {"state": "finished", "done": 5, "total": 5, "why": ""}
    status, data, headers = ask(server, f"/film.mp4?name={name}")
    assert status == 200 and headers["Content-Type"] == "video/mp4"
    with av.open(io.BytesIO(data)) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 5 and frames[0].shape == (64, 64, 3)
    assert np.abs(frames[0].astype(int) - frames[4]).max() > 20
    assert ask(server, "/film.mp4?name=other")[0] == 404


def test_a_video_can_be_stopped_and_too_many_are_sent_away(server: ViewServer) -> None:
    slow = {"scene": {"size": 512, "moment": {"motion": "gestures", "step": 0}}, "stage": 2}
    names = [json.loads(ask(server, "/film", slow)[1])["name"] for _ in range(2)]
    assert ask(server, "/film", slow)[0] == 503
    for name in names:
        assert ask(server, "/film/cancel", {"name": name})[0] == 200
        # Asked for again it would go on; who stops it no longer asks.
        film = server.films._films[name]
        until(lambda film=film: film.state != "running")
        assert film.state == "cancelled"
    assert ask(server, f"/film.mp4?name={names[0]}")[0] == 404
    assert_alive(server)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 403),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
    ],
)
def test_strangers_are_refused_everywhere(
    server: ViewServer, headers: dict[str, str], status: int
) -> None:
    for path in ("/", "/about", "/page.js", "/motion?name=wave", "/film.mp4?name=x", "/no"):
        assert ask(server, path, headers=headers)[0] == status
    for path in ("/picture", "/avatar", "/film", "/pick", "/no"):
        assert ask(server, path, {"client": "s", "scene": SCENE}, headers=headers)[0] == status


def test_without_the_token_nothing_is_served(small_avatar: HandAvatar, tmp_path: Path) -> None:
    guard = guard_of("127.0.0.1", "secret-1")
    with serving(ViewServer(Studio(small_avatar), guard, 0, tmp_path)) as server:
        for path in ("/", "/about", "/page.js"):
            status, data, headers = ask(server, path)
            assert status == 401 and b"token" in data and "Set-Cookie" not in headers
        assert ask(server, "/?token=secret-2")[0] == 401
        assert server.address.endswith("/?token=secret-1")
        status, _, headers = ask(server, "/?token=secret-1")
        assert status == 303 and headers["Location"] == "/"
        assert "HttpOnly; SameSite=Strict" in headers["Set-Cookie"]
        cookie = {"Cookie": headers["Set-Cookie"].partition(";")[0]}
        assert ask(server, "/about", headers=cookie)[0] == 200
        assert ask(server, "/picture", {"client": "t", "scene": SCENE}, headers=cookie)[0] == 200


def test_an_address_cannot_write_headers(server: ViewServer) -> None:
    _, data, headers = ask(server, "/?token=x%0d%0aX-Evil:%20yes")
    assert "X-Evil" not in headers and b"Evil" not in data


def _malformed(chance: random.Random, port: int) -> bytes:
    """A request that is wrong somewhere: in its bytes, its head, its JSON or its numbers."""
    strange = [None, True, -1, 1e300, "x" * 300, [], {}, [[[]]], "NaN", 10**25, "\x00", "../../x"]
    kind = chance.randrange(6)
    if kind == 0:
        return chance.randbytes(chance.randrange(1, 300))
    body = b"{" * chance.randrange(3000) if kind == 1 else chance.randbytes(chance.randrange(200))
    if kind >= 2:
        scene = {
            name: chance.choice(strange)
            for name in ("moment", "angles", "turn", "orbit", "layer", "size", "touches", "x")
            if chance.random() < 0.4
        }
        content = {
            "client": chance.choice(["m", *strange]),
            "order": chance.choice([1, *strange]),
            "stage": chance.choice([0, 1, 2, *strange]),
            "scene": chance.choice([scene, scene, *strange]),
        }
        # The last guard against a valid one: a scene that names what there is not.
        if content["scene"] == {} or content["scene"] is scene:
            content["scene"] = scene | {"unknown": 1}
        body = json.dumps(content).encode()
    length = str(len(body)).encode()
    if kind == 3:
        length = chance.choice([b"-1", b"x", b"99999999999", b"", b"1e3", length + b", 5"])
    path = chance.choice([b"/picture", b"/pick", b"/avatar", b"/film", b"/../etc/passwd", b"/%00"])
    method = chance.choice([b"POST", b"POST", b"POST", b"GET", b"PUT", b"BREW", b""])
    head = [method + b" " + path + b" HTTP/1.1", b"Host: 127.0.0.1:" + str(port).encode()]
    head += [b"Content-Type: application/json", b"Content-Length: " + length]
    if kind == 4:
        head.insert(chance.randrange(len(head)), chance.randbytes(chance.randrange(60)))
        body = body[: len(body) // 2]
    if kind == 5:
        head += [b"X-%d: y" % n for n in range(chance.choice([3, 200]))]
    return b"\r\n".join(head) + b"\r\n\r\n" + body


@pytest.mark.slow
def test_ten_thousand_malformed_messages_change_nothing(
    server: ViewServer, capfd: pytest.CaptureFixture[str]
) -> None:
    before = picture(server, "before", 1)
    files = sorted(server.out.glob("*")) if server.out.exists() else []
    capfd.readouterr()

    def send(part: int) -> set[bytes]:
        chance = random.Random(part)
        return {raw(server, _malformed(chance, server.port))[9:12] for _ in range(1250)}

    with ThreadPoolExecutor(8) as pool:
        statuses = set().union(*pool.map(send, range(8)))
    # Refused, or cut off; what was not understood at all is answered in an older manner.
    known = {b"", b"400", b"403", b"404", b"411", b"413", b"414", b"415", b"431", b"501", b"505"}
    assert {status for status in statuses if status.isdigit() or not status} <= known
    assert b"400" in statuses and b"411" in statuses
    assert (picture(server, "before", 2) == before).all()
    assert files == (sorted(server.out.glob("*")) if server.out.exists() else [])
    captured = capfd.readouterr()
    assert captured.err == "" and captured.out == ""


def test_bodies_that_are_too_long_or_of_no_length_are_not_read(server: ViewServer) -> None:
    head = f"POST /picture HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n".encode()
    head += b"Content-Type: application/json\r\n"
    assert b" 413 " in raw(server, head + b"Content-Length: %d\r\n\r\n" % (MOST_BYTES + 1))
    assert b" 411 " in raw(server, head + b"\r\n{}")
    chunked = b"Transfer-Encoding: chunked\r\nContent-Length: 2\r\n\r\n{}"
    assert b" 411 " in raw(server, head + chunked)
    assert raw(server, head + b"Content-Length: 500\r\n\r\n{}") == b""  # it hung up half way
    assert_alive(server)


@pytest.mark.slow
def test_fifty_clients_at_once_each_see_their_own(server: ViewServer) -> None:
    alone = [picture(server, "one", n + 1, orbit={"azimuth": 7 * n}) for n in range(50)]

    def look(client: int) -> bool:
        seen = [
            picture(server, f"c{client}", order, orbit={"azimuth": 7 * client})
            for order in (1, 2, 3)
        ]
        return all((one == alone[client]).all() for one in seen)

    with ThreadPoolExecutor(50) as pool:
        assert all(pool.map(look, range(50)))
    assert_alive(server)


def test_two_hundred_idle_and_dripping_connections_harm_nobody(
    server: ViewServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port), timeout=5) for _ in range(200)]
    for number, connection in enumerate(idle):
        with contextlib.suppress(OSError):  # of those that had to make room already
            connection.sendall(b"GET / HTTP/1.1\r\n"[: number % 16])
    for _ in range(3):
        assert_alive(server)
    connections = server._http.connections
    assert len(connections._waiting) <= connections.limits.waiting
    # As if the time for a head had passed, in which a byte came now and then.
    later = Connections(connections.limits, lambda: time.monotonic() + 11)
    monkeypatch.setattr(connections, "_clock", later._clock)
    until(lambda: not connections._waiting)
    monkeypatch.undo()
    assert_alive(server)
    for connection in idle:
        with contextlib.suppress(ConnectionError):
            assert connection.recv(1) == b"", "the server has hung up"
        connection.close()


def test_a_body_that_drips_is_cut_off(server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> None:
    head = f"POST /picture HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n".encode()
    head += b"Content-Type: application/json\r\nContent-Length: 50\r\n\r\n{"
    connections = server._http.connections
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        connection.sendall(head)
        until(lambda: bool(connections._served))
        monkeypatch.setattr(connections, "_clock", lambda: time.monotonic() + 22)
        assert connection.recv(1) == b""
        until(lambda: not connections._served)
    monkeypatch.undo()
    assert_alive(server)


def test_places_are_for_those_who_were_let_in(small_avatar: HandAvatar, tmp_path: Path) -> None:
    """Strangers without the token take none, however many there are."""
    with live_server(small_avatar, tmp_path, token="secret") as closed:
        connections = closed._http.connections
        taken = []
        real = connections.place

        def noted(connection: socket.socket) -> Any:
            taken.append(connection)
            return real(connection)

        connections.place = noted  # type: ignore[method-assign]
        assert ask(closed, "/page.js")[0] == 401 and not taken
        assert ask(closed, "/page.js?token=secret")[0] == 200 and len(taken) == 1


def test_a_tab_closed_in_mid_frame_ends_its_picture(server: ViewServer) -> None:
    content = json.dumps({"client": "tab", "order": 1, "stage": 2, "scene": {"size": 512}})
    head = (
        f"POST /picture HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(content)}\r\n\r\n"
    )
    connection = socket.create_connection(("127.0.0.1", server.port))
    connection.sendall((head + content).encode())
    until(lambda: server.turns._running["field"] is not None)
    running = server.turns._running["field"]
    assert running is not None and not running.is_stale()
    connection.close()
    until(lambda: server.turns._running["field"] is not running)
    assert running.is_stale()
    assert_alive(server)


def test_dragging_ends_the_picture_in_full_that_is_being_made(server: ViewServer) -> None:
    done: list[Any] = []
    thread = threading.Thread(target=lambda: done.append(picture(server, "drag", 1, 2, size=512)))
    thread.start()
    until(lambda: server.turns._running["field"] is not None)
    for order in range(2, 12):
        assert picture(server, "drag", order, orbit={"azimuth": order}).shape == (64, 64, 3)
    thread.join(PATIENCE)
    assert done == [204]


def test_a_failure_of_ours_is_told_and_the_server_goes_on(
    server: ViewServer, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for error, said in (
        (KeyError("of ours"), "KeyError: 'of ours'"),
        (MemoryError("as much as there is"), "out of memory (as much as there is)"),
        (OSError(errno.ENOSPC, "No space left on device", "/d"), "/d: No space left on device"),
    ):

        def broken(*_: Any, error: Exception = error) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(Studio, "fluid", broken)
            content = {"client": "x", "order": 1, "scene": SCENE}
            status, data, _ = ask(server, "/picture", content)
        assert status == 500 and json.loads(data)["error"].startswith(said)
        assert f"view: {said}" in capfd.readouterr().err
    assert_alive(server)


@pytest.mark.slow
def test_the_command_serves_tries_the_next_port_and_ends(
    small_avatar: HandAvatar, tmp_path: Path
) -> None:
    small_avatar.save(tmp_path / "avatar.safetensors")
    write_motion(tmp_path / "my wave.json", wave())
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        words = ["view", str(tmp_path / "avatar.safetensors"), "--port", str(port)]
        words += ["--motion", str(tmp_path / "my wave.json")]
        process = subprocess.Popen(
            [sys.executable, "-m", "handavatar", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        try:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(3)]
            address = lines[0].split()[1]
            assert address.startswith("http://127.0.0.1:") and f":{port}/" not in address
            found = int(address.rstrip("/").rpartition(":")[2])
            assert f"ssh -L {found}:127.0.0.1:{found} " in lines[1]
            connection = http.client.HTTPConnection("127.0.0.1", found, timeout=PATIENCE)
            connection.request("GET", "/about")
            assert "my wave" in json.loads(connection.getresponse().read())["motions"]
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
        assert process.returncode == 0
        assert f"port {port} is taken" in errors and "Traceback" not in errors
