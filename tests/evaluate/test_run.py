"""Judging an avatar: the object of the product page, pictures, report, and what is refused."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import write_tiny_capture
from PIL import Image

from handavatar.avatar import CheckpointError, HandAvatar
from handavatar.capture.frames import CaptureError, read_capture
from handavatar.evaluate import run as run_module
from handavatar.evaluate.run import EvaluateOptions, evaluate_run
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import FolderInUse

KEYS = {
    "split",
    "frames",
    "hand_share",
    "paper",
    "masked",
    "mask_iou",
    "baseline",
    "truth",
    "perceptual",
    "notes",
}
"""Of the product page."""


@pytest.fixture(scope="module")
def avatar_file(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("evaluate") / "avatar.safetensors"
    small_avatar.save(path)
    return path


@pytest.fixture(scope="module")
def judged(
    avatar_file: Path, tiny_capture: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("judged") / "out"
    options = EvaluateOptions(avatar_file, tiny_capture, out=out, device="cpu")
    return evaluate_run(options), out


def test_the_object_has_the_keys_of_the_product_page(judged: tuple[dict[str, Any], Path]) -> None:
    metrics, out = judged
    assert metrics.keys() == KEYS
    assert metrics["paper"].keys() == {"psnr", "ssim", "lpips"}
    assert metrics["masked"].keys() == {"psnr", "ssim", "flip", "worst5_psnr"}
    assert metrics["baseline"].keys() == {"mean_color_masked_psnr"}
    assert (metrics["split"], metrics["frames"]) == ("test", 2)
    assert json.loads((out / "metrics.json").read_text()) == metrics
    json.dumps(metrics, allow_nan=False)


def test_the_figures_are_those_of_this_avatar(judged: tuple[dict[str, Any], Path]) -> None:
    metrics, _ = judged
    # The shipped prior knows the hand's outline; its colours are random.
    assert metrics["mask_iou"] > 0.8
    assert 0.05 < metrics["hand_share"] < 0.6
    assert 5 < metrics["masked"]["psnr"] < 25
    assert metrics["masked"]["worst5_psnr"] <= metrics["masked"]["psnr"]
    assert 0 < metrics["masked"]["flip"] < 1
    assert math.isfinite(metrics["baseline"]["mean_color_masked_psnr"])


def test_what_was_not_measured_is_null_with_a_reason(judged: tuple[dict[str, Any], Path]) -> None:
    metrics, _ = judged
    notes = "\n".join(metrics["notes"])
    assert metrics["truth"] is None
    assert "truth" in notes
    if metrics["perceptual"] != "lpips-vgg":
        assert metrics["paper"]["lpips"] is None and "paper.lpips" in notes


def test_pictures_and_report_are_written(judged: tuple[dict[str, Any], Path]) -> None:
    _, out = judged
    assert {path.name for path in out.iterdir()} == {
        ".handavatar",
        "000003.png",
        "000004.png",
        "metrics.json",
        "report.html",
    }
    with Image.open(out / "000003.png") as picture:
        assert picture.size == (6 * 48, 48)
    report = (out / "report.html").read_text()
    assert "000003" in report and "tiny" in report


def test_a_folder_of_something_else_is_not_written_into(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "000003.png").write_text("a holiday")
    options = EvaluateOptions(avatar_file, tiny_capture, out=tmp_path, device="cpu")
    with pytest.raises(FolderInUse, match="not empty, and holds no evaluation"):
        evaluate_run(options)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["a holiday"]


def test_truth_is_compared_where_the_capture_has_it(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "capture"
    shutil.copytree(tiny_capture, folder)
    for kind, shape in (("albedo", (48, 48, 3)), ("shading", (48, 48))):
        (folder / "truth" / kind).mkdir(parents=True)
        values = np.random.default_rng(0).integers(50, 200, shape, dtype=np.uint8)
        Image.fromarray(values).save(folder / "truth" / kind / "000003.png")
    options = EvaluateOptions(avatar_file, folder, out=tmp_path / "out", max_frames=1, device="cpu")
    metrics = evaluate_run(options)
    assert metrics["frames"] == 1
    assert metrics["truth"].keys() >= {"albedo_psnr", "shading_correlation"}
    assert abs(metrics["truth"]["shading_correlation"]) < 0.5  # Of noise with anything.


def test_tracked_poses_are_fitted_to_masks_and_known_ones_are_not(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[torch.Tensor] = []

    def noted(avatar: object, pose: HandPose, camera: object, mask: torch.Tensor) -> HandPose:
        seen.append(mask)
        return pose

    monkeypatch.setattr(run_module, "aligned_pose", noted)
    options = EvaluateOptions(
        avatar_file, tiny_capture, out=tmp_path / "known", max_frames=1, device="cpu"
    )
    evaluate_run(options)
    assert not seen
    tracked = write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.9)
    metrics = evaluate_run(replace(options, capture=tracked, out=tmp_path / "out"))
    assert len(seen) == 1 and torch.equal(seen[0], read_capture(tracked).frame(1).alpha)
    assert any("fitted to their masks" in note for note in metrics["notes"])


def test_what_cannot_be_judged_is_refused(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    with pytest.raises(CaptureError, match="names no capture"):
        evaluate_run(EvaluateOptions(avatar_file))
    with pytest.raises(CheckpointError, match=r"holds no avatar\.safetensors"):
        evaluate_run(EvaluateOptions(tmp_path, tiny_capture))
    with pytest.raises(CaptureError, match="no frame of split 'val'"):
        evaluate_run(EvaluateOptions(avatar_file, tiny_capture, split="val", out=tmp_path / "out"))
    with pytest.raises(CaptureError, match="no split 'tset'"):
        evaluate_run(EvaluateOptions(avatar_file, tiny_capture, split="tset", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    (tmp_path / "avatar.safetensors").write_bytes(avatar_file.read_bytes()[:5000])
    with pytest.raises(CheckpointError, match="damaged or not"):
        evaluate_run(EvaluateOptions(tmp_path, tiny_capture))


def test_a_run_folder_names_its_capture_and_shows_its_curves(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    shutil.copyfile(avatar_file, run / "avatar.safetensors")
    (run / "run.json").write_text(json.dumps({"capture": {"path": str(tiny_capture)}}))
    record = {"psnr": 12.5, "color": 0.1, "silhouette": 0.2}
    lines = [json.dumps({"step": step, **record}) for step in range(1, 41)]
    (run / "log.jsonl").write_text("\n".join(lines) + '\n{"step": 41, "ps')
    evaluate_run(EvaluateOptions(run, max_frames=1, device="cpu"))
    report = (run / "evaluation" / "report.html").read_text()
    assert "psnr, mean of 20 steps" in report
