"""Skeletons as others know them."""

import pytest
import torch

from handavatar.export.skeletons import skeleton_of
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.pose import BONE_NAMES, BONE_PARENTS, FINGER_BONES, NUM_BONES
from handavatar.hand.rig import Rig

# As XRHandMeshModel of three.js looks for them, and as the WebXR Hand Input module lists them.
XR_JOINTS = [
    "wrist",
    *(f"thumb-{part}" for part in ("metacarpal", "phalanx-proximal", "phalanx-distal", "tip")),
    *(
        f"{finger}-finger-{part}"
        for finger in ("index", "middle", "ring", "pinky")
        for part in (
            "metacarpal",
            "phalanx-proximal",
            "phalanx-intermediate",
            "phalanx-distal",
            "tip",
        )
    ),
]


def test_webxr_joints_have_their_names_and_stand_on_their_own(rig: Rig) -> None:
    skeleton = skeleton_of(rig.shaped(), "webxr")
    assert list(skeleton.names) == XR_JOINTS
    assert set(skeleton.parents) == {-1}


def test_webxr_joints_look_at_the_next_one_with_the_back_of_the_hand_up(rig: Rig) -> None:
    hand = rig.shaped()
    skeleton = skeleton_of(hand, "webxr")
    turn = skeleton.file_from_rest[:3, :3].float()
    normals = vertex_normals(hand.rest_vertices, rig.faces)
    axes, places = skeleton.file_from_joint[:, :3, :3], skeleton.file_from_joint[:, :3, 3]
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).double().expand_as(axes))
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(25).double())
    # A hand whose wrist is not turned points along -z, its back up, a right one's thumb left.
    torch.testing.assert_close(axes[0], torch.eye(3).double())
    middle, thumb = XR_JOINTS.index("middle-finger-tip"), XR_JOINTS.index("thumb-tip")
    assert float(places[middle, 2] - places[0, 2]) < -0.1
    assert float(places[thumb, 0]) < -0.03
    for joint, name in enumerate(XR_JOINTS):
        if name == "wrist" or name.endswith("tip"):
            continue
        ahead = torch.nn.functional.normalize(places[joint + 1] - places[joint], dim=0)
        torch.testing.assert_close(-axes[joint, :, 2], ahead)
    for finger, word in (("thumb", "thumb"), ("index", "index-finger"), ("little", "pinky-finger")):
        nail = turn @ normals[rig.vertex_sets[f"nail_{finger}"]].mean(0)
        for part in ("phalanx-distal", "tip"):
            up = axes[XR_JOINTS.index(f"{word}-{part}"), :, 1].float()
            assert float(up @ nail / nail.norm()) > 0.75, (word, part)


def test_metacarpals_of_webxr_lie_near_the_wrist(rig: Rig) -> None:
    """Three tenths of the way to the knuckle; the thumb's is its first joint."""
    skeleton = skeleton_of(rig.shaped(), "webxr")
    places = skeleton.file_from_joint[:, :3, 3]
    for finger in ("index", "middle", "ring", "pinky"):
        joint = XR_JOINTS.index(f"{finger}-finger-metacarpal")
        expected = 0.7 * places[0] + 0.3 * places[joint + 1]
        torch.testing.assert_close(places[joint], expected)


def test_every_bone_is_carried_once_by_a_joint_at_its_place(rig: Rig) -> None:
    hand = rig.shaped()
    for names in ("webxr", "mano", "vrm", "unity"):
        skeleton = skeleton_of(hand, names)
        assert len(set(skeleton.carriers)) == NUM_BONES
        assert [skeleton.bones[joint] for joint in skeleton.carriers] == list(range(NUM_BONES))
        at = skeleton.file_from_joint[list(skeleton.carriers), :3, 3]
        rotation = skeleton.file_from_rest[:3, :3]
        torch.testing.assert_close(at, hand.rest_joints.double() @ rotation.T)


@pytest.mark.parametrize(
    ("names", "side", "expected"),
    [
        ("mano", "right", {0: "right_wrist", 7: "right_pinky1", 13: "right_thumb1"}),
        ("vrm", "left", {0: "leftHand", 13: "leftThumbMetacarpal", 2: "leftIndexIntermediate"}),
        ("unity", "right", {0: "RightHand", 13: "RightThumbProximal", 9: "RightLittleDistal"}),
    ],
)
def test_trees_have_our_bones_under_their_names(
    rig: Rig, names: str, side: str, expected: dict[int, str]
) -> None:
    skeleton = skeleton_of(rig.shaped(), names, side)  # type: ignore[arg-type]
    assert skeleton.parents == BONE_PARENTS
    assert {bone: skeleton.names[bone] for bone in expected} == expected
    assert len(set(skeleton.names)) == NUM_BONES
    for finger, members in FINGER_BONES.items():
        word = {"mano": {"little": "pinky"}.get(finger, finger)}.get(names, finger)
        for bone in members:
            assert word in skeleton.names[bone].lower(), BONE_NAMES[bone]
