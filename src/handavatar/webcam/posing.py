"""The pose of a followed hand: landmarks, skin and depths of one picture, and the pose before it.

Levenberg and Marquardt's descent of the one energy (:mod:`handavatar.fit.energy`), with the habits
of joints, in a few steps from the last pose. The hand's shape stays as it is given.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.fitted_hand import HandFit, HandModel
from handavatar.capture.fitting import (
    OWN_DEPTH_ERROR,
    OWN_ERROR,
    PALM_LANDMARKS,
    FitOptions,
    Observations,
    aligning_rotation,
    placed,
)
from handavatar.capture.skin_points import world_places
from handavatar.capture.windows import mirror_places
from handavatar.fit.energy import EnergyOptions, linearise_landmarks
from handavatar.fit.habits import habit_residuals
from handavatar.fit.kinematics import (
    NUM_UNKNOWNS,
    RestPoints,
    Skeleton,
    moved_pose,
    pose_difference,
)
from handavatar.fit.landmarks import NUM_OFFSETS, LandmarkSightings, landmark_rest
from handavatar.fit.shape import fixed_shape
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.landmarks import HAND_SIZE, NUM_LANDMARKS
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import ShapedHand
from handavatar.jobs.threads import one_thread
from handavatar.tracker.points import TrackedPoints
from handavatar.webcam.following import FollowedHand

_STEPS, _STEPS_AT_FIRST = 4, 8
"""At most, of a pose that is followed and of one that is begun."""
_SETTLED = 0.08
"""Radians: a step that turns no joint further is the last one."""
_BEGINNINGS = ("relaxed", "spread", "fist")
"""Gestures from which a pose of which nothing is known is begun; the best end counts."""
_DAMPING, _FURTHER, _BACK = 1e-2, 0.25, 6.0
_LONGEST_TURN = 0.5
"""Radians of one step."""
_TURN, _TURNING = 0.03, 4.0
"""How far joints turn from one picture to the next: radians, and radians a second."""
_SHIFT, _SHIFTING = 0.004, 0.5
"""How far the wrist goes: metres, and metres a second."""
_LOOSE_TURN, _LOOSE_SHIFT = 0.9, 0.05
"""How far a pose that nothing was known of may be from where it begins: radians, metres."""
_FORGOTTEN = 0.7
"""Seconds after which a pose says nothing more."""
_MISFIT = 0.2
"""Mean distance of landmarks in hand sizes from which on a pose is begun anew."""
_RESTART = 1.0
"""Seconds between two such beginnings, at least."""


@dataclass(frozen=True, eq=False)
class LivePose:
    """A right hand, as it is seen in a picture, or in its mirror image.

    Attributes:
        hand: rest hand.
        pose: in the camera's axes, metres.
        camera: of the picture, mirrored if the hand is a left one.
        misfit: mean distance of fitted and seen landmarks, in hand sizes.
    """

    hand: ShapedHand
    pose: HandPose
    camera: Camera
    misfit: float


class PoseFollower:
    """Gives each picture's pose, begun from the one before."""

    def __init__(
        self, hand: ShapedHand, points: TrackedPoints, focal_share: float = FitOptions.focal_share
    ) -> None:
        """Nothing was seen yet.

        Args:
            hand: rest hand, whose shape stays.
            points: of the tracker; of another rig than the hand's, landmarks alone are used.
            focal_share: focal length over the longer side of the picture.
        """
        self.hand = hand
        self._tracked = points
        self._focal_share = focal_share
        is_same = points.fit(hand.rig)
        self._vertices = points.vertices if is_same else points.vertices[:0]
        rest = landmark_rest(hand, fixed_shape(hand.rig), torch.zeros(NUM_OFFSETS), self._vertices)
        self._rest = RestPoints(rest.positions, rest.skin_weights, rest.directions[..., :0])
        self._model = HandModel(hand.rig)
        self._energy = EnergyOptions()
        self._last: HandPose | None = None
        self._time = 0.0
        self._restarted = -_RESTART

    @one_thread()
    @torch.no_grad()
    def see(self, followed: FollowedHand, size: tuple[int, int], time: float) -> LivePose:
        """The pose in a picture.

        Args:
            followed: what the tracker saw.
            size: of the picture: width, height.
            time: seconds; grows.
        """
        seen = self._observed(followed, size)
        camera = self._camera(size)
        landmarks = self._sightings(seen, camera)
        gap = time - self._time
        last = self._last
        if followed.is_new or last is None or not 0 < gap < _FORGOTTEN:
            pose = self._begun(seen, camera, landmarks)
            self._restarted = time
        else:
            loose = _sigmas(_TURN + _TURNING * gap, _SHIFT + _SHIFTING * gap)
            pose, _ = self._descend(last, loose, camera, landmarks, _STEPS)
        misfit = self._misfit(pose, camera, seen)
        if misfit > _MISFIT and time - self._restarted > _RESTART:
            other = self._begun(seen, camera, landmarks)
            self._restarted = time
            if (again := self._misfit(other, camera, seen)) < misfit:
                pose, misfit = other, again
        self._last, self._time = pose, time
        return LivePose(self.hand, pose, camera, misfit)

    def landmarks(self, live: LivePose) -> Float[Tensor, "21 2"]:
        """Where landmarks of a fitted hand are, pixels of its camera."""
        return project(live.camera, self._places(live.pose)[:NUM_LANDMARKS])[0]

    def _places(self, pose: HandPose) -> Float[Tensor, "points 3"]:
        still = self.hand.rest_joints.new_zeros(*self.hand.rest_joints.shape, 0)
        return Skeleton.of(self.hand, pose, still).positions(self._rest)

    def _camera(self, size: tuple[int, int]) -> Camera:
        focal = self._focal_share * max(size)
        return Camera((focal, focal), (size[0] / 2, size[1] / 2), *size, torch.eye(4))

    def _observed(self, followed: FollowedHand, size: tuple[int, int]) -> "_Observed":
        """In the mirror, if it is a left hand, in which it is a right one."""
        seen = followed.seen
        count = NUM_LANDMARKS + len(self._vertices)
        places = seen.points[:count]
        if followed.is_mirrored:
            places = mirror_places(places, size[0])
        landmarks = places[:NUM_LANDMARKS]
        world = world_places(self._tracked, landmarks, seen.depths[:NUM_LANDMARKS])
        flat = np.linalg.norm(world[:, :2] - world[:, :2].mean(0), axis=-1).sum()
        scale = np.linalg.norm(landmarks - landmarks.mean(0), axis=-1).sum() / max(flat, 1e-6)
        return _Observed(
            torch.from_numpy(places).float(),
            torch.from_numpy(np.hypot(seen.point_errors[:count], OWN_ERROR * scale)).float(),
            torch.from_numpy(HAND_SIZE * seen.depths[:count]).float(),
            torch.from_numpy(
                np.hypot(HAND_SIZE * seen.depth_errors[:count], OWN_DEPTH_ERROR)
            ).float(),
            torch.from_numpy(world).float(),
            float(scale),
        )

    def _sightings(self, seen: "_Observed", camera: Camera) -> LandmarkSightings:
        focal, center = camera.focal[0], seen.places.new_tensor(camera.center)
        return LandmarkSightings(
            (seen.places - center) / focal,
            seen.errors / focal,
            seen.depths - seen.depths.mean(),
            seen.depth_errors,
            torch.zeros(NUM_LANDMARKS, 3),
            self._vertices,
        )

    def _begun(self, seen: "_Observed", camera: Camera, landmarks: LandmarkSightings) -> HandPose:
        """A pose of which nothing was known."""
        size = (camera.width, camera.height)
        observations = Observations(
            seen.places[None, :NUM_LANDMARKS],
            seen.errors[None, :NUM_LANDMARKS],
            seen.world[None],
            torch.tensor([seen.scale]),
            torch.zeros(1),
            size,
            (float(camera.center[0]), float(camera.center[1])),
        )
        palm = list(PALM_LANDMARKS)
        loose = _sigmas(_LOOSE_TURN, _LOOSE_SHIFT)
        found = []
        for gesture in _BEGINNINGS:
            rotations = gesture_rotations(self.hand.rig, gesture)[None].clone()
            fit = HandFit(
                rotations,
                torch.zeros(1, 3),
                torch.zeros(self.hand.rig.shape_directions.shape[-1]),
                torch.tensor(camera.focal[0]).log(),
                torch.zeros(NUM_LANDMARKS, 3),
            )
            turn = aligning_rotation(self._model.landmarks(fit)[:, palm], seen.world[None, palm])
            wrist = turn @ matrix_from_axis_angle(rotations[:, 0])
            rotations[:, 0] = axis_angle_from_matrix(wrist)
            start = placed(self._model, observations, fit).pose(0)
            found.append(self._descend(start, loose, camera, landmarks, _STEPS_AT_FIRST))
        return min(found, key=lambda one: one[1])[0]

    def _descend(
        self,
        start: HandPose,
        sigmas: Float[Tensor, "51"],
        camera: Camera,
        landmarks: LandmarkSightings,
        steps: int,
    ) -> tuple[HandPose, float]:
        """A pose near another, as the sigmas say, and the energy before the last step.

        A small step, and the last one, is taken as it is: what it did shows in the next picture.
        """
        information = sigmas**-2

        def linearised(pose: HandPose) -> tuple[Tensor, Tensor, float]:
            seen = linearise_landmarks(self._rest, self.hand, pose, camera, landmarks, self._energy)
            residuals, jacobian = habit_residuals(self.hand.rig, pose.rotations[None])
            slopes = torch.nn.functional.pad(jacobian[0], (0, 3))
            away = pose_difference(start, pose)
            return (
                seen.hessian + slopes.T @ slopes + torch.diag(information),
                seen.gradient + slopes.T @ residuals[0] + information * away,
                seen.energy
                + float(residuals.square().sum())
                + float((information * away.square()).sum()),
            )

        pose, damping = start, _DAMPING
        hessian, gradient, energy = linearised(pose)
        for step in range(steps):
            damped = hessian + damping * torch.diag(hessian.diagonal())
            change = -torch.linalg.solve(damped, gradient)
            longest = float(change[:-3].abs().max())
            change = change * min(1.0, _LONGEST_TURN / max(longest, 1e-9))
            candidate = moved_pose(pose, change)
            if step == steps - 1 or longest < _SETTLED:
                return candidate, energy
            found = linearised(candidate)
            if found[2] < energy:
                pose, damping = candidate, damping * _FURTHER
                hessian, gradient, energy = found
            else:
                damping *= _BACK
        raise AssertionError("at least one step is taken")

    def _misfit(self, pose: HandPose, camera: Camera, seen: "_Observed") -> float:
        apart = (project(camera, self._places(pose))[0] - seen.places)[:NUM_LANDMARKS]
        return float(apart.norm(dim=-1).mean()) / (seen.scale * HAND_SIZE)


@dataclass(frozen=True, eq=False)
class _Observed:
    """Of a right hand: places and their errors in pixels, depths and theirs in metres."""

    places: Float[Tensor, "points 2"]
    errors: Float[Tensor, "points"]
    depths: Float[Tensor, "points"]
    depth_errors: Float[Tensor, "points"]
    world: Float[Tensor, "21 3"]
    scale: float


def _sigmas(turn: float, shift: float) -> Float[Tensor, "51"]:
    return torch.cat([torch.full((NUM_UNKNOWNS - 3,), turn), torch.full((3,), shift)])
