"""Limits of connections: who may wait with a request, and who is served.

A connection costs nothing until its request's head is whole and was let in: then it takes a place.
Until then it waits, for a short time altogether, however its bytes are spread over it; and where
too many wait, the one that has waited longest goes, of the address of which most wait.
"""

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from handavatar.view.turns import Busy


@dataclass(frozen=True)
class Limits:
    """How many, and how long.

    Attributes:
        waiting: connections without a whole head.
        served: requests that were let in and have no answer yet.
        served_of_one: of these, by one address.
        head_seconds: until a head is whole; also what an idle connection is kept open for.
        body_seconds: until a body is whole, and a second more for every ``body_rate`` bytes.
        body_rate: bytes.
    """

    waiting: int = 128
    served: int = 160
    served_of_one: int = 120
    head_seconds: float = 10.0
    body_seconds: float = 20.0
    body_rate: int = 50_000


class Connections:
    """Keeps the limits; for any thread."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        """No connection is open.

        Args:
            limits: to keep.
            clock: seconds, ever growing.
        """
        self.limits = limits
        self._clock = clock
        self._lock = threading.Lock()
        self._open: dict[socket.socket, str] = {}
        self._waiting: dict[socket.socket, float] = {}
        self._served: dict[socket.socket, str] = {}
        self._deadlines: dict[socket.socket, float] = {}

    def expect_head(self, connection: socket.socket, address: str) -> None:
        """A connection waits for a request; where too many do, one of them is ended.

        Args:
            connection: new, or answered.
            address: whose it is.
        """
        now = self._clock()
        with self._lock:
            self._open[connection] = address
            self._waiting[connection] = now
            self._deadlines[connection] = now + self.limits.head_seconds
            if len(self._waiting) > self.limits.waiting:
                counts = Counter(self._open[waiting] for waiting in self._waiting)
                most = max(counts.values())
                # In the order in which they began to wait; not the newest, which may be a user.
                oldest = next(c for c in self._waiting if counts[self._open[c]] == most)
                self._end(oldest)

    @contextmanager
    def place(self, connection: socket.socket) -> Iterator[None]:
        """A place for a request that was let in, until its answer is sent.

        Raises:
            Busy: if there is none.
        """
        with self._lock:
            self._waiting.pop(connection, None)
            self._deadlines.pop(connection, None)
            address = self._open.get(connection, "")
            of_one = sum(other == address for other in self._served.values())
            if len(self._served) >= self.limits.served or of_one >= self.limits.served_of_one:
                raise Busy
            self._served[connection] = address
        try:
            yield
        finally:
            with self._lock:
                self._served.pop(connection, None)

    @contextmanager
    def body(self, connection: socket.socket, length: int) -> Iterator[None]:
        """Ends the connection if reading a body takes too long altogether.

        Args:
            connection: it is read from.
            length: of the body, bytes.
        """
        seconds = self.limits.body_seconds + length / self.limits.body_rate
        with self._lock:
            self._deadlines[connection] = self._clock() + seconds
        try:
            yield
        finally:
            with self._lock:
                self._deadlines.pop(connection, None)

    def end_late(self) -> None:
        """Ends the connections whose time is over; to be called now and then."""
        now = self._clock()
        with self._lock:
            for connection in [c for c, end in self._deadlines.items() if end < now]:
                self._end(connection)

    def end_all(self) -> None:
        """Ends all connections; what waits for an answer gets none."""
        with self._lock:
            for connection in list(self._open):
                self._end(connection)

    def forget(self, connection: socket.socket) -> None:
        """A connection is closed."""
        with self._lock:
            for known in (self._open, self._waiting, self._served, self._deadlines):
                known.pop(connection, None)

    def _end(self, connection: socket.socket) -> None:
        self._waiting.pop(connection, None)
        self._deadlines.pop(connection, None)
        # Its thread finds that nothing more comes, and closes it.
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
