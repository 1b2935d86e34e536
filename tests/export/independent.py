"""A GLB as another reader sees it: pygltflib finds the numbers, a few lines of numpy pose them."""

import io
from typing import Any

import numpy as np
import pygltflib
from PIL import Image
from scipy.spatial.transform import Rotation

_TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Reading:
    """What a file says."""

    def __init__(self, content: bytes) -> None:
        self.gltf = pygltflib.GLTF2().load_from_bytes(content)
        self.skin = self.gltf.skins[0]
        self.names = [self.gltf.nodes[joint].name for joint in self.skin.joints]
        attributes = self.gltf.meshes[0].primitives[0].attributes
        self.vertices = self.rows(attributes.POSITION).astype(np.float64)
        self.normals = self.rows(attributes.NORMAL)
        self.places = self.rows(attributes.TEXCOORD_0)
        self.joints = self.rows(attributes.JOINTS_0)
        self.weights = self.rows(attributes.WEIGHTS_0) / 65535
        self.faces = self.rows(self.gltf.meshes[0].primitives[0].indices).reshape(-1, 3)

    def rows(self, accessor: int) -> np.ndarray:
        about = self.gltf.accessors[accessor]
        view = self.gltf.bufferViews[about.bufferView]
        width, start = _WIDTHS[about.type], view.byteOffset + (about.byteOffset or 0)
        blob = self.gltf.binary_blob()
        kind = _TYPES[about.componentType]
        return np.frombuffer(blob, kind, width * about.count, start).reshape(-1, width)

    def picture(self, image: int) -> np.ndarray:
        view = self.gltf.bufferViews[self.gltf.images[image].bufferView]
        blob = self.gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.asarray(Image.open(io.BytesIO(blob)))

    def placed(self, moved: dict[int, dict[str, Any]] | None = None) -> np.ndarray:
        """World transforms of the joints; ``moved`` overrides parts of nodes."""
        above = {c: n for n, node in enumerate(self.gltf.nodes) for c in node.children or []}

        def world(number: int) -> np.ndarray:
            node, change = self.gltf.nodes[number], (moved or {}).get(number, {})
            own = np.eye(4)
            rotation = change.get("rotation", node.rotation)
            translation = change.get("translation", node.translation)
            if rotation is not None:
                own[:3, :3] = Rotation.from_quat(rotation).as_matrix()
            if translation is not None:
                own[:3, 3] = translation
            return world(above[number]) @ own if number in above else own

        return np.stack([world(joint) for joint in self.skin.joints])

    def skinned(self, joints: np.ndarray) -> np.ndarray:
        """Vertices that the joints carry."""
        inverses = self.rows(self.skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        total = np.zeros_like(self.vertices)
        points = np.concatenate([self.vertices, np.ones((len(self.vertices), 1))], axis=1)
        for column in range(4):
            motion = (joints @ inverses)[self.joints[:, column]]
            total += self.weights[:, column, None] * np.einsum("vij,vj->vi", motion, points)[:, :3]
        return total

    def keyframe(self, step: int) -> dict[int, dict[str, Any]]:
        """What the animation sets at one of its steps."""
        animation = self.gltf.animations[0]
        moved: dict[int, dict[str, Any]] = {}
        for channel in animation.channels:
            values = self.rows(animation.samplers[channel.sampler].output)
            moved.setdefault(channel.target.node, {})[channel.target.path] = values[step]
        return moved


def rigid_fit(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and shift that bring one set of points closest to another."""
    a, b = source - source.mean(0), target - target.mean(0)
    rotation, _ = Rotation.align_vectors(b, a)
    matrix = rotation.as_matrix()
    return matrix, target.mean(0) - matrix @ source.mean(0)
