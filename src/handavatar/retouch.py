"""Edits from words and pictures: what the command line's flags mean, and avatars that keep them."""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture.checks import CaptureError, decoded, open_picture
from handavatar.edit import Edit, Paint, bones_named
from handavatar.errors import ArgumentError, HandAvatarError, require_range, require_ranges
from handavatar.hand.rig import Rig
from handavatar.jobs.files import files_named, refuse_file_in_use

_log = logging.getLogger(__name__)
_UNSEEN_COLOR = (0.85, 0.1, 0.75)
_UNSEEN_OPACITY = 0.7


@dataclass(frozen=True, kw_only=True)
class Look:
    """An edit as the command line has it; the options of every command that edits have these.

    Attributes:
        light_gain: multiplies the illumination.
        albedo_shift: added to the albedo, R,G,B in [-1, 1].
        lift_shadow: fingers or bones that cast no shadow, comma-separated.
        paint: a picture with transparency (PNG) in the rig's texture chart, laid on the skin.
        light: of an avatar of several clips, the number of the one in whose light it is shown,
            from 0; by default the first one's, or the one that was saved into the avatar.
    """

    light_gain: float = 1.0
    albedo_shift: str = "0,0,0"
    lift_shadow: str = ""
    paint: Path | None = None
    light: int | None = None

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, light_gain=(0, 1000), light=(0, 10**6))

    def check_look(self) -> None:
        """Refuses words that mean nothing, before anything is read.

        Raises:
            ValueError: what cannot be understood.
        """
        self._shift()
        self._bones()

    def edit_on(self, avatar: HandAvatar) -> Edit:
        """The edit of this avatar; a warning says so where it will change next to nothing.

        Raises:
            ValueError: what cannot be understood, or a light that the avatar does not have.
            CaptureError: if the picture of the paint cannot be read.
        """
        avatar.light_of(Edit(light=self.light))
        paint = None if self.paint is None else paint_from(self.paint, avatar)
        bones = self._bones()
        if bones and avatar.illumination.chosen.num_directions == 0:
            _log.warning(
                "`lift_shadow`: this avatar's light was not traced, so that next to nothing of a "
                "shadow is lifted; train it with `method='best'`"
            )
        return Edit(self.light_gain, self._shift(), bones, paint, self.light)

    def _shift(self) -> tuple[float, float, float]:
        try:
            red, green, blue = (float(word) for word in self.albedo_shift.split(","))
        except ValueError as error:
            raise ArgumentError(
                "albedo_shift", self.albedo_shift, "three numbers, such as 0.1,0,-0.05"
            ) from error
        require_range("albedo_shift", (red, green, blue), -1, 1)
        return red, green, blue

    def _bones(self) -> tuple[int, ...]:
        words = (word.strip() for word in self.lift_shadow.split(","))
        return bones_named(tuple(word for word in words if word))


@dataclass(frozen=True)
class EditOptions(Look):
    """Saves an edit into an avatar: everything that renders it shows it.

    Attributes:
        run: run folder, or an avatar file; it stays as it is.
        out: the new avatar file.
        overwrite: replace what lies at ``out``.
    """

    run: Path
    out: Path
    overwrite: bool = False


def save_edited(options: EditOptions) -> Path:
    """Writes the avatar with the edit on top of those that it has.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if the picture of the paint cannot be read.
        FolderInUse: if the file is there already.
        ValueError: what cannot be understood.
    """
    options.check_look()
    read = (options.run, options.run / "avatar.safetensors", *files_named(options.paint))
    refuse_file_in_use(options.out, options.overwrite, read)
    avatar = HandAvatar.load(options.run)
    avatar.edit = avatar.edit.then(options.edit_on(avatar))
    avatar.save(options.out)
    return options.out


def paint_from(path: Path, avatar: HandAvatar) -> Paint:
    """Paint where a picture in the rig's texture chart is not transparent.

    Row ``i`` and column ``j`` of ``n`` lie at ``v = (i + 0.5) / n`` and ``u = (j + 0.5) / n``.
    Every anchor takes the pixel that it lies on; finer strokes than anchors are apart
    (3 to 4 mm) are lost.

    Raises:
        CaptureError: if the file is no picture, or covers everything or nothing.
    """
    return paint_of(open_picture(path), path.name, avatar)


def paint_of(picture: Image.Image, name: str, avatar: HandAvatar) -> Paint:
    """As :func:`paint_from`, of a picture that was opened; closes it.

    Raises:
        CaptureError: if it is damaged, or has no transparency.
    """
    with picture:
        if picture.mode not in ("RGBA", "LA", "PA") and "transparency" not in picture.info:
            raise CaptureError(
                f"{name} has no transparency", "save a PNG that is transparent where skin stays"
            )
        pixels = torch.from_numpy(decoded(picture, name, "RGBA"))
    places = anchor_places(avatar.rig, avatar.anchor_corners, avatar.anchor_barycentric)
    size = places.new_tensor([pixels.shape[1], pixels.shape[0]])
    column, row = (places * size).long().clamp_min(0).minimum(size.long() - 1).unbind(-1)
    chosen = pixels[row.cpu(), column.cpu()].to(places) / 255
    return Paint(chosen[:, :3], chosen[:, 3])


def tint_unseen(avatar: HandAvatar) -> Edit:
    """Paint on the skin that no training frame has seen; its look there is a guess.

    Raises:
        HandAvatarError: if the avatar does not know what was seen.
    """
    if avatar.seen_frames is None:
        raise HandAvatarError(
            "this avatar does not know what was seen", "", "train it with this version"
        )
    unseen = (avatar.seen_frames == 0).to(avatar.anchor_barycentric)
    colors = unseen.new_tensor(_UNSEEN_COLOR).expand(len(unseen), 3)
    return Edit(paint=Paint(colors, _UNSEEN_OPACITY * unseen))


def anchor_places(
    rig: Rig,
    corners: Tensor,
    barycentric: Float[Tensor, "anchors 3"],
) -> Float[Tensor, "anchors 2"]:
    """Texture coordinates (u, v) of points on a rig's faces, in [0, 1].

    Args:
        rig: with a texture chart.
        corners: vertex indices of the face of each point, as the rig's faces list them.
        barycentric: weights of the corners.
    """
    count = rig.num_vertices
    scale = torch.tensor([count * count, count, 1], device=corners.device)
    keys, order = (rig.faces * scale).sum(-1).sort()
    face = order[torch.searchsorted(keys, (corners * scale).sum(-1))]
    return (rig.uv_coordinates[rig.uv_faces[face]] * barycentric[..., None]).sum(1)
