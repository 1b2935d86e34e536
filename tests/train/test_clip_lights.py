"""Several clips of one hand: one shape, one albedo, a light each."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import SKIN, TINY, write_tiny_capture

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import (
    Capture,
    CaptureError,
    Frame,
    read_capture,
    write_capture,
)
from handavatar.capture.view import view_of
from handavatar.edit import Edit
from handavatar.evaluate.baselines import judged_frame
from handavatar.evaluate.metrics import masked_psnr
from handavatar.evaluate.run import EvaluateOptions, evaluate_run
from handavatar.field.shading import CueSet, OrientedCues, TracedCues
from handavatar.train.appearance import appearance_loss, find_seen_samples
from handavatar.train.detail import light_of_pixels
from handavatar.train.loop import (
    METHODS,
    TrainOptions,
    begin_training,
    train,
    training_frames,
    warm_step,
)
from handavatar.train.sky import place_directions

FEW = RenderSettings(num_samples=16)
APPEARANCE = replace(TINY, warm_pixels=384)


def _frames(capture: Capture, split: str) -> list[Frame]:
    return [capture.frame(index) for index in capture.split(split)]


def _renumbered(source: Path, folder: Path, clips: tuple[int, ...]) -> Path:
    """The same frames, those of each clip under another number."""
    capture = read_capture(source)
    frames = [capture.frame(index) for index in range(len(capture.records))]
    names = ("rig_name", "rig_sha256", "subject", "source", "licence")
    header = {name: getattr(capture, name) for name in names}
    write_capture(folder, [replace(frame, clip=clips[frame.clip]) for frame in frames], **header)
    return folder


@pytest.fixture(scope="module")
def two_clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same poses under two lights; read only."""
    folder = tmp_path_factory.mktemp("clips") / "two"
    return write_tiny_capture(folder, "aab", num_clips=2)


