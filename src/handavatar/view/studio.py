"""From a scene to pictures: fluid at once, then the field at half the size, then in full."""

import copy
import io
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from handavatar.animate import camera_on, pass_pictures
from handavatar.avatar import HandAvatar, Rendering, RenderSettings
from handavatar.capture.checks import CaptureError, picture_in
from handavatar.capture.motion import (
    MORE_GESTURES,
    MOTIONS,
    Motion,
    gesture,
    middle_of_hand,
    named_motion,
    placed,
)
from handavatar.capture.view import start_of
from handavatar.edit import Edit, Paint
from handavatar.geometry.cameras import Camera
from handavatar.geometry.colors import eight_bits
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    angles_from_rotations,
    joint_angles,
    rotations_from_angles,
)
from handavatar.render.shaded import shaded_mesh
from handavatar.retouch import paint_of, tint_unseen
from handavatar.view.baked import BakedAvatar, dabbed
from handavatar.view.scene import (
    LAYERS,
    SIZES,
    UNSEEN,
    Coat,
    Moment,
    Orbit,
    Scene,
    SceneError,
    Stroke,
    Touches,
)

STAGES = ("fluid", "half", "full")
FLUID_SIZE = 256
"""The fluid picture has at most so many pixels along a side."""
MOST_SAVED = 100
Pixels = UInt8[np.ndarray, "size size 3"]
MOST_PICTURE_BYTES = 4 * 2**20
"""Of a picture that is sent as paint."""
MOST_PICTURE_PIXELS = 4096 * 4096
"""Of a picture that is sent as paint; decoded it takes four bytes a pixel."""
_KEPT_PAINTS = 8
_KEPT_COATS = 64


class Interrupted(Exception):
    """Nobody waits for this picture any more."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A scene as the renderer takes it.

    Attributes:
        pose: of the hand in the world.
        camera: of the finished picture; of a left hand's, before it is mirrored.
        edit: whole; the avatar's own plays no part.
    """

    pose: HandPose
    camera: Camera
    edit: Edit


