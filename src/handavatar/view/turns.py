"""Whose picture is made next: for each client only the newest, and every client in turn."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

from handavatar.view.share import Share

_REMEMBERED = 1024
"""Clients whose newest order is known."""


class Overtaken(Exception):
    """The same client has asked for something newer, or went away."""


class Busy(Exception):
    """More clients wait than may."""


class Job:
    """A picture that somebody waits for."""

    def __init__(
        self, client: str, order: int, work: Callable[["Job"], Any], share: Share | None = None
    ) -> None:
        """Not begun.

        Args:
            client: who asks.
            order: of the client's wishes; a larger one is newer.
            work: makes the picture; gets the job, to ask now and then whether it is stale.
            share: of a core, if there is one to be kept to.
        """
        self.client = client
        self.order = order
        self._work = work
        self._done = threading.Event()
        self._stale = threading.Event()
        self._result: Any = None
        self._error: BaseException | None = None
        self._share = share

    def is_stale(self) -> bool:
        """Whether nobody wants it any more."""
        return self._stale.is_set()

    def is_to_end(self) -> bool:
        """Whether it is stale; asked by the work itself, which rests here if it must."""
        if self._share is not None:
            self._share.rest(self.is_stale)
        return self.is_stale()

    def drop(self) -> None:
        """Nobody wants it any more."""
        self._stale.set()

    def is_done(self, timeout: float) -> bool:
        """Waits so many seconds at most for it to be done."""
        return self._done.wait(timeout)

    def result(self) -> Any:
        """What the work made, once it is done.

        Raises:
            Overtaken: if it was dropped first.
            BaseException: what the work raised.
        """
        self._done.wait()
        if self._error is not None:
            raise self._error
        return self._result

    def run(self) -> None:
        """Does the work, unless it is stale; never raises."""
        try:
            if not self.is_stale():
                self._result = self._work(self)
        except BaseException as error:
            self._error = error
        if self.is_stale():
            self._error = Overtaken()
        self._done.set()


class Turns:
    """Lanes with a thread each, which take jobs as they came.

    In a lane a client has at most one job that waits. A newer order of a client makes its older
    ones stale in all lanes.
    """

    def __init__(
        self,
        lanes: Mapping[str, Callable[[], None]],
        most_waiting: int = 64,
        share: Share | None = None,
    ) -> None:
        """Starts the threads.

        Args:
            lanes: names of the lanes, and what the thread of each does first.
            most_waiting: in each lane.
            share: of a core, if all of them together must keep to one.
        """
        self._share = share
        self._changed = threading.Condition()
        self._most_waiting = most_waiting
        self._newest: OrderedDict[str, int] = OrderedDict()
        self._waiting: dict[str, OrderedDict[str, Job]] = {name: OrderedDict() for name in lanes}
        self._running: dict[str, Job | None] = dict.fromkeys(lanes)
        self._is_closed = False
        self._threads = [
            threading.Thread(
                target=self._work, args=(name, begin), name=f"view-{name}", daemon=True
            )
            for name, begin in lanes.items()
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, lane: str, client: str, order: int, work: Callable[[Job], Any]) -> Job:
        """Puts a job in line.

        Args:
            lane: which.
            client: who asks.
            order: of the client's wishes.
            work: as :class:`Job`.

        Raises:
            Overtaken: if the client has asked for something newer, or all is closed.
            Busy: if too many wait.
        """
        job = Job(client, order, work, self._share)
        with self._changed:
            if self._is_closed or order < self._newest.get(client, order):
                raise Overtaken
            waiting = self._waiting[lane]
            if client not in waiting and len(waiting) >= self._most_waiting:
                raise Busy
            self._newest[client] = order
            self._newest.move_to_end(client)
            while len(self._newest) > _REMEMBERED:
                self._newest.popitem(last=False)
            for name, jobs in self._waiting.items():
                older = jobs.get(client)
                if older is not None and (name == lane or older.order < order):
                    _forget(jobs.pop(client))
                running = self._running[name]
                if running is not None and running.client == client and running.order < order:
                    running.drop()
            waiting[client] = job
            self._changed.notify_all()
        return job

    def close(self) -> None:
        """Drops all jobs and ends the threads."""
        with self._changed:
            self._is_closed = True
            for jobs in self._waiting.values():
                while jobs:
                    _forget(jobs.popitem()[1])
            for job in self._running.values():
                if job is not None:
                    job.drop()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self, lane: str, begin: Callable[[], None]) -> None:
        begin()
        waiting = self._waiting[lane]
        while True:
            with self._changed:
                self._changed.wait_for(lambda: waiting or self._is_closed)
                if self._is_closed:
                    return
                job = waiting.popitem(last=False)[1]
                self._running[lane] = job
            job.run()
            with self._changed:
                self._running[lane] = None
            if self._share is not None:
                self._share.rest(lambda: self._is_closed)


def _forget(job: Job) -> None:
    """Ends a job that was never begun."""
    job.drop()
    job.run()