@pytest.fixture(scope="module")
def run(two_clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole training of both clips, with every stage; read only."""
    with pytest.MonkeyPatch.context() as patch:
        method = replace(TINY, cues=TracedCues(14), detail_size=32, detail_steps=2)
        patch.setitem(METHODS, "quick", method)
        return train(TrainOptions(two_clips, tmp_path_factory.mktemp("runs") / "run"))


def _appearance_of(folder: Path, cues: CueSet, steps: int) -> HandAvatar:
    """The appearance alone, on the prior's geometry, at the rates of the first steps."""
    capture, method = read_capture(folder), replace(APPEARANCE, cues=cues)
    frames = training_frames(capture, method)
    training = begin_training(capture, frames, method, TrainOptions(folder))
    seen = find_seen_samples(training.avatar, frames, FEW, 2)
    if cues.num_directions:
        seen = place_directions(training.avatar, frames, seen, 0)
    for step in range(1, steps + 1):
        warm_step(training, seen, method, step, 0)
    return training.avatar


def _errors(avatar: HandAvatar, folder: Path) -> tuple[float, float]:
    """Of held-out frames' pixels: mean square of the colour, root mean square of the albedo.

    The albedo is compared after the best factor that is the same for all pixels and channels.
    """
    colors, albedos = [], []
    for frame in _frames(read_capture(folder), "test"):
        seen = avatar.render(frame.pose, frame.camera, Edit(light=frame.clip), FEW)
        inside = frame.mask & (seen.alpha > 0.5)
        alpha = seen.alpha[inside][:, None]
        colors.append(seen.color[inside] / alpha - frame.colors[inside])
        albedos.append(seen.albedo[inside] / alpha)
    albedo, truth = torch.cat(albedos), torch.tensor(SKIN)
    factor = (albedo * truth).sum() / albedo.square().sum()
    error = (factor * albedo - truth).square().mean().sqrt()
    return float(torch.cat(colors).square().mean()), float(error)


@pytest.mark.slow
@pytest.mark.parametrize(
    "cues",
    [OrientedCues(), pytest.param(TracedCues(28), marks=pytest.mark.slow)],
    ids=lambda cues: cues.name,
)
def test_clips_are_nearer_with_a_light_each_than_with_one_for_all(
    two_clips: Path, tmp_path: Path, cues: CueSet
) -> None:
    erased = _renumbered(two_clips, tmp_path / "erased", (0, 0))
    many, one = (_appearance_of(folder, cues, 80) for folder in (two_clips, erased))
    assert (many.num_lights, one.num_lights) == (2, 1)
    (color, albedo), (color_of_one, albedo_of_one) = _errors(many, two_clips), _errors(one, erased)
    assert color_of_one > 3 * color
    assert albedo_of_one > 1.5 * albedo


@pytest.mark.slow
def test_an_avatar_of_two_clips_is_trained_kept_and_judged(run: Path, two_clips: Path) -> None:
    avatar, capture = HandAvatar.load(run), read_capture(two_clips)
    assert avatar.num_lights == 2 and avatar.texture is not None
    frames = _frames(capture, "train")
    views = [view_of([frame for frame in frames if frame.clip == clip]) for clip in (0, 1)]
    assert avatar.info["views"] == views and avatar.info["view"] == views[0]
    # Every judged frame is in the light of its own clip.
    figures = evaluate_run(EvaluateOptions(run))
    frames = _frames(capture, "test")
    renderings = [avatar.render(f.pose, f.camera, Edit(light=f.clip)) for f in frames]
    judged = [
        judged_frame(frame, rendering.color, rendering.alpha)
        for frame, rendering in zip(frames, renderings, strict=True)
    ]
    own = sum(map(masked_psnr, judged)) / len(judged)
    assert figures["frames"] == 2 and figures["masked"]["psnr"] == pytest.approx(own, abs=1e-3)


def test_the_light_of_every_sample_is_its_own_clips(two_clips: Path) -> None:
    capture = read_capture(two_clips)
    frames = _frames(capture, "train")
    training = begin_training(capture, frames, APPEARANCE, TrainOptions(two_clips))
    avatar = training.avatar
    with torch.no_grad():  # The second clip's light is out.
        avatar.illumination.mlp.hidden[0].weight[:, -1] = 0
        avatar.illumination.mlp.hidden[0].weight[0, -1] = 1e3
        avatar.illumination.mlp.output.weight[:, 0] = 0
    seen = find_seen_samples(avatar, frames, FEW, 4)
    assert seen.clips.tolist() == [0, 0, 1, 1]
    owners = seen.clips[seen.frames[seen.starts[:-1]]]
    before = light_of_pixels(avatar, seen)
    loss, _ = appearance_loss(avatar, seen, (owners == 0).nonzero()[:, 0])
    loss.backward()
    column = avatar.illumination.mlp.hidden[0].weight.grad
    assert column is not None and bool(column[:, -2].any()) and not bool(column[:, -1].any())
    with torch.no_grad():
        avatar.illumination.mlp.hidden[0].bias += avatar.illumination.mlp.hidden[0].weight[:, -1]
        avatar.illumination.mlp.hidden[0].weight[:, -1] = 0
    torch.testing.assert_close(light_of_pixels(avatar, seen)[owners == 1], before[owners == 1])


def test_a_clip_that_cannot_be_learned_is_refused(two_clips: Path, tmp_path: Path) -> None:
    gap = _renumbered(two_clips, tmp_path / "gap", (0, 2))
    with pytest.raises(CaptureError, match="clip 1 has no frame of split 'train'"):
        train(TrainOptions(gap, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_frames_of_a_light_that_the_avatar_lacks_are_not_judged(
    run: Path, two_clips: Path, tmp_path: Path
) -> None:
    third = _renumbered(two_clips, tmp_path / "third", (0, 2))
    with pytest.raises(CaptureError, match=r"frames of clip 2 .* lights 0, 1"):
        evaluate_run(EvaluateOptions(run, third, out=tmp_path / "judged"))
    assert not (tmp_path / "judged").exists()
