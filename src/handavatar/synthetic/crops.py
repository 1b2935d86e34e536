"""Made pictures of one hand, as a tracker cuts them out of a video: what the tracker learns from.

Every subject, pose, view, light, background and camera is drawn anew, far wider than one video has
them, so that a real one lies somewhere between. The truth of every picture is known: joints,
fingertips and points of the skin in three dimensions, and what each pixel shows.
"""

import io
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage
from scipy.spatial.transform import Rotation
from torch import Tensor

from handavatar.capture.synthetic import SynthOptions, make_subject
from handavatar.capture.windows import resized
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.colors import srgb_from_linear
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.landmarks import MIDDLE_KNUCKLE
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    angles_from_rotations,
    clamped_angles,
    gesture_rotations,
    resolve_penetration,
    rotations_from_angles,
    sample_poses,
)
from handavatar.hand.rig import Rig
from handavatar.render.skylight import even_directions, sky_light
from handavatar.synthetic.actor import Actor, Lights, PosedActor
from handavatar.synthetic.backgrounds import BACKGROUNDS, paint_background
from handavatar.tracker.network import FOREARM, HAND, OTHER
from handavatar.tracker.points import TrackedPoints

CROP_SIDE = 128
"""Pixels along a side of a made picture."""
_VIEWS = 5
_NUM_BACKGROUNDS, _BACKGROUND_SIDE = 10, 224
_SUBJECTS = 3
_SHADOWED = 3
_PALM_VIEW = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class MadeCrops:
    """Made pictures and their truth.

    Attributes:
        images: sRGB.
        classes: ``OTHER``, ``HAND`` or ``FOREARM``.
        points: of the right hand: right and down as shares of the side, then depth behind the
            wrist's joint, in units of the distance from there to the middle finger's knuckle.
        is_hand: whether there is one; without it points say nothing.
    """

    images: UInt8[np.ndarray, "crops side side 3"]
    classes: UInt8[np.ndarray, "crops side side"]
    points: Float32[np.ndarray, "crops points 3"]
    is_hand: Bool[np.ndarray, "crops"]


