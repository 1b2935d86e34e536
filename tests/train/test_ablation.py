"""The ablation: parts in their place, the very same samples, and a table that is paired."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import TINY
from PIL import Image
from told import Told

from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import read_capture
from handavatar.capture.synthetic import SynthOptions, make_capture
from handavatar.field.shading import PaperCues, TracedCues
from handavatar.hand.pose import NUM_BONES
from handavatar.train import ablation
from handavatar.train.ablation import (
    ROWS,
    FittedGeometry,
    Row,
    Shading,
    SplitShading,
    fitted_geometry,
    judged,
    shaded_view,
    trained_shading,
    view_spread,
)
from handavatar.train.ablation_table import AblationTableOptions, ablation_table
from handavatar.train.loop import METHODS

SMALL = replace(TINY, patch_size=8)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    options = SynthOptions(
        train_frames=3,
        test_frames=3,
        size=48,
        samples=16,
        subdivisions=1,
        texture=64,
        variant="scalar_rgb",
    )
    return make_capture(tmp_path_factory.mktemp("made") / "light-key", options).folder


@pytest.fixture(scope="module")
def geometry(made: Path) -> FittedGeometry:
    return fitted_geometry(read_capture(made), "personal", SMALL, 0)


def test_rows_are_named_after_what_they_are_compared_with() -> None:
    names = list(ROWS)
    for number, row in enumerate(ROWS.values()):
        assert row.against in ("", *names[:number])
    assert [name for name, row in ROWS.items() if not row.against] == names[:1]


def test_a_view_shaded_whole_is_what_the_avatar_renders(made: Path) -> None:
    """The samples that stay are those of a picture with one ray per pixel."""
    from handavatar.avatar import HandAvatar, RenderSettings
    from handavatar.train.ablation import view_of_frame
    from handavatar.train.prior import load_prior

    capture = read_capture(made)
    frame = capture.frame(3)
    torch.manual_seed(0)
    rig = ablation.begin_training(
        capture, [frame], SMALL, ablation.TrainOptions(made, device="cpu")
    ).avatar.base_rig
    avatar = HandAvatar(
        rig, capture.shape_coefficients, rounds=1, num_anchors=128, cues=TracedCues(8)
    )
    load_prior(avatar.occupancy)
    settings = RenderSettings(num_samples=16, edge_rays=1)
    view = view_of_frame(avatar, frame, frame.camera, settings)
    shading = SplitShading(view.samples.light.new_zeros(128, 3), TracedCues(8), torch.rand(3))
    shading.albedo, shading.illumination = avatar.albedo, avatar.illumination
    picture, expected = (
        shaded_view(shading, view),
        avatar.render(frame.pose, frame.camera, None, settings),
    )
    torch.testing.assert_close(picture["alpha"], expected.alpha, atol=1e-5, rtol=0)
    # The light of the samples is kept in half precision.
    torch.testing.assert_close(picture["color"], expected.color, atol=2e-3, rtol=0)
    torch.testing.assert_close(picture["light"], expected.illumination, atol=2e-3, rtol=0)


@pytest.mark.slow
def test_a_shading_learns_and_its_figures_are_of_every_frame(
    made: Path, geometry: FittedGeometry
) -> None:
    row = ROWS["traced light"]
    capture = read_capture(made)
    before, _ = judged(trained_shading(row, geometry, SMALL, 1, 0), geometry, capture)
    shading = trained_shading(row, geometry, SMALL, 60, 0)
    after, whole = judged(shading, geometry, capture)
    assert all(len(values) == 3 for values in after.values())
    assert sum(after["psnr"]) > sum(before["psnr"]) + 1
    assert whole.keys() == {"albedo", "shading r", "view spread %"}
    assert all(0 <= hidden < 1 for hidden in geometry.hidden)
    again = trained_shading(row, geometry, SMALL, 60, 0)
    for name, value in shading.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


@pytest.mark.slow
def test_only_light_that_looks_along_the_ray_changes_with_the_camera(
    geometry: FittedGeometry,
) -> None:
    anchors, color = geometry.anchors, geometry.color
    torch.manual_seed(0)
    paper = SplitShading(anchors, PaperCues(), color)
    with torch.no_grad():
        torch.nn.init.normal_(paper.illumination.mlp.output.weight, std=0.1)
        paper.illumination.mlp.hidden[0].weight[:, :NUM_BONES] *= 4
    blind = SplitShading(anchors, PaperCues(), color, torch.zeros_like)
    blind.load_state_dict(paper.state_dict())
    spread = [view_spread(shading, geometry.turned) for shading in (blind, paper)]
    # What is left without the ray is that rays end some tenths of a millimetre apart.
    assert 0 < spread[0] < 0.5 * spread[1]


@pytest.mark.slow
def test_the_table_is_kept_and_paired(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "quick", SMALL)
    for name in list(ROWS):
        if name.startswith("control") or name.endswith((" (quick)", " (best)")):
            monkeypatch.delitem(ROWS, name)
    options = AblationTableOptions((made,), tmp_path / "kept", seeds=(0, 1), steps=2)
    told = Told()
    table = ablation_table(options, told.progress)
    assert told.steps == list(range(1, options.total_steps + 1))
    assert list(table.rows) == list(ROWS)
    with Image.open(tmp_path / "kept" / "light-key.png") as sheet:
        assert sheet.size == (48 * (1 + len(ROWS)), 48 * 6)
        pixels = torch.from_numpy(np.array(sheet)).float()
    # The first column is the truth: its hands are brighter than what lies around them.
    assert float(pixels[:48, :48].max()) > 80 and float(pixels[0, 0].max()) == 0
    stored = json.loads((tmp_path / "kept" / "light-key.json").read_text())
    paper = stored["rows"]["+ directed occupancy (paper)"]
    traced = stored["rows"]["traced light"]
    gains = [
        sum(
            traced[seed]["frames"]["psnr"][frame] - paper[seed]["frames"]["psnr"][frame]
            for seed in ("0", "1")
        )
        / 2
        for frame in range(3)
    ]
    text = str(table.rows["traced light"]["gain, all"])
    assert text.startswith(f"{sum(gains) / 3:+.2f} [")
    assert table.rows["coefficients, entangled"]["gain, all"] is None
    assert table.rows["+ personal shape"]["shading r"] is None
    monkeypatch.setattr(ablation, "fitted_geometry", None)
    assert ablation_table(options) == table
    with pytest.raises(CaptureError, match="transforms"):
        ablation_table(replace(options, captures=(tmp_path,)))


@pytest.mark.slow
def test_some_rows_of_a_capture_without_truth_and_then_more(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "quick", SMALL)
    blind = tmp_path / "blind"
    shutil.copytree(made, blind, ignore=shutil.ignore_patterns("truth"))
    options = AblationTableOptions((blind,), tmp_path / "kept", ("traced light",), (0,), steps=2)
    first = ablation_table(replace(options, rows=("(paper)",)))
    assert list(first.rows) == ["+ directed occupancy (paper)"]
    row = first.rows["+ directed occupancy (paper)"]
    assert row["albedo"] is None and row["shading r"] is None and row["gain, all"] is None
    assert row["against"] is None and float(str(row["psnr"])) > 5
    both = replace(options, rows=("(paper)", "traced light"))
    told = Told()
    train, trainings = ablation.trained_shading, []

    def counted(row: Row, *rest: Any) -> Shading:
        trainings.append(row)
        return train(row, *rest)

    monkeypatch.setattr(ablation, "trained_shading", counted)
    table = ablation_table(both, told.progress)
    assert len(told.steps) == both.total_steps == 3
    assert table.rows["+ directed occupancy (paper)"] == row
    assert table.rows["traced light"]["gain, all"] is not None
    # Poses are known: with corrected ones it is the same training, which is not done again.
    assert table.rows["traced light, poses corrected (best)"] == table.rows["traced light"]
    assert trainings == [ROWS["traced light"]]
    assert ablation_table(replace(options, rows=("(paper)",))) == first
    with pytest.raises(ValueError, match="`rows`: no row is called sunlight"):
        ablation_table(replace(options, rows=("sunlight",)))
