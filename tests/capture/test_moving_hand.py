"""A film of a moving hand becomes a capture, from its file to its folder, and holds the truth.

The hand is drawn, the film compressed as a phone would, and found by a detector that knows where
the hand is and errs as it is told to. Everything between is what a user's video goes through; no
tracker's models are needed. Lengths are pixels of the film unless they say otherwise.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from moving_hand import (
    FOCAL,
    FPS,
    HEIGHT,
    NUM_PICTURES,
    WIDTH,
    MovingHand,
    TruthfulFinder,
    make_moving_hand,
)
from PIL import Image
from scipy import ndimage

from handavatar.capture import video as video_module
from handavatar.capture.fitting import LANDMARK_ERROR, FitOptions
from handavatar.capture.frames import Capture, Frame
from handavatar.capture.soundness import find_problems
from handavatar.capture.video import VideoOptions, capture_video, track_video
from handavatar.capture.video_cameras import KnownCamera, Lens
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.cameras import project
from handavatar.geometry.rotations import apply_rigid, matrix_from_axis_angle, rigid_transform
from handavatar.hand.pose_sampling import limit_excess
from handavatar.jobs.progress import SILENT

MISSED, UNSEEN, MISTAKEN, UNSURE, TORN = 4, 8, 10, 12, 14
"""Pictures in which the detector errs, each in its own way."""
TORN_PIXELS, UNSURE_PRESENCE = 3.0, 0.2
LEAVING = 16
"""From this picture on the hand goes beyond the border."""


@pytest.fixture(scope="module")
def film() -> MovingHand:
    return make_moving_hand()


@dataclass(frozen=True, eq=False)
class Made:
    """A capture, the film it was made of, and the finder that was asked."""

    capture: Capture
    film: MovingHand
    finder: TruthfulFinder

    def frame(self, number: int) -> Frame:
        """The frame of a picture of the film."""
        names = [record.name for record in self.capture.records]
        return self.capture.frame(names.index(f"{number:06d}"))

    @property
    def focal(self) -> float:
        """Length as found, pixels of the film."""
        fit = json.loads((self.capture.folder / "fit.json").read_text())
        return float(fit["focal_pixels"])

    @property
    def numbers(self) -> list[int]:
        """Of the pictures that were kept."""
        return [int(record.name) for record in self.capture.records]


def _made(film: MovingHand, folder: Path, finder: TruthfulFinder, **asked: object) -> Made:
    path = film.save(folder / "hand.mp4", finder.is_mirrored)
    options = VideoOptions(
        path,
        folder / "capture",
        rig="open-hand-778",
        fit=FitOptions(focal_share=FOCAL / max(WIDTH, HEIGHT), landmark_steps=30),
        register=RegisterOptions(coefficient_sigma=1.0, restarts=0, texture_sigmas=()),
        **asked,  # type: ignore[arg-type]
    )
    return Made(capture_video(options, film.rig, open_finder=lambda: finder), film, finder)


@pytest.fixture(scope="module")
def left(film: MovingHand, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Of a left hand: the film in a mirror, every other picture of it."""
    pytest.importorskip("cv2")
    finder = TruthfulFinder(
        film,
        is_mirrored=True,
        presence={UNSURE: UNSURE_PRESENCE},
        missed=(MISSED,),
        unseen=(UNSEEN,),
        mistaken=(MISTAKEN,),
        torn={TORN: TORN_PIXELS},
    )
    return _made(film, tmp_path_factory.mktemp("left"), finder, fps=FPS / 2)


