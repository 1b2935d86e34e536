"""Limits of connections, without a server."""

import socket
from collections.abc import Iterator

import pytest

from handavatar.view.limits import Connections, Limits
from handavatar.view.turns import Busy

LIMITS = Limits(waiting=3, served=4, served_of_one=3, head_seconds=10.0, body_seconds=20.0)


class _Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> _Clock:
    return _Clock()


@pytest.fixture
def connections(clock: _Clock) -> Connections:
    return Connections(LIMITS, clock)


@pytest.fixture
def sockets() -> Iterator[list[tuple[socket.socket, socket.socket]]]:
    """Ours, and the other side's."""
    made = [socket.socketpair() for _ in range(8)]
    for pair in made:
        pair[1].settimeout(0.0)
    yield made
    for pair in made:
        for one in pair:
            one.close()


def _has_ended(pair: tuple[socket.socket, socket.socket]) -> bool:
    try:
        return pair[1].recv(1) == b""
    except BlockingIOError:
        return False


Pairs = list[tuple[socket.socket, socket.socket]]


def test_the_one_that_waited_longest_goes_of_the_address_of_which_most_wait(
    connections: Connections, sockets: Pairs
) -> None:
    for pair, address in zip(sockets, ["user", "flood", "flood", "flood"], strict=False):
        connections.expect_head(pair[0], address)
    assert [_has_ended(pair) for pair in sockets[:4]] == [False, True, False, False]
    connections.expect_head(sockets[4][0], "flood")
    assert [_has_ended(pair) for pair in sockets[:5]] == [False, True, True, False, False]


def test_a_head_has_one_deadline_and_an_answer_begins_another(
    connections: Connections, sockets: Pairs, clock: _Clock
) -> None:
    connections.expect_head(sockets[0][0], "a")
    connections.expect_head(sockets[1][0], "a")
    clock.now = 9.0
    with connections.place(sockets[0][0]):
        clock.now = 11.0
        connections.end_late()
        assert not _has_ended(sockets[0]), "what is being answered has all the time that it takes"
        assert _has_ended(sockets[1])
    connections.expect_head(sockets[0][0], "a")
    clock.now = 20.9
    connections.end_late()
    assert not _has_ended(sockets[0])
    clock.now = 21.1
    connections.end_late()
    assert _has_ended(sockets[0])


def test_a_body_has_a_deadline_by_its_length(
    connections: Connections, sockets: Pairs, clock: _Clock
) -> None:
    for number, length in enumerate((0, 500_000)):
        connections.expect_head(sockets[number][0], "a")
        with connections.place(sockets[number][0]), connections.body(sockets[number][0], length):
            clock.now += 20.1
            connections.end_late()
    assert _has_ended(sockets[0]) and not _has_ended(sockets[1])


def test_places_are_bounded_altogether_and_for_one_address(
    connections: Connections, sockets: Pairs
) -> None:
    places = []
    for number in range(3):
        connections.expect_head(sockets[number][0], "a")
        places.append(connections.place(sockets[number][0]))
        places[-1].__enter__()
    connections.expect_head(sockets[3][0], "a")
    with pytest.raises(Busy), connections.place(sockets[3][0]):
        pytest.fail("one address has three")
    connections.expect_head(sockets[4][0], "b")
    places.append(connections.place(sockets[4][0]))
    places[-1].__enter__()
    connections.expect_head(sockets[5][0], "c")
    with pytest.raises(Busy), connections.place(sockets[5][0]):
        pytest.fail("four altogether")
    for place in places:
        place.__exit__(None, None, None)
    with connections.place(sockets[5][0]):
        connections.forget(sockets[5][0])
    connections.end_all()
    assert all(_has_ended(pair) for pair in sockets[:5]) and not _has_ended(sockets[5])
