import json
from dataclasses import replace
from pathlib import Path

import pytest
from told import Told

from handavatar.capture import benchmark
from handavatar.capture.benchmark import (
    SUBJECTS,
    BenchmarkOptions,
    benchmark_names,
    make_benchmark,
    synth_options,
)
from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import read_capture
from handavatar.capture.soundness import find_problems
from handavatar.jobs.files import MARKER


def test_names_say_subject_lighting_transport_and_what_is_worse() -> None:
    names = benchmark_names()
    assert len(names) == len(set(names)) == 3 * 3 * 2 + 3 * 6
    tones = [tone for _, tone in SUBJECTS.values()]
    assert min(tones) < 0.1 and max(tones) > 0.9
    options = synth_options("dark-colored-direct", "standard")
    assert (options.lighting, options.transport, options.size) == ("colored", "direct", 256)
    assert options.contacts and options.test_views > 1
    # Subject and motion are those of the name, whatever the light.
    assert options.seed == synth_options("dark-dome", "mini").seed == SUBJECTS["dark"][0]


def test_sources_come_before_what_is_made_from_them() -> None:
    names = BenchmarkOptions(only=("dark-key-pose5", "light-dome")).names()
    assert names == ("light-dome", "dark-key", "dark-key-pose5")
    assert BenchmarkOptions().names() == benchmark_names()
    with pytest.raises(CaptureError, match="no 'purple-key'"):
        BenchmarkOptions(only=("purple-key",)).names()


@pytest.fixture
def tiny_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """``mini`` takes seconds."""
    pytest.importorskip("mitsuba")
    tiny = replace(
        benchmark._SIZES["mini"],
        train_frames=2,
        test_frames=2,
        size=24,
        samples=16,
        subdivisions=1,
        texture=64,
        variant="scalar_rgb",
    )
    monkeypatch.setitem(benchmark._SIZES, "mini", tiny)


def _contents(folder: Path) -> dict[str, bytes]:
    """Of the files but for the marker, which says when it was written."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != MARKER)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.slow
def test_the_same_bits_every_time(tmp_path: Path, tiny_size: None) -> None:
    options = BenchmarkOptions(only=("dark-key-pose5",))
    made = [make_benchmark(tmp_path / place, options) for place in ("first", "second")]
    for first, second in zip(*made, strict=True):
        before, after = _contents(first), _contents(second)
        assert len(before) > 10 and before.keys() == after.keys()
        for name, content in before.items():
            assert content == after[name], f"{first.name}/{name}"


@pytest.mark.slow
def test_what_is_there_is_not_made_again(tmp_path: Path, tiny_size: None) -> None:
    told = Told()
    options = BenchmarkOptions(only=("light-colored-direct", "light-key-pose5"))
    folders = make_benchmark(tmp_path, options, told.progress)
    assert list(dict.fromkeys(job for job, _, _ in told.counts)) == [
        "light-key",
        "light-colored-direct",
        "light-key-pose5",
    ]
    times = [(folder / "transforms.json").stat().st_mtime_ns for folder in folders]
    for folder in folders:
        assert find_problems(folder) == []
        facts = json.loads((folder / "truth/truth.json").read_text())
        assert facts["noise_psnr"] > 20
    assert make_benchmark(tmp_path, options) == folders
    assert [(folder / "transforms.json").stat().st_mtime_ns for folder in folders] == times
    # Training has one standing camera; the test's cameras take turns.
    frames = [read_capture(folders[0]).frame(index) for index in range(4)]
    forward = [frame.camera.camera_from_world[2, :3] for frame in frames]
    assert float(forward[0] @ forward[1]) > 0.9999
    assert 0.8 < float(forward[2] @ forward[3]) < 0.9
