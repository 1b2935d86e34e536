"""Poses of one hand carried over to another whose rest pose differs.

A pose counts from a rest pose, so that the same numbers bend two hands differently. What is kept
here is where bones point in the world: every bone has a frame of three unit axes (flexion,
abduction, twist), and the target's frames are turned to where the source's are.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.hand.pose import BONE_PARENTS, FINGER_BONES, NUM_BONES
from handavatar.hand.rig import Rig

_INDEX, _MIDDLE, _LITTLE = (FINGER_BONES[name][0] for name in ("index", "middle", "little"))


def palm_frame(
    wrist: Float[Tensor, "3"],
    index: Float[Tensor, "3"],
    middle: Float[Tensor, "3"],
    little: Float[Tensor, "3"],
) -> Float[Tensor, "3 3"]:
    """Axes of a palm as rows: from the middle knuckle to the wrist, out of its back, to the thumb.

    Args:
        wrist: joint, metres.
        index: first joint of this finger, and so are the others.
        middle: metres.
        little: metres.
    """
    along = torch.nn.functional.normalize(wrist - middle, dim=-1)
    across = index - little
    thumbwards = torch.nn.functional.normalize(across - (across @ along) * along, dim=-1)
    return torch.stack([along, torch.linalg.cross(thumbwards, along), thumbwards])


def rest_frames(rig: Rig) -> Float[Tensor, "bones 3 3"]:
    """Axes of every bone of a rig at rest, as rows, in double precision.

    The wrist's are those of the palm, a finger's first two bones' the axes of their joints. The
    last bone has those of the one before it: tips lie within the flesh in one rig and on the skin
    in another, which would bend the last joint by some degrees.
    """
    joints = rig.shaped().rest_joints.double()
    frames = rig.joint_axes.double().clone()
    frames[0] = palm_frame(joints[0], joints[_INDEX], joints[_MIDDLE], joints[_LITTLE])
    for _, second, third in FINGER_BONES.values():
        frames[third] = frames[second]
    return frames


def chain_rotations(
    rotations: Float[Tensor, "*batch bones 3 3"],
) -> Float[Tensor, "*batch bones 3 3"]:
    """Rotations of bones from rest into the world, of those relative to the parents."""
    world: list[Tensor] = []
    for bone in range(NUM_BONES):
        own = rotations[..., bone, :, :]
        world.append(own if bone == 0 else world[BONE_PARENTS[bone]] @ own)
    return torch.stack(world, dim=-3)


def local_rotations(
    world: Float[Tensor, "*batch bones 3 3"],
) -> Float[Tensor, "*batch bones 3 3"]:
    """Inverse of :func:`chain_rotations`."""
    parents = world[..., [max(parent, 0) for parent in BONE_PARENTS], :, :].clone()
    parents[..., 0, :, :] = torch.eye(3, dtype=world.dtype, device=world.device)
    return parents.mT @ world


def retarget(
    rotations: Float[Tensor, "*batch bones 3 3"],
    source: Float[Tensor, "bones 3 3"],
    target: Float[Tensor, "bones 3 3"],
) -> Float[Tensor, "*batch bones 3 3"]:
    """Rotations of the target's bones that turn its frames to where the source's are.

    Lengths of bones are not looked at: fingertips come to lie elsewhere by as much as the hands
    differ in size and proportions, and fingertips that touched may not touch.

    Args:
        rotations: of the source's bones, relative to the parent, the wrist's to the world.
        source: axes of its bones at rest as rows, see :func:`rest_frames`.
        target: those of the hand that is to take the pose.
    """
    return local_rotations(chain_rotations(rotations) @ (source.mT @ target))
