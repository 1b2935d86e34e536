"""Which skin has been seen well so far, by parts of the hand, and what to show next."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from handavatar.capture.seen_skin import seen_vertices, skin_regions, vertex_areas
from handavatar.capture.windows import window_camera
from handavatar.geometry.cameras import Camera, framing_camera, project
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import angles_from_rotations, gesture_rotations
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import Fragments, interpolate, rasterize
from handavatar.webcam.posing import LivePose

_ENOUGH = 4
"""Pictures that saw a vertex well: from then on it counts as seen."""
_COSINE = 0.4
"""Between normal and line of sight: flatter skin has too few pixels to count as seen well."""
_SIDE = 80
"""Pixels of the little picture in which it is told what hides what."""
_DONE = 0.75
"""Of a step's skin: as much of it seen is all that is asked for."""
_MAP_SIDE = 150
_FROM = {
    "palm": (0.0, -1.0, 0.0),
    "back": (0.0, 1.0, 0.0),
    "thumb's side": (0.0, 0.0, 1.0),
    "little finger's side": (0.0, 0.0, -1.0),
}
_UNSEEN, _SEEN, _GROUND = (0.85, 0.42, 0.30), (0.36, 0.78, 0.45), (0.11, 0.12, 0.15)
_FISTED, _SPREAD = 55.0, 16.0
"""Degrees: mean bend of the long fingers' joints from which on a hand is a fist, and angle between
index and little finger, as their knuckles turn, from which on it is spread."""
_HELD = 3
"""Pictures in which a gesture has to be seen."""


@dataclass(frozen=True)
class Step:
    """Something to show to the camera.

    Attributes:
        name: a word.
        instruction: what to do, a sentence.
        regions: of the skin (:func:`handavatar.capture.seen_skin.skin_regions`), of which most has
            to be seen.
        gesture: that has to be seen as well; empty for any.
    """

    name: str
    instruction: str
    regions: tuple[str, ...] = ()
    gesture: str = ""


_LONG = ("index", "middle", "ring", "little")
STEPS: tuple[Step, ...] = (
    Step(
        "palm",
        "Show the palm, the fingers straight and a little apart.",
        ("palm", "thumb, pad's side", *(f"{finger} finger, palm side" for finger in _LONG)),
    ),
    Step(
        "back",
        "Turn the hand slowly and show its back.",
        ("back", "thumb, nail's side", *(f"{finger} finger, back" for finger in _LONG)),
    ),
    Step(
        "thumb's side",
        "Turn the hand so that the thumb's edge faces the camera, then back again.",
        ("edge on the thumb's side", "index finger, thumb's side"),
    ),
    Step(
        "little finger's side",
        "Turn the hand the other way, so that the little finger's edge faces the camera.",
        ("edge on the little finger's side", "little finger, little finger's side"),
    ),
    Step("spread", "Spread the fingers as far as they go.", gesture="spread"),
    Step("fist", "Close the hand slowly to a fist, and open it again.", gesture="fist"),
)
"""In the order in which they are asked for."""
FINISHED = "All has been seen. Go on with slow movements for a while, or stop."


