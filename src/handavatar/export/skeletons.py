"""Skeletons as engines and standards know them: names, places and axes of their joints.

Our sixteen bones carry the hand; a skeleton says which of its joints follows which bone.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.rotations import rigid_transform
from handavatar.hand.pose import BONE_PARENTS, FINGER_BONES, NUM_BONES
from handavatar.hand.rig import ShapedHand

BoneNames = Literal["webxr", "mano", "vrm", "unity"]

METACARPAL_SHARE = 0.3
"""WebXR's metacarpal joints of the four fingers lie so far on the way from wrist to knuckle."""

_WEBXR_FINGERS = {
    "thumb": "thumb",
    "index": "index-finger",
    "middle": "middle-finger",
    "ring": "ring-finger",
    "little": "pinky-finger",
}
# What follows the side in the names of the wrist and of each finger's three joints.
_TREES: dict[str, dict[str, tuple[str, ...]]] = {
    "mano": {
        "wrist": ("_wrist",),
        **{
            finger: tuple(f"_{name}{number}" for number in (1, 2, 3))
            for finger, name in (
                ("thumb", "thumb"),
                ("index", "index"),
                ("middle", "middle"),
                ("ring", "ring"),
                ("little", "pinky"),
            )
        },
    },
    "vrm": {
        "wrist": ("Hand",),
        "thumb": ("ThumbMetacarpal", "ThumbProximal", "ThumbDistal"),
        **{
            finger.lower(): tuple(f"{finger}{p}" for p in ("Proximal", "Intermediate", "Distal"))
            for finger in ("Index", "Middle", "Ring", "Little")
        },
    },
    "unity": {
        "wrist": ("Hand",),
        **{
            finger.lower(): tuple(f"{finger}{p}" for p in ("Proximal", "Intermediate", "Distal"))
            for finger in ("Thumb", "Index", "Middle", "Ring", "Little")
        },
    },
}


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a right hand in its zero pose.

    Attributes:
        names: of the joints.
        parents: joint that each hangs on; -1 hangs on the hand as a whole.
        bones: our bone that each joint follows.
        carriers: the joint that takes over the skin of each of our bones; the others move none.
        file_from_rest: from the rest frame to the file's: a rotation.
        file_from_joint: places (metres) and axes of the joints in the zero pose.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    bones: tuple[int, ...]
    carriers: tuple[int, ...]
    file_from_rest: Float[Tensor, "4 4"]
    file_from_joint: Float[Tensor, "joints 4 4"]


def skeleton_of(hand: ShapedHand, names: BoneNames, side: str = "right") -> Skeleton:
    """The skeleton of a right hand, float64.

    ``webxr`` is flat: 25 joints, none on top of another, each looking along -z at the next one
    with +y out of the back of the hand; in the file the hand points along -z. The others are trees
    of sixteen joints with the axes of the rest frame, which is the file's as well: a joint's
    rotation is a bone's rotation of a :class:`~handavatar.hand.pose.HandPose`.

    Args:
        hand: in the zero pose, one hand.
        names: of whose joints.
        side: what the names of a tree say; the geometry is a right hand's in any case.
    """
    return _flat(hand) if names == "webxr" else _tree(hand, names, side)


def _tree(hand: ShapedHand, names: BoneNames, side: str) -> Skeleton:
    words = _TREES[names]
    bones = {"wrist": (0,), **FINGER_BONES}
    start = side.capitalize() if names == "unity" else side
    named = [""] * NUM_BONES
    for part, members in bones.items():
        for bone, word in zip(members, words[part], strict=True):
            named[bone] = start + word
    joints = hand.rest_joints.double()
    axes = torch.eye(3, dtype=torch.float64).expand(NUM_BONES, 3, 3)
    each = tuple(range(NUM_BONES))
    here = torch.eye(4, dtype=torch.float64)
    return Skeleton(tuple(named), BONE_PARENTS, each, each, here, rigid_transform(axes, joints))


def _flat(hand: ShapedHand) -> Skeleton:
    joints = hand.rest_joints.double()
    axes = hand.rig.joint_axes.double()
    # The rest frame's fingers, back and thumb side: -x, +y, +z; here -z, +y, -x.
    turn = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
    file_from_rest = rigid_transform(turn, torch.zeros(3, dtype=torch.float64))
    names, bones = ["wrist"], [0]
    # Its axes are the hand's own, so that the wrist's rotation is zero in the file.
    rest_from_joint = [rigid_transform(turn.T, joints[0])]
    for finger, members in FINGER_BONES.items():
        chain = [joints[bone] for bone in members] + [_fingertip(hand, members[-1])]
        followed = [*members, members[-1]]
        phalanges = ["metacarpal", "phalanx-proximal", "phalanx-distal", "tip"]
        if finger != "thumb":
            phalanges.insert(2, "phalanx-intermediate")
            knuckle = joints[members[0]]
            chain.insert(0, joints[0] + METACARPAL_SHARE * (knuckle - joints[0]))
            followed.insert(0, 0)
        dorsal = [axes[bone, 1] for bone in ([members[0]] * (len(chain) - 4) + followed[-4:])]
        for number, place in enumerate(chain):
            ahead = min(number, len(chain) - 2)
            along = chain[ahead + 1] - chain[ahead]
            rest_from_joint.append(rigid_transform(_looking(along, dorsal[number]), place))
            names.append(f"{_WEBXR_FINGERS[finger]}-{phalanges[number]}")
        bones += followed
    is_own = [name == "wrist" or "phalanx" in name or name == "thumb-metacarpal" for name in names]
    own = [joint for joint, has_skin in enumerate(is_own) if has_skin]
    carriers = tuple(next(j for j in own if bones[j] == bone) for bone in range(NUM_BONES))
    return Skeleton(
        tuple(names),
        (-1,) * len(names),
        tuple(bones),
        carriers,
        file_from_rest,
        file_from_rest @ torch.stack(rest_from_joint),
    )


def _looking(along: Float[Tensor, "3"], dorsal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Axes with -z along a direction and +y as near as can be to another."""
    back = -torch.nn.functional.normalize(along, dim=0)
    up = torch.nn.functional.normalize(dorsal - (dorsal @ back) * back, dim=0)
    return torch.stack([torch.linalg.cross(up, back), up, back], dim=-1)


def _fingertip(hand: ShapedHand, bone: int) -> Float[Tensor, "3"]:
    """The farthest place of a finger's last part along its bone, metres."""
    own = hand.rest_vertices[hand.rig.skin_weights.argmax(-1) == bone].double()
    return own[(own @ hand.rig.joint_axes[bone, 2].double()).argmax()]
