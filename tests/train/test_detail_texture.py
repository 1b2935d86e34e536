"""The detail of a textured hand: what a texture is learned from, and what it becomes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import lit_frame
from told import Told

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Frame
from handavatar.evaluate.perceptual import GradientStructure
from handavatar.field.texture import texture_at
from handavatar.hand.open_hand import load_open_hand
from handavatar.train.appearance import find_seen_samples
from handavatar.train.detail import (
    DetailView,
    believed_share,
    faded,
    find_detail_views,
    fine_part,
    learn_detail,
    learn_texels,
    light_of_pixels,
    outline_error,
    unwrap_frames,
)
from handavatar.train.prior import load_prior
from handavatar.train.unwrap import UnwrapView

FEW = RenderSettings(num_samples=24)


@pytest.fixture(scope="module")
def avatar() -> HandAvatar:
    torch.manual_seed(0)
    avatar = HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=256)
    load_prior(avatar.occupancy)
    avatar.start_from_color(torch.tensor([0.5, 0.4, 0.3]))
    return avatar


@pytest.fixture(scope="module")
def frames(avatar: HandAvatar) -> list[Frame]:
    return [lit_frame(index, "train", size=64, rig=avatar.base_rig) for index in range(3)]


def _views(avatar: HandAvatar, frames: list[Frame]) -> list[DetailView]:
    if avatar.texture is None:
        avatar.give_texture(64)
    return find_detail_views(avatar, frames, find_seen_samples(avatar, frames, FEW, 2))


def test_a_view_is_what_the_avatar_renders(avatar: HandAvatar, frames: list[Frame]) -> None:
    view, frame = _views(avatar, frames)[0], frames[0]
    rendering = avatar.render(frame.pose, frame.camera, settings=FEW)
    height, width = view.is_known.shape
    window = (slice(view.top, view.top + height), slice(view.left, view.left + width))
    known = view.is_known & (rendering.alpha[window] > 0.98)
    assert int(known.sum()) > 300
    found = view.picture(view.albedo.float() * view.light.float()[:, None])
    assert float((found - rendering.color[window])[known].abs().mean()) < 0.01
    assert torch.equal(view.truth, frame.image[window]) and torch.equal(view.gain, frame.gain)
    assert 0 <= float(view.places.min()) <= float(view.places.max()) <= 1


def test_a_view_knows_what_its_frame_knows_at_the_average_exposure(
    avatar: HandAvatar, frames: list[Frame]
) -> None:
    frame, size = frames[0], frames[0].camera.width
    known = torch.ones(size, size, dtype=torch.bool)
    known[: size // 2] = False
    gain = torch.tensor([0.9, 0.8, 0.7])
    darker = replace(frame, image=(frame.image * gain).round().byte(), gain=gain, known=known)
    (whole,) = _views(avatar, [frame])
    (view,) = _views(avatar, [darker])
    assert bool((whole.top + whole.is_known.nonzero()[:, 0] < size // 2).any())
    rows, columns = view.is_known.nonzero().unbind(-1)
    assert len(rows) > 100 and int(view.top + rows.min()) == size // 2
    found = view.colors[rows, columns]
    assert torch.equal(found, darker.colors[view.top + rows, view.left + columns])
    truth = frame.colors[view.top + rows, view.left + columns]
    assert float((found - truth).abs().max()) < 0.5 / 255 / 0.7 + 1e-6


def test_the_light_of_pixels_is_the_illumination_along_their_rays(
    avatar: HandAvatar, frames: list[Frame]
) -> None:
    seen = find_seen_samples(avatar, frames[:1], FEW, 3)
    found = light_of_pixels(avatar, seen)
    assert found.shape == seen.alpha.shape
    torch.testing.assert_close(found, torch.full_like(found, 0.65), atol=0.1, rtol=0)


def test_a_pattern_on_the_skin_is_unwrapped_where_it_is(
    avatar: HandAvatar, frames: list[Frame]
) -> None:
    """Pictures made with a texture give this texture back, as far as they are sharp enough."""
    views = _views(avatar, frames)
    places = (torch.stack(torch.meshgrid(*[torch.arange(64)] * 2, indexing="xy"), -1) + 0.5) / 64
    pattern = (0.3 * torch.sin(40 * places).prod(-1))[..., None].expand(64, 64, 3)
    made = []
    for view in views:
        color = view.albedo.float() * texture_at(pattern, view.places).exp()
        color = view.picture(255 * color * view.light.float()[:, None])
        made.append(replace(view, truth=color.round().to(torch.uint8)))
    found = unwrap_frames(avatar, frames, made)
    assert 0.2 < found.seen_share < 0.8
    seen = found.seen > 1
    a, b = found.residual[seen].flatten(), pattern[seen].flatten()
    assert float(torch.corrcoef(torch.stack([a, b]))[0, 1]) > 0.6
    assert not bool(found.residual[found.seen == 0].isnan().any())


def test_steps_bring_the_texture_closer_to_the_pictures(
    avatar: HandAvatar, frames: list[Frame]
) -> None:
    views = [
        replace(view, truth=(0.8 * view.truth.float()).to(torch.uint8))
        for view in _views(avatar, frames)
    ]
    start = torch.zeros(64, 64, 3)
    told = Told()
    args = (start, views, 12, GradientStructure(), 0.1)
    first = learn_texels(*args, 0, told.progress)
    assert told.steps[1:] == list(range(1, 13))
    assert torch.equal(first, learn_texels(*args, 0))
    assert not torch.equal(first, learn_texels(*args, 1))
    assert torch.equal(start, learn_texels(start, views, 0, GradientStructure(), 0.1, 0))
    # The truth is darker than the rendering nearly everywhere: so becomes the texture.
    assert float(first[first != 0].mean()) < 0


def test_the_whole_changes_the_texture_alone(
    avatar: HandAvatar, frames: list[Frame], tmp_path: Path
) -> None:
    avatar.save(tmp_path / "avatar.safetensors")
    fresh = HandAvatar.load(tmp_path / "avatar.safetensors")
    before = {name: value.clone() for name, value in fresh.state_dict().items()}
    seen = find_seen_samples(fresh, frames, FEW, 2)
    learned = learn_detail(fresh, frames, seen, 32, 2, GradientStructure(), 0.1, 0)
    assert learned.seen.shape == (32, 32) and 0 < learned.seen_share < 1
    assert fresh.texture is not None and fresh.texture.size == 32
    for name, value in fresh.state_dict().items():
        if not name.startswith("texture"):
            assert torch.equal(value, before[name]), name


def test_what_was_not_seen_fades_to_zero() -> None:
    texels, seen = torch.full((64, 64, 3), 0.4), torch.zeros(64, 64)
    seen[:, :32] = 5.0
    found = faded(texels, seen)
    torch.testing.assert_close(found[:, :24], texels[:, :24], atol=0.01, rtol=0)
    assert float(found[:, 34:38].mean()) > 0.1 and float(found[:, 58:].abs().max()) < 0.05
    assert bool((found[32].diff(dim=0) <= 1e-6).all())


def test_the_fine_part_has_no_mean_and_nothing_from_beside_the_known() -> None:
    values = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    is_known = torch.zeros(40, 40, dtype=torch.bool)
    is_known[5:30, 8:33] = True
    found = fine_part(values + 3, is_known, 2.0)
    assert not bool(found[~is_known].any())
    assert float(found[is_known].mean().abs()) < 0.02
    changed = torch.where(is_known[..., None], values + 3, 100.0)
    torch.testing.assert_close(found, fine_part(changed, is_known, 2.0))
    flat = fine_part(torch.full((40, 40, 3), 2.0), is_known, 2.0)
    torch.testing.assert_close(flat, torch.zeros_like(flat), atol=1e-5, rtol=0)


def test_frames_that_disagree_are_believed_less(frames: list[Frame]) -> None:
    generator = torch.Generator().manual_seed(0)
    texels = torch.randn(16, 16, 3, generator=generator)
    places = torch.rand(400, 2, generator=generator)
    said = texture_at(texels, places)
    known = torch.ones(20, 20, dtype=torch.bool)
    camera = frames[0].camera

    def share(*factors: float) -> float:
        views = [
            UnwrapView(factor * said, places, known, camera, torch.zeros(1, 3), 1.0, 0.0)
            for factor in factors
        ]
        return believed_share(texels, views)

    assert share(1.0, 1.0) == pytest.approx(1)
    assert share(1.0, 0.2) == pytest.approx(0.6)
    assert share(1.5) == 1 and share(-1.0) == 0 and share() == 0


def test_the_outlines_error_is_a_distance_in_pixels(avatar: HandAvatar) -> None:
    frame = lit_frame(0, "train", size=96, rig=avatar.base_rig)
    posed = avatar.base_rig.shaped().posed(frame.pose)
    assert outline_error(posed.vertices, avatar.base_rig.faces, frame) < 0.05
    moved = torch.roll(frame.coverage, 3, dims=1)
    error = outline_error(posed.vertices, avatar.base_rig.faces, replace(frame, coverage=moved))
    assert 0.8 < error < 3
    known = torch.zeros(96, 96, dtype=torch.bool)
    nowhere = replace(frame, coverage=moved, known=known)
    assert outline_error(posed.vertices, avatar.base_rig.faces, nowhere) == 0
    known[:, :48] = True
    half = replace(frame, known=known)
    # The mask ends where the known does; that is no outline, and what lies beyond no error.
    assert outline_error(posed.vertices, avatar.base_rig.faces, half) < 0.05
    scribbled = replace(half, coverage=torch.where(known, frame.coverage, 255 - frame.coverage))
    assert outline_error(posed.vertices, avatar.base_rig.faces, scribbled) == outline_error(
        posed.vertices, avatar.base_rig.faces, half
    )
