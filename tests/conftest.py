"""What several tests need: a small avatar, and a capture of a few small pictures."""

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from priorities import is_ordinary, make_ordinary
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture import synthetic as made_captures
from handavatar.capture.decoding import Sampling, video_frames
from handavatar.capture.frames import Frame, write_capture
from handavatar.capture.skin import SkinOptions, paint_skin
from handavatar.capture.view import view_of
from handavatar.field.shading import OrientedCues
from handavatar.geometry.cameras import Camera, look_at
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import Parts, divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import PosedHand, Rig
from handavatar.render.rasterize import interpolate, rasterize
from handavatar.synthetic.films import FilmOptions, make_film
from handavatar.synthetic.truth import FilmTruth, read_film_truth
from handavatar.train.loop import Method
from handavatar.train.prior import load_prior

TINY = Method(
    steps=12,
    outline_rounds=1,
    outline_visits=1,
    personal_steps=2,
    sharpness=2.0,
    border_steps=2,
    warm_steps=3,
    warm_pixels=64,
    warm_stride=2,
    frames=1,
    patches=1,
    patch_size=16,
    border_pixels=32,
    num_samples=12,
    silhouette_size=32,
    lr=5e-3,
    lr_matrices=5e-3,
    lr_codes=1e-2,
    perceptual_weight=0.1,
    occupancy_points=64,
    rounds=0,
    num_anchors=128,
)
"""The whole method on a budget of seconds."""


def bent_pose(step: int) -> HandPose:
    """The fingers close a little and the wrist turns a little from step to step."""
    rotations = torch.zeros(NUM_BONES, 3)
    rotations[1:13, 2] = 0.12 * step
    rotations[0] = torch.tensor([0.0, 0.08 * step, 0.05])
    return HandPose(rotations, torch.tensor([0.0, 0.01, 0.002 * step]))


def camera_above(size: int, distance: float = 0.42) -> Camera:
    """A square camera over the back of the flat hand, which fills most of the picture."""
    middle = torch.tensor([-0.08, 0.0, 0.0])
    placed = look_at(
        middle + torch.tensor([0.02, distance, 0.05]), middle, torch.tensor([-1.0, 0.0, 0.0])
    )
    return Camera((1.7 * size, 1.7 * size), (size / 2, size / 2), size, size, placed)


LIGHTS = ((0.3, 0.9, 0.3), (0.2, 0.25, -0.95))
"""Of the frames' clips: towards each clip's own light, world."""
SKIN = (0.9, 0.65, 0.5)
"""Of the frames: their only albedo."""


def lit_frame(
    index: int,
    split: str,
    confidence: float = 1.0,
    size: int = 48,
    rig: Rig | None = None,
    clip: int = 0,
) -> Frame:
    """The rasterised open hand, or that of another rig, skin-coloured, under its clip's light."""
    pose, camera = bent_pose(index), camera_above(size)
    if rig is not None:  # Its wrist may lie elsewhere.
        pose = replace(pose, translation=pose.translation - rig.shaped().rest_joints[0])
    posed = (rig or load_open_hand()).shaped().posed(pose)
    faces = posed.rig.faces
    fragments = rasterize(posed.vertices, faces, camera)
    normals = interpolate(fragments, faces, vertex_normals(posed.vertices, faces))
    light = (normals @ torch.tensor(LIGHTS[clip])).clamp(0, 1) * 0.7 + 0.2
    color = light[..., None] * torch.tensor(SKIN) * fragments.mask[..., None]
    return Frame(
        name=f"{index + 1000 * clip:06d}",
        image=(color * 255).round().to(torch.uint8),
        coverage=fragments.mask.byte() * 255,
        camera=camera,
        pose=pose,
        confidence=confidence,
        split=split,
        time=index / 30,
        clip=clip,
    )


def write_tiny_capture(
    folder: Path,
    splits: str = "aaabb",
    confidence: float = 1.0,
    rig: Rig | None = None,
    size: int = 48,
    num_clips: int = 1,
    **header: str,
) -> Path:
    """A capture of small pictures: ``a`` stands for a training frame, ``b`` for a test frame.

    Every clip shows the same poses, under its own light.
    """
    frames = [
        lit_frame(index, {"a": "train", "b": "test"}[letter], confidence, size, rig, clip)
        for clip in range(num_clips)
        for index, letter in enumerate(splits)
    ]
    rig = rig or load_open_hand()
    facts = dict(
        rig_name=rig.name,
        rig_sha256=rig.sha256,
        subject="tiny",
        source="rasterised in a test",
        licence="CC0-1.0",
    )
    write_capture(folder, frames, **(facts | header))
    return folder


@pytest.fixture(autouse=True)
def _no_priority() -> Iterator[None]:
    """No test makes this process one that the others have to wait for."""
    yield
    stays_ordinary = is_ordinary()
    make_ordinary()
    assert stays_ordinary, "this test has made its process a real-time one"


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three training and two test frames with known poses; read only."""
    return write_tiny_capture(tmp_path_factory.mktemp("capture") / "tiny")


@contextmanager
def coarse_skin() -> Iterator[None]:
    """Made hands get a texture of few texels: painting one takes most of a small film's time."""

    def paint(rig: Rig, options: SkinOptions, resolution: int) -> Tensor:
        return paint_skin(rig, options, min(resolution, 192))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made_captures, "paint_skin", paint)
        yield


