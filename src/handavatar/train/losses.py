"""The losses of end-to-end training, each a function of tensors.

Source: paper Sec. 4.1: ``L_shape + L_PairOF + L_SelF``.
"""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.geometry.meshes import uniform_laplacian


def occupancy_loss(
    predicted: Float[Tensor, "points"], is_inside: Bool[Tensor, "points"]
) -> Float[Tensor, ""]:
    """Mean squared error of the occupancy.

    Source: paper Sec. 3.2, L_PairOF.
    """
    return (predicted - is_inside.to(predicted)).square().mean()


def color_loss(
    rendered: Float[Tensor, "pixels 3"], truth: Float[Tensor, "pixels 3"]
) -> Float[Tensor, ""]:
    """Mean absolute error.

    Source: paper Sec. 3.3, the l1 term of L_SelF.
    """
    return (rendered - truth).abs().mean()


def border_loss(
    alpha: Float[Tensor, "pixels"], coverage: Float[Tensor, "pixels"]
) -> Float[Tensor, ""]:
    """Mean absolute error of how much of a pixel the hand covers, beside the mask's border.

    Departs: the authors' occupancy learns its outline in the picture from colours alone, for which
        minutes are too short: it stays half a pixel off the mesh.
    """
    return (alpha - coverage).abs().mean()


def offset_loss(
    offsets: Float[Tensor, "vertices 3"], edges: Int[Tensor, "edges 2"], spacing: float
) -> Float[Tensor, ""]:
    """How rough and how large the personal offsets are, in squared millimetres.

    Roughness is that of the open hand's coarse mesh: the Laplacian of the same offsets on a finer
    mesh is smaller by the square of the edges' lengths.

    Args:
        offsets: metres.
        edges: of the mesh.
        spacing: mean length of the edges, metres.

    Departs: the authors regularise nothing; a silhouette alone leaves the surface that faces the
        camera free, and it wrinkles.
    """
    rough = uniform_laplacian(offsets, edges).square().sum(-1).mean()
    large = offsets.square().sum(-1).mean()
    return 1e6 * (1e-4 * (_COARSE_SPACING / spacing) ** 4 * rough + 5e-5 * large)


_COARSE_SPACING = 0.005
