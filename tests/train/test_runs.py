"""Run folders and checkpoints: whatever happens to the disk or the process, nothing is lost."""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from handavatar.avatar import CheckpointError
from handavatar.jobs.files import read_marker
from handavatar.jobs.finite import NotFinite
from handavatar.train import runs
from handavatar.train.live import live_folder, read_live
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)
from handavatar.train.provenance import folder_sha256
from handavatar.train.runs import (
    Run,
    append_log,
    create_run,
    default_run_folder,
    interrupted_run_folder,
    latest_checkpoint,
    load_checkpoint,
    locked,
    open_run,
    read_log,
    save_checkpoint,
    truncate_log,
)


def _new_run(folder: Path) -> Run:
    return create_run(
        folder,
        {"steps": 10},
        seed=1,
        capture=folder,
        capture_sha256="0" * 64,
        perceptual="gradient-pyramid",
    )


def _tensors(step: int) -> dict[str, dict[str, torch.Tensor]]:
    generator = torch.Generator().manual_seed(step)
    return {
        "model": {
            "layer.weight": torch.randn(8, 5, generator=generator),
            "mask": torch.arange(4) > 1,
        },
        "optimizer": {"0.step": torch.tensor(float(step)), "0.exp_avg": torch.full((8, 5), 1e-30)},
    }


def _assert_holds(run: Run, step: int) -> None:
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None and checkpoint.step == step
    contents = load_checkpoint(checkpoint)
    assert contents.state == {"step": step, "rate": 0.1}
    for stem, group in _tensors(step).items():
        assert contents.tensors[stem].keys() == group.keys()
        for name, value in group.items():
            assert torch.equal(contents.tensors[stem][name], value)


def _save(run: Run, step: int) -> None:
    save_checkpoint(run, step, _tensors(step), {"step": step, "rate": 0.1})


def test_a_run_folder_says_where_it_came_from(tmp_path: Path) -> None:
    run = open_run(_new_run(tmp_path / "run").folder)
    assert run.options == {"steps": 10}
    assert run.facts["seed"] == 1
    assert run.facts["perceptual"] == "gradient-pyramid"
    assert run.facts["versions"]["torch"].startswith("2.")
    assert run.facts["capture"]["sha256"] == "0" * 64
    assert isinstance(run.facts["command"], list)


def test_a_folder_in_use_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(CheckpointError, match="not empty"):
        _new_run(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("text", ['{"epochs": 3}', '{"avatar_schema": 1}'])
def test_only_our_own_beginning_is_gone_on_with(tmp_path: Path, text: str) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "options.json").write_text(text)
    if "epochs" in text:
        with pytest.raises(CheckpointError, match="not empty"):
            _new_run(tmp_path)
        assert (tmp_path / "options.json").read_text() == text
    else:
        assert _new_run(tmp_path).options == {"steps": 10}


def test_no_run_folder_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no run\.json"):
        open_run(tmp_path)
    run = _new_run(tmp_path / "run")
    (run.folder / "run.json").write_text('{"versions": ')
    with pytest.raises(CheckpointError, match="not JSON"):
        _ = open_run(run.folder).facts


def _begun(folder: Path, started: str, sha256: str = "a", method: str = "quick") -> Path:
    """A run that says that it was begun then."""
    create_run(
        folder,
        {"method": method},
        seed=1,
        capture=folder,
        capture_sha256=sha256,
        perceptual="gradient-pyramid",
    )
    facts = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(facts | {"started": started}))
    return folder


def test_resume_auto_goes_by_what_runs_say_of_themselves(tmp_path: Path) -> None:
    assert interrupted_run_folder("a", "quick", tmp_path) is None
    runs_of = tmp_path / "hand" / "quick"
    finished = _begun(runs_of / "2099-01-01_000000", "2026-11-30T12:00:00+00:00")
    (finished / "avatar.safetensors").write_bytes(b"whole")
    assert interrupted_run_folder("a", "quick", tmp_path) is None
    # Named, and written, in another order than they were begun in; one in another zone.
    earlier = _begun(runs_of / "zzz", "2026-11-30T10:30:00+01:00")
    last = _begun(runs_of / "aaa", "2026-11-30T10:00:00+00:00")
    os.utime(last / "run.json", (0, 0))
    os.utime(earlier / "run.json")
    _begun(runs_of / "other-capture", "2026-11-30T11:00:00+00:00", sha256="b")
    _begun(runs_of / "other-method", "2026-11-30T11:00:00+00:00", method="best")
    (runs_of / "never-begun").mkdir()
    assert interrupted_run_folder("a", "quick", tmp_path) == last
    (last / "avatar.safetensors").write_bytes(b"whole")
    assert interrupted_run_folder("a", "quick", tmp_path) == earlier
    default = default_run_folder(tmp_path / "hand", "quick", tmp_path)
    assert default.parent == runs_of


