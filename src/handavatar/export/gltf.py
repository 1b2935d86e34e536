"""Binary glTF 2.0 of a skinned, textured mesh. Knows nothing of avatars.

Lengths in metres, +y up, right-handed; the base colour texture holds sRGB and the occlusion texture
linear values, as glTF defines them.
"""

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.rotations import invert_rigid, quaternion_from_matrix

ROUGHNESS = 0.55
"""Of skin, about."""
_WHOLE = 65535
_FLOAT, _BYTE, _SHORT, _INT = 5126, 5121, 5123, 5125
_VERTEX_DATA, _FACE_DATA = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP = 9729, 9987, 33071
_JSON, _BIN = b"JSON", b"BIN\0"
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation: where the joints are at equal steps of time.

    Attributes:
        name: of the animation.
        fps: steps per second.
        file_from_joint: rigid transforms.
    """

    name: str
    fps: float
    file_from_joint: Float[Tensor, "steps joints 4 4"]


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """What a file holds.

    Attributes:
        name: of the object.
        vertices: metres, in the rest pose.
        normals: unit, outwards.
        places: texture coordinates, (0, 0) the upper left corner of the pictures.
        faces: counter-clockwise seen from outside.
        joints: that move each vertex; the first joint where the share is 0.
        shares: of each of them, in units of 1/65535; rows sum to 65535.
        joint_names: as engines look for them.
        parents: joint that each joint hangs on, -1 for none.
        file_from_joint: rigid transforms of the joints in the rest pose.
        base_color: PNG.
        occlusion: PNG, or nothing.
        is_unlit: the base colour is what is seen; no light of the engine changes it.
        clip: an animation, or none.
        facts: kept in the file for whoever asks; must be JSON.
    """

    name: str
    vertices: Float[Tensor, "vertices 3"]
    normals: Float[Tensor, "vertices 3"]
    places: Float[Tensor, "vertices 2"]
    faces: Int[Tensor, "faces 3"]
    joints: Int[Tensor, "vertices influences"]
    shares: Int[Tensor, "vertices influences"]
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    file_from_joint: Float[Tensor, "joints 4 4"]
    base_color: bytes
    occlusion: bytes = b""
    is_unlit: bool = False
    clip: Clip | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def glb_bytes(mesh: SkinnedMesh, generator: str) -> bytes:
    """The file.

    The scene's one root is the skinned mesh, and the joints hang on it: whoever takes the scene's
    first child has all of the hand.

    Args:
        mesh: what to write.
        generator: name and version of the program.
    """
    data = _Data()
    attributes = {
        "POSITION": data.vertices(mesh.vertices, has_bounds=True),
        "NORMAL": data.vertices(torch.nn.functional.normalize(mesh.normals, dim=-1)),
        "TEXCOORD_0": data.vertices(mesh.places),
        "JOINTS_0": data.accessor(mesh.joints.numpy().astype(np.uint8), _BYTE, _VERTEX_DATA),
        "WEIGHTS_0": data.accessor(
            mesh.shares.numpy().astype(np.uint16), _SHORT, _VERTEX_DATA, is_normalized=True
        ),
    }
    indices = mesh.faces.numpy().reshape(-1, 1)
    is_small = len(mesh.vertices) < _WHOLE  # The last number of a kind means another thing.
    primitive = {
        "attributes": attributes,
        "indices": data.accessor(
            indices.astype(np.uint16 if is_small else np.uint32),
            _SHORT if is_small else _INT,
            _FACE_DATA,
        ),
        "material": 0,
    }
    inverses = invert_rigid(mesh.file_from_joint.double()).mT.float().flatten(1)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": generator, "extras": mesh.facts},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": _nodes(mesh),
        "meshes": [{"name": mesh.name, "primitives": [primitive]}],
        "skins": [
            {
                "name": mesh.name,
                "joints": list(range(1, 1 + len(mesh.joint_names))),
                "inverseBindMatrices": data.accessor(inverses.numpy(), _FLOAT),
            }
        ],
        **_material(mesh, data),
    }
    if mesh.clip is not None:
        document["animations"] = [_animation(mesh, mesh.clip, data)]
    document["accessors"], document["bufferViews"] = data.accessors, data.views
    document["buffers"] = [{"byteLength": len(data.content)}]
    return _packed(document, bytes(data.content))


class _Data:
    """The binary part, and who finds what in it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        self.content += b"\0" * (-len(self.content) % 4)
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self.content),
            "byteLength": len(content),
        }
        self.views.append(view | ({} if target is None else {"target": target}))
        self.content += content
        return len(self.views) - 1

    def accessor(
        self,
        values: np.ndarray,
        component: int,
        target: int | None = None,
        is_normalized: bool = False,
        has_bounds: bool = False,
    ) -> int:
        rows = np.ascontiguousarray(values)
        about: dict[str, Any] = {
            "bufferView": self.view(rows.tobytes(), target),
            "componentType": component,
            "count": len(rows),
            "type": _KINDS[rows.shape[1]],
        }
        if is_normalized:
            about["normalized"] = True
        if has_bounds:
            about |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(about)
        return len(self.accessors) - 1

    def vertices(self, values: Tensor, has_bounds: bool = False) -> int:
        return self.accessor(values.float().numpy(), _FLOAT, _VERTEX_DATA, has_bounds=has_bounds)


