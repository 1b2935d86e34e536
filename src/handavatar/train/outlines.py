"""Before the first step: poses and personal shape, drawn in turn to the outlines of all frames.

Colours are only learned where they belong once the mesh lies on the picture. On the coarse mesh,
whose outline is nearly that of the fine one, a frame costs a twentieth of a joint step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.alignment import aligned_pose
from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.field.shape import personal_hand
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import unique_edges
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand, Rig
from handavatar.jobs.finite import require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import unbroken
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState, named_tensors
from handavatar.jobs.threads import mapped
from handavatar.render.silhouette import known_at, silhouette_loss, soft_mask, soft_silhouette
from handavatar.train.corrections import PoseCorrections
from handavatar.train.losses import offset_loss
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)

# Frames per step of the shape; its learning rate falls to a tenth.
_BATCH = 4
_RATE = 4e-3
# Gauss-Newton steps per frame and round.
_ALIGNMENT_STEPS = 4
_ALIGNED_AT_ONCE = 16


@dataclass(frozen=True, eq=False)
class EdgeSet:
    """Edges of a rig's mesh, for the smoothness of offsets.

    Attributes:
        edges: each once.
        spacing: their mean length in the template, metres.
    """

    edges: Int[Tensor, "edges 2"]
    spacing: float

    @classmethod
    def of(cls, rig: Rig) -> "EdgeSet":
        """Of a rig's template."""
        edges = unique_edges(rig.faces)
        start, end = rig.template_vertices[edges].unbind(1)
        return cls(edges, float((end - start).norm(dim=-1).mean()))


def shape_losses(
    posed: PosedHand,
    offsets: Float[Tensor, "vertices 3"],
    camera: Camera,
    mask: Float[Tensor, "size size"],
    edges: EdgeSet,
    known: Bool[Tensor, "size size"] | None = None,
) -> dict[str, Tensor]:
    """L_shape on a small mask, and what keeps the personal offsets smooth.

    Args:
        posed: the personal hand in the frame.
        offsets: of its rest vertices, metres.
        camera: of the frame, of any resolution.
        mask: of the frame, from :func:`~handavatar.render.silhouette.soft_mask`.
        edges: of the same mesh.
        known: pixels of the mask that count; None for all.

    Source: paper Sec. 3.1, L_shape.
    """
    coverage = soft_silhouette(posed.vertices, posed.rig.faces, camera.resized(*mask.shape))
    if known is not None:
        coverage, mask = coverage[known], mask[known]
    return {
        "silhouette": silhouette_loss(coverage, mask),
        "offsets": offset_loss(offsets, edges.edges, edges.spacing),
    }


