"""Edits of a finished avatar's look: a value that rendering takes, no training needed."""

from dataclasses import dataclass, replace
from numbers import Integral

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.errors import ArgumentError
from handavatar.field.anchors import Neighbours
from handavatar.geometry.tensors import is_finite_number, require_tensor, require_type
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, NUM_BONES


@dataclass(frozen=True, eq=False)
class Paint:
    """Paint on the skin, a spot per anchor; between anchors it runs together.

    Attributes:
        colors: RGB in [0, 1], as the albedo.
        opacity: 0 leaves the skin, 1 covers it.

    Raises:
        ArgumentError: if one is no tensor of floats of this shape.
    """

    colors: Float[Tensor, "anchors 3"]
    opacity: Float[Tensor, "anchors"]

    def __post_init__(self) -> None:
        """Refuses what is no paint."""
        require_tensor("Paint.colors", self.colors, (-1, 3))
        require_tensor("Paint.opacity", self.opacity, (len(self.colors),))

    def over(self, below: "Paint") -> "Paint":
        """Both coats as one, this one on top."""
        hidden = below.opacity * (1 - self.opacity)
        opacity = self.opacity + hidden
        mixed = self.colors * self.opacity[:, None] + below.colors * hidden[:, None]
        return Paint(mixed / opacity.clamp_min(1e-6)[:, None], opacity)


@dataclass(frozen=True)
class Edit:
    """What to change. The default changes nothing.

    Attributes:
        light_gain: multiplies the illumination.
        albedo_shift: added to the albedo, RGB in [-1, 1].
        lifted_bones: bones that cast no shadow: their directed soft occupancy is set to zero, or
            light is traced to a hand without them.
        paint: on the skin, over the shifted albedo; None is none.
        light: in which of the avatar's lights it is shown: the number of a clip of its capture;
            None leaves that as it is, which is the first one's where nobody chose.

    Raises:
        ArgumentError: if a number cannot be: it says which.

    Source: paper supplement (texture editing).
    """

    light_gain: float = 1.0
    albedo_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lifted_bones: tuple[int, ...] = ()
    paint: Paint | None = None
    light: int | None = None

    def __post_init__(self) -> None:
        """Refuses what is no edit."""
        if not (is_finite_number(self.light_gain) and self.light_gain >= 0):
            raise ArgumentError("light_gain", str(self.light_gain)[:60], "a number, at least 0")
        shift = self.albedo_shift
        is_triple = isinstance(shift, tuple | list) and len(shift) == 3
        if not (is_triple and all(is_finite_number(value) for value in shift)):
            raise ArgumentError("albedo_shift", str(shift)[:60], "three numbers: red, green, blue")
        bones = self.lifted_bones
        is_list = isinstance(bones, tuple | list)
        if not (is_list and all(isinstance(b, Integral) and 0 <= b < NUM_BONES for b in bones)):
            raise ArgumentError(
                "lifted_bones",
                str(bones)[:60],
                f"numbers of bones, 0 to {NUM_BONES - 1}",
                "bones_named(('thumb',)) gives those of a finger",
            )
        if self.paint is not None:
            require_type("paint", self.paint, Paint)

    def then(self, other: "Edit") -> "Edit":
        """This edit and another one after it, as one."""
        red, green, blue = (
            a + b for a, b in zip(self.albedo_shift, other.albedo_shift, strict=True)
        )
        paint = other.paint or self.paint
        if self.paint is not None and other.paint is not None:
            paint = other.paint.over(self.paint)
        return Edit(
            self.light_gain * other.light_gain,
            (red, green, blue),
            tuple(dict.fromkeys((*self.lifted_bones, *other.lifted_bones))),
            paint,
            self.light if other.light is None else other.light,
        )

    def to(self, device: torch.device | str) -> "Edit":
        """The same edit with its paint on another device."""
        if self.paint is None:
            return self
        paint = Paint(self.paint.colors.to(device), self.paint.opacity.to(device))
        return replace(self, paint=paint)

    def of_albedo(self, albedo: Float[Tensor, "queries 3"]) -> Float[Tensor, "queries 3"]:
        """Edited albedo, still in [0, 1]."""
        if not any(self.albedo_shift):
            # What a GPU is given by Python it waits for.
            return albedo
        return (albedo + albedo.new_tensor(self.albedo_shift)).clamp(0, 1)

    def painted(
        self, albedo: Float[Tensor, "queries 3"], neighbours: Neighbours
    ) -> Float[Tensor, "queries 3"]:
        """Albedo under the paint of the nearest anchors."""
        if self.paint is None:
            return albedo
        coat = self.paint.colors * self.paint.opacity[:, None]
        values = neighbours.interpolated(torch.cat([coat, self.paint.opacity[:, None]], dim=-1))
        return albedo * (1 - values[:, 3:]) + values[:, :3]

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
            raise ArgumentError(
                "lift_shadow",
                f"'{name}' is neither a finger nor a bone; choose from "
                f"{', '.join([*FINGER_BONES, *BONE_NAMES])}",
            )
    return tuple(dict.fromkeys(bones))
