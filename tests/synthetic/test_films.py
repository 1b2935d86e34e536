"""Made videos: the picture shows what the truth says."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, video_frames
from handavatar.errors import ArgumentError
from handavatar.geometry.cameras import project
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose_sampling import PenetrationProbe, limit_excess
from handavatar.synthetic.films import FILMS, FilmOptions, drifting_gains, natural_motion
from handavatar.synthetic.truth import FilmTruth, read_film_truth


def test_the_mask_is_where_the_picture_differs_from_its_background(
    small_film: FilmTruth, film_folder: Path
) -> None:
    frames = list(video_frames(film_folder / f"{small_film.name}.mp4", Sampling(small_film.fps)))
    assert len(frames) == len(small_film)
    for number in (0, len(frames) - 1):
        mask = small_film.mask(number).numpy()
        picture = frames[number].image.astype(float)
        # The sleeved arm leaves below: above the wrist, all that is no wall is hand.
        wrist = float(project(small_film.camera, small_film.posed(number).joints[0])[0][1])
        above = np.arange(len(mask)) < wrist - 4
        wall = np.median(picture[:, :8], axis=(0, 1))
        differs = np.abs(picture - wall).max(-1) > 25
        found, true = differs[above], mask[above] > 0.5
        assert (found & true).sum() / (found | true).sum() > 0.88


def test_the_mask_is_the_projected_hand(small_film: FilmTruth) -> None:
    vertices = small_film.posed(2).vertices
    pixels, depth = project(small_film.camera, vertices)
    mask = small_film.mask(2)
    low, high = pixels.amin(0), pixels.amax(0)
    rows, columns = (mask > 0.5).nonzero().unbind(-1)
    assert float(rows.min()) == pytest.approx(float(low[1]), abs=1.5)
    assert float(columns.min()) == pytest.approx(float(low[0]), abs=1.5)
    assert float(columns.max()) + 1 == pytest.approx(float(high[0]), abs=1.5)
    assert 0.2 < float(depth.mean()) < 0.8
    assert float(small_film.inside[2]) == 1.0
    # Antialiased: there are pixels that the hand covers in part.
    assert bool(((mask > 0.2) & (mask < 0.8)).any())


def test_the_video_says_bt_709(small_film: FilmTruth, film_folder: Path) -> None:
    with av.open(str(film_folder / f"{small_film.name}.mp4")) as container:
        context = container.streams.video[0].codec_context
        assert context.name == "h264"
        tags = (context.color_primaries, context.color_trc, context.colorspace)
        assert tags == (1, 1, 1)


def test_motions_are_natural() -> None:
    rig = load_open_hand()
    for film in FILMS[:2]:
        motion = natural_motion(rig, film)
        assert len(motion) == film.num_frames
        assert float(limit_excess(rig, motion.rotations).max()) < 0.3
        assert float(PenetrationProbe(rig).depths(motion.rotations[::9]).max()) < 0.006
        speed = motion.translations.diff(dim=0).norm(dim=-1) * film.fps
        assert 0.01 < float(speed.mean()) < 0.5 and float(speed.max()) < 1.5


def test_the_hand_leaves_the_picture_where_it_is_to() -> None:
    rig = load_open_hand()
    film = next(film for film in FILMS if film.leaves)
    motion = natural_motion(rig, film)
    reach = film.width / 2 / (film.focal_share * max(film.width, film.height))
    beside = motion.translations[:, 0] / motion.translations[:, 2]
    assert float(beside.max()) > 0.8 * reach and float(beside[0].abs()) < 0.6 * reach


def test_gains_drift_about_one() -> None:
    gains = drifting_gains(FILMS[0])
    assert gains.shape == (FILMS[0].num_frames, 3)
    torch.testing.assert_close(gains.log().mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    assert 1.05 < float(gains.max() / gains.min()) < 1.8
    assert float((gains[:, 0] / gains[:, 2]).max()) > 1.01


def test_films_that_cannot_be_made_are_refused() -> None:
    with pytest.raises(ArgumentError, match="`seconds`: found 0"):
        FilmOptions("none", 1, seconds=0.0)
    with pytest.raises(CaptureError, match="no gesture"):
        natural_motion(load_open_hand(), replace(FILMS[0], gestures=("relaxed", "nonsense")))


def test_damaged_truth_is_refused(film_folder: Path, small_film: FilmTruth, tmp_path: Path) -> None:
    source = film_folder / f"{small_film.name}.json"
    (tmp_path / "a.json").write_bytes(source.read_bytes())
    with pytest.raises(CaptureError, match="cannot be read"):
        read_film_truth(tmp_path / "a.mp4")
    (tmp_path / "a.json").write_text('{"schema": 7}')
    with pytest.raises(CaptureError, match="schema is 7"):
        read_film_truth(tmp_path / "a.mp4")
