"""Connections: from a socket to a request that was let in, and from its answer back."""

import errno
import json
import select
import socket
import socketserver
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from handavatar.errors import ArgumentError, HandAvatarError, machine_error, printable
from handavatar.view.guard import POSTED_KINDS, Guard, Refused
from handavatar.view.limits import Connections, Limits
from handavatar.view.scene import SceneError
from handavatar.view.studio import MOST_PICTURE_BYTES, Interrupted
from handavatar.view.turns import Busy, Overtaken

MOST_BYTES = 64 * 1024
"""Of a request's body."""
MOST_CAMERA_BYTES = 1 << 20
"""Of a camera's picture."""
MOST_PIECE_BYTES = 4 << 20
"""Of a piece of a recording."""
MOST_PICTURES = 2
"""Pictures that are being received or read at a time; more are asked to try again."""
MOST_PORTS = 20
"""Ports that are tried, from the one that is asked for."""
_TIMEOUT = 20.0
_FILES = {
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/webcam.js": ("webcam.js", "text/javascript; charset=utf-8"),
    "/training.js": ("training.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_MOST_POSTED = {
    "/paint": MOST_PICTURE_BYTES,
    "/look": MOST_CAMERA_BYTES,
    "/recording": MOST_PIECE_BYTES,
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


def page_file(name: str, kind: str) -> Answer:
    """A file of the page, as it ships."""
    return Answer((resources.files("handavatar.view") / "page" / name).read_bytes(), kind)


def json_answer(value: dict[str, Any]) -> Answer:
    """A JSON object, without NaN."""
    return Answer(json.dumps(value, allow_nan=False).encode())


class Answering(Protocol):
    """From requests that were let in to answers."""

    def get(self, path: str, query: dict[str, str]) -> Answer:
        """Answers a GET request; ``Refused`` and ``SceneError`` say what is wrong with it."""
        ...

    def post(self, path: str, body: bytes, is_gone: Callable[[], bool]) -> Answer:
        """Answers a POST request, unless its client is gone."""
        ...


class HttpServer(ThreadingHTTPServer):
    """Bounded in its connections, and silent about clients that hang up."""

    daemon_threads = True
    request_queue_size = 128
    guard: Guard
    answers: Answering

    def __init__(self, address: tuple[str, int]) -> None:
        """Binds the port; before it serves, it must be given its guard and its answers."""
        self.pictures = threading.BoundedSemaphore(MOST_PICTURES)
        self.connections = Connections(Limits())
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """As its parent, without asking a name server what this machine is called."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def service_actions(self) -> None:
        """Several times a second, while it serves."""
        self.connections.end_late()

    def process_request(self, request: Any, client_address: Any) -> None:
        """A thread for a connection, which has to say soon what it wants."""
        self.connections.expect_head(request, str(client_address[0]))
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Closes a connection."""
        self.connections.forget(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that broke; what a request asked for never ends here."""


class _HttpServer6(HttpServer):
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
    server: HttpServer

    def handle_one_request(self) -> None:
        """Waits for a request, and answers it."""
        self.server.connections.expect_head(self.connection, str(self.client_address[0]))
        super().handle_one_request()

    def do_GET(self) -> None:
        self._answer(self._got)

    def do_POST(self) -> None:
        self._answer(self._posted)

    def _answer(self, make: Callable[[], Answer]) -> None:
        try:
            self.server.guard.check(self.command, self.path, self.headers)
            with self.server.connections.place(self.connection):
                self._answer_let_in(make)
            return
        except Refused as error:
            answer = self._failure(error.status, str(error))
        except Busy:
            answer = self._failure(503, "too many ask at once: try again")
        self._send(answer)

    def _answer_let_in(self, make: Callable[[], Answer]) -> None:
        try:
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
            known = error if isinstance(error, HandAvatarError) else machine_error(error)
            said = str(known)[:400] if known else f"{type(error).__name__}: {str(error)[:200]}"
            print(printable(f"view: {said}"), file=sys.stderr)
            answer = self._failure(500, said)
        self._send(answer)

    def _got(self) -> Answer:
        try:
            parts = urlsplit(self.path)
            given = parse_qs(parts.query, max_num_fields=8)
        except ValueError as error:
            raise SceneError("this address means nothing") from error
        query = {name: values[0] for name, values in given.items()}
        if parts.path == "/" and "token" in query:
            # From the address into a cookie, out of sight and out of the browser's history.
            guard = self.server.guard
            cookie = f"{guard.cookie}={guard.token}; HttpOnly; SameSite=Strict; Path=/"
            return Answer(b"", headers=(("Location", "/"), ("Set-Cookie", cookie)), status=303)
        if parts.path in _FILES:
            return page_file(*_FILES[parts.path])
        return self.server.answers.get(parts.path, query)

    def _posted(self) -> Answer:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or len(length) > 9 or "Transfer-Encoding" in self.headers:
            raise Refused(411, "say how long the body is")
        path = self.path.partition("?")[0]
        if path not in POSTED_KINDS:
            return self._posted_whole(int(length), MOST_BYTES)
        if not self.server.pictures.acquire(blocking=False):
            raise Busy
        try:
            return self._posted_whole(int(length), _MOST_POSTED[path])
        finally:
            self.server.pictures.release()

    def _posted_whole(self, length: int, most: int) -> Answer:
        if length > most:
            raise Refused(413, f"at most {most} bytes")
        with self.server.connections.body(self.connection, length):
            body = self.rfile.read(length)
        if len(body) < length:
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


def bound(host: str, port: int) -> HttpServer:
    """A server that listens.

    Args:
        host: where.
        port: the first to try; 0 is any.

    Raises:
        ArgumentError: if no port is free, or there is no such host.
    """
    kind = _HttpServer6 if ":" in host else HttpServer
    last = min(port + MOST_PORTS, 65536) - 1 if port else 0
    for candidate in range(port, last + 1):
        try:
            return kind((host, candidate))
        except OSError as error:
            if error.errno != errno.EADDRINUSE or candidate == last:
                is_port = error.errno in (errno.EADDRINUSE, errno.EACCES)
                found = f"{candidate if is_port else host}: {error.strerror}"
                raise ArgumentError(
                    "port" if is_port else "host", found, "", "choose another"
                ) from error
    raise AssertionError("the last port returns or raises")
