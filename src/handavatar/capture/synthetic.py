"""Made captures: a subject that never lived, path traced, with everything about it known.

A subject is the open hand with its own shape coefficients, its own displacement of the surface (up
to a few millimetres that no shape coefficient can express) and its own painted skin. It moves in
front of a camera that stands still; each frame is the square part of the picture around the hand.
Light comes mostly from one side.

The truth beside the frames lies in ``truth/`` in the same stored space as the pictures, sRGB / 255:

* ``albedo/``: colour of the skin, 8 bit.
* ``shading/``: grey, 8 bit, 255 is 1: the factor ``s`` per pixel for which ``s * albedo`` comes
  nearest to the picture. The sRGB curve is almost a power law, for which picture = albedo times
  shading holds in the stored space if it holds for light; what is left is the curve's toe and
  light that was coloured by bouncing off skin (in the shipped capture 1.8/255 in the mean, 40 dB).
* ``depth/``: 16 bit, units of 0.1 mm along the optical axis, 0 is background.
* ``normals/``: 8 bit, ``(n + 1) / 2``, world axes.
* ``subject.safetensors``: rest vertices of the subject and of the hand with the same coefficients
  but without the displacement, on the rig subdivided as ``truth.json`` says; shape coefficients.
* ``truth.json``: all options and the seed, and the PSNR of the pictures against noiseless ones
  (``noise_psnr``, three test poses traced twice).
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from safetensors.torch import save
from torch import Tensor

from handavatar.capture.frames import (
    Capture,
    CaptureWriter,
    Frame,
    read_capture,
)
from handavatar.capture.motion import Motion, gesture, placed
from handavatar.capture.pathtracer import (
    LIGHTINGS,
    MAX_DEPTH,
    HandTracer,
    Lighting,
    SurfaceMaps,
    Traced,
    Variant,
    choose_variant,
)
from handavatar.capture.skin import SkinOptions, paint_skin, smooth_noise
from handavatar.errors import SEEDS, require_ranges
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.colors import eight_bits, srgb_from_linear
from handavatar.geometry.meshes import uniform_laplacian, unique_edges, vertex_normals
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.detail import subdivided
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import (
    interpolate_rotations,
    resolve_penetration,
    sample_poses,
)
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.hand.rigs import load_rig
from handavatar.jobs.progress import SILENT, Progress

TRAINING_GESTURES = (
    "relaxed",
    "spread",
    "loose_fist",
    "fist",
    "point",
    "victory",
    "pinch",
    "thumb_to_middle",
    "thumb_to_little",
    "flat",
    "wave_low",
    "hook",
    "table",
    "thumbs_up",
    "claw",
    "ok",
    "wave_high",
    "four",
)
TEST_GESTURES = ("thumb_to_ring", "three", "gun", "purse", "horns", "shaka", "little_out")
CONTACT_GESTURES = ("thumb_to_ring", "knock", "purse", "key_grip", "gun", "cupped", "horns")
"""Fists that training does not have, and fingers that touch."""
_CAMERA_DISTANCE = 0.6
_CENTER = (-0.09, 0.0, 0.0)
_CROP_MARGIN = 1.3
_BACKGROUND = 0.17
_SAME_DEPTH = 2e-4
"""Metres: two pictures show the same skin where their depths differ by less."""


@dataclass(frozen=True)
class SynthOptions:
    """A made capture."""

    train_frames: int = 80
    """frames of the training motion"""
    test_frames: int = 20
    """frames of another motion through other poses"""
    size: int = 256
    """width and height of the pictures, pixels"""
    samples: int = 100
    """light paths per pixel; spread evenly if it is a square number"""
    seed: int = 7
    """subject, skin and motion"""
    tone: float = 0.35
    """skin: 0 very light to 1 very dark"""
    personal: float = 1.0
    """strength of the displacement that shape coefficients cannot express"""
    subdivisions: int = 2
    """rounds that refine the rig before it is displaced and rendered"""
    texture: int = 1024
    """texels along each side of the skin texture"""
    lighting: Lighting = "key"
    """key and fill, even light from everywhere, or lamps of different colours"""
    transport: Literal["full", "direct"] = "full"
    """all light, or only what comes straight from the lamps"""
    contacts: bool = False
    """the test motion passes through fists and touching fingers"""
    test_views: int = 1
    """cameras that take turns in the test motion: the standing one and others around it"""
    geometry_truth: bool = False
    """store depth and normals too, not only albedo and shading"""
    variant: Variant = "auto"
    """of Mitsuba; auto takes llvm_ad_rgb where it works"""
    rig: str = "open-hand"
    """the hand: open-hand, an imported one (mano-right) or its file"""

    def __post_init__(self) -> None:
        """Refuses what cannot be rendered."""
        require_ranges(
            self,
            train_frames=(1, 10**5),
            test_frames=(1, 10**5),
            size=(8, 4096),
            samples=(1, 65_536),
            seed=SEEDS,
            tone=(0, 1),
            personal=(0, 10),
            subdivisions=(0, 4),
            texture=(1, 8192),
            test_views=(1, 1000),
        )


@dataclass(frozen=True, eq=False)
class Subject:
    """A hand that is fully known.

    Attributes:
        rig: the refined hand.
        shape_coefficients: standard deviations.
        plain_vertices: rest hand of these coefficients, metres.
        rest_vertices: the same with the personal displacement, metres.
        texture: albedo, sRGB in [0, 1].
    """

    rig: Rig
    shape_coefficients: Float[Tensor, "shapes"]
    plain_vertices: Float[Tensor, "vertices 3"]
    rest_vertices: Float[Tensor, "vertices 3"]
    texture: Float[Tensor, "rows columns 3"]

    @property
    def rest_hand(self) -> ShapedHand:
        """In the zero pose. The joints are those of the shape coefficients."""
        shaped = self.rig.shaped(self.shape_coefficients)
        return replace(shaped, rest_vertices=self.rest_vertices)

    def posed_vertices(self, pose: HandPose) -> Float[Tensor, "vertices 3"]:
        """Skin in the world."""
        return self.rest_hand.posed(pose).vertices


def make_capture(
    folder: Path,
    options: SynthOptions,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Capture:
    """Renders a made capture into a folder.

    Args:
        folder: where the capture is to be.
        options: subject, motion and quality.
        overwrite: replace a capture that is there.
        progress: told the frames done.

    Raises:
        CaptureError: if Mitsuba is missing or the folder is in use.
    """
    choose_variant(options.variant)
    base = load_rig(options.rig)
    # What can be refused is refused before the slow work begins.
    writer = CaptureWriter(
        folder,
        rig_name=base.name,
        rig_sha256=base.sha256,
        subject=f"made-{options.seed}",
        source=f"handavatar capture synth, seed {options.seed}",
        licence="CC0-1.0",
        shape_coefficients=_drawn_shape(base, _random_of_subject(options.seed)),
        overwrite=overwrite,
    )
    subject = make_subject(subdivided(base, options.subdivisions), options)
    motions = {
        "train": motion_for_training(base, options.train_frames, options.seed),
        "test": motion_for_testing(
            base,
            options.test_frames,
            options.seed,
            CONTACT_GESTURES if options.contacts else TEST_GESTURES,
        ),
    }
    total = options.train_frames + options.test_frames
    with writer:
        pictures = []
        for done, (frame, traced, maps) in enumerate(_frames(subject, motions, options), start=1):
            writer.add(frame)
            _write_truth(writer, frame, traced, maps, options.geometry_truth)
            pictures.append(frame.image)
            progress(done, total)
        noise = _noise(subject, motions["test"], options)
        _write_subject(writer, subject, options, noise)
        sheet = contact_sheet(pictures[:: max(1, total // 40)])
        Image.fromarray(sheet.numpy()).save(writer.file("overview.png"))
    return read_capture(folder)


def make_subject(rig: Rig, options: SynthOptions) -> Subject:
    """The subject of a seed: shape, displacement, skin."""
    random = _random_of_subject(options.seed)
    coefficients = _drawn_shape(rig, random)
    shaped = rig.shaped(coefficients)
    plain = _rounded(rig, shaped.rest_vertices)
    offsets = options.personal * _personal_displacement(rig, random)
    normals = vertex_normals(plain, rig.faces)
    texture = paint_skin(rig, SkinOptions(options.seed, options.tone), options.texture)
    return Subject(
        rig=rig,
        shape_coefficients=coefficients,
        plain_vertices=shaped.rest_vertices,
        rest_vertices=plain + offsets[:, None] * normals,
        texture=texture,
    )


def _random_of_subject(seed: int) -> np.random.Generator:
    """Draws the shape coefficients first, the displacement after them."""
    return np.random.default_rng([seed, 11])


def _drawn_shape(rig: Rig, random: np.random.Generator) -> Float[Tensor, "shapes"]:
    """Moderate shape coefficients, standard deviations."""
    drawn = 0.7 * random.standard_normal(rig.shape_directions.shape[-1])
    return torch.from_numpy(drawn.clip(-1.4, 1.4)).float()


def _rounded(
    rig: Rig, vertices: Float[Tensor, "vertices 3"], rounds: int = 8
) -> Float[Tensor, "vertices 3"]:
    """Takes the facets off that midpoint subdivision leaves, without shrinking the hand."""
    edges = unique_edges(rig.faces)
    is_free = torch.ones(len(vertices), 1)
    is_free[rig.rim] = 0
    for _ in range(rounds):
        # A smoothing step and a slightly larger step back (Taubin) act as a low pass.
        for factor in (0.5, -0.53):
            vertices = vertices + factor * is_free * uniform_laplacian(vertices, edges)
    return vertices


def _personal_displacement(rig: Rig, random: np.random.Generator) -> Float[Tensor, "vertices"]:
    """Metres along the normal: build of joints, pads and palm, and smooth irregularity."""
    places = rig.template_vertices.double().numpy() * 1000
    shaped = rig.shaped()
    joints = shaped.rest_joints.double().numpy() * 1000
    dorsal = vertex_normals(rig.template_vertices, rig.faces)[:, 1].numpy()
    back, front = dorsal.clip(0), (-dorsal).clip(0)

    def bump(center: np.ndarray, radius: float) -> np.ndarray:
        return np.exp(-0.5 * ((places - center) ** 2).sum(-1) / radius**2)

    total = 1.1 * smooth_noise(places, np.full(3, 38.0), random)
    total += 0.5 * smooth_noise(places, np.full(3, 15.0), random)
    for first, second, third in FINGER_BONES.values():
        total += random.normal(1.6, 0.7) * back * bump(joints[first], 7.0)
        total += random.normal(1.1, 0.6) * bump(joints[second], 6.0)
        total += random.normal(0.4, 0.3) * bump(joints[third], 5.0)
        middle = (joints[second] + joints[third]) / 2
        total += random.normal(-0.2, 0.4) * bump(middle, 6.0)
    for center, radius, mean in (
        ((-40, -25, 34), 15.0, 2.5),
        ((-42, -20, -32), 16.0, 1.8),
        ((-58, -20, -4), 13.0, -2.2),
    ):
        total += random.normal(mean, 0.8) * front * bump(np.array(center, float), radius)
    # The wrist's rim stays where the rig has it.
    total *= 1 - bump(joints[0], 12.0)
    return torch.from_numpy(total.clip(-3.5, 3.5) / 1000).float()


def motion_for_training(rig: Rig, steps: int, seed: int) -> Motion:
    """Curling over the palm, thumb opposition and free poses while the hand turns all the way."""
    generator = torch.Generator().manual_seed(seed)
    free = sample_poses(rig, 10, generator)
    keys = [gesture(rig, name) for name in TRAINING_GESTURES]
    for index, pose in enumerate(free):
        keys.insert(2 * index + 1, pose)
    share = torch.linspace(0, 1, steps)
    fingers = interpolate_rotations(torch.stack(keys), share * (len(keys) - 1))
    # Palm side first, then through the thumb's edge to the back.
    to_back = ((share - 0.5) / 0.1).clamp(0, 1)
    yaw = 180 * to_back + 70 * _wave(share, 4.3, 0.1)
    return _turning(rig, fingers, yaw, 32 * _wave(share, 2.6, 0.35), 28 * _wave(share, 5.2, 0.6))


def motion_for_testing(
    rig: Rig, steps: int, seed: int, gestures: tuple[str, ...] = TEST_GESTURES
) -> Motion:
    """Other gestures and poses than the training motion's, in similar orientations."""
    generator = torch.Generator().manual_seed(seed + 1000)
    free = sample_poses(rig, 4, generator)
    keys = [gesture(rig, name) for name in gestures]
    for index, pose in enumerate(free):
        keys.insert(3 * index + 1, pose)
    share = torch.linspace(0, 1, steps)
    fingers = interpolate_rotations(torch.stack(keys), share * (len(keys) - 1))
    yaw = 180 * ((share - 0.58) / 0.08).clamp(0, 1) + 55 * _wave(share, 3.1, 0.3)
    return _turning(rig, fingers, yaw, 24 * _wave(share, 1.7, 0.8), 22 * _wave(share, 2.9, 0.2))


