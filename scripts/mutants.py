#!/usr/bin/env python
"""Puts small faults into a copy of the package, one after the other, and runs the tests that
should find them.

    scripts/mutants.py                      all of scripts/mutants.toml that is not known already
    scripts/mutants.py --only crop mirror   those with one of these words in their name or file
    scripts/mutants.py --jobs 2             so many at a time, each in a copy of its own
    scripts/mutants.py --all                those that are known as well

Prints a line for each: killed (and by which test), survived, or broken (its tests could not run).
What is found is kept in --results; a mutant is run again when it, its file, or its tests change.
At the end the tests that killed are run once on the package as it is: one that fails there has
found nothing. Exits with the number of survivors that the list does not expect, and of broken ones.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "scripts/mutants.toml"
PACKAGE = Path("src/handavatar")
_COPIED = ("src", "tests", "docs", "examples", "scripts", "pyproject.toml", "README.md")
# Shapes are not checked, which takes as long again: what a test says of values has to do.
_PYTEST = ("-x", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-rfE", "--tb=no")
_PRELOADED = (
    *("numpy", "scipy.linalg", "scipy.ndimage", "scipy.sparse", "scipy.spatial", "scipy.special"),
    *(
        "scipy.stats",
        "torch",
        "torch._dynamo",
        "safetensors.torch",
        "PIL.Image",
        "av",
        "igl",
        "cv2",
    ),
    *("jaxtyping", "pytest", "hypothesis", "rich", "tyro"),
)
"""What a process of tests need not import again: it takes longer than most tests."""
_SERVER = multiprocessing.get_context("forkserver")
_FAILED = re.compile(r"^(?:FAILED|ERROR) ([^\s\[]+(?:\[.*?\](?= - |$))?)", re.MULTILINE)
"""The name of a test in pytest's summary; what is in brackets may have blanks."""
_PATIENCE = 600.0
"""Seconds: a mutant that makes a test run for ever is found by that."""


@dataclass(frozen=True)
class Mutant:
    """A fault.

    Attributes:
        name: of the fault.
        file: in which it is, of ``PACKAGE``.
        old: text of the file; occurs once.
        new: what takes its place.
        breaks: what goes wrong.
        tests: files of ``tests`` that should find it, the likeliest first.
        survives: why no test is expected to; empty where one is.
    """

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: tuple[str, ...]
    survives: str = ""

    def applied(self, text: str) -> str:
        """The file with the fault.

        Raises:
            ValueError: the old text is not there, or more than once.
        """
        count = text.count(self.old)
        if count != 1:
            raise ValueError(
                f"{self.name}: the old text occurs {count} times in {self.file}, expected once; "
                f"bring {LIST.name} up to date"
            )
        return text.replace(self.old, self.new)

    def fingerprint(self, tree: Path = ROOT) -> str:
        """Of all in a tree that its verdict is known to depend on."""
        digest = hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode())
        for path in (PACKAGE / self.file, *(Path("tests") / test for test in self.tests)):
            digest.update((tree / path).read_bytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class Verdict:
    """What became of a mutant.

    Attributes:
        state: ``killed``, ``survived`` or ``broken``.
        by: the test that failed first.
        seconds: that it took.
        fingerprint: of the mutant.
    """

    state: str
    by: str
    seconds: float
    fingerprint: str


def read_mutants(path: Path = LIST) -> list[Mutant]:
    """The list."""
    entries = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    return [Mutant(**{**entry, "tests": tuple(entry["tests"])}) for entry in entries]


def copy_tree(folder: Path) -> Path:
    """A copy of what the tests need."""
    for name in _COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, folder / name)
    return folder


@dataclass(frozen=True)
class TestRun:
    """How tests ended.

    Attributes:
        code: pytest's exit status; None if they took too long.
        output: of pytest.
    """

    code: int | None
    output: str


def run_tests(tree: Path, tests: Sequence[str]) -> TestRun:
    """Runs tests of a tree against its own package, in a process that knows all other packages."""
    with tempfile.NamedTemporaryFile() as output:
        process = _SERVER.Process(target=_run_here, args=(tree, tuple(tests), output.name))
        process.start()
        process.join(_PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()
            return TestRun(None, "")
        return TestRun(process.exitcode, Path(output.name).read_text(errors="replace"))


def _run_here(tree: Path, tests: tuple[str, ...], output: str) -> None:
    written = os.open(output, os.O_WRONLY)
    os.dup2(written, 1)
    os.dup2(written, 2)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree / "src")
    sys.path.insert(0, str(tree / "src"))
    code = pytest.main([*_PYTEST, *(f"tests/{test}" for test in tests)])
    sys.stdout.flush()
    # Without the end of the interpreter, for which threads of other packages may wait.
    os._exit(int(code))


