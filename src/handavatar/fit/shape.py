"""A person's own shape as few numbers: the rig's coefficients, and smooth swellings of the skin."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import eigsh
from torch import Tensor

from handavatar.geometry.meshes import unique_edges, vertex_normals
from handavatar.hand.rig import Rig, ShapedHand

NUM_SWELLINGS = 40
"""Enough for the thickness of each joint; the finest is about 25 mm long."""
_SWELLING = 1.5e-3
"""Metres by which skin lies beside the rig's, of the longest waves; the finest have half."""


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """Shapes around a hand, linear in a few numbers.

    Attributes:
        directions: of the rest vertices with each number, metres.
        joint_directions: of the rest joints.
        sigmas: expected size of each number.
    """

    directions: Float[Tensor, "vertices 3 shapes"]
    joint_directions: Float[Tensor, "bones 3 shapes"]
    sigmas: Float[Tensor, "shapes"]

    @staticmethod
    def around(
        rig: Rig, coefficient_sigma: float, num_swellings: int = NUM_SWELLINGS
    ) -> "ShapeSpace":
        """The rig's shape coefficients and, along the normals, the smoothest waves on its mesh.

        Args:
            rig: with its shape directions.
            coefficient_sigma: how far the coefficients may be from those to start from.
            num_swellings: number of waves.
        """
        normals = vertex_normals(rig.template_vertices, rig.faces)
        waves, frequencies = _smooth_waves(rig, num_swellings)
        swellings = normals[:, :, None] * waves[:, None]
        directions = torch.cat([rig.shape_directions, swellings], dim=-1)
        fading = 1 / (1 + frequencies / frequencies.max().clamp_min(1e-12))
        num_coefficients = rig.shape_directions.shape[-1]
        sigmas = torch.cat([torch.full((num_coefficients,), coefficient_sigma), _SWELLING * fading])
        joints = torch.einsum("bv,vcs->bcs", rig.joint_regressor, directions)
        # Swellings thicken the skin; joints stay inside where they are.
        joints[..., num_coefficients:] = 0
        return ShapeSpace(directions, joints, sigmas)

    def shaped(self, hand: ShapedHand, values: Float[Tensor, "shapes"]) -> ShapedHand:
        """The rest hand after a change of shape."""
        return ShapedHand(
            hand.rig,
            hand.rest_vertices + self.directions @ values,
            hand.rest_joints + self.joint_directions @ values,
        )


def fixed_shape(rig: Rig) -> ShapeSpace:
    """No freedom: the hand is as it is."""
    return ShapeSpace(
        rig.template_vertices.new_zeros(rig.num_vertices, 3, 0),
        rig.template_vertices.new_zeros(len(rig.joint_regressor), 3, 0),
        rig.template_vertices.new_zeros(0),
    )


@lru_cache(maxsize=4)
def _smooth_waves(
    rig: Rig, count: int
) -> tuple[Float[Tensor, "vertices count"], Float[Tensor, "count"]]:
    """Eigenvectors of the graph's Laplacian with mean square one, and their eigenvalues."""
    edges = unique_edges(rig.faces).numpy()
    num_vertices = rig.num_vertices
    ones = np.ones(2 * len(edges))
    rows = np.concatenate([edges[:, 0], edges[:, 1]])
    columns = np.concatenate([edges[:, 1], edges[:, 0]])
    joined = coo_matrix((ones, (rows, columns)), shape=(num_vertices, num_vertices)).tocsr()
    laplacian = diags(np.asarray(joined.sum(1))[:, 0]) - joined
    values, vectors = eigsh(
        laplacian.tocsc(), k=count, sigma=-1e-3, v0=np.ones(num_vertices) / num_vertices**0.5
    )
    # The sign of an eigenvector is nobody's; here its largest entry is positive.
    signs = np.sign(vectors[np.abs(vectors).argmax(0), np.arange(count)])
    scaled = vectors * signs * np.sqrt(num_vertices)
    return torch.from_numpy(scaled).float(), torch.from_numpy(values).float().clamp_min(0)
