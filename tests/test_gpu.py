"""On a GPU the same commands give the same numbers as on the CPU, within rounding."""

import copy
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from conftest import TINY, bent_pose, camera_above, write_tiny_capture

from handavatar.avatar import HandAvatar, RayValues
from handavatar.evaluate.run import EvaluateOptions, evaluate_run
from handavatar.hand.pose import HandPose
from handavatar.train.loop import METHODS, TrainOptions, train
from handavatar.train.prior import PriorOptions, train_prior
from handavatar.train.runs import open_run, read_log

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def test_a_picture_is_the_same(small_avatar: HandAvatar, tmp_path: Path) -> None:
    small_avatar.save(tmp_path / "avatar.safetensors")
    there = HandAvatar.load(tmp_path / "avatar.safetensors").moved_to("cuda")
    pose, camera = bent_pose(3), camera_above(64)
    expected, found = small_avatar.render(pose, camera), there.render(pose, camera)
    assert float(expected.alpha.sum()) > 500
    for field in fields(RayValues):
        truth, picture = getattr(expected, field.name), getattr(found, field.name)
        assert picture.device.type == "cuda"
        # Single samples fall on the other side of a threshold or of a part box.
        assert float((picture.cpu() - truth).abs().mean()) < 1e-5, field.name
        assert float((picture.cpu() - truth).abs().max()) < 2e-2, field.name


def test_a_replayed_state_is_the_prepared_one(small_avatar: HandAvatar) -> None:
    avatar = copy.deepcopy(small_avatar).moved_to("cuda")

    def difference(pose: HandPose) -> float:
        """Of what is replayed without gradient from what is computed with it."""
        with torch.no_grad():
            replayed = avatar.prepare(pose)
        computed = avatar.prepare(pose)
        assert replayed.posed.pose is pose
        pairs = [
            (replayed.posed.vertices, computed.posed.vertices),
            (replayed.codes.part_codes, computed.codes.part_codes),
            (replayed.codes.boxes.upper, computed.codes.boxes.upper),
            (replayed.anchor_normals, computed.anchor_normals),
        ]
        return max(float((found - true).detach().abs().max()) for found, true in pairs)

    poses = [bent_pose(step).to("cuda") for step in (3, 5)]
    with torch.no_grad():
        first = avatar.prepare(poses[0])
    kept = first.posed.vertices.clone()
    assert difference(poses[1]) < 1e-5
    assert torch.equal(first.posed.vertices, kept), "the next pose has overwritten this one"
    with torch.no_grad():
        avatar.shape.mlp.output.bias += 0.3
    assert difference(poses[0]) < 1e-5, "weights that a step has changed"
    avatar.coefficients = avatar.coefficients + 1
    assert difference(poses[0]) < 1e-5, "another tensor"
    with torch.no_grad():
        moved = avatar.prepare(poses[0])
        again = copy.deepcopy(avatar).prepare(poses[0])
    assert float((moved.posed.vertices - kept).abs().max()) > 1e-3
    torch.testing.assert_close(again.posed.vertices, moved.posed.vertices)


@pytest.mark.parametrize("confidence", [1.0, 0.8], ids=["known poses", "tracked poses"])
def test_training_takes_the_same_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, confidence: float
) -> None:
    monkeypatch.setitem(METHODS, "quick", TINY)
    capture = write_tiny_capture(tmp_path / "tiny", confidence=confidence)
    logs, scores = {}, {}
    for device in ("cpu", "cuda"):
        run = train(
            TrainOptions(
                capture, tmp_path / device, steps=6, device=device, perceptual="substitute"
            )
        )
        logs[device] = read_log(open_run(run))
        scores[device] = evaluate_run(EvaluateOptions(run, device=device))
    for ours, theirs in zip(logs["cpu"], logs["cuda"], strict=True):
        assert ours.keys() == theirs.keys()
        for name, value in ours.items():
            assert theirs[name] == pytest.approx(value, rel=0.02, abs=1e-4), (ours["step"], name)
    for protocol in ("paper", "masked"):
        expected = scores["cpu"][protocol]["psnr"]
        assert scores["cuda"][protocol]["psnr"] == pytest.approx(expected, abs=0.1)


def test_pre_training_takes_the_same_steps(tmp_path: Path) -> None:
    losses = {}
    for device in ("cpu", "cuda"):
        found: list[float] = []
        train_prior(
            PriorOptions(tmp_path / f"{device}.safetensors", steps=5, level="778", device=device),
            lambda step, figures, found=found: found.append(figures["loss"]),
        )
        losses[device] = found
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=1e-3)
