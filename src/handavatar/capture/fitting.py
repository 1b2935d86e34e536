"""The rig laid onto tracked landmarks and outlines: one hand shape, a pose for every frame.

All frames are fitted at once, in camera axes (OpenCV, the camera's centre as origin, metres).
First the landmarks alone decide; then the mesh's outline is drawn to the mask's, pair by pair.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.capture.fitted_hand import HandFit, HandModel, projected
from handavatar.capture.skin_points import SeenPoints
from handavatar.errors import require_ranges
from handavatar.geometry.rotations import axis_angle_from_matrix
from handavatar.hand.landmarks import HAND_SIZE
from handavatar.hand.pose import FINGER_BONES
from handavatar.hand.pose_sampling import (
    angles_from_rotations,
    gesture_rotations,
    limit_excess,
)
from handavatar.hand.rig import Rig
from handavatar.jobs.threads import one_thread

_LONG_FINGERS = ("index", "middle", "ring", "little")
PALM_LANDMARKS = (0, 1, 5, 9, 13, 17)
"""Those that move least with the fingers."""
_RETRY_GESTURES = ("fist", "relaxed", "pinch")
_BAD_RATIO = 1.6
LANDMARK_ERROR = 0.004
"""Metres by which a landmark is off, beside what the tracker itself admits."""
_OUTLINE_WEIGHT = 64


@dataclass(frozen=True)
class FitOptions:
    """How the hand is fitted; errors are those expected of what is observed."""

    focal_share: float = 1.0
    """Focal length over the longer side of the picture: phones and webcams have 0.75 to 1.2."""
    focal_tolerance: float = 0.1
    """Standard deviation of the logarithm of the focal length; 0: it is known."""
    landmark_error: float = LANDMARK_ERROR
    """Metres by which a tracked landmark is off, beside what the tracker itself admits."""
    outline_error: float = 0.0012
    """Metres between the outlines of mesh and mask in a good fit."""
    acceleration: float = 16.0
    """Hand sizes a second, each second, by which a landmark's speed changes: in hand sizes, so that
    a smaller hand is not a calmer one, and in seconds, so that frame rates do not matter."""
    landmark_steps: int = 250
    """Steps of the first stage."""
    outline_steps: int = 240
    """Steps of the second stage."""
    retry_steps: int = 90
    """Steps of every further attempt at a frame that fits badly."""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            focal_share=(0.05, 50),
            focal_tolerance=(0, 10),
            landmark_error=(1e-6, 1),
            outline_error=(1e-6, 1),
            acceleration=(1e-3, 1e6),
            landmark_steps=(0, 10**5),
            outline_steps=(0, 10**5),
            retry_steps=(0, 10**5),
        )


@dataclass(frozen=True, eq=False)
class SkinObservations:
    """What our own tracker sees beside where landmarks are: skin, and the depth of all points.

    Attributes:
        vertices: of the rig: which points of the skin follow the landmarks.
        places: of the skin, pixels of the picture.
        errors: expected, of each coordinate, pixels.
        depths: of the landmarks and then of the skin, behind the wrist, metres.
        depth_errors: expected, metres.
    """

    vertices: Int[Tensor, "skin"]
    places: Float[Tensor, "frames skin 2"]
    errors: Float[Tensor, "frames skin"]
    depths: Float[Tensor, "frames points"]
    depth_errors: Float[Tensor, "frames points"]

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "SkinObservations":
        """The same of some frames; they may repeat."""
        return SkinObservations(
            self.vertices,
            self.places[frames],
            self.errors[frames],
            self.depths[frames],
            self.depth_errors[frames],
        )


@dataclass(frozen=True, eq=False)
class Observations:
    """What was seen of a right hand in some frames of one video.

    Attributes:
        landmarks: pixels of the picture, in the tracker's order.
        uncertainty: of each landmark, pixels.
        world_landmarks: metres about the hand's centre, camera axes, of the tracker's mean hand.
        scale: picture pixels per metre at the hand.
        times: seconds.
        picture_size: width and height, pixels.
        principal_point: of the camera, pixels.
        skin: what our own tracker sees beside them; None where it was not asked.
    """

    landmarks: Float[Tensor, "frames 21 2"]
    uncertainty: Float[Tensor, "frames 21"]
    world_landmarks: Float[Tensor, "frames 21 3"]
    scale: Float[Tensor, "frames"]
    times: Float[Tensor, "frames"]
    picture_size: tuple[int, int]
    principal_point: tuple[float, float]
    skin: SkinObservations | None = None

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "Observations":
        """The same of some frames; they may repeat."""
        return Observations(
            self.landmarks[frames],
            self.uncertainty[frames],
            self.world_landmarks[frames],
            self.scale[frames],
            self.times[frames],
            self.picture_size,
            self.principal_point,
            None if self.skin is None else self.skin.chosen(frames),
        )


OWN_ERROR = 0.010
"""Metres by which points of our own tracker are off in the picture, beside what it admits: on real
pictures it is 5 to 26 mm from where MediaPipe sees the same landmarks, on made ones far less."""
OWN_DEPTH_ERROR = 0.004
"""Metres by which their depths are off, beside what it admits."""


def contradiction(
    apart: Float[Tensor, "frames points 2"],
    own: Float[Tensor, "frames points"],
    other: Float[Tensor, "frames points"],
) -> Float[Tensor, "frames points"]:
    """By what factor our tracker seems further off than it says, at least 1.

    It was taught by made pictures; where real ones are unlike those, nobody tells it but another
    tracker that sees the hand elsewhere.

    Args:
        apart: of the two trackers' landmarks, pixels.
        own: errors that our tracker admits, of each coordinate, pixels.
        other: those of the other one.
    """
    squared = apart.square().mean(-1) / (own.square() + other.square())
    return squared.clamp_min(1.0).sqrt()


def with_skin(
    seen: Observations,
    points: Sequence[SeenPoints],
    vertices: Int[Tensor, "skin"],
    nearest: Int[Tensor, "skin"],
) -> Observations:
    """Landmarks of both trackers in one, each as far as it is sure, and our own's skin and depths.

    Args:
        seen: by the other tracker; landmarks that are infinitely unsure count nothing.
        points: by our own, in the same frames.
        vertices: of the rig, which points behind the landmarks are; of another rig none.
        nearest: landmark of each of them: where that is contradicted, so is the skin.
    """

    def stacked(name: str) -> Tensor:
        values = torch.from_numpy(np.stack([getattr(point, name) for point in points])).float()
        return values[:, : seen.landmarks.shape[1] + len(vertices)]

    count, scale = seen.landmarks.shape[1], seen.scale[:, None]
    places, depths = stacked("places"), HAND_SIZE * stacked("depths")
    other = seen.uncertainty.hypot(LANDMARK_ERROR * scale)
    errors = stacked("errors").hypot(OWN_ERROR * scale)
    apart = places[:, :count] - seen.landmarks
    factors = contradiction(apart, errors[:, :count], other)
    factors = torch.cat([factors, factors[:, nearest]], dim=1)
    depth_errors = factors * (HAND_SIZE * stacked("depth_errors")).hypot(
        torch.tensor(OWN_DEPTH_ERROR)
    )
    own = errors[:, :count]
    share = (own**-2 / (own**-2 + other**-2))[..., None]
    both = share * places[:, :count] + (1 - share) * seen.landmarks
    # Where they contradict each other one of them is wrong, and nobody knows which.
    wide = (share * (1 - share))[..., 0] * apart.square().mean(-1)
    error = (1 / (own**-2 + other**-2) + wide).sqrt()
    across = (both - both.mean(1, keepdim=True)) / scale[..., None]
    return replace(
        seen,
        landmarks=both,
        uncertainty=error,
        world_landmarks=torch.cat([across, depths[:, :count, None]], dim=-1),
        skin=SkinObservations(
            vertices,
            places[:, count:],
            (factors * errors)[:, count:],
            depths,
            depth_errors,
        ),
    )


@dataclass(frozen=True, eq=False)
class OutlinePairs:
    """Vertices and the image points at which they ought to be seen.

    Attributes:
        vertices: indices.
        targets: pixels of the picture.
        normals: unit normals of the outline there; along it a vertex may slide.
        weights: 0 where a place in the array is not used.
    """

    vertices: Int[Tensor, "frames pairs"]
    targets: Float[Tensor, "frames pairs 2"]
    normals: Float[Tensor, "frames pairs 2"]
    weights: Float[Tensor, "frames pairs"]


@runtime_checkable
class PairFinder(Protocol):
    """Knows the outlines that were seen, one per frame."""

    def __call__(self, vertices: Float[Tensor, "frames vertices 3"], focal: float) -> OutlinePairs:
        """Pairs for posed vertices (metres, camera axes) and a focal length (pixels)."""
        ...

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "PairFinder":
        """The same for some frames; they may repeat."""
        ...


@one_thread()
def fit_hands(
    rig: Rig,
    observations: Observations,
    options: FitOptions,
    find_pairs: PairFinder | None = None,
) -> HandFit:
    """Shape, focal length, and the pose of every frame.

    Args:
        rig: any rig with fingertips.
        observations: of one right hand.
        options: expected errors, steps.
        find_pairs: correspondences of outlines; without it landmarks alone decide.
    """
    model = HandModel(rig)
    fit = initial_fit(model, observations, options)
    fit = refined(model, observations, fit, options, steps=options.landmark_steps)
    if find_pairs is not None:
        fit = refined(
            model, observations, fit, options, steps=options.outline_steps, find_pairs=find_pairs
        )
        fit = retried(model, observations, fit, options, find_pairs)
    return fit


def fit_poses(rig: Rig, observations: Observations, fit: HandFit, options: FitOptions) -> HandFit:
    """Poses of every frame by landmarks, anew, of a hand whose shape is known.

    Args:
        rig: any rig with fingertips.
        observations: of one right hand.
        fit: whose shape, focal length and offsets stay.
        options: expected errors, steps.
    """
    model = HandModel(rig)
    begin = initial_fit(model, observations, options)
    begin = replace(fit, rotations=begin.rotations, translation=begin.translation)
    begin = placed(model, observations, begin)
    steps = options.landmark_steps
    return refined(model, observations, begin, options, steps=steps, learns_shape=False)


def retried(
    model: HandModel,
    observations: Observations,
    fit: HandFit,
    options: FitOptions,
    find_pairs: PairFinder,
) -> HandFit:
    """Tries the worst explained frames again from other poses, and keeps what explains them best.

    Other poses are those of the nearest well explained frames before and after, and gestures.
    """
    energy = frame_energy(model, observations, fit, options, find_pairs)
    is_bad = energy > _BAD_RATIO * energy.median()
    if not bool(is_bad.any()) or bool(is_bad.all()):
        return fit
    bad, good = is_bad.nonzero()[:, 0], (~is_bad).nonzero()[:, 0]
    position = torch.searchsorted(good, bad)
    before, after = good[(position - 1).clamp_min(0)], good[position.clamp_max(len(good) - 1)]
    attempts = [fit.chosen(bad)]
    for neighbour in (before, after):
        attempts.append(replace(fit.chosen(bad), rotations=fit.rotations[neighbour]))
    for gesture in _RETRY_GESTURES:
        rotations = gesture_rotations(model.rig, gesture).repeat(len(bad), 1, 1)
        rotations[:, 0] = fit.rotations[bad, 0]
        attempts.append(replace(fit.chosen(bad), rotations=rotations))
    repeated = bad.repeat(len(attempts))
    seen, pairs = observations.chosen(repeated), find_pairs.chosen(repeated)
    start = replace(
        fit,
        rotations=torch.cat([attempt.rotations for attempt in attempts]),
        translation=torch.cat([attempt.translation for attempt in attempts]),
    )
    tried = refined(
        model,
        seen,
        placed(model, seen, start),
        options,
        steps=options.retry_steps,
        find_pairs=pairs,
        learns_shape=False,
    )
    result = frame_energy(model, seen, tried, options, pairs).reshape(len(attempts), len(bad))
    best = result.argmin(0)
    is_better = result.amin(0) < 0.97 * energy[bad]
    winner = (best * len(bad) + torch.arange(len(bad)))[is_better]
    rotations, translation = fit.rotations.clone(), fit.translation.clone()
    rotations[bad[is_better]] = tried.rotations[winner]
    translation[bad[is_better]] = tried.translation[winner]
    return replace(fit, rotations=rotations, translation=translation)


def initial_fit(model: HandModel, observations: Observations, options: FitOptions) -> HandFit:
    """Poses from the tracker's own 3D landmarks, placed where the 2D ones say."""
    frames = len(observations.landmarks)
    focal = options.focal_share * max(observations.picture_size)
    num_shapes = model.rig.shape_directions.shape[-1]
    rotations = gesture_rotations(model.rig, "relaxed").repeat(frames, 1, 1)
    fit = HandFit(
        rotations,
        torch.zeros(frames, 3),
        torch.zeros(num_shapes),
        torch.tensor(math.log(focal)),
        torch.zeros(21, 3),
    )
    seen = observations.world_landmarks
    palm = list(PALM_LANDMARKS)
    turn = aligning_rotation(model.landmarks(fit)[:, palm], seen[:, palm])
    fit.rotations[:, 0] = axis_angle_from_matrix(turn)
    fit = _fitted_to_world_landmarks(model, fit, seen)
    return placed(model, observations, fit)


