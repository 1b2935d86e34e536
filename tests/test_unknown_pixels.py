"""What is not known counts nowhere: scribbling over unknown pixels changes no bit of any result."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from conftest import TINY, avatar_of_the_prior, bent_pose, lit_frame
from torch import Tensor

from handavatar.alignment import aligned_pose
from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Frame, read_capture, write_capture
from handavatar.evaluate.metrics import mean_color
from handavatar.evaluate.perceptual import GradientStructure, perceptual_loss
from handavatar.evaluate.textured_mesh import fit_textured_mesh
from handavatar.hand.open_hand import load_open_hand
from handavatar.peers.inverse_skinning import fit_inverse_skinning
from handavatar.train.ablation import FrameScores
from handavatar.train.appearance import find_seen_samples
from handavatar.train.border import BORDER_REACH, border_pixels, fit_border
from handavatar.train.detail import learn_detail
from handavatar.train.loop import TrainOptions, begin_training, frame_losses
from handavatar.train.outlines import EdgeSet, fit_outlines, small_mask

SIZE = 48


def _half_known(index: int) -> Frame:
    """Two fingers and a piece of the wall are hidden, and so is a spot in the middle of the palm.

    Gained by exposure a little.
    """
    frame = lit_frame(index, "train", size=SIZE)
    known = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known[:16, 20:] = False
    known[26:30, 22:27] = False
    return replace(frame, known=known, gain=torch.tensor([1.1, 1.0, 0.9]), confidence=0.9)


def _scribbled(frame: Frame) -> Frame:
    generator = torch.Generator().manual_seed(11)
    noise = torch.randint(0, 256, (SIZE, SIZE, 4), generator=generator, dtype=torch.uint8)
    return replace(
        frame,
        image=torch.where(frame.known[..., None], frame.image, noise[..., :3]),
        coverage=torch.where(frame.known, frame.coverage, noise[..., 3]),
    )


FRAMES = [_half_known(index) for index in range(2)]
SCRIBBLED = [_scribbled(frame) for frame in FRAMES]


def _trained(parameters: list[Tensor]) -> list[Tensor]:
    return [value.detach().clone() for value in parameters]


def _seen(frames: list[Frame]) -> list[Tensor]:
    avatar = avatar_of_the_prior()
    seen = find_seen_samples(avatar, frames, RenderSettings(num_samples=12), 2)
    return [seen.colors, seen.alpha, seen.weights, seen.starts]


def _small_masks(frames: list[Frame]) -> list[Tensor]:
    return [part for frame in frames for part in small_mask(frame, 24) if part is not None]


def _shapes(frames: list[Frame]) -> list[Tensor]:
    avatar = avatar_of_the_prior()
    fit_outlines(avatar, None, frames, rounds=1, visits=1, size=32, seed=0)
    return _trained(list(avatar.shape.parameters()))


def _borders(frames: list[Frame]) -> list[Tensor]:
    avatar = avatar_of_the_prior()
    fit_border(avatar, frames, 2, RenderSettings(num_samples=12), seed=0)
    return _trained(list(avatar.occupancy.decoder.parameters()))


def _aligned(frames: list[Frame]) -> list[Tensor]:
    hand_of = avatar_of_the_prior().coarse_personal
    found = [
        aligned_pose(hand_of, bent_pose(2), frame.camera, frame.alpha, 4, known=frame.known)
        for frame in frames
    ]
    return [pose.rotations for pose in found]


def _mean_colors(frames: list[Frame]) -> list[Tensor]:
    return [mean_color((frame.colors, frame.mask) for frame in frames)]


def _texture(frames: list[Frame]) -> list[Tensor]:
    avatar = avatar_of_the_prior()
    picture = fit_textured_mesh(avatar, frames, torch.tensor([0.7, 0.5, 0.4]), 3, 0)
    return [picture(frames[0])]


def _field(frames: list[Frame]) -> list[Tensor]:
    return [fit_inverse_skinning(avatar_of_the_prior(), frames, 2, 0)(frames[0])]


def _detail(frames: list[Frame]) -> list[Tensor]:
    avatar = avatar_of_the_prior()
    avatar.start_from_color(torch.tensor([0.7, 0.5, 0.4]))
    seen = find_seen_samples(avatar, frames, RenderSettings(num_samples=12), 2)
    learned = learn_detail(avatar, frames, seen, 32, 3, GradientStructure(), 0.1, seed=0)
    assert avatar.texture is not None and learned.seen_share > 0
    return [avatar.texture.texels.detach(), learned.seen]


def _scores(frames: list[Frame]) -> list[Tensor]:
    scores = FrameScores()
    for frame in frames:
        scores.add(frame, torch.full((SIZE, SIZE, 3), 0.4), torch.ones(SIZE, SIZE))
    return [torch.tensor(values) for values in scores.by_name.values()]


def _for_people(frames: list[Frame]) -> list[Tensor]:
    return [frame.shown for frame in frames]


@pytest.mark.parametrize(
    "consumer",
    [
        _seen,
        _small_masks,
        _shapes,
        _borders,
        _aligned,
        _mean_colors,
        _texture,
        _field,
        _detail,
        _scores,
        _for_people,
    ],
)
def test_scribbles_change_nothing(consumer: Callable[[list[Frame]], list[Tensor]]) -> None:
    for before, after in zip(consumer(FRAMES), consumer(SCRIBBLED), strict=True):
        assert torch.equal(before, after)


@pytest.mark.slow
def test_scribbles_would_change_it_if_they_were_known() -> None:
    """The law is no tautology: with everything known the same scribbles do change results."""
    everything = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known, scribbled = (
        [replace(frame, known=everything) for frame in frames] for frames in (FRAMES, SCRIBBLED)
    )
    for consumer in (
        _seen,
        _small_masks,
        _shapes,
        _aligned,
        _mean_colors,
        _texture,
        _detail,
        _scores,
    ):
        pairs = zip(consumer(known), consumer(scribbled), strict=True)
        assert not all(a.shape == b.shape and torch.equal(a, b) for a, b in pairs), consumer


@pytest.mark.slow
def test_scribbles_change_neither_losses_nor_gradients_of_a_joint_step(tmp_path: object) -> None:
    folder = tmp_path / "capture"  # type: ignore[operator]
    rig = load_open_hand()
    header = {"rig_name": rig.name, "rig_sha256": rig.sha256, "subject": "tiny"}
    write_capture(folder, FRAMES, source="test", licence="CC0-1.0", **header)
    capture = read_capture(folder)
    assert [bool(frame.known.all()) for frame in map(capture.frame, range(2))] == [False, False]
    results = []
    for frames in (FRAMES, SCRIBBLED):
        method = replace(TINY, patches=3)
        training = begin_training(capture, frames, method, TrainOptions(folder, device="cpu"))
        edges = EdgeSet.of(training.avatar.rig)
        found = []
        for step in (1, 2, 3):
            generator = torch.Generator().manual_seed(step)
            losses = frame_losses(
                training,
                frames[0],
                0,
                edges,
                perceptual_loss("substitute"),
                method,
                step,
                generator,
            )
            torch.stack(list(losses.values())).sum().backward()
            found += [value.detach() for value in losses.values()]
        found += [p.grad for p in training.avatar.parameters() if p.grad is not None]
        results.append(found)
    assert len(results[0]) > 20
    for before, after in zip(*results, strict=True):
        assert torch.equal(before, after)


def test_where_the_known_ends_there_is_no_border(small_avatar: HandAvatar) -> None:
    mask = torch.zeros(60, 60)
    mask[20:40, :40] = 1
    known = torch.ones(60, 60, dtype=torch.bool)
    known[:, :10] = False
    every = torch.Generator().manual_seed(0)
    x, y = border_pixels(mask * known, 9999, every, known).unbind(-1)
    # The hand leaves the picture on the left: upper, lower and right side are borders, the cut not.
    assert int(x.min()) >= 10
    on_cut = (x < 10 + BORDER_REACH) & (y > 20 + BORDER_REACH) & (y < 40 - BORDER_REACH)
    assert not bool(on_cut.any())
    assert bool(((x > 36) & (y == 30)).any()) and bool(((y < 22) & (x == 20)).any())


def test_a_hand_cut_by_the_picture_does_not_shrink_into_it(small_avatar: HandAvatar) -> None:
    """The pose of a hand of which the fingertips lie outside stays where the rest of it says."""
    frame = lit_frame(1, "train", size=96)
    known = torch.ones(96, 96, dtype=torch.bool)
    known[:30] = False
    cut = replace(frame, known=known, coverage=frame.coverage * known)
    hand_of = avatar_of_the_prior().coarse_personal
    found = [
        aligned_pose(hand_of, frame.pose, frame.camera, cut.alpha, 8, known=seen)
        for seen in (known, None)
    ]
    moved = [float((pose.rotations - frame.pose.rotations).norm()) for pose in found]
    assert moved[0] < 0.5 * moved[1]


def test_colours_are_taken_back_to_the_average_exposure() -> None:
    frame = lit_frame(0, "train", size=SIZE)
    gain = torch.tensor([0.9, 0.8, 0.7])
    darker = replace(frame, image=(frame.image * gain).round().byte(), gain=gain)
    assert float((darker.colors - frame.colors).abs().max()) < 0.5 / 255 / 0.7 + 1e-6
    assert torch.equal(frame.colors, frame.image.float() / 255)
