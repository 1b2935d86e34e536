"""The second pass: near the mesh alone, and honest about what the picture leaves open."""

from dataclasses import replace

import numpy as np
import pytest
from made_hands import CORNER, FOCAL, PICTURE, SIDE, SKIN, made_fit, made_hand
from scipy import ndimage

from handavatar.capture.fitted_hand import HandModel
from handavatar.capture.guided_masks import (
    GuidedMask,
    PlacedMesh,
    WristLine,
    at_average_exposure,
    cut_at_wrist,
    find_guided_mask,
    is_cut_unsure,
    learn_guided_colors,
    placed_mesh,
    wrist_line,
)
from handavatar.capture.tracking import TrackedHand
from handavatar.capture.windows import Window
from handavatar.hand.open_hand import load_open_hand

pytest.importorskip("cv2")
NUMBERS = range(3)


def _mesh(hand: TrackedHand, number: int) -> PlacedMesh:
    rig = load_open_hand("778")
    return placed_mesh(rig, HandModel(rig).all_vertices(made_fit(number))[0], FOCAL, hand)


def _with_image(hand: TrackedHand, image: np.ndarray) -> TrackedHand:
    return replace(hand, window=replace(hand.window, image=image.clip(0, 255).astype(np.uint8)))


def _found(hands: list[TrackedHand]) -> tuple[GuidedMask, PlacedMesh]:
    """The second pass over some pictures of the made hand; the last one's mask."""
    meshes = [_mesh(hand, number) for number, hand in enumerate(hands)]
    gains = np.ones((len(hands), 3))
    colors = learn_guided_colors(hands, meshes, gains)
    return find_guided_mask(hands[-1], meshes[-1], colors, gains[-1]), meshes[-1]


def _before(mesh: PlacedMesh) -> np.ndarray:
    return mesh.wrist.before_pixels(SIDE) > 0


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_before_a_plain_wall_the_mask_is_right_and_everything_is_known() -> None:
    made = [made_hand(number) for number in NUMBERS]
    found, mesh = _found([hand for hand, _ in made])
    before = _before(mesh)
    assert _overlap(found.mask.pixels & before, made[-1][1] & before) > 0.97
    assert float(found.known.mean()) > 0.995
    assert found.edge_quality > 0.85 and found.agreement > 0.95 and found.covered_share == 0


def test_a_face_behind_the_hand_does_not_join_it() -> None:
    """A large patch of the very colour of the skin behind the fingertips."""
    y, x = np.mgrid[:SIDE, :SIDE]
    face = np.hypot(x - 160, y - 60) < 80
    hands, truths = [], []
    for number in NUMBERS:
        hand, truth = made_hand(number)
        shaded = SKIN * (0.7 + 0.3 * x / SIDE)[..., None]
        noise = np.random.default_rng(number).normal(0, 5, shaded.shape)
        image = np.where((face & ~truth)[..., None], shaded + noise, hand.window.image)
        hands.append(_with_image(hand, image))
        truths.append(truth)
    found, mesh = _found(hands)
    before = _before(mesh)
    away = ndimage.distance_transform_edt(~mesh.covered) / mesh.scale
    assert not (found.mask.pixels & before & (away > 0.0085)).any()
    # What is called hand or background is right, and the border that nobody can see is unknown.
    wrong = (found.mask.pixels ^ truths[-1]) & found.known & before
    assert wrong.sum() < 0.03 * truths[-1].sum()
    plain, _ = _found([made_hand(number)[0] for number in NUMBERS])
    assert found.edge_quality < plain.edge_quality - 0.1
    assert (~found.known).sum() > 10 * (~plain.known).sum()


def test_an_object_before_the_palm_is_unknown_and_not_background() -> None:
    made = [made_hand(number) for number in NUMBERS]
    hands = [hand for hand, _ in made]
    mesh = _mesh(hands[-1], NUMBERS[-1])
    depth = ndimage.distance_transform_edt(mesh.covered)
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    image = hands[-1].window.image.copy()
    size = round(0.009 * mesh.scale)
    box = np.s_[row - size : row + size, column - size : column + size]
    image[box] = (20, 160, 60)
    hands[-1] = _with_image(hands[-1], image)
    found, _ = _found(hands)
    inner = np.s_[row - size + 2 : row + size - 2, column - size + 2 : column + size - 2]
    assert not found.known[inner].any() and not found.mask.pixels[inner].any()
    assert 0.5 < found.covered_share * mesh.covered.sum() / (2 * size) ** 2 < 1.5
    assert float(found.known.mean()) > 0.97