@pytest.fixture(scope="session")
def film_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A made film of nine small pictures with its truth; read only."""
    folder = tmp_path_factory.mktemp("films")
    options = FilmOptions(
        "small", 5, 0.9, ("spread", "relaxed"), sleeved=True, width=128, height=96, seconds=0.6
    )
    with coarse_skin():
        make_film(replace(options, crf=10, personal=0.0), folder)
    return folder


@pytest.fixture(scope="session")
def small_film(film_folder: Path) -> FilmTruth:
    """Its truth."""
    return read_film_truth(film_folder / "small.mp4")


def make_hand_film(folder: Path, seconds: float) -> Path:
    """A made film of a hand, ten pictures a second, large enough to find it."""
    options = FilmOptions(
        "hand", 21, 0.2, ("spread", "relaxed"), width=320, height=240, seconds=seconds, fps=10.0
    )
    with coarse_skin():
        return make_film(replace(options, distance=0.36, crf=12), folder)


@pytest.fixture(scope="session")
def hand_film_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A made film of five pictures, large enough for a webcam's page; read only."""
    return make_hand_film(tmp_path_factory.mktemp("hand_film"), 0.5)


@pytest.fixture(scope="session")
def hand_film(hand_film_path: Path) -> FilmTruth:
    """Its truth."""
    return read_film_truth(hand_film_path)


@pytest.fixture(scope="session")
def hand_pictures(hand_film_path: Path) -> list[np.ndarray]:
    """Its pictures; read only."""
    frames = list(video_frames(hand_film_path, Sampling(10.0), lambda told: None))
    assert len(frames) == 5
    return [frame.image for frame in frames]


def avatar_of_the_prior() -> HandAvatar:
    """The 778-vertex hand with the shipped prior, which was trained on a finer mesh."""
    torch.manual_seed(0)
    avatar = HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=64)
    load_prior(avatar.occupancy)
    return avatar


def assert_teaches_the_decoder_alone(avatar: HandAvatar, fit: Callable[[], None]) -> None:
    """``fit`` changes every weight of the avatar's pair decoder, and leaves no gradient."""
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    fit()
    changed = {n for n, v in avatar.state_dict().items() if not torch.equal(v, before[n])}
    assert changed == {name for name in before if name.startswith("occupancy.decoder.")}
    assert all(parameter.grad is None for parameter in avatar.parameters())


def assert_teaching_repeats(fit: Callable[[HandAvatar, int, int], None]) -> None:
    """The same seed gives the same bits, and no steps change nothing.

    Args:
        fit: teaches an avatar's pair decoder for so many steps with a seed.
    """
    results = []
    for steps, seed in ((2, 3), (2, 3), (2, 4), (0, 3)):
        avatar = avatar_of_the_prior()
        fit(avatar, steps, seed)
        results.append(avatar.occupancy.decoder.state_dict())
    same, different, none = (
        all(torch.equal(results[0][name], other[name]) for name in other) for other in results[1:]
    )
    assert same and not different and not none
    untrained = avatar_of_the_prior().occupancy.decoder.state_dict()
    assert all(torch.equal(untrained[name], results[3][name]) for name in untrained)


@pytest.fixture(scope="session")
def small_avatar() -> HandAvatar:
    """The 778-vertex hand with the shipped prior and random colours; read only."""
    torch.manual_seed(0)
    avatar = HandAvatar(
        load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=256, info={"side": "right"}
    )
    load_prior(avatar.occupancy)
    with torch.no_grad():  # Colours and shadows that differ from place to place.
        avatar.albedo.codes.mul_(10)
        avatar.shape.mlp.output.weight.mul_(100 / math.sqrt(3))
    return avatar


@pytest.fixture(scope="session")
def two_lights() -> HandAvatar:
    """A small avatar of two clips, which differ in their light and in their world; read only."""
    turned = replace(camera_above(48), camera_from_world=torch.diag(torch.tensor([-1.0, 1, -1, 1])))
    turned.camera_from_world[2, 3] = 0.5
    frames = [lit_frame(0, "train"), replace(lit_frame(3, "train", clip=1), camera=turned)]
    views = [view_of([frame]) for frame in frames]
    torch.manual_seed(0)
    avatar = HandAvatar(
        load_open_hand("778"),
        torch.zeros(10),
        rounds=0,
        num_anchors=128,
        cues=OrientedCues(),
        info={"side": "right", "view": views[0], "views": views},
        num_lights=2,
    )
    load_prior(avatar.occupancy)
    with torch.no_grad():  # Lights that differ clearly, and from place to place.
        avatar.illumination.mlp.hidden[0].weight[:, -2:].mul_(20)
    return avatar


def passed_kernel_checks(checks: Path) -> int:
    """How many tests of Triton kernels a file holds; all must pass.

    In a process of their own, on the GPU, else in Triton's interpreter: Triton must know before its
    import that it is to interpret, and cannot read functions that the type checker has wrapped.
    """
    environment = {**os.environ, "TRITON_INTERPRET": "0" if torch.cuda.is_available() else "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, str(checks)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed, done.stdout[-500:]
    return int(passed[1])


def any_pose(rig: Rig, turn: float = 0.0, shift: float = 0.0) -> PosedHand:
    """One random pose, the same at every call, with the wrist turned (radians) and moved."""
    generator = torch.Generator().manual_seed(1)
    rotations = 0.3 * torch.randn(NUM_BONES, 3, generator=generator)
    rotations[0] = turn * torch.tensor([0.6, 0.0, 0.8])
    pose = HandPose(rotations, shift * torch.tensor([1.0, -2.0, 3.0]))
    return rig.shaped().posed(pose.to(rig.template_vertices.device))


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The 778-vertex hand; read only."""
    return load_open_hand("778")


@pytest.fixture(scope="session")
def parts(rig: Rig) -> Parts:
    """Its parts; read only."""
    return divide_into_parts(rig)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, for tests of pages."""
    from chromium import launched

    with launched() as running:
        yield running
