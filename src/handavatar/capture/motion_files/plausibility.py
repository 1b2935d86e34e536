"""Whether a track can be a hand's: how far away it is, and which way its fingers bend.

Wrong units, axes, sides and mean poses all give a hand; not one that a camera sees, or that a
finger's joints allow.
"""

import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.mano_parameters import with_mean, without_mean
from handavatar.capture.motion_files.track import (
    UNITS,
    Conventions,
    HandTrack,
    mirrored_rotations,
)
from handavatar.errors import argument
from handavatar.geometry.rotations import axis_angle_from_matrix
from handavatar.hand.mano import ManoModel
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES
from handavatar.hand.pose_sampling import angles_from_rotations, limit_bounds
from handavatar.hand.rig import Rig

NEAREST, FARTHEST = 0.05, 5.0
"""Metres from a camera within which a hand is believed."""
WORLD_REACH = 20.0
"""Metres from the origin of a recording's world."""
MAX_BEND = math.radians(12)
"""Mean bend of a frame's finger joints beyond their limits from which on a motion is refused: that
of the worst tenth of its frames, since an open hand shows a fault that a relaxed one hides."""
DOUBTFUL_BEND = math.radians(6)
"""The same, from which on it is told."""
_WORST_SHARE = 0.9
TOLD_BEND = math.radians(20)
"""Median bend beyond its limits of one joint that is told."""
_FINGER_JOINTS = [bone for name, chain in FINGER_BONES.items() if name != "thumb" for bone in chain]
_TRACKERS = ("hamer", "wilor", "wilor-mini")
_OF_MATRICES = ("hamer", "wilor", "hawor", "soma")


def check_distance(wrists: Float[Tensor, "steps 3"], conventions: Conventions, layout: str) -> None:
    """Refuses hands behind the camera, in it, or too far from it to be filmed.

    Args:
        wrists: metres, camera (x right, y down, z forward).
        conventions: what the user said of units and axes.
        layout: whose file it is.

    Raises:
        CaptureError: what was found, and which convention would put it right.
    """
    depth = float(wrists[:, 2].median())
    if depth < 0:
        remedy = "its axes may be OpenGL's (y up, z backwards): say `axes='opengl'`"
        if conventions.axes == "opengl":
            remedy = "leave `axes` out: with OpenCV's axes it is in front of it"
        raise CaptureError(f"the hand is {-depth:.3g} m behind the camera", remedy)
    if NEAREST <= depth <= FARTHEST:
        return
    raise CaptureError(
        f"the hand is {depth:.3g} m from the camera, expected {NEAREST:g} to {FARTHEST:g} m",
        _unit_remedy(depth, conventions, layout),
    )


def _unit_remedy(depth: float, conventions: Conventions, layout: str) -> str:
    stored = depth / UNITS[conventions.unit]
    if layout in _TRACKERS and depth > FARTHEST:
        return (
            "depths of HaMeR and WiLoR are for a focal length of 5000 / 256 times the picture's "
            "longer side: say the true one in pixels with `focal`"
        )
    fitting = [
        name
        for name, metres in UNITS.items()
        if name != conventions.unit and NEAREST <= stored * metres <= FARTHEST
    ]
    if fitting:
        return f"its unit may be another: {' or '.join(argument('unit', unit) for unit in fitting)}"
    return "give translations in the camera's frame"


def check_reach(wrists: Float[Tensor, "steps 3"], conventions: Conventions) -> None:
    """Refuses hands too far from the origin of their world.

    Raises:
        CaptureError: it is farther than :data:`WORLD_REACH`.
    """
    reach = float(wrists.norm(dim=-1).median())
    if reach > WORLD_REACH:
        stored = reach / UNITS[conventions.unit]
        fitting = [n for n, metres in UNITS.items() if stored * metres <= WORLD_REACH]
        raise CaptureError(
            f"the hand is {reach:.4g} m from the origin, expected {WORLD_REACH:g} m at most",
            f"its unit may be another: {' or '.join(argument('unit', unit) for unit in fitting)}"
            if fitting
            else "give translations in metres",
        )


