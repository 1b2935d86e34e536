"""The hand that a page holds: fitted to the field's samples, and honest about its loss."""

from dataclasses import replace

import pytest
import torch

from handavatar.avatar import HandAvatar
from handavatar.edit import Edit, Paint
from handavatar.export.capsules import fit_capsules
from handavatar.export.correctives import fit_correctives
from handavatar.export.field_samples import FieldSamples, sample_field, sampled_poses
from handavatar.export.lightweight import (
    Effort,
    LightweightHand,
    lightweight_hand,
    stored_correctives,
    stored_network,
)
from handavatar.export.shading_network import (
    ShadingNetwork,
    fit_shading,
    shading_error,
    shown,
    surroundings,
)
from handavatar.field.anchors import nearest_anchors
from handavatar.field.shading import TracedCues
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.pose import FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_features import NUM_POSE_FEATURES, pose_features
from handavatar.hand.rig import Rig

EFFORT = Effort(poses=8, steps=60)


@pytest.fixture(scope="module")
def light(small_avatar: HandAvatar) -> LightweightHand:
    return lightweight_hand(small_avatar, Edit(), effort=EFFORT)


def _samples(avatar: HandAvatar, count: int, num_points: int = 64) -> FieldSamples:
    generator = torch.Generator().manual_seed(0)
    rotations = sampled_poses(avatar, count, generator)
    return sample_field(avatar, rotations, generator, num_points=num_points)


