import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import TINY

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import read_capture
from handavatar.field.anchors import Neighbours
from handavatar.field.shading import TracedCues
from handavatar.hand.open_hand import load_open_hand
from handavatar.render.skylight import even_directions
from handavatar.train.appearance import SeenSamples, find_seen_samples
from handavatar.train.loop import METHODS, TrainOptions, train
from handavatar.train.prior import load_prior
from handavatar.train.runs import Checkpoint, load_checkpoint
from handavatar.train.sky import _joined_skies, bright_directions, fit_sky, place_directions, relit


def _seen_under(sky: torch.Tensor, tones: torch.Tensor) -> SeenSamples:
    """One sample per pixel on random places of a body with random shadows."""
    generator = torch.Generator().manual_seed(0)
    directions = even_directions(len(sky))
    normals = torch.nn.functional.normalize(torch.randn(6000, 3, generator=generator), dim=-1)
    is_free = torch.rand(6000, len(sky), generator=generator) > 0.3
    light = (normals @ directions.T).clamp_min(0) * is_free
    anchor = torch.randint(len(tones), (6000, 1), generator=generator)
    value = tones[anchor[:, 0]] * (light @ sky + 0.05) ** 0.45
    return SeenSamples(
        weights=torch.ones(6000),
        directed=torch.zeros(6000, 16),
        neighbours=Neighbours(anchor, torch.ones(6000, 1)),
        normals=normals,
        light=light.half(),
        frames=torch.zeros(6000, dtype=torch.long),
        starts=torch.arange(6001),
        colors=value[:, None].expand(-1, 3).clamp(0, 1),
        alpha=torch.ones(6000),
        points=torch.zeros(6000, 3),
        rotations=torch.zeros(1, 16, 3),
        clips=torch.zeros(1, dtype=torch.long),
    )


def test_a_sky_is_found_from_shadows_whatever_the_tones() -> None:
    sky = torch.full((40,), 0.002)
    sky[7], sky[29] = 0.6, 0.2
    tones = 0.3 + 0.5 * torch.rand(30, generator=torch.Generator().manual_seed(1))
    found = fit_sky(_seen_under(sky, tones), 30, seed=0)
    assert found.argsort(descending=True)[:2].tolist() == [7, 29]
    assert float(found[29] / found[7]) == pytest.approx(1 / 3, abs=0.15)


def test_each_clip_has_a_sky_of_its_own_and_all_share_the_directions() -> None:
    skies = torch.full((2, 40), 0.002)
    skies[0, 7], skies[1, 29] = 0.6, 0.2
    tones = 0.3 + 0.5 * torch.rand(30, generator=torch.Generator().manual_seed(1))
    first, second = (_seen_under(sky, tones) for sky in skies)
    both = replace(
        first,
        **{
            name: torch.cat([getattr(first, name), getattr(second, name)])
            for name in ("weights", "directed", "normals", "light", "colors", "alpha", "points")
        },
        neighbours=Neighbours(
            torch.cat([first.neighbours.indices, second.neighbours.indices]),
            torch.cat([first.neighbours.weights, second.neighbours.weights]),
        ),
        frames=torch.cat([first.frames, second.frames + 1]),
        starts=torch.arange(12001),
        rotations=torch.zeros(2, 16, 3),
        clips=torch.tensor([0, 1]),
    )
    found = [fit_sky(both, 30, 0, clip) for clip in (0, 1)]
    assert [int(sky.argmax()) for sky in found] == [7, 29]
    # A clip alone is what it was, to the bit, and so are its directions.
    assert torch.equal(found[0], fit_sky(first, 30, 0))
    joined = _joined_skies(found)
    assert torch.equal(_joined_skies(found[:1]), found[0])
    chosen = bright_directions(even_directions(40), joined)
    near = (chosen @ even_directions(40)[[7, 29]].T).amax(0)
    assert bool((near > 0.98).all())
    # However bright a clip is, it gets its share: here about half of what is not even.
    count = [(chosen @ even_directions(40)[place] > 0.85).sum() for place in (7, 29)]
    assert min(count) >= 6


def test_directions_gather_where_the_sky_is_bright() -> None:
    directions = even_directions(112)
    brightness = torch.full((112,), 1e-3)
    brightness[50] = 1.0
    chosen = bright_directions(directions, brightness)
    assert chosen.shape == (112, 3)
    torch.testing.assert_close(chosen.norm(dim=-1), torch.ones(112))
    assert torch.equal(chosen[:48], even_directions(48))
    near = chosen[48:] @ directions[50]
    # An eighth of an even lattice is a cap of 41 degrees around the brightest direction.
    assert float(near.min()) > 0.7


@pytest.mark.slow
def test_relit_samples_are_those_that_would_be_found(tiny_capture: Path) -> None:
    capture = read_capture(tiny_capture)
    frames = [capture.frame(index) for index in capture.split("train")]
    torch.manual_seed(0)
    avatar = HandAvatar(
        load_open_hand(), torch.zeros(10), rounds=0, num_anchors=128, cues=TracedCues(14)
    )
    load_prior(avatar.occupancy)
    settings = RenderSettings(num_samples=12)
    seen = find_seen_samples(avatar, frames, settings, 2)
    moved = place_directions(avatar, frames, seen, seed=0)
    assert not torch.equal(avatar.illumination.directions, even_directions(14))
    assert not torch.equal(moved.light, seen.light)
    again = find_seen_samples(avatar, frames, settings, 2)
    assert torch.equal(again.light, moved.light)
    assert torch.equal(relit(avatar, frames, seen).light, moved.light)


@pytest.mark.slow
def test_a_run_with_traced_light_goes_on_to_the_same_bits(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "best", replace(TINY, cues=TracedCues(14)))
    options = TrainOptions(
        tiny_capture,
        tmp_path / "whole",
        method="best",
        steps=6,
        checkpoint_every=2,
        device="cpu",
        perceptual="substitute",
    )
    whole = train(options)
    light = HandAvatar.load(whole).illumination
    assert light.chosen.name == "traced" and light.directions.shape == (14, 3)
    for step in (0, 2, 4):
        part = tmp_path / f"from-{step}"
        shutil.copytree(whole, part)
        (part / "avatar.safetensors").unlink()
        for later in range(step + 2, 8, 2):
            shutil.rmtree(part / "checkpoints" / f"step-{later:09d}")
        train(replace(options, out=part))
        assert (part / "avatar.safetensors").read_bytes() == (
            whole / "avatar.safetensors"
        ).read_bytes()
    stored = load_checkpoint(Checkpoint(whole / "checkpoints" / "step-000000004", 4)).tensors
    assert torch.equal(stored["model"]["avatar.illumination.directions"], light.directions)