@pytest.fixture(scope="module")
def right(film: MovingHand, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Of a right hand: every picture of the film's first half second."""
    pytest.importorskip("cv2")
    finder = TruthfulFinder(film)
    return _made(film, tmp_path_factory.mktemp("right"), finder, fps=FPS, max_frames=8)


def test_every_other_picture_is_taken_and_those_that_tell_nothing_are_left_out(left: Made) -> None:
    looked_at = list(range(0, NUM_PICTURES, 2))
    assert left.finder.tracked == looked_at
    skipped = json.loads((left.capture.folder / "skipped.json").read_text())["frames"]
    assert skipped[f"{UNSEEN:06d}"] == "no hand found"
    assert skipped[f"{UNSURE:06d}"].startswith("the tracker is not sure of a hand")
    last = looked_at[-1]
    assert skipped[f"{last:06d}"].endswith("of the hand is in the picture")
    assert left.numbers == [n for n in looked_at if n not in (UNSEEN, UNSURE, last)]
    for record in left.capture.records:
        assert record.time == pytest.approx(int(record.name) / FPS, abs=1e-6)
    assert find_problems(left.capture.folder) == []


def test_a_hand_that_is_lost_is_looked_for_where_it_was(left: Made) -> None:
    """Once straight on, and then, as every hand that is found, in two views turned either way."""
    turned = [math.radians(35), math.radians(-35)]
    looks = {number: [] for number in left.finder.tracked}
    for number, turn in left.finder.looked:
        looks[number].append(turn)
    assert looks.pop(MISSED) == pytest.approx([0.0, *turned])
    assert looks.pop(UNSEEN) == [0.0]
    assert all(turns == pytest.approx(turned) for turns in looks.values())


def test_one_mistake_about_the_side_changes_nothing(left: Made) -> None:
    assert left.capture.side == "left" and MISTAKEN in left.numbers
    summary = json.loads((left.capture.folder / "fit.json").read_text())["summary"]
    votes = {number: 0.95 for number in left.finder.tracked if number != UNSEEN}
    votes[UNSURE] = UNSURE_PRESENCE
    # The share of the votes for the side that is taken.
    expected = 1 - votes[MISTAKEN] / sum(votes.values())
    assert summary["side_votes"] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("is_mirrored", [False, True])
@pytest.mark.parametrize("asked", ["auto", "left", "right"])
def test_the_side_is_that_of_the_hand_unless_it_is_named(
    film: MovingHand, tmp_path: Path, asked: Literal["auto", "left", "right"], is_mirrored: bool
) -> None:
    """Of a left hand, or what is to be one, everything is that of the mirrored picture."""
    path = film.save(tmp_path / "hand.mp4", is_mirrored)
    options = VideoOptions(path, tmp_path / "out", fps=FPS, max_frames=8, side=asked)
    finder = TruthfulFinder(film, is_mirrored, noise=0.0)
    track = track_video(options, open_finder=lambda: finder)
    assert track.votes_right == (0.0 if is_mirrored else 1.0)
    assert track.side == (asked if asked != "auto" else "left" if is_mirrored else "right")
    is_turned = is_mirrored == (track.side == "right")
    places, points = film.landmarks()
    for hand in track.hands:
        truth, world = places[hand.index].copy(), points[hand.index].double().numpy().copy()
        picture = film.pictures[hand.index]
        if is_turned:
            truth[:, 0], world[:, 0], picture = WIDTH - truth[:, 0], -world[:, 0], picture[:, ::-1]
        assert np.allclose(hand.landmarks, truth)
        assert np.allclose(hand.world_landmarks, world)
        glance = next(each for each in track.glances if each.index == hand.index)
        assert np.abs(glance.image.astype(float) - picture).mean() < 3
        # The window shows the picture about the hand, where its corner says.
        window, middle = hand.window, truth.mean(0)
        x, y = np.floor(middle).astype(int)
        column, row = np.floor(window.from_picture(np.array([x + 0.5, y + 0.5]))).astype(int)
        seen = window.image[row - 2 : row + 3, column - 2 : column + 3].astype(float)
        shown = picture[y - 2 : y + 3, x - 2 : x + 3].astype(float)
        assert np.abs(seen.mean((0, 1)) - shown.mean((0, 1))).max() < 6


def test_known_cameras_of_a_left_hand_are_mirrored_with_it(
    film: MovingHand, tmp_path: Path
) -> None:
    """A place of the world is seen in the mirrored picture where its mirror image was."""
    pytest.importorskip("cv2")
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(8):
        mirrored = np.ascontiguousarray(film.pictures[number][:, ::-1])
        Image.fromarray(mirrored).save(folder / f"{number:03d}.png")
    turns = matrix_from_axis_angle(0.3 * torch.randn(8, 3, generator=torch.manual_seed(0)))
    views = rigid_transform(turns, torch.randn(8, 3, generator=torch.manual_seed(1)))
    lens = Lens((WIDTH, HEIGHT), (FOCAL, FOCAL), (60.0, 70.0), (0.0, 0.0), (0.0, 0.0))
    known = {f"{number:03d}.png": view for number, view in enumerate(views)}
    options = VideoOptions(folder, tmp_path / "out", fps=30.0, camera=(tmp_path,))
    finder = TruthfulFinder(film, is_mirrored=True)
    clip = video_module._tracked_clip(
        options, film.rig, KnownCamera(lens, "made", known), SILENT, None, lambda: finder
    )
    assert clip.track.side == "left" and clip.camera_from_world is not None
    assert clip.track.principal_point == (WIDTH - 60.0, 70.0)
    places = torch.randn(8, 5, 3, generator=torch.manual_seed(2))
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    seen = apply_rigid(clip.camera_from_world, places * mirror)
    assert torch.allclose(seen, apply_rigid(views, places) * mirror, atol=1e-5)


def _film_places(made: Made, frame: Frame) -> np.ndarray:
    """Where the middles of a frame's pixels lie in the film's picture of a right hand, x and y."""
    scale, side = _scale(made, frame), frame.camera.width
    y, x = np.mgrid[:side, :side] + 0.5
    places = np.stack([x, y], axis=-1) - np.array(frame.camera.center)
    return places / scale + np.array([WIDTH, HEIGHT]) / 2


def _scale(made: Made, frame: Frame) -> float:
    """Pixels of a frame in one of the film."""
    return frame.camera.focal[0] / made.focal


def _seen_by(made: Made, frame: Frame, pictures: np.ndarray) -> np.ndarray:
    """What a frame ought to show of the film's pictures, or of its masks; beyond them zeros."""
    columns, rows = np.moveaxis(_film_places(made, frame) - 0.5, -1, 0)
    picture = pictures[int(frame.name)].astype(float)
    layers = np.moveaxis(picture.reshape(HEIGHT, WIDTH, -1), -1, 0)
    seen = [ndimage.map_coordinates(layer, [rows, columns], order=1) for layer in layers]
    return np.stack(seen, axis=-1).squeeze()


def _before_wrist(made: Made, frame: Frame) -> np.ndarray:
    """How far a frame's pixels lie on the hand's side of the middle of its end, pixels of the film.

    Where the mesh ends the forearm goes on; the mask is to end on a line through that middle.
    """
    vertices = made.film.vertices()[int(frame.name)].numpy()
    places = vertices[:, :2] / vertices[:, 2:] * FOCAL + np.array([WIDTH, HEIGHT]) / 2
    middle = places[made.film.rig.rim.numpy()].mean(0)
    towards = places.mean(0) - middle
    return (_film_places(made, frame) - middle) @ (towards / np.linalg.norm(towards))


def _inside_film(made: Made, frame: Frame) -> np.ndarray:
    """Pixels of a frame that lie wholly in the film's picture."""
    half = 0.5 / _scale(made, frame)
    places = _film_places(made, frame)
    return ((places > half - 1e-3) & (places < np.array([WIDTH, HEIGHT]) - half + 1e-3)).all(-1)


LUMA = np.array([0.2126, 0.7152, 0.0722])


def _shift(seen: np.ndarray, expected: np.ndarray, where: np.ndarray) -> np.ndarray:
    """By how many pixels, to the right and down, a picture is beside the expected one."""
    slopes = np.stack(np.gradient(expected, axis=(1, 0)), axis=-1)[where].reshape(-1, 2)
    apart = (expected - seen)[where].reshape(-1)
    return np.linalg.lstsq(slopes, apart, rcond=None)[0]


# A right hand goes the same way but for the mirror; it takes as long again.
BOTH = pytest.mark.parametrize("side", ["left", pytest.param("right", marks=pytest.mark.slow)])


@pytest.fixture
def made(side: str, request: pytest.FixtureRequest) -> Made:
    return request.getfixturevalue(side)


@BOTH
def test_pictures_are_cut_out_where_their_cameras_say(made: Made) -> None:
    """To a twentieth of a pixel of the film, in the colours of the film."""
    for number in made.numbers:
        frame = made.frame(number)
        scale = _scale(made, frame)
        # Compression and two resamplings blur; what they do is even.
        seen, expected = (
            ndimage.gaussian_filter(picture.astype(float), (scale, scale, 0))
            for picture in (frame.image.numpy(), _seen_by(made, frame, made.film.pictures))
        )
        where = ndimage.binary_erosion(frame.known.numpy(), iterations=8, border_value=0)
        assert where.mean() > 0.3
        assert np.abs(seen - expected)[where].mean() < 3
        # By its brightness: the film's colours have half its pixels.
        assert np.abs(_shift(seen @ LUMA, expected @ LUMA, where) / scale).max() < 0.05
        # Of 255: the film keeps 219 steps, PIL rounds down.
        assert np.abs((seen - expected)[where].mean(0)).max() < 1.5


@BOTH
def test_the_box_has_room_about_the_hand_on_every_side(made: Made) -> None:
    for number in made.numbers:
        frame = made.frame(number)
        skin = _seen_by(made, frame, made.film.masks) + _seen_by(made, frame, made.film.arms)
        rows, columns = np.nonzero((skin > 0.5) & (_before_wrist(made, frame) > 0))
        low, high = (np.array([f(columns), f(rows)]) + 0.5 for f in (np.min, np.max))
        side = frame.camera.width
        # 1.3 times the hand. Its end is known to four pixels in 70: 4 mm twice.
        assert (high - low).max() / side * 1.3 == pytest.approx(1.0, abs=0.06)
        assert np.abs((low + high) / 2 / side - 0.5).max() < 0.025
        # 1.3 times what was taken for the hand, to a pixel on either side.
        own = max(np.ptp(places) + 1 for places in np.nonzero(frame.alpha.numpy() > 0.5))
        assert own / side * 1.3 == pytest.approx(1.0, abs=0.03)


@BOTH
def test_masks_are_the_hand_without_the_forearm(made: Made) -> None:
    for number in made.numbers:
        frame = made.frame(number)
        known, alpha = frame.known.numpy(), frame.alpha.numpy()
        hand, arm = (_seen_by(made, frame, of) for of in (made.film.masks, made.film.arms))
        before = _before_wrist(made, frame)
        # The end is known to four pixels, as above, and the cut need not be square to the hand.
        judged = known & (before > 4)
        true, found = hand > 0.5, alpha > 0.5
        border = (true & ~ndimage.binary_erosion(true) & judged).sum() / _scale(made, frame)
        # The film has colours for blocks of two pixels: to half a pixel outwards or inwards on the
        # whole, and to three quarters along the border.
        area = _scale(made, frame) ** 2
        assert abs(int(found[judged].sum()) - int(true[judged].sum())) / area / border < 0.5
        assert (found ^ true)[judged].sum() / area / border < 0.75
        assert known[(hand > 0.5) & (before > 4) & _inside_film(made, frame)].mean() > 0.97
        assert (arm > 0.5).mean() > 0.01
        assert alpha[before < -4].max(initial=0.0) == 0.0


def test_what_lies_beyond_the_picture_is_unknown_and_shows_nothing(left: Made) -> None:
    assert any(number >= LEAVING for number in left.numbers)
    for number in left.numbers:
        frame = left.frame(number)
        known, inside = frame.known.numpy(), _inside_film(left, frame)
        assert not known[~inside].any() and not frame.coverage.numpy()[~inside].any()
        assert (frame.image.numpy()[~inside] == 128).all()
        # Within it everything is known, but at the wrist.
        assert known[inside & (_before_wrist(left, frame) > 4)].mean() > 0.98
        if number >= LEAVING:
            assert (~inside).mean() > 0.1


@BOTH
def test_poses_are_those_of_the_film(made: Made) -> None:
    """Of a left hand those of the right one that its mirror image shows."""
    truth = made.film.vertices()
    hand = made.film.rig.shaped(made.capture.shape_coefficients)
    apart = []
    for number in made.numbers:
        frame = made.frame(number)
        scale = _scale(made, frame)
        vertices = hand.posed(frame.pose).vertices
        seen = project(frame.camera, vertices)[0].numpy()
        true = truth[number].numpy()
        places = true[:, :2] / true[:, 2:] * FOCAL * scale + np.array(frame.camera.center)
        apart.append(np.linalg.norm(seen - places, axis=-1).mean() / scale)
        # Metres. One camera hardly tells depth; the landmarks' own are believed to 20 mm.
        depths = vertices[:, 2].numpy()
        relative = (depths - depths.mean()) - (true[:, 2] - true[:, 2].mean())
        assert np.abs(relative).mean() < 0.010
        # A large hand far away looks like a small one that is near.
        assert depths.mean() / made.focal == pytest.approx(true[:, 2].mean() / FOCAL, rel=0.05)
    # The fit takes landmarks to be 4 mm off, whatever it is told: so many pixels at this depth.
    expected = LANDMARK_ERROR * FOCAL / float(truth[..., 2].mean())
    assert np.mean(apart) < expected and np.max(apart) < 2 * expected


@BOTH
def test_joints_stay_within_their_limits(made: Made) -> None:
    for record in made.capture.records:
        excess = limit_excess(made.film.rig, record.pose.rotations[None])[0, 1:]
        assert float(excess.max()) < math.radians(6)


@BOTH
def test_exposure_is_followed(made: Made) -> None:
    """The wall tells it, to a third of the drift: what is unsure is taken for less."""
    found = np.log([record.gain for record in made.capture.records])
    true = np.log(made.film.gains[made.numbers]) / 2.2
    true -= true.mean(0)
    assert np.abs(found - true).max() < 0.02
    assert np.abs(found.mean(0)).max() < 1e-3


def test_confidence_falls_with_what_the_detector_says(left: Made) -> None:
    frames = json.loads((left.capture.folder / "fit.json").read_text())["frames"]
    sure = {
        number: frames[f"{number:06d}"]["confidence"] for number in left.numbers if number != TORN
    }
    assert min(sure.values()) > 0.93 and max(sure.values()) < 1.0
    # A tracker that is sure to nine tenths is believed.
    unsure = frames[f"{UNSURE:06d}"]["confidence"]
    assert unsure == pytest.approx(UNSURE_PRESENCE / 0.9, rel=0.07)
    # Looks that are apart by so many pixels: along both axes, at the scale of the hand's depth.
    depth = float(left.film.vertices()[TORN, :, 2].mean())
    metres = TORN_PIXELS * math.sqrt(2) * depth / FOCAL
    expected = math.exp(-((metres / 0.015) ** 2))
    assert frames[f"{TORN:06d}"]["confidence"] == pytest.approx(expected, rel=0.12)


@pytest.mark.slow
def test_the_same_motion_is_found_of_either_hand(left: Made, right: Made) -> None:
    """Relative to the wrist, in pictures that both have: one film is the other in a mirror."""
    for number in sorted(set(left.numbers) & set(right.numbers) - {TORN}):
        shapes = []
        for made in (left, right):
            hand = made.film.rig.shaped(made.capture.shape_coefficients)
            vertices = hand.posed(made.frame(number).pose).vertices
            vertices = vertices - vertices.mean(0)
            shapes.append(vertices / vertices.norm(dim=-1).mean())
        # A share of the hand's size: some 3 mm.
        assert float((shapes[0] - shapes[1]).norm(dim=-1).mean()) < 0.06
