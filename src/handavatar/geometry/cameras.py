"""Pinhole cameras in OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

import math
from dataclasses import dataclass, replace
from numbers import Integral

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.errors import ArgumentError
from handavatar.geometry.rotations import rigid_transform
from handavatar.geometry.tensors import is_finite_number, require_tensor

_RIGID = 1e-3
"""How far the entries of a rotation times its transpose may be from those of the identity."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        focal: focal lengths (x, y), pixels.
        center: principal point (x, y), pixels; the centre of the first pixel is (0.5, 0.5).
        width: image width, pixels.
        height: image height, pixels.
        camera_from_world: rigid transform, metres, OpenCV camera axes.

    Raises:
        ArgumentError: if a length or size cannot be, or the transform is no 4 x 4 tensor of floats,
            or, on a CPU, not rigid: it may not mirror or scale.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    width: int
    height: int
    camera_from_world: Float[Tensor, "4 4"]

    def __post_init__(self) -> None:
        """Refuses what is no camera."""
        for name, least in (("focal", 0.0), ("center", -math.inf)):
            pair = getattr(self, name)
            if not (_are_two_numbers(pair) and min(pair) > least):
                expected = "two finite numbers" + (" above zero" if least == 0 else "")
                raise ArgumentError(f"Camera.{name}", str(pair)[:60], f"{expected}, pixels")
        for name in ("width", "height"):
            size = getattr(self, name)
            if not (isinstance(size, Integral) and int(size) >= 1):
                raise ArgumentError(f"Camera.{name}", str(size)[:60], "a whole number, at least 1")
        require_tensor("Camera.camera_from_world", self.camera_from_world, (4, 4))
        # A GPU would have to be waited for, and cameras are made on the CPU.
        if self.camera_from_world.device.type == "cpu":
            _require_rigid(self.camera_from_world.detach().double())

    def to(self, device: torch.device | str) -> "Camera":
        """The same camera with its transform on another device."""
        return replace(self, camera_from_world=self.camera_from_world.to(device))

    def resized(self, width: int, height: int) -> "Camera":
        """The same view with another number of pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self,
            focal=(self.focal[0] * x, self.focal[1] * y),
            center=(self.center[0] * x, self.center[1] * y),
            width=width,
            height=height,
        )

    def cropped(self, left: float, top: float, width: float, height: float) -> "Camera":
        """The view through a window of the image; the window may leave the image.

        Args:
            left: left border of the window, pixels of this camera.
            top: top border.
            width: width of the window; rounded to whole pixels of the new image.
            height: height of the window.
        """
        return replace(
            self,
            center=(self.center[0] - left, self.center[1] - top),
            width=round(width),
            height=round(height),
        )


def _are_two_numbers(value: object) -> bool:
    return (
        isinstance(value, tuple | list)
        and len(value) == 2
        and all(is_finite_number(number) for number in value)
    )


def _require_rigid(transform: Tensor) -> None:
    rotation = transform[:3, :3]
    excess = (rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max()
    # An inverse that was computed in general has rounding in its last row.
    last = (transform[3] - transform.new_tensor([0.0, 0, 0, 1])).abs().max()
    if bool((excess < _RIGID) & (last < _RIGID)) and bool(transform.isfinite().all()):
        if float(torch.linalg.det(rotation)) > 0:
            return
        raise ArgumentError(
            "Camera.camera_from_world",
            "a mirrored camera (its determinant is -1)",
            "a rotation and a translation",
            "turn two axes and not one: OpenCV's are x right, y down, z forward",
        )
    raise ArgumentError(
        "Camera.camera_from_world",
        f"a matrix that is not rigid: {[[round(v, 3) for v in row] for row in transform.tolist()]}",
        "a rotation and a translation, last row 0 0 0 1",
    )


@dataclass(frozen=True, eq=False)
class Rays:
    """Half lines in world space.

    Attributes:
        origins: metres.
        directions: unit length.
    """

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]


def pixel_centers(camera: Camera) -> Float[Tensor, "height width 2"]:
    """Centres (x, y) of all pixels, at +0.5."""
    device = camera.camera_from_world.device
    y, x = torch.meshgrid(
        torch.arange(camera.height, device=device),
        torch.arange(camera.width, device=device),
        indexing="ij",
    )
    return torch.stack([x, y], dim=-1).to(camera.camera_from_world.dtype) + 0.5


def rays_through_pixels(camera: Camera, pixels: Float[Tensor, "rays 2"]) -> Rays:
    """World-space rays from the camera centre through image points (x, y) in pixels."""
    focal = pixels.new_tensor(camera.focal)
    center = pixels.new_tensor(camera.center)
    in_camera = torch.cat([(pixels - center) / focal, torch.ones_like(pixels[:, :1])], dim=-1)
    rotation = camera.camera_from_world[:3, :3]
    directions = torch.nn.functional.normalize(in_camera @ rotation, dim=-1)
    origin = -(camera.camera_from_world[:3, 3] @ rotation)
    return Rays(origin.expand_as(directions), directions)


def project(
    camera: Camera, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Image positions in pixels, and depths along the optical axis in metres.

    Points at or behind the camera plane give positions that mean nothing; check the depth.
    """
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    in_camera = points @ rotation.T + translation
    depth = in_camera[..., 2]
    safe = torch.where(depth.abs() < 1e-9, torch.full_like(depth, 1e-9), depth)
    pixels = in_camera[..., :2] / safe[..., None] * points.new_tensor(camera.focal)
    return pixels + points.new_tensor(camera.center), depth


def framing_camera(
    points: Float[Tensor, "points 3"],
    direction: tuple[float, float, float],
    size: int,
    distance: float,
    room: float,
) -> Camera:
    """A square camera that sees all points, with the x axis downwards.

    Args:
        points: world, metres.
        direction: from the middle of the points towards the camera; not along x.
        size: pixels along a side.
        distance: of the camera from the middle, metres.
        room: the picture's side for the longest side of the points' box.
    """
    lower, upper = points.amin(0), points.amax(0)
    middle, reach = (lower + upper) / 2, float((upper - lower).max())
    towards = torch.nn.functional.normalize(points.new_tensor(direction), dim=0)
    focal = size * (distance - reach / 2) / (room * reach)
    pose = look_at(middle + distance * towards, middle, points.new_tensor([-1.0, 0.0, 0.0]))
    return Camera((focal, focal), (size / 2, size / 2), size, size, pose)


def look_at(
    eye: Float[Tensor, "*batch 3"], target: Float[Tensor, "3"], up: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """``camera_from_world`` of a camera at ``eye`` that looks at ``target``, ``up`` upwards."""
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=-2)
    return rigid_transform(rotation, -(rotation @ eye[..., None])[..., 0])
