"""Even motion: what neighbouring frames say of each other, in seconds and hand sizes.

A joint's turning speed changes by some radians a second each second, whatever the frame rate: at
30 pictures a second neighbours say much of each other, at two a second next to nothing.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import solveh_banded
from torch import Tensor

from handavatar.fit.kinematics import NUM_UNKNOWNS, pose_difference
from handavatar.hand.pose import HandPose

_TURNING = 40.0
"""Radians a second, each second, by which a joint's turning speed changes."""
_MOVING = 3.0
"""Metres a second, each second."""
_LONGEST_GAP = 0.25
"""Seconds between neighbours that still say something of each other."""


@dataclass(frozen=True, eq=False)
class MotionTerms:
    """Second differences of successive poses.

    Attributes:
        first: frame before, of each triple; the next two follow it.
        residuals: accelerations in expected ones.
        weights: by which the changes of the three frames enter the residuals.
    """

    first: Int[Tensor, "triples"]
    residuals: Float[Tensor, "triples 51"]
    weights: Float[Tensor, "triples 3 51"]

    def frame_energy(self, num_frames: int) -> Float[Tensor, "frames"]:
        """Each frame's share: a third of every triple that it belongs to."""
        energy = torch.zeros(num_frames)
        squared = self.residuals.square().sum(-1) / 3
        for offset in range(3):
            energy.index_add_(0, self.first + offset, squared)
        return energy

    def gradient(self, num_frames: int) -> Float[Tensor, "frames 51"]:
        """Half of the energy's."""
        gradient = torch.zeros(num_frames, NUM_UNKNOWNS)
        for offset in range(3):
            gradient.index_add_(0, self.first + offset, self.weights[:, offset] * self.residuals)
        return gradient

    def curvature(self, num_frames: int) -> Float[Tensor, "frames 51"]:
        """Diagonal of the whole matrix: what holds each frame if its neighbours stand still."""
        diagonal = torch.zeros(num_frames, NUM_UNKNOWNS)
        for offset in range(3):
            diagonal.index_add_(0, self.first + offset, self.weights[:, offset].square())
        return diagonal

    def banded(self, blocks: Float[Tensor, "frames 51 51"]) -> np.ndarray:
        """Lower band of the whole matrix: each frame's own block, and what joins neighbours."""
        num_frames = len(blocks)
        size = num_frames * NUM_UNKNOWNS
        band = np.zeros((3 * NUM_UNKNOWNS, size))
        own = blocks.double().numpy()
        for below in range(NUM_UNKNOWNS):
            diagonal = np.diagonal(own, -below, 1, 2)
            target = band[below].reshape(num_frames, NUM_UNKNOWNS)
            target[:, : NUM_UNKNOWNS - below] = diagonal
        weights, first = self.weights.double().numpy(), self.first.numpy()
        for row in range(3):
            for column in range(row + 1):
                offset = (row - column) * NUM_UNKNOWNS
                target = band[offset].reshape(num_frames, NUM_UNKNOWNS)
                np.add.at(target, first + column, weights[:, row] * weights[:, column])
        return band


def motion_terms(poses: HandPose, times: Float[Tensor, "frames"]) -> MotionTerms:
    """Of successive frames; gaps of more than a quarter of a second say nothing."""
    gaps = times.diff()
    first = torch.arange(max(len(times) - 2, 0))
    is_near = (gaps[:-1] < _LONGEST_GAP) & (gaps[1:] < _LONGEST_GAP) & (gaps[:-1] > 0)
    first = first[is_near & (gaps[1:] > 0)] if len(first) else first
    before, after = gaps[first], gaps[first + 1]
    expected = torch.cat([torch.full((NUM_UNKNOWNS - 3,), _TURNING), torch.full((3,), _MOVING)])
    scale = 2 / (before + after)[:, None] / expected
    speed = pose_difference(_at(poses, first), _at(poses, first + 1)) / before[:, None]
    next_speed = pose_difference(_at(poses, first + 1), _at(poses, first + 2)) / after[:, None]
    weights = torch.stack(
        [
            scale / before[:, None],
            -scale * (1 / before + 1 / after)[:, None],
            scale / after[:, None],
        ],
        dim=1,
    )
    return MotionTerms(first, scale * (next_speed - speed), weights)


def solve_chain(
    blocks: Float[Tensor, "frames 51 51"],
    terms: MotionTerms,
    right: Float[Tensor, "frames 51 columns"],
) -> Float[Tensor, "frames 51 columns"]:
    """Solves for all frames at once.

    Args:
        blocks: each frame's own matrix, without what joins it to its neighbours.
        terms: that join neighbours.
        right: right sides.
    """
    if len(terms.first) == 0:
        return torch.linalg.solve(blocks, right)
    solution = solveh_banded(
        terms.banded(blocks), right.double().flatten(0, 1).numpy(), lower=True, check_finite=False
    )
    return torch.from_numpy(solution).to(blocks).reshape(right.shape)


def _at(poses: HandPose, frames: Tensor) -> HandPose:
    return HandPose(poses.rotations[frames], poses.translation[frames])
