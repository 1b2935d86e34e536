"""Shape and poses are drawn to the outlines, and nothing else moves."""

import pytest
import torch
from conftest import bent_pose, camera_above

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.render.rasterize import rasterize
from handavatar.train.corrections import PoseCorrections
from handavatar.train.outlines import EdgeSet, fit_outlines

SIZE = 64


def _frames(scale: float, shift: float) -> list[Frame]:
    """Masks of a hand with fingers of another thickness; poses are off by a shift (metres)."""
    frames = []
    for number in range(5):
        pose, camera = bent_pose(number), camera_above(SIZE)
        posed = load_open_hand("778").shaped().posed(pose)
        centre = posed.vertices.mean(0)
        mask = rasterize(centre + scale * (posed.vertices - centre), posed.rig.faces, camera).mask
        frames.append(
            Frame(
                name=f"{number}",
                image=torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8),
                coverage=mask.byte() * 255,
                camera=camera,
                pose=HandPose(pose.rotations, pose.translation + torch.tensor([shift, 0, 0])),
                confidence=0.9,
                split="train",
                time=0.1 * number,
            )
        )
    return frames


def _avatar() -> HandAvatar:
    torch.manual_seed(0)
    return HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=64)


def _mean_iou(avatar: HandAvatar, poses: list[HandPose], frames: list[Frame]) -> float:
    overlaps = []
    with torch.no_grad():
        for pose, frame in zip(poses, frames, strict=True):
            posed = avatar.coarse_personal(pose).posed(pose)
            covered = rasterize(posed.vertices, posed.rig.faces, frame.camera).mask
            overlaps.append(int((covered & frame.mask).sum()) / int((covered | frame.mask).sum()))
    return sum(overlaps) / len(overlaps)


@pytest.mark.slow
def test_the_shape_grows_into_larger_masks() -> None:
    avatar, frames = _avatar(), _frames(1.05, 0.0)
    poses = [frame.pose for frame in frames]
    others = {n: v.clone() for n, v in avatar.state_dict().items() if not n.startswith("shape.")}
    before = _mean_iou(avatar, poses, frames)
    fit_outlines(avatar, None, frames, rounds=1, visits=20, size=SIZE, seed=0)
    assert _mean_iou(avatar, poses, frames) > before + 0.4 * (1 - before)
    for name, value in others.items():
        assert torch.equal(avatar.state_dict()[name], value), name
    assert all(parameter.grad is None for parameter in avatar.parameters())


def test_wrong_poses_are_corrected_before_the_shape_bends() -> None:
    avatar, frames = _avatar(), _frames(1.0, 0.004)
    corrections = PoseCorrections(len(frames))
    fit_outlines(avatar, corrections, frames, rounds=1, visits=1, size=SIZE, seed=0)
    with torch.no_grad():
        moved = [float(value[0]) for value in corrections.translations]
        poses = [corrections(number, frame.pose) for number, frame in enumerate(frames)]
    # Half or twice: depth, and a turn of the wrist, can stand in for some of the shift.
    assert all(-0.008 < value < -0.002 for value in moved)
    assert _mean_iou(avatar, poses, frames) > 0.96


def test_the_same_seed_gives_the_same_bits_and_no_rounds_change_nothing() -> None:
    results = []
    for rounds, seed in ((1, 3), (1, 3), (1, 4), (0, 3)):
        avatar = _avatar()
        fit_outlines(avatar, None, _frames(1.03, 0.0), rounds, 2, 32, seed)
        results.append(avatar.shape.mlp.output.weight.detach().clone())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])
    assert torch.equal(results[3], _avatar().shape.mlp.output.weight.detach())


def test_spacing_is_the_mean_length_of_the_edges() -> None:
    rig = load_open_hand("778")
    found = EdgeSet.of(rig)
    total = [
        float((rig.template_vertices[a] - rig.template_vertices[b]).norm())
        for a, b in found.edges.tolist()
    ]
    assert found.spacing == pytest.approx(sum(total) / len(total), rel=1e-5)
