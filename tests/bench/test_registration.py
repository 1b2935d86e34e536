"""The table of registration, on captures with known poses and on a film's truth."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from told import Told

from handavatar.bench import registration
from handavatar.bench.measures import COLUMNS
from handavatar.bench.registration import (
    FoundClip,
    RegistrationTableOptions,
    judge_film,
    judge_poses,
    registration_table,
)
from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import read_capture
from handavatar.geometry.cameras import Camera
from handavatar.synthetic.films import FilmOptions, make_film
from handavatar.synthetic.truth import FilmTruth
from handavatar.train.kept import write_kept


def test_true_poses_are_found_to_be_true(tiny_capture: Path) -> None:
    source = read_capture(tiny_capture)
    indices = list(source.split("train"))
    scores = judge_poses(source, indices, [source.frame(index).pose for index in indices])
    assert scores.figures["vertices_mm"] == pytest.approx(0, abs=1e-3)
    assert scores.figures["angle_deg"] == pytest.approx(0, abs=0.05)
    assert scores.figures["landmarks_px"] == pytest.approx(0, abs=1e-3)
    assert scores.figures["frames_kept"] is None
    assert len(scores.of_frames) == len(indices)


def test_noise_is_told_row_by_row(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Registration that knows the truth: its row must show it.
    source = read_capture(tiny_capture)
    monkeypatch.setattr(
        registration,
        "register_capture",
        lambda capture: [source.frame(i).pose for i in range(len(source.records))],
    )
    options = RegistrationTableOptions(
        (tiny_capture,),
        cases=("noise5",),
        rows=("tracked", "fitted", "registered"),
        seeds=(0, 1),
        keep=tmp_path,
    )
    told = Told()
    table = registration_table(options, told.progress)
    record = json.loads(json.dumps(table.record()))
    assert set(record) == {"noise5", "noise5/tiny-0", "noise5/tiny-1"}
    for rows in record.values():
        assert set(rows) == {"tracked", "registered"}
        for figures in rows.values():
            assert set(figures) == {*COLUMNS, "interval"}
    tracked, registered = record["noise5"]["tracked"], record["noise5"]["registered"]
    assert tracked["angle_deg"] == pytest.approx(5, rel=0.25)
    assert tracked["vertices_mm"] > 3 and registered["vertices_mm"] < 0.01
    low, high = tracked["interval"]
    assert low < tracked["vertices_mm"] < high
    assert "noise5, registered" in table.markdown()
    assert sorted(set(told.steps)) == [1, 2, 3, 4]
    # What was kept is not measured again.
    monkeypatch.setattr(registration, "register_capture", lambda capture: 1 / 0)
    assert registration_table(options).record() == table.record()
    # Of another commit, or of another capture of that name, it is refused.
    kept = tmp_path / "noise5-tiny-0-tracked.json"
    content = json.loads(kept.read_text())
    write_kept(kept, content | {"commits": {"figures": "0123abcd"}})
    with pytest.raises(CaptureError, match="measured by commit 0123abcd"):
        registration_table(options)
    shown = registration_table(replace(options, any_commit=True))
    assert shown.record() == table.record() and "commit 0123abcd" in shown.notes[-1]
    write_kept(kept, content | {"capture_sha256": "0" * 64})
    with pytest.raises(CaptureError, match="are of another capture"):
        registration_table(options)


@pytest.mark.parametrize(
    ("wrong", "remedy"), [({"cases": ("noisy",)}, "noise2"), ({"rows": ("all",)}, "choose among")]
)
def test_unknown_names_are_refused(wrong: dict[str, tuple[str, ...]], remedy: str) -> None:
    with pytest.raises(CaptureError, match=remedy):
        RegistrationTableOptions(**wrong)  # type: ignore[arg-type]


def _crop(truth: FilmTruth, focal: float) -> Camera:
    """The whole height of the picture as a square crop, for a fit of another focal length."""
    height, width = truth.camera.height, truth.camera.width
    zoom = 128 / height
    center = (width / 2 * zoom - (width - height) / 2 * zoom, 64.0)
    return Camera((focal * zoom, focal * zoom), center, 128, 128, torch.eye(4))


def test_a_films_truth_judges_itself_right(small_film: FilmTruth) -> None:
    truth = small_film
    hand = replace(truth.rig.shaped(truth.shape_coefficients), rest_vertices=truth.rest_vertices)
    pictures = [0, 2, 4]
    focal = truth.camera.focal[0]
    clip = FoundClip(
        hand,
        pictures,
        [truth.pose(picture) for picture in pictures],
        focal,
        [_crop(truth, focal)] * 3,
        [True, False, True],
    )
    figures = judge_film(truth, clip, tried=4).figures
    assert figures["vertices_mm"] == pytest.approx(0, abs=1e-3)
    assert figures["size_error"] == figures["focal_error"] == 0
    # The mesh of 1,609 vertices has the outline of the finer one that was rendered.
    assert figures["mask_iou"] > 0.96 and figures["border_px"] < 1.0
    assert (figures["frames_kept"], figures["rejected_right"]) == (0.5, 0.25)
    assert figures["kept_wrong"] == 0 and figures["cut_mask_iou"] is None
    # A hand that is off sideways by 5 mm lies 5 mm off, and everything else tells the same.
    shifted = [
        replace(pose, translation=pose.translation + torch.tensor([0.005, 0.0, 0.0]))
        for pose in clip.poses
    ]
    moved = judge_film(truth, replace(clip, poses=shifted), tried=4).figures
    assert moved["vertices_mm"] == pytest.approx(5, rel=0.02)
    assert moved["landmarks_mm"] == pytest.approx(5, rel=0.02)
    expected = 0.005 * focal / float(truth.posed(0).vertices[:, 2].mean()) * 256 / 96
    assert moved["landmarks_px"] == pytest.approx(expected, rel=0.1)
    assert moved["mask_iou"] < figures["mask_iou"]


def test_nothing_kept_leaves_errors_open(small_film: FilmTruth) -> None:
    truth = small_film
    focal = truth.camera.focal[0]
    clip = FoundClip(
        truth.rig.shaped(truth.shape_coefficients),
        [1],
        [truth.pose(1)],
        focal,
        [_crop(truth, focal)],
        [False],
        [np.zeros((128, 128), bool)],
    )
    figures = judge_film(truth, clip, tried=1).figures
    assert figures["vertices_mm"] is None and figures["mask_iou"] is None
    assert figures["frames_kept"] == 0 and figures["rejected_right"] == 1


@pytest.mark.slow
def test_a_film_goes_all_the_way(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe")
    film = FilmOptions(
        "short", 21, 0.2, ("spread", "relaxed"), width=320, height=240, seconds=1.6, fps=10.0
    )
    make_film(film, tmp_path / "films")
    options = RegistrationTableOptions(films=tmp_path / "films", cases=("video",))
    rows = registration_table(options).cases["video"]
    assert {"tracked", "fitted", "outlines", "registered"} == set(rows)
    kept = rows["registered"]["frames_kept"]
    assert isinstance(kept, float) and kept > 0.5
    off = {row: figures["vertices_mm"] for row, figures in rows.items()}
    assert all(isinstance(value, float) and 1 < value < 25 for value in off.values())
    assert off["registered"] < off["tracked"]


@pytest.mark.slow
def test_a_film_goes_all_the_way_without_mediapipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cv2")
    monkeypatch.setitem(sys.modules, "mediapipe.python.solutions.hands", None)
    film = FilmOptions(
        "short", 21, 0.2, ("spread", "relaxed"), width=320, height=240, seconds=1.6, fps=10.0
    )
    make_film(film, tmp_path / "films")
    options = RegistrationTableOptions(
        films=tmp_path / "films", cases=("video",), rows=("registered",)
    )
    figures = registration_table(options).cases["video"]["registered"]
    kept, off = figures["frames_kept"], figures["vertices_mm"]
    assert isinstance(kept, float) and kept > 0.5
    assert isinstance(off, float) and 1 < off < 15