class Studio:
    """One avatar, the motions it knows, and its pictures.

    :meth:`fluid` and :meth:`nearest_anchor` belong to one thread, :meth:`refined` to another; both
    may run at once. All else may be called from any thread.
    """

    def __init__(
        self,
        avatar: HandAvatar,
        motions: dict[str, Motion] | None = None,
        settings: RenderSettings | None = None,
    ) -> None:
        """Sets the stage for an avatar, which is not changed.

        Args:
            avatar: its own edit is where pages begin.
            motions: by name, besides those that are built in.
            settings: how the field is evaluated for a picture in full; by default as
                :meth:`HandAvatar.render` does.
        """
        self._settings = settings or RenderSettings()
        self._avatar = copy.copy(avatar)
        self._avatar.edit = Edit()
        self.start = avatar.edit
        self._tint = None if avatar.seen_frames is None else tint_unseen(avatar)
        self.side = str(avatar.info.get("side", "right"))
        # The rest hand and its joints answer small questions, on the CPU and from any thread.
        self._rig = avatar.base_rig.to("cpu")
        # Of each light: a clip has a world of its own.
        self._firsts = _first_poses(avatar)
        self._motions = dict(motions or {})
        self._built_in: dict[tuple[str, int], Motion] = {}
        self._frames: dict[tuple[str | None, int, int], tuple[Camera, Tensor]] = {}
        self._making_motions = threading.Lock()
        self._mixing_paint = threading.Lock()
        # A module of its own: the other one's evaluations can be interrupted.
        self._baked = BakedAvatar(copy.deepcopy(self._avatar), self._firsts[0])
        self._places, self._normals = self._baked.template_anchors()
        self._paints: OrderedDict[tuple[Any, ...], Paint | None] = OrderedDict()
        self._coats: OrderedDict[str, Paint] = OrderedDict()
        self._reading_coat = threading.Lock()

    def about(self) -> dict[str, Any]:
        """What a page needs to know, as JSON; angles in degrees."""
        known = {**GESTURES, **MORE_GESTURES}
        lifted = set(self.start.lifted_bones)
        return {
            "side": self.side,
            "subject": str(self._avatar.info.get("subject", "")),
            "layers": [*LAYERS, *(() if self._tint is None else (UNSEEN,))],
            "sizes": list(SIZES),
            "stages": list(STAGES),
            "most_picture_bytes": MOST_PICTURE_BYTES,
            "joints": [vars(angle) for angle in joint_angles()],
            "fingers": list(FINGER_BONES),
            "angles": self.angles(None),
            "gestures": {name: self._degrees(gesture(self._rig, name)) for name in known},
            "lights": self._avatar.num_lights,
            "motions": [*self._motions, *(name for name in MOTIONS if name not in self._motions)],
            "touches": {
                "light_gain": self.start.light_gain,
                "albedo_shift": list(self.start.albedo_shift),
                "lift_shadow": [BONE_NAMES[bone] for bone in sorted(lifted)],
                "strokes": [],
                "light": self.start.light or 0,
            },
            "finger_bones": {
                finger: [BONE_NAMES[bone] for bone in bones]
                for finger, bones in FINGER_BONES.items()
            },
        }

    def motion(self, name: str, light: int = 0) -> Motion:
        """A motion by name; built-in ones are made when they are first asked for.

        Args:
            name: of the motion.
            light: in whose clip's view a built-in one begins.

        Raises:
            SceneError: if there is none.
        """
        if name in self._motions:
            return self._motions[name]
        if name not in MOTIONS:
            raise SceneError(f"there is no motion {ascii(name)[:40]}")
        with self._making_motions:
            if (name, light) not in self._built_in:
                made = named_motion(self._rig, name, self._firsts[light])
                self._built_in[name, light] = made
        return self._built_in[name, light]

    def angles(self, moment: Moment | None) -> list[list[float]]:
        """Flexion, abduction and twist of every bone at a moment, degrees; the wrist's are zero.

        Raises:
            SceneError: if there is no such moment.
        """
        return self._degrees(self._at(moment).rotations)

    def shot(self, scene: Scene) -> Shot:
        """What the renderer needs for a scene.

        Raises:
            SceneError: if the scene names a moment, an anchor, a picture or a layer that there
                is not.
        """
        edit = self.edit(scene.touches)
        if scene.layer == UNSEEN:
            if self._tint is None:
                raise SceneError(f"layer: this avatar does not know what was seen, no {UNSEEN!r}")
            edit = edit.then(self._tint)
        return Shot(self.pose(scene), self._camera(scene), edit)

    def pose(self, scene: Scene) -> HandPose:
        """The hand of a scene, in the world.

        Raises:
            SceneError: if there is no such moment.
        """
        pose = self._at(scene.moment, self._light(scene.touches))
        if scene.angles is not None:
            rotations = rotations_from_angles(self._rig, torch.tensor(scene.angles))
            pose = replace(pose, rotations=torch.cat([pose.rotations[:1], rotations[1:]]))
        if any(scene.turn):
            wrist = matrix_from_axis_angle(pose.rotations[0])
            turned = wrist @ matrix_from_axis_angle(torch.tensor(scene.turn))
            middle = middle_of_hand(self._rig, pose)
            pose = placed(self._rig, pose.rotations[None], turned[None], middle, 30.0).pose(0)
        return pose

    def edit(self, touches: Touches) -> Edit:
        """The edit that a page's touches make of the untouched avatar.

        Raises:
            SceneError: if a stroke lies on an anchor, or is a picture, that there is not, or the
                avatar has no such light.
        """
        light = self._light(touches)
        return Edit(
            touches.light_gain,
            touches.albedo_shift,
            touches.lifted_bones,
            self._paint(touches),
            light if self._avatar.num_lights > 1 else None,
        )

    def _light(self, touches: Touches) -> int:
        try:
            return self._avatar.light_of(Edit(light=touches.light))
        except ValueError as error:
            raise SceneError(str(error)) from error

    def fluid(self, scene: Scene) -> Pixels:
        """The picture for a hand in motion, of at most ``FLUID_SIZE`` pixels.

        Raises:
            SceneError: as :meth:`shot`.
        """
        shot = self.shot(replace(scene, size=min(scene.size, FLUID_SIZE)))
        if scene.layer == "mesh":
            vertices = self._baked.posed(shot.pose).posed.vertices
            return mesh_picture(vertices, self._avatar, shot, 1)
        rendering = self._baked.render(shot.pose, shot.camera, shot.edit)
        return layer_picture(rendering, self.side, scene.layer)

    def refined(self, scene: Scene, stage: str, is_stale: Callable[[], bool]) -> Pixels:
        """The picture by the field; the last stage is what ``handavatar render`` gives.

        Args:
            scene: what is to be seen.
            stage: ``half`` or ``full``.
            is_stale: asked every few milliseconds whether to go on.

        Raises:
            Interrupted: as soon as it is stale.
            SceneError: as :meth:`shot`.
        """
        shot = self.shot(replace(scene, size=size_at(stage, scene.size)))
        return refined_picture(self._avatar, shot, scene.layer, stage, self._settings, is_stale)

    def nearest_anchor(self, scene: Scene, x: float, y: float) -> int | None:
        """The anchor under a point of the picture; None beside the hand.

        Args:
            scene: what is seen.
            x: to the right, in widths of the picture.
            y: down, in heights.
        """
        shot = self.shot(scene)
        x = 1 - x if self.side == "left" else x
        column, row = (min(int(share * scene.size), scene.size - 1) for share in (x, y))
        return self._baked.nearest_anchor(shot.pose, shot.camera, column, row)

    def coat(self, content: bytes) -> str:
        """Reads a picture as paint, and gives the name by which scenes may have it.

        The last few are kept; the same picture has the same name.

        Args:
            content: a PNG with transparency, in the rig's texture chart.

        Raises:
            SceneError: if it is none, or too large.
        """
        name = sha256(content).hexdigest()[:32]
        with self._reading_coat:
            if name not in self._coats:
                try:
                    picture = picture_in(
                        io.BytesIO(content), "the picture", ("PNG",), MOST_PICTURE_PIXELS
                    )
                    self._coats[name] = paint_of(picture, "the picture", self._avatar)
                except CaptureError as error:
                    raise SceneError(f"{error.what}: {error.remedy}") from error
                while len(self._coats) > _KEPT_COATS:
                    self._coats.popitem(last=False)
            self._coats.move_to_end(name)
        return name

    def save(self, touches: Touches, folder: Path) -> Path:
        """Writes the avatar with a page's edits under a new name; no file is replaced.

        Returns:
            ``edited-001.safetensors`` in the folder, or with the first number that is free.

        Raises:
            SceneError: if a stroke means nothing here, or no number is free.
        """
        edited = copy.copy(self._avatar)
        edited.edit = self.edit(touches)
        folder.mkdir(parents=True, exist_ok=True)
        aside = folder / f".edited-{os.getpid()}-{threading.get_ident()}.safetensors"
        try:
            edited.save(aside)
            for number in range(1, MOST_SAVED + 1):
                path = folder / f"edited-{number:03d}.safetensors"
                try:
                    os.link(aside, path)  # which fails where a file is
                except FileExistsError:
                    continue
                return path
        finally:
            aside.unlink(missing_ok=True)
        raise SceneError(f"{folder} holds {MOST_SAVED} edited avatars: move some away")

    def _at(self, moment: Moment | None, light: int = 0) -> HandPose:
        if moment is None:
            return self._firsts[light]
        motion = self.motion(moment.motion, light)
        if moment.step >= len(motion):
            raise SceneError(f"{moment.motion} has {len(motion)} steps, no step {moment.step}")
        return motion.pose(moment.step)

    def _camera(self, scene: Scene) -> Camera:
        light = self._light(scene.touches)
        key = (None if scene.moment is None else scene.moment.motion, light, scene.size)
        if key not in self._frames:
            poses = self._framed(key[0], light)
            middle = middle_of_hand(self._rig, poses[0])
            camera = camera_on(self._avatar, poses, scene.size, edit=Edit(light=light))
            self._frames[key] = camera, middle
        return orbiting(*self._frames[key], scene.orbit, self.side == "left")

    def _framed(self, name: str | None, light: int) -> list[HandPose]:
        if name is not None:
            motion = self.motion(name, light)
            return [motion.pose(step) for step in range(len(motion))]
        first = self._firsts[light]
        poses = [first]
        for shape in ("spread", "flat", "fist"):
            fingers = gesture(self._rig, shape)[1:]
            poses.append(replace(first, rotations=torch.cat([first.rotations[:1], fingers])))
        return poses

    def _paint(self, touches: Touches) -> Paint | None:
        with self._mixing_paint:
            if touches.strokes not in self._paints:
                self._paints[touches.strokes] = self._mixed(touches.strokes)
                while len(self._paints) > _KEPT_PAINTS:
                    self._paints.popitem(last=False)
            return self._paints[touches.strokes]

    def _mixed(self, strokes: tuple[Stroke | Coat, ...]) -> Paint | None:
        paint = self.start.paint
        for stroke in strokes:
            coat = self._sent(stroke) if isinstance(stroke, Coat) else self._dab(stroke)
            paint = coat if paint is None else coat.over(paint)
        return paint

    def _sent(self, coat: Coat) -> Paint:
        paint = self._coats.get(coat.picture)
        if paint is None:
            raise SceneError(f"there is no picture {coat.picture!a}: choose its file again")
        return paint

    def _dab(self, stroke: Stroke) -> Paint:
        if stroke.anchor >= len(self._places):
            raise SceneError(
                f"anchor: expected one below {len(self._places)}, found {stroke.anchor}"
            )
        opacity = dabbed(self._places, self._normals, stroke.anchor, stroke.radius)
        return Paint(opacity.new_tensor(stroke.color).expand(len(opacity), 3), opacity)

    def _degrees(self, rotations: Float[Tensor, "bones 3"]) -> list[list[float]]:
        angles = angles_from_rotations(self._rig, rotations).rad2deg()
        angles[0] = 0
        return [[round(value, 3) for value in row] for row in angles.tolist()]


