"""Judging an avatar: the object of the product page, pictures, report, and what is refused."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from conftest import lit_frame, write_tiny_capture
from PIL import Image
from told import Told

from handavatar.avatar import CheckpointError, HandAvatar
from handavatar.capture.frames import CaptureError, Frame, read_capture, write_capture
from handavatar.evaluate import baselines, textured_mesh
from handavatar.evaluate import run as run_module
from handavatar.evaluate.baselines import judged_frame
from handavatar.evaluate.metrics import masked_psnr
from handavatar.evaluate.run import EvaluateOptions, dropped_frames, evaluate_run
from handavatar.fit.register import RegisterOptions
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import ShapedHand
from handavatar.jobs.files import FolderInUse
from handavatar.jobs.progress import Progress

KEYS = {
    "split",
    "frames",
    "dropped",
    "protocol",
    "core",
    "border",
    "detail",
    "inside",
    "intervals",
    "protocols",
    "hand_share",
    "paper",
    "masked",
    "mask_iou",
    "baseline",
    "truth",
    "skin_never_seen",
    "perceptual",
    "notes",
}
"""Of the product page, and what was never seen."""

OF_A_PROTOCOL = {"masked", "core", "border", "detail", "mask_iou", "flip", "intervals"}


@pytest.fixture(scope="module", autouse=True)
def hasty_mesh() -> Iterator[None]:
    """A textured mesh of few texels, fitted in a moment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "MESH_STEPS", 3)
        patch.setattr(textured_mesh, "NUM_TEXELS", 500)
        yield


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
    told = Told()
    metrics = evaluate_run(options, told.progress)
    assert told.shares == sorted(told.shares) and len(told.shares) > 1 and told.shares[-1] <= 1
    return metrics, out


def test_the_object_has_the_keys_of_the_product_page(judged: tuple[dict[str, Any], Path]) -> None:
    metrics, out = judged
    assert metrics.keys() == KEYS
    assert metrics["paper"].keys() == {"psnr", "ssim", "lpips"}
    assert metrics["masked"].keys() == {"psnr", "ssim", "flip", "worst5_psnr"}
    assert metrics["baseline"].keys() == {
        "mean_color_masked_psnr",
        "mean_color_own_mask_psnr",
        "textured_mesh_masked_psnr",
    }
    assert metrics["protocol"] == "known" and metrics["protocols"].keys() == {"known"}
    assert metrics["protocols"]["known"].keys() == OF_A_PROTOCOL
    for key in OF_A_PROTOCOL - {"flip"}:
        assert metrics[key] == metrics["protocols"]["known"][key]
    assert metrics["core"].keys() == {"psnr", "share"}
    assert metrics["border"].keys() == {"psnr", "error_share"}
    assert metrics["detail"].keys() == {"ratio", "correlation"}
    assert metrics["inside"] == {"psnr": metrics["masked"]["psnr"], "unknown_share": 0}
    assert metrics["dropped"] == {"split": None, "capture": None}
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
    for value in metrics["baseline"].values():
        assert 5 < value < 60
    # The flat colour in the true mask is the better for it.
    baseline = metrics["baseline"]
    assert baseline["mean_color_masked_psnr"] > baseline["mean_color_own_mask_psnr"]
    intervals = metrics["intervals"]
    assert intervals["blocks"] == 2
    found = intervals["masked_psnr"]
    assert found["mean"] == pytest.approx(metrics["masked"]["psnr"])
    assert found["low"] <= found["mean"] <= found["high"]
    ahead = intervals["masked_psnr_minus_mean_color"]["mean"]
    expected = metrics["masked"]["psnr"] - baseline["mean_color_masked_psnr"]
    assert ahead == pytest.approx(expected)
    assert intervals["core_psnr"]["mean"] == pytest.approx(metrics["core"]["psnr"])
    assert intervals["detail_ratio"]["mean"] == pytest.approx(metrics["detail"]["ratio"])


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
        "sheet.png",
    }
    with Image.open(out / "000003.png") as picture:
        assert picture.size == (6 * 48, 48)
    with Image.open(out / "sheet.png") as sheet:
        assert sheet.size == (5 * 48, 16 + 2 * (48 + 16))
    report = (out / "report.html").read_text()
    assert "000003" in report and "tiny" in report


def test_a_folder_of_something_else_is_not_written_into(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "000003.png").write_text("a holiday")
    options = EvaluateOptions(avatar_file, tiny_capture, out=tmp_path, device="cpu")
    with pytest.raises(FolderInUse, match="holds no evaluation of this program's"):
        evaluate_run(options)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["a holiday"]


