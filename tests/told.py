"""A progress that remembers what it was told."""

from typing import Any

from handavatar.jobs.progress import Board, Progress


class Told:
    """What a progress was told.

    Attributes:
        progress: to be handed to a function.
        states: as JSON lines have them, one for every time that it was told something.
    """

    def __init__(self) -> None:
        board = Board("test")
        self.progress = Progress(board)
        self.states: list[dict[str, Any]] = []
        board.listeners.append(lambda state, _: self.states.append(state))

    @property
    def steps(self) -> list[int]:
        return [state["step"] for state in self.states]

    @property
    def shares(self) -> list[float]:
        return [state["share"] for state in self.states]

    @property
    def counts(self) -> list[tuple[str, int, int]]:
        return [(state["job"], state["step"], state["total"]) for state in self.states]
