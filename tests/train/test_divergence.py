"""NaN and infinity, put into a training in 51 ways: each ends in a finite avatar or a clear stop.

A stop names what was not finite and when, leaves only checkpoints that are good, and says what to
do; whoever does that gets a finite avatar.
"""

import copy
import json
import math
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import TINY, bent_pose, camera_above, write_tiny_capture
from safetensors.torch import load_file, save_file
from torch import Tensor

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Capture, Frame
from handavatar.cli import main
from handavatar.cli.failures import BAD_DATA, NUMERICAL
from handavatar.field.shading import TracedCues
from handavatar.hand.pose import HandPose
from handavatar.jobs.finite import find_not_finite
from handavatar.train import border, detail, loop, outlines, pretraining, registration, sky
from handavatar.train.loop import METHODS, Training
from handavatar.train.prior import SHIPPED_PRIOR
from handavatar.train.runs import open_run, read_log

STEPS = 6
"""Three warm ones, three joint ones; a checkpoint after every second."""
DETAILED = replace(TINY, detail_size=32, detail_steps=3)
TRACED = replace(TINY, cues=TracedCues(8))
FAST = {"warm step: albedo code", "last step: adam"}
"""Within a stage and at the very end, for every day."""


class Killed(Exception):
    """In place of a signal that ends the process."""


@dataclass(frozen=True)
class Injection:
    """One way to spoil a training.

    Attributes:
        inject: spoils it, once or for as long as the patch lasts.
        expected: pattern of what must be named.
        is_tracked: whether the capture's poses are corrected.
        method: of training.
        is_whole: whether the stages before the first step are run; else they were run before.
        prior: whether the given prior is what is spoilt.
    """

    inject: Callable[[pytest.MonkeyPatch], None]
    expected: str
    is_tracked: bool = False
    method: loop.Method = TINY
    is_whole: bool = False
    prior: bool = False