def judge(mutant: Mutant, tree: Path) -> Verdict:
    """Puts a fault into a copied tree, runs its tests, and takes it out again."""
    path = tree / PACKAGE / mutant.file
    sound = path.read_text(encoding="utf-8")
    fingerprint = mutant.fingerprint(tree)
    begun = time.monotonic()
    state, by = "broken", ""
    try:
        path.write_text(mutant.applied(sound), encoding="utf-8")
        _forget_compiled(path)
        done = run_tests(tree, mutant.tests)
        found = _FAILED.search(done.output)
        if done.code is None:
            state, by = "killed", f"{_PATIENCE:.0f} seconds"
        elif done.code == 0:
            state = "survived"
        elif done.code == 1 and found:
            state, by = "killed", found[1]
        else:  # Such as a module that can no longer be imported.
            by = (done.output.strip().splitlines() or [f"exit status {done.code}"])[-1][:200]
    finally:
        path.write_text(sound, encoding="utf-8")
        _forget_compiled(path)
    return Verdict(state, by, round(time.monotonic() - begun, 1), fingerprint)


def _forget_compiled(path: Path) -> None:
    """Python knows a compiled file by its size and second, which a mutant may share."""
    for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):
        compiled.unlink()


def read_results(path: Path) -> dict[str, Verdict]:
    """Verdicts that are kept, by the mutants' names."""
    if not path.is_file():
        return {}
    return {name: Verdict(**verdict) for name, verdict in json.loads(path.read_text()).items()}


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--results", type=Path, default=ROOT / ".mutants.json")
    return parser.parse_args()


def main() -> int:
    """Runs what is asked for; returns the number of mutants that are not as expected."""
    asked = _asked()
    os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    _SERVER.set_forkserver_preload([*_PRELOADED])
    mutants = [
        mutant
        for mutant in read_mutants()
        if not asked.only or any(word in f"{mutant.name} {mutant.file}" for word in asked.only)
    ]
    kept = read_results(asked.results)
    waiting = [
        mutant
        for mutant in mutants
        if asked.all
        or mutant.name not in kept
        or kept[mutant.name].state == "broken"
        or kept[mutant.name].fingerprint != mutant.fingerprint()
    ]
    print(f"{len(mutants)} mutants, {len(waiting)} to run", flush=True)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(max(asked.jobs, 1)):
            trees.put(copy_tree(Path(folder) / str(number)))

        def work(mutant: Mutant) -> tuple[Mutant, Verdict]:
            tree = trees.get()
            try:
                return mutant, judge(mutant, tree)
            finally:
                trees.put(tree)

        with ThreadPoolExecutor(max(asked.jobs, 1)) as pool:
            for mutant, verdict in pool.map(work, waiting):
                kept[mutant.name] = verdict
                asked.results.write_text(
                    json.dumps({name: asdict(one) for name, one in sorted(kept.items())}, indent=1)
                )
                print(
                    f"{verdict.state:8} {verdict.seconds:6.1f} s  {mutant.name}  {verdict.by}",
                    flush=True,
                )
        _check_killers({kept[mutant.name].by for mutant in waiting}, trees.get())
    return _summarise(mutants, kept)


def _check_killers(tests: set[str], tree: Path) -> None:
    """Refuses verdicts of tests that fail without any fault."""
    names = sorted(test.removeprefix("tests/") for test in tests if test.startswith("tests/"))
    if not names:
        return
    done = run_tests(tree, names)
    if done.code != 0:
        sys.exit(f"tests fail on the package as it is:\n{done.output[-3000:]}")
    print(f"{len(names)} tests that killed pass on the package as it is", flush=True)


def _summarise(mutants: Sequence[Mutant], kept: dict[str, Verdict]) -> int:
    states = Counter(kept[mutant.name].state for mutant in mutants)
    wrong = [
        mutant
        for mutant in mutants
        if (kept[mutant.name].state == "survived") != bool(mutant.survives)
        or kept[mutant.name].state == "broken"
    ]
    for mutant in mutants:
        state = kept[mutant.name].state
        if state == "survived" or mutant in wrong:
            reason = mutant.survives or "no reason is given"
            print(f"{state}: {mutant.name} ({mutant.file}): {mutant.breaks}; {reason}")
    counted = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    seconds = sum(kept[mutant.name].seconds for mutant in mutants)
    print(f"{len(mutants)} mutants: {counted}; {seconds / 60:.0f} minutes of tests")
    return min(len(wrong), 100)


if __name__ == "__main__":
    sys.exit(main())