class SkinCoverage:
    """Counts, for each vertex of a hand, in how many good pictures it was seen from the front."""

    def __init__(self, rig: Rig) -> None:
        """Nothing was seen yet.

        Args:
            rig: whose vertices are counted.
        """
        self._rig = rig
        self._area = vertex_areas(rig.template_vertices, rig.faces)
        regions = skin_regions(rig)
        self._vertices = {
            step.name: torch.cat([regions[name] for name in step.regions if name in regions])
            for step in STEPS
            if step.regions
        }
        self.reset()

    def reset(self) -> None:
        """Forgets what was seen."""
        self.counts = torch.zeros(self._rig.num_vertices, dtype=torch.long)
        self._gestures = {step.gesture: 0 for step in STEPS if step.gesture}

    @property
    def is_seen(self) -> Bool[Tensor, "vertices"]:
        """Which vertices were seen well."""
        return self.counts >= _ENOUGH

    @torch.no_grad()
    def add(self, live: LivePose, vertices: Float[Tensor, "vertices 3"]) -> None:
        """Counts one good picture.

        Args:
            live: pose and camera.
            vertices: of the posed hand, metres, camera axes.
        """
        camera = _camera_about(live.camera, vertices)
        # Beyond the picture nothing is seen: its pixels are those between its corners.
        known = _inside(camera, live.camera)
        self.counts += seen_vertices(vertices, self._rig.faces, camera, known, _COSINE)
        for name in gestures_shown(self._rig, live.pose):
            self._gestures[name] += 1

    def share(self) -> float:
        """Of all the skin's area, seen well, in [0, 1]."""
        return self._share_of(torch.arange(self._rig.num_vertices))

    def shares(self) -> dict[str, float]:
        """Of every step, how much of it is done, in [0, 1]."""
        found = {}
        for step in STEPS:
            skin = self._share_of(self._vertices[step.name]) / _DONE if step.regions else 1.0
            held = self._gestures[step.gesture] / _HELD if step.gesture else 1.0
            found[step.name] = min(skin, held, 1.0)
        return found

    def _share_of(self, vertices: Int[Tensor, "chosen"]) -> float:
        area = self._area[vertices]
        return float((area * self.is_seen[vertices]).sum() / area.sum())

    def picture(self, is_left: bool = False) -> UInt8[np.ndarray, "height width 3"]:
        """The spread hand's palm, back and two edges in a row; skin that was seen is green.

        Args:
            is_left: whether it is shown as a left hand.
        """
        seen = (self.counts.float() / _ENOUGH).clamp(max=1.0)[:, None]
        colors = torch.lerp(torch.tensor(_UNSEEN), torch.tensor(_SEEN), seen)
        pieces = []
        for fragments, shade in _drawings(self._rig):
            drawn = interpolate(fragments, self._rig.faces, colors * shade[:, None])
            drawn[~fragments.mask] = torch.tensor(_GROUND)
            pieces.append(drawn.flip(1) if is_left else drawn)
        row = torch.cat(pieces, dim=1)
        return (255 * row).round().byte().numpy()


def next_step(shares: dict[str, float]) -> Step | None:
    """What to show next; None if all was seen.

    Args:
        shares: as :meth:`SkinCoverage.shares` gives them.
    """
    return next((step for step in STEPS if shares[step.name] < 1), None)


def gestures_shown(rig: Rig, pose: HandPose) -> list[str]:
    """Which of the gestures that are asked for a pose is.

    Args:
        rig: for the axes of its joints.
        pose: of the hand.
    """
    angles = angles_from_rotations(rig, pose.rotations).rad2deg()
    bones = [bone for finger in _LONG for bone in FINGER_BONES[finger]]
    bend = float(angles[bones, 0].mean())
    index, little = (FINGER_BONES[finger][0] for finger in ("index", "little"))
    apart = float(angles[index, 1] - angles[little, 1])
    found = []
    if bend > _FISTED:
        found.append("fist")
    if apart > _SPREAD and bend < _FISTED / 2:
        found.append("spread")
    return found


def _camera_about(camera: Camera, vertices: Float[Tensor, "vertices 3"]) -> Camera:
    """The square about a hand, with few pixels."""
    pixels, _ = project(camera, vertices)
    low, high = pixels.amin(0), pixels.amax(0)
    side = float((high - low).max()) + 2
    left, top = ((low + high) / 2 - side / 2).tolist()
    return window_camera(camera.focal[0], camera.center, (left, top), side, _SIDE)


def _inside(camera: Camera, whole: Camera) -> Bool[Tensor, "height width"]:
    """Pixels of a view that lie in the whole picture."""
    scale = camera.focal[0] / whole.focal[0]
    inside = []
    for length, center, middle, size in (
        (camera.height, camera.center[1], whole.center[1], whole.height),
        (camera.width, camera.center[0], whole.center[0], whole.width),
    ):
        places = (torch.arange(length) + 0.5 - center) / scale + middle
        inside.append((places >= 0) & (places <= size))
    return inside[0][:, None] & inside[1][None]


@lru_cache(maxsize=2)
def _drawings(rig: Rig) -> list[tuple[Fragments, Float[Tensor, "vertices"]]]:
    """The spread hand from four sides, and how bright its vertices are."""
    pose = HandPose(gesture_rotations(rig, "spread"), torch.zeros(3))
    vertices = rig.shaped().posed(pose).vertices
    normals = vertex_normals(vertices, rig.faces)
    found = []
    for direction in _FROM.values():
        camera = framing_camera(vertices, direction, _MAP_SIDE, 0.6, 1.1)
        shade = 0.45 + 0.55 * (normals @ torch.tensor(direction)).clamp(0, 1)
        found.append((rasterize(vertices, rig.faces, camera), shade))
    return found
