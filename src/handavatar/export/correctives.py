"""Pose correctives: a few shapes that are added to the rest hand, each as much as the pose says.

Engines know them as blend shapes driven by the pose. They stand for all that makes the rest shape
depend on the pose: the personal offsets, the rig's own pose blend shapes, and how far the occupancy
field's surface is from the mesh.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.export.field_samples import FieldSamples
from handavatar.geometry.meshes import Subdivision, carried_to_fine, vertex_normals
from handavatar.hand.pose_features import pose_features
from handavatar.hand.rig import Rig, ShapedHand

NUM_SHAPES = 12
_DAMPING = 1.0
"""Of the regression from pose to shapes, in squared units of its features."""


@dataclass(frozen=True, eq=False)
class PoseCorrectives:
    """A rest hand before subdivision, linear in the entries of its fingers' rotation matrices.

    Attributes:
        vertices: mean over the poses, metres.
        joints: mean over the poses, metres.
        shapes: added to the vertices, metres.
        joint_shapes: added to the joints, metres.
        weights: how much of each shape a feature of the pose adds; the last column always counts.
    """

    vertices: Float[Tensor, "coarse 3"]
    joints: Float[Tensor, "bones 3"]
    shapes: Float[Tensor, "shapes coarse 3"]
    joint_shapes: Float[Tensor, "shapes bones 3"]
    weights: Float[Tensor, "shapes features"]

    def coefficients(self, rotations: Float[Tensor, "*batch bones 3"]) -> Float[Tensor, "*batch _"]:
        """How much of each shape the poses take."""
        return pose_features(rotations) @ self.weights[:, :-1].T + self.weights[:, -1]

    def shaped(
        self, rig: Rig, levels: list[Subdivision], rotations: Float[Tensor, "bones 3"]
    ) -> ShapedHand:
        """The rest hand of one pose on the fine mesh.

        Args:
            rig: fine, without pose blend shapes of its own.
            levels: of subdivision, from these vertices to the rig's.
            rotations: axis-angle.
        """
        amounts = self.coefficients(rotations)
        vertices = self.vertices + torch.einsum("k,kvc->vc", amounts, self.shapes)
        joints = self.joints + torch.einsum("k,kbc->bc", amounts, self.joint_shapes)
        return ShapedHand(rig, carried_to_fine(vertices, levels), joints)


def fit_correctives(samples: FieldSamples, hand: ShapedHand) -> PoseCorrectives:
    """The shapes that explain most of how the surface differs between poses, and what drives them.

    Args:
        samples: the surface in many poses.
        hand: the average one, in its zero pose; its normals say what is outside.
    """
    coarse = samples.surface.shape[1]
    normals = vertex_normals(hand.rig.sealed(hand.rest_vertices), hand.rig.sealed_faces)[:coarse]
    split = 3 * coarse
    features = pose_features(samples.rotations)
    rest = torch.cat([samples.rest_vertices.flatten(1), samples.rest_joints.flatten(1)], dim=1)
    middle, driven = _driven(features, rest)
    is_known = samples.surface.isfinite().any(1)
    if bool(is_known.any()):
        found = samples.surface[is_known]
        mean = found.nanmean(0).nan_to_num(0)
        outwards = torch.where(found.isfinite(), found, mean)
        farther, driven_farther = _driven(features[is_known], outwards)
        middle[:split] += (farther[:, None] * normals).flatten()
        driven[:, :split] += (driven_farther[..., None] * normals).flatten(1)
    # What the pose explains, in the fewest shapes.
    explained = torch.cat([features, torch.ones_like(features[:, :1])], dim=1).double() @ driven
    shapes = torch.linalg.svd(explained, full_matrices=False).Vh[:NUM_SHAPES]
    return PoseCorrectives(
        middle[:split].view(-1, 3).float(),
        middle[split:].view(-1, 3).float(),
        shapes[:, :split].unflatten(1, (-1, 3)).float(),
        shapes[:, split:].unflatten(1, (-1, 3)).float(),
        (driven @ shapes.T).T.float(),
    )


def _driven(
    features: Float[Tensor, "poses features"], values: Float[Tensor, "poses columns"]
) -> tuple[Float[Tensor, "columns"], Float[Tensor, "features_and_one columns"]]:
    """Means of values over poses, and by ridge regression what drives them away from these."""
    features = torch.cat([features, torch.ones_like(features[:, :1])], dim=1).double()
    values = values.double()
    damping = _DAMPING * torch.eye(features.shape[1], dtype=torch.float64)
    damping[-1, -1] = 0
    mean = values.mean(0)
    normal = features.T @ features + damping
    return mean, torch.linalg.solve(normal, features.T @ (values - mean))
