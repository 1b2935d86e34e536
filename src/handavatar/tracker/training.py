"""Teaches the network what made pictures show."""

import copy
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import (
    affine_grid,
    binary_cross_entropy_with_logits,
    conv2d,
    cross_entropy,
    grid_sample,
)

from handavatar.processes import ALONE, Processes
from handavatar.tracker.network import INPUT_SIDE, MAP_SIDE, HandNetwork, Told
from handavatar.tracker.points import upright_turn

_PLACE_SCALE, _DEPTH_SCALE = 128.0, 20.0
_NEXT_PROCESS = 1_000_003
"""By which seeds of processes are apart."""
_WARM_STEPS, _LEAST_RATE, _SMOOTHING, _LONGEST_GRADIENT = 300, 0.005, 0.998, 5.0


@dataclass(frozen=True)
class TrackerOptions:
    """How the network is taught."""

    rate: float = 2e-3
    """learning rate at its highest"""
    batch: int = 64
    """pictures a step"""
    weight_decay: float = 1e-4
    """of AdamW"""
    turn: float = 0.35
    """radians by which hands are not upright, one standard deviation"""
    any_turn: float = 0.1
    """share of pictures that are turned any way"""
    sides: tuple[float, float] = (1.2, 1.75)
    """least and greatest side of a picture, in units of its hand's box"""
    mirrored: float = 0.12
    """share that shows a left hand, of which the network tells side and mask alone"""
    shift: float = 0.08
    """by which hands are beside the middle, in units of half the side, one standard deviation"""


@dataclass(frozen=True, eq=False)
class CropBatch:
    """Pictures and what is true of them, as :class:`MadeCrops` has it."""

    images: UInt8[Tensor, "crops side side 3"]
    classes: UInt8[Tensor, "crops rows columns"]
    points: Float[Tensor, "crops points 3"]
    is_hand: Bool[Tensor, "crops"]

    @classmethod
    def joined(cls, parts: Sequence[Mapping[str, Tensor]]) -> "CropBatch":
        """All pictures of several parts, whose tensors have the names of the fields."""
        return cls(**{name: torch.cat([part[name] for part in parts]) for name in CROP_FIELDS})

    def chosen(self, crops: Int[Tensor, "chosen"] | slice) -> "CropBatch":
        """Some of the pictures."""
        return CropBatch(*(getattr(self, name)[crops] for name in CROP_FIELDS))


CROP_FIELDS = tuple(field.name for field in fields(CropBatch))


def vary_crops(
    batch: CropBatch, options: TrackerOptions, generator: torch.Generator
) -> tuple[
    Float[Tensor, "crops 3 side side"],
    Int[Tensor, "crops rows columns"],
    Float[Tensor, "crops points 3"],
    Bool[Tensor, "crops"],
]:
    """Brings hands upright into the middle, more or less, tints them, and mirrors a few of them.

    Returns:
        Pictures, classes at the maps' resolution, points, and whether the hand is a right one.
    """
    count = len(batch.images)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator) * 2 - 1

    corners = batch.points[..., :2] * 2 - 1
    angle = upright_turn(batch.points[..., :2])
    angle = angle + options.turn * torch.randn(count, generator=generator)
    is_any = torch.rand(count, generator=generator) < options.any_turn
    angle = torch.where(is_any, math.pi * uniform(), angle)
    turn = torch.stack(
        [torch.stack([angle.cos(), -angle.sin()], -1), torch.stack([angle.sin(), angle.cos()], -1)],
        dim=1,
    )
    turned = corners @ turn
    low, high = turned.amin(1), turned.amax(1)
    least, most = options.sides
    side = (high - low).amax(-1) / 2 * (least + (most - least) * (uniform() + 1) / 2)
    middle = (low + high) / 2 + options.shift * side[:, None] * torch.randn(
        count, 2, generator=generator
    )
    shift = (turn @ middle[..., None])[..., 0]
    turn = turn * side[:, None, None]
    is_right = torch.rand(count, generator=generator) > options.mirrored
    mirror = torch.ones(count, 2)
    mirror[~is_right, 0] = -1
    theta = torch.cat([turn * mirror[:, None], shift[..., None]], -1)
    images = batch.images.permute(0, 3, 1, 2).float() / 255
    grid = affine_grid(theta, [count, 3, INPUT_SIDE, INPUT_SIDE], align_corners=False)
    images = grid_sample(images, grid, padding_mode="border", align_corners=False)
    tint = 1 + 0.08 * torch.randn(count, 3, 1, 1, generator=generator)
    images = (images * tint + 0.06 * torch.randn(count, 1, 1, 1, generator=generator)).clamp(0, 1)
    small = affine_grid(theta, [count, 1, MAP_SIDE, MAP_SIDE], align_corners=False)
    classes = grid_sample(
        batch.classes[:, None].float(), small, mode="nearest", align_corners=False
    )[:, 0].long()
    where = corners - shift[:, None]
    where = torch.linalg.solve(theta[:, None, :, :2], where[..., None])[..., 0]
    points = torch.cat([(where + 1) / 2, batch.points[..., 2:]], dim=-1)
    return images, classes, points, is_right