def fit_outlines(
    avatar: HandAvatar,
    corrections: PoseCorrections | None,
    frames: Sequence[Frame],
    rounds: int,
    visits: int,
    size: int,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> None:
    """Moves the avatar's shape, and the corrections, towards the masks of all frames.

    Args:
        avatar: only its shape offsets change.
        corrections: of tracked poses; None where poses are known exactly.
        frames: of training.
        rounds: poses, then shape, so many times; the poses once more at the end.
        visits: of every frame by the shape in one round.
        size: pixels along a side of the compared masks.
        seed: of the order of the frames.
        progress: told how many frames were seen.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.

    Departs: the authors start all losses at once.
    """
    if rounds == 0:
        return
    generator = torch.Generator().manual_seed(seed)
    edges = EdgeSet.of(avatar.base_rig)
    masks = [small_mask(frame, size) for frame in frames]
    optimizer = torch.optim.Adam(avatar.shape.parameters(), lr=_RATE, betas=(0.9, 0.99))
    falling = 0.1 ** (1 / (rounds * visits * -(-len(frames) // _BATCH)))
    pieces = _pieces(len(frames), rounds, visits, generator, corrections is not None)
    total = sum(len(numbers) for _, numbers in pieces)
    done, value = 0, math.nan

    def restored() -> int:
        state = kept.read()
        if state is None:
            return 0
        avatar.shape.load_state_dict(named_tensors(state.tensors, "shape."))
        if corrections is not None:
            corrections.load_state_dict(named_tensors(state.tensors, "corrections."))
        adam = named_tensors(state.tensors, "adam.")
        restore_optimizer(optimizer, adam, state.facts["adam"])
        return int(state.facts["pieces"])

    def state() -> WorkState:
        tensors = {f"shape.{name}": value for name, value in avatar.shape.state_dict().items()}
        if corrections is not None:
            poses = corrections.state_dict()
            tensors |= {f"corrections.{name}": value for name, value in poses.items()}
        tensors |= {f"adam.{name}": v for name, v in optimizer_tensors(optimizer).items()}
        return WorkState(tensors, {"pieces": done, "adam": optimizer_options(optimizer)})

    done = restored()
    seen = sum(len(numbers) for _, numbers in pieces[:done])
    progress.skip(seen, total)
    with kept.kept(state) as now_and_then:
        for is_of_poses, numbers in pieces[done:]:
            with unbroken():
                if is_of_poses:
                    assert corrections is not None
                    _align(avatar, corrections, frames, numbers)
                else:
                    value = _shape_step(avatar, corrections, frames, masks, edges, numbers)
                    require_finite({"silhouette": value}, f"outlines, piece {done + 1}")
                    optimizer.step()
                    for group in optimizer.param_groups:
                        group["lr"] *= falling
                done, seen = done + 1, seen + len(numbers)
            now_and_then()
            progress(seen, total, silhouette=value)
    optimizer.zero_grad(set_to_none=True)


def _pieces(
    count: int, rounds: int, visits: int, generator: torch.Generator, has_poses: bool
) -> list[tuple[bool, list[int]]]:
    """All that is to be done, in order: whether poses are laid or the shape is, and the frames."""
    poses = [(True, part.tolist()) for part in torch.arange(count).split(_ALIGNED_AT_ONCE)]
    poses = poses if has_poses else []
    pieces = []
    for _ in range(rounds):
        pieces += poses
        for _ in range(visits):
            order = torch.randperm(count, generator=generator)
            pieces += [(False, part.tolist()) for part in order.split(_BATCH)]
    return pieces + poses


def small_mask(
    frame: Frame, size: int
) -> tuple[Float[Tensor, "size size"], Bool[Tensor, "size size"] | None]:
    """What :func:`shape_losses` compares with: a frame's soft mask, and which pixels count.

    The second is None where all do.
    """
    mask = soft_mask(frame.alpha, size, known=frame.known)
    if bool(frame.known.all()):
        return mask, None
    return mask, known_at(frame.alpha, frame.known, size)


def corrected_pose(
    corrections: PoseCorrections | None, frame: Frame, number: int, device: torch.device
) -> HandPose:
    """The frame's pose as training sees it."""
    pose = frame.pose.to(device)
    return pose if corrections is None else corrections(number, pose)


def _align(
    avatar: HandAvatar, corrections: PoseCorrections, frames: Sequence[Frame], numbers: list[int]
) -> None:
    def align(number: int) -> None:
        frame = frames[number]
        pose = frame.pose.to(avatar.device)
        found = aligned_pose(
            avatar.coarse_personal,
            pose,
            frame.camera.to(avatar.device),
            frame.alpha,
            _ALIGNMENT_STEPS,
            corrections(number, pose),
            frame.known,
        )
        corrections.set(number, pose, found)

    mapped(align, numbers)


def _shape_step(
    avatar: HandAvatar,
    corrections: PoseCorrections | None,
    frames: Sequence[Frame],
    masks: list[tuple[Float[Tensor, "size size"], Bool[Tensor, "size size"] | None]],
    edges: EdgeSet,
    chosen: list[int],
) -> float:
    """Sets the gradient of the shape to that of some frames; returns their silhouette loss."""
    parameters = list(avatar.shape.parameters())

    def differentiated(number: int) -> tuple[tuple[Tensor, ...], float]:
        frame = frames[number]
        pose = corrected_pose(corrections, frame, number, avatar.device)
        camera, (mask, known) = frame.camera.to(avatar.device), masks[number]
        mask = mask.to(avatar.device)
        known = None if known is None else known.to(avatar.device)
        with torch.enable_grad():
            rest = avatar.coarse_rig.shaped(avatar.coefficients)
            offsets = avatar.shape(rest, pose.rotations)
            posed = personal_hand(rest, offsets).posed(pose)
            losses = shape_losses(posed, offsets, camera, mask, edges, known)
            gradient = torch.autograd.grad(torch.stack(list(losses.values())).sum(), parameters)
        return gradient, float(losses["silhouette"].detach())

    gradients, values = zip(*mapped(differentiated, chosen), strict=True)
    for parameter, parts in zip(parameters, zip(*gradients, strict=True), strict=True):
        parameter.grad = torch.stack(parts).mean(0)
    return sum(values) / len(values)
