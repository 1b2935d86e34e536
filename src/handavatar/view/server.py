"""``handavatar view``: an HTTP server of its own, for a page of its own; nothing else is loaded.

Of no viewer library, because none checks who asks; docs/viewer.md says more. A page sends its whole
scene with every wish for a picture, so the server keeps nothing of a client but its newest order.
"""

import errno
import json
import os
import select
import signal
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import torch

from handavatar.avatar import HandAvatar, RenderSettings, chosen_device
from handavatar.capture.motion import MOTIONS, Motion, read_motion
from handavatar.field.kernels import Kernel, chosen_kernel
from handavatar.view.films import FilmOrder, Films
from handavatar.view.guard import Guard, Refused, guard_of, is_loopback
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
from handavatar.view.studio import STAGES, Interrupted, Studio, encoded
from handavatar.view.turns import Busy, Job, Overtaken, Turns

MOST_BYTES = 64 * 1024
"""Of a request's body."""
MOST_CONNECTIONS = 160
MOST_WAITING = 64
"""Clients whose picture has not been begun; more are asked to try again."""
MOST_PORTS = 20
"""Ports that are tried, from the one that is asked for."""
_TIMEOUT = 20.0
_STOPPING = (signal.SIGINT, signal.SIGTERM)
_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True)
class ViewOptions:
    """Shows an avatar in the browser: pose it, light it, paint it, save it.

    Attributes:
        run: run folder, or an avatar file; it stays as it is.
        port: of the page; if it is taken, the next free one.
        host: where to listen. Beyond this machine a token is needed; without ``token`` one is made.
        token: letters, digits, - and _; who does not know it is not served.
        motion: motion files for the timeline, besides the built-in motions.
        out: folder for avatars saved from the page; they get names that are free.
        device: where the fields run.
        kernel: what decodes pairs of parts, as for ``handavatar render``.
    """

    run: Path
    port: int = 7007
    host: str = "127.0.0.1"
    token: str = ""
    motion: tuple[Path, ...] = ()
    out: Path = Path("edited")
    device: str = "auto"
    kernel: Kernel = "auto"