def tracker_loss(
    told: Told,
    classes: Int[Tensor, "crops rows columns"],
    points: Float[Tensor, "crops points 3"],
    is_hand: Bool[Tensor, "crops"],
    is_right: Bool[Tensor, "crops"],
) -> Float[Tensor, ""]:
    """Negative logarithm of the likelihood of points, mask, presence and side."""
    counts = (is_hand & is_right).float()[:, None]
    # A heat map has no place beyond its border.
    inside = ((points[..., :2] > 0.01) & (points[..., :2] < 0.99)).all(-1).float() * counts
    apart = (told.places - points[..., :2]).square().sum(-1)
    sigma = told.place_errors
    likelihood = 0.5 * apart / sigma.square() + 2 * (sigma * _PLACE_SCALE).log()
    near = (apart * _PLACE_SCALE**2 + 1).sqrt() - 1
    behind = (told.depths - points[..., 2]).square()
    deep = told.depth_errors
    depth_likelihood = 0.5 * behind / deep.square() + (deep * _DEPTH_SCALE).log()
    depth_near = (behind * _DEPTH_SCALE**2 + 1).sqrt() - 1
    total = (inside * (likelihood + 0.3 * near)).sum() / inside.sum().clamp_min(1)
    number = counts.sum().clamp_min(1) * points.shape[1]
    total = total + (counts * (depth_likelihood + 0.5 * depth_near)).sum() / number
    total = total + 2 * cross_entropy(told.classes, classes)
    total = total + binary_cross_entropy_with_logits(told.is_hand, is_hand.float())
    side = binary_cross_entropy_with_logits(told.is_right, is_right.float(), reduction="none")
    return total + (side * is_hand).sum() / is_hand.sum().clamp_min(1)


@lru_cache(maxsize=4)
def is_bfloat16_fast(device: str) -> bool:
    """Whether convolutions in bfloat16 are no slower than in 32 bits, measured here.

    Processors without units for it emulate it: a step takes forty times as long.

    Args:
        device: its kind, such as ``cpu`` or ``cuda``.
    """
    seconds = {}
    for kind in (torch.float32, torch.bfloat16):
        picture = torch.zeros(4, 64, 32, 32, device=device, dtype=kind)
        weights = torch.zeros(64, 64, 3, 3, device=device, dtype=kind)
        tries = []
        for _ in range(4):
            began = time.perf_counter()
            float(conv2d(picture, weights, padding=1).sum())
            tries.append(time.perf_counter() - began)
        seconds[kind] = min(tries)
    return seconds[torch.bfloat16] <= seconds[torch.float32]


