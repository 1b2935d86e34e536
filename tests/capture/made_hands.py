"""Made pictures of a hand whose mask is known."""

from functools import cache

import numpy as np
import torch

from handavatar.capture.fitted_hand import HandFit, HandModel, projected
from handavatar.capture.outlines import silhouette
from handavatar.capture.tracking import TrackedHand
from handavatar.capture.windows import Window, window_camera
from handavatar.geometry.rotations import axis_angle_from_matrix
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose_sampling import gesture_rotations

SIDE = 320
PICTURE = (400, 400)
CENTER = (200.0, 200.0)
CORNER = (40.0, 40.0)
FOCAL = 400.0
SKIN = np.array([205.0, 150.0, 120.0])


def made_fit(number: int) -> HandFit:
    """An upright spread hand, half a metre away, a little further right with every number."""
    rig = load_open_hand("778")
    rotations = gesture_rotations(rig, "spread")[None].clone()
    upright = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    rotations[0, 0] = axis_angle_from_matrix(upright)
    return HandFit(
        rotations,
        torch.tensor([[0.005 * number - 0.02, 0.10, 0.5]]),
        torch.zeros(rig.shape_directions.shape[-1]),
        torch.tensor(FOCAL).log(),
        torch.zeros(21, 3),
    )


@cache
def made_hand(number: int) -> tuple[TrackedHand, np.ndarray]:
    """A shaded skin-coloured hand before a striped wall, and its true mask; read only."""
    rig, fit = load_open_hand("778"), made_fit(number)
    generator = np.random.default_rng(number)
    model = HandModel(rig)
    camera = window_camera(FOCAL, CENTER, CORNER, float(SIDE), SIDE)
    mask = silhouette(rig, model.all_vertices(fit)[0], camera)
    y, x = np.mgrid[:SIDE, :SIDE]
    wall = np.stack([110 + 25 * (x // 40 % 2), 120 + 0 * x, 130 + 20 * (y // 60 % 2)], axis=-1)
    shade = 0.7 + 0.3 * x / SIDE
    skin = SKIN * shade[..., None]
    image = np.where(mask[..., None], skin, wall) + generator.normal(0, 5, (SIDE, SIDE, 3))
    points = model.landmarks(fit)
    hand = TrackedHand(
        index=number,
        time=number / 10,
        window=Window(image.clip(0, 255).astype(np.uint8), CORNER, 1.0, PICTURE),
        landmarks=projected(points, fit.log_focal.exp(), CENTER)[0].double().numpy(),
        spread=np.ones(21),
        world_landmarks=(points - points.mean(1, keepdim=True))[0].double().numpy(),
        presence=0.95,
    )
    return hand, mask