class ViewServer:
    """The page, and what it asks for."""

    def __init__(self, studio: Studio, guard: Guard, port: int, out: Path) -> None:
        """Binds the port; :meth:`serve` answers.

        Args:
            studio: makes the pictures.
            guard: who is let in, and where to listen.
            port: the first to try; 0 is any.
            out: folder for saved avatars.

        Raises:
            OSError: if no port is free, or there is no such host.
        """
        self._http = _bound(guard.host, port)
        self.port: int = self._http.server_address[1]
        self.guard = replace(guard, cookie=f"{guard.cookie}-{self.port}")
        # One core for what must be there at once: torch's threads are of no use to it, and it would
        # wait for the field's pieces. Torch would give the other lane the number last set.
        cores = torch.get_num_threads()
        self.turns = Turns(
            {
                "fluid": lambda: torch.set_num_threads(1),
                "field": lambda: torch.set_num_threads(cores),
            },
            MOST_WAITING,
        )
        self.films = Films(studio, self.turns)
        self.out = out
        self._http.answers = Answers(studio, self.turns, self.films, self.guard, out)

    @property
    def address(self) -> str:
        """What to open in a browser, the token included."""
        host = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
            self.guard.host, self.guard.host
        )
        host = f"[{host}]" if ":" in host else host
        query = f"?token={self.guard.token}" if self.guard.token else ""
        return f"http://{host}:{self.port}/{query}"

    def serve(self) -> None:
        """Answers until :meth:`close` is called from another thread."""
        self._http.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stops answering, drops what is being made, frees the port."""
        self._http.shutdown()
        self._http.server_close()
        self._http.hang_up()
        self.films.close()
        self.turns.close()


@contextmanager
def serving(server: ViewServer) -> Iterator[ViewServer]:
    """A server that answers, from a thread of its own, as long as the block lasts."""
    thread = threading.Thread(target=server.serve, name="view", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.close()
        thread.join()


def view(options: ViewOptions) -> None:
    """Serves until SIGINT or SIGTERM; for the main thread.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if a motion cannot be read.
        ValueError: for a port or token that cannot be.
        OSError: if no port is free, or there is no such host.
    """
    if not 0 <= options.port < 65536:
        raise ValueError(f"--port {options.port}: expected 0 to 65535")
    guard = guard_of(options.host, options.token)
    device = chosen_device(options.device)
    settings = RenderSettings(kernel=chosen_kernel(options.kernel, str(device)))
    motions = _named(options.motion)
    avatar = HandAvatar.load(options.run).moved_to(device)
    server = ViewServer(Studio(avatar, motions, settings), guard, options.port, options.out)
    if server.port != options.port and options.port:
        print(f"port {options.port} is taken; this is {server.port}", file=sys.stderr)
    if not is_loopback(guard.host):
        print(
            f"warning: {guard.host} is not loopback: whoever knows the token below can watch, "
            "edit, and save avatars here, and all is sent unencrypted",
            file=sys.stderr,
        )
    print(f"open {server.address}", flush=True)
    if is_loopback(guard.host):
        user = os.environ.get("USER", "you")
        print(
            f"from elsewhere: ssh -L {server.port}:127.0.0.1:{server.port} "
            f"{user}@{socket.gethostname()}, then open it there",
            flush=True,
        )
    is_stopped: list[int] = []
    before = [signal.signal(kind, lambda *_: is_stopped.append(1)) for kind in _STOPPING]
    try:
        with serving(server):
            print("Ctrl-C ends it", flush=True)
            # An exception out of a signal can be lost wherever Python swallows exceptions.
            while not is_stopped:
                time.sleep(0.1)
    finally:
        for kind, handler in zip(_STOPPING, before, strict=True):
            signal.signal(kind, handler)


@dataclass(frozen=True)
class Answer:
    """What a request gets.

    Attributes:
        data: the body.
        kind: its media type.
        headers: besides those that all have.
        status: of HTTP.
    """

    data: bytes
    kind: str = "application/json"
    headers: tuple[tuple[str, str], ...] = ()
    status: int = 200


class Answers:
    """From a request that was let in to its answer."""

    def __init__(self, studio: Studio, turns: Turns, films: Films, guard: Guard, out: Path) -> None:
        """Joins the parts."""
        self.guard = guard
        self._studio = studio
        self._turns = turns
        self._films = films
        self._out = out
        self._saving = threading.Lock()

    def get(self, target: str) -> Answer:
        """Answers a GET request.

        Raises:
            Refused: 404 for what there is not.
            SceneError: for a query that means nothing.
        """
        try:
            parts = urlsplit(target)
            given = parse_qs(parts.query, max_num_fields=8)
        except ValueError as error:
            raise SceneError("this address means nothing") from error
        query = {name: values[0] for name, values in given.items()}
        if parts.path == "/" and "token" in query:
            # From the address into a cookie, out of sight and out of the browser's history.
            cookie = f"{self.guard.cookie}={self.guard.token}; HttpOnly; SameSite=Strict; Path=/"
            return Answer(b"", headers=(("Location", "/"), ("Set-Cookie", cookie)), status=303)
        if parts.path in _PAGE:
            name, kind = _PAGE[parts.path]
            page = resources.files("handavatar.view") / "page" / name
            return Answer(page.read_bytes(), kind)
        if parts.path == "/about":
            return _json(self._studio.about())
        if parts.path == "/motion":
            motion = self._studio.motion(query.get("name", ""))
            return _json({"fps": motion.fps, "steps": len(motion)})
        if parts.path == "/angles":
            step = int(query["step"]) if query.get("step", "")[:7].isdecimal() else -1
            moment = Moment(query.get("motion", ""), whole(step, "step", 0, MOST_STEPS))
            return _json({"angles": self._studio.angles(moment)})
        if parts.path == "/film":
            progress = self._films.progress(query.get("name", ""))
            if progress is not None:
                return _json(progress)
        if parts.path == "/film.mp4":
            film = self._films.file(query.get("name", ""))
            if film is not None:
                return Answer(film, "video/mp4")
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
        known = {
            "/picture": self._picture,
            "/pick": self._pick,
            "/avatar": self._avatar,
            "/film": self._film,
            "/film/cancel": self._cancel_film,
        }
        if path not in known:
            raise Refused(404, "there is no such thing")
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
        job = self._turns.submit(lane, _client(content), _order(content), work)
        kind = "image/png" if stage == STAGES[-1] else "image/jpeg"
        return Answer(_waited(job, is_gone), kind)

    def _pick(self, content: dict[str, Any], is_gone: Callable[[], bool]) -> Answer:
        fields(content, "pick", ("client", "order", "scene", "x", "y"))
        scene = read_scene(content.get("scene", {}))
        x, y = (number(content.get(name), name, 0.0, 1.0) for name in ("x", "y"))
        self._studio.shot(scene)
        client = f"pick {_client(content)}"
        job = self._turns.submit(
            "fluid", client, _order(content), lambda _: self._studio.nearest_anchor(scene, x, y)
        )
        return _json({"anchor": _waited(job, is_gone)})

    def _avatar(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        fields(content, "avatar", ("touches",))
        with self._saving:
            path = self._studio.save(read_touches(content.get("touches", {})), self._out)
        return _json({"path": str(path)})

    def _film(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        fields(content, "film", ("scene", "stage", "every"))
        scene = read_scene(content.get("scene", {}))
        if scene.moment is None:
            raise SceneError("a video needs a motion: choose one")
        stage = STAGES[whole(content.get("stage", 0), "stage", 0, len(STAGES) - 1)]
        every = whole(content.get("every", 1), "every", 1, 1000)
        return _json({"name": self._films.start(FilmOrder(scene, stage, every))})

    def _cancel_film(self, content: dict[str, Any], _: Callable[[], bool]) -> Answer:
        self._films.cancel(str(content.get("name", ""))[:64])
        return _json({})


class _Http(ThreadingHTTPServer):
    """Bounded in its connections, and silent about clients that hang up."""

    daemon_threads = True
    request_queue_size = 128
    answers: Answers

    def __init__(self, address: tuple[str, int]) -> None:
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self._open: set[socket.socket] = set()
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """As its parent, without asking a name server what this machine is called."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            self._open.add(request)
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._open.discard(request)
            self._free.release()

    def hang_up(self) -> None:
        """Ends the connections that are open; what waits for an answer gets none."""
        for connection in list(self._open):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that broke; what a request asked for never ends here."""


class _Http6(_Http):
    address_family = socket.AF_INET6


class _Handler(BaseHTTPRequestHandler):
    """One connection, with a thread of its own."""

    protocol_version = "HTTP/1.1"
    server_version = "handavatar"
    sys_version = ""
    timeout = _TIMEOUT
    error_message_format = "%(code)d %(message)s\n"
    error_content_type = "text/plain"
    # Without it small answers wait for the other side's acknowledgement.
    disable_nagle_algorithm = True
    server: _Http

    def do_GET(self) -> None:
        self._answer(lambda: self.server.answers.get(self.path))

    def do_POST(self) -> None:
        self._answer(self._posted)

    def _answer(self, make: Callable[[], Answer]) -> None:
        try:
            self.server.answers.guard.check(self.command, self.path, self.headers)
            answer = make()
        except Refused as error:
            answer = self._failure(error.status, str(error))
        except SceneError as error:
            answer = self._failure(400, str(error))
        except (Overtaken, Interrupted):
            answer = Answer(b"", status=204)
        except Busy:
            answer = self._failure(503, "too many ask at once: try again")
        except (ConnectionError, TimeoutError):
            self.close_connection = True
            return
        except Exception as error:  # one answer fails, the server goes on
            print(f"view: {type(error).__name__}: {str(error)[:200]}", file=sys.stderr)
            answer = self._failure(500, f"{type(error).__name__}: {str(error)[:200]}")
        self._send(answer)

    def _posted(self) -> Answer:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or len(length) > 9 or "Transfer-Encoding" in self.headers:
            raise Refused(411, "say how long the body is")
        if int(length) > MOST_BYTES:
            raise Refused(413, f"at most {MOST_BYTES} bytes")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise ConnectionResetError
        return self.server.answers.post(self.path, body, self._is_gone)

    def _is_gone(self) -> bool:
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)

    def _failure(self, status: int, why: str) -> Answer:
        # Its body may not have been read, so nothing more can come on this connection.
        self.close_connection = True
        return Answer(json.dumps({"error": why}).encode(), status=status)

    def _send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        headers = {**_HEADERS, **dict(answer.headers)}
        if answer.data or answer.status != 204:
            headers |= {"Content-Type": answer.kind, "Content-Length": str(len(answer.data))}
        if self.close_connection:
            headers["Connection"] = "close"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.data)

    def log_message(self, *_: Any) -> None:
        """Nothing: the terminal belongs to whoever started the program."""


def _bound(host: str, port: int) -> _Http:
    kind = _Http6 if ":" in host else _Http
    last = min(port + MOST_PORTS, 65536) - 1 if port else 0
    for candidate in range(port, last + 1):
        try:
            return kind((host, candidate))
        except OSError as error:
            if error.errno != errno.EADDRINUSE or candidate == last:
                where = f"--host {host} --port {candidate}"
                raise OSError(error.errno, f"{error.strerror}: choose another", where) from error
    raise AssertionError("the last port returns or raises")


def _named(paths: tuple[Path, ...]) -> dict[str, Motion]:
    """Motions of files, by the files' names; a name that is taken is counted on."""
    motions: dict[str, Motion] = {}
    for path in paths:
        stem = "".join(c if c.isalnum() or c in "-_. " else "_" for c in path.stem)[:30] or "file"
        name, count = stem, 1
        while name in motions or name in MOTIONS:
            count += 1
            name = f"{stem} {count}"
        motions[name] = read_motion(path)
    return motions


def _client(content: dict[str, Any]) -> str:
    client = content.get("client")
    if not isinstance(client, str) or not 0 < len(client) <= 64:
        raise SceneError("client: expected a name of at most 64 letters")
    return client


def _order(content: dict[str, Any]) -> int:
    return whole(content.get("order", 0), "order", 0, 2**53)


def _waited(job: Job, is_gone: Callable[[], bool]) -> Any:
    while not job.is_done(0.1):
        if is_gone():
            job.drop()
            raise ConnectionResetError
    return job.result()


def _json(value: dict[str, Any]) -> Answer:
    return Answer(json.dumps(value, allow_nan=False).encode())