def test_beyond_the_camera_s_picture_nothing_is_known() -> None:
    made = [made_hand(number) for number in NUMBERS]
    hand = made[-1][0]
    # The same window, but the picture ends at its column 200: what follows repeats the edge.
    width = int(CORNER[0]) + 200
    image = hand.window.image.copy()
    image[:, 200:] = image[:, 199:200]
    cut = Window(image, CORNER, 1.0, (width, PICTURE[1]))
    shift = np.array([0.0, 0.0])
    hands = [h for h, _ in made[:-1]] + [
        replace(hand, window=cut, landmarks=hand.landmarks + shift)
    ]
    meshes = [_mesh(h, number) for number, h in enumerate([h for h, _ in made])]
    colors = learn_guided_colors(hands, meshes, np.ones((3, 3)))
    found = find_guided_mask(hands[-1], meshes[-1], colors, np.ones(3))
    assert not found.known[:, 200:].any()
    assert found.known[:, :195].mean() > 0.99


def test_exposure_is_taken_back_before_colours_are_judged() -> None:
    gain = np.array([0.8, 0.9, 1.1])
    made = [made_hand(number) for number in NUMBERS]
    hands = [hand for hand, _ in made]
    hands[-1] = _with_image(hands[-1], hands[-1].window.image * gain)
    meshes = [_mesh(hand, number) for number, hand in enumerate(hands)]
    gains = np.ones((3, 3))
    gains[-1] = gain
    colors = learn_guided_colors(hands, meshes, gains)
    found = find_guided_mask(hands[-1], meshes[-1], colors, gain)
    before = _before(meshes[-1])
    assert _overlap(found.mask.pixels & before, made[-1][1] & before) > 0.97


def test_the_average_exposure_is_that_of_a_gain_of_one() -> None:
    image = np.random.default_rng(0).integers(20, 200, (8, 8, 3), dtype=np.uint8)
    gain = np.array([0.8, 1.0, 1.25])
    exposed = (image * gain).round().astype(np.uint8)
    # Rounded twice, the first time in units of up to 1 / 0.8.
    assert np.abs(at_average_exposure(exposed, gain).astype(float) - image).max() <= 1
    assert (at_average_exposure(image, np.ones(3)) == image).all()


def test_a_wall_that_is_hardly_darker_than_the_skin_does_not_join_the_hand() -> None:
    """By seven per cent, all over the picture: colours lean to the hand, the mesh has a word."""
    shade = (0.7 + 0.3 * np.mgrid[:SIDE, :SIDE][1] / SIDE)[..., None]
    hands, truths = [], []
    for number in NUMBERS:
        hand, truth = made_hand(number)
        noise = np.random.default_rng(number).normal(0, 5, (SIDE, SIDE, 3))
        wall = 0.93 * SKIN * shade + noise
        hands.append(_with_image(hand, np.where(truth[..., None], hand.window.image, wall)))
        truths.append(truth)
    found, mesh = _found(hands)
    before = _before(mesh)
    border = (truths[-1] & ~ndimage.binary_erosion(truths[-1]) & before).sum()
    # Half a pixel along the border; colours alone would have most of a pixel.
    assert (found.mask.pixels & ~truths[-1] & before).sum() < 0.5 * border


def test_the_wrist_is_cut_along_a_straight_line_to_a_fraction_of_a_pixel() -> None:
    line = WristLine(np.array([20.3, 31.7]), np.array([0.28, -0.96]))
    shares = cut_at_wrist(np.ones((64, 64)), line)
    # Where each column passes from hand to forearm: a straight line of the right slope.
    heights = shares.sum(0)
    expected = 31.7 + (np.arange(64) + 0.5 - 20.3) * 0.28 / 0.96
    assert np.abs(heights - expected).max() < 0.06
    assert ((shares > 0) & (shares < 1)).sum() >= 64
    is_open = is_cut_unsure(np.ones((64, 64), dtype=bool), line, 1000.0)
    distance = line.before_pixels(64)
    assert is_open[np.abs(distance) < 2].all() and not is_open[distance > 2.1].any()


def test_the_cut_follows_the_ring_at_the_rig_s_end() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    tilt = np.radians(25)
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    flat = np.stack([30 * np.cos(angle), 5 * np.sin(angle)], axis=-1) @ turn.T
    line = wrist_line(flat, np.array([0.0, -90.0]))
    assert np.allclose(line.direction, turn @ np.array([0.0, -1.0]), atol=1e-6)
    # Seen from the front the ring is round and says nothing: the way to the hand decides.
    ring = np.stack([30 * np.cos(angle), 29 * np.sin(angle)], axis=-1)
    assert np.allclose(wrist_line(ring, np.array([0.0, -90.0])).direction, [0, -1], atol=1e-6)
