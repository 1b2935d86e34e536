"""The list of mutants fits the package as it is."""

import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import mutants  # noqa: E402  # Processes that it starts find it by its name.

MUTANTS = mutants.read_mutants()
LEAST = {
    "capture": 25,
    "fit": 10,
    "field": 10,
    "render": 8,
    "train": 8,
    "geometry": 6,
    "hand": 6,
    "evaluate": 6,
    "export": 4,
    "view": 4,
}


def test_every_mutant_is_a_change_of_one_place_and_has_tests() -> None:
    for mutant in MUTANTS:
        sound = (ROOT / mutants.PACKAGE / mutant.file).read_text(encoding="utf-8")
        changed = mutant.applied(sound)
        assert changed != sound
        compile(changed, mutant.file, "exec")
        assert mutant.breaks and mutant.tests
        for test in mutant.tests:
            assert (ROOT / "tests" / test).is_file(), f"{mutant.name}: {test}"
    assert max(Counter(mutant.name for mutant in MUTANTS).values()) == 1


def test_mutants_are_all_over_the_package_and_few_may_survive() -> None:
    rooms = Counter(mutant.file.split("/")[0] for mutant in MUTANTS)
    assert len(MUTANTS) >= 80
    assert {room: rooms[room] for room in LEAST if rooms[room] < LEAST[room]} == {}
    assert rooms["jobs"] + rooms["cli"] >= 5
    assert sum(bool(mutant.survives) for mutant in MUTANTS) <= 5


def test_a_mutant_whose_place_is_gone_is_an_error() -> None:
    gone = mutants.Mutant("gone", "edit.py", "no such text", "", "nothing", ("test_edit.py",))
    with pytest.raises(ValueError, match=r"gone: the old text occurs 0 times in edit\.py"):
        gone.applied("def f(): ...")
    with pytest.raises(ValueError, match="occurs 2 times"):
        mutants.Mutant("twice", "edit.py", "a", "b", "", ()).applied("a a")


@pytest.mark.parametrize(("fault", "state"), [("x + y", "survived"), ("x - y", "killed")])
def test_a_fault_is_put_in_judged_and_taken_out_again(
    tmp_path: Path, fault: str, state: str
) -> None:
    """In a copy of a package of one line, with a test that knows the sum of two and nothing."""
    source = "def added(x: int, y: int) -> int:\n    return y + x\n"
    file = tmp_path / mutants.PACKAGE / "edit.py"
    file.parent.mkdir(parents=True)
    (file.parent / "__init__.py").touch()
    file.write_text(source)
    test = tmp_path / "tests/test_edit.py"
    test.parent.mkdir()
    test.write_text("from handavatar.edit import added\ndef test_sum(): assert added(1, 2) == 3\n")
    mutant = mutants.Mutant("made", "edit.py", "y + x", fault, "sums", ("test_edit.py",))
    verdict = mutants.judge(mutant, tmp_path)
    assert verdict.state == state
    assert verdict.by == ("tests/test_edit.py::test_sum" if state == "killed" else "")
    assert file.read_text() == source