@pytest.mark.slow
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


@pytest.mark.slow
def test_tracked_poses_are_fitted_to_masks_and_known_ones_are_not(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[Frame]] = []

    def noted(
        hands: list[ShapedHand],
        frames: list[Frame],
        options: RegisterOptions,
        learns_shape: bool,
        progress: Progress,
    ) -> list[HandPose]:
        # By landmarks and masks, never by colours, and with the avatar's own shape.
        assert options.texture_sigmas == () and not learns_shape
        assert len(hands) == len(frames)
        seen.append(frames)
        return [frame.pose for frame in frames]

    monkeypatch.setattr(run_module, "register_frames", noted)
    monkeypatch.setattr(run_module, "registered_poses", lambda found: found)
    options = EvaluateOptions(
        avatar_file, tiny_capture, out=tmp_path / "known", max_frames=1, device="cpu"
    )
    evaluate_run(options)
    assert not seen
    tracked = write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.9)
    metrics = evaluate_run(replace(options, capture=tracked, out=tmp_path / "out"))
    # The judged frame, and the frame that the textured mesh is fitted to.
    assert [[frame.name for frame in frames] for frames in seen] == [["000001"], ["000000"]]
    assert torch.equal(seen[0][0].alpha, read_capture(tracked).frame(1).alpha)
    assert any("fitted to their masks" in note for note in metrics["notes"])
    assert metrics["protocol"] == "mask"
    assert list(metrics["protocols"]) == ["mask", "registered"]
    assert metrics["masked"] == metrics["protocols"]["mask"]["masked"]
    with av.open(str(tmp_path / "out" / "own_motion.mp4")) as film:
        assert (film.streams.video[0].width, film.streams.video[0].height) == (96, 48)
    assert not (tmp_path / "known" / "own_motion.mp4").exists()


@pytest.mark.slow
def test_registered_poses_are_judged_apart(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(avatar: object, frame: object, start: HandPose, rendering: object) -> HandPose:
        return replace(start, translation=start.translation + torch.tensor([0.03, 0.0, 0.0]))

    monkeypatch.setattr(run_module, "registered_pose", away)
    tracked = write_tiny_capture(tmp_path / "tracked", "ab", confidence=0.9)
    options = EvaluateOptions(avatar_file, tracked, out=tmp_path / "out", device="cpu")
    metrics = evaluate_run(options)
    mask, registered = metrics["protocols"]["mask"], metrics["protocols"]["registered"]
    assert mask["mask_iou"] > 0.8 > registered["mask_iou"]
    assert metrics["mask_iou"] == mask["mask_iou"]
    assert metrics["masked"]["psnr"] == mask["masked"]["psnr"] != registered["masked"]["psnr"]


def _scribbled(folder: Path, seed: int) -> Path:
    """A tracked capture of whose pictures a third is unknown and holds noise, mask and all."""
    generator = torch.Generator().manual_seed(seed)
    frames = []
    for index, split in enumerate(("train", "train", "test")):
        frame = lit_frame(index, split, confidence=0.9)
        known = torch.ones(48, 48, dtype=torch.bool)
        known[:, 30:] = False
        noise = torch.randint(0, 256, (48, 48, 4), generator=generator, dtype=torch.uint8)
        image = torch.where(known[..., None], frame.image, noise[..., :3])
        coverage = torch.where(known, frame.coverage, noise[..., 3])
        gain = torch.tensor([1.1, 1.0, 0.9])
        frames.append(replace(frame, image=image, coverage=coverage, known=known, gain=gain))
    rig = load_open_hand()
    about = dict(subject="tiny", source="rasterised in a test", licence="CC0-1.0")
    write_capture(folder, frames, rig_name=rig.name, rig_sha256=rig.sha256, **about)
    return folder


@pytest.mark.slow
def test_what_stands_in_unknown_pixels_changes_no_figure(avatar_file: Path, tmp_path: Path) -> None:
    found = []
    for seed in (0, 1):
        capture = _scribbled(tmp_path / f"capture{seed}", seed)
        options = EvaluateOptions(avatar_file, capture, out=tmp_path / f"{seed}", device="cpu")
        found.append(evaluate_run(options))
    assert found[0] == found[1]
    assert found[0]["inside"]["unknown_share"] == pytest.approx(18 / 48)
    for name in ("000002.png", "sheet.png"):
        first, second = ((tmp_path / f"{seed}" / name).read_bytes() for seed in (0, 1))
        assert first == second
    with Image.open(tmp_path / "0" / "000002.png") as strip:
        pixels = np.asarray(strip)
    for column in (0, 1, 5):
        unknown = pixels[:, 48 * column + 30 : 48 * (column + 1)]
        assert bool((unknown == 128).all())


def test_a_brighter_exposure_is_judged_as_such(
    avatar_file: Path, tiny_capture: Path, tmp_path: Path
) -> None:
    capture = read_capture(tiny_capture)
    frame = capture.frame(3)
    color = frame.image.float() / 255 * 0.5
    alpha = frame.alpha
    assert masked_psnr(judged_frame(frame, color, alpha)) < 25
    brighter = replace(frame, gain=torch.tensor([2.0, 2.0, 2.0]))
    assert masked_psnr(judged_frame(brighter, color, alpha)) > 50


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, (None, None)),
        ({"skipped.json": {"000001": "blurred", "000002": "no hand"}}, (None, 2)),
        (
            {"skipped.json": {"000001": "blurred", "splits": {"test": 1, "train": 0}}},
            (1, 1),
        ),
        (
            {
                "fit.json": {"splits": {"test": {"kept": 3, "dropped": 5}}},
                "skipped.json": {"000001": "blurred"},
            },
            (5, 1),
        ),
        ({"fit.json": {"splits": [1]}, "skipped.json": ["odd"]}, (None, 0)),
    ],
)
def test_dropped_frames_are_counted_as_far_as_the_capture_tells(
    tmp_path: Path, files: dict[str, Any], expected: tuple[int | None, int | None]
) -> None:
    for name, content in files.items():
        (tmp_path / name).write_text(json.dumps(content))
    found = dropped_frames(tmp_path, "test")
    assert (found["split"], found["capture"]) == expected