def make_crops(rig: Rig, tracked: TrackedPoints, count: int, seed: int) -> MadeCrops:
    """Draws made pictures; the same seed gives the same ones.

    Args:
        rig: the hand.
        tracked: points whose places are to be told.
        count: of pictures.
        seed: of everything that is drawn.
    """
    studio = _Studio(rig, tracked, seed)
    images = np.zeros((count, CROP_SIDE, CROP_SIDE, 3), np.uint8)
    classes = np.zeros((count, CROP_SIDE, CROP_SIDE), np.uint8)
    points = np.zeros((count, len(tracked), 3), np.float32)
    is_hand = np.zeros(count, bool)
    rotations = _draw_poses(rig, -(-count // _VIEWS), studio.random)
    for number in range(count):
        if number % _VIEWS == 0:
            studio.pose(rotations[number // _VIEWS])
        images[number], classes[number], points[number], is_hand[number] = studio.picture()
    return MadeCrops(images, classes, points, is_hand)


def _draw_poses(
    rig: Rig, count: int, random: np.random.Generator
) -> Float[Tensor, "count bones 3"]:
    """Free poses, named gestures with deviations, and fists, none of which sinks into itself."""
    generator = torch.Generator().manual_seed(int(random.integers(2**31)))
    drawn = sample_poses(rig, count, generator)
    angles = angles_from_rotations(rig, drawn)
    named = torch.stack([gesture_rotations(rig, name) for name in GESTURES])
    named_angles = angles_from_rotations(rig, named)
    chosen = torch.randint(0, len(named), (2, count), generator=generator)
    # Between two gestures, nearer to one of them.
    share = 0.5 * torch.rand(count, 1, 1, generator=generator).square()
    between = torch.lerp(named_angles[chosen[0]], named_angles[chosen[1]], share)
    between = between + torch.deg2rad(torch.tensor(6.0)) * torch.randn(
        between.shape, generator=generator
    ) * (named_angles.std(0) > 1e-3)
    is_named = torch.rand(count, 1, 1, generator=generator) < 0.45
    mixed = clamped_angles(torch.where(is_named, between, angles))
    mixed[:, 0] = 0
    return resolve_penetration(rig, rotations_from_angles(rig, mixed))


class _Studio:
    """Subjects, backgrounds, and the scene at present."""

    def __init__(self, rig: Rig, tracked: TrackedPoints, seed: int) -> None:
        self.random = random = np.random.default_rng([seed, 41])
        self._tracked = tracked
        self._actors = []
        for _ in range(_SUBJECTS):
            own = int(random.integers(2**31))
            options = SynthOptions(
                seed=own,
                tone=float(random.uniform()),
                personal=float(random.uniform(0.2, 1.2)),
                texture=256,
            )
            subject = make_subject(rig, options)
            self._actors.append(Actor(subject, rig, bool(random.random() < 0.45), own))
        self._backgrounds = [
            paint_background(
                BACKGROUNDS[random.integers(len(BACKGROUNDS))],
                _BACKGROUND_SIDE,
                _BACKGROUND_SIDE,
                random,
            )
            for _ in range(_NUM_BACKGROUNDS)
        ]
        self._aside: tuple[np.ndarray, np.ndarray] | None = None

    def pose(self, rotations: Float[Tensor, "bones 3"]) -> None:
        """Takes a subject in a new pose under a new light; its wrist is not turned."""
        random = self.random
        self._actor = self._actors[random.integers(len(self._actors))]
        rotations = rotations.clone()
        rotations[0] = 0
        pose = HandPose(rotations, torch.zeros(3))
        # Fingers lie along -x, so the arm comes from about +x; wrists bend by some 40 degrees.
        elbow = torch.from_numpy(np.array([1.0, 0, 0]) + 0.55 * random.standard_normal(3)).float()
        self._posed = self._actor.posed(pose, elbow)
        self._points = self._tracked.positions(self._actor.subject.rest_hand, pose)
        self._lights = _draw_scattered_lights(random)
        brought = sky_light(
            self._posed.vertices,
            self._actor.caster_faces,
            self._posed.vertices,
            self._posed.normals,
            self._lights.directions[:_SHADOWED],
        )
        soft = self._lights.directions[_SHADOWED:]
        # From everywhere else without shadows: what turns away still sees half of it.
        ambient = (0.5 + 0.5 * self._posed.normals @ soft.T) ** 1.5
        self._light = torch.cat([brought, ambient], 1) @ self._lights.colors

    def picture(
        self,
    ) -> tuple[
        UInt8[np.ndarray, "side side 3"],
        UInt8[np.ndarray, "side side"],
        Float32[np.ndarray, "points 3"],
        bool,
    ]:
        """The scene from a new place, by a new camera, before a new background."""
        random, actor = self.random, self._actor
        view = _draw_view(random)
        middle = self._points.mean(0)
        depth = float(np.exp(random.uniform(math.log(0.2), math.log(0.9))))
        shift = torch.tensor([0.0, 0.0, depth])
        vertices = (self._posed.vertices - middle) @ view.T + shift
        posed = PosedActor(vertices, self._posed.normals @ view.T)
        lights = replace(self._lights, directions=self._lights.directions @ view.T)
        points = (self._points - middle) @ view.T + shift
        camera = _draw_crop(points, random)
        pixels, _ = project(camera, points)
        size = (points[MIDDLE_KNUCKLE] - points[0]).norm()
        truth = torch.cat(
            [pixels / CROP_SIDE, ((points[:, 2] - points[0, 2]) / size)[:, None]], dim=1
        )
        scene = self._behind()
        classes = np.full((CROP_SIDE, CROP_SIDE), OTHER, np.uint8)
        self._add_second_hand(scene)
        is_hand = bool(random.random() > 0.04)
        if is_hand:
            fragments = actor.fragments(posed, camera)
            covered = fragments.mask.numpy()
            tint = 1 + 0.08 * random.standard_normal(3)
            colors = actor.colors(fragments, posed, self._light, lights).numpy() * tint
            scene[covered] = colors
            on_hand = actor.is_hand(fragments).numpy()
            classes[on_hand] = HAND
            classes[covered & ~on_hand] = FOREARM
            self._aside = (scene * covered[..., None], covered)
        self._add_occluders(scene, classes)
        return _take_picture(scene, random), classes, truth.numpy().astype(np.float32), is_hand

    def _behind(self) -> Float[np.ndarray, "side side 3"]:
        random = self.random
        if random.random() < 0.45:
            whole = self._backgrounds[random.integers(len(self._backgrounds))]
            side = int(random.integers(48, _BACKGROUND_SIDE))
            top, left = random.integers(0, _BACKGROUND_SIDE - side + 1, 2)
            part = whole[top : top + side, left : left + side]
            part = np.rot90(part, int(random.integers(4)))
            scene = _resized(part, CROP_SIDE) * random.uniform(0.4, 1.4)
        else:
            scene = _draw_clutter(random)
        return scene.astype(np.float64)

    def _add_second_hand(self, scene: Float[np.ndarray, "side side 3"]) -> None:
        """Sometimes a hand of before lies behind, at another place."""
        random = self.random
        if self._aside is None or random.random() > 0.08:
            return
        colors, covered = self._aside
        by = tuple(random.integers(-90, 90, 2))
        turned = int(random.integers(4))
        colors, covered = np.rot90(colors, turned), np.rot90(covered, turned)
        moved = np.zeros_like(covered)
        source = np.zeros_like(scene)
        rows, columns = (slice(max(0, step), CROP_SIDE + min(0, step)) for step in by)
        old_rows, old_columns = (slice(max(0, -step), CROP_SIDE - max(0, step)) for step in by)
        moved[rows, columns] = covered[old_rows, old_columns]
        source[rows, columns] = colors[old_rows, old_columns]
        scene[moved] = source[moved]

    def _add_occluders(
        self,
        scene: Float[np.ndarray, "side side 3"],
        classes: UInt8[np.ndarray, "side side"],
    ) -> None:
        """Sometimes a thing is held before the hand, or the picture ends."""
        random = self.random
        if random.random() < 0.1:
            shape = _draw_shape(random)
            color = random.uniform(0, 0.8, 3) * random.uniform(0.3, 1)
            scene[shape] = color
            classes[shape] = OTHER
        if random.random() < 0.08:
            gone = int(random.integers(4, 40))
            rows = np.s_[:gone] if random.random() < 0.5 else np.s_[-gone:]
            turned = random.random() < 0.5
            for picture, fill in ((scene, random.choice([0.0, 0.2])), (classes, OTHER)):
                (picture.swapaxes(0, 1) if turned else picture)[rows] = fill


def _draw_view(random: np.random.Generator) -> Float[Tensor, "3 3"]:
    """How the camera's axes see the hand's: any way round, mostly with the fingers across."""
    if random.random() < 0.2:
        quaternion = Rotation.from_quat(random.standard_normal(4), scalar_first=True)
        return torch.from_numpy(quaternion.as_matrix()).float()
    axes = torch.eye(3)
    roll = random.uniform(-math.pi, math.pi) if random.random() < 0.4 else random.normal(0, 0.6)
    pitch = random.normal(0, 0.55)
    if random.random() < 0.35:
        yaw = random.uniform(-math.pi, math.pi)
    else:
        yaw = (math.pi if random.random() < 0.5 else 0) + random.normal(0, 0.6)
    about = [
        matrix_from_axis_angle(angle * axis)
        for angle, axis in ((roll, axes[2]), (pitch, axes[0]), (yaw, axes[0]))
    ]
    return about[0] @ about[1] @ _PALM_VIEW @ about[2]


def _draw_crop(points: Float[Tensor, "points 3"], random: np.random.Generator) -> Camera:
    """A square about the hand, as wide as a tracker would cut it, more or less."""
    places = points[:, :2] / points[:, 2:].clamp_min(0.05)
    low, high = places.amin(0), places.amax(0)
    side = float((high - low).max()) * random.uniform(1.12, 1.9)
    center = (low + high) / 2 + torch.from_numpy(random.normal(0, 0.06, 2)).float() * side
    focal = CROP_SIDE / side
    shift = (CROP_SIDE / 2 - focal * center).tolist()
    return Camera((focal, focal), (shift[0], shift[1]), CROP_SIDE, CROP_SIDE, torch.eye(4))


def _draw_scattered_lights(random: np.random.Generator) -> Lights:
    """A lamp and two weaker ones that cast shadows, and five that do not."""
    key = torch.from_numpy(random.standard_normal((_SHADOWED, 3))).float()
    key = torch.nn.functional.normalize(key, dim=-1)
    share = random.uniform(0.15, 0.85)
    strengths = np.array([1.0, random.uniform(0, 0.6), random.uniform(0, 0.4)])
    strengths *= (1 - share) * 1.1 / strengths.sum()
    soft = random.uniform(0.2, 1, 5)
    soft *= share * 1.6 / soft.sum()
    colors = np.concatenate([strengths, soft])[:, None] * (1 + 0.1 * random.standard_normal((8, 3)))
    return Lights(torch.cat([key, even_directions(5)]), torch.from_numpy(colors.clip(0)).float(), 0)


def _draw_clutter(random: np.random.Generator) -> Float[np.ndarray, "side side 3"]:
    """Noise of some sizes, edges, and things in any colour, linear light."""
    picture = np.ones((CROP_SIDE, CROP_SIDE, 3)) * random.uniform(0.05, 0.9, 3)
    if random.random() < 0.25:
        # As skin, wood, sand: what a hand is mistaken for.
        picture[:] = np.array([0.78, 0.58, 0.47]) * random.uniform(0.4, 1.15)
    for _ in range(random.integers(1, 4)):
        cells = int(random.integers(2, 32))
        channels = 3 if random.random() < 0.4 else 1
        noise = random.standard_normal((cells, cells, channels))
        picture = picture + _resized(noise, CROP_SIDE) * random.uniform(0.01, 0.16)
    if random.random() < 0.3:
        y, x = np.mgrid[0:CROP_SIDE, 0:CROP_SIDE]
        angle, length = random.uniform(0, math.pi), random.uniform(3, 40)
        wave = np.sin(2 * math.pi * (x * math.cos(angle) + y * math.sin(angle)) / length)
        picture = picture + random.uniform(0.02, 0.2) * wave[..., None] * random.uniform(0.3, 1, 3)
    for _ in range(random.integers(0, 7)):
        shape = _draw_shape(random)
        share = random.uniform(0.4, 1)
        picture[shape] = (1 - share) * picture[shape] + share * random.uniform(0, 1, 3)
    if random.random() < 0.5:
        picture = ndimage.gaussian_filter(picture, (random.uniform(0.3, 3),) * 2 + (0,))
    return picture.clip(0.01, 1) ** 2.2


def _draw_shape(random: np.random.Generator) -> Bool[np.ndarray, "side side"]:
    """The pixels of a polygon, an ellipse or a stroke."""
    canvas = Image.new("L", (CROP_SIDE, CROP_SIDE), 0)
    draw = ImageDraw.Draw(canvas)
    middle = random.uniform(0, CROP_SIDE, 2)
    reach = random.uniform(6, 60, 2)
    kind = random.integers(3)
    if kind == 0:
        angles = np.sort(random.uniform(0, 2 * math.pi, int(random.integers(3, 7))))
        corners = middle + reach * np.stack([np.cos(angles), np.sin(angles)], -1)
        draw.polygon([(float(x), float(y)) for x, y in corners], fill=255)
    elif kind == 1:
        draw.ellipse([*(middle - reach / 2), *(middle + reach / 2)], fill=255)
    else:
        ends = random.uniform(-20, CROP_SIDE + 20, (3, 2))
        draw.line(
            [(float(x), float(y)) for x, y in ends], fill=255, width=int(random.integers(1, 14))
        )
    return np.asarray(canvas) > 0


def _take_picture(
    scene: Float[np.ndarray, "side side 3"], random: np.random.Generator
) -> UInt8[np.ndarray, "side side 3"]:
    """What a phone makes of the light: blur, exposure, white balance, noise, compression."""
    linear = scene * random.uniform(0.55, 1.5) * (1 + 0.07 * random.standard_normal(3))
    stored = srgb_from_linear(torch.from_numpy(linear.clip(0, 1)).float()).numpy()
    chance = random.random()
    if chance < 0.3:
        stored = ndimage.gaussian_filter(stored, (random.uniform(0.3, 1.3),) * 2 + (0,))
    elif chance < 0.5:
        stored = _moved(stored, random.uniform(1.5, 9), random.uniform(0, math.pi))
    if random.random() < 0.25:
        small = int(random.integers(48, CROP_SIDE))
        stored = _resized(_resized(stored, small), CROP_SIDE)
    if random.random() < 0.2:
        grey = stored.mean(-1, keepdims=True)
        stored = grey + (stored - grey) * random.uniform(0, 1.4)
    stored = stored + random.standard_normal(stored.shape) * random.uniform(0, 0.035)
    levels = (255 * stored).round().clip(0, 255).astype(np.uint8)
    if random.random() < 0.5:
        stream = io.BytesIO()
        Image.fromarray(levels).save(stream, "JPEG", quality=int(random.integers(25, 92)))
        levels = np.asarray(Image.open(stream, formats=["JPEG"]))
    return levels


def _moved(
    picture: Float[np.ndarray, "side side 3"], length: float, angle: float
) -> Float[np.ndarray, "side side 3"]:
    """Blurred along a line, pixels long."""
    reach = int(length / 2) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    kernel = np.clip(length / 2 + 0.5 - abs(along), 0, 1) * np.clip(1 - abs(across), 0, 1)
    planes = torch.from_numpy(picture).float().permute(2, 0, 1)[:, None]
    weights = torch.from_numpy(kernel / kernel.sum()).float()[None, None]
    padded = torch.nn.functional.pad(planes, (reach,) * 4, mode="replicate")
    return torch.nn.functional.conv2d(padded, weights)[:, 0].permute(1, 2, 0).numpy()


def _resized(
    picture: Float[np.ndarray, "rows columns channels"], side: int
) -> Float[np.ndarray, "side side channels"]:
    return resized(torch.from_numpy(np.ascontiguousarray(picture)).float(), side).numpy()
