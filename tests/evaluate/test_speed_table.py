"""The table of rendering's speed: same pictures, honest counts, and what it refuses."""

import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import pytest
import torch
from conftest import bent_pose
from told import Told

from handavatar.avatar import HandAvatar
from handavatar.evaluate.speed_table import (
    SpeedTableOptions,
    counted,
    hand_camera,
    most_memory,
    speed_table,
)
from handavatar.geometry.cameras import project


@pytest.fixture(scope="module")
def options(
    small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory
) -> SpeedTableOptions:
    path = tmp_path_factory.mktemp("speed") / "avatar.safetensors"
    small_avatar.save(path)
    return SpeedTableOptions(
        path, size=16, poses=2, plain_rays=40, plain_points=(512,), sizes=(8,), hands=(3,)
    )


@pytest.mark.slow
def test_the_ways_are_timed_on_the_same_pictures(options: SpeedTableOptions) -> None:
    told = Told()
    table = speed_table(options, told.progress)
    assert list(table.rows) == [
        *("plain", "exact", "near-exact", "exact, 3 hands", "near-exact, 3 hands"),
        *("exact, 8 pixels", "near-exact, 8 pixels"),
    ]
    exact, near = table.rows["exact"], table.rows["near-exact"]
    assert isinstance(exact["max error"], float) and exact["max error"] < 5e-5
    assert isinstance(near["PSNR"], float) and near["PSNR"] > 60
    work = [table.rows[name]["TFLOP"] for name in ("plain", "exact", "near-exact")]
    assert work[0] > work[1] > work[2] > 0  # type: ignore[operator]
    assert told.steps[-1] == options.total_steps
    assert json.loads(json.dumps(table.record(), allow_nan=False)) is not None
    shown = table.markdown()
    assert "2 poses of 16x16 pixels" in shown and "ms a hand" in shown
    assert "8192 places in the box around a hand" in shown
    memory = table.rows["exact, 8 pixels"]["MB at most"]
    assert isinstance(memory, int) and 100 < memory < 2000


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process's own peak")
def test_the_memory_of_whoever_started_a_process_is_not_its_own() -> None:
    torch.ones(150_000_000).sum()  # 600 MB, given back
    cpu = torch.device("cpu")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        child = pool.submit(most_memory, cpu).result()
    assert 100 < child < most_memory(cpu) - 300


def test_operations_and_bytes_are_counted() -> None:
    left, right = torch.zeros(20, 30), torch.zeros(30, 40)
    flops, traffic = counted(lambda: (left @ right).view(-1))
    assert flops == 2 * 20 * 30 * 40
    assert traffic == 4 * (20 * 30 + 30 * 40 + 20 * 40)


def test_the_camera_holds_the_whole_hand(small_avatar: HandAvatar) -> None:
    with torch.no_grad():
        vertices = small_avatar.prepare(bent_pose(3)).posed.vertices
    for direction in ((0.0, 1.0, 0.0), (0.3, -0.5, 0.6)):
        pixels, depth = project(hand_camera(vertices, direction, 64), vertices)
        assert float(depth.min()) > 0
        assert float(pixels.min()) >= 0 and float(pixels.max()) <= 64
        assert float((pixels.amax(0) - pixels.amin(0)).max()) > 0.5 * 64


@pytest.mark.parametrize(
    ("wrong", "message"), [({"poses": 0}, "`poses`"), ({"plain_rays": 257}, "`plain_rays`")]
)
def test_what_cannot_be_timed_is_refused(
    options: SpeedTableOptions, wrong: dict[str, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        speed_table(replace(options, **wrong))  # type: ignore[arg-type]
