"""A made film of a moving hand whose truth is known, and a detector that knows it.

The hand and a forearm of the same skin are rasterised before a wall, coarsely and in little time.
The film lasts for more than the detector's mistakes: every one of them has its own picture.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from handavatar.capture.fitted_hand import HandFit, HandModel, projected
from handavatar.capture.tracking import Sighting
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose_sampling import gesture_rotations, interpolate_rotations
from handavatar.hand.rig import Rig
from handavatar.jobs.video_writer import VideoWriter
from handavatar.render.rasterize import interpolate, rasterize

WIDTH, HEIGHT, FOCAL = 128, 144, 170.0
FPS = 20.0
NUM_PICTURES = 22
FINER = 2
"""Pictures are drawn so many times as large, and averaged."""
SKIN = (0.60, 0.34, 0.23)
WALLS = ((0.10, 0.14, 0.18), (0.15, 0.19, 0.24))
"""Linear light."""
DRIFT = 0.10
"""By which the logarithm of the exposure drifts, either way; red against blue by a third of it."""
ARM = 0.16
"""Metres of forearm."""
LEAVES = 0.115
"""Metres by which it moves aside at the end."""


@dataclass(frozen=True, eq=False)
class MovingHand:
    """A made film of a right hand.

    Attributes:
        rig: of the hand.
        fit: poses of all pictures, focal length; camera axes.
        pictures: as they are before the film is compressed, sRGB.
        masks: how much of each pixel shows the hand, without the forearm, in [0, 1].
        arms: how much of each shows the forearm.
        gains: of linear light, in each picture; 1 in the mean.
    """

    rig: Rig
    fit: HandFit
    pictures: UInt8[np.ndarray, "pictures height width 3"]
    masks: Float[np.ndarray, "pictures height width"]
    arms: Float[np.ndarray, "pictures height width"]
    gains: Float[np.ndarray, "pictures 3"]

    def vertices(self) -> Float[Tensor, "pictures vertices 3"]:
        """Of the hand, metres, camera axes."""
        return HandModel(self.rig).all_vertices(self.fit)

    def landmarks(self) -> tuple[Float[np.ndarray, "pictures 21 2"], Float[Tensor, "_ 21 3"]]:
        """In pixels, and in metres about their mean."""
        points = HandModel(self.rig).landmarks(self.fit)
        center = (WIDTH / 2, HEIGHT / 2)
        places = projected(points, self.fit.log_focal.exp(), center).double().numpy()
        return places, points - points.mean(1, keepdim=True)

    def save(self, path: Path, is_mirrored: bool = False) -> Path:
        """Writes the film, as a mirror shows it or not."""
        with VideoWriter(path, FPS, HEIGHT, WIDTH, crf=8) as writer:
            for picture in self.pictures:
                writer.add(picture[:, ::-1] if is_mirrored else picture)
        return path


def make_moving_hand() -> MovingHand:
    """Fingers that close and open before a wall; palm to the camera, fingers up."""
    rig = load_open_hand("778")
    share = torch.linspace(0, 1, NUM_PICTURES)
    keys = torch.stack([gesture_rotations(rig, name) for name in ("spread", "relaxed", "spread")])
    rotations = interpolate_rotations(keys, 2 * share)
    upright = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for number, at in enumerate(share.tolist()):
        turn = torch.tensor([0.15 * math.sin(3 * at), 0.3 * at - 0.15, 0.2 - 0.25 * at])
        rotations[number, 0] = axis_angle_from_matrix(matrix_from_axis_angle(turn) @ upright)
    # At last it leaves the picture to the right, by about a third.
    gone = LEAVES * ((share - 0.7) / 0.3).clamp_min(0)
    translation = torch.stack(
        [0.010 * (6 * share).sin() - 0.005 + gone, 0.054 + 0.006 * share, 0.35 + 0.015 * share],
        dim=-1,
    )
    fit = HandFit(
        rotations,
        translation,
        torch.zeros(rig.shape_directions.shape[-1]),
        torch.tensor(FOCAL).log(),
        torch.zeros(21, 3),
    )
    logs = DRIFT * np.sin(5 * share.numpy()[:, None] + 0.5) * np.ones(3)
    logs += DRIFT / 3 * np.sin(4 * share.numpy()[:, None]) * np.array([1.0, 0.0, -1.0])
    gains = np.exp(logs - logs.mean(0))
    drawn = [
        _drawn(rig, vertices, matrix_from_axis_angle(wrist), gain)
        for vertices, wrist, gain in zip(
            HandModel(rig).all_vertices(fit), rotations[:, 0], gains, strict=True
        )
    ]
    pictures, masks, arms = (np.stack(parts) for parts in zip(*drawn, strict=True))
    return MovingHand(rig, fit, pictures, masks, arms, gains)


def _drawn(
    rig: Rig,
    vertices: Float[Tensor, "vertices 3"],
    wrist: Float[Tensor, "3 3"],
    gain: Float[np.ndarray, "3"],
) -> tuple[
    UInt8[np.ndarray, "height width 3"],
    Float[np.ndarray, "height width"],
    Float[np.ndarray, "height width"],
]:
    """A picture, and how much of each pixel is hand and how much forearm."""
    camera = Camera(
        (FINER * FOCAL,) * 2,
        (FINER * WIDTH / 2, FINER * HEIGHT / 2),
        FINER * WIDTH,
        FINER * HEIGHT,
        torch.eye(4),
    )
    # The forearm goes on from the mesh's end, along the axis of the rest pose's fingers.
    rim = vertices[rig.rim]
    far = rim + ARM * wrist[:, 0]
    count, first = len(rim), len(vertices)
    near, end = rig.rim, torch.arange(first, first + count)
    quads = torch.stack([near, near.roll(-1), end, end.roll(-1)])
    sides = torch.cat([quads[[0, 1, 2]].T, quads[[1, 3, 2]].T])
    faces = torch.cat([rig.faces, sides])
    whole = torch.cat([vertices, far])
    normals = vertex_normals(whole, faces)
    fragments = rasterize(whole, faces, camera)
    normal = interpolate(fragments, faces, normals).numpy()
    # Blotches of 2 cm: places differ, as they do on skin.
    rest = torch.cat([rig.template_vertices, rig.template_vertices[rig.rim]])
    blotches = interpolate(fragments, faces, torch.sin(rest * (2 * math.pi / 0.02))).numpy()
    light = 0.6 + 0.4 * np.abs(normal @ np.array([0.2, -0.4, -0.9]))
    skin = np.array(SKIN) * (light * (1 + 0.12 * blotches.mean(-1)))[..., None]
    covered = fragments.mask.numpy()
    y, x = np.mgrid[: FINER * HEIGHT, : FINER * WIDTH] // (FINER * 16)
    wall = np.array(WALLS)[(x + y) % 2]
    linear = np.where(covered[..., None], skin, wall)
    is_hand = covered & (fragments.face_index.numpy() < len(rig.faces))
    layers = np.concatenate([linear, is_hand[..., None], (covered & ~is_hand)[..., None]], axis=-1)
    small = layers.reshape(HEIGHT, FINER, WIDTH, FINER, 5).mean((1, 3))
    light = (small[..., :3] * gain).clip(0, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * srgb).round().astype(np.uint8), small[..., 3], small[..., 4]


@dataclass(eq=False)
class TruthfulFinder:
    """Finds the hand of a made film by knowing where it is; its mistakes are set.

    It tells which picture it is shown by comparing it with those of the film.

    Attributes:
        film: that it is shown.
        is_mirrored: whether it is shown the film in a mirror, as of a left hand.
        noise: of its landmarks, pixels, one standard deviation.
        presence: its certainty, in the pictures where that is not 0.95.
        missed: pictures in which following finds no hand, but looking closely does.
        unseen: pictures in which nothing does.
        mistaken: pictures in which it takes the hand for one of the other side.
        torn: pictures whose turned looks are off by so many pixels, either way.
    """

    film: MovingHand
    is_mirrored: bool = False
    noise: float = 0.3
    presence: Mapping[int, float] = field(default_factory=dict)
    missed: tuple[int, ...] = ()
    unseen: tuple[int, ...] = ()
    mistaken: tuple[int, ...] = ()
    torn: Mapping[int, float] = field(default_factory=dict)
    tracked: list[int] = field(default_factory=list)
    looked: list[tuple[int, float]] = field(default_factory=list)

    def track(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """The hand of a picture."""
        number = self._number(image)
        self.tracked.append(number)
        if number in self.missed or number in self.unseen:
            return []
        return [self._sighting(number, 0)]

    def look_closely(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        around: Float[np.ndarray, "21 2"],
        turn: float,
    ) -> Sighting | None:
        """The hand of a picture, if it is near what is already known of it."""
        number = self._number(image)
        self.looked.append((number, turn))
        if number in self.unseen:
            return None
        seen = self._sighting(number, round(math.degrees(turn)))
        beside = np.linalg.norm(seen.landmarks.mean(0) - around.mean(0))
        if beside > 0.3 * float(np.ptp(around, axis=0).max()):
            return None
        shift = self.torn.get(number, 0.0) * np.sign(turn)
        return replace(seen, landmarks=seen.landmarks + shift)

    def _number(self, image: UInt8[np.ndarray, "height width 3"]) -> int:
        shown = image[:, ::-1] if self.is_mirrored else image
        return closest_picture(self.film, shown)

    def _sighting(self, number: int, seed: int) -> Sighting:
        places, points = (values[number] for values in self.film.landmarks())
        places = np.array(places)
        world = points.double().numpy().copy()
        if self.is_mirrored:
            places[:, 0] = WIDTH - places[:, 0]
            world[:, 0] *= -1
        generator = np.random.default_rng([number, seed + 90])
        places += self.noise * generator.standard_normal(places.shape)
        is_right = self.is_mirrored == (number in self.mistaken)
        return Sighting(places, world, self.presence.get(number, 0.95), is_right)


def closest_picture(film: MovingHand, image: UInt8[np.ndarray, "height width 3"]) -> int:
    """The number of the film's picture that an image shows."""
    apart = np.abs(film.pictures.astype(np.int16) - image.astype(np.int16))
    return int(apart.mean((1, 2, 3)).argmin())
