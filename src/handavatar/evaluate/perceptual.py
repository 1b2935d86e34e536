"""How different two pictures look: LPIPS where its weights are present, or a named substitute.

The weights of LPIPS-VGG are not shipped. Whoever has them puts two files into torch's checkpoint
folder (``$TORCH_HOME/hub/checkpoints``, by default ``~/.cache/torch/hub/checkpoints``):

- ``vgg16-397923af.pth``, the ImageNet backbone as torchvision distributes it;
- ``lpips_vgg_v0.1.pth``, the learnt heads: the file ``weights/v0.1/vgg.pth`` of the ``lpips``
  package; it is found under the name ``vgg.pth`` too.
"""

import hashlib
import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d

BACKBONE_FILE = "vgg16-397923af.pth"
HEADS_FILES = ("lpips_vgg_v0.1.pth", "vgg.pth")

_BACKBONE_SHA256 = "397923af"
_HEADS_SHA256 = "a78928a0"


class PerceptualLoss(nn.Module, ABC):
    """A differentiable distance of pictures, without trainable parameters.

    Attributes:
        name: what a run records beside every number that this measured.
    """

    name: str

    @abstractmethod
    def forward(
        self,
        rendered: Float[Tensor, "images height width 3"],
        truth: Float[Tensor, "images height width 3"],
    ) -> Float[Tensor, "images"]:
        """One distance per pair of pictures; colours in [0, 1], at least 16 x 16 pixels."""


@final
class LpipsVgg(PerceptualLoss):
    """LPIPS with the VGG-16 backbone.

    Features after five ReLU layers, scaled to unit length across channels; their squared
    differences are weighted per channel by the heads, averaged over the picture and summed over
    the layers.

    Source: paper Sec. 4.1, LPIPS (Zhang et al. 2018, Eq. 1), version 0.1.
    """

    mean: Tensor
    spread: Tensor

    # Per stage, the layer numbers of the convolutions in torchvision's ``vgg16().features``.
    stages = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))

    def __init__(self, backbone: dict[str, Tensor], heads: dict[str, Tensor]) -> None:
        """Takes the arrays by the names that their files use.

        Args:
            backbone: ``features.{layer}.weight`` and ``.bias`` of VGG-16; others are ignored.
            heads: ``lin{stage}.model.1.weight``, one non-negative weight per channel.

        Raises:
            ValueError: if an array is missing or has an unexpected shape.
        """
        super().__init__()
        self.name = "lpips-vgg"
        # Mean and spread of ImageNet colours, for pictures in [-1, 1].
        self.register_buffer("mean", torch.tensor([-0.030, -0.088, -0.188]))
        self.register_buffer("spread", torch.tensor([0.458, 0.448, 0.450]))
        channels = 3
        for number, stage in enumerate(self.stages):
            width = min(64 << number, 512)
            for layer in stage:
                weight = _array(backbone, f"features.{layer}.weight", (width, channels, 3, 3))
                self.register_buffer(f"weight{layer}", weight)
                bias = _array(backbone, f"features.{layer}.bias", (width,))
                self.register_buffer(f"bias{layer}", bias)
                channels = width
            head = _array(heads, f"lin{number}.model.1.weight", (1, width, 1, 1))
            self.register_buffer(f"head{number}", head)

    def forward(
        self,
        rendered: Float[Tensor, "images height width 3"],
        truth: Float[Tensor, "images height width 3"],
    ) -> Float[Tensor, "images"]:
        """One distance per pair of pictures; colours in [0, 1], at least 16 x 16 pixels."""
        both = torch.cat([rendered, truth])
        values = ((2 * both - 1 - self.mean) / self.spread).movedim(-1, 1)
        total = rendered.new_zeros(len(rendered))
        for number, stage in enumerate(self.stages):
            if number:
                values = max_pool2d(values, 2)
            for layer in stage:
                weight, bias = (self.get_buffer(f"{kind}{layer}") for kind in ("weight", "bias"))
                values = conv2d(values, weight, bias, padding=1).relu()
            length = torch.linalg.vector_norm(values, dim=1, keepdim=True)
            first, second = (values / (length + 1e-10)).split(len(rendered))
            weighted = conv2d((first - second).square(), self.get_buffer(f"head{number}"))
            total = total + weighted.mean((1, 2, 3))
        return total


