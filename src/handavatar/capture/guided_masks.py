"""The second pass of the masks: the fitted hand says where skin can be, and what is not known.

Colours are learned again, on the skin inside the fitted mesh and on what lies well outside of it,
so that a face or a sleeve behind the hand counts as what it is. Nothing far from the mesh is hand.
What the picture leaves open - a border without contrast, an object in front of the hand - is
unknown, and so is what the camera did not see.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.masks import (
    BACKGROUND,
    HAND,
    LIKELY_BACKGROUND,
    LIKELY_HAND,
    SURE,
    ColorModel,
    HandMask,
    cleaned_mask,
    color_model,
    depth_inside,
    forearm_cone,
    graph_cut,
    grown,
    inside_picture,
    oklab_from_srgb,
    settled,
    sure_and_spread,
    without_rim,
)
from handavatar.capture.outlines import silhouette
from handavatar.capture.tracking import TrackedHand
from handavatar.geometry.cameras import Camera, pixel_centers, project
from handavatar.hand.rig import Rig

# Metres. Farther from the mesh nothing is hand; so deep inside colours are learned as skin.
_LIMIT = 0.008
_LEARNED_DEPTH = 0.003
# So far from the mesh skin that goes on beyond the limit may still be the hand.
_DOUBTED = 0.020
# The mesh's own word, as a logarithm of a ratio of likelihoods, and where it is halfway sure.
_MESH_WORD, _MESH_ERROR = 4.0, 0.004
# Of a border that the picture does not decide: half-width of the band that is unknown.
_UNSURE_PIXELS, _UNSURE_WIDTH, _UNSURE_REACH = 2.0, 0.0015, 0.006
_CLEAR = 0.5
_SHORTEST_UNSURE = 8
# Of what covers the hand: squared metres, and metres inside the mesh.
_SMALLEST_COVER, _COVER_DEPTH, _SURE_COVER_DEPTH = 1e-4, 0.004, 0.008
_EXPLAINED_SHARE = 0.02
# OKLab; about a tenth of the way from grey to a pure colour.
_SAME_HUE = 0.03
# Behind and beside the cut at the wrist, metres.
_WRIST_BAND = 0.002
# Of gradients, 8-bit steps per pixel; of the distance of two outlines, metres.
_GRADIENT_NOISE, _AGREEMENT = 2.0, 0.004
_PIXELS_PER_FRAME, _NUM_FRAMES = 1500, 30


@dataclass(frozen=True, eq=False)
class WristLine:
    """The straight line across the wrist where the rig ends, in pixels of some picture.

    Attributes:
        point: on it.
        direction: unit, across it, towards the hand.
    """

    point: Float[np.ndarray, "2"]
    direction: Float[np.ndarray, "2"]

    def before(self, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """How far places lie on the hand's side, pixels; negative on the forearm's."""
        return (places - self.point) @ self.direction

    def before_pixels(self, side: int) -> Float[np.ndarray, "side side"]:
        """The same of all pixels' centres."""
        y, x = np.mgrid[:side, :side] + 0.5
        return self.before(np.stack([x, y], axis=-1))


def wrist_line(rim: Float[np.ndarray, "rim 2"], hand: Float[np.ndarray, "2"]) -> WristLine:
    """Along the ring at the rig's end as the picture shows it; where that is round, across the way.

    Args:
        rim: where the mesh ends, pixels.
        hand: the hand's centre, pixels.
    """
    center = rim.mean(0)
    towards = (hand - center) / max(float(np.linalg.norm(hand - center)), 1e-9)
    spreads, axes = np.linalg.eigh(np.cov((rim - center).T))
    across = axes[:, 0] if axes[:, 0] @ towards > 0 else -axes[:, 0]
    roundness = float(np.sqrt(max(spreads[0], 0) / max(spreads[1], 1e-12)))
    trust = np.clip((0.85 - roundness) / 0.35, 0, 1) * float(across @ towards > 0.6)
    direction = trust * across + (1 - trust) * towards
    return WristLine(center, direction / np.linalg.norm(direction))


def wrist_in(camera: Camera, rig: Rig, vertices: Float[Tensor, "vertices 3"]) -> WristLine:
    """Where the fitted hand ends, in a view of it.

    Args:
        camera: the view, in its own axes.
        rig: whose vertices they are.
        vertices: metres, camera axes.
    """
    places = project(camera, vertices)[0].double().numpy()
    return wrist_line(places[rig.rim.numpy()], places.mean(0))


