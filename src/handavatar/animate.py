"""Pictures and video of an avatar in poses and from cameras it never saw.

Several processes, also on several machines with a common disk, share the frames:
``torchrun --nproc-per-node 2 -m handavatar render RUN ...``. What was rendered before a process was
killed is kept, and the same command given again renders the rest.
"""

import io
import json
import math
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from handavatar.avatar import (
    EXACT,
    HandAvatar,
    Rendering,
    RenderSettings,
    chosen_device,
    rendering_seconds,
)
from handavatar.capture.frame_sequence import spread_numbers
from handavatar.capture.motion import gesture, open_motion
from handavatar.capture.view import camera_holding, start_of
from handavatar.edit import Edit
from handavatar.errors import ArgumentError, require_ranges
from handavatar.field.kernels import Kernel, chosen_kernel
from handavatar.geometry.cameras import Camera
from handavatar.geometry.colors import eight_bits
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import (
    FolderKind,
    UnfinishedFolder,
    files_named,
    refuse_folder_in_use,
    write_atomically,
)
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.video_writer import VideoWriter
from handavatar.processes import joined_processes
from handavatar.retouch import Look

PASSES = ("rgb", "albedo", "illumination", "normal", "depth", "alpha")
_NUMBER = "[0-9]" * 6
PICTURES = FolderKind(
    "pictures",
    (
        *(f"{name}/{_NUMBER}.png" for name in PASSES),
        *(f"{name}.mp4" for name in PASSES),
        f"errors/{_NUMBER}.json",
        "errors.json",
    ),
)
"""The folder that :func:`render_motion` makes."""


@dataclass(frozen=True)
class RenderOptions(Look):
    """What to render.

    Attributes:
        run: run folder, or an avatar file.
        motion: a motion file (JSON), or the name of a built-in motion (gestures, count, grasp,
            pinch, ripple, turn).
        out: folder for the pictures and videos; must be empty or new.
        passes: comma-separated: rgb, albedo, illumination, normal, depth, alpha.
        size: pixels along a side.
        frames: render so many frames, evenly spread; all by default.
        orbit: turn the camera once around the hand while it moves.
        num_samples: samples per ray.
        quality: ``near-exact`` looks closely only near the hand; ``exact`` leaves out nothing that
            weighs 1e-7, and takes some three times as long.
        check: of every frame so many pixels are evaluated exactly as well, and ``errors.json``
            states how far they are from the picture.
        overwrite: replace pictures that lie at ``out``; never a folder that this program did not
            write, one of another kind, or one with other files in it.
        device: where the fields run.
        kernel: what decodes pairs of parts; ``triton`` is for NVIDIA GPUs, with ``-tf32`` or
            ``-bf16`` for products of shorter numbers.
    """

    run: Path
    motion: str = "gestures"
    out: Path = Path("render")
    passes: str = "rgb"
    size: int = 256
    frames: int | None = None
    orbit: bool = False
    num_samples: int = 64
    quality: Literal["near-exact", "exact"] = "near-exact"
    check: int = 0
    overwrite: bool = False
    device: str = "auto"
    kernel: Kernel = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        super().__post_init__()
        require_ranges(
            self, size=(2, 8192), frames=(1, 10**5), num_samples=(1, 4096), check=(0, 10**6)
        )


