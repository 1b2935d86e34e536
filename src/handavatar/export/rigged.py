"""The avatar as engines take it: a skinned, textured mesh with the joints of a chosen skeleton."""

from dataclasses import replace
from typing import Any

import torch

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import Motion
from handavatar.edit import Edit
from handavatar.export.baking import NUM_LIGHT_POSES, baked_textures
from handavatar.export.gltf import Clip, SkinnedMesh
from handavatar.export.skeletons import BoneNames, Skeleton, skeleton_of
from handavatar.export.surface import rest_shape_error, split_at_seams, textured_hand
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import (
    apply_rigid,
    invert_rigid,
    mirror_rigid,
    rigid_transform,
)
from handavatar.hand.pose import bone_transforms
from handavatar.hand.rig import ShapedHand
from handavatar.hand.sparse_skin import SparseSkin

MIRROR = (-1.0, 1.0, 1.0)
"""A left hand is a right one mirrored in x, as files and pictures have it."""


def skinned_mesh(
    avatar: HandAvatar,
    edit: Edit | None = None,
    bones: BoneNames = "webxr",
    texture_size: int = 1024,
    motion: Motion | None = None,
    is_unlit: bool = False,
    light_poses: int = NUM_LIGHT_POSES,
) -> SkinnedMesh:
    """The avatar as engines take it: one rest shape, four bones a vertex, textures.

    Args:
        avatar: on the CPU; its own edit is in the textures.
        edit: on top of that.
        bones: names and arrangement of the joints.
        texture_size: texels along a side.
        motion: becomes the animation; its first wrist is moved to where the hand lies in the file,
            and the axes are those of the avatar's typical view, so that who looks along -z sees
            what ``handavatar render`` shows.
        is_unlit: bake the mean light into the colours, for materials that no light changes.
        light_poses: that the mean light is taken over.
    """
    edit = edit or Edit()
    side = str(avatar.info.get("side", "right"))
    hand = textured_hand(avatar)
    rig = hand.rig
    textures = baked_textures(avatar, hand, edit, texture_size, is_unlit, light_poses=light_poses)
    skeleton = skeleton_of(hand, bones, side)
    seamed = split_at_seams(rig)
    skin = SparseSkin.of(rig.skin_weights, avatar.base_rig, avatar.rounds)
    carriers = torch.tensor(skeleton.carriers)
    joints = torch.where(skin.shares > 0, carriers[skin.bones], 0)
    turn = skeleton.file_from_rest[:3, :3].float()
    normals = vertex_normals(hand.rest_vertices, rig.faces)
    clip = None if motion is None else _clip(avatar, hand, skeleton, motion, edit)
    mesh = SkinnedMesh(
        name="hand",
        vertices=(hand.rest_vertices @ turn.T)[seamed.sources],
        normals=(normals @ turn.T)[seamed.sources],
        places=seamed.places,
        faces=seamed.faces,
        joints=joints[seamed.sources],
        shares=skin.shares[seamed.sources],
        joint_names=skeleton.names,
        parents=skeleton.parents,
        file_from_joint=skeleton.file_from_joint,
        base_color=textures.base_color,
        occlusion=textures.occlusion,
        is_unlit=is_unlit,
        clip=clip,
        facts=_facts(avatar, hand, bones, textures.full_light),
    )
    return mirrored(mesh) if side == "left" else mesh


def mirrored(mesh: SkinnedMesh) -> SkinnedMesh:
    """The other hand: mirrored in x, its faces wound outwards again, joints still rigid."""
    flip = mesh.vertices.new_tensor(MIRROR)
    clip = mesh.clip
    if clip is not None:
        clip = replace(clip, file_from_joint=mirror_rigid(clip.file_from_joint))
    return replace(
        mesh,
        vertices=mesh.vertices * flip,
        normals=mesh.normals * flip,
        faces=mesh.faces.flip(-1),
        file_from_joint=mirror_rigid(mesh.file_from_joint),
        clip=clip,
    )


def _clip(
    avatar: HandAvatar, hand: ShapedHand, skeleton: Skeleton, motion: Motion, edit: Edit
) -> Clip:
    """Joints follow their bones through a motion, float64."""
    joints = hand.rest_joints.double()
    world_from_bone = bone_transforms(motion.rotations.double(), joints)
    world_from_bone[..., :3, 3] += motion.translations.double()[:, None]
    axes = torch.eye(3, dtype=torch.float64).expand(len(joints), 3, 3)
    world_from_rest = world_from_bone @ invert_rigid(rigid_transform(axes, joints))
    rest_from_joint = invert_rigid(skeleton.file_from_rest) @ skeleton.file_from_joint
    world_from_joint = world_from_rest[:, list(skeleton.bones)] @ rest_from_joint
    turn = skeleton.file_from_rest[:3, :3]
    if (view := avatar.view(edit)) is not None:
        # From a camera that looks along +z with y down to one that looks along -z with y up.
        turn = torch.tensor(view["camera_from_world"], dtype=torch.float64)[:3, :3]
        turn = turn.new_tensor([1.0, -1.0, -1.0])[:, None] * turn
    wrist = apply_rigid(skeleton.file_from_rest, joints[:1])[0]
    file_from_world = rigid_transform(turn, wrist - turn @ world_from_bone[0, 0, :3, 3])
    return Clip("motion", motion.fps, file_from_world @ world_from_joint)


def _facts(
    avatar: HandAvatar, hand: ShapedHand, bones: BoneNames, full_light: float
) -> dict[str, Any]:
    """What the file says of itself."""
    known = ("side", "subject", "method", "licence", "color_space")
    facts = {name: avatar.info[name] for name in known if name in avatar.info}
    facts |= {"bones": bones, "rig": avatar.base_rig.name, "full_light": round(full_light, 4)}
    mean, most = (round(1000 * error, 3) for error in rest_shape_error(avatar, hand))
    facts["rest_shape_error_mm"] = {"mean": mean, "p95": most}
    if avatar.base_rig.is_licensed:
        facts["rig_licence"] = "the rig's own: mesh and weights derive from a licensed file"
    return {"handavatar": facts}
