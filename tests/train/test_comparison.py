"""The geometry table: alike for all decoders, paired, and honest about what it does not know."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from told import Told

from handavatar.errors import HandAvatarError
from handavatar.field.decoders import Decoder, OccupancyField
from handavatar.field.occupancy import HandCodes
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand
from handavatar.train.comparison import (
    ComparisonOptions,
    compare_decoders,
    comparison_table,
    contenders,
)
from handavatar.train.geometry_table import GeometryTableOptions, MeshMeasure, geometry_table
from handavatar.train.prior import PriorEvaluationOptions, evaluate_prior, open_prior


def _options(out: Path) -> ComparisonOptions:
    return ComparisonOptions(
        out,
        steps=1,
        points=64,
        poses=3,
        judged_points=256,
        measured_poses=2,
        level="778",
        rounds=0,
    )


def _volume(field: OccupancyField, codes: HandCodes, posed: PosedHand) -> Mapping[str, float]:
    """Stands for a measure of the extracted mesh."""
    whole = field(codes, posed.vertices).whole
    return {"covered": float((whole > 0).float().mean()), "mean": float(whole.mean())}


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("compared") / "decoders"
    options = replace(
        _options(out), seeds=(0, 1), decoders=("pair-shuffled", "pair", "transformer")
    )
    return out, compare_decoders(options, (_volume,))


@pytest.mark.slow
def test_the_result_is_json_and_names_what_was_compared(
    compared: tuple[Path, dict[str, Any]],
) -> None:
    out, value = compared
    assert json.loads(json.dumps(value, allow_nan=False)) is not None
    rows = value["decoders"]
    assert [rows[name]["parameters"] for name in rows] == [232_513, 232_513, 255_977]
    for row in rows.values():
        assert row["iou"] == pytest.approx((row["iou_boxes"] + row["iou_surface"]) / 2)
        share = row["iou"] * 100 / (row["parameters"] / 1e5)
        assert row["iou_points_per_100k"] == pytest.approx(share)
        assert 0 < row["covered"] <= 1 and row["training_seconds"] > 0
    assert "minus_pair" not in rows["pair"]
    assert isinstance(value["control_hurts"], bool)
    assert {path.name for path in out.iterdir()} == {
        ".handavatar",
        "attention.png",
        *(f"{name}-{seed}.safetensors" for name in rows for seed in (0, 1)),
        *(f"{name}-{seed}" for name in rows for seed in (0, 1)),
        *(f"{name}-{seed}.json" for name in rows for seed in (0, 1)),
    }
    for gesture in ("flat", "fist"):
        assert value["attention"][gesture]["preference"] > 0


@pytest.mark.slow
def test_differences_are_paired_and_over_seeds_too(compared: tuple[Path, dict[str, Any]]) -> None:
    _, value = compared
    for name in ("pair-shuffled", "transformer"):
        row = value["decoders"][name]
        for column in ("iou", "iou_boxes", "iou_surface", "covered", "mean"):
            expected = row[column] - value["decoders"]["pair"][column]
            for kind in ("minus_pair", "minus_pair_over_seeds"):
                found = row[kind][column]
                assert found["mean"] == pytest.approx(expected, abs=1e-6)
                assert found["low"] <= found["mean"] <= found["high"]


@pytest.mark.slow
def test_the_judging_poses_are_those_of_prior_evaluate(
    compared: tuple[Path, dict[str, Any]],
) -> None:
    out, value = compared
    scores = [
        evaluate_prior(
            PriorEvaluationOptions(
                out / f"transformer-{seed}.safetensors", 3, 256, level="778", rounds=0
            )
        )["iou"]
        for seed in (0, 1)
    ]
    assert value["decoders"]["transformer"]["iou"] == pytest.approx(sum(scores) / 2, abs=1e-6)


@pytest.mark.slow
def test_the_table_has_a_line_for_each_decoder(compared: tuple[Path, dict[str, Any]]) -> None:
    _, value = compared
    shown = comparison_table(value).markdown().splitlines()
    lines = [line for line in shown if line.startswith("|")]
    assert len(lines) == 2 + 3
    assert len({line.count("|") for line in lines}) == 1
    assert "covered" in lines[0] and "232,513" in lines[2] and "| – |" in lines[3]


def test_every_decoder_sees_the_same_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What reaches the inside test, training by training."""
    import handavatar.train.labelled_poses as labelled_poses
    import handavatar.train.prior as prior

    seen: list[list[torch.Tensor]] = []
    original = labelled_poses.training_points

    def watched(*arguments: Any) -> torch.Tensor:
        seen[-1].append(original(*arguments))
        return seen[-1][-1]

    monkeypatch.setattr(labelled_poses, "training_points", watched)
    for decoder in get_args(Decoder):
        seen.append([])
        options = prior.PriorOptions(
            tmp_path / decoder, steps=1, points=32, level="778", rounds=0, decoder=decoder
        )
        prior.train_prior(options)
    for points in seen[1:]:
        assert len(points) == len(seen[0]) > 0
        assert all(torch.equal(a, b) for a, b in zip(points, seen[0], strict=True))