def render_motion(options: RenderOptions, progress: Progress = SILENT) -> Path:
    """Renders a motion: one PNG per frame and pass, and one video per pass.

    Args:
        options: what to render.
        progress: told the frames done.

    Returns:
        The folder.

    Started by ``torchrun``, the processes share the frames; the first one writes the videos.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if the motion cannot be read.
        ArgumentError: for a pass or an edit that does not exist.
        FolderInUse: if ``out`` holds something that may not be replaced.
    """
    passes = tuple(word.strip() for word in options.passes.split(",") if word.strip())
    if not passes:
        raise ArgumentError("passes", f"none given; choose from {', '.join(PASSES)}")
    for name in passes:
        if name not in PASSES:
            raise ArgumentError(
                "passes", f"there is no pass '{name}'; choose from {', '.join(PASSES)}"
            )
    options.check_look()
    inputs = [options.run, *files_named(options.motion, options.paint)]
    refuse_folder_in_use(options.out, PICTURES, options.overwrite, inputs)
    device = str(chosen_device(options.device))
    kernel = chosen_kernel(options.kernel, device)
    avatar = HandAvatar.load(options.run)
    edit = options.edit_on(avatar)
    start = start_of(avatar.view(edit))
    motion = open_motion(options.motion, avatar.base_rig.to("cpu"), start)
    poses = [motion.pose(step) for step in spread_numbers(len(motion), options.frames)]
    camera = camera_on(avatar, poses, options.size, edit=edit)
    views = [camera] * len(poses)
    if options.orbit:
        middle = _middle(avatar, poses[0])
        turns = [2 * math.pi * index / len(poses) for index in range(len(poses))]
        views = [orbited(camera, middle, turn) for turn in turns]
    settings = EXACT if options.quality == "exact" else RenderSettings()
    settings = replace(settings, num_samples=options.num_samples, kernel=kernel)
    facts = _what_frames_depend_on(avatar, edit, options, poses, views)
    folder = UnfinishedFolder(options.out, PICTURES, facts, inputs)
    with joined_processes(device) as processes:
        avatar.moved_to(processes.device)
        try:
            if processes.is_first:
                folder.begin(options.overwrite)
            processes.wait()
            frames, videos = progress.stages(
                {
                    "frames": rendering_seconds(camera.width, camera.height) * len(poses),
                    "videos": 0.03 * len(poses) * len(passes),
                }
            ).values()
            for index in range(processes.rank, len(poses), processes.count):
                files = [f"{name}/{index:06d}.png" for name in passes]
                files += [f"errors/{index:06d}.json"] * (options.check > 0)
                if folder.has(files):
                    frames.skip(index + 1, len(poses))
                    continue
                frames(index, len(poses))
                pose, view = poses[index], views[index]
                rendering = avatar.render(pose, view, edit, settings)
                pictures = pass_pictures(rendering, avatar.info.get("side", "right"))
                for name in passes:
                    folder.write(f"{name}/{index:06d}.png", _png(pictures[name]))
                if options.check:
                    error = rendering_error(avatar, pose, view, settings, options.check, index)
                    folder.write(f"errors/{index:06d}.json", json.dumps(error).encode())
            processes.wait()
        except BaseException:
            if processes.is_first:
                folder.abandon()
            raise
        if processes.is_first:
            fps = motion.fps * len(poses) / len(motion)
            _join_frames(folder.path, passes, len(poses), fps, options, videos)
            folder.finish()
        processes.wait()
    return options.out


def rendering_error(
    avatar: HandAvatar,
    pose: HandPose,
    camera: Camera,
    settings: RenderSettings,
    count: int,
    seed: int = 0,
) -> dict[str, float]:
    """How far rays evaluated with these settings are from exact ones, on some pixels.

    Args:
        avatar: whose fields.
        pose: of the hand.
        camera: of the picture.
        settings: that are judged, one ray a pixel.
        count: pixels, drawn among those near the hand, of which the picture has as many or fewer.
        seed: of the draw.

    Returns:
        ``max_error`` and ``psnr`` (decibels; 200 where there is no error) of the
        colour in [0, 1], and ``pixels``, how many were compared.
    """
    with torch.no_grad():
        state = avatar.prepare(pose.to(avatar.device))
        camera = camera.to(avatar.device)
        # Twice the margin, so that what the settings' own margin cuts off is seen.
        around = avatar.near_mesh(state, camera, min(2 * settings.mask_margin, 0.25))
        pixels = around.flatten().nonzero()[:, 0]
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(pixels), generator=generator)[:count]
        pixels = pixels[order.to(pixels.device)]
        exact = replace(EXACT, num_samples=settings.num_samples)
        found, truth = (avatar.at_pixels(state, camera, pixels, way) for way in (settings, exact))
        error = found.color - truth.color
    squared = float(error.double().square().mean()) if len(pixels) else 0.0
    return {
        "max_error": float(error.abs().max()) if len(pixels) else 0.0,
        "psnr": -10 * math.log10(max(squared, 1e-20)),
        "pixels": float(len(pixels)),
    }


def _what_frames_depend_on(
    avatar: HandAvatar,
    edit: Edit,
    options: RenderOptions,
    poses: list[HandPose],
    views: list[Camera],
) -> dict[str, Any]:
    """The options but for where and how often; a fingerprint of avatar, look, poses and cameras."""
    elsewhere = ("run", "motion", "out", "frames", "orbit", "overwrite", "device", "paint", "light")
    digest = sha256()
    look = avatar.edit.then(edit)
    digest.update(repr((look.light_gain, look.albedo_shift, look.lifted_bones)).encode())
    if avatar.num_lights > 1:
        digest.update(repr(avatar.light_of(edit)).encode())
    tensors = [value for _, value in sorted(avatar.state_dict().items())]
    if look.paint is not None:
        tensors += [look.paint.colors, look.paint.opacity]
    tensors += [value for pose in poses for value in (pose.rotations, pose.translation)]
    for value in tensors:
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    for view in views:
        digest.update(repr((view.focal, view.center, view.camera_from_world.tolist())).encode())
    record = {name: value for name, value in asdict(options).items() if name not in elsewhere}
    return record | {"sha256": digest.hexdigest(), "frame_count": len(poses)}


