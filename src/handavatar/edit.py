"""Edits of a finished avatar's look: a value that rendering takes, no training needed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.hand.pose import BONE_NAMES, FINGER_BONES


@dataclass(frozen=True)
class Edit:
    """What to change. The default changes nothing.

    Attributes:
        light_gain: multiplies the illumination.
        albedo_shift: added to the albedo, RGB in [-1, 1].
        lifted_bones: bones that cast no shadow (their directed soft occupancy is set to zero).

    Source: paper supplement (texture editing).
    """

    light_gain: float = 1.0
    albedo_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lifted_bones: tuple[int, ...] = ()

    def of_albedo(self, albedo: Float[Tensor, "queries 3"]) -> Float[Tensor, "queries 3"]:
        """Edited albedo, still in [0, 1]."""
        return (albedo + albedo.new_tensor(self.albedo_shift)).clamp(0, 1)

    def of_illumination(self, illumination: Float[Tensor, "queries"]) -> Float[Tensor, "queries"]:
        """Edited illumination, not clipped above."""
        return illumination * self.light_gain

    def of_directed(
        self, directed: Float[Tensor, "queries bones"]
    ) -> Float[Tensor, "queries bones"]:
        """Directed soft occupancy with the lifted bones far away."""
        if not self.lifted_bones:
            return directed
        return directed.index_fill(-1, torch.tensor(self.lifted_bones, device=directed.device), 0.0)


def bones_named(names: tuple[str, ...]) -> tuple[int, ...]:
    """Bones of finger or bone names, such as ``thumb`` or ``ring2``.

    Raises:
        ValueError: for a name that is neither.
    """
    bones: list[int] = []
    for name in names:
        if name in FINGER_BONES:
            bones.extend(FINGER_BONES[name])
        elif name in BONE_NAMES:
            bones.append(BONE_NAMES.index(name))
        else:
            raise ValueError(
                f"--lift-shadow: '{name}' is neither a finger nor a bone; choose from "
                f"{', '.join([*FINGER_BONES, *BONE_NAMES])}"
            )
    return tuple(dict.fromkeys(bones))
