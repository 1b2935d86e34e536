"""A table of results: numbers for programs, Markdown for people."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

from handavatar.jobs.files import FolderKind
from handavatar.jobs.progress import Progress

TABLES = FolderKind("tables")
"""A folder in which the figures behind tables are kept."""
Cell = float | int | str | None
"""``None`` was not measured."""


@dataclass(frozen=True)
class ResultTable:
    """Named rows with the same columns.

    Attributes:
        title: one line.
        rows: by name; each maps the columns, in order, to figures.
        notes: what a reader must know to judge the figures.
    """

    title: str
    rows: Mapping[str, Mapping[str, Cell]]
    notes: tuple[str, ...] = ()

    def record(self) -> dict[str, object]:
        """The table as JSON takes it."""
        return asdict(self)

    def markdown(self) -> str:
        """The table with its title and notes."""
        columns = list(next(iter(self.rows.values()), {}))
        lines = ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        for name, row in self.rows.items():
            lines.append(f"| {name} | " + " | ".join(_text(row[c]) for c in columns) + " |")
        notes = "".join(f"\n{note}\n" for note in self.notes)
        return f"### {self.title}\n\n" + "\n".join(lines) + "\n" + notes


def step_counter(progress: Progress, total: int) -> Callable[[], None]:
    """A function that tells how often it has been called, of so many times."""
    done = 0

    def finished() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    return finished


def _text(cell: Cell) -> str:
    if isinstance(cell, int):
        return f"{cell:,}"
    return "–" if cell is None else str(cell)
