"""The way of a camera that moved: poses of a hand in the world, and how long the world's unit is.

Structure from motion knows a camera's way but for its scale. A hand's size is known, and where the
camera saw it: the scale is that with which the hand moves least in the world.
"""

from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.geometry.rotations import invert_rigid

_LEAST_EXPLAINED = 0.5
"""Of the hand's motion before the camera, that the camera's own has to explain."""
_STILL = 1e-9


def metres_of_unit(
    camera_from_world: Float[Tensor, "frames 4 4"], places: Float[Tensor, "frames 3"]
) -> float:
    """How many metres the world's unit is, if the hand was held still.

    The least squares of ``turn @ place + unit * center`` about its mean, where ``turn`` and
    ``center`` are the camera's in the world.

    Args:
        camera_from_world: OpenCV axes, in the world's units.
        places: of the hand, metres, camera axes.

    Raises:
        CaptureError: the hand moved about as much as the camera did, or the camera only turned.
    """
    world_from_camera = invert_rigid(camera_from_world.double())
    centers = world_from_camera[:, :3, 3]
    turned = (world_from_camera[:, :3, :3] @ places.double()[..., None])[..., 0]
    centers, turned = centers - centers.mean(0), turned - turned.mean(0)
    spread = float(centers.square().sum())
    unit = -float((centers * turned).sum()) / max(spread, _STILL)
    left = float((turned + unit * centers).square().sum())
    explained = 1 - left / max(float(turned.square().sum()), _STILL)
    if unit <= 0 or spread < _STILL or explained < _LEAST_EXPLAINED:
        raise CaptureError(
            "how long the unit of the cameras' positions is cannot be told: the hand moved about "
            f"as much as the camera did (of its way {max(0, round(100 * explained))} % is the "
            "camera's)",
            "hold the hand still while the camera moves, or name the unit with `camera_unit` "
            "(metres; 1 where the positions are in metres)",
        )
    return unit


def in_metres(
    camera_from_world: Float[Tensor, "frames 4 4"], unit: float
) -> Float[Tensor, "frames 4 4"]:
    """Cameras whose positions were in some unit, in metres."""
    found = camera_from_world.clone()
    found[..., :3, 3] *= unit
    return found
