"""Pictures and video of an avatar in poses and from cameras it never saw."""

import math
import shutil
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from handavatar.avatar import HandAvatar, Rendering, RenderSettings, chosen_device
from handavatar.capture.motion import MOTIONS, Motion, named_motion, read_motion
from handavatar.edit import Edit, bones_named
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose

PASSES = ("rgb", "albedo", "illumination", "normal", "depth", "alpha")


@dataclass(frozen=True)
class RenderOptions:
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
        light_gain: multiplies the illumination.
        albedo_shift: added to the albedo, R,G,B in [-1, 1].
        lift_shadow: fingers or bones that cast no shadow, comma-separated.
        overwrite: replace what lies at ``out``.
        device: where the fields run.
    """

    run: Path
    motion: str = "gestures"
    out: Path = Path("render")
    passes: str = "rgb"
    size: int = 256
    frames: int | None = None
    orbit: bool = False
    num_samples: int = 64
    light_gain: float = 1.0
    albedo_shift: str = "0,0,0"
    lift_shadow: str = ""
    overwrite: bool = False
    device: str = "auto"


def render_motion(options: RenderOptions) -> Path:
    """Renders a motion: one PNG per frame and pass, and one video per pass.

    Returns:
        The folder.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if the motion cannot be read.
        ValueError: for a pass or an edit that does not exist, or a folder that is not empty.
    """
    for flag, value, least in (
        ("--size", options.size, 2),
        ("--frames", 1 if options.frames is None else options.frames, 1),
        ("--num-samples", options.num_samples, 1),
    ):
        if value < least:
            raise ValueError(f"{flag} {value}: expected at least {least}")
    passes = tuple(word.strip() for word in options.passes.split(",") if word.strip())
    if not passes:
        raise ValueError(f"--passes: none given; choose from {', '.join(PASSES)}")
    for name in passes:
        if name not in PASSES:
            raise ValueError(
                f"--passes: there is no pass '{name}'; choose from {', '.join(PASSES)}"
            )
    edit = edit_from(options.light_gain, options.albedo_shift, options.lift_shadow)
    avatar = HandAvatar.load(options.run)
    avatar.moved_to(chosen_device(options.device))
    motion = _chosen_motion(avatar, options.motion)
    steps = _spread(len(motion), options.frames)
    poses = [motion.pose(step) for step in steps]
    camera = camera_on(avatar, poses, options.size)
    fps = motion.fps * len(steps) / len(motion)
    settings = RenderSettings(num_samples=options.num_samples)
    with _new_folder(options.out, options.overwrite) as folder:
        writers = {name: VideoWriter(folder / f"{name}.mp4", fps, options.size) for name in passes}
        for index, pose in enumerate(poses):
            view = camera
            if options.orbit:
                view = orbited(camera, _middle(avatar, poses[0]), 2 * math.pi * index / len(poses))
            rendering = avatar.render(pose, view, edit, settings)
            for name, pixels in pass_pictures(rendering, avatar.info.get("side", "right")).items():
                if name in passes:
                    (folder / name).mkdir(exist_ok=True)
                    Image.fromarray(pixels).save(folder / name / f"{index:06d}.png")
                    writers[name].add(pixels)
        for writer in writers.values():
            writer.close()
    return options.out


def edit_from(light_gain: float, albedo_shift: str, lift_shadow: str) -> Edit:
    """The edit that the command line's flags describe.

    Raises:
        ValueError: what cannot be understood.
    """
    try:
        red, green, blue = (float(word) for word in albedo_shift.split(","))
    except ValueError as error:
        raise ValueError(
            f"--albedo-shift {albedo_shift}: expected three numbers, such as 0.1,0,-0.05"
        ) from error
    numbers = (light_gain, red, green, blue)
    if not all(math.isfinite(value) for value in numbers) or light_gain < 0:
        raise ValueError(
            "--light-gain and --albedo-shift: expected finite numbers, gain not below 0"
        )
    names = tuple(word.strip() for word in lift_shadow.split(",") if word.strip())
    return Edit(light_gain, (red, green, blue), bones_named(names))


def camera_on(avatar: HandAvatar, poses: list[HandPose], size: int) -> Camera:
    """A square camera where the capture's was, that holds the hand in all the poses.

    Args:
        avatar: knows the view of its capture.
        poses: to be held.
        size: pixels along a side.
    """
    view = avatar.info.get("view")
    if view is None:
        middle = _middle(avatar, poses[0])
        placed = look_at(
            middle + torch.tensor([0.0, -0.6, 0.0]), middle, torch.tensor([-1.0, 0, 0])
        )
    else:
        placed = torch.tensor(view["camera_from_world"])
    wide = Camera((1.0, 1.0), (0.0, 0.0), 1, 1, placed)
    with torch.no_grad():
        rest = avatar.rig.to("cpu").shaped(avatar.coefficients.cpu())
        seen = torch.cat([project(wide, rest.posed(pose).vertices)[0] for pose in poses])
    lower, upper = seen.amin(0), seen.amax(0)
    side = float((upper - lower).max()) * 1.15
    left, top = ((lower + upper) / 2 - side / 2).tolist()
    focal = size / side
    return Camera((focal, focal), (-left * focal, -top * focal), size, size, placed)


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
    pictures = {
        name: (value.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        for name, value in values.items()
    }
    if side == "left":
        pictures = {name: np.ascontiguousarray(value[:, ::-1]) for name, value in pictures.items()}
    return pictures


class VideoWriter:
    """Writes RGB pictures into an H.264 video that every player opens."""

    def __init__(self, path: Path, fps: float, size: int) -> None:
        """Opens the file; pictures of odd size lose their last row and column.

        Args:
            path: ends in ``.mp4``.
            fps: pictures per second.
            size: pixels along a side.
        """
        self._even = size // 2 * 2
        self._container = av.open(str(path), "w")
        rate = Fraction(fps).limit_denominator(1000)
        self._stream: Any = self._container.add_stream("libx264", rate=rate)
        self._stream.width = self._stream.height = self._even
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "18"}

    def add(self, pixels: np.ndarray) -> None:
        """Adds one picture, (size, size, 3), 8 bit."""
        cut = np.ascontiguousarray(pixels[: self._even, : self._even])
        frame = av.VideoFrame.from_ndarray(cut, format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finishes the file."""
        self._container.mux(self._stream.encode())
        self._container.close()


