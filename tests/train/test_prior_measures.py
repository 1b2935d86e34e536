"""The table of geometry: rows are complete, repeat, and tell a prior from an untrained field."""

import json
import math
from dataclasses import asdict

import pytest
import torch

from handavatar import cli
from handavatar.field.occupancy import PairOccupancy
from handavatar.hand.open_hand import load_open_hand
from handavatar.train.prior import SHIPPED_PRIOR, load_prior
from handavatar.train.prior_measures import (
    measure_prior,
    measure_prior_file,
    summarised,
    unseen_fists,
    unseen_hands,
)


@pytest.mark.slow
def test_a_prior_gets_a_row_per_hand_that_json_can_hold() -> None:
    prior = PairOccupancy()
    load_prior(prior)
    rig = load_open_hand("778")
    hands = [*unseen_hands(rig, rig, 1), *unseen_fists(rig, rig, 1)]
    rows = measure_prior(prior, hands, resolution=32, num_points=512)
    assert len(rows) == 2
    again = measure_prior(prior, hands[:1], resolution=32, num_points=512)[0]
    assert asdict(again) | {"seconds": 0} == asdict(rows[0]) | {"seconds": 0}
    for row in rows:
        json.dumps(asdict(row), allow_nan=False)
        # The coarse hand is not the one that the prior was made for: near, not good.
        assert row.iou > 0.6 and row.cham < 15 and row.pieces < 5
        assert row.cham == pytest.approx((row.cham_to_truth + row.cham_from_truth) / 2)
        # So coarse a grid is asked everywhere, and then twice at each vertex.
        assert 0.7 < row.saved < 1
    assert rows[1].contact_error is not None and 0 <= rows[1].contact_error < 0.5
    summary = summarised(rows)
    json.dumps(summary, allow_nan=False)
    assert summary["iou"]["mean"] == pytest.approx((rows[0].iou + rows[1].iou) / 2)
    assert summary["iou"]["count"] == 2
    assert summarised(rows[:1])["iou"]["half_width"] is None


def test_a_field_without_a_surface_is_refused() -> None:
    rig = load_open_hand("778")
    field = PairOccupancy()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.zero_()
        field.decoder.mlp.output.bias.fill_(-1.0)
    with pytest.raises(ValueError, match="has no surface"):
        measure_prior(field, unseen_hands(rig, rig, 1), resolution=16, num_points=64)


def test_unseen_hands_repeat_and_differ() -> None:
    rig = load_open_hand("778")
    first, second = (unseen_hands(rig, rig, 2)[:] for _ in range(2))
    assert torch.equal(first[1].vertices, second[1].vertices)
    assert not torch.equal(first[0].vertices, first[1].vertices)
    fists = unseen_fists(rig, rig, 2)
    spread = (fists[0].pose.rotations - fists[1].pose.rotations)[1:].norm(dim=-1)
    assert 0 < float(spread.mean()) < math.radians(30)


def test_prior_evaluate_extracts_meshes_only_if_asked(capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "prior",
        "evaluate",
        "--poses",
        "1",
        "--points",
        "64",
        "--level",
        "778",
        "--rounds",
        "0",
        "--json",
    ]
    assert cli.main(words) == 0
    asked_for = {"iou", "iou_boxes", "iou_surface", "iou_people"}
    assert set(json.loads(capsys.readouterr().out)) == asked_for


def test_a_prior_file_is_measured_on_unseen_poses_and_fists() -> None:
    found = measure_prior_file(SHIPPED_PRIOR, load_open_hand("778"), 0, count=1, resolution=16)
    assert set(found) == {"unseen", "fists"}
    assert found["fists"]["contact_error"]["count"] == 1
    assert all(columns["cham"]["mean"] > 0 for columns in found.values())
