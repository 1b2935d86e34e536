"""When numbers are no longer finite: what the run notes, what to do, and the seed that goes on.

The same seed would lead to the same NaN, so a run that has diverged, and no other, may go on from
its last checkpoint with another seed. ``seeds.json`` says which steps were taken with which.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from handavatar.avatar import CheckpointError
from handavatar.jobs.finite import NotFinite, find_not_finite, require_finite
from handavatar.train.runs import Run, latest_checkpoint, read_json, write_json

_MAX_SEEDS = 10_000


@dataclass(frozen=True)
class SeedUse:
    """A seed that a run was trained with.

    Attributes:
        seed: of all that was drawn.
        after: number of the step, of the checkpoint, from which it went on; 0 from the beginning.
        diverged: what was not finite in the end; empty if nothing was.
    """

    seed: int
    after: int = 0
    diverged: str = ""


def read_seeds(run: Run, begun: int) -> list[SeedUse]:
    """The seeds of a run in the order of their use; the last one is in use.

    Args:
        run: that has been begun.
        begun: the seed that it was begun with.

    Raises:
        CheckpointError: if the file that says so is damaged.
    """
    path = run.folder / "seeds.json"
    if not path.is_file():
        return [SeedUse(begun)]
    content = read_json(path, "delete it: the run then goes on with the seed it was begun with")
    try:
        uses = [
            SeedUse(int(use["seed"]), int(use["after"]), str(use["diverged"]))
            for use in content["seeds"][:_MAX_SEEDS]
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: says of a seed too little, or something else ({error!r})",
            "",
            "delete it: the run then goes on with the seed it was begun with",
        ) from error
    return uses or [SeedUse(begun)]


def may_take_seed(run: Run, begun: int, seed: int) -> bool:
    """Whether a run goes on with a seed: with its own, and with any other where it has diverged."""
    last = read_seeds(run, begun)[-1]
    return seed == last.seed or bool(last.diverged)


def take_seed(run: Run, begun: int, seed: int, after: int) -> None:
    """Notes that a run goes on with a seed, if it is another than before.

    Args:
        run: whose lock the caller holds.
        begun: the seed that it was begun with.
        seed: that it may take.
        after: number of the step from which it goes on.
    """
    uses = read_seeds(run, begun)
    if uses[-1].seed != seed:
        _write_seeds(run, [*uses, SeedUse(seed, after)])


@contextmanager
def divergence_noted(run: Run, begun: int, seed: int, words: str) -> Iterator[None]:
    """Notes in a run that it has diverged, and adds to the error how it goes on.

    Args:
        run: whose lock the caller holds.
        begun: the seed that it was begun with.
        seed: in use.
        words: of the command that make it go on in this run.

    Raises:
        NotFinite: what was raised inside, with the remedy.
    """
    try:
        yield
    except NotFinite as error:
        *earlier, last = read_seeds(run, begun)
        _write_seeds(run, [*earlier, SeedUse(last.seed, last.after, error.found.splitlines()[0])])
        checkpoint = latest_checkpoint(run)
        if checkpoint is None:
            state = "no checkpoint was written yet: it begins anew"
        else:
            state = f"the checkpoint of step {checkpoint.step} is good: it goes on from there"
        raise NotFinite(
            error.found,
            f"{state} with another seed\ngive the same command again with {words} "
            f"`seed={_unused_seed([*earlier, last], seed)}`",
        ) from error


def _unused_seed(uses: list[SeedUse], seed: int) -> int:
    return max(seed, *(use.seed for use in uses)) + 1


def _write_seeds(run: Run, uses: list[SeedUse]) -> None:
    write_json(run.folder / "seeds.json", {"seeds": [asdict(use) for use in uses]})


@contextmanager
def finite_stage(name: str, values: Callable[[], Mapping[str, object]]) -> Iterator[None]:
    """A stage of a training that must leave finite values.

    NaN makes many a function fail for a reason of its own, such as a point without a nearest
    face; what it is then called is told by the values themselves.

    Args:
        name: of the stage.
        values: that it changes, as of :func:`handavatar.jobs.finite.find_not_finite`.

    Raises:
        NotFinite: if some of them are not finite when it ends, or when it fails.
    """
    try:
        yield
    except NotFinite:
        raise
    except (ArithmeticError, ValueError, RuntimeError, IndexError) as error:
        found = find_not_finite(values())
        if found is None:
            raise
        raise NotFinite(f"{name}: {found}") from error
    require_finite(values(), name)
