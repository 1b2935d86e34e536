"""Path tracing of a textured hand with Mitsuba 3 (the optional extra ``synth``).

The skin is purely diffuse: what leaves the hand is albedo times arriving light. Colours are linear
here; textures come in as sRGB. The scene is built once; per frame only vertices and camera change.
"""

import math
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.geometry.cameras import Camera
from handavatar.geometry.colors import linear_from_srgb
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import invert_rigid
from handavatar.hand.rig import Rig

Variant = Literal["auto", "llvm_ad_rgb", "scalar_rgb"]
Lighting = Literal["key", "dome", "colored"]


@dataclass(frozen=True)
class Lights:
    """A large key light from one side, a weak fill from the other, and light from everywhere.

    Strengths are the shading (irradiance over pi) of a surface that faces the light unobstructed
    at the scene's centre. Directions point from the centre to the light, in the world.
    """

    key: float = 0.74
    key_direction: tuple[float, float, float] = (-0.50, -0.58, -0.64)
    key_size: float = 0.18
    """side of the square, metres; larger is softer"""
    fill: float = 0.07
    fill_direction: tuple[float, float, float] = (0.1, -0.6, 0.8)
    ambient: float = 0.10
    key_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """of the light, linear RGB; multiplies its strength"""
    fill_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ambient_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance: float = 0.9
    """of both lights from the centre, metres"""


LIGHTINGS: dict[Lighting, Lights] = {
    "key": Lights(),
    "dome": Lights(key=0.0, fill=0.0, ambient=0.85),
    "colored": Lights(
        key=0.62,
        key_color=(1.0, 0.74, 0.5),
        fill=0.34,
        fill_color=(0.42, 0.64, 1.0),
        ambient=0.12,
        ambient_color=(0.8, 1.0, 0.85),
    ),
}
"""Key and fill; even light from everywhere; and a warm key, a strong blue fill and a greenish rest,
under which no scalar is the shading."""
MAX_DEPTH = {"full": 5, "direct": 2}
"""Vertices of a light path for all transport, and for light that comes straight from a lamp."""


@dataclass(frozen=True, eq=False)
class Traced:
    """A rendered picture.

    Attributes:
        color: linear, premultiplied by ``alpha``.
        alpha: share of the pixel the hand covers.
    """

    color: Float[Tensor, "height width 3"]
    alpha: Float[Tensor, "height width"]


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """What the camera sees of the surface, averaged over the covered part of each pixel.

    Attributes:
        albedo: linear; zero where there is no hand.
        depth: metres along the optical axis; zero where there is no hand.
        normals: unit, world; zero where there is no hand.
    """

    albedo: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]


_TRIAL = """
import drjit, mitsuba
mitsuba.set_variant("llvm_ad_rgb")
drjit.eval(mitsuba.render(mitsuba.load_dict(mitsuba.cornell_box()), spp=1))
drjit.sync_thread()
"""


@cache
def choose_variant(wanted: Variant = "auto") -> str:
    """The fastest Mitsuba variant that works on this machine.

    A missing or broken LLVM library can end the whole process, so it is tried in another one, by a
    small picture: versions 15 and 16 add numbers, and abort where rays are traced.

    Raises:
        CaptureError: if Mitsuba is not installed.
    """
    _mitsuba()
    if wanted != "auto":
        return wanted
    try:
        done = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return "scalar_rgb"
    return "llvm_ad_rgb" if done.returncode == 0 else "scalar_rgb"