def _first_poses(avatar: HandAvatar) -> list[HandPose]:
    """Of each light: the wrist as its clip saw it, the fingers as the first clip did."""
    poses = [start_of(avatar.view(Edit(light=light))) for light in range(avatar.num_lights)]
    fingers = poses[0].rotations[1:]
    return [replace(pose, rotations=torch.cat([pose.rotations[:1], fingers])) for pose in poses]


def orbiting(
    camera: Camera, middle: Float[Tensor, "3"], orbit: Orbit, is_mirrored: bool = False
) -> Camera:
    """A camera moved around a point, its picture zoomed and shifted.

    Args:
        camera: where it is by default.
        middle: of the hand, world, metres.
        orbit: as a person sees it.
        is_mirrored: the person sees the mirror image of the camera's picture.
    """
    sign = -1.0 if is_mirrored else 1.0
    if orbit.azimuth or orbit.elevation:
        rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
        # In the camera's axes: to walk to the right is to turn the hand to the left.
        about_vertical = torch.tensor([0.0, -sign * orbit.azimuth, 0.0])
        about_horizontal = torch.tensor([-orbit.elevation, 0.0, 0.0])
        turn = matrix_from_axis_angle(about_horizontal) @ matrix_from_axis_angle(about_vertical)
        center = rotation @ middle + translation
        moved = torch.eye(4)
        moved[:3, :3] = turn @ rotation
        moved[:3, 3] = turn @ (translation - center) + center
        camera = replace(camera, camera_from_world=moved)
    if orbit.zoom != 1 or any(orbit.shift):
        x, y = (
            half + (at - half) * orbit.zoom + shift * 2 * half
            for at, half, shift in (
                (camera.center[0], camera.width / 2, sign * orbit.shift[0]),
                (camera.center[1], camera.height / 2, orbit.shift[1]),
            )
        )
        focal = (camera.focal[0] * orbit.zoom, camera.focal[1] * orbit.zoom)
        camera = replace(camera, focal=focal, center=(x, y))
    return camera


