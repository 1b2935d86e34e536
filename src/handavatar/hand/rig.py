"""A hand rig and its stages: ``Rig -> ShapedHand -> PosedHand``.

The types carry the stage: only a shaped hand can be posed, only a posed hand has a place in the
world. The wrist of the mesh is open; ``sealed_*`` adds one vertex, the mean of the rim, and a fan
of faces, for everything that asks what is inside.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.errors import ErrorKind, HandAvatarError
from handavatar.geometry.meshes import boundary_loop
from handavatar.geometry.tensors import require_tensor
from handavatar.hand.pose import NUM_BONES, HandPose, bone_transforms, linear_blend_skinning
from handavatar.hand.pose_features import NUM_POSE_FEATURES, pose_features

RIG_ARRAYS = (
    "template_vertices",
    "faces",
    "skin_weights",
    "joint_regressor",
    "shape_directions",
    "uv_coordinates",
    "uv_faces",
    "joint_axes",
)
"""What every rig has; files of rigs and avatars store these by name."""


class RigError(HandAvatarError):
    """A rig that cannot be used: what was found, what was expected, what to do."""


class LicensedRigMissing(RigError):
    """A rig that may not ship and is not here: which, and where to get it."""

    kind = ErrorKind.LICENSED_FILE_MISSING


@dataclass(frozen=True, eq=False)
class Rig:
    """A parametric hand: template, skinning, shape space.

    Attributes:
        name: e.g. ``open-hand``.
        template_vertices: mean hand in the zero pose, metres, wrist joint near the origin, right
            hand, fingers along -x, back of the hand towards +y, thumb side +z (MANO's axes).
        faces: outward winding, open at the wrist.
        skin_weights: rows sum to 1.
        joint_regressor: rest joints are this times the rest vertices.
        shape_directions: displacement in metres per unit of each shape coefficient.
        uv_coordinates: texture coordinates in [0, 1].
        uv_faces: for each face corner, its texture coordinate.
        joint_axes: per bone the unit flexion, abduction and twist axes in rest axes.
        vertex_sets: named vertices, such as ``fingertips`` or ``nail_thumb``.
        pose_directions: displacement in metres per unit of each entry of the finger bones'
            rotation matrices minus identity, nine per bone, row by row; no columns if the rig has
            no pose blend shapes.
        is_licensed: its arrays may not be given on: files name it by its fingerprint alone.
    """

    name: str
    template_vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    skin_weights: Float[Tensor, "vertices bones"]
    joint_regressor: Float[Tensor, "bones vertices"]
    shape_directions: Float[Tensor, "vertices 3 shapes"]
    uv_coordinates: Float[Tensor, "uvs 2"]
    uv_faces: Int[Tensor, "faces 3"]
    joint_axes: Float[Tensor, "bones 3 3"]
    vertex_sets: dict[str, Int[Tensor, "_"]] = field(default_factory=dict)
    pose_directions: Float[Tensor, "vertices 3 poses"] = field(
        default_factory=lambda: torch.zeros(0, 3, 0)
    )
    is_licensed: bool = False

    def __post_init__(self) -> None:
        """Refuses arrays that contradict each other."""
        self._require_shapes()
        num_vertices = len(self.template_vertices)
        if self.pose_directions.numel() == 0:
            none = self.template_vertices.new_zeros(num_vertices, 3, 0)
            object.__setattr__(self, "pose_directions", none)
        elif self.pose_directions.shape != (num_vertices, 3, NUM_POSE_FEATURES):
            raise RigError(
                f"rig {self.name}: pose_directions have shape "
                f"{tuple(self.pose_directions.shape)}, expected "
                f"({num_vertices}, 3, {NUM_POSE_FEATURES})"
            )
        for label in (
            "template_vertices",
            "skin_weights",
            "joint_regressor",
            "shape_directions",
            "pose_directions",
        ):
            if not bool(torch.isfinite(getattr(self, label)).all()):
                raise RigError(f"rig {self.name}: {label} holds NaN or infinity")
        if int(self.faces.min()) < 0 or int(self.faces.max()) >= num_vertices:
            raise RigError(
                f"rig {self.name}: faces name vertices {int(self.faces.min())} to "
                f"{int(self.faces.max())}, but there are {num_vertices}"
            )
        sums = self.skin_weights.sum(-1)
        if not torch.allclose(sums, torch.ones_like(sums), atol=1e-4):
            raise RigError(f"rig {self.name}: rows of skin_weights do not sum to 1")

    def _require_shapes(self) -> None:
        """Files may hold anything: what is computed with these arrays relies on their shapes."""
        vertices, faces = len(self.template_vertices), len(self.faces)
        floats: dict[str, tuple[int, ...]] = {
            "template_vertices": (vertices, 3),
            "skin_weights": (vertices, NUM_BONES),
            "joint_regressor": (NUM_BONES, vertices),
            "shape_directions": (vertices, 3, *self.shape_directions.shape[2:][:1]),
            "uv_coordinates": (len(self.uv_coordinates), 2),
            "joint_axes": (NUM_BONES, 3, 3),
        }
        whole = {"faces": (faces, 3), "uv_faces": (faces, 3)}
        for label, shape in {**floats, **whole}.items():
            found = getattr(self, label)
            if tuple(found.shape) != shape:
                raise RigError(
                    f"rig {self.name}: {label} have shape {tuple(found.shape)}, expected {shape}"
                )
            if found.is_floating_point() != (label in floats):
                kind = "floating-point" if label in floats else "whole"
                raise RigError(
                    f"rig {self.name}: {label} are {found.dtype}, expected {kind} numbers"
                )

    @property
    def num_vertices(self) -> int:
        """Number of vertices without the one that closes the wrist."""
        return len(self.template_vertices)

    @cached_property
    def rim(self) -> Int[Tensor, "rim"]:
        """The open wrist loop, ordered.

        Raises:
            RigError: if the mesh is not open at one place, the wrist.
        """
        try:
            return boundary_loop(self.faces.cpu()).to(self.faces.device)
        except ValueError as error:
            raise RigError(f"rig {self.name}: {error}; expected one hole, the wrist") from error

    @cached_property
    def sealed_faces(self) -> Int[Tensor, "sealed_faces 3"]:
        """All faces and a fan that closes the wrist to vertex ``num_vertices``."""
        rim, centre = self.rim, torch.full_like(self.rim, self.num_vertices)
        return torch.cat([self.faces, torch.stack([rim.roll(-1), rim, centre], dim=-1)])

    def sealed(
        self, vertices: Float[Tensor, "*batch vertices 3"]
    ) -> Float[Tensor, "*batch sealed_vertices 3"]:
        """The vertices and, last, the mean of the rim."""
        centre = vertices[..., self.rim, :].mean(-2, keepdim=True)
        return torch.cat([vertices, centre], dim=-2)

    @cached_property
    def sha256(self) -> str:
        """Fingerprint of the arrays that decide where a posed vertex lies."""
        digest = sha256()
        deciding = [self.template_vertices, self.faces, self.skin_weights, self.joint_regressor]
        if self.pose_directions.numel():
            # MANO's left hand exists with two signs of its shape directions: they count too.
            deciding += [self.pose_directions, self.shape_directions]
        for value in deciding:
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def to(self, device: torch.device | str) -> "Rig":
        """The same rig on another device."""
        fields: dict[str, Any] = {
            name: value.to(device)
            for name, value in vars(self).items()
            if torch.is_tensor(value) and name in self.__dataclass_fields__
        }
        sets = {name: value.to(device) for name, value in self.vertex_sets.items()}
        return replace(self, vertex_sets=sets, **fields)

    def shaped(self, coefficients: Float[Tensor, "*batch shapes"] | None = None) -> "ShapedHand":
        """The rest hand of given shape coefficients (units: standard deviations).

        Raises:
            ArgumentError: if they are no tensor of floats, one for each of the rig's directions.

        Source: paper appendix A, the shape equation. What the pose adds, adds ``ShapedHand.posed``.
        """
        vertices = self.template_vertices
        if coefficients is not None:
            count = self.shape_directions.shape[-1]
            require_tensor("coefficients", coefficients, (count,), vertices.dtype, is_batch=True)
            vertices = vertices + torch.einsum(
                "vcs,...s->...vc", self.shape_directions, coefficients
            )
        return ShapedHand(self, vertices, self.joint_regressor @ vertices)

    def pose_offsets(
        self,
        rotations: Float[Tensor, "*batch bones 3"],
        chosen: Int[Tensor, "chosen"] | None = None,
    ) -> Float[Tensor, "*batch _ 3"]:
        """What a pose adds to the rest vertices before skinning (pose blend shapes), metres.

        Zero in the zero pose, and in every pose of a rig without ``pose_directions``.

        Args:
            rotations: axis-angle, radians, relative to the parent; the wrist's does not matter.
            chosen: which vertices, by default all.

        Source: paper appendix A, B_p in the shape equation; as in MANO.
        """
        directions = self.pose_directions if chosen is None else self.pose_directions[chosen]
        if directions.numel() == 0:
            return directions.new_zeros(*rotations.shape[:-2], len(directions), 3)
        features = pose_features(rotations)
        return (features @ directions.flatten(0, 1).T).unflatten(-1, (-1, 3))


@dataclass(frozen=True, eq=False)
class ShapedHand:
    """A hand of a definite shape in the zero pose.

    Attributes:
        rig: what it was made of.
        rest_vertices: metres, zero pose.
        rest_joints: metres, zero pose.
    """

    rig: Rig
    rest_vertices: Float[Tensor, "*batch vertices 3"]
    rest_joints: Float[Tensor, "*batch bones 3"]

    def posed(self, pose: HandPose) -> "PosedHand":
        """Pose blend shapes, then linear blend skinning into the world."""
        world_from_bone = bone_transforms(pose.rotations, self.rest_joints)
        world_from_bone = torch.cat(
            [
                torch.cat(
                    [
                        world_from_bone[..., :3, :3],
                        world_from_bone[..., :3, 3:] + pose.translation[..., None, :, None],
                    ],
                    dim=-1,
                ),
                world_from_bone[..., 3:, :],
            ],
            dim=-2,
        )
        batch = pose.rotations.shape[:-2]
        rest = self.rest_vertices.expand(*batch, -1, -1)
        if self.rig.pose_directions.numel():
            rest = rest + self.rig.pose_offsets(pose.rotations)
        joints = self.rest_joints.expand(*batch, -1, -1)
        vertices = linear_blend_skinning(rest, self.rig.skin_weights, world_from_bone, joints)
        return PosedHand(self.rig, pose, vertices, world_from_bone)


@dataclass(frozen=True, eq=False)
class PosedHand:
    """A hand placed in the world.

    Attributes:
        rig: what it was made of.
        pose: the pose it is in.
        vertices: metres, world.
        world_from_bone: rigid transform of each bone; its origin is the posed joint.
    """

    rig: Rig
    pose: HandPose
    vertices: Float[Tensor, "*batch vertices 3"]
    world_from_bone: Float[Tensor, "*batch bones 4 4"]

    @property
    def joints(self) -> Float[Tensor, "*batch bones 3"]:
        """Posed joint positions, metres, world."""
        return self.world_from_bone[..., :3, 3]

    @property
    def sealed_vertices(self) -> Float[Tensor, "*batch sealed_vertices 3"]:
        """Vertices with the wrist closed; goes with ``rig.sealed_faces``."""
        return self.rig.sealed(self.vertices)