def placed(model: HandModel, observations: Observations, fit: HandFit) -> HandFit:
    """The same poses, moved (not turned) to where the 2D landmarks are; least squares."""
    center = torch.tensor(observations.principal_point)
    points = model.landmarks(replace(fit, translation=torch.zeros_like(fit.translation)))
    rays = (observations.landmarks - center) / fit.log_focal.exp()
    one, zero = torch.ones_like(rays[..., 0]), torch.zeros_like(rays[..., 0])
    rows = torch.cat(
        [torch.stack([one, zero, -rays[..., 0]], -1), torch.stack([zero, one, -rays[..., 1]], -1)],
        dim=1,
    )
    flat = rays * points[..., 2:] - points[..., :2]
    right_side = torch.cat([flat[..., 0], flat[..., 1]], dim=1)
    translation = torch.linalg.lstsq(rows, right_side[..., None]).solution[..., 0]
    nearest = 0.08 - points[..., 2].amin(1)
    depth = torch.maximum(translation[:, 2], nearest)
    return replace(fit, translation=torch.cat([translation[:, :2], depth[:, None]], dim=1))


@one_thread()
def refined(
    model: HandModel,
    observations: Observations,
    fit: HandFit,
    options: FitOptions,
    *,
    steps: int,
    find_pairs: PairFinder | None = None,
    learns_shape: bool = True,
) -> HandFit:
    """Descends the whole energy from a given fit.

    Args:
        model: the hand.
        observations: one row per frame.
        fit: where to start.
        options: expected errors.
        steps: of Adam.
        find_pairs: called every 15 steps for new correspondences of outlines.
        learns_shape: whether shape, focal length and offsets move, and frames are successive;
            otherwise every frame stands alone.
    """
    free = replace(
        fit,
        rotations=fit.rotations.clone().requires_grad_(),
        translation=fit.translation.clone().requires_grad_(),
    )
    groups = [{"params": [free.rotations], "lr": 0.02}, {"params": [free.translation], "lr": 0.003}]
    if learns_shape:
        free = replace(
            free,
            shape_coefficients=fit.shape_coefficients.clone().requires_grad_(),
            offsets=fit.offsets.clone().requires_grad_(),
        )
        groups += [
            {"params": [free.shape_coefficients], "lr": 0.03},
            {"params": [free.offsets], "lr": 0.0004},
        ]
        if options.focal_tolerance > 0:
            free = replace(free, log_focal=fit.log_focal.clone().requires_grad_())
            groups.append({"params": [free.log_focal], "lr": 0.002})
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.98))
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 0.05 + 0.95 * math.cos(0.5 * math.pi * step / steps)
    )
    pairs = None
    for step in range(steps):
        if find_pairs is not None and step % 15 == 0:
            pairs = find_pairs(model.all_vertices(free), float(free.log_focal.detach().exp()))
        optimizer.zero_grad()
        energy = _frame_energy(model, observations, free, options, pairs).sum()
        if learns_shape:
            energy = energy + _shared_energy(model, observations, free, options)
        energy.backward()
        optimizer.step()
        schedule.step()
    return HandFit(
        free.rotations.detach(),
        free.translation.detach(),
        free.shape_coefficients.detach(),
        free.log_focal.detach(),
        free.offsets.detach(),
    )