def test_what_is_kept_is_not_trained_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A seed that another machine has measured counts, weights or none."""
    import handavatar.train.comparison as comparison

    options = replace(_options(tmp_path), decoders=("pair", "coap"), seeds=(3,), guides=())
    once = compare_decoders(options, (_volume,))
    for path in tmp_path.glob("*.safetensors"):
        path.unlink()

    def refused(*_: Any) -> OccupancyField:
        raise AssertionError("trained again")

    monkeypatch.setattr(comparison, "train_prior", refused)
    again = compare_decoders(options, (_volume,))
    assert again == once
    kept = json.loads((tmp_path / "coap-3.json").read_text())
    assert kept["options"]["steps"] == 1 and kept["options"]["decoder"] == "coap"
    assert len(kept["columns"]["iou"]) == 3 and len(kept["columns"]["covered"]) == 2
    with pytest.raises(AssertionError, match="trained again"):
        compare_decoders(replace(options, judged_points=128), (_volume,))


def test_a_guide_is_compared_with_the_same_decoder(tmp_path: Path) -> None:
    options = replace(_options(tmp_path), decoders=("pair", "coap"), guides=(0, 1), steps=2)
    value = compare_decoders(options, (_volume,))
    assert list(value["guides"]) == ["coap-guide-1"], "0 is the table's own guide"
    guide, own = value["guides"]["coap-guide-1"], value["decoders"]["coap"]
    assert guide["minus_coap"]["iou"]["mean"] == pytest.approx(guide["iou"] - own["iou"], abs=1e-6)
    without = replace(options, decoders=("pair", "transformer"))
    assert [row.name for row in contenders(without)] == ["pair", "transformer"]


def test_impossible_comparisons_are_refused(tmp_path: Path) -> None:
    options = _options(tmp_path / "none")
    wrong: dict[str, dict[str, Any]] = {
        "expected 'pair'": {"decoders": ("coap", "transformer")},
        "at least one other": {"decoders": ("pair",)},
        r"found \(1, 1\), expected different ones": {"seeds": (1, 1)},
        r"found \(\), expected different ones": {"seeds": ()},
        "`poses`: found 1, expected 2 to": {"poses": 1, "measured_poses": 1},
        "no more measured than judged": {"measured_poses": 4},
        "different numbers of subdivisions": {"guides": (1, 1)},
        "`guides`: found -1, expected 0 to": {"guides": (-1,)},
    }
    for message, changes in wrong.items():
        with pytest.raises(HandAvatarError, match=message):
            compare_decoders(replace(options, **changes))
    assert not (tmp_path / "none").exists()


# --- bench --table geometry -----------------------------------------------------------------------


@pytest.mark.slow
def test_the_table_has_a_row_per_decoder_and_says_what_it_rests_on(tmp_path: Path) -> None:
    wanted = {"decoders": ("pair", "coap"), "guides": (1,)} | {
        "steps": 2,
        "poses": 2,
        "resolution": 16,
    }
    options = GeometryTableOptions(**(vars(_options(tmp_path)) | wanted))
    told = Told()
    table = geometry_table(options, told.progress)
    assert list(table.rows) == ["pair", "coap", "coap-guide-1"]
    assert table.rows["pair"]["parameters"] == 232_513
    assert table.rows["pair"]["IoU - pair [95 % over poses]"] is None
    assert "[" in str(table.rows["coap"]["IoU - pair [95 % over poses]"])
    # Two steps make no hand: what has no surface has no figure, never NaN.
    cells = [cell for row in table.rows.values() for cell in row.values()]
    assert all(not isinstance(cell, float) or math.isfinite(cell) for cell in cells)
    assert options.total_steps == 6 and max(told.steps, default=0) <= 2
    assert any(note.startswith("coap-guide-1 minus coap: iou ") for note in table.notes)
    assert "2 steps of 64 points" in table.markdown()
    assert json.loads(json.dumps(table.record(), allow_nan=False)) is not None


def test_a_good_prior_has_all_columns() -> None:
    rig = load_open_hand("778")
    posed = rig.shaped().posed(HandPose(torch.zeros(16, 3), torch.zeros(3)))
    field = open_prior()
    with torch.no_grad():
        codes = field.encode(divide_into_parts(rig), posed)
        found = MeshMeasure(32)(field, codes, posed)
    columns = {"lap", "cham_to_truth", "cham_from_truth", "cham", "seam", "seam_step"}
    assert set(found) == columns
    assert all(math.isfinite(value) for value in found.values())
    assert 0 < found["cham"] < 30  # 1e-4 m; a voxel has some 60.
