"""The training loop on a capture of five small pictures: the same methods, seconds of budget."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import TINY, write_tiny_capture
from safetensors.torch import load_file

from handavatar.avatar import SCHEMA, CheckpointError, HandAvatar
from handavatar.capture.frames import CaptureError, read_capture
from handavatar.evaluate.perceptual import perceptual_loss
from handavatar.field.shading import CueSet, OrientedCues, TracedCues
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand import parts
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.rig import RigError
from handavatar.jobs.progress import Board, Progress
from handavatar.train import loop
from handavatar.train.loop import (
    METHODS,
    Interrupted,
    TrainOptions,
    begin_training,
    patch_pixels,
    train,
    train_step,
    training_frames,
)
from handavatar.train.outlines import EdgeSet
from handavatar.train.prior import SHIPPED_PRIOR
from handavatar.train.runs import (
    Checkpoint,
    latest_checkpoint,
    load_checkpoint,
    open_run,
    read_log,
)

STEPS = 6


@pytest.fixture(scope="module", autouse=True)
def _tiny_method() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(METHODS, "quick", TINY)
        yield


def _options(capture: Path, out: Path, steps: int = STEPS, seed: int = 0) -> TrainOptions:
    return TrainOptions(
        capture,
        out,
        steps=steps,
        seed=seed,
        checkpoint_every=2,
        device="cpu",
        perceptual="substitute",
    )


@pytest.fixture(scope="module")
def whole_run(
    tiny_capture: Path, tmp_path_factory: pytest.TempPathFactory, _tiny_method: None
) -> Path:
    """Trained without interruption; read only."""
    return train(_options(tiny_capture, tmp_path_factory.mktemp("runs") / "whole"))


def _assert_same_end(run: Path, whole_run: Path) -> None:
    ours, theirs = run / "avatar.safetensors", whole_run / "avatar.safetensors"
    assert ours.read_bytes() == theirs.read_bytes()
    assert read_log(open_run(run)) == read_log(open_run(whole_run))
    ends = [latest_checkpoint(open_run(folder)) for folder in (run, whole_run)]
    for name in ("model.safetensors", "adam.safetensors", "muon.safetensors"):
        first, second = ((end.folder / name).read_bytes() for end in ends if end is not None)
        assert first == second, name


# --- what training does ---------------------------------------------------------------------------


@pytest.mark.slow
def test_the_loss_of_a_patch_seen_again_and_again_falls(tiny_capture: Path) -> None:
    capture = read_capture(tiny_capture)
    frame = capture.frame(0)
    training = begin_training(capture, [frame], TINY, _options(tiny_capture, Path("-")))
    edges = EdgeSet.of(training.avatar.rig)
    perceptual = perceptual_loss("substitute")
    # All randomness comes from the step: the same one shows the same patch.
    figures = [
        train_step(training, [frame], None, edges, perceptual, TINY, step=1, seed=0)
        for _ in range(12)
    ]
    for name in ("loss", "color"):
        assert figures[-1][name] < figures[0][name], name
    assert figures[-1]["color"] < 0.7 * figures[0]["color"]
    assert figures[-1]["psnr"] > figures[0]["psnr"] + 2


def test_a_step_changes_all_but_the_frozen_encoder(tiny_capture: Path) -> None:
    capture = read_capture(tiny_capture)
    frames = [capture.frame(0)]
    training = begin_training(capture, frames, TINY, _options(tiny_capture, Path("-")))
    avatar = training.avatar
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    edges = EdgeSet.of(avatar.rig)
    train_step(training, frames, None, edges, perceptual_loss("substitute"), TINY, 1, seed=0)
    changed = {n for n, value in avatar.state_dict().items() if not torch.equal(value, before[n])}
    fixed = {name for name in before if name.startswith("occupancy.encoder")}
    fixed |= {"coefficients", "anchor_corners", "anchor_barycentric"}
    fixed |= {"illumination.position_codes", "illumination.wrist_reference"}
    reference = matrix_from_axis_angle(avatar.illumination.wrist_reference)
    torch.testing.assert_close(reference, matrix_from_axis_angle(frames[0].pose.rotations[0]))
    assert not changed & fixed
    for part in ("shape", "occupancy.decoder", "albedo.codes", "albedo.mlp", "illumination.mlp"):
        assert any(name.startswith(part) for name in changed), part


@pytest.mark.slow
def test_warm_steps_leave_the_occupancy_alone(whole_run: Path) -> None:
    warm, joint = (
        load_checkpoint(Checkpoint(whole_run / "checkpoints" / f"step-{step:09d}", step)).tensors
        for step in (2, 4)
    )
    outlines = {n: v for n, v in warm["outlines"].items() if n.startswith("decoder.")}
    for name, value in outlines.items():
        assert torch.equal(warm["model"][f"avatar.occupancy.{name}"], value), name
    changed = [name for name in outlines if name.startswith("decoder.mlp")]
    assert not all(
        torch.equal(joint["model"][f"avatar.occupancy.{name}"], outlines[name]) for name in changed
    )
    logged = read_log(open_run(whole_run))
    assert ["perceptual" in record for record in logged] == [False] * 3 + [True] * 3
    assert ["silhouette" in record for record in logged] == [False] * 3 + [True] * 3


def test_the_outlines_keep_the_encoder_and_teach_the_decoder(whole_run: Path) -> None:
    checkpoint = latest_checkpoint(open_run(whole_run))
    assert checkpoint is not None
    tensors = load_checkpoint(checkpoint).tensors
    outlines, prior = tensors["outlines"], load_file(SHIPPED_PRIOR)
    encoder = {n: v for n, v in prior.items() if n.startswith("encoder.")}
    for name, value in encoder.items():
        assert torch.equal(tensors["model"][f"avatar.occupancy.{name}"], value), name
    decoder = {n: v for n, v in prior.items() if n.startswith("decoder.")}
    assert decoder and decoder.keys() <= outlines.keys()
    assert HandAvatar.load(whole_run / "avatar.safetensors").occupancy.sharpness == TINY.sharpness
    assert not all(torch.equal(outlines[name], value) for name, value in decoder.items())


def test_the_run_folder_holds_everything(whole_run: Path, tiny_capture: Path) -> None:
    names = {path.name for path in whole_run.iterdir()}
    assert {"options.json", "run.json", "log.jsonl", "checkpoints", "avatar.safetensors"} <= names
    kept = sorted(path.name for path in (whole_run / "checkpoints").iterdir())
    assert kept == ["step-000000002", "step-000000004", "step-000000006"]
    run = open_run(whole_run)
    assert [record["step"] for record in read_log(run)] == list(range(1, STEPS + 1))
    assert {"loss", "psnr", "color", "silhouette", "occupancy"} <= read_log(run)[-1].keys()
    assert run.facts["capture"]["sha256"] == read_capture(tiny_capture).sha256
    assert run.facts["perceptual"] == perceptual_loss("substitute").name
    assert run.options["steps"] == STEPS and run.options["budget"]["patch_size"] == 16
    info = HandAvatar.load(run.avatar).info
    assert info["subject"] == "tiny" and info["side"] == "right"
    assert {"camera_from_world", "rotations", "translation"} == info["view"].keys()


@pytest.mark.slow
def test_several_threads_give_the_same_bytes_every_time(tiny_capture: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        first, second = (train(_options(tiny_capture, tmp_path / name)) for name in ("a", "b"))
    finally:
        torch.set_num_threads(before)
    _assert_same_end(first, second)
    assert not torch.are_deterministic_algorithms_enabled()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(
    tiny_capture: Path, tmp_path: Path
) -> None:
    runs = [
        train(_options(tiny_capture, tmp_path / str(index), steps=4, seed=seed))
        for index, seed in enumerate((3, 3, 4))
    ]
    first, second, third = ((run / "avatar.safetensors").read_bytes() for run in runs)
    assert first == second != third


@pytest.mark.slow
def test_tracked_poses_are_corrected_and_known_ones_are_not(
    tiny_capture: Path, whole_run: Path, tmp_path: Path
) -> None:
    capture = write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.8)
    run = open_run(train(_options(capture, tmp_path / "run", steps=4)))
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None
    model = load_checkpoint(checkpoint).tensors["model"]
    assert model["corrections.rotations.0"].shape == (16, 3)
    assert bool(model["corrections.rotations.0"].any() & model["corrections.translations.0"].any())
    assert "pose" in read_log(run)[-1]
    known = latest_checkpoint(open_run(whole_run))
    assert known is not None
    names = load_checkpoint(known).tensors["model"]
    assert not any(name.startswith("corrections.") for name in names)


def test_the_papers_method_takes_tracked_poses_as_they_are(tmp_path: Path) -> None:
    """It has neither the rounds of outlines nor corrections, and its own parts and optimiser."""
    folder = write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.8)
    capture = read_capture(folder)
    frames = [capture.frame(index) for index in capture.split("train")]
    method = METHODS["paper"]
    training = begin_training(capture, frames, method, _options(folder, tmp_path / "run"))
    assert training.corrections is None and training.optimizers.keys() == {"adam"}
    assert method.outline_rounds == method.personal_steps == method.warm_steps == 0
    assert training.avatar.illumination.chosen.name == "paper"
    assert (method.frames * method.patches, method.patch_size, method.num_samples) == (16, 32, 64)


@pytest.mark.slow
def test_detail_is_learned_last_and_begun_anew_by_whoever_was_stopped_in_it(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "quick", replace(TINY, detail_size=32, detail_steps=2))
    whole = train(_options(tiny_capture, tmp_path / "whole", steps=4))
    avatar = HandAvatar.load(whole)
    assert avatar.texture is not None and bool(avatar.texture.texels.any())
    assert avatar.info["detail"]["size"] == 32 and avatar.info["detail"]["steps"] == 2
    assert 0 < avatar.info["detail"]["seen_share"] < 1

    learn = loop.learn_detail

    def stopped_early(*args: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return learn(*args)

    monkeypatch.setattr(loop, "learn_detail", stopped_early)
    with pytest.raises(Interrupted, match="detail"):
        train(_options(tiny_capture, tmp_path / "stopped", steps=4))
    assert not (tmp_path / "stopped" / "avatar.safetensors").exists()
    monkeypatch.setattr(loop, "learn_detail", learn)
    again = train(_options(tiny_capture, tmp_path / "stopped", steps=4))
    assert (again / "avatar.safetensors").read_bytes() == (
        whole / "avatar.safetensors"
    ).read_bytes()
    assert [
        (METHODS[name].detail_size, METHODS[name].detail_steps) for name in ("joint", "paper")
    ] == [(0, 0)] * 2


# --- interruptions --------------------------------------------------------------------------------

KILLED = """
import json, os, signal, sys, time
from pathlib import Path
tests, capture, run, steps, moments = json.loads(sys.argv[1])
sys.path.insert(0, tests)
from conftest import TINY
from handavatar.train.loop import METHODS, TrainOptions, train

