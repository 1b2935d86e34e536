import dataclasses
import json

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from safetensors.torch import load_file

from handavatar.capture.default import default_capture
from handavatar.capture.frames import CaptureError
from handavatar.capture.soundness import find_problems
from handavatar.capture.synthetic import (
    SynthOptions,
    crop_camera,
    make_capture,
    motion_for_testing,
    motion_for_training,
)
from handavatar.errors import ArgumentError
from handavatar.geometry.cameras import project
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.rig import ShapedHand

SIZE = 64
TINY = SynthOptions(
    train_frames=2,
    test_frames=1,
    size=SIZE,
    samples=25,
    subdivisions=1,
    texture=128,
    geometry_truth=True,
    variant="scalar_rgb",
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    pytest.importorskip("mitsuba")
    return make_capture(tmp_path_factory.mktemp("synth") / "made", TINY)


def truth(capture, kind, name):
    return np.asarray(Image.open(capture.folder / "truth" / kind / f"{name}.png"))


def coverage(camera, vertices, faces, oversampling=8):
    """Share of every pixel that the triangles cover, by painting them many times finer."""
    pixels, _ = project(camera, vertices)
    side = camera.width * oversampling
    picture = Image.new("L", (side, side))
    draw = ImageDraw.Draw(picture)
    # The painter counts from the centre of its first pixel.
    for corners in (pixels[faces] * oversampling - 0.5).tolist():
        draw.polygon([tuple(corner) for corner in corners], fill=1)
    cells = np.asarray(picture).reshape(camera.height, oversampling, camera.width, oversampling)
    return cells.mean(axis=(1, 3))


def test_the_capture_is_sound_and_says_what_it_is(capture):
    assert find_problems(capture.folder) == []
    assert capture.split("train") == (0, 1)
    assert capture.split("test") == (2,)
    assert capture.rig_sha256 == load_open_hand().sha256
    facts = json.loads((capture.folder / "truth/truth.json").read_text())
    assert facts["options"]["seed"] == TINY.seed
    assert (capture.folder / "overview.png").is_file()


def test_the_posed_truth_fills_the_mask(capture):
    arrays = load_file(capture.folder / "truth/subject.safetensors")
    rig = subdivided(load_open_hand(), TINY.subdivisions)
    joints = rig.shaped(arrays["shape_coefficients"]).rest_joints
    hand = ShapedHand(rig, arrays["rest_vertices"], joints)
    for index in range(3):
        frame = capture.frame(index)
        posed = hand.posed(frame.pose)
        expected = coverage(frame.camera, posed.sealed_vertices, rig.sealed_faces) > 0.5
        mask = frame.mask.numpy()
        # 25 samples decide a pixel's coverage to 0.1: some of the outline's pixels flip.
        assert (mask & expected).sum() / (mask | expected).sum() > 0.97


def test_the_displacement_is_a_few_millimetres(capture):
    arrays = load_file(capture.folder / "truth/subject.safetensors")
    distance = (arrays["rest_vertices"] - arrays["plain_vertices"]).norm(dim=-1)
    assert 3e-4 < float(distance.mean()) < 2e-3
    assert 1.5e-3 < float(distance.max()) < 5e-3


def test_the_picture_is_albedo_times_shading(capture):
    for index in range(3):
        frame = capture.frame(index)
        mask = truth(capture, "shading", frame.name) > 0
        # Pixels of the outline hold background too.
        inner = (
            mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
        )
        inner = np.pad(inner, 1)
        albedo = truth(capture, "albedo", frame.name) / 255
        shading = truth(capture, "shading", frame.name)[..., None] / 255
        difference = np.abs(frame.image.numpy() / 255 - albedo * shading)[inner]
        # One grey shading cannot hold the colour of bounced light, nor the sRGB curve's toe.
        assert difference.mean() < 5 / 255
        assert 0.2 < shading[inner].mean() < 0.95


def test_depth_and_normals_are_those_of_the_hand(capture):
    frame = capture.frame(0)
    mask = frame.mask.numpy()
    depth = truth(capture, "depth", frame.name) * 1e-4
    assert ((depth > 0) == mask).mean() > 0.99
    assert 0.4 < depth[mask].min() < depth[mask].max() < 0.8
    normals = truth(capture, "normals", frame.name)[mask] / 127.5 - 1
    lengths = np.linalg.norm(normals, axis=-1)
    # Quantised to 1/127.
    np.testing.assert_allclose(lengths, 1, atol=0.02)
    rotation = frame.camera.camera_from_world[:3, :3].numpy()
    assert ((normals @ rotation.T)[:, 2] < 0.1).mean() > 0.95


@pytest.mark.parametrize("options", [{"train_frames": 0}, {"size": 2}, {"tone": 1.5}])
def test_options_that_cannot_be_rendered_are_refused(options):
    with pytest.raises(ArgumentError, match=next(iter(options))):
        SynthOptions(**options)


def test_a_folder_in_use_is_refused_before_the_work(tmp_path):
    pytest.importorskip("mitsuba")
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(CaptureError, match="not empty"):
        make_capture(tmp_path, TINY)


def test_the_crop_leaves_the_margin_it_says():
    vertices = load_open_hand().template_vertices
    camera = crop_camera(vertices, 100)
    pixels, _ = project(camera, vertices)
    extent = pixels.max(0).values - pixels.min(0).values
    center = (pixels.max(0).values + pixels.min(0).values) / 2
    # Pixels of a 100 pixel picture, in float32.
    torch.testing.assert_close(extent.max(), torch.tensor(100 / 1.3), atol=1e-2, rtol=0)
    torch.testing.assert_close(center, torch.tensor([50.0, 50.0]), atol=1e-2, rtol=0)


def test_training_sees_all_sides_and_testing_other_poses():
    rig = load_open_hand("778")
    train, test = motion_for_training(rig, 40, 0), motion_for_testing(rig, 10, 0)
    normals = matrix_from_axis_angle(train.rotations[:, 0])[:, :, 1]
    # The camera looks along +y: the back of the hand turns to it, away, and to both sides.
    assert float(normals[:, 1].min()) < -0.9
    assert float(normals[:, 1].max()) > 0.9
    assert float(normals[:, 2].min()) < -0.7
    assert float(normals[:, 2].max()) > 0.7
    distance = torch.cdist(test.rotations[:, 1:].flatten(1), train.rotations[:, 1:].flatten(1))
    # No test pose is in the training motion: over all joints they differ by 20 degrees or more.
    assert float(distance.min()) > 0.35


def test_the_shipped_capture_is_whole():
    capture = default_capture()
    facts = json.loads((capture.folder / "truth/truth.json").read_text())
    defaults = dataclasses.asdict(SynthOptions())
    # It was made before one could choose a rig; an option that came later is at its default.
    assert defaults | facts["options"] == defaults
    assert len(capture.split("train")) == 80
    assert len(capture.split("test")) == 20
    assert capture.rig_sha256 == load_open_hand().sha256
    for record in capture.records:
        for kind in ("albedo", "shading"):
            assert (capture.folder / "truth" / kind / f"{record.name}.png").is_file()