def pixels_before_wrist(
    camera: Camera, rig: Rig, vertices: Float[Tensor, "vertices 3"], margin: float
) -> Bool[np.ndarray, "height width"]:
    """Pixels in front of the wrist: what lies behind it is the forearm's.

    Args:
        camera: the view, in its own axes.
        rig: whose vertices they are.
        vertices: metres, camera axes.
        margin: metres before the rig's end from where on they count.
    """
    before = wrist_in(camera, rig, vertices).before(pixel_centers(camera).double().numpy())
    return before > margin * pixels_per_metre_at(camera, vertices)


def pixels_per_metre_at(camera: Camera, vertices: Float[Tensor, "vertices 3"]) -> float:
    """Scale of a view at a fitted hand.

    Args:
        camera: the view, in its own axes.
        vertices: metres, camera axes.
    """
    return camera.focal[0] / max(float(vertices[:, 2].median()), 0.02)


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """The fitted hand in one window.

    Attributes:
        covered: pixels of the window that it covers, its wrist closed.
        wrist: where it ends, in the window.
        scale: window pixels per metre at the hand.
    """

    covered: Bool[np.ndarray, "side side"]
    wrist: WristLine
    scale: float


def placed_mesh(
    rig: Rig, vertices: Float[Tensor, "vertices 3"], focal: float, hand: TrackedHand
) -> PlacedMesh:
    """The hand as its window shows it.

    Args:
        rig: whose vertices they are.
        vertices: metres, camera axes.
        focal: of the whole picture, pixels.
        hand: whose window is meant.
    """
    camera = hand.window.camera(focal)
    return PlacedMesh(
        silhouette(rig, vertices, camera),
        wrist_in(camera, rig, vertices),
        pixels_per_metre_at(camera, vertices),
    )


@dataclass(frozen=True, eq=False)
class GuidedMask:
    """The hand and forearm in a window, and what of it is not known.

    Attributes:
        mask: as of the first pass; its quality is that of border and mesh, not of colours.
        known: false outside the camera's picture, and where hand or background is left open.
        edge_quality: how far the picture changes across the mask's border and not along it, in
            [0, 1]; borders through a face or through clothes like skin have little.
        agreement: of the mask's border with the mesh's outline, in [0, 1].
        covered_share: of the mesh, hidden by something in front of the hand.
    """

    mask: HandMask
    known: Bool[np.ndarray, "side side"]
    edge_quality: float
    agreement: float
    covered_share: float


@dataclass(frozen=True, eq=False)
class GuidedColors:
    """Skin against everything else, of one clip at its average exposure.

    Attributes:
        model: the two densities.
        rarest: logarithm of the background's density that almost all of the background exceeds.
    """

    model: ColorModel
    rarest: float


def learn_guided_colors(
    hands: Sequence[TrackedHand],
    meshes: Sequence[PlacedMesh],
    gains: Float[np.ndarray, "hands 3"],
    seed: int = 0,
) -> GuidedColors:
    """From the surest frames of a video, spread over its length.

    Raises:
        CaptureError: the hand fills the picture.
    """
    generator = np.random.default_rng(seed)
    numbers = {id(hand): number for number, hand in enumerate(hands)}
    chosen = [numbers[id(hand)] for hand in sure_and_spread(hands, _NUM_FRAMES)]
    inside: list[np.ndarray] = []
    outside: list[np.ndarray] = []
    for number in chosen:
        hand, mesh = hands[number], meshes[number]
        image = at_average_exposure(hand.window.image, gains[number])
        side = image.shape[0]
        seen = inside_picture(hand.window)
        before = mesh.wrist.before_pixels(side) > 0
        skin = (depth_inside(mesh.covered) > _LEARNED_DEPTH * mesh.scale) & before & seen
        forearm = _forearm(hand, mesh, before)
        other = (depth_inside(~mesh.covered) > _LIMIT * mesh.scale) & seen
        other &= ~grown(forearm, 0.01 * mesh.scale)
        for colors, region in ((inside, skin), (outside, other)):
            pixels = image[region]
            if len(pixels):
                count = min(len(pixels), _PIXELS_PER_FRAME)
                colors.append(generator.choice(pixels, count, axis=0))
    if not inside or not outside:
        raise CaptureError("the hand fills the picture", "record it with room on every side")
    others = np.concatenate(outside)
    model = color_model(
        _of_one_hue(np.concatenate(inside)), others, generator, is_skin_elsewhere=False
    )
    densities = model.background.log_density(oklab_from_srgb(others))
    return GuidedColors(model, float(np.quantile(densities, _EXPLAINED_SHARE)))


def _of_one_hue(colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "m 3"]:
    """Skin is bright or dark, but of one hue: what differs lies before the hand, or beside it."""
    hues = oklab_from_srgb(colors)[:, 1:]
    apart = np.linalg.norm(hues - np.median(hues, axis=0), axis=-1)
    return colors[apart < max(_SAME_HUE, 4 * float(np.median(apart)))]


