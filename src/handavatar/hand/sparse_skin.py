"""Skinning weights with few bones per vertex, as files hold them and engines take them."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from handavatar.errors import raise_if_refused
from handavatar.hand.pose import NUM_BONES
from handavatar.hand.rig import Rig, RigError
from handavatar.jobs.files import write_atomically

MAX_BONES = 4
"""Bones that may move one vertex: game engines and glTF's first joint set allow no more."""
SCHEMA = "1"
_WHOLE = 65535
"""A share of one. A sixteen-bit step moves a vertex 0.1 m from its joint by 2 micrometres."""


@dataclass(frozen=True, eq=False)
class SparseSkin:
    """At most four bones per vertex and their shares.

    Attributes:
        bones: of each vertex; the first bone, with share 0, where fewer than four take part.
        shares: in units of 1/65535; every row sums to 65535 exactly.
        rig_sha256: fingerprint of the base rig whose subdivision these weights belong to.
        rounds: midpoint subdivisions of that rig.
    """

    bones: Int[Tensor, "vertices influences"]
    shares: Int[Tensor, "vertices influences"]
    rig_sha256: str
    rounds: int

    @staticmethod
    def of(skin_weights: Float[Tensor, "vertices bones"], base: Rig, rounds: int) -> "SparseSkin":
        """Rounds weights to sixteen bits.

        Args:
            skin_weights: rows sum to 1, at most four entries of a row are not zero.
            base: the rig before it was subdivided.
            rounds: midpoint subdivisions.

        Raises:
            RigError: if a vertex hangs on more bones than four.
        """
        most = int((skin_weights != 0).sum(-1).max())
        if most > MAX_BONES:
            raise RigError(
                f"skin weights: found a vertex with {most} bones, at most {MAX_BONES} can be "
                "stored; keep the strongest with strongest_bones()"
            )
        largest = skin_weights.topk(MAX_BONES, dim=-1)
        scaled = largest.values.double() * (_WHOLE / largest.values.double().sum(-1, keepdim=True))
        shares = scaled.floor().long()
        # What rounding down lost goes to the largest remainders, one unit each.
        rank = (scaled - shares).argsort(-1, descending=True).argsort(-1)
        shares = shares + (rank < _WHOLE - shares.sum(-1, keepdim=True)).long()
        bones = torch.where(shares > 0, largest.indices, 0)
        return SparseSkin(bones, shares, base.sha256, rounds)

    @property
    def is_sound(self) -> bool:
        """Whether every vertex hangs on one to four bones that there are, by shares of one."""
        shape = self.bones.shape
        if len(shape) != 2 or not shape[0] or not 0 < shape[1] <= MAX_BONES:
            return False
        if self.shares.shape != shape or int(self.shares.min()) < 0:
            return False
        is_whole = bool((self.shares.sum(-1) == _WHOLE).all())
        return is_whole and 0 <= int(self.bones.min()) <= int(self.bones.max()) < NUM_BONES

    def dense(self) -> Float[Tensor, "vertices bones"]:
        """The weights as a :class:`Rig` has them."""
        weights = torch.zeros(len(self.bones), NUM_BONES, dtype=torch.float64)
        weights.scatter_add_(1, self.bones.long(), self.shares.double() / _WHOLE)
        return weights.float()

    def fits(self, base: Rig, rounds: int) -> bool:
        """Whether the weights were made for this rig and subdivision."""
        return self.rounds == rounds and self.rig_sha256 == base.sha256

    def save(self, path: Path, facts: dict[str, str] | None = None) -> None:
        """Writes the weights aside and renames them into place.

        Args:
            path: a safetensors file.
            facts: what else its header says, such as how the weights were made.
        """
        header = {"schema": SCHEMA, "rig_sha256": self.rig_sha256, "rounds": str(self.rounds)}
        tensors = {"bones": self.bones.to(torch.uint8), "shares": self.shares.to(torch.uint16)}
        write_atomically({path: save(tensors, (facts or {}) | header)})

    @staticmethod
    def load(path: Path) -> "SparseSkin":
        """Reads weights back.

        Raises:
            RigError: if the file is missing, damaged or not of this schema.
        """
        if not path.is_file():
            raise RigError(f"no skin weights at {path}: make them with `handavatar rig refine`")
        try:
            with safe_open(path, framework="pt") as file:
                header = file.metadata() or {}
                bones, shares = (file.get_tensor(name) for name in ("bones", "shares"))
            skin = SparseSkin(
                bones.long(), shares.to(torch.int64), header["rig_sha256"], int(header["rounds"])
            )
            is_sound = not bones.is_floating_point() and skin.is_sound
        except Exception as error:
            raise_if_refused(error)
            raise RigError(
                f"{path}: cannot be read as skin weights ({error}); make them again with "
                "`handavatar rig refine`"
            ) from error
        if header.get("schema") != SCHEMA or not is_sound:
            raise RigError(
                f"{path}: not skin weights of schema {SCHEMA} whose rows sum to {_WHOLE}; make "
                "them again with `handavatar rig refine`"
            )
        return skin