@torch.no_grad()
def frame_energy(
    model: HandModel,
    observations: Observations,
    fit: HandFit,
    options: FitOptions,
    find_pairs: PairFinder,
) -> Float[Tensor, "frames"]:
    """How badly each frame is explained, in the unit of :func:`refined`."""
    pairs = find_pairs(model.all_vertices(fit), fit.focal)
    return _frame_energy(model, observations, fit, options, pairs)


@torch.no_grad()
def landmark_errors(
    model: HandModel, observations: Observations, fit: HandFit
) -> Float[Tensor, "frames"]:
    """Mean distance of fitted and tracked landmarks in every frame, pixels."""
    seen = projected(model.landmarks(fit), fit.log_focal.exp(), observations.principal_point)
    return (seen - observations.landmarks).norm(dim=-1).mean(-1)


def _frame_energy(
    model: HandModel,
    observations: Observations,
    fit: HandFit,
    options: FitOptions,
    pairs: OutlinePairs | None,
) -> Float[Tensor, "frames"]:
    """What each frame's own observations and the limits of its joints say."""
    focal = fit.log_focal.exp()
    landmarks = model.landmarks(fit)
    apart = projected(landmarks, focal, observations.principal_point) - observations.landmarks
    expected = torch.hypot(
        observations.uncertainty, options.landmark_error * observations.scale[:, None]
    )
    energy = _robust(apart.norm(dim=-1) / expected).sum(-1)
    # The tracker's depths are poor, but they tell towards and away.
    seen_depth = observations.world_landmarks[..., 2]
    depth = landmarks[..., 2] - landmarks[..., 2].mean(-1, keepdim=True)
    seen_depth = seen_depth - seen_depth.mean(-1, keepdim=True)
    energy = energy + 0.5 * _robust((depth - seen_depth) / 0.020).sum(-1)
    energy = energy + _pose_energy(model.rig, fit.rotations)
    if pairs is not None:
        energy = energy + _outline_energy(model, observations, fit, options, pairs)
    return energy