@torch.no_grad()
def test_samples_are_what_the_field_says(small_avatar: HandAvatar) -> None:
    samples = _samples(small_avatar, 2)
    for number, rotations in enumerate(samples.rotations):
        pose = HandPose(rotations, torch.zeros(3))
        state = small_avatar.prepare(pose)
        points = state.posed.vertices[samples.points[number]]
        near = nearest_anchors(state.anchors, points)
        around = small_avatar.occupancy(state.codes, points).soft_parts
        lifted = around.masked_fill(samples.lifted[number], 0)
        normals, none = near.interpolated(state.anchor_normals), points.new_zeros(len(points), 0)
        for seen, light in ((around, samples.light), (lifted, samples.lifted_light)):
            expected = small_avatar.illumination(rotations, near, seen, normals, none)
            torch.testing.assert_close(light[number], expected)
        own = small_avatar.personal(pose)
        torch.testing.assert_close(samples.rest_vertices[number], own.rest_vertices)
        assert samples.lifted[number].sum() == 3 * (1 + (number // 4 % 3 == 0))


@torch.no_grad()
def test_the_outline_is_where_the_occupancy_says(small_avatar: HandAvatar) -> None:
    samples = _samples(small_avatar, 2)
    rig = small_avatar.rig
    assert samples.surface[0].isnan().all()
    state = small_avatar.prepare(HandPose(samples.rotations[4], torch.zeros(3)))
    vertices = state.posed.vertices
    normals = vertex_normals(rig.sealed(vertices), rig.sealed_faces)[: rig.num_vertices]
    found = samples.surface[4]
    is_found = found.isfinite()
    assert 0.5 < is_found.float().mean() <= 1 and found[is_found].abs().max() < 4e-3
    # 0.1 mm to both sides of it: twice what six halvings of 8 mm leave.
    inside, outside = (
        small_avatar.occupancy(
            state.codes, (vertices + (found + step)[:, None] * normals)[is_found]
        ).whole
        for step in (-1e-4, 1e-4)
    )
    assert (inside > outside).float().mean() > 0.95


def test_the_edit_of_an_avatar_is_not_in_the_samples(small_avatar: HandAvatar) -> None:
    plain = _samples(small_avatar, 2)
    small_avatar.edit = Edit(2.0, (0.1, 0.0, 0.0), (13,))
    try:
        edited = _samples(small_avatar, 2)
    finally:
        small_avatar.edit = Edit()
    assert torch.equal(plain.light, edited.light)
    assert torch.equal(plain.lifted_light, edited.lifted_light)


def test_traced_light_is_sampled_with_and_without_fingers(rig: Rig) -> None:
    torch.manual_seed(1)
    avatar = HandAvatar(rig, torch.zeros(10), rounds=0, num_anchors=64, cues=TracedCues(6))
    samples = _samples(avatar, 4)
    assert samples.lifted.any(1).tolist() == [True, False, False, True]
    is_lifted = samples.lifted.any(1)
    assert (samples.light != samples.lifted_light)[is_lifted].any()
    assert torch.equal(samples.light[~is_lifted], samples.lifted_light[~is_lifted])


def _made_samples(rig: Rig, count: int) -> FieldSamples:
    """Poses whose rest shape is linear in their features, of rank three."""
    generator = torch.Generator().manual_seed(4)
    rotations = 0.5 * torch.randn(count, NUM_BONES, 3, generator=generator)
    drive = torch.randn(NUM_POSE_FEATURES, 3, generator=generator)
    shapes = 1e-3 * torch.randn(3, rig.num_vertices, 3, generator=generator)
    hand = rig.shaped()
    amounts = pose_features(rotations) @ drive / 10
    rest = hand.rest_vertices + torch.einsum("pk,kvc->pvc", amounts, shapes)
    none = torch.zeros(count, rig.num_vertices)
    points = torch.arange(rig.num_vertices).expand(count, -1)
    lifted = torch.zeros(count, NUM_BONES, dtype=torch.bool)
    lifted[:, list(FINGER_BONES["thumb"])] = True
    joints = hand.rest_joints.expand(count, -1, -1)
    return FieldSamples(rotations, rest, joints, none, points, none, lifted, none)


def test_correctives_find_shapes_that_the_pose_drives(rig: Rig) -> None:
    samples = _made_samples(rig, 900)
    is_known = torch.arange(900) < 890
    known, others = samples.chosen(is_known), samples.chosen(~is_known)
    found = stored_correctives(fit_correctives(known, rig.shaped()))
    mean = known.rest_vertices.mean(0)
    for rotations, truth in zip(others.rotations, others.rest_vertices, strict=True):
        shaped = found.shaped(rig, [], rotations)
        error = (shaped.rest_vertices - truth).norm(dim=-1).mean()
        assert float(error) < 0.1 * float((truth - mean).norm(dim=-1).mean())
        torch.testing.assert_close(shaped.rest_joints, rig.shaped().rest_joints)


def test_a_surface_off_the_mesh_moves_the_vertices_along_their_normals(rig: Rig) -> None:
    samples = _made_samples(rig, 40)
    still = replace(
        samples,
        rest_vertices=rig.template_vertices.expand(40, -1, -1),
        surface=torch.full_like(samples.surface, 1e-3).index_fill(0, torch.arange(5), torch.nan),
    )
    found = fit_correctives(still, rig.shaped())
    normals = vertex_normals(rig.sealed(rig.template_vertices), rig.sealed_faces)
    expected = rig.template_vertices + 1e-3 * normals[: rig.num_vertices]
    torch.testing.assert_close(found.vertices, expected, atol=1e-6, rtol=0)


@pytest.mark.slow
def test_the_network_learns_light_and_lifted_shadows(rig: Rig) -> None:
    """Of a made light: dark where the thumb is near, unless its shadow is lifted."""
    samples = _made_samples(rig, 12)
    hand = rig.shaped()
    normals = vertex_normals(hand.rest_vertices, rig.faces)
    around = surroundings(samples, hand, normals, fit_capsules(hand))
    thumb = around.occlusion[:, :, 0, list(FINGER_BONES["thumb"])].amax(-1)
    made = replace(
        samples, light=0.8 - 0.6 * thumb, lifted_light=torch.full_like(samples.light, 0.8)
    )
    network = fit_shading(made, around, [], steps=300)
    plain, lifted = (
        error.square().mean().sqrt() for error in shading_error(network, made, around, [])
    )
    assert float(plain) < 0.1 * float(made.light.std()) + 0.01
    assert float(lifted) < 0.02
    again = fit_shading(made, around, [], steps=300)
    for name, value in network.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_quantising_latents_changes_little(rig: Rig) -> None:
    samples = _made_samples(rig, 2)
    hand = rig.shaped()
    around = surroundings(
        samples, hand, vertex_normals(hand.rest_vertices, rig.faces), fit_capsules(hand)
    )
    torch.manual_seed(0)
    network = ShadingNetwork(rig.num_vertices).requires_grad_(False)
    before = shading_error(network, samples, around, [])[0]
    after = shading_error(stored_network(network), samples, around, [])[0]
    assert float(network.latents.abs().max()) <= 1
    assert float((before - after).abs().max()) < 5e-3


def test_lifted_bones_hide_nothing() -> None:
    occlusion = torch.rand(2, 5, 2, NUM_BONES)
    lifted = torch.zeros(2, NUM_BONES, dtype=torch.bool)
    lifted[1, 3] = True
    found = shown(occlusion, lifted)
    assert torch.equal(found[0], occlusion[0]) and not found[1, :, :, 3].any()
    assert torch.equal(found[1, :, :, 4:], occlusion[1, :, :, 4:])


@pytest.mark.slow
def test_a_lightweight_hand_repeats_and_knows_its_loss(
    small_avatar: HandAvatar, light: LightweightHand
) -> None:
    again = lightweight_hand(small_avatar, Edit(), effort=EFFORT)
    first, second = light.arrays(), again.arrays()
    assert list(first) == list(second)
    for name, packed in first.items():
        assert packed.values.tobytes() == second[name].values.tobytes(), name
    assert light.loss == again.loss and light.loss["poses"] == 8
    assert 0 < light.loss["light_rmse"] < 0.5 and 15 < light.loss["color_psnr"] < 60
    assert 0 < light.loss["surface_mm"] < 2


def test_what_is_stored_is_what_was_fitted(light: LightweightHand) -> None:
    arrays = light.arrays()
    coarse = light.correctives.vertices.shape
    torch.testing.assert_close(
        arrays["vertices"].read().view(coarse), light.correctives.vertices, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(arrays["latents"].read(), light.network.latents, atol=1e-6, rtol=0)
    torch.testing.assert_close(arrays["shapes"].read(), light.correctives.shapes, atol=1e-6, rtol=0)
    count = light.hand.rig.num_vertices + 1
    assert len(arrays["albedo"].values) == len(arrays["bones"].values) == count
    assert (arrays["shares"].values.astype(int).sum(1) == 65535).all()
    assert "paint" not in arrays


def test_paint_is_laid_on_in_a_coat_of_its_own(small_avatar: HandAvatar) -> None:
    count = len(small_avatar.anchor_corners)
    colors = torch.tensor([0.2, 0.4, 0.9]).expand(count, 3).contiguous()
    opacity = (torch.arange(count) % 2).float()
    painted = lightweight_hand(
        small_avatar, Edit(paint=Paint(colors, opacity)), effort=Effort(2, 2)
    )
    assert painted.paint is not None
    torch.testing.assert_close(
        painted.paint[:, :3], painted.paint[:, 3:] * torch.tensor([0.2, 0.4, 0.9])
    )
    with torch.no_grad():
        assert painted.arrays()["paint"].values.shape == (len(painted.albedo), 4)


def test_samples_are_in_the_light_that_is_asked_for(two_lights: HandAvatar) -> None:
    def samples(light: int | None) -> FieldSamples:
        generator = torch.Generator().manual_seed(5)
        rotations = sampled_poses(two_lights, 1, generator, light)
        return sample_field(two_lights, rotations, generator, num_points=64, light=light)

    first, second = samples(None), samples(1)
    assert not torch.equal(first.rotations[:, 0], second.rotations[:, 0])
    assert torch.equal(first.rotations[:, 1:], second.rotations[:, 1:])
    two_lights.edit = Edit(light=1)
    try:
        kept, other = samples(None), samples(0)
    finally:
        two_lights.edit = Edit()
    assert torch.equal(kept.light, second.light) and torch.equal(other.light, first.light)
    # The same places in the same poses: the lights alone differ.
    turned = first.rotations[None, :1]
    there = [
        sample_field(two_lights, turned, torch.Generator().manual_seed(6), light=light).light
        for light in (0, 1)
    ]
    assert float((there[0] - there[1]).abs().mean()) > 0.05