def size_at(stage: str, size: int) -> int:
    """Pixels along a side at a stage of the field's pictures."""
    return size if stage == STAGES[-1] else size // 2


def refined_picture(
    avatar: HandAvatar,
    shot: Shot,
    layer: str,
    stage: str,
    settings: RenderSettings,
    is_stale: Callable[[], bool],
) -> Pixels:
    """A layer by the field, or the mesh without jags; mirrored back if it is a left hand.

    Args:
        avatar: whose.
        shot: of :func:`size_at`.
        layer: one of ``LAYERS``, or ``UNSEEN``.
        stage: ``half`` or ``full``.
        settings: of the stage ``full``.
        is_stale: asked every few milliseconds whether to go on.

    Raises:
        Interrupted: as soon as it is stale.
    """
    if layer == "mesh":
        return mesh_picture(posed_vertices(avatar, shot), avatar, shot, 2)
    if stage != STAGES[-1]:
        settings = replace(settings, num_samples=settings.num_samples // 2 or 1, edge_rays=1)
    rendering = rendered(avatar, shot, settings, is_stale)
    return layer_picture(rendering, str(avatar.info.get("side", "right")), layer)


def layer_picture(rendering: Rendering, side: str, layer: str) -> Pixels:
    """A layer of a rendering; mirrored back if it is a left hand.

    Args:
        rendering: by the field or from the mesh, of the shot's edit.
        side: ``left`` or ``right``.
        layer: one of ``LAYERS`` but ``mesh``, or ``UNSEEN``: the tint is in the shot's edit.
    """
    return pass_pictures(rendering, side)["rgb" if layer == UNSEEN else layer]


def rendered(
    avatar: HandAvatar, shot: Shot, settings: RenderSettings, is_stale: Callable[[], bool]
) -> Rendering:
    """:meth:`HandAvatar.render` of a shot, which ends as soon as it is stale.

    Raises:
        Interrupted: then.
    """
    with _interruptible(avatar, is_stale):
        return avatar.render(shot.pose, shot.camera, shot.edit, settings)


def mesh_picture(
    vertices: Float[Tensor, "vertices 3"], avatar: HandAvatar, shot: Shot, samples: int
) -> Pixels:
    """The posed mesh in grey, of so many samples a pixel's side; mirrored back if it is a left one.

    Args:
        vertices: of the shot's pose.
        avatar: whose.
        shot: its camera counts.
        samples: one is fast.
    """
    camera = shot.camera.to(vertices.device)
    with torch.no_grad():
        pixels = eight_bits(shaded_mesh(vertices, avatar.rig.faces, camera, samples).cpu()).numpy()
    is_left = avatar.info.get("side") == "left"
    return np.ascontiguousarray(pixels[:, ::-1]) if is_left else pixels


def posed_vertices(avatar: HandAvatar, shot: Shot) -> Float[Tensor, "vertices 3"]:
    """Of the personal hand in the shot's pose, metres, world."""
    pose = shot.pose.to(avatar.device)
    with torch.no_grad():
        return avatar.personal(pose).posed(pose).vertices


def encoded(pixels: UInt8[np.ndarray, "height width 3"], kind: str) -> bytes:
    """A picture file: ``PNG`` without loss, or ``JPEG`` at once."""
    buffer = io.BytesIO()
    options = {"quality": 92} if kind == "JPEG" else {}
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


@contextmanager
def _interruptible(avatar: HandAvatar, is_stale: Callable[[], bool]) -> Iterator[None]:
    """While it lasts, evaluations of the avatar's occupancy end soon after they are stale."""

    def stop_if_stale(*_: object) -> None:
        if is_stale():
            raise Interrupted

    # The last network of the decoder runs once for each few hundred points.
    handle = avatar.occupancy.decoder.mlp.register_forward_pre_hook(stop_if_stale)
    try:
        yield
    finally:
        handle.remove()