@pytest.mark.parametrize("text", ['{"capture": ', "[]", "{}", '{"capture": 3, "started": "now"}'])
def test_resume_auto_passes_over_what_cannot_be_read_and_says_so(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    broken = _begun(tmp_path / "hand" / "quick" / "2099", "2026-11-30T12:00:00+00:00")
    (broken / "run.json").write_text(text)
    whole = _begun(tmp_path / "hand" / "quick" / "2000", "2026-11-30T10:00:00+00:00")
    assert interrupted_run_folder("a", "quick", tmp_path) == whole
    assert "2099: is passed over" in caplog.text


def test_checkpoints_return_bit_for_bit_and_old_ones_are_pruned(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    assert latest_checkpoint(run) is None
    for step in (10, 20, 30, 40, 1000):
        _save(run, step)
        _assert_holds(run, step)
    assert sorted(p.name for p in run.checkpoints.iterdir()) == [
        "step-000000030",
        "step-000000040",
        "step-000001000",
    ]


def test_saving_a_step_again_replaces_it(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    save_checkpoint(run, 7, {"model": {"a": torch.zeros(1)}}, {})
    _save(run, 7)
    _assert_holds(run, 7)
    assert len(list(run.checkpoints.iterdir())) == 1


def test_a_damaged_newest_checkpoint_gives_way_to_the_one_before(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every file cut at random, flipped, emptied, filled with garbage, or gone."""
    chance = random.Random(0)
    run = _new_run(tmp_path / "run")
    _save(run, 1)
    names = ["model.safetensors", "optimizer.safetensors", "state.json", "MANIFEST.json"]
    kinds = ["cut", "flip", "empty", "garbage", "gone"]
    for number, (name, kind) in enumerate((n, k) for n in names for k in kinds for _ in range(4)):
        _save(run, 2)
        path = run.checkpoints / "step-000000002" / name
        data = bytearray(path.read_bytes())
        if kind == "cut":
            path.write_bytes(data[: chance.randrange(len(data))])
        elif kind == "flip":
            at = chance.randrange(len(data))
            # Case within the manifest's hex digits carries no meaning: flip a low bit.
            data[at] ^= 1
            path.write_bytes(data)
        elif kind == "empty":
            path.write_bytes(b"")
        elif kind == "garbage":
            path.write_bytes(chance.randbytes(chance.randrange(1, 300)))
        else:
            path.unlink()
        caplog.clear()
        try:
            _assert_holds(run, 1)
        except AssertionError:
            # The only harmless flips: white space in the manifest.
            assert (name, kind) == ("MANIFEST.json", "flip")
            _assert_holds(run, 2)
        else:
            assert "moved to corrupt" in caplog.text
            assert len(list((run.folder / "corrupt").iterdir())) >= 1, number


def test_a_named_checkpoint_cut_in_half_is_a_clear_error(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    _save(run, 5)
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None
    path = checkpoint.folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(checkpoint)
    message = str(caught.value)
    assert "model.safetensors" in message and "`resume='auto'`" in message
    assert len(message.splitlines()) <= 6


def test_a_manifest_cannot_reach_outside_its_folder(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    _save(run, 5)
    path = run.checkpoints / "step-000000005" / "MANIFEST.json"
    manifest = json.loads(path.read_text())
    manifest["files"]["../../options.json"] = manifest["files"]["state.json"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match="outside the folder"):
        load_checkpoint(runs.Checkpoint(path.parent, 5))


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    second = pytest.raises(CheckpointError, match=f"process {os.getpid()}")
    with locked(run), second, locked(run):
        pass
    with locked(run):
        pass


@pytest.mark.parametrize("failing_call", range(7))
def test_a_full_disk_leaves_the_checkpoint_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing_call: int
) -> None:
    """Each write-to-disk call of a save fails in turn (four files, two folders, then none)."""
    run = _new_run(tmp_path / "run")
    _save(run, 1)
    calls = 0
    real_sync = os.fsync

    def sync(descriptor: int) -> None:
        nonlocal calls
        calls += 1
        if calls == failing_call + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        real_sync(descriptor)

    monkeypatch.setattr(os, "fsync", sync)
    num_syncs = 6
    if failing_call < num_syncs:
        with pytest.raises(OSError, match="No space"):
            _save(run, 2)
    else:
        _save(run, 2)
    monkeypatch.undo()
    # Once the folder has its final name (the last sync), the new one is whole already.
    _assert_holds(run, 2 if failing_call >= num_syncs - 1 else 1)
    assert not list(run.checkpoints.glob(".tmp-*"))


def test_too_little_space_is_noticed_before_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = _new_run(tmp_path / "run")
    monkeypatch.setattr(runs.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 100}))
    with pytest.raises(OSError, match="100") as caught:
        _save(run, 1)
    assert caught.value.errno == errno.ENOSPC
    assert latest_checkpoint(run) is None


_SAVE_FOREVER = """
import sys, torch
from pathlib import Path
from handavatar.train.runs import Run, latest_checkpoint, save_checkpoint
torch.set_num_threads(1)
run = Run(Path(sys.argv[1]))
newest = latest_checkpoint(run)
step = newest.step if newest else 0
print("ready", flush=True)
while True:
    step += 1
    tensors = {"model": {"a": torch.full((20000,), float(step))}, "optimizer": {"b": torch.ones(9)}}
    save_checkpoint(run, step, tensors, {"step": step})
"""


@pytest.mark.slow
def test_a_kill_while_saving_never_loses_the_last_checkpoint(tmp_path: Path) -> None:
    """SIGKILL at random moments: the newest checkpoint is whole and never older than before."""
    chance = random.Random(3)
    run = _new_run(tmp_path / "run")
    newest = 0
    for _ in range(4):
        command = [sys.executable, "-c", _SAVE_FOREVER, str(run.folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            time.sleep(chance.uniform(0.02, 0.4))
            process.send_signal(signal.SIGKILL)
        checkpoint = latest_checkpoint(run)
        if checkpoint is None:
            assert newest == 0
            continue
        assert checkpoint.step >= newest
        newest = checkpoint.step
        values = load_checkpoint(checkpoint).tensors["model"]["a"]
        assert torch.equal(values, torch.full((20000,), float(newest)))
        # Whatever has its final name was whole: nothing needed to be set aside.
        assert not (run.folder / "corrupt").exists()
    assert newest > 0


def test_the_log_after_a_resume_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    straight, broken = _new_run(tmp_path / "a"), _new_run(tmp_path / "b")
    for step in range(1, 9):
        append_log(straight, step, {"loss": 1 / step})
    for step in range(1, 7):
        append_log(broken, step, {"loss": 1 / step})
    with open(broken.log, "a") as file:
        file.write('{"step": 7, "lo')  # torn by the kill
    assert [record["step"] for record in read_log(broken)] == [1, 2, 3, 4, 5, 6]
    truncate_log(broken, 4)
    for step in range(5, 9):
        append_log(broken, step, {"loss": 1 / step})
    assert broken.log.read_bytes() == straight.log.read_bytes()
    assert read_log(Run(tmp_path / "nowhere")) == []


def test_nan_never_reaches_a_file(tmp_path: Path) -> None:
    run = _new_run(tmp_path / "run")
    with pytest.raises(ValueError):
        append_log(run, 1, {"loss": float("nan")})
    with pytest.raises(NotFinite, match=r"checkpoint of step 1: state\.loss is inf"):
        save_checkpoint(run, 1, {}, {"loss": float("inf")})
    assert not run.log.exists() and latest_checkpoint(run) is None


@pytest.mark.parametrize("stem", ["model", "optimizer"])
def test_a_checkpoint_with_nan_is_not_written_and_the_one_before_stays(
    tmp_path: Path, stem: str
) -> None:
    run = _new_run(tmp_path / "run")
    _save(run, 3)
    tensors = _tensors(4)
    name = {"model": "layer.weight", "optimizer": "0.exp_avg"}[stem]
    tensors[stem][name][2, 1] = float("nan")
    with pytest.raises(NotFinite, match=rf"of step 4: {stem}\.{name} holds NaN at \[2, 1\]"):
        save_checkpoint(run, 4, tensors, {"step": 4, "rate": 0.1})
    _assert_holds(run, 3)
    assert [path.name for path in run.checkpoints.iterdir()] == ["step-000000003"]


@pytest.mark.parametrize("file", ["model", "state"])
def test_a_checkpoint_that_an_older_version_wrote_with_nan_is_put_aside(
    tmp_path: Path, file: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = _new_run(tmp_path / "run")
    _save(run, 3)
    tensors, state = _tensors(4), {"step": 4, "rate": 0.1}
    with monkeypatch.context() as older:
        older.setattr(runs, "require_finite", lambda *_: None)
        dumps = json.dumps
        older.setattr(runs.json, "dumps", lambda value, **_: dumps(value))
        if file == "model":
            tensors["model"]["layer.weight"][0, 0] = float("inf")
        else:
            state["rate"] = float("nan")
        checkpoint = save_checkpoint(run, 4, tensors, state)
    what = {"model": r"model\.layer\.weight holds inf at \[0, 0\]", "state": r"state\.rate is NaN"}
    with pytest.raises(CheckpointError, match=f"cannot be gone on from: {what[file]}"):
        load_checkpoint(checkpoint)
    _assert_holds(run, 3)
    assert (run.folder / "corrupt" / "step-000000004").is_dir()
    assert "step-000000004" in caplog.text and "moved to corrupt/" in caplog.text


def _trained(num_steps: int, model: torch.nn.Linear, optimizer: torch.optim.Optimizer) -> None:
    for step in range(num_steps):
        optimizer.zero_grad()
        inputs = torch.randn(4, 3, generator=torch.Generator().manual_seed(step))
        model(inputs).square().mean().backward()
        optimizer.step()


def _adam(model: torch.nn.Linear) -> torch.optim.Adam:
    groups = [
        {"params": [model.weight], "lr": 0.1 / 3, "name": "weights"},
        {"params": [model.bias], "lr": 1e-3, "betas": (0.8, 0.99)},
    ]
    return torch.optim.Adam(groups)


def test_adam_continues_bit_for_bit_through_a_checkpoint(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = torch.nn.Linear(3, 2)
    optimizer = _adam(model)
    _trained(5, model, optimizer)
    run = _new_run(tmp_path / "run")
    save_checkpoint(
        run,
        5,
        {"model": dict(model.state_dict()), "optimizer": optimizer_tensors(optimizer)},
        {"optimizer": optimizer_options(optimizer)},
    )
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None
    contents = load_checkpoint(checkpoint)
    twin = torch.nn.Linear(3, 2)
    twin.load_state_dict(contents.tensors["model"])
    twin_optimizer = _adam(twin)
    restore_optimizer(twin_optimizer, contents.tensors["optimizer"], contents.state["optimizer"])
    assert twin_optimizer.param_groups[1]["betas"] == (0.8, 0.99)
    _trained(7, model, optimizer)
    _trained(7, twin, twin_optimizer)
    assert torch.equal(model.weight, twin.weight) and torch.equal(model.bias, twin.bias)
    for name, value in optimizer_tensors(optimizer).items():
        assert torch.equal(value, optimizer_tensors(twin_optimizer)[name]), name


def test_an_optimizer_of_another_model_is_refused() -> None:
    model = torch.nn.Linear(3, 2)
    optimizer = _adam(model)
    _trained(1, model, optimizer)
    tensors, options = optimizer_tensors(optimizer), optimizer_options(optimizer)
    with pytest.raises(CheckpointError, match="shape"):
        restore_optimizer(_adam(torch.nn.Linear(4, 2)), tensors, options)
    with pytest.raises(CheckpointError, match="groups"):
        restore_optimizer(torch.optim.Adam(model.parameters()), tensors, options)


def test_a_fingerprint_sees_contents_and_names(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "transforms.json").write_text("{}")
    (tmp_path / "images" / "0.png").write_bytes(b"0")
    names = ("transforms.json", "images")
    first = folder_sha256(tmp_path, names)
    assert first == folder_sha256(tmp_path, names)
    (tmp_path / "overview.png").write_bytes(b"ignored")
    assert first == folder_sha256(tmp_path, names)
    (tmp_path / "images" / "0.png").rename(tmp_path / "images" / "1.png")
    assert first != folder_sha256(tmp_path, names)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_where_a_file_should_be_is_not_waited_for(tmp_path: Path) -> None:
    """An archive may bring one; who opens it waits for one who writes."""
    run = _new_run(tmp_path / "run")
    append_log(run, 1, {"psnr": 1.0})
    checkpoint = save_checkpoint(run, 7, _tensors(7), {"step": 7})
    live_folder(run).mkdir()

    def piped(path: Path) -> Path:
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        return path

    for read, path, message in (
        (lambda: run.facts, run.folder / "run.json", "not a plain file"),
        (lambda: read_log(run), run.log, "not a plain file"),
        (lambda: load_checkpoint(checkpoint), checkpoint.folder / "MANIFEST.json", "not a plain"),
    ):
        piped(path)
        with pytest.raises((OSError, CheckpointError), match=message):
            read()
    piped(live_folder(run) / "progress.json")
    assert read_live(run) is None
    piped(run.folder / ".handavatar")
    assert read_marker(run.folder) is None
