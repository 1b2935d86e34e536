"""Anchors: points fixed on the surface that carry codes, and interpolation between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from handavatar.field.kernels import Kernel, settled_kernel
from handavatar.geometry.meshes import SurfacePoints, sample_surface_evenly
from handavatar.hand.rig import Rig

NUM_NEIGHBOURS = 4
"""The paper's N^n."""
SMALLEST_DISTANCE = 1e-5
"""Distances are not taken smaller than this in inverse-distance weights, metres."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The nearest anchors of each query.

    Attributes:
        indices: nearest first.
        weights: inverse distances, rows sum to 1.
    """

    indices: Int[Tensor, "queries neighbours"]
    weights: Float[Tensor, "queries neighbours"]

    def interpolated(
        self, values: Float[Tensor, "anchors channels"]
    ) -> Float[Tensor, "queries channels"]:
        """Weighted mean of the neighbours' values.

        Source: paper Sec. 3.3 (albedo field), the interpolation of A and E.
        """
        if values.shape[1] == 0:
            # Torch's operation refuses rows without columns.
            return values.new_zeros(len(self.indices), 0)
        return torch.nn.functional.embedding_bag(
            self.indices, values, per_sample_weights=self.weights, mode="sum"
        )


def place_anchors(rig: Rig, count: int = 4096, seed: int = 0) -> SurfacePoints:
    """Evenly spread anchors on a rig's template (the open wrist's cap carries none).

    Source: paper Sec. 3.3, N^a = 4096 barycentric anchors.
    """
    generator = torch.Generator().manual_seed(seed)
    return sample_surface_evenly(rig.template_vertices, rig.faces, count, generator)


def nearest_anchors(
    anchors: Float[Tensor, "anchors 3"],
    queries: Float[Tensor, "queries 3"],
    count: int = NUM_NEIGHBOURS,
    kernel: Kernel = "auto",
) -> Neighbours:
    """The ``count`` nearest anchors by a k-d tree (a brute-force search on a GPU).

    The choice of neighbours has no gradient; their weights have one, to both arguments.

    Args:
        anchors: metres.
        queries: metres.
        count: of neighbours.
        kernel: Triton's search for four by :mod:`handavatar.field.fused_anchors`.

    Source: paper Sec. 3.3, N^n = 4 nearest by Euclidean distance.
    """
    kernel = settled_kernel(kernel, queries.device)
    if kernel != "torch" and count == NUM_NEIGHBOURS:
        from handavatar.field.fused_anchors import four_nearest

        indices = four_nearest(anchors, queries)
    elif queries.device.type == "cpu":
        tree = cKDTree(anchors.detach().numpy())
        _, found = tree.query(queries.detach().numpy(), k=count)
        indices = torch.from_numpy(found.astype("int64")).reshape(-1, count)
    else:
        indices = torch.cat(
            [
                torch.cdist(
                    part.detach(),
                    anchors.detach(),
                    compute_mode="donot_use_mm_for_euclid_dist",
                )
                .topk(count, largest=False)
                .indices
                for part in queries.split(16384)
            ]
            or [torch.empty(0, count, dtype=torch.long, device=queries.device)]
        )
    return Neighbours(indices, inverse_distance_weights(anchors, queries, indices))


def inverse_distance_weights(
    anchors: Float[Tensor, "anchors 3"],
    queries: Float[Tensor, "queries 3"],
    indices: Int[Tensor, "queries neighbours"],
) -> Float[Tensor, "queries neighbours"]:
    """Weights proportional to 1 / distance, finite where a query lies on an anchor."""
    squared = (queries[:, None] - anchors[indices]).square().sum(-1)
    inverse = squared.clamp_min(SMALLEST_DISTANCE**2).rsqrt()
    return inverse / inverse.sum(-1, keepdim=True)
