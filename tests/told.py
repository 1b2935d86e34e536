"""A progress that remembers what it was told."""

from typing import Any

from handavatar.jobs.progress import Board, Progress


def remembered() -> tuple[Progress, list[dict[str, Any]]]:
    """A progress, and the states that it was told, as JSON lines have them."""
    board, states = Board("test"), list[dict[str, Any]]()
    board.listeners.append(lambda state, _: states.append(state))
    return Progress(board), states