def bends_beyond_limits(
    rig: Rig, rotations: Float[Tensor, "steps bones 3 3"]
) -> Float[Tensor, "steps joints"]:
    """How far the twelve finger joints are bent beyond the limits of flexion, radians."""
    angles = angles_from_rotations(rig, axis_angle_from_matrix(rotations).float())
    least, greatest = limit_bounds(angles)
    excess = (least - angles).relu() + (angles - greatest).relu()
    return excess[:, _FINGER_JOINTS, 0]


def check_bends(
    rig: Rig,
    rotations: Float[Tensor, "steps bones 3 3"],
    carried: Callable[[Tensor], Tensor],
    track: HandTrack,
    layout: str,
    model: ManoModel | None,
    tell: Callable[[str], None],
) -> None:
    """Refuses motions whose fingers bend as no hand's do, and says which convention would do.

    Args:
        rig: whose limits hold.
        rotations: of the track, as a right hand.
        carried: carries rotations of the track over to the rig.
        track: that they are of.
        layout: whose file it is.
        model: a MANO file of this side, to try its mean pose.
        tell: called where one joint alone is bent too far.

    Raises:
        CaptureError: the joints are beyond their limits by :data:`MAX_BEND`.
    """

    def beyond(turns: Tensor) -> float:
        frames = bends_beyond_limits(rig, carried(turns)).mean(-1)
        return float(frames.quantile(_WORST_SHARE))

    found = bends_beyond_limits(rig, carried(rotations))
    worst_frames = beyond(rotations)
    if worst_frames <= MAX_BEND:
        if worst_frames > DOUBTFUL_BEND:
            tell(
                "finger joints are bent beyond their limits by "
                f"{math.degrees(worst_frames):.0f} degrees on average in one of ten frames: see "
                "whether side and mean pose are right"
            )
        medians = found.median(0).values
        worst = int(medians.argmax())
        if float(medians[worst]) > TOLD_BEND:
            tell(
                f"{BONE_NAMES[_FINGER_JOINTS[worst]]} is bent beyond its limits by "
                f"{math.degrees(float(medians[worst])):.0f} degrees in half of the frames"
            )
        return
    tries = _other_conventions(rotations, track, layout, model)
    fitting = [remedy for remedy, turns in tries if beyond(turns) <= MAX_BEND / 2]
    raise CaptureError(
        "its finger joints are bent beyond their limits by "
        f"{math.degrees(worst_frames):.0f} degrees on average in one of ten frames: the side, the "
        "mean pose or the order of the bones is another",
        "within the limits it is, if " + "; or if ".join(fitting)
        if fitting
        else "check `side`, `flat_hand_mean`, `use_pca` and `layout` against what wrote the file",
    )


def _other_conventions(
    rotations: Float[Tensor, "steps bones 3 3"],
    track: HandTrack,
    layout: str,
    model: ManoModel | None,
) -> list[tuple[str, Float[Tensor, "steps bones 3 3"]]]:
    """What may be the matter, and the rotations that the file then means."""
    tries = []
    if track.skeleton == "mano":
        other = "left" if track.side == "right" else "right"
        tries.append((_side_remedy(layout, other), mirrored_rotations(rotations)))
    if layout in _OF_MATRICES:
        tries.append(("its matrices are for row vectors: transpose them", rotations.mT))
    elif model is not None:
        tries += [
            (
                "its poses count from MANO's mean pose: `layout='mano'` `flat_hand_mean='false'`",
                with_mean(rotations, model),
            ),
            (
                "its poses hold MANO's mean pose already: `layout='mano'` `flat_hand_mean='true'`",
                without_mean(rotations, model),
            ),
        ]
    return tries


def _side_remedy(layout: str, other: str) -> str:
    if layout in _TRACKERS:
        return (
            f"it is a {other} hand, or a left one as another tracker describes it: "
            "`layout='hamer'`, wilor or wilor-mini"
        )
    return f"it is a {other} hand: `side={other!r}`"