class HandTracer:
    """A scene with one hand whose vertices and camera can be changed."""

    def __init__(
        self,
        rig: Rig,
        texture: Float[Tensor, "rows columns 3"],
        lights: Lights,
        center: tuple[float, float, float],
        size: int,
        variant: Variant = "auto",
        max_depth: int = MAX_DEPTH["full"],
        hidden_bones: tuple[int, ...] = (),
    ) -> None:
        """Builds the scene.

        Args:
            rig: gives faces, texture chart and the wrist's rim; vertices come with each frame.
            texture: sRGB albedo in [0, 1].
            lights: as they stand around ``center``.
            center: metres, world.
            size: width and height of the pictures, pixels.
            variant: of Mitsuba.
            max_depth: one of ``MAX_DEPTH``.
            hidden_bones: bones whose skin is left out; the other's shape and normals stay.
        """
        self.mi = _mitsuba()
        self.mi.set_variant(choose_variant(variant))
        self.rig, self.size = rig, size
        owner = rig.skin_weights.argmax(-1)[rig.faces]
        stays = ~torch.isin(owner, torch.tensor(hidden_bones, dtype=torch.long)).all(-1)
        faces, uv_faces = rig.faces[stays], rig.uv_faces[stays]
        corners = np.stack([faces.numpy().ravel(), uv_faces.numpy().ravel()], axis=-1)
        # A vertex on a seam of the chart has several texture coordinates: one copy for each.
        split, which = np.unique(corners, axis=0, return_inverse=True)
        self._source = torch.from_numpy(split[:, 0])
        linear = linear_from_srgb(texture).numpy().astype(np.float32)
        skin = {
            "type": "bitmap",
            "bitmap": self.mi.Bitmap(linear),
            "raw": True,
            "wrap_mode": "clamp",
        }
        uv = rig.uv_coordinates.numpy()[split[:, 1]]
        hand = self._mesh("hand", len(split), which.reshape(-1, 3), skin, uv)
        rim = len(rig.rim)
        fan = np.stack([np.roll(np.arange(rim), -1), np.arange(rim), np.full(rim, rim)], axis=-1)
        cap_color = self._rim_color(linear)
        cap = self._mesh("cap", rim + 1, fan, {"type": "rgb", "value": cap_color.tolist()}, None)
        ambient = [lights.ambient * part for part in lights.ambient_color]
        scene = {
            "type": "scene",
            "hand": hand,
            "cap": cap,
            "sensor": self._sensor(),
            "ambient": {"type": "constant", "radiance": {"type": "rgb", "value": ambient}},
        }
        # A lamp without light would still be asked for its share of the samples.
        if lights.key:
            scene["key"] = self._panel(
                lights.key, lights.key_color, lights.key_direction, lights.key_size, lights, center
            )
        if lights.fill:
            scene["fill"] = self._panel(
                lights.fill, lights.fill_color, lights.fill_direction, 0.6, lights, center
            )
        self.scene = self.mi.load_dict(scene)
        self.params = self.mi.traverse(self.scene)
        path = {"type": "path", "max_depth": max_depth, "hide_emitters": True}
        self._path = self.mi.load_dict(path)
        self._maps = self.mi.load_dict(
            {"type": "aov", "aovs": "albedo:albedo,place:position,normal:sh_normal"}
        )
        # With one bounce less, scalar_rgb leaves the alpha of hidden emitters at zero.
        self._coverage = self.mi.load_dict({**path, "max_depth": 2})

    def place(self, vertices: Float[Tensor, "vertices 3"], camera: Camera) -> None:
        """Moves the hand and the camera.

        Args:
            vertices: of the rig without the one that closes the wrist, metres, world.
            camera: square pixels and pictures of the tracer's size.
        """
        normals = vertex_normals(vertices, self.rig.faces)
        params, rim = self.params, self.rig.rim
        params["hand.vertex_positions"] = vertices[self._source].reshape(-1).numpy()
        params["hand.vertex_normals"] = normals[self._source].reshape(-1).numpy()
        rim_vertices = torch.cat([vertices[rim], vertices[rim].mean(0, keepdim=True)])
        params["cap.vertex_positions"] = rim_vertices.reshape(-1).numpy()
        world_from_camera = invert_rigid(camera.camera_from_world.double()).numpy()
        # Mitsuba's cameras have x to the left and y up.
        to_world = world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
        params["sensor.to_world"] = self.mi.ScalarTransform4f(to_world)
        params["sensor.x_fov"] = 2 * math.degrees(math.atan(camera.width / 2 / camera.focal[0]))
        params["sensor.principal_point_offset_x"] = 0.5 - camera.center[0] / camera.width
        params["sensor.principal_point_offset_y"] = 0.5 - camera.center[1] / camera.height
        params.update()
        self._camera = camera

    def trace(self, samples: int, seed: int) -> Traced:
        """The picture; ``samples`` paths per pixel."""
        pixels = self._rendered(self._path, samples, seed)
        return Traced(pixels[..., :3], pixels[..., 3])

    def surface_maps(self, samples: int = 16) -> SurfaceMaps:
        """Albedo, depth and normals of what is seen."""
        sums = self._rendered(self._maps, samples, 0)[..., -9:]
        # Misses count as zero in the averages: divide by the covered share of the pixel. The same
        # seed sends the same camera rays.
        alpha = self._rendered(self._coverage, samples, 0)[..., 3:]
        albedo, places, normals = (sums / alpha.clamp(min=1e-6)).split(3, dim=-1)
        row = self._camera.camera_from_world[2]
        depth = (places @ row[:3] + row[3]) * (alpha[..., 0] > 0)
        return SurfaceMaps(albedo, depth, torch.nn.functional.normalize(normals, dim=-1))

    def _rendered(
        self, integrator: Any, samples: int, seed: int
    ) -> Float[Tensor, "height width c"]:
        picture = self.mi.render(self.scene, integrator=integrator, spp=samples, seed=seed)
        return torch.from_numpy(np.array(picture, dtype=np.float32))

    def _mesh(
        self, name: str, count: int, faces: np.ndarray, color: dict[str, Any], uv: np.ndarray | None
    ) -> Any:
        mi = self.mi
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(
            {"type": "twosided", "nested": {"type": "diffuse", "reflectance": color}}
        )
        mesh = mi.Mesh(
            name,
            vertex_count=count,
            face_count=len(faces),
            has_vertex_normals=uv is not None,
            has_vertex_texcoords=uv is not None,
            props=properties,
        )
        params = mi.traverse(mesh)
        params["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
        if uv is not None:
            params["vertex_texcoords"] = np.ascontiguousarray(uv, dtype=np.float32).ravel()
        params.update()
        return mesh

    def _rim_color(self, linear: np.ndarray) -> np.ndarray:
        """Mean colour of the skin along the wrist's rim."""
        on_rim = torch.isin(self.rig.faces, self.rig.rim)
        uv = self.rig.uv_coordinates[self.rig.uv_faces[on_rim]].numpy()
        row, column = (uv[:, 1] * len(linear)).astype(int), (uv[:, 0] * len(linear)).astype(int)
        return linear[row.clip(0, len(linear) - 1), column.clip(0, len(linear) - 1)].mean(0)

    def _sensor(self) -> dict[str, Any]:
        return {
            "type": "perspective",
            "fov": 20.0,
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 100.0,
            "principal_point_offset_x": 0.0,
            "principal_point_offset_y": 0.0,
            "film": {
                "type": "hdrfilm",
                "width": self.size,
                "height": self.size,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter"},
        }

    def _panel(
        self,
        strength: float,
        color: tuple[float, float, float],
        direction: tuple[float, float, float],
        side: float,
        lights: Lights,
        center: tuple[float, float, float],
    ) -> dict[str, Any]:
        """A square light that faces the centre."""
        unit = np.array(direction) / np.linalg.norm(direction)
        origin = np.array(center) + lights.distance * unit
        to_world = self.mi.ScalarTransform4f().look_at(
            origin=origin.tolist(), target=list(center), up=[0.31, 0.47, 0.83]
        )
        bright = strength * math.pi * lights.distance**2 / side**2
        radiance = [bright * part for part in color]
        return {
            "type": "rectangle",
            "to_world": to_world @ self.mi.ScalarTransform4f().scale([side / 2, side / 2, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        }


def _mitsuba() -> Any:
    try:
        import mitsuba
    except ImportError as error:
        raise CaptureError(
            "made captures need Mitsuba, which is not installed",
            'pip install "handavatar[synth]"',
        ) from error
    return mitsuba
