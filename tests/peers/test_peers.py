"""Prior art: each learns the hand that it is shown, and the table pairs frames."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import TINY, bent_pose
from told import Told

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame, read_capture
from handavatar.evaluate import textured_mesh
from handavatar.evaluate.metrics import mean_color
from handavatar.evaluate.textured_mesh import fit_textured_mesh, harmonics
from handavatar.field.shading import TracedCues
from handavatar.hand.open_hand import load_open_hand
from handavatar.peers import inverse_skinning
from handavatar.peers.inverse_skinning import (
    CanonicalField,
    fit_inverse_skinning,
    joined,
    ray_samples,
    rest_places,
    seen_along,
    some_rays,
)
from handavatar.peers.table import PeersTableOptions, peers_table
from handavatar.render.rasterize import rasterize
from handavatar.train.ablation import FrameScores
from handavatar.train.loop import METHODS


@pytest.fixture(scope="module")
def avatar() -> HandAvatar:
    torch.manual_seed(0)
    return HandAvatar(load_open_hand(), torch.zeros(10), rounds=0, num_anchors=1024)


@pytest.fixture(scope="module")
def frames(tiny_capture: Path) -> list[Frame]:
    capture = read_capture(tiny_capture)
    return [capture.frame(index) for index in range(len(capture.records))]


def _psnr(picture: torch.Tensor, frame: Frame) -> float:
    scores = FrameScores()
    scores.add(frame, picture[..., :3], picture[..., 3])
    return scores.by_name["psnr"][0]


def test_harmonics_are_orthogonal_over_the_sphere() -> None:
    normals = torch.nn.functional.normalize(
        torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    values = harmonics(normals)
    gram = values.T @ values / len(values)
    # A mean of 200,000 values below 1 has a deviation of at most 0.002.
    assert float((gram - gram.diag().diag()).abs().max()) < 0.02
    assert float(gram.diag().min()) > 0.05


def test_posed_skin_goes_back_to_the_rest_skin(avatar: HandAvatar) -> None:
    pose = bent_pose(6)
    hand = avatar.personal(pose)
    posed = hand.posed(pose)
    weights = avatar.rig.skin_weights
    found = rest_places(hand, posed, weights, posed.vertices)
    torch.testing.assert_close(found, hand.rest_vertices, atol=1e-5, rtol=0)


def test_samples_lie_near_the_skin_and_rays_cover_the_hand(
    avatar: HandAvatar, frames: list[Frame]
) -> None:
    frame = frames[0]
    samples = ray_samples(avatar, frame)
    posed = avatar.personal(frame.pose).posed(frame.pose)
    covered = rasterize(posed.vertices, avatar.rig.faces, frame.camera).mask.flatten()
    assert bool(torch.isin(covered.nonzero()[:, 0], samples.pixels).all())
    has_samples = torch.zeros(len(samples.pixels), dtype=torch.bool)
    has_samples[samples.rays] = True
    assert float(has_samples[covered[samples.pixels]].float().mean()) == 1.0
    rest = avatar.personal(frame.pose).rest_vertices
    nearest = torch.cdist(samples.places[::50], rest).amin(-1)
    # Half an edge of the mesh and the stretch of bent joints come on top of the reach.
    assert float(nearest.max()) < inverse_skinning.REACH + 0.006


def test_rays_are_seen_alike_alone_and_together(avatar: HandAvatar, frames: list[Frame]) -> None:
    torch.manual_seed(1)
    field, generator = CanonicalField(), torch.Generator().manual_seed(0)
    parts = [some_rays(ray_samples(avatar, frame), 50, generator) for frame in frames[:2]]
    turns = [frame.pose.rotations.flatten() for frame in frames[:2]]
    apart = [
        seen_along(field, part, turn.expand(len(part.places), -1))
        for part, turn in zip(parts, turns, strict=True)
    ]
    each = torch.cat([t.expand(len(p.places), -1) for p, t in zip(parts, turns, strict=True)])
    together = seen_along(field, joined(parts), each)
    torch.testing.assert_close(together, torch.cat(apart))
    assert float(together[:, 3].detach().min()) >= 0 and float(together[:, 3].detach().max()) <= 1


@pytest.mark.slow
def test_both_learn_the_hand_and_the_same_seed_the_same_bits(
    avatar: HandAvatar, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(textured_mesh, "NUM_TEXELS", 2000)
    color = mean_color((f.image.float() / 255, f.mask) for f in frames)
    train, test = frames[:3], frames[3]
    mesh = [fit_textured_mesh(avatar, train, color, steps, 0)(test) for steps in (1, 80, 80)]
    assert _psnr(mesh[1], test) > max(_psnr(mesh[0], test) + 2, 20)
    assert torch.equal(mesh[1], mesh[2])
    nerf = [fit_inverse_skinning(avatar, train, steps, 0, 1)(test) for steps in (1, 60, 60)]
    assert _psnr(nerf[1], test) > _psnr(nerf[0], test) + 3
    assert torch.equal(nerf[1], nerf[2])


@pytest.mark.slow
def test_the_table_is_kept_and_has_every_row(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from handavatar.peers import table

    monkeypatch.setitem(METHODS, "quick", replace(TINY, cues=TracedCues()))
    monkeypatch.setattr(textured_mesh, "NUM_TEXELS", 500)
    options = PeersTableOptions((tiny_capture,), tmp_path, seeds=(0,), steps=2, peer_steps=2)
    told = Told()
    found = peers_table(options, told.progress)
    assert list(found.rows) == [*table.PEERS, *table.OURS]
    assert sum(" minus " in note for note in found.notes) == len(table.PEERS) * len(table.OURS)
    assert "ours (best) minus textured mesh: ssim " in found.markdown()
    assert told.steps[-1] == options.total_steps
    stored = json.loads((tmp_path / f"peers-{tiny_capture.name}.json").read_text())
    assert len(stored["rows"]["textured mesh"]["0"]["psnr"]) == 2
    assert str(found.rows["inverse skinning"]["ours (best) ahead by"]).count("[") == 1
    monkeypatch.setattr(table, "fitted_geometry", None)
    assert peers_table(options) == found