def _join_frames(
    folder: Path,
    passes: tuple[str, ...],
    count: int,
    fps: float,
    options: RenderOptions,
    progress: Progress,
) -> None:
    """Makes the videos, and one file of the frames' errors, from what all processes wrote."""
    for number, name in enumerate(passes):
        with VideoWriter(folder / f"{name}.mp4", fps, options.size) as writer:
            for index in range(count):
                writer.add(np.asarray(Image.open(folder / name / f"{index:06d}.png")))
                progress(number * count + index + 1, len(passes) * count)
    if options.check:
        files = [folder / "errors" / f"{index:06d}.json" for index in range(count)]
        frames = [json.loads(path.read_text(encoding="utf-8")) for path in files]
        worst = max(frame["max_error"] for frame in frames)
        value = {"max_error": worst, "worst_psnr": min(frame["psnr"] for frame in frames)}
        text = json.dumps(value | {"frames": frames}, indent=2) + "\n"
        write_atomically({folder / "errors.json": text.encode()})
        for path in files:
            path.unlink()
        (folder / "errors").rmdir()


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def posed_as_seen(avatar: HandAvatar, fingers: str | Float[Tensor, "bones 3"]) -> HandPose:
    """A pose of the fingers, with the wrist as the avatar's capture has typically seen it.

    An avatar has learned its light as well: it looks right where its capture has seen the hand.

    Args:
        avatar: knows the view of its capture; the wrist is at the origin if it does not.
        fingers: name of a gesture, or rotations whose wrist plays no part.

    Raises:
        CaptureError: for a name that no gesture has.
    """
    start = start_of(avatar.view())
    if isinstance(fingers, str):
        fingers = gesture(avatar.base_rig.to("cpu"), fingers)
    return replace(start, rotations=torch.cat([start.rotations[:1], fingers[1:].cpu()]))


def camera_on(
    avatar: HandAvatar,
    poses: list[HandPose],
    size: int,
    room: float = 0.15,
    edit: Edit | None = None,
) -> Camera:
    """A square camera where the capture's was, that holds the hand in all the poses.

    Args:
        avatar: knows the view of its capture.
        poses: to be held.
        size: pixels along a side.
        room: around the hand, as a share of its longer side, half of it on either side. A camera
            that is to be carried around the hand needs more, for from there it may reach farther.
        edit: on top of the avatar's own: of several clips, its light says whose camera.
    """
    with torch.no_grad():
        rest = avatar.rig.to("cpu").shaped(avatar.coefficients.cpu())
        points = torch.cat([rest.posed(pose).vertices for pose in poses])
    middle = _middle(avatar, poses[0])
    return camera_holding(avatar.view(edit), points, middle, size, room)


def orbited(camera: Camera, center: Tensor, angle: float) -> Camera:
    """The camera carried around a point, about its own vertical axis (radians)."""
    up = camera.camera_from_world[1, :3]
    turn = matrix_from_axis_angle(up * angle)
    # Turning the camera about the point is turning the world the other way in front of it.
    world_turn = torch.eye(4)
    world_turn[:3, :3] = turn.T
    world_turn[:3, 3] = center - turn.T @ center
    return replace(camera, camera_from_world=camera.camera_from_world @ world_turn)


def pass_pictures(rendering: Rendering, side: str = "right") -> dict[str, np.ndarray]:
    """Every pass as 8-bit RGB; a left hand, which is stored mirrored, is mirrored back."""
    alpha = rendering.alpha.cpu()
    depth = rendering.depth.cpu() / alpha.clamp_min(1e-6)
    seen = alpha > 0.5
    near, far = (float(depth[seen].min()), float(depth[seen].max())) if bool(seen.any()) else (0, 1)
    closeness = ((far - depth) / max(far - near, 1e-6)).clamp(0, 1) * 0.8 + 0.2
    values = {
        "rgb": rendering.color.cpu(),
        "albedo": rendering.albedo.cpu(),
        "illumination": rendering.illumination.cpu()[..., None].expand(-1, -1, 3),
        "normal": (rendering.normal.cpu() + alpha[..., None]) / 2,
        "depth": (closeness * alpha)[..., None].expand(-1, -1, 3),
        "alpha": alpha[..., None].expand(-1, -1, 3),
    }
    pictures = {name: eight_bits(value).numpy() for name, value in values.items()}
    if side == "left":
        pictures = {name: np.ascontiguousarray(value[:, ::-1]) for name, value in pictures.items()}
    return pictures


def _middle(avatar: HandAvatar, pose: HandPose) -> Tensor:
    with torch.no_grad():
        vertices = avatar.rig.to("cpu").shaped(avatar.coefficients.cpu()).posed(pose).vertices
    return (vertices.amin(0) + vertices.amax(0)) / 2
