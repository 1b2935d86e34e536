"""``handavatar export``: an avatar as files that other programs open."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from handavatar import __version__
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import Motion, gesture, open_motion
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.errors import ArgumentError, require_ranges
from handavatar.export.baking import baked_textures, colors_at_vertices
from handavatar.export.gltf import glb_bytes
from handavatar.export.lightweight import lightweight_hand
from handavatar.export.polygons import obj_bytes, ply_bytes
from handavatar.export.rigged import MIRROR, skinned_mesh
from handavatar.export.skeletons import BoneNames
from handavatar.export.surface import average_hand, textured_hand
from handavatar.export.web import web_files
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import (
    FolderKind,
    UnfinishedFolder,
    files_named,
    refuse_file_in_use,
    refuse_folder_in_use,
    write_atomically,
)
from handavatar.jobs.progress import SILENT, Progress
from handavatar.retouch import Look

MAX_TEXTURE = 8192
WEB_PAGE = FolderKind("web page", ("index.html", "loss.json"))


@dataclass(frozen=True)
class ExportOptions(Look):
    """An avatar as files that other programs open.

    Attributes:
        run: run folder, or an avatar file.
        format: ``glb`` has bones, skin weights and textures; ``ply`` (a colour per vertex) and
            ``obj`` (with .mtl and .png beside it) are the surface in one pose; ``web`` is a page
            with light that follows the pose, for any browser.
        out: file to write; for ``web`` a folder, which must be new or empty.
        bones: names of the joints in a GLB, and how they are arranged: ``webxr`` is the flat
            skeleton of 25 joints that three.js's XRHandMeshModel drives, the others are trees.
        texture_size: texels along a side of the albedo; the occlusion texture has half.
        motion: a motion file (JSON) or a built-in motion (gestures, count, grasp, pinch, ripple,
            turn) that a GLB carries as an animation, and a page plays.
        pose: a gesture (flat, relaxed, fist, point, ...) that PLY and OBJ show.
        unlit: colours with the mean light baked in, and no engine's light on them.
        overwrite: replace what lies at ``out``; of folders only a page written by this program.
    """

    run: Path
    format: Literal["glb", "ply", "obj", "web"]
    out: Path
    bones: BoneNames = "webxr"
    texture_size: int = 1024
    motion: str | None = None
    pose: str = "flat"
    unlit: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        super().__post_init__()
        require_ranges(self, texture_size=(16, MAX_TEXTURE))


def export_avatar(options: ExportOptions, progress: Progress = SILENT) -> Path:
    """Writes the files, aside first.

    Args:
        options: what to write.
        progress: told how far it is.

    Returns:
        The file or folder that was asked for.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if the motion or the paint cannot be read, or there is no such gesture.
        ValueError: for options that contradict each other.
        FolderInUse: if a file is there already, or the folder of a page holds something that may
            not be replaced.
    """
    options.check_look()
    _check(options)
    avatar = HandAvatar.load(options.run)
    edit = options.edit_on(avatar)
    if options.format == "web":
        _write_web(avatar, edit, options, progress)
        return options.out
    if options.format == "glb":
        contents = [_glb(avatar, edit, options)]
    elif options.format == "ply":
        contents = [_ply(avatar, edit, options)]
    else:
        contents = _obj(avatar, edit, options)
    write_atomically(dict(zip(_files(options), contents, strict=True)))
    return options.out


def _check(options: ExportOptions) -> None:
    """Refuses what contradicts itself, before anything is read."""
    if options.format == "web":
        if options.pose != "flat" or options.unlit:
            name = "pose" if options.pose != "flat" else "unlit"
            raise ArgumentError(name, "a page begins in the capture's pose, and is lit")
        refuse_folder_in_use(options.out, WEB_PAGE, options.overwrite, _inputs(options))
        return
    if options.out.suffix.lower() != f".{options.format}":
        raise ArgumentError("out", str(options.out), f"a name that ends in .{options.format}")
    if options.format == "glb" and options.pose != "flat":
        raise ArgumentError("pose", "a GLB is in its rest pose; animate it with `motion`")
    if options.format != "glb" and options.motion is not None:
        raise ArgumentError(
            "motion", f"{options.format.upper()} cannot move; choose glb, or `pose`"
        )
    for path in _files(options):
        refuse_file_in_use(path, options.overwrite, _inputs(options))


def _inputs(options: ExportOptions) -> list[Path]:
    """What is read: the folder that is written may not hold it."""
    return [options.run, *files_named(options.motion, options.paint)]


def _files(options: ExportOptions) -> list[Path]:
    beside = (".png", ".mtl") if options.format == "obj" else ()
    return [*(options.out.with_suffix(suffix) for suffix in beside), options.out]


def _glb(avatar: HandAvatar, edit: Edit, options: ExportOptions) -> bytes:
    motion = _motion(avatar, edit, options)
    size = options.texture_size
    mesh = skinned_mesh(avatar, edit, options.bones, size, motion, options.unlit)
    return glb_bytes(mesh, f"handavatar {__version__}")


def _motion(avatar: HandAvatar, edit: Edit, options: ExportOptions) -> Motion | None:
    if options.motion is None:
        return None
    return open_motion(options.motion, avatar.base_rig, start_of(avatar.view(edit)))


def _write_web(avatar: HandAvatar, edit: Edit, options: ExportOptions, progress: Progress) -> None:
    motion = _motion(avatar, edit, options)
    light = lightweight_hand(avatar, edit, progress)
    folder = UnfinishedFolder(options.out, WEB_PAGE, {"format": "web"}, _inputs(options))
    try:
        folder.begin(options.overwrite)
        for name, content in web_files(avatar, light, edit, motion).items():
            folder.write(name, content)
        folder.finish()
    except BaseException:
        folder.abandon()
        raise


def _surface(avatar: HandAvatar, options: ExportOptions) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices and normals of the personal hand in the pose, and faces; of the hand's own side."""
    pose = HandPose(gesture(avatar.base_rig, options.pose), torch.zeros(3))
    with torch.no_grad():
        vertices = avatar.personal(pose).posed(pose).vertices
    faces = avatar.rig.faces
    normals = vertex_normals(vertices, faces)
    if avatar.info.get("side") == "left":
        flip = vertices.new_tensor(MIRROR)
        return vertices * flip, normals * flip, faces.flip(-1)
    return vertices, normals, faces


def _ply(avatar: HandAvatar, edit: Edit, options: ExportOptions) -> bytes:
    hand = average_hand(avatar)
    vertices, normals, faces = _surface(avatar, options)
    colors = colors_at_vertices(avatar, hand, edit, options.unlit)
    return ply_bytes(vertices, normals, colors, faces, ("metres, +y up; colours are sRGB",))


def _obj(avatar: HandAvatar, edit: Edit, options: ExportOptions) -> list[bytes]:
    hand = textured_hand(avatar)
    rig = hand.rig
    vertices, normals, faces = _surface(avatar, options)
    places = rig.uv_faces.flip(-1) if avatar.info.get("side") == "left" else rig.uv_faces
    texts = obj_bytes(vertices, normals, rig.uv_coordinates, faces, places, options.out.stem)
    textures = baked_textures(avatar, hand, edit, options.texture_size, options.unlit, False)
    return [textures.base_color, texts.material, texts.mesh]
