"""An avatar remembers which skin its training frames have seen."""

import copy
from pathlib import Path

import numpy as np
import torch
from conftest import lit_frame

from handavatar.avatar import HandAvatar
from handavatar.capture.seen_skin import count_seen_skin, skin_regions
from handavatar.evaluate.unseen import VIEWS, unseen_figures, unseen_pictures
from handavatar.train.seen_anchors import count_seen_anchors

FRAMES = [lit_frame(index, "train", size=96) for index in range(3)]


def _seen_from_above(small_avatar: HandAvatar) -> HandAvatar:
    avatar = copy.deepcopy(small_avatar)
    with torch.no_grad():  # Its shape is random.
        avatar.shape.mlp.output.weight.zero_()
    count_seen_anchors(avatar, FRAMES)
    return avatar


def test_anchors_count_as_the_vertices_beside_them(small_avatar: HandAvatar) -> None:
    avatar = _seen_from_above(small_avatar)
    assert avatar.seen_frames is not None and avatar.seen_frames.shape == (256,)
    vertices = count_seen_skin(avatar.rig, torch.zeros(10), FRAMES).counts
    around = vertices[avatar.anchor_corners]
    # Where the three corners agree there is no doubt.
    least, most = around.amin(1), around.amax(1)
    agree = least == most
    assert float(agree.float().mean()) > 0.6
    assert torch.equal(avatar.seen_frames[agree].long(), least[agree])
    assert bool(((avatar.seen_frames >= least) & (avatar.seen_frames <= most)).all())
    assert 0.2 < float((avatar.seen_frames == 0).float().mean()) < 0.8


def test_an_anchor_is_seen_where_most_of_its_surroundings_are(small_avatar: HandAvatar) -> None:
    avatar = copy.deepcopy(small_avatar)
    with torch.no_grad():
        avatar.shape.mlp.output.weight.zero_()
    count_seen_anchors(avatar, FRAMES[:1])
    seen = count_seen_skin(avatar.rig, torch.zeros(10), FRAMES[:1]).counts
    share = (seen[avatar.anchor_corners] * avatar.anchors.barycentric).sum(-1)
    assert bool(((share > 0.05) & (share < 0.5)).any())
    assert avatar.seen_frames is not None
    assert torch.equal(avatar.seen_frames, (share > 0.5).int())


def test_the_avatar_keeps_it_in_its_file(small_avatar: HandAvatar, tmp_path: Path) -> None:
    avatar = _seen_from_above(small_avatar)
    avatar.save(tmp_path / "seen.safetensors")
    loaded = HandAvatar.load(tmp_path / "seen.safetensors")
    assert loaded.seen_frames is not None and avatar.seen_frames is not None
    assert torch.equal(loaded.seen_frames, avatar.seen_frames)
    assert loaded.seen_frames.dtype == torch.int32
    small_avatar.save(tmp_path / "older.safetensors")
    assert HandAvatar.load(tmp_path / "older.safetensors").seen_frames is None
    assert loaded.reloaded(tmp_path / "older.safetensors").seen_frames is None


def test_figures_name_the_palm_of_a_hand_seen_from_above(small_avatar: HandAvatar) -> None:
    avatar = _seen_from_above(small_avatar)
    figures = unseen_figures(avatar)
    assert figures is not None and avatar.seen_frames is not None
    assert figures["share"] == round(float((avatar.seen_frames == 0).float().mean()), 4)
    assert "palm" in figures["regions"] and "back" not in figures["regions"]
    assert set(figures["regions"]) <= set(skin_regions(avatar.rig))
    assert unseen_figures(small_avatar) is None


def test_a_left_hand_is_shown_as_the_mirror_image(small_avatar: HandAvatar) -> None:
    avatar = _seen_from_above(small_avatar)
    right = unseen_pictures(avatar, 48)
    avatar.info = {**avatar.info, "side": "left"}
    left = unseen_pictures(avatar, 48)
    pairs = [(0, 0), (1, 3), (2, 2), (3, 1)]  # what is right of one is left of the other
    for mine, other in pairs:
        mirrored = left[VIEWS[mine]][:, ::-1].astype(int)
        assert np.abs(mirrored - right[VIEWS[other]]).mean() < 3


def test_pictures_from_all_sides_have_the_tint_where_nobody_saw(small_avatar: HandAvatar) -> None:
    avatar = _seen_from_above(small_avatar)
    pictures = unseen_pictures(avatar, 48)
    assert tuple(pictures) == VIEWS

    def violet(name: str) -> float:
        pixels = torch.from_numpy(pictures[name]).float()
        shown = pixels.sum(-1) < 700
        red, green, blue = pixels[shown].unbind(-1)
        return float(((blue > green + 20) & (red > green + 20)).float().mean())

    # Without a capture the first view is from below, onto the palm; the frames are from above.
    assert violet("from behind") < 0.2 < 0.6 < violet("as in the video")