def _wave(share: Tensor, cycles: float, phase: float) -> Tensor:
    return torch.sin(2 * math.pi * (cycles * share + phase))


def _turning(rig: Rig, fingers: Tensor, yaw: Tensor, pitch: Tensor, roll: Tensor) -> Motion:
    """Places finger poses in front of the camera; angles in degrees.

    Yaw turns about the forearm, pitch tilts towards the camera, roll leans to the side.
    """
    fingers = resolve_penetration(rig, fingers)
    axes = torch.eye(3)
    turn_x, turn_z, turn_y = (
        matrix_from_axis_angle(angle.deg2rad()[:, None] * axis)
        for angle, axis in ((yaw, axes[0]), (pitch, axes[2]), (roll, axes[1]))
    )
    share = torch.linspace(0, 1, len(fingers))
    drift = 0.02 * torch.stack([_wave(share, c, c / 7) for c in (1.3, 1.9, 2.3)], dim=-1)
    middle = torch.tensor(_CENTER) + drift
    return placed(rig, fingers, turn_y @ turn_z @ turn_x, middle, fps=10.0)


def crop_camera(points: Float[Tensor, "points 3"], size: int, view: int = 0) -> Camera:
    """A standing camera's view of the square around the hand, 1.3 times its box.

    View 0 is the one that training sees; the others stand 30 degrees beside, above or below it.
    """
    eye = torch.tensor(_CENTER) - torch.tensor([0.0, _CAMERA_DISTANCE, 0.0])
    if view:
        # The golden angle spreads any number of views around the first.
        around = torch.tensor((view - 1) * math.pi * (3 - math.sqrt(5)))
        axis = torch.stack([around.cos(), torch.zeros(()), around.sin()])
        turn = matrix_from_axis_angle(axis * math.radians(30))
        eye = torch.tensor(_CENTER) + turn @ (eye - torch.tensor(_CENTER))
    upright = look_at(eye, torch.tensor(_CENTER), torch.tensor([-1.0, 0.0, 0.0]))
    camera = Camera((1000.0, 1000.0), (0.0, 0.0), 1, 1, upright)
    pixels, _ = project(camera, points)
    low, high = pixels.min(0).values, pixels.max(0).values
    side = _CROP_MARGIN * float((high - low).max())
    left, top = ((low + high) / 2 - side / 2).tolist()
    zoom = size / side
    return Camera((1000 * zoom, 1000 * zoom), (-left * zoom, -top * zoom), size, size, upright)