def _chosen_motion(avatar: HandAvatar, name: str) -> Motion:
    if name not in MOTIONS:
        return read_motion(Path(name))
    view = avatar.info.get("view")
    start = HandPose.flat()
    if view is not None:
        start = HandPose(torch.tensor(view["rotations"]), torch.tensor(view["translation"]))
    return named_motion(avatar.base_rig.to("cpu"), name, start)


def _spread(length: int, count: int | None) -> list[int]:
    if count is None or count >= length:
        return list(range(length))
    return torch.linspace(0, length - 1, count).round().long().tolist()


def _middle(avatar: HandAvatar, pose: HandPose) -> Tensor:
    with torch.no_grad():
        vertices = avatar.rig.to("cpu").shaped(avatar.coefficients.cpu()).posed(pose).vertices
    return (vertices.amin(0) + vertices.amax(0)) / 2


class _new_folder:
    """Fills a folder aside and renames it into place, so that nothing is half written."""

    def __init__(self, target: Path, overwrite: bool) -> None:
        if target.exists() and (not target.is_dir() or any(target.iterdir())) and not overwrite:
            raise ValueError(f"--out {target}: not empty; name another, or add --overwrite")
        self._target = target
        self._aside = target.with_name(target.name + ".unfinished")

    def __enter__(self) -> Path:
        shutil.rmtree(self._aside, ignore_errors=True)
        self._aside.mkdir(parents=True)
        return self._aside

    def __exit__(self, kind: Any, *_: Any) -> None:
        if kind is not None:
            shutil.rmtree(self._aside, ignore_errors=True)
            return
        if self._target.exists():
            shutil.rmtree(self._target)
        self._aside.rename(self._target)
