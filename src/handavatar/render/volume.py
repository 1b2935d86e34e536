"""Volume rendering of occupancy: what is seen of each sample, and its sum along the ray."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def transmittance(
    occupancy: Float[Tensor, "rays samples"],
) -> Float[Tensor, "rays samples"]:
    """Share of light that arrives at each sample: product of (1 - occupancy) before it."""
    passed = (1 - occupancy).cumprod(dim=1)
    return torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)


def visibility(occupancy: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
    """Weight of each sample in the pixel: transmittance times occupancy; at most 1 in sum.

    Source: paper Sec. 3.3, Eq. 2 (the weights). Occupancy takes the place of opacity; there is
        no density and no step length.
    """
    return transmittance(occupancy) * occupancy


def composite(
    weights: Float[Tensor, "rays samples"], values: Float[Tensor, "rays samples channels"]
) -> Float[Tensor, "rays channels"]:
    """Weighted sum along each ray; what is not covered stays zero (black).

    Source: paper Sec. 3.3, Eq. 2, for X = albedo, illumination or their product.
    """
    return (weights[..., None] * values).sum(1)


def composite_sparse(
    weights: Float[Tensor, "kept"],
    rays: Int[Tensor, "kept"],
    values: Float[Tensor, "kept channels"],
    num_rays: int,
) -> Float[Tensor, "rays channels"]:
    """:func:`composite` over kept samples only; ``rays`` names the ray of each."""
    total = values.new_zeros(num_rays, values.shape[-1])
    return total.index_add(0, rays, weights[:, None] * values)
