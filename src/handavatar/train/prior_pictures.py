"""Pictures of occupancy priors: the extracted meshes of telling poses, side by side."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from handavatar.errors import HandAvatarError, require_ranges
from handavatar.evaluate.geometry import Skin, Truth
from handavatar.field.decoders import OccupancyField
from handavatar.geometry.cameras import framing_camera
from handavatar.geometry.colors import eight_bits
from handavatar.geometry.extraction import Field
from handavatar.hand.open_hand import Level
from handavatar.hand.parts import POINT_ROUNDS, finer_rig
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand
from handavatar.hand.rigs import load_rig
from handavatar.hand.surface import extract_hand
from handavatar.jobs.files import FolderKind, claim_folder, write_aside
from handavatar.render.shaded import shaded_mesh
from handavatar.train.prior import SHIPPED_PRIOR, open_prior

POSES = ("flat", "fist", "pinch", "crossed_fingers")
PRIOR_PICTURES = FolderKind(
    "pictures of priors",
    tuple(f"{pose}.png" for pose in POSES),
    lambda folder: all((folder / f"{pose}.png").is_file() for pose in POSES),
)
"""The folder that :func:`picture_priors` writes into."""
VIEWS: dict[str, tuple[float, float, float]] = {
    "palm": (0.0, -1.0, 0.0),
    "thumb side": (0.0, 0.0, 1.0),
    "back": (0.0, 1.0, 0.0),
    "little side": (0.0, 0.0, -1.0),
}
"""Where the camera stands, in the hand's rest axes."""

_DISTANCE = 1.2
_ROOM = 1 / 0.92
_TITLE = 18

FieldOf = Callable[[PosedHand], Field]
"""The occupancy of a posed hand."""


@dataclass(frozen=True)
class PriorPictureOptions:
    """Which priors to look at, and how.

    Attributes:
        out: folder for one picture per pose: a row per prior, a column per side.
        priors: the weights; by default those that ship.
        resolution: cells along the longest side of the extraction's box.
        size: edge of one picture, pixels.
        rig: the hand: ``open-hand``, an imported one (``mano-right``) or its file.
        level: ``778`` thins the open hand to MANO's size; other rigs have ``full`` alone.
        rounds: midpoint subdivisions.
        truth: adds a row of the guiding mesh, extracted in the same way.
    """

    out: Path
    priors: tuple[Path, ...] = (SHIPPED_PRIOR,)
    resolution: int = 256
    size: int = 320
    rig: str = "open-hand"
    level: Level = "full"
    rounds: int = POINT_ROUNDS
    truth: bool = True

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, resolution=(2, 1024), size=(16, 4096), rounds=(0, 4))


def picture_priors(options: PriorPictureOptions) -> list[Path]:
    """Writes a picture of each of ``POSES``.

    Raises:
        CheckpointError: if a prior cannot be read.
        RigError: if there is no such rig, or not at this level.
        FolderInUse: if ``out`` holds something else than such pictures.
    """
    base = load_rig(options.rig, options.level)
    rig, parts = finer_rig(base, options.rounds)
    skin = Skin.of(rig)
    fields: dict[str, FieldOf] = {}
    for path in options.priors:
        prior = open_prior(path)

        def occupancy_of(hand: PosedHand, prior: OccupancyField = prior) -> Field:
            with torch.no_grad():
                codes = prior.encode(parts, hand)
            return lambda points: prior(codes, points).whole

        fields[str(path) if path.stem in fields else path.stem] = occupancy_of
    if options.truth:
        fields["guiding mesh"] = lambda hand: Truth(hand, skin).occupancy
    claim_folder(options.out, PRIOR_PICTURES)
    written = []
    for pose in POSES:
        hand = rig.shaped().posed(HandPose(gesture_rotations(base, pose), torch.zeros(3)))
        boxes = parts.boxes(hand, 0.0)
        meshes = {}
        for name, field_of in fields.items():
            surface = extract_hand(field_of(hand), boxes, hand, options.resolution)
            if len(surface.faces) == 0:
                raise HandAvatarError(
                    f"{name}: no surface is found at `resolution={options.resolution}`",
                    "",
                    "raise it; or is this no prior of this rig?",
                )
            meshes[name] = (surface.vertices, surface.faces)
        path = options.out / f"{pose}.png"
        with write_aside(path) as aside:
            Image.fromarray(side_by_side(meshes, hand.vertices, options.size)).save(aside)
        written.append(path)
    return written


def side_by_side(
    meshes: Mapping[str, tuple[Tensor, Tensor]], frame: Tensor, size: int
) -> UInt8[np.ndarray, "height width 3"]:
    """A row per mesh (vertices, faces), a column per side; all through the same cameras.

    Args:
        meshes: by title.
        frame: points (metres) that fill every picture.
        size: edge of one picture, pixels.
    """
    cameras = {
        name: framing_camera(frame, direction, size, _DISTANCE, _ROOM)
        for name, direction in VIEWS.items()
    }
    rows = []
    for title, (vertices, faces) in meshes.items():
        pictures = [shaded_mesh(vertices, faces, camera) for camera in cameras.values()]
        strip = eight_bits(torch.cat(pictures, dim=1)).numpy()
        head = Image.new("RGB", (strip.shape[1], _TITLE), (255, 255, 255))
        draw = ImageDraw.Draw(head)
        for column, side in enumerate(cameras):
            text = f"{title}: {side}" if column == 0 else side
            draw.text((column * size + 4, 3), text, fill=(60, 60, 60))
        rows += [np.asarray(head), strip]
    return np.concatenate(rows)