def _frames(
    subject: Subject, motions: dict[str, Motion], options: SynthOptions
) -> Iterator[tuple[Frame, Traced, SurfaceMaps]]:
    tracer = _tracer(subject, options)
    index, time = 0, 0.0
    for split, motion in motions.items():
        for step in range(len(motion)):
            vertices = subject.posed_vertices(motion.pose(step))
            view = step % options.test_views if split == "test" else 0
            camera = crop_camera(vertices, options.size, view)
            tracer.place(vertices, camera)
            traced = tracer.trace(options.samples, seed=index)
            maps = tracer.surface_maps()
            # The flat background is put in after the fact: it lights nothing.
            color = traced.color + (1 - traced.alpha[..., None]) * _BACKGROUND**2.2
            frame = Frame(
                name=f"{index:06d}",
                image=eight_bits(srgb_from_linear(color)),
                coverage=eight_bits(traced.alpha),
                camera=camera,
                pose=motion.pose(step),
                confidence=1.0,
                split=split,
                time=time,
            )
            yield frame, traced, maps
            index, time = index + 1, time + 1 / motion.fps


def _tracer(
    subject: Subject, options: SynthOptions, hidden_bones: tuple[int, ...] = ()
) -> HandTracer:
    return HandTracer(
        subject.rig,
        subject.texture,
        LIGHTINGS[options.lighting],
        _CENTER,
        options.size,
        options.variant,
        MAX_DEPTH[options.transport],
        hidden_bones,
    )


