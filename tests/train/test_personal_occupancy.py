"""The decoder learns a person's hand before the first step, and nothing else moves."""

import torch
from conftest import bent_pose
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.geometry.meshes import is_inside
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.train.labelled_poses import training_points
from handavatar.train.personal_occupancy import fit_occupancy
from handavatar.train.prior import load_prior

POSES = [bent_pose(step) for step in range(3)]


def _avatar(swelling: float = 0.0) -> HandAvatar:
    """The shipped prior on a hand whose offsets, metres, no shape coefficients give."""
    torch.manual_seed(0)
    avatar = HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=64)
    load_prior(avatar.occupancy)
    with torch.no_grad():
        avatar.shape.mlp.output.weight.mul_(1000 * swelling)
    return avatar


@torch.no_grad()
def _error(avatar: HandAvatar, pose: HandPose) -> float:
    """Cross entropy of the field on points near the personal surface."""
    posed = avatar.personal(pose).posed(pose)
    generator = torch.Generator().manual_seed(11)
    points = training_points(avatar.parts, posed, 4000, avatar.occupancy.margin, generator)
    labels = is_inside(posed.sealed_vertices, avatar.rig.sealed_faces, points)
    codes = avatar.occupancy.encode(avatar.parts, posed)
    whole = avatar.occupancy(codes, points).whole.clamp(1e-6, 1 - 1e-6)
    return float(torch.nn.functional.binary_cross_entropy(whole, labels.to(whole)))


def _decoder(avatar: HandAvatar) -> dict[str, Tensor]:
    return {n: v.detach().clone() for n, v in avatar.occupancy.decoder.state_dict().items()}


def test_the_field_fits_the_personal_surface_better_in_unseen_poses_too() -> None:
    avatar = _avatar(swelling=0.1)
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    unseen = bent_pose(5)
    errors = [_error(avatar, POSES[0]), _error(avatar, unseen)]
    fit_occupancy(avatar, POSES, steps=60, seed=0)
    assert _error(avatar, POSES[0]) < 0.8 * errors[0]
    assert _error(avatar, unseen) < 0.8 * errors[1]
    changed = {n for n, v in avatar.state_dict().items() if not torch.equal(v, before[n])}
    assert changed == {name for name in before if name.startswith("occupancy.decoder.")}
    assert all(parameter.grad is None for parameter in avatar.parameters())


def test_the_same_seed_gives_the_same_bits_and_no_steps_change_nothing() -> None:
    results = []
    for steps, seed in ((2, 3), (2, 3), (2, 4), (0, 3)):
        avatar = _avatar()
        fit_occupancy(avatar, POSES, steps, seed)
        results.append(_decoder(avatar))
    same, different, none = (
        all(torch.equal(results[0][name], other[name]) for name in other) for other in results[1:]
    )
    assert same and not different and not none
    untrained = _decoder(_avatar())
    assert all(torch.equal(untrained[name], results[3][name]) for name in untrained)
