from dataclasses import replace
from pathlib import Path

import pytest
from told import Told

from handavatar.avatar import HandAvatar
from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import Capture, read_capture
from handavatar.capture.synthetic import (
    SynthOptions,
    lifted_truths,
    make_capture,
    make_subject,
)
from handavatar.edit import bones_named
from handavatar.evaluate.lift_table import LiftTableOptions, lift_table
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand

TINY = SynthOptions(
    train_frames=1,
    test_frames=2,
    size=64,
    samples=64,
    subdivisions=1,
    texture=64,
    variant="scalar_rgb",
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    pytest.importorskip("mitsuba")
    return make_capture(tmp_path_factory.mktemp("lift") / "made", TINY)


@pytest.mark.slow
def test_without_a_finger_its_skin_is_gone_and_what_it_shaded_is_brighter(
    capture: Capture,
) -> None:
    subject = make_subject(subdivided(load_open_hand(), 1), TINY)
    frame = capture.frame(1)
    before = frame.image.float() / 255
    picture, is_same = next(lifted_truths(subject, [frame], TINY, bones_named(("thumb",)), 64))
    assert 0.4 * float(frame.mask.sum()) < float(is_same.sum()) < float(frame.mask.sum())
    change = (picture - before)[is_same].mean(-1)
    # Noise of 64 paths is well below this; light that the thumb sent is lost in few places.
    assert float((change > 0.04).float().mean()) > 0.005
    assert float((change < -0.04).float().mean()) < 0.5 * float((change > 0.04).float().mean())
    # Nothing lifted: the same skin everywhere, and the same picture up to noise.
    picture, is_same = next(lifted_truths(subject, [frame], TINY, (), 64))
    assert int(is_same.sum()) > 0.9 * int((frame.coverage > 253).sum())
    assert float((picture - before)[is_same].abs().mean()) < 0.02


@pytest.mark.slow
def test_the_table_judges_every_avatar_where_the_shadow_falls(
    capture: Capture, small_avatar: HandAvatar, tmp_path: Path
) -> None:
    small_avatar.save(tmp_path / "a.safetensors")
    options = LiftTableOptions(
        capture.folder, (tmp_path / "a.safetensors",), ("thumb", "middle+ring"), 2, samples=16
    )
    told = Told()
    table = lift_table(options, told.progress)
    assert told.steps == list(range(1, options.total_steps + 1))
    assert list(table.rows) == ["thumb: a.safetensors", "middle+ring: a.safetensors"]
    (tmp_path / "b").mkdir()
    small_avatar.save(tmp_path / "b" / "a.safetensors")
    twins = (*options.avatars, tmp_path / "b" / "a.safetensors")
    both = lift_table(replace(options, avatars=twins, lift=("thumb",), frames=1))
    assert list(both.rows) == [f"thumb: {path}" for path in twins], "none is lost"
    row = table.rows["thumb: a.safetensors"]
    assert row["frames"] in (1, 2) and isinstance(row["lifted"], float)


def test_a_capture_without_truth_and_a_finger_without_name_are_refused(
    tiny_capture: Path, capture: Capture
) -> None:
    with pytest.raises(CaptureError, match=r"no truth/truth.json"):
        lift_table(LiftTableOptions(tiny_capture, ()))
    with pytest.raises(ValueError, match="neither a finger"):
        lift_table(LiftTableOptions(capture.folder, (), ("pinky",)))
    assert read_capture(capture.folder).sha256 == capture.sha256
