"""Kept figures are shown for the capture that they are of, and by the commit that measured them."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import write_tiny_capture

from handavatar.capture.checks import CaptureError
from handavatar.cli import main
from handavatar.evaluate.tables import ResultTable
from handavatar.peers import table as peers
from handavatar.peers.table import PeersTableOptions, peers_table
from handavatar.train import ablation_table as ablation
from handavatar.train import kept
from handavatar.train.ablation_table import AblationTableOptions, ablation_table
from handavatar.train.kept import (
    capture_fingerprint,
    origin,
    present_commit,
    read_kept,
    write_kept,
)

DOCS = Path(__file__).parents[2] / "docs"
KEPT = DOCS / "ablation"


@pytest.fixture(autouse=True)
def _nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(*_: object) -> None:
        raise AssertionError("measured anew")

    monkeypatch.setattr(ablation, "ablate", measured)
    monkeypatch.setattr(peers, "_measured", measured)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_tiny_capture(tmp_path / "B" / "light-key", "ab")


def _ablation(capture: Path, folder: Path, any_commit: bool = False) -> ResultTable:
    rows = ("(paper)", "traced light")
    options = AblationTableOptions((capture,), folder, rows, steps=150, any_commit=any_commit)
    return ablation_table(options)


def _peers(capture: Path, folder: Path, any_commit: bool = False) -> ResultTable:
    return peers_table(PeersTableOptions((capture,), folder, any_commit=any_commit))


TABLES = {"light-key.json": _ablation, "peers-light-key.json": _peers}
Table = Callable[..., ResultTable]


def _stamped(name: str, folder: Path, **facts: Any) -> Path:
    """Figures of the documents, as if this version had kept them."""
    folder.mkdir(exist_ok=True)
    content = json.loads((KEPT / name).read_text())
    (folder / name).write_text(json.dumps(content | facts))
    return folder


@pytest.mark.parametrize("name", TABLES)
def test_figures_of_a_capture_that_is_not_there_are_refused(name: str) -> None:
    with pytest.raises(CaptureError, match=r"transforms\.json"):
        TABLES[name](Path("/nonexistent/light-key"), KEPT)


@pytest.mark.parametrize("name", TABLES)
def test_what_an_older_version_kept_is_shown_and_said_to_be_that(name: str, capture: Path) -> None:
    table = TABLES[name](capture, KEPT)
    assert "light-key: kept by a version that recorded neither" in table.notes[-1]
    assert present_commit() in table.notes[-1]


@pytest.mark.parametrize("name", TABLES)
def test_figures_of_this_capture_and_commit_are_shown_without_a_word(
    name: str, capture: Path, tmp_path: Path
) -> None:
    rows = json.loads((KEPT / name).read_text())["rows"]
    folder = _stamped(name, tmp_path / "kept", **origin(capture_fingerprint(capture), rows))
    table = TABLES[name](capture, folder)
    assert table.rows == TABLES[name](capture, KEPT).rows
    assert not any("commit" in note for note in table.notes)


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("file", ["transforms.json", "images/000001.png", "masks/000000.png"])
def test_figures_of_another_capture_are_refused(
    name: str, file: str, capture: Path, tmp_path: Path
) -> None:
    rows = json.loads((KEPT / name).read_text())["rows"]
    folder = _stamped(name, tmp_path / "kept", **origin(capture_fingerprint(capture), rows))
    other = tmp_path / "C" / "light-key"
    shutil.copytree(capture, other)
    if file.endswith(".json"):
        content = json.loads((other / file).read_text())
        content["frames"][0]["time"] = 0.5
        (other / file).write_text(json.dumps(content))
    else:
        another = "000000" if "1" in file else "000001"
        shutil.copy(capture / file.replace(Path(file).stem, another), other / file)
    for any_commit in (False, True):
        with pytest.raises(CaptureError, match="are of another capture: fingerprint") as caught:
            TABLES[name](other, folder, any_commit)
        assert "name another folder" in str(caught.value)


@pytest.mark.parametrize("name", TABLES)
def test_figures_of_another_commit_are_refused_unless_they_are_asked_for(
    name: str, capture: Path, tmp_path: Path
) -> None:
    rows = json.loads((KEPT / name).read_text())["rows"]
    facts = origin(capture_fingerprint(capture), rows)
    first = next(iter(rows))
    facts["commits"][first] = "0123abcd"
    folder = _stamped(name, tmp_path / "kept", **facts)
    with pytest.raises(CaptureError, match="measured by commit 0123abcd, this is") as caught:
        TABLES[name](capture, folder)
    assert "`any_commit=True`" in str(caught.value)
    table = TABLES[name](capture, folder, True)
    expected = f"light-key: measured by commit 0123abcd, not by this one ({present_commit()}): "
    assert table.notes[-1] == f"{expected}{first}."


def test_new_rows_are_not_put_beside_figures_of_an_unknown_capture(
    capture: Path, tmp_path: Path
) -> None:
    folder = _stamped("light-key.json", tmp_path / "kept")
    content = json.loads((folder / "light-key.json").read_text())
    del content["rows"]["traced light"]
    (folder / "light-key.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="others cannot be put beside them"):
        _ablation(capture, folder)


@pytest.mark.parametrize("facts", [{"commits": []}, {"capture_sha256": 3}, {"rows": 3}])
def test_a_file_that_says_nonsense_is_refused(
    facts: dict[str, Any], capture: Path, tmp_path: Path
) -> None:
    folder = _stamped("light-key.json", tmp_path / "kept", **facts)
    with pytest.raises(CaptureError, match=r"light-key\.json: "):
        _ablation(capture, folder)


def test_figures_that_were_changed_after_they_were_written_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    figures = {"rows": {"quick": [0.1, 2, None]}, "steps": (1, 2)} | origin("abc", ["quick"])
    written = write_kept(path, figures)
    assert read_kept(path, "abc", False) == written and written["steps"] == [1, 2]
    path.write_text(path.read_text().replace("0.1", "0.2"))
    with pytest.raises(CaptureError, match=r"figures\.json: its figures were changed") as caught:
        read_kept(path, "abc", True)
    assert "move this file away" in str(caught.value)


def test_an_installed_copy_goes_by_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "source_commit", lambda: None)
    assert re.fullmatch(r"version \d+\.\d+\.\d+.*", kept.present_commit.__wrapped__())


def test_there_is_nothing_to_read_where_nothing_is_kept(tmp_path: Path) -> None:
    assert read_kept(tmp_path / "none.json", "0", False) == {}


def _commands(option: str) -> list[str]:
    text = "\n".join(path.read_text() for path in sorted(DOCS.glob("*.md")))
    return re.findall(rf"^handavatar (bench .*{option}.*)$", text, re.MULTILINE)


def test_the_documents_commands_that_show_kept_figures_still_show_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a stand-in for the made capture, of which the figures of older versions know nothing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(DOCS)
    commands = _commands("--kept docs/ablation")
    assert len(commands) >= 3
    for command in commands:
        words = shlex.split(command)
        made = Path(words[words.index("--captures") + 1])
        if not made.exists():
            write_tiny_capture(made, "ab")
        assert main(words) == 0
        printed = capsys.readouterr().out
        assert f"{made.name}: kept by a version that recorded neither" in printed
        assert "| + directed occupancy (paper) |" in printed or "| ours (best) |" in printed
    options = AblationTableOptions((made,), KEPT, steps=1)
    with pytest.raises(AssertionError, match="measured anew"):
        ablation_table(replace(options, kept=tmp_path / "empty"))


def test_the_documents_command_that_shows_kept_trainings_says_which_commits_they_are_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(DOCS / "geometry", tmp_path / "docs" / "geometry")
    (command,) = _commands("--priors docs/geometry")
    assert main(shlex.split(command)) == 0
    printed = capsys.readouterr().out
    for contender in ("pair", "coap", "transformer"):
        commit = json.loads((DOCS / "geometry" / f"{contender}-1.json").read_text())["commit"]
        notes = [
            line
            for line in printed.splitlines()
            if f"Trainings: measured by commit {commit}" in line
        ]
        assert len(notes) == 1 and f"{contender}-1" in notes[0] and present_commit() in notes[0]