def at_average_exposure(
    image: UInt8[np.ndarray, "height width 3"], gain: Float[np.ndarray, "3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture as the clip's average exposure and white balance would give it."""
    return (image / gain).round().clip(0, 255).astype(np.uint8)


def _forearm(
    hand: TrackedHand, mesh: PlacedMesh, before: Bool[np.ndarray, "side side"]
) -> Bool[np.ndarray, "side side"]:
    side = before.shape[0]
    return forearm_cone(hand.window.from_picture(hand.landmarks), side) & ~before


def find_guided_mask(
    hand: TrackedHand,
    mesh: PlacedMesh,
    colors: GuidedColors,
    gain: Float[np.ndarray, "3"],
) -> GuidedMask:
    """The hand and forearm in one frame's window, near the fitted mesh alone.

    Args:
        hand: its window and landmarks.
        mesh: as fitted.
        colors: of the clip.
        gain: of the frame.

    Raises:
        CaptureError: OpenCV is not installed.
    """
    image = hand.window.image
    scale, side = mesh.scale, image.shape[0]
    before = mesh.wrist.before_pixels(side) > 0
    depth, away = depth_inside(mesh.covered), depth_inside(~mesh.covered)
    forearm = _forearm(hand, mesh, before)
    allowed = ((away <= _LIMIT * scale) & before) | forearm
    average = at_average_exposure(image, gain)
    ratio = ndimage.gaussian_filter(colors.model.log_ratio(average), 1.0)
    word = _MESH_WORD * np.tanh((depth - away) / (_MESH_ERROR * scale))
    belief = ratio + np.where(before, word, 0.0)
    labels = np.full(ratio.shape, BACKGROUND, dtype=np.uint8)
    labels[allowed] = LIKELY_BACKGROUND
    labels[(belief > 0) & allowed] = LIKELY_HAND
    labels[belief < -SURE] = BACKGROUND
    labels[(belief > SURE) & allowed] = HAND
    core = (depth > _COVER_DEPTH * scale) & before & (ratio > 0)
    labels[core] = HAND
    is_sure = labels == BACKGROUND
    cut = cleaned_mask(graph_cut(image, labels), core, scale) & ~is_sure
    level, clearness = settled(image, cut, without_rim(is_sure))
    pixels = cleaned_mask((level > 0.5) & allowed, core, scale) & allowed
    level = np.where(pixels == (level > 0.5), level, pixels)

    cover = _cover(average, pixels, depth, before, ratio, colors, scale)
    seen = inside_picture(hand.window)
    unknown = cover | ~seen
    unknown |= _unsure_border(pixels, mesh.covered, clearness, before, scale)
    unknown |= _beyond_limit(pixels, away, ratio, before, scale)
    edges, agreement = _border_quality(image, pixels, mesh, before & seen & ~cover)
    quality = float(np.sqrt(edges * agreement))
    covered_share = float((cover & mesh.covered).sum() / max(1, int(mesh.covered.sum())))
    return GuidedMask(HandMask(pixels, level, quality), ~unknown, edges, agreement, covered_share)


def guided_by_given(hand: TrackedHand, mesh: PlacedMesh, mask: HandMask) -> GuidedMask:
    """A mask that the user gives: it is believed, wherever the camera saw.

    Args:
        hand: its window.
        mesh: as fitted.
        mask: of the window.
    """
    seen = inside_picture(hand.window)
    before = mesh.wrist.before_pixels(len(seen)) > 0
    _, agreement = _border_quality(hand.window.image, mask.pixels, mesh, before & seen)
    return GuidedMask(mask, seen, 1.0, agreement, 0.0)


def _cover(
    image: UInt8[np.ndarray, "side side 3"],
    pixels: Bool[np.ndarray, "side side"],
    depth: Float[np.ndarray, "side side"],
    before: Bool[np.ndarray, "side side"],
    ratio: Float[np.ndarray, "side side"],
    colors: GuidedColors,
    scale: float,
) -> Bool[np.ndarray, "side side"]:
    """What hides the hand: well inside the mesh, clearly not skin, larger than a fingertip.

    A finger that is fitted beside itself looks like that as well, but what is seen through it is
    the background that is known from elsewhere, and it is thin.
    """
    strange = ~pixels & (depth > 0) & before & (ratio < -2)
    pieces, count = ndimage.label(strange)
    cover = np.zeros_like(strange)
    for piece in range(1, count + 1):
        mine = pieces == piece
        deep = mine & (depth > _COVER_DEPTH * scale)
        if deep.sum() < _SMALLEST_COVER * scale**2:
            continue
        density = colors.model.background.log_density(oklab_from_srgb(image[deep]))
        is_strange = float(np.median(density)) < colors.rarest
        if is_strange or float(depth[mine].max()) > _SURE_COVER_DEPTH * scale:
            cover |= mine
    return cover


def _border(pixels: Bool[np.ndarray, "side side"]) -> Bool[np.ndarray, "side side"]:
    return pixels & ~ndimage.binary_erosion(pixels, border_value=1)


def _unsure_border(
    pixels: Bool[np.ndarray, "side side"],
    covered: Bool[np.ndarray, "side side"],
    clearness: Float[np.ndarray, "side side"],
    before: Bool[np.ndarray, "side side"],
    scale: float,
) -> Bool[np.ndarray, "side side"]:
    """A band about the border where skin and what is beside it look alike."""
    weak = _border(pixels) & (clearness < _CLEAR) & before
    pieces, count = ndimage.label(grown(weak, 2.0))
    lengths = np.bincount(pieces[weak], minlength=count + 1)
    weak &= lengths[pieces] >= _SHORTEST_UNSURE
    band = grown(weak, max(_UNSURE_PIXELS, _UNSURE_WIDTH * scale))
    # Between the two outlines each may be right.
    band |= grown(weak, _UNSURE_REACH * scale) & (pixels ^ covered)
    return band & before


def _beyond_limit(
    pixels: Bool[np.ndarray, "side side"],
    away: Float[np.ndarray, "side side"],
    ratio: Float[np.ndarray, "side side"],
    before: Bool[np.ndarray, "side side"],
    scale: float,
) -> Bool[np.ndarray, "side side"]:
    """Skin that goes on where the mesh is too far: a finger fitted badly, or somebody's face."""
    beyond = (away > _LIMIT * scale) & (away < _DOUBTED * scale) & before & (ratio > 1)
    pieces, _ = ndimage.label(beyond)
    touching = np.unique(pieces[grown(pixels & before, 2.0) & beyond])
    beyond &= np.isin(pieces, touching[touching > 0])
    contact = pixels & grown(beyond, 2.0)
    return beyond | (grown(contact, _UNSURE_REACH * scale) & (away > 0) & before)


def _border_quality(
    image: UInt8[np.ndarray, "side side 3"],
    pixels: Bool[np.ndarray, "side side"],
    mesh: PlacedMesh,
    where: Bool[np.ndarray, "side side"],
) -> tuple[float, float]:
    """Change across the border against change along it, and nearness to the mesh's outline."""
    border = _border(pixels) & where
    rows, columns = np.nonzero(border)
    if len(rows) == 0:
        return 0.0, 0.0
    smooth = ndimage.gaussian_filter(image.astype(np.float32), (1.0, 1.0, 0.0))
    down, right = np.gradient(smooth, axis=(0, 1))
    mask_down, mask_right = np.gradient(ndimage.gaussian_filter(pixels.astype(np.float32), 2.0))
    length = np.hypot(mask_down, mask_right) + 1e-9
    normal_down, normal_right = (mask_down / length)[..., None], (mask_right / length)[..., None]
    across = ((down * normal_down + right * normal_right) ** 2).sum(-1)
    along = ((right * normal_down - down * normal_right) ** 2).sum(-1)
    strength = across / (across + along + _GRADIENT_NOISE**2)
    # The border may lie a pixel beside the steepest place.
    strength = ndimage.maximum_filter(np.where(length > 1e-3, strength, 0.0), 3)
    outline = _border(mesh.covered)
    distance = depth_inside(~outline)[rows, columns] / mesh.scale
    near = np.exp(-((distance / _AGREEMENT) ** 2))
    return float(strength[rows, columns].mean()), float(near.mean())


def cut_at_wrist(
    shares: Float[np.ndarray, "side side"], line: WristLine
) -> Float[np.ndarray, "side side"]:
    """A mask without the forearm: cut along a straight line, pixels on it in part.

    Args:
        shares: how much of each pixel is hand or forearm, in [0, 1].
        line: in the same picture.
    """
    return np.minimum(shares, (line.before_pixels(len(shares)) + 0.5).clip(0, 1))


def is_cut_unsure(
    mesh: Bool[np.ndarray, "side side"], line: WristLine, scale: float
) -> Bool[np.ndarray, "side side"]:
    """Pixels at the cut and behind it: skin goes on there, and the hand's own end is no line.

    Args:
        mesh: pixels that the fitted hand covers, its wrist closed.
        line: where the mask is cut.
        scale: pixels per metre.
    """
    return grown(mesh, _LIMIT * scale) & (
        line.before_pixels(len(mesh)) < max(1.0, _WRIST_BAND * scale)
    )