def _outline_energy(
    model: HandModel,
    observations: Observations,
    fit: HandFit,
    options: FitOptions,
    pairs: OutlinePairs,
) -> Float[Tensor, "frames"]:
    points = model.vertices(fit, pairs.vertices)
    seen = projected(points, fit.log_focal.exp(), observations.principal_point)
    apart = seen - pairs.targets
    across = (apart * pairs.normals).sum(-1)
    along = apart[..., 0] * pairs.normals[..., 1] - apart[..., 1] * pairs.normals[..., 0]
    expected = (options.outline_error * observations.scale[:, None]).clamp_min(1.0)
    terms = _robust((across.square() + 0.02 * along.square() + 1e-9).sqrt() / expected)
    share = (terms * pairs.weights).sum(-1) / pairs.weights.sum(-1).clamp_min(1.0)
    # Neighbouring outline points err together: all of them weigh as much as this many.
    return _OUTLINE_WEIGHT * share


def _pose_energy(rig: Rig, rotations: Float[Tensor, "frames bones 3"]) -> Float[Tensor, "frames"]:
    """Joint limits, and mild habits: little twist, end joints that follow the middle ones."""
    excess = limit_excess(rig, rotations)[:, 1:]
    energy = (excess / math.radians(4)).square().sum(-1)
    angles = angles_from_rotations(rig, rotations)
    flexion = angles[..., 0]
    for finger in _LONG_FINGERS:
        _, middle, last = FINGER_BONES[finger]
        follows = flexion[:, last] - 0.55 * flexion[:, middle]
        energy = energy + 0.5 * (follows / math.radians(15)).square()
    return energy + 0.5 * (angles[:, 1:] / math.radians(60)).square().sum((-1, -2))