def _noise(subject: Subject, motion: Motion, options: SynthOptions) -> float:
    """PSNR of a picture against one without noise, from two of each of three poses, decibels.

    Over pixels that the hand covers; their difference holds the noise of both.
    """
    tracer = _tracer(subject, options)
    squared = []
    for step in sorted({0, len(motion) // 2, len(motion) - 1}):
        vertices = subject.posed_vertices(motion.pose(step))
        tracer.place(vertices, crop_camera(vertices, options.size))
        first, second = (tracer.trace(options.samples, seed=1_000_000 + k) for k in range(2))
        covered = (first.alpha > 0.99) & (second.alpha > 0.99)
        difference = srgb_from_linear(first.color) - srgb_from_linear(second.color)
        squared.append(difference[covered].square().mean() / 2)
    return float(-10 * torch.stack(squared).mean().clamp_min(1e-12).log10())


def lifted_truths(
    subject: Subject,
    frames: list[Frame],
    options: SynthOptions,
    bones: tuple[int, ...],
    samples: int,
) -> Iterator[tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]]:
    """Frames' pictures without the light that some bones' skin takes or gives.

    Args:
        subject: whose hand.
        frames: of one made capture: poses and cameras.
        options: of the capture: lights, transport, size.
        bones: whose skin is taken away.
        samples: light paths per pixel.

    Yields:
        sRGB in [0, 1] on the capture's background, and where it shows the same skin as the frame
        does: not the bones, and not what they hide.
    """
    whole, rest = _tracer(subject, options), _tracer(subject, options, bones)
    for frame in frames:
        vertices = subject.posed_vertices(frame.pose)
        for tracer in (whole, rest):
            tracer.place(vertices, frame.camera)
        traced = rest.trace(samples, seed=7)
        color = traced.color + (1 - traced.alpha[..., None]) * _BACKGROUND**2.2
        depth = rest.surface_maps().depth
        is_same = (whole.surface_maps().depth - depth).abs() < _SAME_DEPTH
        is_covered = (frame.alpha > 0.99) & (traced.alpha > 0.99)
        yield srgb_from_linear(color), is_same & is_covered


def _write_subject(
    writer: CaptureWriter, subject: Subject, options: SynthOptions, noise: float
) -> None:
    arrays = {
        "rest_vertices": subject.rest_vertices,
        "plain_vertices": subject.plain_vertices,
        "shape_coefficients": subject.shape_coefficients,
    }
    subject_file = writer.file("truth/subject.safetensors")
    subject_file.write_bytes(save({k: v.contiguous() for k, v in arrays.items()}))
    facts = {
        "schema": 1,
        "options": asdict(options),
        "lights": asdict(LIGHTINGS[options.lighting]),
        "noise_psnr": round(noise, 2),
    }
    writer.file("truth/truth.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")


def _write_truth(
    writer: CaptureWriter, frame: Frame, traced: Traced, maps: SurfaceMaps, geometry: bool
) -> None:
    mask = frame.mask.float()
    albedo = srgb_from_linear(maps.albedo) * mask[..., None]
    # Light of the hand alone, without what the background adds to the pixels of its outline.
    hand = srgb_from_linear(traced.color / traced.alpha.clamp(min=1e-6)[..., None])
    shading = (hand * albedo).sum(-1) / albedo.square().sum(-1).clamp(min=1e-6) * mask

    def save(kind: str, pixels: np.ndarray) -> None:
        Image.fromarray(pixels).save(writer.file(f"truth/{kind}/{frame.name}.png"))

    save("albedo", eight_bits(albedo).numpy())
    save("shading", eight_bits(shading).numpy())
    if geometry:
        tenths = (maps.depth * 1e4 * mask).round().clamp(0, 65535)
        save("depth", tenths.numpy().astype(np.uint16))
        save("normals", eight_bits((maps.normals + 1) / 2 * mask[..., None]).numpy())


def contact_sheet(pictures: list[Tensor], columns: int = 8, cell: int = 160) -> Tensor:
    """Pictures side by side, each shrunk to ``cell`` pixels, as one 8-bit picture."""
    rows = math.ceil(len(pictures) / columns)
    sheet = Image.new("RGB", (columns * cell, rows * cell))
    for index, picture in enumerate(pictures):
        small = Image.fromarray(picture.numpy()).resize((cell, cell), Image.Resampling.LANCZOS)
        sheet.paste(small, (index % columns * cell, index // columns * cell))
    return torch.from_numpy(np.array(sheet))