def _put(values: Tensor, bad: float) -> None:
    with torch.no_grad():
        values.view(-1)[values.numel() // 2] = bad


# --- what is spoilt -------------------------------------------------------------------------------


def _in_frames(change: Callable[[Frame], Frame]) -> Callable[[pytest.MonkeyPatch], None]:
    """The second frame says something that is no number."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        read = Capture.frame

        def frame(self: Capture, index: int) -> Frame:
            return change(read(self, index)) if index == 1 else read(self, index)

        patch.setattr(Capture, "frame", frame)

    return inject


def _spoilt_pose(frame: Frame, name: str, bad: float) -> Frame:
    values = {key: value.clone() for key, value in vars(frame.pose).items()}
    _put(values[name], bad)
    return replace(frame, pose=HandPose(**values))


def _spoilt_coefficients(patch: pytest.MonkeyPatch) -> None:
    read = loop.read_capture

    def spoilt(folder: Path) -> Capture:
        return replace(read(folder), shape_coefficients=torch.full((10,), math.nan))

    patch.setattr(loop, "read_capture", spoilt)


def _after_stage(
    name: str, spoil: Callable[..., None], times: int = 1
) -> Callable[[pytest.MonkeyPatch], None]:
    """What a function of the loop leaves is spoilt; the first argument is what it works on."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        work, left = getattr(loop, name), [times]

        def spoilt(*arguments: Any, **named: Any) -> Any:
            result = work(*arguments, **named)
            left[0] -= 1
            if left[0] == 0:
                spoil(*arguments)
            return result

        patch.setattr(loop, name, spoilt)

    return inject


def _result(
    module: Any, name: str, bad: float, call: int = 1
) -> Callable[[pytest.MonkeyPatch], None]:
    """A loss, or whatever a function returns, is not finite in one of its calls."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        work, left = getattr(module, name), [call]

        def spoilt(*arguments: Any, **named: Any) -> Any:
            result = work(*arguments, **named)
            left[0] -= 1
            if left[0] != 0:
                return result
            # The first of several results is the loss.
            return (result[0] * bad, *result[1:]) if isinstance(result, tuple) else result * bad

        patch.setattr(module, name, spoilt)

    return inject


def _gradients_of(
    module: Any, name: str, call: int, group: int = 0
) -> Callable[[pytest.MonkeyPatch], None]:
    """The gradients of one optimiser step of a module's are not finite."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        step, left = torch.optim.Adam.step, [0]
        inside = [False]
        work = getattr(module, name)

        def during(*arguments: Any, **named: Any) -> Any:
            inside[0] = True
            try:
                return work(*arguments, **named)
            finally:
                inside[0] = False

        def spoilt(self: torch.optim.Adam, closure: None = None) -> None:
            left[0] += inside[0]
            if inside[0] and left[0] == call:
                gradient = self.param_groups[group]["params"][0].grad
                assert gradient is not None
                _put(gradient, math.nan)
            step(self)

        patch.setattr(module, name, during)
        patch.setattr(torch.optim.Adam, "step", spoilt)

    return inject


def _shape_gradient(patch: pytest.MonkeyPatch) -> None:
    step = outlines._shape_step

    def spoilt(avatar: HandAvatar, *rest: Any) -> float:
        value = step(avatar, *rest)
        gradient = next(avatar.shape.parameters()).grad
        assert gradient is not None
        _put(gradient, math.nan)
        return value

    patch.setattr(outlines, "_shape_step", spoilt)


def _registered(change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """What registration finds is spoilt before it is taken."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        register = registration.register_frames
        patch.setattr(registration, "register_frames", lambda *a, **k: change(register(*a, **k)))

    return inject


def _spoilt_poses(found: Any) -> Any:
    _put(found.poses.translation, math.nan)
    return found


def _after_step(
    number: int, spoil: Callable[[Training], None]
) -> Callable[[pytest.MonkeyPatch], None]:
    """Something is spoilt at the end of a step, warm or joint."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        for name, place in (("warm_step", 3), ("train_step", 6)):
            work = getattr(loop, name)

            def spoilt(*arguments: Any, work: Any = work, place: int = place) -> Any:
                figures = work(*arguments)
                if arguments[place] == number:
                    spoil(arguments[0])
                return figures

            patch.setattr(loop, name, spoilt)

    return inject


def _weight(name: str, bad: float = math.nan) -> Callable[[Training], None]:
    def spoil(training: Training) -> None:
        _put(loop.model_tensors(training)[name], bad)

    return spoil


def _state(optimizer: str, name: str, bad: float) -> Callable[[Training], None]:
    def spoil(training: Training) -> None:
        states = training.optimizers[optimizer].state
        _put(next(state[name] for state in states.values() if name in state), bad)

    return spoil


def _rate(training: Training) -> None:
    # "lr" is set anew at every step; this is what it is set from.
    training.optimizers["adam"].param_groups[0]["initial_lr"] = math.nan


def _gradient_in_step(number: int, optimizer: str) -> Callable[[pytest.MonkeyPatch], None]:
    """A gradient of one step is not finite, and the loss is."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        for name, place in (("warm_step", 3), ("train_step", 6)):
            work = getattr(loop, name)

            def spoilt(*arguments: Any, work: Any = work, place: int = place) -> Any:
                chosen = arguments[0].optimizers[optimizer]
                if arguments[place] != number:
                    return work(*arguments)
                step = chosen.step

                def with_nan() -> None:
                    parameters = [p for g in chosen.param_groups for p in g["params"]]
                    gradient = next(p.grad for p in parameters if p.grad is not None)
                    _put(gradient, math.nan)
                    step()

                chosen.step = with_nan
                try:
                    return work(*arguments)
                finally:
                    del chosen.step

            patch.setattr(loop, name, spoilt)

    return inject


def _texels(avatar: HandAvatar, *_: Any) -> None:
    assert avatar.texture is not None
    _put(avatar.texture.texels, math.nan)


def _unwrapped(patch: pytest.MonkeyPatch) -> None:
    unwrap = detail.unwrap_frames

    def spoilt(*arguments: Any) -> Any:
        found = unwrap(*arguments)
        found.residual.fill_(math.nan)
        return found

    patch.setattr(detail, "unwrap_frames", spoilt)


def _sky(patch: pytest.MonkeyPatch) -> None:
    found = sky.composite_sparse
    patch.setattr(sky, "composite_sparse", lambda *a: found(*a) * math.nan)


def _stored_checkpoint(name: str, step: int, bad: float) -> Callable[[pytest.MonkeyPatch], None]:
    """A version that did not ask has written a checkpoint with NaN, and was killed then."""

    def inject(patch: pytest.MonkeyPatch) -> None:
        save = loop.save_checkpoint

        def unasked(run: Any, at: int, tensors: Any, state: Any) -> Any:
            if at != step:
                return save(run, at, tensors, state)
            group, _, key = name.partition(".")
            spoilt = {stem: dict(values) for stem, values in tensors.items()}
            spoilt[group][key] = spoilt[group][key].clone()
            _put(spoilt[group][key], bad)
            with pytest.MonkeyPatch.context() as older:
                older.setattr("handavatar.train.runs.require_finite", lambda *_: None)
                save(run, at, spoilt, state)
            raise Killed

        patch.setattr(loop, "save_checkpoint", unasked)

    return inject


NAN, INF = math.nan, math.inf
CODES = "avatar.albedo.codes"
ALBEDO = "avatar.albedo.mlp.output.weight"
LIGHT = "avatar.illumination.mlp.output.weight"
SHAPE = "avatar.shape.mlp.output.weight"
DECODER = "avatar.occupancy.decoder.mlp.output.weight"
ENCODER = "avatar.occupancy.encoder.input.weight"
POSE = "corrections.rotations.1"
PLACE = "corrections.translations.0"


def _camera(frame: Frame, **changes: Any) -> Frame:
    """Past what a camera refuses when it is made, as a fault of the memory would be."""
    camera = copy.copy(frame.camera)
    vars(camera).update(changes)
    return replace(frame, camera=camera)


INJECTIONS: dict[str, Injection] = {
    # What a training is given.
    "frame: rotations": Injection(
        _in_frames(lambda f: _spoilt_pose(f, "rotations", NAN)), "frame 000001 .*pose.rotations"
    ),
    "frame: translation": Injection(
        _in_frames(lambda f: _spoilt_pose(f, "translation", INF)), "frame 000001 .*translation"
    ),
    "frame: gain": Injection(
        _in_frames(lambda f: replace(f, gain=torch.tensor([1.0, NAN, 1.0]))),
        "frame 000001 .*gain holds NaN",
    ),
    "frame: focal length": Injection(
        _in_frames(lambda f: _camera(f, focal=(NAN, 80.0))), "frame 000001 .*camera.focal.0"
    ),
    "frame: principal point": Injection(
        _in_frames(lambda f: _camera(f, center=(24.0, -INF))), "frame 000001 .*camera.center.1"
    ),
    "frame: camera's place": Injection(
        _in_frames(lambda f: _camera(f, camera_from_world=torch.full((4, 4), NAN))),
        "frame 000001 .*camera_from_world",
    ),
    "capture: shape coefficients": Injection(_spoilt_coefficients, "a shape coefficient is nan"),
    "file: prior": Injection(lambda _: None, "encoder.input.weight holds NaN", prior=True),
    # Before the first step.
    "registration: shape coefficients": Injection(
        _after_stage("register_training", lambda a, *_: _put(a.coefficients, NAN)),
        "registration: avatar.coefficients",
        is_tracked=True,
        is_whole=True,
    ),
    "registration: shape": Injection(
        _after_stage("register_training", lambda a, *_: _put(a.shape.mlp.output.weight, INF)),
        f"registration: {SHAPE}",
        is_tracked=True,
        is_whole=True,
    ),
    "registration: poses": Injection(
        _registered(_spoilt_poses),
        r"registration: corrections.translations.\d+",
        is_tracked=True,
        is_whole=True,
    ),
    "outlines: gradient": Injection(
        _shape_gradient, "outlines: avatar.shape.mlp.* holds NaN", is_whole=True
    ),
    "outlines: loss": Injection(
        _result(outlines, "silhouette_loss", NAN), "outlines, piece 1: silhouette", is_whole=True
    ),
    "outlines: shape": Injection(
        _after_stage("fit_outlines", lambda a, *_: _put(a.shape.mlp.output.weight, NAN)),
        f"outlines: {SHAPE}",
        is_whole=True,
    ),
    "occupancy: loss": Injection(
        _result(pretraining.OccupancyLoss, "of_codes", NAN),
        "occupancy, step 1: loss",
        is_whole=True,
    ),
    "occupancy: infinite loss": Injection(
        _result(pretraining.OccupancyLoss, "of_codes", INF, call=4),
        "occupancy, step 2: loss",
        is_whole=True,
    ),
    "occupancy: gradient of the last step": Injection(
        _gradients_of(loop, "fit_occupancy", call=2),
        "occupancy: avatar.occupancy.decoder.* holds NaN",
        is_whole=True,
    ),
    "occupancy: decoder": Injection(
        _after_stage("fit_occupancy", lambda a, *_: _put(a.occupancy.decoder.mlp.output.bias, INF)),
        "occupancy: avatar.occupancy.decoder.mlp.output.bias",
        is_whole=True,
    ),
    "border: loss": Injection(
        _result(border, "border_loss", NAN), "border, step 1: loss", is_whole=True
    ),
    "border: gradient of the last step": Injection(
        _gradients_of(loop, "fit_border", call=2),
        "border: avatar.occupancy.decoder.* holds NaN",
        is_whole=True,
    ),
    "border: decoder": Injection(
        _after_stage("fit_border", lambda a, *_: _put(a.occupancy.decoder.mlp.output.weight, -INF)),
        f"border: {DECODER} holds -inf",
        is_whole=True,
    ),
    "sky: loss": Injection(_sky, "sky of clip 0: brightness", method=TRACED, is_whole=True),
    "sky: directions": Injection(
        _after_stage("place_directions", lambda a, *_: _put(a.illumination.directions, NAN)),
        "stage done: .*directions holds NaN",
        method=TRACED,
        is_whole=True,
    ),
    # Warm steps: appearance alone.
    "warm step: albedo code": Injection(_after_step(1, _weight(CODES)), f"step 1: {CODES}"),
    "warm step: albedo": Injection(_after_step(2, _weight(ALBEDO, INF)), f"step 2: {ALBEDO}"),
    "warm step: light": Injection(_after_step(3, _weight(LIGHT, -INF)), f"step 3: {LIGHT}"),
    "warm step: shape, which has no part in it": Injection(
        _after_step(2, _weight(SHAPE)), f"step 2: {SHAPE}"
    ),
    "warm step: decoder, which has no part in it": Injection(
        _after_step(1, _weight(DECODER)), f"step 1: {DECODER}"
    ),
    "warm step: encoder, which is never trained": Injection(
        _after_step(3, _weight(ENCODER, INF)), f"step 3: {ENCODER}"
    ),
    "warm step: coefficients": Injection(
        _after_step(1, _weight("avatar.coefficients")), "step 1: avatar.coefficients"
    ),
    "warm step: wrist": Injection(
        _after_step(2, _weight("avatar.illumination.wrist_reference")), "step 2: .*wrist_reference"
    ),
    "warm step: loss": Injection(
        _result(loop, "appearance_loss", NAN), "step 1: loss.color is NaN"
    ),
    "warm step: gradient": Injection(_gradient_in_step(2, "adam"), "step 2: avatar.* holds NaN"),
    "warm step: muon's gradient": Injection(
        _gradient_in_step(3, "muon"), "step 3: avatar.* holds NaN"
    ),
    "warm step: adam": Injection(
        _after_step(2, _state("adam", "exp_avg", NAN)), r"step 2: adam.\d+.exp_avg holds NaN"
    ),
    "warm step: muon": Injection(
        _after_step(1, _state("muon", "momentum_buffer", NAN)), "step 2: avatar.* holds NaN"
    ),
    # Joint steps.
    "joint step: decoder": Injection(_after_step(4, _weight(DECODER, INF)), f"step 4: {DECODER}"),
    "joint step: pose": Injection(
        _after_step(5, _weight(POSE)), f"step 5: {POSE}", is_tracked=True
    ),
    "joint step: loss": Injection(_result(loop, "color_loss", NAN), "step 4: loss.color is NaN"),
    "joint step: adam's squares": Injection(
        _after_step(4, _state("adam", "exp_avg_sq", INF)), r"step 4: adam.\d+.exp_avg_sq holds inf"
    ),
    # The last step: nothing comes after it that would show it.
    "last step: albedo code": Injection(_after_step(6, _weight(CODES)), f"step 6: {CODES}"),
    "last step: decoder": Injection(_after_step(6, _weight(DECODER)), f"step 6: {DECODER}"),
    "last step: place": Injection(
        _after_step(6, _weight(PLACE, INF)), f"step 6: {PLACE}", is_tracked=True
    ),
    "last step: gradient": Injection(_gradient_in_step(6, "adam"), "step 6: avatar.* holds NaN"),
    "last step: adam": Injection(
        _after_step(6, _state("adam", "exp_avg_sq", NAN)), r"step 6: adam.\d+.exp_avg_sq holds NaN"
    ),
    "last step: muon": Injection(
        _after_step(6, _state("muon", "momentum_buffer", NAN)), r"step 6: muon.\d+.momentum_buffer"
    ),
    "last step: learning rate": Injection(
        _after_step(6, _rate), "step 6: state.adam.param_groups.0.initial_lr is NaN"
    ),
    # After the last step.
    "detail: unwrapped": Injection(_unwrapped, "detail, step 1: loss is NaN", method=DETAILED),
    "detail: texels": Injection(
        _after_stage("learn_detail", _texels), "detail: avatar.texture.texels", method=DETAILED
    ),
    # What an older version has left.
    "checkpoint: joint step": Injection(_stored_checkpoint(f"model.{CODES}", 4, NAN), ""),
    "checkpoint: outlines": Injection(_stored_checkpoint("outlines.coefficients", 4, INF), ""),
}


# --- the trainings --------------------------------------------------------------------------------


def _words(capture: Path, steps: int = STEPS) -> list[str]:
    options = f"--steps {steps} --checkpoint-every 2 --device cpu --perceptual substitute"
    return ["train", str(capture), *options.split()]


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """With poses that are known, and with tracked ones; read only."""
    folder = tmp_path_factory.mktemp("captures")
    return {
        False: write_tiny_capture(folder / "known", "aab"),
        True: write_tiny_capture(folder / "tracked", "aab", confidence=0.8),
    }


@pytest.fixture(scope="module")
def begun(
    captures: dict[bool, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[bool, loop.Method], Path]]:
    """Runs as they are before the first step; read only."""
    folder = tmp_path_factory.mktemp("begun")
    known: dict[tuple[bool, int], Path] = {}

    def of(is_tracked: bool, method: loop.Method) -> Path:
        key = (is_tracked, id(method))
        if key not in known:
            run = folder / str(len(known))
            with pytest.MonkeyPatch.context() as patch:
                patch.setitem(METHODS, "quick", method)
                assert main([*_words(captures[is_tracked], 1), "--out", str(run)]) == 0
            shutil.rmtree(run / "checkpoints" / "step-000000001")
            (run / "avatar.safetensors").unlink()
            known[key] = run
        return known[key]

    yield of


def _assert_finite_avatar(run: Path) -> None:
    avatar = HandAvatar.load(run)
    assert find_not_finite(avatar.state_dict()) is None
    picture = avatar.render(bent_pose(1), camera_above(16), settings=RenderSettings(num_samples=8))
    assert find_not_finite(vars(picture)) is None and float(picture.alpha.max()) > 0.5
    assert [record["step"] for record in read_log(open_run(run))] == list(range(1, STEPS + 1))


def _assert_good_checkpoints(run: Path) -> None:
    for file in run.glob("checkpoints/step-*/*.safetensors"):
        assert find_not_finite(load_file(file)) is None, file


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in INJECTIONS],
)
def test_a_training_with_nan_ends_in_a_finite_avatar_or_a_clear_stop(
    name: str,
    captures: dict[bool, Path],
    begun: Callable[[bool, loop.Method], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    injection = INJECTIONS[name]
    run = tmp_path / "run"
    capture = captures[injection.is_tracked]
    if not injection.is_whole and not injection.expected.startswith("frame"):
        shutil.copytree(begun(injection.is_tracked, injection.method), run)
    monkeypatch.setitem(METHODS, "quick", injection.method)
    given = []
    if injection.prior:
        tensors = load_file(SHIPPED_PRIOR)
        _put(tensors["encoder.input.weight"], NAN)
        save_file(tensors, tmp_path / "prior")
        given = ["--prior", str(tmp_path / "prior")]
    with monkeypatch.context() as patch:
        injection.inject(patch)
        code = main([*_words(capture), *given, "--out", str(run)])
    message = capsys.readouterr().err
    if "Killed" in message:  # Nobody knows yet that the checkpoint is bad.
        assert main([*_words(capture), "--out", str(run)]) == 0
        assert (run / "corrupt" / "step-000000004").is_dir()
        _assert_good_checkpoints(run)
        _assert_finite_avatar(run)
        return
    said = message[message.index("handavatar: ") :]
    assert code in (BAD_DATA, NUMERICAL) and "a mistake in handavatar" not in said
    assert len(said.splitlines()) <= 4
    assert re.search(injection.expected, said), said
    assert not (run / "avatar.safetensors").exists()
    _assert_good_checkpoints(run)

    # As it is advised: another seed in the same run, or without what was wrong.
    again = ["--out", str(run)]
    if said.splitlines()[-1].startswith("give the same command again with "):
        again = shlex.split(said.splitlines()[-1].partition(" with ")[2])
        assert again[:-1] == ["--out", str(run), "--resume", "auto", "--seed"]
        used = {use["seed"] for use in json.loads((run / "seeds.json").read_text())["seeds"]}
        assert int(again[-1]) not in used
    else:
        assert re.search("drop the frame|check the capture|leave (it|them) out", said), said
    assert main([*_words(capture), *again]) == 0
    _assert_good_checkpoints(run)
    _assert_finite_avatar(run)


def test_there_are_51_injections() -> None:
    assert len(INJECTIONS) == 51 and INJECTIONS.keys() >= FAST