def _shared_energy(
    model: HandModel, observations: Observations, fit: HandFit, options: FitOptions
) -> Float[Tensor, ""]:
    """Priors of shape, focal length and offsets, and even motion in time."""
    prior_focal = math.log(options.focal_share * max(observations.picture_size))
    frames = len(fit.rotations)
    # The frames share their errors (one tracker, one rig): the priors weigh with their number.
    priors = (
        fit.shape_coefficients.square().sum()
        + (fit.offsets / model.offset_tolerance[:, None]).square().sum()
    )
    if options.focal_tolerance > 0:
        priors = priors + ((fit.log_focal - prior_focal) / options.focal_tolerance).square()
    energy = 0.1 * frames * priors
    if frames < 3:
        return energy
    landmarks = model.landmarks(fit)
    before, after = (
        observations.times[1:-1] - observations.times[:-2],
        observations.times.diff()[1:],
    )
    gap = (before + after)[:, None, None] / 2
    speed = (landmarks[1:-1] - landmarks[:-2]) / before[:, None, None]
    next_speed = (landmarks[2:] - landmarks[1:-1]) / after[:, None, None]
    bend = next_speed - speed
    size = landmarks.detach()[:, [9]].sub(landmarks.detach()[:, [0]]).norm(dim=-1).mean() * 2
    # In units of the hand's size: divided by it, gradient and all.
    palm = (landmarks[:, 9] - landmarks[:, 0]).norm(dim=-1).mean() * 2
    expected = (options.acceleration * gap.square()[..., 0]).hypot(options.landmark_error / size)
    return energy + 0.5 * _robust(bend.norm(dim=-1) / palm * gap[..., 0] / expected).sum()


