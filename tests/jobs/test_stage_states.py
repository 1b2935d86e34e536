"""Stages that go on where they were interrupted."""

import logging
import math
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from handavatar.jobs import stage_states
from handavatar.jobs.finite import NotFinite
from handavatar.jobs.signals import Interrupted
from handavatar.jobs.stage_states import NOT_KEPT, StageStates, WorkState, state_files

NAMES = ("first", "second", "third")


def _states(folder: Path, fingerprint: str = "x") -> StageStates:
    return StageStates(folder / "work", fingerprint, NAMES)


def _whole(value: float) -> WorkState:
    return WorkState({"weights": torch.full((2,), value)}, {"value": value})


def test_the_work_goes_on_with_the_stage_that_was_begun(tmp_path: Path) -> None:
    states = _states(tmp_path)
    assert states.whole is None and not states.is_done("first")
    assert states.begin("first", lambda: _whole(1.0)).read() is None
    states.begin("second", lambda: _whole(2.0))
    again = _states(tmp_path)
    assert again.is_done("first") and not again.is_done("second")
    assert again.whole is not None and again.whole.facts == {"value": 2.0}
    assert torch.equal(again.whole.tensors["weights"], torch.full((2,), 2.0))
    # Who goes on asks for no other state, and the stage has said nothing yet.
    assert again.begin("second", lambda: pytest.fail("asked")).read() is None
    again.begin("third", lambda: _whole(3.0))
    assert _states(tmp_path).is_done("second")
    again.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_stage_that_is_told_to_stop_keeps_how_far_it_is(tmp_path: Path) -> None:
    stage = _states(tmp_path).begin("second", lambda: _whole(2.0))
    done = 0
    with (
        pytest.raises(Interrupted),
        stage.kept(lambda: WorkState({"done": torch.tensor(done)}, {"done": done})) as step,
    ):
        for done in range(1, 6):
            step()
            if done == 3:
                raise Interrupted
    again = _states(tmp_path)
    state = again.begin("second", lambda: _whole(9.0)).read()
    assert state is not None and state.facts == {"done": 3} and int(state.tensors["done"]) == 3
    # It is nothing to any other stage.
    assert again.begin("third", lambda: _whole(3.0)).read() is None
    assert _states(tmp_path).begin("third", lambda: _whole(3.0)).read() is None


def test_a_killed_stage_goes_on_from_what_it_kept_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage_states, "_EVERY", 0.0)
    stage = _states(tmp_path).begin("first", lambda: _whole(1.0))
    with stage.kept(lambda: WorkState({}, {"done": 4})) as step:
        step()
        state = _states(tmp_path).begin("first", lambda: _whole(1.0)).read()
    assert state is not None and state.facts == {"done": 4}


@pytest.mark.parametrize("file", [0, 1])
@pytest.mark.parametrize("how", ["other work", "cut", "empty", "no state", "NaN"])
def test_what_cannot_be_gone_on_from_is_begun_anew_with_a_warning(
    file: int, how: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    states = _states(tmp_path)
    stage = states.begin("second", lambda: _whole(2.0))
    stage.write(WorkState({"done": torch.ones(1)}, {"done": 1}))
    path = state_files(tmp_path / "work")[file]
    content = path.read_bytes()
    changed = {
        "cut": content[: len(content) // 2],
        "empty": b"",
        "no state": content.replace(b"fingerprint", b"fingerprunt"),
        "NaN": content[:-4] + torch.tensor(math.nan).numpy().tobytes(),
        "other work": content,
    }
    path.write_bytes(changed[how])
    with caplog.at_level(logging.WARNING):
        again = _states(tmp_path, "y" if how == "other work" else "x")
    assert str(path if how != "other work" else state_files(tmp_path / "work")[0]) in caplog.text
    if file == 0 or how == "other work":
        assert again.whole is None
    else:
        assert again.begin("second", lambda: _whole(2.0)).read() is None


def test_what_is_not_finite_is_not_kept(tmp_path: Path) -> None:
    states = _states(tmp_path)
    with pytest.raises(NotFinite, match="stage first: not kept: weights"):
        states.begin("first", lambda: _whole(math.nan))
    assert list(tmp_path.iterdir()) == []


def test_who_has_no_place_keeps_nothing() -> None:
    with pytest.raises(Interrupted), NOT_KEPT.kept(lambda: WorkState({}, {})) as step:
        step()
        raise Interrupted
    assert NOT_KEPT.read() is None


@pytest.mark.parametrize("is_tensor", [True, False])
def test_what_was_changed_after_it_was_written_is_begun_anew(
    is_tensor: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    facts = {"steps": (1, 2), "by number": {10: "ten", 9: "nine"}}
    tensors = {
        "none": torch.zeros(0, 3),
        "one": torch.tensor(True),
        "half": torch.ones(2, 3, dtype=torch.bfloat16).T,
        "whole": torch.arange(4),
    }
    _states(tmp_path).begin("second", lambda: WorkState(tensors, facts))
    again = _states(tmp_path).whole
    assert again is not None and again.facts["by number"] == {"10": "ten", "9": "nine"}
    assert all(torch.equal(again.tensors[name], values) for name, values in tensors.items())
    (file,) = tmp_path.iterdir()
    with safe_open(file, "pt") as opened:
        header = opened.metadata()
        found = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    if is_tensor:
        found["whole"][3] = 4
    else:
        header["state"] = header["state"].replace("nine", "none")
    save_file(found, file, header)
    assert _states(tmp_path).whole is None
    assert "it was changed after it was written" in caplog.text