class TrackerTraining:
    """A network while it is taught, and the mean of its weights over the last steps.

    Attributes:
        step: number of steps done.
    """

    def __init__(
        self,
        network: HandNetwork,
        options: TrackerOptions,
        steps: int,
        seed: int = 0,
        processes: Processes = ALONE,
    ) -> None:
        """Begins.

        Args:
            network: to teach, in place, on its device; with equal weights in all processes.
            options: rates.
            steps: in all: the learning rate falls along a cosine.
            seed: of how pictures are varied, in each process otherwise.
            processes: that share every step's pictures.
        """
        self.network, self.options, self.steps, self.step = network, options, steps, 0
        self.processes, self._seed = processes, seed
        self.generator = torch.Generator().manual_seed(seed + _NEXT_PROCESS * processes.rank)
        self._optimizer = torch.optim.AdamW(
            network.parameters(), options.rate, weight_decay=options.weight_decay
        )
        self._smooth = torch.optim.swa_utils.AveragedModel(
            network,
            multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(_SMOOTHING),
            use_buffers=True,
        )

    def state(self) -> dict[str, Tensor]:
        """All that is needed to go on, as tensors by name."""
        found = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        found |= {f"smooth.{name}": value for name, value in self._smooth.state_dict().items()}
        for number, values in self._optimizer.state_dict()["state"].items():
            found |= {f"optimizer.{number}.{name}": value for name, value in values.items()}
        found["generator"] = self.generator.get_state()
        found["step"] = torch.tensor(self.step)
        return {name: value.detach().cpu().clone().contiguous() for name, value in found.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Goes on from a state; the number of steps in all stays as given here.

        Raises:
            KeyError, RuntimeError: if it is the state of another network.
        """

        def part(prefix: str) -> dict[str, Tensor]:
            size = len(prefix) + 1
            return {n[size:]: v for n, v in state.items() if n.startswith(f"{prefix}.")}

        self.network.load_state_dict(part("network"))
        self._smooth.load_state_dict(part("smooth"))
        held: dict[int, dict[str, Tensor]] = {}
        for name, value in part("optimizer").items():
            number, _, key = name.partition(".")
            held.setdefault(int(number), {})[key] = value
        groups = self._optimizer.state_dict()["param_groups"]
        self._optimizer.load_state_dict({"state": held, "param_groups": groups})
        self.step = int(state["step"])
        if self.processes.is_first:
            self.generator.set_state(state["generator"])
        else:  # The state is the first one's.
            self.generator.manual_seed(self._seed + _NEXT_PROCESS * self.processes.rank + self.step)

    def teach(self, batch: CropBatch) -> float:
        """One step, of all processes together.

        Args:
            batch: this process's part of the step's pictures.

        Returns:
            The loss before it, of this part.
        """
        self.network.train()
        device = next(self.network.parameters()).device
        done = self.step / self.steps
        rate = self.options.rate * min(1.0, (self.step + 1) / _WARM_STEPS)
        for group in self._optimizer.param_groups:
            group["lr"] = rate * (0.5 + 0.5 * math.cos(math.pi * done) + _LEAST_RATE)
        images, classes, points, is_right = vary_crops(batch, self.options, self.generator)
        # Sums are of 32 bits.
        with torch.autocast(device.type, torch.bfloat16, enabled=is_bfloat16_fast(device.type)):
            told = self.network(images.to(device))
        loss = tracker_loss(
            told,
            classes.to(device),
            points.to(device),
            batch.is_hand.to(device),
            is_right.to(device),
        )
        self._optimizer.zero_grad()
        loss.backward()
        gradients = (weights.grad for weights in self.network.parameters())
        self.processes.average(gradient for gradient in gradients if gradient is not None)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _LONGEST_GRADIENT)
        self._optimizer.step()
        self._smooth.update_parameters(self.network)
        self.step += 1
        return float(loss.detach())

    def taught(self) -> HandNetwork:
        """The network with the mean of its last weights, which sees better than the last one."""
        found = copy.deepcopy(self._smooth.module)
        assert isinstance(found, HandNetwork)
        return found.eval()