def _robust(ratio: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Squared below 1, then like a logarithm: outliers lose their pull."""
    return torch.log1p(0.5 * ratio.square()) * 2


def aligning_rotation(
    source: Float[Tensor, "frames points 3"], target: Float[Tensor, "frames points 3"]
) -> Float[Tensor, "frames 3 3"]:
    """The rotation that best lays ``source`` on ``target``, both about their means."""
    source = source - source.mean(1, keepdim=True)
    target = target - target.mean(1, keepdim=True)
    u, _, v = torch.linalg.svd(target.transpose(-1, -2) @ source)
    sign = torch.ones(len(source), 3)
    sign[:, 2] = torch.linalg.det(u @ v)
    return (u * sign[:, None]) @ v


def _fitted_to_world_landmarks(
    model: HandModel, fit: HandFit, seen: Float[Tensor, "frames 21 3"]
) -> HandFit:
    """Joint rotations by the tracker's 3D landmarks, whose hand is brought to the rig's size."""
    palm = list(PALM_LANDMARKS)
    seen = seen - seen[:, palm].mean(1, keepdim=True)
    rest = model.landmarks(fit)
    size = (rest[:, palm] - rest[:, palm].mean(1, keepdim=True)).norm(dim=-1).mean(1)
    seen = seen * (size / seen[:, palm].norm(dim=-1).mean(1))[:, None, None]
    rotations = fit.rotations.clone().requires_grad_()
    optimizer = torch.optim.Adam([rotations], lr=0.05)
    for _ in range(80):
        optimizer.zero_grad()
        points = model.landmarks(replace(fit, rotations=rotations))
        points = points - points[:, palm].mean(1, keepdim=True)
        energy = _robust((points - seen).norm(dim=-1) / 0.010).sum()
        (energy + _pose_energy(model.rig, rotations).sum()).backward()
        optimizer.step()
    return replace(fit, rotations=rotations.detach())