@final
class GradientStructure(PerceptualLoss):
    """A distance without learnt weights: edges in place, contrast and structure alike.

    At three scales, each half as fine as the one before: the absolute difference of the image
    gradients, and one minus the contrast-structure term of SSIM in 5 x 5 windows. Both ignore
    a constant offset, which a colour loss beside it sees. Windows shrink with small pictures.

    Departs: the paper trains and judges with LPIPS-VGG, whose backbone may not ship. Figures of
        this one are no LPIPS figures, hence the name that the run records.
    """

    def __init__(self, gradient_weight: float = 2.0, structure_weight: float = 1.0) -> None:
        """Sets the weights of the two terms; the defaults make them about equal on blurred skin.

        Args:
            gradient_weight: of the difference of gradients, colours per pixel.
            structure_weight: of one minus contrast-structure, in [0, 2].
        """
        super().__init__()
        self.name = "multi-scale gradient+structure (weight-free substitute)"
        self.gradient_weight = gradient_weight
        self.structure_weight = structure_weight

    def forward(
        self,
        rendered: Float[Tensor, "images height width 3"],
        truth: Float[Tensor, "images height width 3"],
    ) -> Float[Tensor, "images"]:
        """One distance per pair of pictures; colours in [0, 1], at least 16 x 16 pixels."""
        first, second = rendered.movedim(-1, 1), truth.movedim(-1, 1)
        total = rendered.new_zeros(len(rendered))
        for scale in range(3):
            if scale:
                first, second = avg_pool2d(first, 2), avg_pool2d(second, 2)
            difference = first - second
            gradient = difference.diff(dim=2).abs().mean((1, 2, 3)) + difference.diff(
                dim=3
            ).abs().mean((1, 2, 3))
            structure = _structure_difference(first, second).mean((1, 2, 3))
            total = total + self.gradient_weight * gradient + self.structure_weight * structure
        return total / 3


def _structure_difference(
    first: Float[Tensor, "images 3 height width"], second: Float[Tensor, "images 3 height width"]
) -> Float[Tensor, "images 3 inner_height inner_width"]:
    """One minus the contrast-structure term of SSIM, of every window that fits."""
    size = min(5, *first.shape[2:])
    mean_a, mean_b, square_a, square_b, product = avg_pool2d(
        torch.cat([first, second, first * first, second * second, first * second]), size, stride=1
    ).chunk(5)
    variances = square_a - mean_a.square() + square_b - mean_b.square()
    return 1 - (2 * (product - mean_a * mean_b) + 0.03**2) / (variances + 0.03**2)


def perceptual_loss(
    prefer: Literal["auto", "lpips", "substitute"] = "auto", folder: Path | None = None
) -> PerceptualLoss:
    """The distance to use; its ``name`` says which one it is and belongs into every record.

    Args:
        prefer: ``auto`` takes LPIPS if both of its files are present, ``lpips`` insists on it,
            ``substitute`` never reads a file.
        folder: where the files are; by default torch's checkpoint folder.

    Raises:
        FileNotFoundError: if ``lpips`` is wanted and a file is missing.
        ValueError: if a file is present and is not what its name says, also under ``auto``.
    """
    if prefer == "substitute":
        return GradientStructure()
    folder = folder or _checkpoint_folder()
    backbone = folder / BACKBONE_FILE
    heads = next((folder / n for n in HEADS_FILES if (folder / n).is_file()), folder / "vgg.pth")
    missing = [path.name for path in (backbone, heads) if not path.is_file()]
    if not missing:
        return LpipsVgg(
            _read_weights(backbone, _BACKBONE_SHA256), _read_weights(heads, _HEADS_SHA256)
        )
    if prefer == "lpips":
        raise FileNotFoundError(
            f"LPIPS needs {' and '.join(missing)} in {folder}: the VGG-16 backbone is "
            f"torchvision's, the heads are weights/v0.1/{HEADS_FILES[1]} of the lpips package. "
            "Or choose the substitute."
        )
    return GradientStructure()


def _checkpoint_folder() -> Path:
    """Where torch keeps files that it fetched."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", os.path.join(cache, "torch"))
    return Path(home).expanduser() / "hub" / "checkpoints"


def _read_weights(path: Path, fingerprint: str) -> dict[str, Tensor]:
    """A foreign pickle, so its content is compared with the published one before it is opened."""
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(fingerprint):
        raise ValueError(
            f"{path} has sha256 {found[:8]}…, expected {fingerprint}…: "
            "the file is damaged or another one; fetch it again or remove it"
        )
    arrays: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return arrays


def _array(arrays: dict[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    found = arrays.get(name)
    if found is None or tuple(found.shape) != shape:
        what = "nothing" if found is None else f"shape {tuple(found.shape)}"
        raise ValueError(f"LPIPS weights: found {what} under {name!r}, expected shape {shape}")
    return found.detach().float().clone()