METHODS["quick"] = TINY
options = TrainOptions(Path(capture), Path(run), steps=steps, checkpoint_every=2, device="cpu",
                       perceptual="substitute")
log = Path(run, "log.jsonl")
count = lambda: log.read_bytes().count(b"\\n") if log.exists() else 0
for lines, later in moments:
    pid = os.fork()
    if pid == 0:
        train(options)
        os._exit(0)
    while count() < lines:
        time.sleep(0.001)
    time.sleep(later)
    os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    print("killed" if os.WIFSIGNALED(status) else "ended", count())
train(options)
"""
"""Imports once; every training is a fork of its own, killed at a moment the test draws."""


@pytest.mark.slow
def test_killed_at_random_moments_and_resumed_gives_the_same_weights_bit_by_bit(
    tiny_capture: Path, whole_run: Path, tmp_path: Path
) -> None:
    draw = torch.rand(3, generator=torch.Generator().manual_seed(7)).tolist()
    # After lines 2 and 4 of the log a checkpoint is written. The second run ends with four lines
    # or more, so that the third is killed while it starts.
    moments = [(lines, 0.15 * share) for lines, share in zip((2, 4, 4), draw, strict=True)]
    tests = Path(__file__).parent.parent
    arguments = [str(tests), str(tiny_capture), str(tmp_path / "run"), STEPS, moments]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, json.dumps(arguments)],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("killed") >= 2, done.stdout
    _assert_same_end(tmp_path / "run", whole_run)


def test_a_kill_before_the_first_line_of_the_run_is_no_obstacle(
    tiny_capture: Path, tmp_path: Path
) -> None:
    """What :func:`create_run` leaves if it is killed between its files."""
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "options.json").write_text("{}")
    (run / ".tmp-123-run.json").write_text("{")
    train(_options(tiny_capture, run, steps=1))
    assert (run / "avatar.safetensors").is_file()


def test_an_interrupt_saves_and_the_rest_continues(
    tiny_capture: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = loop.append_log
    handler = signal.getsignal(signal.SIGINT)

    def interrupting(run: object, step: int, record: dict[str, float]) -> None:
        append(run, step, record)
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(loop, "append_log", interrupting)
    options = _options(tiny_capture, tmp_path / "run")
    with pytest.raises(Interrupted, match="step 3"):
        train(options)
    assert signal.getsignal(signal.SIGINT) is handler
    checkpoint = latest_checkpoint(open_run(tmp_path / "run"))
    assert checkpoint is not None and checkpoint.step == 3
    assert not (tmp_path / "run" / "avatar.safetensors").exists()
    monkeypatch.setattr(loop, "append_log", append)
    train(options)
    _assert_same_end(tmp_path / "run", whole_run)


class _StoppedIn:
    """Tells the process to stop when a stage of a training has come to a step."""

    def __init__(self, job: str, step: int) -> None:
        self._place = (job, step)
        self._board = Board("train")
        self._board.listeners.append(self._hear)
        self.progress = Progress(self._board)

    def _hear(self, state: dict[str, Any], _: bool) -> None:
        if (state["job"], state["step"]) == self._place:
            os.kill(os.getpid(), signal.SIGTERM)


_SOME = (("outlines", 3), ("occupancy", 1), ("samples", 1), ("train", 5), ("detail", 1))
_REGISTRATION = (("poses", 28), ("poses", 71), ("offsets", 2))
_BEFORE_STEPS = (("outlines", 3), ("hands", 1), ("occupancy", 1), ("border", 1))
_WITH_LIGHT = (("samples", 2), ("sky", 1), ("tracing light", 3))
_STEPS_AND_DETAIL = (("train", 1), ("train", 5), ("views", 2), ("unwrapping", 1), ("detail", 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("confidence", "cues", "places"),
    [
        (1.0, OrientedCues(), _SOME),
        pytest.param(
            0.9,
            TracedCues(14),
            (*_REGISTRATION, *_BEFORE_STEPS, *_WITH_LIGHT, *_STEPS_AND_DETAIL),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_stopped_in_every_stage_it_gives_the_same_avatar(
    confidence: float,
    cues: CueSet,
    places: tuple[tuple[str, int], ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = replace(TINY, cues=cues, detail_size=32, detail_steps=3)
    monkeypatch.setitem(METHODS, "quick", small)
    capture = write_tiny_capture(tmp_path / "capture", confidence=confidence)
    whole = train(_options(capture, tmp_path / "whole"))
    options = _options(capture, tmp_path / "run")
    out, kept = tmp_path / "run", set[str]()
    for job, step in places:
        with pytest.raises(Interrupted, match="the same command goes on"):
            train(options, _StoppedIn(job, step).progress)
        kept |= {path.name for path in out.glob("*.unfinished*")}
    assert {name.partition(".")[0] for name in kept} == {"geometry", "samples", "detail"}
    run = train(options)
    _assert_same_end(run, whole)
    assert not list(run.glob("*.unfinished*"))


def test_a_resumed_training_keeps_the_part_points_that_it_began_with(
    tiny_capture: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    (run / "avatar.safetensors").unlink()
    shutil.rmtree(run / "checkpoints" / "step-000000006")
    monkeypatch.setattr(parts, "divide_into_parts", partial(divide_into_parts, seed=1))
    train(_options(tiny_capture, run))
    _assert_same_end(run, whole_run)


def test_a_checkpoint_cut_in_half_falls_back_to_the_one_before(
    tiny_capture: Path, whole_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    (run / "avatar.safetensors").unlink()
    newest = run / "checkpoints" / "step-000000006" / "model.safetensors"
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    train(_options(tiny_capture, run))
    assert (run / "corrupt" / "step-000000006").is_dir()
    _assert_same_end(run, whole_run)


def test_a_finished_run_is_not_trained_again(
    tiny_capture: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    monkeypatch.setattr(loop, "train_step", None)
    train(_options(tiny_capture, run))
    _assert_same_end(run, whole_run)
    with pytest.raises(CheckpointError, match="not empty"):
        train(replace(_options(tiny_capture, run), resume="never"))


@pytest.mark.slow
def test_an_interrupted_run_is_gone_on_with_beside_a_finished_one_of_a_later_date(
    tiny_capture: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runs = Path("outputs") / "tiny" / "quick"
    shutil.copytree(whole_run, runs / "2099-01-01_000000")
    shutil.copytree(whole_run, runs / "2020-01-01_000000")
    (runs / "2020-01-01_000000" / "avatar.safetensors").unlink()
    options = replace(_options(tiny_capture, Path("-")), out=None)
    assert train(options) == runs / "2020-01-01_000000"
    again = train(replace(options, steps=1))
    assert again.parent == runs and again not in (runs / "2020-01-01_000000", runs / "2099-01-01")


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_checkpoint(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverging(*arguments: object) -> dict[str, float]:
        step = arguments[6]
        return {"loss": float("nan") if step == 3 else 1.0, "psnr": 10.0}

    monkeypatch.setitem(METHODS, "quick", replace(TINY, warm_steps=0))
    monkeypatch.setattr(loop, "train_step", diverging)
    with pytest.raises(FloatingPointError, match="step 3"):
        train(_options(tiny_capture, tmp_path / "run"))
    checkpoint = latest_checkpoint(open_run(tmp_path / "run"))
    assert checkpoint is not None and checkpoint.step == 2
    assert not (tmp_path / "run" / "avatar.safetensors").exists()


# --- bad input ------------------------------------------------------------------------------------


def test_a_capture_without_training_frames_is_refused(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture", "bb")
    with pytest.raises(CaptureError, match="train"):
        train(_options(capture, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_capture_of_another_rig_is_refused(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture", "a", rig_sha256="f" * 64)
    with pytest.raises(RigError, match="ffffffffffff"):
        train(_options(capture, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_missing_prior_is_refused(tiny_capture: Path, tmp_path: Path) -> None:
    options = replace(_options(tiny_capture, tmp_path / "run"), prior=tmp_path / "none")
    with pytest.raises(CheckpointError, match="no occupancy prior"):
        train(options)
    assert not (tmp_path / "run").exists()


def test_pictures_smaller_than_a_patch_are_refused(tiny_capture: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(METHODS, "quick", replace(TINY, patch_size=49, warm_steps=0))
        with pytest.raises(CaptureError, match="smaller than a 49 x 49 patch"):
            train(_options(tiny_capture, tmp_path / "run"))


# --- patches and frames ---------------------------------------------------------------------------


def test_patches_are_square_grids_inside_the_picture_and_mostly_on_the_hand() -> None:
    mask = torch.zeros(40, 60, dtype=torch.bool)
    mask[:3, 50:] = True  # In a corner: centres there must be moved inwards.
    generator = torch.Generator().manual_seed(0)
    strides, on_hand = set(), 0
    for _ in range(100):
        x, y = patch_pixels(mask, 8, (1, 2, 5, 9), generator).unbind(-1)
        stride = int(x[1] - x[0])
        strides.add(stride)
        assert int(x.min()) >= 0 and int(x.max()) < 60 and int(y.min()) >= 0 and int(y.max()) < 40
        assert torch.equal(x.view(8, 8)[0] - x[0], stride * torch.arange(8))
        assert torch.equal(x.view(8, 8), x[:8].expand(8, 8))
        assert torch.equal(y.view(8, 8), y.view(8, 8)[:, :1].expand(8, 8))
        assert torch.equal(y.view(8, 8)[:, 0] - y[0], stride * torch.arange(8))
        on_hand += bool(mask[y, x].any())
    assert strides == {1, 2, 5}  # 9 does not fit.
    assert on_hand > 90


def test_an_empty_mask_gives_the_middle() -> None:
    pixels = patch_pixels(torch.zeros(9, 9, dtype=torch.bool), 3, (1,), torch.Generator())
    assert pixels.tolist()[4] == [4, 4]


def test_every_epoch_shows_every_frame_once_in_another_order() -> None:
    epochs = [[loop._frame_number(7, 7 * epoch + i, seed=1) for i in range(7)] for epoch in (0, 1)]
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(range(7)) and epochs[0] != epochs[1]


def test_a_run_whose_weights_meant_something_else_is_not_continued(
    tiny_capture: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    options = replace(_options(tiny_capture, run), steps=1)
    train(options)
    record = json.loads((run / "options.json").read_text())
    (run / "options.json").write_text(json.dumps({**record, "avatar_schema": SCHEMA - 1}))
    with pytest.raises(CheckpointError, match="weights mean something else"):
        train(options)


def test_a_run_of_another_seed_is_not_continued(tiny_capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = replace(_options(tiny_capture, run), steps=1)
    train(options)
    with pytest.raises(CheckpointError, match="was begun with seed 0, now it is 1"):
        train(replace(options, seed=options.seed + 1))
    with pytest.raises(ValueError, match="`steps`: found 0, expected at least 1"):
        train(replace(options, steps=0))


@pytest.mark.slow
def test_large_pictures_are_binned_for_all_but_the_detail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_tiny_capture(tmp_path / "large", "ab", size=96)
    capture = read_capture(folder)
    method = replace(TINY, picture_size=48, detail_size=32, detail_steps=2)
    assert {frame.camera.width for frame in training_frames(capture, method)} == {48}
    assert {frame.camera.width for frame in training_frames(capture, METHODS["paper"])} == {96}
    monkeypatch.setitem(METHODS, "quick", method)
    widths: dict[str, set[int]] = {}
    for name in ("find_seen_samples", "learn_detail"):
        work = getattr(loop, name)

        def spied(
            avatar: HandAvatar, frames: Any, *rest: Any, name: str = name, work: Any = work
        ) -> Any:
            widths[name] = {frame.camera.width for frame in frames}
            return work(avatar, frames, *rest)

        monkeypatch.setattr(loop, name, spied)
    avatar = HandAvatar.load(train(_options(folder, tmp_path / "run", steps=4)))
    # Of very many frames some stay binned.
    monkeypatch.setattr(loop, "_DETAILED_FRAMES", 1)
    some = loop._detailed_frames(
        read_capture(write_tiny_capture(tmp_path / "many", "aab", size=96)),
        [capture.frame(0).binned(48)] * 2,
        [0, 1],
    )
    assert [frame.camera.width for frame in some] == [96, 48]
    assert widths == {"find_seen_samples": {48}, "learn_detail": {96}}
    assert avatar.seen_frames is not None and avatar.seen_frames.unique().tolist() == [0, 1]
    assert avatar.texture is not None and bool(avatar.texture.texels.any())