@pytest.mark.slow
def test_a_capture_without_training_frames_has_no_baseline(
    avatar_file: Path, tmp_path: Path
) -> None:
    capture = write_tiny_capture(tmp_path / "tests", "b")
    metrics = evaluate_run(EvaluateOptions(avatar_file, capture, out=tmp_path / "o", device="cpu"))
    assert set(metrics["baseline"].values()) == {None}
    assert any("no training frames" in note for note in metrics["notes"])
    assert metrics["intervals"]["masked_psnr"] is None  # One frame says nothing of others.


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_large_pictures_are_judged_binned_unless_asked_for_whole(
    avatar_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "FITTED_SIDE", 48)
    folder = write_tiny_capture(tmp_path / "large", "aab", size=96)
    capture = read_capture(folder)
    mask = capture.frame(2).mask.numpy()[..., None]
    for kind in ("albedo", "shading"):
        (folder / "truth" / kind).mkdir(parents=True)
        pixels = np.where(mask, 128, 0).astype(np.uint8).repeat(3, -1)
        Image.fromarray(pixels).save(folder / "truth" / kind / "000002.png")
    # What is black beside the hand darkens no pixel of its outline.
    small = capture.frame(2).binned(48)
    truth = run_module.true_picture(capture, small, "albedo")
    assert truth.shape == (48, 48, 3)
    assert torch.allclose(truth[small.mask], torch.tensor(128 / 255))
    avatar = HandAvatar.load(avatar_file)
    avatar.seen_frames = torch.zeros(256, dtype=torch.int32)
    avatar.seen_frames[:64] = 1
    avatar.save(tmp_path / "avatar.safetensors")
    for full_size, side in ((False, 48), (True, 96)):
        out = tmp_path / f"out{side}"
        options = EvaluateOptions(
            tmp_path / "avatar.safetensors", folder, out=out, full_size=full_size, device="cpu"
        )
        metrics = evaluate_run(options)
        # What nobody has seen is told as well, in figures and in the report.
        assert metrics["skin_never_seen"]["share"] == 0.75 and metrics["skin_never_seen"]["regions"]
        assert "Skin that was never seen" in (out / "report.html").read_text()
        with Image.open(out / "000002.png") as strip:
            assert strip.height == side
        notes = [note for note in metrics["notes"] if "`full_size`" in note]
        assert bool(notes) != full_size
        assert metrics["truth"] is not None and metrics["truth"]["albedo_psnr"] > 0
    assert "48 pixels along a side, of 96" in "".join(
        json.loads((tmp_path / "out48" / "metrics.json").read_text())["notes"]
    )
