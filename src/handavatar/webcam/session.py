"""One person before one camera: every picture's hand, warnings, coverage, and what comes next."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from handavatar.capture.windows import mirror_places
from handavatar.geometry.cameras import project
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.jobs.threads import one_thread
from handavatar.webcam.coverage import FINISHED, SkinCoverage, next_step
from handavatar.webcam.following import FollowedHand, HandFollower, WhichSide
from handavatar.webcam.posing import LivePose, PoseFollower
from handavatar.webcam.quality import ADVICE, Warning, find_warnings, warnings_without_hand

_UNSURE = 0.12
"""Mean distance of fitted and seen landmarks in hand sizes from which on the pose is not believed;
measured on made films it is 0.01 to 0.07."""
_COUNT_EVERY = 0.15
"""Seconds from one picture that counts for the skin to the next, at least: neighbours see
the same."""
_EVERY_DOT = 5
"""Of the vertices that face the camera, so manyth are shown."""


@dataclass(frozen=True, eq=False)
class LiveView:
    """What is told of one picture.

    Attributes:
        followed: the hand that the tracker saw; None if there is none.
        live: its pose.
        landmarks: of the fitted hand, pixels of the picture as it is.
        dots: some points of the skin that faces the camera, pixels of the picture as it is.
        are_seen: whether each of them has been seen well.
        warnings: what is wrong.
        is_counted: whether the picture was good enough to count for the skin.
        instruction: what to show next.
        steps: how much of each step is done, in [0, 1].
        seen_share: of the skin, seen well, in [0, 1].
    """

    followed: FollowedHand | None
    live: LivePose | None
    landmarks: Float[np.ndarray, "landmarks 2"]
    dots: Float[np.ndarray, "dots 2"]
    are_seen: list[bool]
    warnings: list[Warning]
    is_counted: bool
    instruction: str
    steps: dict[str, float]
    seen_share: float

    def as_json(self) -> dict[str, Any]:
        """The same for a page; places in tenths of a pixel."""
        return {
            "side": None if self.followed is None else self.followed.side,
            "landmarks": np.round(self.landmarks, 1).tolist(),
            "dots": np.round(self.dots, 1).tolist(),
            "are_seen": self.are_seen,
            "warnings": [
                {"kind": w.kind, "found": w.found, "remedy": w.remedy} for w in self.warnings
            ],
            "is_counted": self.is_counted,
            "instruction": self.instruction,
            "steps": {name: round(share, 3) for name, share in self.steps.items()},
            "seen_share": round(self.seen_share, 3),
        }


class LiveSession:
    """Sees pictures one after the other; for one thread at a time."""

    def __init__(
        self,
        hand: ShapedHand,
        side: WhichSide = "auto",
        focal_share: float = 1.0,
        follower: HandFollower | None = None,
    ) -> None:
        """Begins with nothing seen.

        Args:
            hand: rest hand that is laid onto the pictures.
            side: of the hand before the camera; auto tells which it is.
            focal_share: focal length over the longer side of the picture.
            follower: of hands; by default of the tracker that ships.
        """
        self._follower = follower or HandFollower(side)
        self._poser = PoseFollower(hand, self._follower.tracker.points, focal_share)
        self.coverage = SkinCoverage(hand.rig)
        self._counted = -_COUNT_EVERY

    @property
    def rig(self) -> Rig:
        """Of the hand."""
        return self._poser.hand.rig

    @one_thread()
    @torch.no_grad()
    def see(self, image: UInt8[np.ndarray, "height width 3"], time: float) -> LiveView:
        """The next picture.

        Args:
            image: sRGB, upright, not mirrored.
            time: seconds; grows.
        """
        height, width = image.shape[:2]
        followed = self._follower.see(image)
        if followed is None:
            nowhere = np.zeros((0, 2))
            warnings = warnings_without_hand(image)
            return self._view(None, None, nowhere, nowhere, [], warnings, False)
        live = self._poser.see(followed, (width, height), time)
        vertices = live.hand.posed(live.pose).vertices
        pixels = project(live.camera, vertices)[0].double().numpy()
        landmarks = self._poser.landmarks(live).double().numpy()
        if followed.is_mirrored:
            pixels, landmarks = (mirror_places(p, width) for p in (pixels, landmarks))
        is_unsure = live.misfit > _UNSURE
        warnings = find_warnings(image, followed.seen, pixels, is_unsure)
        is_counted = not {w.kind for w in warnings} & {"dark", "blur", "unsure", "small"}
        if is_counted and abs(time - self._counted) >= _COUNT_EVERY:
            self.coverage.add(live, vertices)
            self._counted = time
        dots = self._facing(live, vertices)
        are_seen = self.coverage.is_seen[dots].tolist()
        return self._view(
            followed, live, landmarks, pixels[dots.numpy()], are_seen, warnings, is_counted
        )

    def _facing(self, live: LivePose, vertices: Float[Tensor, "vertices 3"]) -> Int[Tensor, "dots"]:
        """Some of the vertices that the camera would see."""
        towards = torch.nn.functional.normalize(-vertices, dim=-1)
        normals = vertex_normals(vertices, live.hand.rig.faces)
        chosen = (((normals * towards).sum(-1)) > 0.2).nonzero()[:, 0]
        return chosen[chosen % _EVERY_DOT == 0]

    def _view(
        self,
        followed: FollowedHand | None,
        live: LivePose | None,
        landmarks: Float[np.ndarray, "landmarks 2"],
        dots: Float[np.ndarray, "dots 2"],
        are_seen: list[bool],
        warnings: list[Warning],
        is_counted: bool,
    ) -> LiveView:
        steps = self.coverage.shares()
        step = next_step(steps)
        instruction = FINISHED if step is None else step.instruction
        if followed is None:
            instruction = ADVICE["none"][1].capitalize() + "."
        return LiveView(
            followed,
            live,
            landmarks,
            dots,
            are_seen,
            warnings,
            is_counted,
            instruction,
            steps,
            self.coverage.share(),
        )
