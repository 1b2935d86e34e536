"""The avatar: laws of pictures, edits, broken files."""

import copy
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import bent_pose, camera_above
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from handavatar.avatar import (
    EXACT,
    SCHEMA,
    CheckpointError,
    HandAvatar,
    HandState,
    Rendering,
    RenderSettings,
)
from handavatar.edit import Edit, Paint, bones_named
from handavatar.field.anchors import Neighbours
from handavatar.field.shading import CueSet, OrientedCues, TracedCues
from handavatar.geometry.cameras import Camera, Rays, pixel_centers, rays_through_pixels
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand import parts
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import Rig
from handavatar.jobs.finite import NotFinite
from handavatar.plain import plain_rays
from handavatar.train.prior import load_prior

FEW = RenderSettings(num_samples=24)


def _assert_equal(first: Rendering, second: Rendering) -> None:
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(second, name)), name


@pytest.fixture(scope="module")
def rendering(small_avatar: HandAvatar) -> Rendering:
    return small_avatar.render(bent_pose(2), camera_above(24), settings=FEW)


def _rays(camera: Camera) -> Rays:
    return rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1))


# --- pictures -------------------------------------------------------------------------------------


def test_rendering_twice_gives_the_same_picture(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    _assert_equal(small_avatar.render(bent_pose(2), camera_above(24), settings=FEW), rendering)


def test_the_picture_shows_the_hand(small_avatar: HandAvatar, rendering: Rendering) -> None:
    pose, camera = bent_pose(2), camera_above(24)
    with torch.no_grad():
        state = small_avatar.prepare(pose)
    mesh = small_avatar.near_mesh(state, camera, 0.0)
    covered = rendering.alpha > 0.5
    # A pixel of 24 is 5 mm wide: the outline alone holds a quarter of the hand's pixels.
    assert int((mesh & covered).sum()) / int((mesh | covered).sum()) > 0.75
    assert float(rendering.alpha.min()) >= 0 and float(rendering.alpha.max()) <= 1 + 1e-5
    depth = (rendering.depth / rendering.alpha.clamp_min(1e-6))[covered]
    assert 0.35 < float(depth.min()) < float(depth.max()) < 0.52
    assert float(rendering.normal.norm(dim=-1).max()) <= 1 + 1e-5
    # The colour is the product of the two at every sample, not of their sums.
    product = (
        rendering.albedo * (rendering.illumination / rendering.alpha.clamp_min(1e-6))[..., None]
    )
    assert float((rendering.color - product)[covered].abs().mean()) < 0.05


def test_pieces_of_rays_do_not_matter(small_avatar: HandAvatar, rendering: Rendering) -> None:
    settings = replace(FEW, rays_at_once=50)
    pieced = small_avatar.render(bent_pose(2), camera_above(24), settings=settings)
    for name, value in vars(rendering).items():
        # Matrix products of other sizes round otherwise: as between fast and plain occupancy.
        torch.testing.assert_close(getattr(pieced, name), value, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_a_batch_is_rendered_as_its_hands_are_one_by_one(small_avatar: HandAvatar) -> None:
    poses = [bent_pose(seed) for seed in (1, 2, 3)]
    cameras = [camera_above(size) for size in (16, 24, 20)]
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        found = small_avatar.render_batch(poses, cameras)
    finally:
        torch.set_num_threads(threads)
    for picture, pose, camera in zip(found, poses, cameras, strict=True):
        assert torch.equal(picture.color, small_avatar.render(pose, camera).color)
    with pytest.raises(ValueError, match="`cameras`: found 2, expected as many as poses, 3"):
        small_avatar.render_batch(poses, cameras[:2])


def test_a_later_state_is_read_as_a_file_is(small_avatar: HandAvatar, tmp_path: Path) -> None:
    small_avatar.save(tmp_path / "one.safetensors")
    later = HandAvatar.load(tmp_path / "one.safetensors")
    with torch.no_grad():
        later.albedo.codes.add_(0.1)
    later.info, later.edit, later.occupancy.sharpness = {"step": 3}, Edit(light_gain=1.5), 2.0
    later.save(tmp_path / "two.safetensors")
    before = {name: value.clone() for name, value in small_avatar.state_dict().items()}
    found = small_avatar.reloaded(tmp_path / "two.safetensors")
    for name, value in later.state_dict().items():
        assert torch.equal(found.state_dict()[name], value), name
        assert torch.equal(small_avatar.state_dict()[name], before[name]), name
    assert found.info == {"step": 3} and found.edit == later.edit
    assert found.occupancy.sharpness == 2.0 and small_avatar.occupancy.sharpness == 1.0
    other = HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=1, num_anchors=256)
    other.save(tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="of another rig"):
        small_avatar.reloaded(tmp_path / "other.safetensors")
    (tmp_path / "two.safetensors").write_bytes(b"x")
    with pytest.raises(CheckpointError, match="damaged"):
        small_avatar.reloaded(tmp_path / "two.safetensors")


@pytest.mark.slow
def test_in_a_batch_a_pose_is_prepared_once(
    small_avatar: HandAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[HandPose] = []
    prepare = HandAvatar.prepare

    def counted(self: HandAvatar, pose: HandPose, *rest: Any) -> HandState:
        prepared.append(pose)
        return prepare(self, pose, *rest)

    poses = [bent_pose(1), bent_pose(2)]
    cameras = [camera_above(12), camera_above(16)]
    edit = Edit(light_gain=1.2, lifted_bones=(13, 14, 15))
    alone = [small_avatar.render(pose, camera, edit) for camera in cameras for pose in poses]
    monkeypatch.setattr(HandAvatar, "prepare", counted)
    found = small_avatar.render_batch(2 * poses, [cameras[n // 2] for n in range(4)], edit)
    assert len(prepared) == 2
    for picture, expected in zip(found, alone, strict=True):
        assert torch.equal(picture.color, expected.color)
    assert small_avatar.render_batch([], []) == []


def test_at_the_outline_a_pixel_is_the_mean_of_four_rays(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    pose, camera = bent_pose(2), camera_above(24)
    single = replace(FEW, edge_rays=1)
    once = small_avatar.render(pose, camera, settings=single)
    twice = small_avatar.render(pose, camera.resized(48, 48), settings=single)
    is_edge = (rendering.alpha - once.alpha).abs() > 1e-6
    assert 0.1 < float(is_edge.float().mean()) < 0.5
    inner = is_edge.new_zeros(24, 24)
    inner[1:-1, 1:-1] = True
    around = [
        -torch.nn.functional.max_pool2d(-sign * once.alpha[None], 3, 1, 1)[0] * sign
        for sign in (1, -1)
    ]
    is_plain = (torch.stack(around).amax(0) < 0.1) | (torch.stack(around).amin(0) > 0.9)
    for name, value in vars(rendering).items():
        ray, mean = getattr(once, name), getattr(twice, name)
        mean = mean.unflatten(0, (24, 2)).unflatten(2, (24, 2)).mean((1, 3))
        torch.testing.assert_close(value[is_edge & inner], mean[is_edge & inner], atol=1e-4, rtol=0)
        assert torch.equal(value[is_plain], ray[is_plain]), name
    # Coverage as more rays have it: 16 of every pixel.
    many = small_avatar.render(pose, camera.resized(96, 96), settings=single).alpha
    many = many.unflatten(0, (24, 4)).unflatten(2, (24, 4)).mean((1, 3))
    errors = [float((image - many).square().mean()) for image in (once.alpha, rendering.alpha)]
    assert errors[1] < 0.5 * errors[0]


def test_saving_and_loading_changes_nothing(
    small_avatar: HandAvatar, rendering: Rendering, tmp_path: Path
) -> None:
    small_avatar.save(tmp_path / "deep" / "avatar.safetensors")
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["avatar.safetensors"]
    loaded = HandAvatar.load(tmp_path / "deep" / "avatar.safetensors")
    assert loaded.info == small_avatar.info and loaded.rounds == small_avatar.rounds
    assert loaded.base_rig.sha256 == small_avatar.base_rig.sha256
    _assert_equal(loaded.render(bent_pose(2), camera_above(24), settings=FEW), rendering)


def _avatar_with(small_avatar: HandAvatar, cues: CueSet) -> HandAvatar:
    torch.manual_seed(2)
    avatar = HandAvatar(small_avatar.base_rig, torch.zeros(10), rounds=0, num_anchors=64, cues=cues)
    load_prior(avatar.occupancy)
    return avatar


@pytest.mark.parametrize("cues", [OrientedCues(), TracedCues(20)])
def test_an_avatar_comes_back_with_its_cues(
    small_avatar: HandAvatar, tmp_path: Path, cues: CueSet
) -> None:
    avatar = _avatar_with(small_avatar, cues)
    if cues.num_directions:
        avatar.illumination.directions.copy_(avatar.illumination.directions.flip(-1))
    avatar.save(tmp_path / "avatar.safetensors")
    loaded = HandAvatar.load(tmp_path / "avatar.safetensors")
    _assert_equal(
        loaded.render(bent_pose(1), camera_above(8), settings=FEW),
        avatar.render(bent_pose(1), camera_above(8), settings=FEW),
    )


def test_traced_shadows_do_not_swim_when_only_the_camera_moves(small_avatar: HandAvatar) -> None:
    """The same skin in the same pose has the same light, whoever looks."""
    avatar = _avatar_with(small_avatar, TracedCues(20))
    state = avatar.prepare(bent_pose(3))
    place = state.anchors[state.anchor_normals[:, 1].argmax()]
    eyes = place + torch.tensor([[0.0, 0.4, 0.0], [0.2, 0.35, 0.1], [-0.2, 0.35, -0.15]])
    rays = Rays(eyes, torch.nn.functional.normalize(place - eyes, dim=-1))
    values = avatar.render_rays(state, rays, replace(EXACT, num_samples=512))
    assert bool((values.alpha > 0.9).all())
    light = (values.illumination / values.alpha).detach()
    anchors = torch.arange(64)[:, None]
    everywhere = avatar.illumination(
        state.posed.pose.rotations,
        Neighbours(anchors, torch.ones(64, 1)),
        torch.zeros(64, NUM_BONES),
        state.anchor_normals,
        state.light,
    ).detach()
    # Rays end within a few hundredths of a millimetre of the same place.
    assert float(light.amax() - light.amin()) < 0.01 * float(everywhere.amax() - everywhere.amin())


@pytest.mark.slow
def test_lifting_a_finger_lights_what_it_shaded(small_avatar: HandAvatar) -> None:
    avatar = _avatar_with(small_avatar, TracedCues(60))
    pose = HandPose(gesture_rotations(small_avatar.base_rig, "fist"), torch.zeros(3))
    bones = bones_named(("thumb",))
    with torch.no_grad():
        light = avatar.prepare(pose).light
        lifted = avatar.prepare(pose, bones).light
    assert bool((lifted >= light).all()) and float((lifted - light).amax()) > 0.5
    # Far from the thumb nothing changes: the little finger's tip is on the other side.
    assert float((lifted == light).all(-1).float().mean()) > 0.3
    before, after = (
        avatar.render(pose, camera_above(12), edit, FEW)
        for edit in (None, Edit(lifted_bones=bones))
    )
    assert not torch.equal(before.illumination, after.illumination)
    assert torch.equal(before.albedo, after.albedo) and torch.equal(before.alpha, after.alpha)


def test_moving_hand_and_camera_together_leaves_the_geometry(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    here, camera = bent_pose(2), camera_above(24)
    turn = matrix_from_axis_angle(torch.tensor([0.5, -0.3, 0.8]))
    shift = torch.tensor([0.1, -0.2, 0.05])
    with torch.no_grad():
        world_from_bone = small_avatar.prepare(here).posed.world_from_bone
        rest_wrist = world_from_bone[0, :3, 3] - here.translation
    wrist = turn @ matrix_from_axis_angle(here.rotations[0])
    # theta = log of the composed rotation, by its skew part (the angle is below pi).
    angle = torch.arccos((wrist.trace() - 1) / 2)
    skew = torch.stack(
        [wrist[2, 1] - wrist[1, 2], wrist[0, 2] - wrist[2, 0], wrist[1, 0] - wrist[0, 1]]
    )
    rotations = here.rotations.clone()
    rotations[0] = skew / (2 * angle.sin()) * angle
    moved_wrist = turn @ (rest_wrist + here.translation) + shift
    there = HandPose(rotations, moved_wrist - rest_wrist)
    world_there_from_here = torch.eye(4)
    world_there_from_here[:3, :3], world_there_from_here[:3, 3] = turn, shift
    camera_there = replace(
        camera, camera_from_world=camera.camera_from_world @ torch.linalg.inv(world_there_from_here)
    )
    moved = small_avatar.render(there, camera_there, settings=FEW)
    # Samples stand where they stood to 1e-7 m; where a thin edge is hit, logits (which change by
    # some thousand per metre and more) differ in the third digit.
    for name in ("alpha", "albedo", "depth"):
        difference = (getattr(moved, name) - getattr(rendering, name)).abs()
        assert float(difference.mean()) < 1e-3, name
        assert float((difference > 5e-3).float().mean()) < 0.02, name


def _looking_away(camera: Camera) -> Camera:
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera.camera_from_world
    return replace(camera, camera_from_world=turned)


@pytest.mark.parametrize("margin", [8 / 256, math.inf])
def test_a_camera_that_looks_away_sees_nothing(small_avatar: HandAvatar, margin: float) -> None:
    settings = replace(FEW, mask_margin=margin)
    rendering = small_avatar.render(bent_pose(2), _looking_away(camera_above(8)), settings=settings)
    for name, value in vars(rendering).items():
        assert value.shape[:2] == (8, 8) and not bool(value.any()), name


@pytest.mark.parametrize("height", [0.0, 0.012, 0.05])
@pytest.mark.parametrize("margin", [8 / 256, math.inf])
def test_a_camera_in_or_at_the_hand_gives_finite_pictures(
    small_avatar: HandAvatar, height: float, margin: float
) -> None:
    camera = camera_above(8, distance=max(height, 1e-3))
    settings = replace(FEW, mask_margin=margin)
    rendering = small_avatar.render(bent_pose(0), camera, settings=settings)
    for name, value in vars(rendering).items():
        assert bool(torch.isfinite(value).all()), name
    assert 0 <= float(rendering.alpha.min()) <= float(rendering.alpha.max()) <= 1 + 1e-5


def test_training_jitter_repeats_with_its_generator(small_avatar: HandAvatar) -> None:
    rays, state = _rays(camera_above(8)), small_avatar.prepare(bent_pose(1))
    colors = [
        small_avatar.render_rays(state, rays, FEW, torch.Generator().manual_seed(seed)).color
        for seed in (1, 1, 2)
    ]
    assert torch.equal(colors[0], colors[1]) and not torch.equal(colors[0], colors[2])


def test_alpha_alone_has_value_and_gradient_of_the_whole_evaluation(
    small_avatar: HandAvatar,
) -> None:
    rays, state = _rays(camera_above(12)), small_avatar.prepare(bent_pose(1))
    weights = list(small_avatar.occupancy.decoder.parameters())
    direction = torch.randn(len(rays.origins), generator=torch.Generator().manual_seed(4))
    gradients = []
    whole = small_avatar.render_rays(state, rays, FEW).alpha
    alone = small_avatar.alpha(state.codes, rays, FEW)
    assert torch.equal(whole, alone)
    for alpha in (whole, alone):
        total = (direction * alpha).sum()
        gradients.append(torch.autograd.grad(total, weights, retain_graph=True, allow_unused=True))
    assert any(gradient is not None and bool(gradient.any()) for gradient in gradients[0])
    for first, second in zip(*gradients, strict=True):
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-6)


def test_an_untrained_avatar_starts_with_the_given_colour(small_avatar: HandAvatar) -> None:
    torch.manual_seed(1)
    avatar = HandAvatar(small_avatar.base_rig, torch.zeros(10), rounds=0, num_anchors=64)
    avatar.occupancy.load_state_dict(small_avatar.occupancy.state_dict())
    color = torch.tensor([0.5, 0.3, 0.25])
    avatar.start_from_color(color)
    rendering = avatar.render(bent_pose(0), camera_above(12), settings=FEW)
    seen = rendering.color[rendering.alpha > 0.99]
    torch.testing.assert_close(seen.mean(0), color, atol=0.05, rtol=0)


# --- edits ----------------------------------------------------------------------------------------


def _edited(avatar: HandAvatar, edit: Edit) -> Rendering:
    return avatar.render(bent_pose(2), camera_above(24), edit, FEW)


def test_the_default_edit_changes_nothing(small_avatar: HandAvatar, rendering: Rendering) -> None:
    _assert_equal(_edited(small_avatar, Edit()), rendering)


def test_light_gain_scales_illumination_and_colour(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    brighter = _edited(small_avatar, Edit(light_gain=1.5))
    torch.testing.assert_close(brighter.illumination, 1.5 * rendering.illumination)
    torch.testing.assert_close(brighter.color, 1.5 * rendering.color)
    for name in ("albedo", "alpha", "depth", "normal"):
        assert torch.equal(getattr(brighter, name), getattr(rendering, name))


def test_an_albedo_shift_leaves_light_and_geometry(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    bluer = _edited(small_avatar, Edit(albedo_shift=(0.0, 0.0, 0.3)))
    covered = rendering.alpha > 0.5
    assert float((bluer.albedo - rendering.albedo)[..., 2][covered].min()) > 0
    assert (
        float((bluer.albedo / rendering.alpha.clamp_min(1e-6)[..., None])[covered].max()) <= 1.001
    )
    for name in ("illumination", "alpha", "depth", "normal"):
        assert torch.equal(getattr(bluer, name), getattr(rendering, name))


def test_lifted_bones_change_the_light_alone(
    small_avatar: HandAvatar, rendering: Rendering
) -> None:
    lifted = _edited(small_avatar, Edit(lifted_bones=bones_named(("index", "thumb"))))
    assert not torch.equal(lifted.illumination, rendering.illumination)
    for name in ("albedo", "alpha", "depth", "normal"):
        assert torch.equal(getattr(lifted, name), getattr(rendering, name))


# --- files ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def file(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "avatar.safetensors"
    small_avatar.save(path)
    return path


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_file_cut_short_is_refused(file: Path, tmp_path: Path, share: float) -> None:
    cut = tmp_path / "cut.safetensors"
    content = file.read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"cut\.safetensors"):
        HandAvatar.load(cut)


def test_garbage_and_missing_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "noise").write_bytes(bytes(range(256)) * 40)
    with pytest.raises(CheckpointError, match="noise"):
        HandAvatar.load(tmp_path / "noise")
    with pytest.raises(CheckpointError, match="no such file"):
        HandAvatar.load(tmp_path / "nothing")


def _about(file: Path) -> dict[str, Any]:
    """What an avatar file says of itself beside its tensors."""
    with safe_open(file, framework="pt") as opened:
        about: dict[str, Any] = json.loads(opened.metadata()["handavatar"])
    return about


def _rewritten(file: Path, tmp_path: Path, about: object, drop: str = "-") -> Path:
    tensors = {name: value for name, value in load_file(file).items() if not name.startswith(drop)}
    path = tmp_path / "other.safetensors"
    save_file(tensors, path, {"handavatar": json.dumps(about)})
    return path


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_the_field_is_given_the_points_that_its_prior_knows(rig: Rig, rounds: int) -> None:
    avatar = HandAvatar(rig, torch.zeros(10), rounds=rounds, num_anchors=64)
    known = divide_into_parts(subdivided(rig, min(rounds, POINT_ROUNDS)))
    assert torch.equal(avatar.parts.corner_indices, known.corner_indices)
    assert torch.equal(avatar.parts.barycentric, known.barycentric)
    assert len(avatar.parts.vertex_labels) == avatar.rig.num_vertices


def test_an_avatar_keeps_its_part_points_however_others_are_drawn(
    small_avatar: HandAvatar,
    rendering: Rendering,
    file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another torch may draw others; and a version that stored none drew them at every load."""
    older = _rewritten(file, tmp_path, _about(file), "parts.")

    def shown(avatar: HandAvatar) -> Rendering:
        return avatar.render(bent_pose(2), camera_above(24), settings=FEW)

    for avatar in (HandAvatar.load(older), small_avatar.reloaded(older)):
        _assert_equal(shown(avatar), rendering)
    monkeypatch.setattr(parts, "divide_into_parts", partial(divide_into_parts, seed=1))
    redrawn = HandAvatar.load(older)
    assert not torch.equal(shown(redrawn).alpha, rendering.alpha)
    for avatar in (HandAvatar.load(file), redrawn.reloaded(file)):
        assert torch.equal(avatar.parts.corner_indices, small_avatar.parts.corner_indices)
        assert torch.equal(avatar.parts.vertex_labels, small_avatar.parts.vertex_labels)
        _assert_equal(shown(avatar), rendering)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stored: {"corners": stored["corners"] + 5000}, "expected vertices of a rig of 778"),
        (lambda stored: {"corners": -stored["corners"]}, "expected vertices of a rig of 778"),
        (lambda stored: {n: values[:-1] for n, values in stored.items()}, "for each of 16 parts"),
        (lambda stored: {n: values[:0] for n, values in stored.items()}, "for each of 16 parts"),
        (lambda stored: {"corners": stored["corners"][:-16]}, "not a complete avatar"),
    ],
)
def test_part_points_that_are_not_on_the_rig_are_refused(
    file: Path,
    tmp_path: Path,
    change: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]],
    message: str,
) -> None:
    tensors = load_file(file)
    stored = {name: tensors[f"parts.{name}"] for name in ("corners", "barycentric")}
    tensors |= {f"parts.{name}": values.contiguous() for name, values in change(stored).items()}
    save_file(tensors, tmp_path / "spoilt", {"handavatar": json.dumps(_about(file))})
    with pytest.raises(CheckpointError, match=message):
        HandAvatar.load(tmp_path / "spoilt")


@pytest.mark.parametrize("about", [None, [], {"schema": SCHEMA - 1}, {"schema": SCHEMA + 1}])
def test_another_schema_is_refused(file: Path, tmp_path: Path, about: object) -> None:
    with pytest.raises(CheckpointError, match=r"other\.safetensors: not an avatar of schema"):
        HandAvatar.load(_rewritten(file, tmp_path, about))


@pytest.mark.parametrize("about", [{"schema": SCHEMA}, {"schema": SCHEMA, "rig": 3}])
def test_a_file_that_says_too_little_is_refused(file: Path, tmp_path: Path, about: object) -> None:
    with pytest.raises(CheckpointError, match=r"other\.safetensors: not a complete avatar"):
        HandAvatar.load(_rewritten(file, tmp_path, about))


@pytest.mark.parametrize("drop", ["rig.faces", "avatar.albedo", "avatar.occupancy.encoder"])
def test_a_file_that_lacks_tensors_is_refused(file: Path, tmp_path: Path, drop: str) -> None:
    about = _about(file)
    assert HandAvatar.load(_rewritten(file, tmp_path, about)).rounds == 0
    with pytest.raises(CheckpointError, match="not a complete avatar"):
        HandAvatar.load(_rewritten(file, tmp_path, about, drop))


def test_an_avatar_with_nan_is_not_saved_and_the_old_file_stays(
    small_avatar: HandAvatar, file: Path
) -> None:
    before = file.read_bytes()
    spoilt = copy.deepcopy(small_avatar)
    with torch.no_grad():
        spoilt.albedo.codes[7, 3] = math.nan
    with pytest.raises(NotFinite, match=r"not saved: avatar\.albedo\.codes holds NaN at \[7, 3\]"):
        spoilt.save(file)
    dimmed = copy.copy(small_avatar)
    dimmed.edit = Edit()
    vars(dimmed.edit).update(light_gain=math.inf)  # Past what an edit refuses when it is made.
    with pytest.raises(NotFinite, match=r"edit\.light_gain is inf"):
        dimmed.save(file)
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize(
    "name", ["avatar.albedo.codes", "avatar.occupancy.decoder.mlp.output.bias", "rig.skin_weights"]
)
def test_an_avatar_file_with_nan_is_refused_and_the_tensor_named(
    small_avatar: HandAvatar, file: Path, tmp_path: Path, name: str, bad: float
) -> None:
    tensors = load_file(file)
    tensors[name].view(-1)[0] = bad
    spoilt = tmp_path / "spoilt.safetensors"
    save_file(tensors, spoilt, {"handavatar": json.dumps(_about(file))})
    for load in (HandAvatar.load, small_avatar.reloaded):
        with pytest.raises(CheckpointError, match=rf"spoilt\.safetensors: {re.escape(name)} holds"):
            load(spoilt)


@pytest.mark.parametrize("key", ["light_gain", "margin", "sharpness"])
def test_an_avatar_file_whose_numbers_are_nan_is_refused(
    file: Path, tmp_path: Path, key: str
) -> None:
    about = _about(file)
    holder = about["edit"] if key in about["edit"] else about
    holder[key] = math.nan
    with pytest.raises(CheckpointError, match=rf"{key} is NaN, expected finite numbers"):
        HandAvatar.load(_rewritten(file, tmp_path, about))


def test_a_failed_save_leaves_the_old_file(
    small_avatar: HandAvatar, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = file.read_bytes()

    def disk_full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", disk_full)
    with pytest.raises(OSError, match="disk full"):
        small_avatar.save(file)
    assert file.read_bytes() == before


# --- detail ---------------------------------------------------------------------------------------


def _with_detail(avatar: HandAvatar, tmp_path: Path, strength: float = 0.3) -> HandAvatar:
    avatar.save(tmp_path / "plain.safetensors")
    detailed = HandAvatar.load(tmp_path / "plain.safetensors")
    texture = detailed.give_texture(64)
    with torch.no_grad():
        texture.texels.copy_(strength * torch.randn(64, 64, 3))
    return detailed


def test_a_texture_of_zeros_changes_no_bit(
    small_avatar: HandAvatar, rendering: Rendering, tmp_path: Path
) -> None:
    assert small_avatar.texture is None
    assert not any(name.startswith("texture") for name in small_avatar.state_dict())
    detailed = _with_detail(small_avatar, tmp_path, 0.0)
    _assert_equal(detailed.render(bent_pose(2), camera_above(24), settings=FEW), rendering)


def test_detail_changes_colour_and_albedo_alone(
    small_avatar: HandAvatar, rendering: Rendering, tmp_path: Path
) -> None:
    detailed = _with_detail(small_avatar, tmp_path)
    found = detailed.render(bent_pose(2), camera_above(24), settings=FEW)
    for name in ("illumination", "normal", "depth", "alpha"):
        assert torch.equal(getattr(found, name), getattr(rendering, name)), name
    for name in ("color", "albedo"):
        assert not torch.equal(getattr(found, name), getattr(rendering, name)), name
    inside = rendering.alpha > 0.98
    factor = found.albedo[inside] / rendering.albedo[inside]
    assert 0.05 < float(factor.log().std()) < 0.3
    batch = detailed.render_batch([bent_pose(2)], [camera_above(24)], settings=FEW)[0]
    _assert_equal(batch, found)


def test_edits_come_after_the_detail(small_avatar: HandAvatar, tmp_path: Path) -> None:
    detailed = _with_detail(small_avatar, tmp_path)
    count = len(detailed.anchor_corners)
    coat = Paint(torch.full((count, 3), 0.25), torch.ones(count))
    found = detailed.render(bent_pose(2), camera_above(24), Edit(paint=coat), FEW)
    covered = found.alpha > 0.5
    painted = found.albedo[covered] / found.alpha[covered][:, None]
    torch.testing.assert_close(painted, torch.full_like(painted, 0.25), atol=1e-4, rtol=0)


def test_detail_is_saved_and_read_back(small_avatar: HandAvatar, tmp_path: Path) -> None:
    detailed = _with_detail(small_avatar, tmp_path)
    detailed.save(tmp_path / "detailed.safetensors")
    for found in (
        HandAvatar.load(tmp_path / "detailed.safetensors"),
        small_avatar.reloaded(tmp_path / "detailed.safetensors"),
    ):
        assert found.texture is not None and detailed.texture is not None
        assert torch.equal(found.texture.texels, detailed.texture.texels)
        _assert_equal(
            found.render(bent_pose(2), camera_above(24), settings=FEW),
            detailed.render(bent_pose(2), camera_above(24), settings=FEW),
        )
    assert small_avatar.texture is None
    assert detailed.reloaded(tmp_path / "plain.safetensors").texture is None


@pytest.mark.slow
def test_an_avatar_of_two_clips_is_shown_in_either_light(
    two_lights: HandAvatar, tmp_path: Path
) -> None:
    def shown(avatar: HandAvatar, edit: Edit | None = None) -> Rendering:
        return avatar.render(bent_pose(2), camera_above(24), edit, RenderSettings(num_samples=24))

    first, second = shown(two_lights), shown(two_lights, Edit(light=1))
    assert torch.equal(first.albedo, second.albedo) and torch.equal(first.alpha, second.alpha)
    assert float((first.illumination - second.illumination).abs().max()) > 0.05
    assert torch.equal(first.color, shown(two_lights, Edit(light=0)).color)
    edited = copy.copy(two_lights)
    edited.edit = Edit(light=1)
    edited.save(tmp_path / "second.safetensors")
    read = HandAvatar.load(tmp_path / "second.safetensors")
    assert (read.num_lights, read.light_of(), read.edit) == (2, 1, Edit(light=1))
    assert torch.equal(shown(read).color, second.color)
    assert torch.equal(shown(read, Edit(light=0)).color, first.color)
    assert read.view() == two_lights.info["views"][1]
    assert read.view(Edit(light=0)) == two_lights.view() == two_lights.info["view"]
    batch = two_lights.render_batch(
        [bent_pose(2)] * 2,
        [camera_above(24)] * 2,
        [Edit(light=1), Edit()],
        RenderSettings(num_samples=24),
    )
    assert torch.equal(batch[0].color, second.color) and torch.equal(batch[1].color, first.color)
    with pytest.raises(ValueError, match="`edit`: found 1, expected as many as poses, 2"):
        two_lights.render_batch([bent_pose(2)] * 2, [camera_above(24)] * 2, [Edit()])


def test_the_slow_rendering_is_in_the_avatars_light(two_lights: HandAvatar) -> None:
    edited = copy.copy(two_lights)
    edited.edit = Edit(light=1)
    camera = camera_above(6)
    rays = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1))
    with torch.no_grad():
        state = edited.prepare(bent_pose(2))
        slow = plain_rays(edited, state, rays, num_samples=24)
        exact = replace(EXACT, num_samples=24)
        fast = edited.render_rays(state, rays, exact)
        other = two_lights.render_rays(state, rays, exact)
    torch.testing.assert_close(slow.illumination, fast.illumination, atol=1e-4, rtol=1e-4)
    assert float((slow.illumination - other.illumination).abs().max()) > 0.05


def test_a_light_that_there_is_not_is_refused_by_its_number(
    two_lights: HandAvatar, small_avatar: HandAvatar, tmp_path: Path
) -> None:
    for avatar, light, known in ((two_lights, 2, "0, 1"), (small_avatar, 1, "0")):
        message = f"`light`: this avatar has none of number {light}; choose from {known} "
        with pytest.raises(ValueError, match=message):
            avatar.light_of(Edit(light=light))
        with pytest.raises(ValueError, match=message):
            avatar.render(bent_pose(1), camera_above(8), Edit(light=light))
    edited = copy.copy(two_lights)
    edited.edit = Edit(light=7)
    edited.save(tmp_path / "seventh.safetensors")
    with pytest.raises(CheckpointError, match="number 7"):
        HandAvatar.load(tmp_path / "seventh.safetensors")


def test_the_file_of_one_light_says_nothing_of_lights(file: Path) -> None:
    about = _about(file)
    assert about["edit"].keys() == {"light_gain", "albedo_shift", "lifted_bones"}
    assert not [name for name in about if "light" in name]
    assert HandAvatar.load(file).num_lights == 1
