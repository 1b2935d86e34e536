"""The decoder learns a person's hand before the first step, and nothing else moves."""

import pytest
import torch
from conftest import (
    assert_teaches_the_decoder_alone,
    assert_teaching_repeats,
    avatar_of_the_prior,
    bent_pose,
)

from handavatar.avatar import HandAvatar
from handavatar.geometry.meshes import is_inside
from handavatar.hand.pose import HandPose
from handavatar.train.labelled_poses import training_points
from handavatar.train.personal_occupancy import fit_occupancy

POSES = [bent_pose(step) for step in range(3)]


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


@pytest.mark.slow
def test_the_field_fits_the_personal_surface_better_in_unseen_poses_too() -> None:
    avatar = avatar_of_the_prior()
    with torch.no_grad():  # Offsets that no shape coefficients give.
        avatar.shape.mlp.output.weight.mul_(100)
    unseen = bent_pose(5)
    errors = [_error(avatar, POSES[0]), _error(avatar, unseen)]
    assert_teaches_the_decoder_alone(avatar, lambda: fit_occupancy(avatar, POSES, 60, seed=0))
    assert _error(avatar, POSES[0]) < 0.8 * errors[0]
    assert _error(avatar, unseen) < 0.8 * errors[1]


def test_the_same_seed_gives_the_same_bits_and_no_steps_change_nothing() -> None:
    assert_teaching_repeats(lambda avatar, steps, seed: fit_occupancy(avatar, POSES, steps, seed))