def _nodes(mesh: SkinnedMesh) -> list[dict[str, Any]]:
    """The mesh, then the joints; joint ``i`` is node ``i + 1``."""
    translations, rotations = _local(mesh.file_from_joint[None], mesh.parents)
    nodes: list[dict[str, Any]] = [{"name": mesh.name, "mesh": 0, "skin": 0}]
    for joint, name in enumerate(mesh.joint_names):
        nodes.append(
            {
                "name": name,
                "translation": translations[0, joint].tolist(),
                "rotation": rotations[0, joint].tolist(),
            }
        )
    for parent in (-1, *range(len(mesh.parents))):
        children = [1 + joint for joint, above in enumerate(mesh.parents) if above == parent]
        if children:
            nodes[1 + parent]["children"] = children
    return nodes


def _local(
    file_from_joint: Float[Tensor, "steps joints 4 4"], parents: tuple[int, ...]
) -> tuple[Float[Tensor, "steps joints 3"], Float[Tensor, "steps joints 4"]]:
    """Translations (metres) and rotations (quaternions x, y, z, w) relative to the parents."""
    each = file_from_joint.double()
    local = [
        each[:, joint] if above < 0 else invert_rigid(each[:, above]) @ each[:, joint]
        for joint, above in enumerate(parents)
    ]
    stacked = torch.stack(local, dim=1)
    rotations = quaternion_from_matrix(stacked[..., :3, :3]).roll(-1, dims=-1)
    # Of the two quaternions of a rotation, the nearer to the step before.
    agree = (rotations[1:] * rotations[:-1]).sum(-1, keepdim=True)
    signs = torch.where(agree < 0, -1.0, 1.0).cumprod(0)
    rotations = torch.cat([rotations[:1], rotations[1:] * signs])
    return stacked[..., :3, 3].float(), torch.nn.functional.normalize(rotations, dim=-1).float()


def _material(mesh: SkinnedMesh, data: _Data) -> dict[str, Any]:
    pictures = [mesh.base_color, mesh.occlusion] if mesh.occlusion else [mesh.base_color]
    material: dict[str, Any] = {
        "name": "skin",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0,
            "roughnessFactor": ROUGHNESS,
        },
        "doubleSided": True,  # The wrist is open.
    }
    if mesh.occlusion:
        material["occlusionTexture"] = {"index": 1}
    used: dict[str, Any] = {}
    if mesh.is_unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
        used["extensionsUsed"] = ["KHR_materials_unlit"]
    sampler = {
        "magFilter": _LINEAR,
        "minFilter": _LINEAR_MIPMAP_LINEAR,
        "wrapS": _CLAMP,
        "wrapT": _CLAMP,
    }
    names = ("albedo", "occlusion")
    return used | {
        "materials": [material],
        "samplers": [sampler],
        "textures": [{"sampler": 0, "source": number} for number in range(len(pictures))],
        "images": [
            {"name": name, "mimeType": "image/png", "bufferView": data.view(picture)}
            for name, picture in zip(names, pictures, strict=False)
        ],
    }


def _animation(mesh: SkinnedMesh, clip: Clip, data: _Data) -> dict[str, Any]:
    """Every joint's rotation, and the place of those that do not only turn about their parent."""
    translations, rotations = _local(clip.file_from_joint, mesh.parents)
    rest, _ = _local(mesh.file_from_joint[None], mesh.parents)
    steps = torch.arange(len(translations), dtype=torch.float64)[:, None] / clip.fps
    times = data.accessor(steps.float().numpy(), _FLOAT, has_bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for joint in range(len(mesh.joint_names)):
        tracks = {"rotation": rotations[:, joint]}
        if float((translations[:, joint] - rest[:, joint]).abs().max()) > 1e-7:
            tracks["translation"] = translations[:, joint]
        for path, values in tracks.items():
            output = data.accessor(values.numpy(), _FLOAT)
            channels.append({"sampler": len(samplers), "target": {"node": 1 + joint, "path": path}})
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    return {"name": clip.name, "samplers": samplers, "channels": channels}


def _packed(document: dict[str, Any], content: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    content += b"\0" * (-len(content) % 4)
    body = b"".join(
        struct.pack("<I4s", len(chunk), kind) + chunk
        for kind, chunk in ((_JSON, text), (_BIN, content))
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
