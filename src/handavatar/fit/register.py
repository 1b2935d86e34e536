"""Registration: poses of all frames, and the shape, laid onto what the frames show.

First the outlines decide, from wide to narrow; frames that they explain badly are begun again from
other poses. Then the shape shares the blame, and how far the tracked poses are off is learned from
how far they had to move. The texture comes last, when the start is not spoilt, from coarse to fine.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.errors import SEEDS, require_ranges
from handavatar.fit.appearance import SkinTexture, fit_texture, look_up_points
from handavatar.fit.contact import fill_with_balls
from handavatar.fit.energy import EnergyOptions, HandPoints, Observation
from handavatar.fit.kinematics import NUM_UNKNOWNS, RestPoints, moved_pose, pose_difference
from handavatar.fit.landmarks import landmark_rest, offset_tolerances
from handavatar.fit.pictures import FramePicture
from handavatar.fit.shape import ShapeSpace, fixed_shape
from handavatar.fit.solver import Descent, Look
from handavatar.geometry.meshes import SurfacePoints, sample_surface_evenly
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState
from handavatar.jobs.threads import one_thread

_NUM_POINTS = 4096
_WIDE, _MIDDLE, _NARROW = 6.0, 3.0, 1.5
_FARTHEST = torch.tensor([0.2] * (NUM_UNKNOWNS - 3) + [0.02] * 3)
"""Radians and metres by which a pose to begin anew from is moved, one standard deviation."""
_TILTED_EVERY = 3
_THOROUGH_STEPS = 4
_TRIED_STEPS = 2
"""Of each width, from a pose that is tried."""
_LANDMARK_STEPS = 10
_OUTLINE_BESIDE_LANDMARKS = 2.5
"""Independent points of an outline, each way, where landmarks are to lead."""
_FOLLOWED_STEPS = 4
"""At each size of details, of a picture that is followed."""
_NO_LANDMARKS = RestPoints(torch.zeros(0, 3), torch.zeros(0, 16), torch.zeros(0, 3, 0))
_FINE = 0.7
"""Pixels of blur while outlines alone are looked at."""
_BAD = 1.3
"""Times the median energy: such frames are begun again."""
_LEAST_TEXTURE_ERROR = 0.01
"""Of logarithms of colours: a step of eight bits, and a little noise."""
_MILLIMETRES_PER_DEGREE = 0.5
"""A tracker that is off by some degrees is off by as many half millimetres, each way."""
_SHARED_ERRORS = 0.1
"""Of what a frame says about the shape, so much stands for errors that all frames share."""
_LEAST_ERROR, _MOST_ERROR = 0.5, 12.0
"""Degrees."""


@dataclass(frozen=True)
class RegisterOptions:
    """How hands are laid onto pictures."""

    pose_error: float = 5.0
    """Degrees by which a joint of a tracked pose is off, where the capture does not say."""
    learns_pose_error: bool = True
    """Whether this error is learned from all frames together."""
    is_wide: bool = True
    """Whether the start may be off by a finger's width."""
    tilts: tuple[float, ...] = ()
    """Degrees by which whole hands are tilted, each way, to begin anew: outlines alone hardly tell
    a hand that leans back from one that bends forward."""
    restarts: int = 4
    """Times that badly explained frames are begun anew."""
    texture_sigmas: tuple[float, ...] = (5.0, 2.5, 1.2)
    """Size of the details that are compared, pixels of 256."""
    texture_rounds: int = 4
    """Turns of texture and poses at each."""
    coefficient_sigma: float = 0.5
    """Standard deviations by which the shape coefficients may be off."""
    seed: int = 0
    """Of the poses to begin anew from."""
    energy: EnergyOptions = field(default_factory=EnergyOptions)
    """Expected errors of what is observed."""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            pose_error=(0.01, 180),
            tilts=(0, 180),
            restarts=(0, 1000),
            texture_sigmas=(0.1, 100),
            texture_rounds=(0, 1000),
            coefficient_sigma=(1e-3, 10),
            seed=SEEDS,
        )


@dataclass(frozen=True, eq=False)
class Registered:
    """What a registration found.

    Attributes:
        poses: of all frames.
        covariances: of their errors, as the energy's curvature has them: joints' turns (radians),
            then translation (metres).
        hand: rest hand of the first frame with its shape as found.
        shape_change: of the rig's coefficients.
        offsets: of the tracker's landmarks, metres; none without landmarks.
        information: what motion and the tracked poses say of each pose, without landmarks, masks
            and colours: an inverse covariance.
        energies: how badly each frame is explained; a good one has about as many as the best.
        pose_error: degrees by which the tracked poses were off, as learned.
        texture: of the surface's points in the finest band, if it was looked at.
    """

    poses: HandPose
    covariances: Float[Tensor, "frames 51 51"]
    hand: ShapedHand
    shape_change: Float[Tensor, "shapes"]
    offsets: Float[Tensor, "offsets"]
    information: Float[Tensor, "frames 51 51"]
    energies: Float[Tensor, "frames"]
    pose_error: float
    texture: SkinTexture | None


@torch.no_grad()
def register(
    hands: Sequence[ShapedHand],
    observations: Sequence[Observation],
    tracked: HandPose,
    information: Float[Tensor, "frames 51 51"] | None,
    options: RegisterOptions,
    is_sequence: bool = False,
    learns_shape: bool = True,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> Registered:
    """Lays one hand onto all frames.

    Args:
        hands: rest hand to begin with, one for all frames or one for each; one shape is added to
            all of them.
        observations: of the frames.
        tracked: poses to begin with.
        information: inverse covariances of their errors; None where nobody knows: then they are
            learned.
        options: expected errors, rounds.
        is_sequence: whether the frames are neighbours in time.
        learns_shape: whether the hand's shape moves.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        Interrupted: if the command was told to stop.
    """
    threads = torch.get_num_threads()
    with one_thread():
        return _register(
            hands,
            observations,
            tracked,
            information,
            options,
            is_sequence,
            learns_shape,
            progress,
            kept,
            threads,
        )


def _register(
    hands: Sequence[ShapedHand],
    observations: Sequence[Observation],
    tracked: HandPose,
    information: Float[Tensor, "frames 51 51"] | None,
    options: RegisterOptions,
    is_sequence: bool,
    learns_shape: bool,
    progress: Progress,
    kept: StageState,
    threads: int,
) -> Registered:
    """As :func:`register`; frames are shared out among threads, all else is done by one."""
    rig = hands[0].rig
    space = ShapeSpace.around(rig, options.coefficient_sigma) if learns_shape else fixed_shape(rig)
    generator = torch.Generator().manual_seed(options.seed)
    surface, balls = _compared_points(rig), fill_with_balls(rig)
    sightings = [seen.landmarks for seen in observations if seen.landmarks is not None]
    has_landmarks = len(sightings) > 0
    skin = sightings[0].vertices if has_landmarks else None
    num_shapes = len(space.sigmas)

    last: tuple[Tensor, HandPoints] | None = None

    def points_of(shared: Float[Tensor, "shared"], frame: int) -> HandPoints:
        nonlocal last
        if last is not None and last[0] is shared:
            return last[1]
        shaped = space.shaped(hands[frame if len(hands) > 1 else 0], shared[:num_shapes])
        landmarks = (
            landmark_rest(shaped, space, shared[num_shapes:], skin)
            if has_landmarks
            else _NO_LANDMARKS
        )
        points = HandPoints(shaped, space, surface, balls, landmarks)
        if len(hands) == 1:  # The same for all frames.
            last = shared, points
        return points

    # The frames share their errors (one rig, one way to cut out hands): shape has to be worth it.
    space_sigmas = space.sigmas / max(1.0, _SHARED_ERRORS * len(observations)) ** 0.5
    sigmas = torch.cat([space_sigmas, offset_tolerances()]) if has_landmarks else space_sigmas
    shared = torch.zeros(len(sigmas))
    if has_landmarks:
        shared[num_shapes:] = torch.stack([seen.offsets for seen in sightings]).mean(0).flatten()

    error = options.pose_error
    is_learned = information is None and options.learns_pose_error
    if information is None:
        information = _information(error, len(observations))
    descent = Descent(
        observations=list(observations),
        times=torch.tensor([seen.time for seen in observations]),
        tracked=tracked,
        information=information,
        points_of=points_of,
        shared_sigmas=sigmas,
        options=options.energy,
        is_sequence=is_sequence,
        poses=tracked,
        shared=shared,
        threads=threads,
    )
    outlines, look = Look(_FINE, _NARROW), Look(_FINE, _NARROW)
    width = observations[0].picture.camera.width / 256

    def begin() -> None:
        for outlier in (_WIDE, _MIDDLE) if options.is_wide else (_MIDDLE,):
            descent.step_poses(Look(_FINE, outlier), 4)

    def tilt(degrees: float) -> None:
        begin_tilted(descent, outlines, degrees)
        begin_like_neighbours(descent, outlines)
        descent.step_shape(outlines, 2)

    def learn_error() -> None:
        nonlocal error
        error = _learned_error(descent, outlines, error)
        descent.information = _information(error, len(observations))
        descent.damping.fill_(1e-2)
        descent.step_shape(outlines, 2)
        descent.step_poses(outlines, 2)

    def draw_to_texture(sigma: float) -> None:
        nonlocal look
        descent.forget_other_bands(sigma * width)
        look = textured_look(descent, sigma * width)
        descent.step_poses(look, 2)

    # What is done, one piece after the other, and about how long each takes beside the others.
    pieces: list[tuple[float, Callable[[], None]]] = [(15.0, begin)]
    pieces.append((5.0, lambda: descent.step_shape(Look(_FINE, _MIDDLE), 4)))
    pieces += [(15.0, partial(tilt, degrees)) for degrees in options.tilts]
    pieces += [
        (2.5, partial(begin_anew, descent, outlines, generator, is_near=turn % 2 == 1))
        for turn in range(options.restarts)
    ]
    if has_landmarks:
        pieces.append((10.0, lambda: begin_at_landmarks(descent, outlines)))
    pieces.append((5.0, lambda: descent.step_shape(outlines, 4)))
    pieces += [(3.0, learn_error)] * (3 if is_learned else 0)
    rounds = len(options.texture_sigmas) * options.texture_rounds
    for sigma in options.texture_sigmas:
        pieces += [(45.0 / rounds, partial(draw_to_texture, sigma))] * options.texture_rounds
    total = sum(seconds for seconds, _ in pieces)
    done = 0

    def state() -> WorkState:
        return WorkState(
            {
                "rotations": descent.poses.rotations,
                "translation": descent.poses.translation,
                "shared": descent.shared,
                "damping": descent.damping.clone(),
                "information": descent.information,
                "generator": generator.get_state(),
            },
            {"done": done, "error": error, "shared_damping": descent.shared_damping},
        )

    if (begun := kept.read()) is not None:
        descent.poses = HandPose(begun.tensors["rotations"], begun.tensors["translation"])
        descent.shared = begun.tensors["shared"]
        descent.damping = begun.tensors["damping"]
        descent.information = begun.tensors["information"]
        descent.shared_damping = float(begun.facts["shared_damping"])
        generator.set_state(begun.tensors["generator"])
        done, error = int(begun.facts["done"]), float(begun.facts["error"])
    passed = sum(seconds for seconds, _ in pieces[:done])
    progress.skip(passed, total)
    before = state()
    # Of a piece that is broken off nothing is kept; the last one finds the texture for the end.
    with kept.kept(lambda: before) as now_and_then:
        for seconds, piece in pieces[done:]:
            piece()
            done, passed = done + 1, passed + seconds
            if done < len(pieces):
                before = state()
                now_and_then()
            progress(passed / total)
    energies, covariances = descent.judge(look)
    return Registered(
        descent.poses,
        covariances,
        points_of(descent.shared, 0).hand,
        descent.shared[: rig.shape_directions.shape[-1] if learns_shape else 0],
        descent.shared[num_shapes:],
        descent.tracked_information(),
        energies,
        error,
        look.texture,
    )


@torch.no_grad()
def follow_picture(
    hand: ShapedHand,
    seen: Observation,
    shown: FramePicture,
    pose: HandPose,
    information: Float[Tensor, "51 51"],
    options: RegisterOptions,
) -> HandPose:
    """One pose, drawn to a picture's outline and texture, when it is known how the hand looks.

    The picture's landmarks are not looked at.

    Args:
        hand: rest hand; its shape stays.
        seen: the picture to follow.
        shown: how the hand looks in the pose to begin with, from the same camera.
        pose: to begin with.
        information: inverse covariance of its errors.
        options: sizes of details, expected errors.

    Returns:
        The pose to begin with, unless outline and texture agree better with another one.
    """
    surface, space = _compared_points(hand.rig), fixed_shape(hand.rig)
    points = HandPoints(hand, space, surface, fill_with_balls(hand.rig), _NO_LANDMARKS)
    start = HandPose(pose.rotations[None], pose.translation[None])
    with one_thread():
        descent = Descent(
            # The pose to begin with has been laid onto them already.
            observations=[replace(seen, landmarks=None)],
            times=torch.zeros(1),
            tracked=start,
            information=information[None],
            points_of=lambda shared, frame: points,
            shared_sigmas=space.sigmas,
            options=options.energy,
            is_sequence=False,
            poses=start,
            shared=torch.zeros(0),
            threads=1,
        )
        vertices = hand.posed(pose).vertices
        look = Look(_FINE, _NARROW)
        for sigma in options.texture_sigmas:
            size = sigma * seen.picture.camera.width / 256
            known = look_up_points(hand.rig, vertices, surface, shown, shown.band(size))
            photographed = look_up_points(
                hand.rig, vertices, surface, seen.picture, descent.band(0, size)
            )
            both = known.is_compared & photographed.is_compared
            if not both.any():
                return pose
            apart = (photographed.values - known.values)[both]
            error = float(apart.norm(dim=-1).median()) / math.sqrt(3)
            texture = SkinTexture(known.values, known.is_compared.to(apart))
            look = Look(size, _NARROW, texture, max(error, _LEAST_TEXTURE_ERROR))
            descent.step_poses(look, _FOLLOWED_STEPS)
        found, after = descent.poses, float(descent.energies(look))
        descent.poses = start
        before = float(descent.energies(look))
    return HandPose(found.rotations[0], found.translation[0]) if after < before else pose


@lru_cache(maxsize=4)
def _compared_points(rig: Rig) -> SurfacePoints:
    """Evenly spread over the rig's template; the same ones every time."""
    generator = torch.Generator().manual_seed(0)
    return sample_surface_evenly(rig.template_vertices, rig.faces, _NUM_POINTS, generator)


def textured_look(descent: Descent, sigma: float) -> Look:
    """A look at the skin's texture, as all frames together show it at present."""
    look = Look(sigma, _NARROW)
    num_points = len(descent.points_of(descent.shared, 0).surface.faces)
    texture, error = fit_texture(descent.see(look), num_points)
    return replace(look, texture=texture, texture_error=max(error, _LEAST_TEXTURE_ERROR))


def begin_anew(descent: Descent, look: Look, generator: torch.Generator, is_near: bool) -> None:
    """Tries badly explained frames from other poses, and keeps what explains them better.

    Args:
        descent: of all frames.
        look: by which frames are judged.
        generator: of the other poses.
        is_near: whether to begin around what was found, instead of around what was tracked.
    """
    descent.step_poses(look, 4)
    before = descent.energies(look)
    bad = (before > _BAD * before.median()).nonzero()[:, 0]
    if len(bad) == 0:
        return
    around = descent.poses if is_near else descent.tracked
    spread = descent.information.diagonal(dim1=-2, dim2=-1).rsqrt()[bad]
    change = torch.randn(len(bad), NUM_UNKNOWNS, generator=generator) * spread.minimum(_FARTHEST)
    start = HandPose(around.rotations[bad], around.translation[bad])
    _try(descent, look, bad, moved_pose(start, change), _THOROUGH_STEPS)


def begin_at_landmarks(descent: Descent, look: Look) -> None:
    """Tries every frame from where its landmarks have the hand, however far that is.

    Where fingers lie on the palm the outline has many poses that are about as good, and a finger
    in one of them does not find its way to another.

    Args:
        descent: of all frames.
        look: by which frames are judged.
    """
    frames = torch.arange(len(descent.observations))
    part = descent.select(frames)
    part.options = replace(
        descent.options, outline_points=_OUTLINE_BESIDE_LANDMARKS, landmark_outlier=math.inf
    )
    part.step_poses(replace(look, outlier=_WIDE), _LANDMARK_STEPS)
    _try(descent, look, frames, part.poses, _TRIED_STEPS)


def begin_tilted(descent: Descent, look: Look, degrees: float) -> None:
    """Tries every frame with the whole hand tilted about its middle, four ways.

    Args:
        descent: of all frames.
        look: by which frames are judged.
        degrees: of the tilt.
    """
    # Neighbours lean alike: what one of them finds, the others are told afterwards.
    frames = torch.arange(0, len(descent.observations), _TILTED_EVERY)
    cameras = [seen.picture.camera.camera_from_world[:3, :3] for seen in descent.observations]
    views = torch.stack(cameras)
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            turn = torch.deg2rad(torch.tensor(sign * degrees)) * views[:, axis]
            tilt = matrix_from_axis_angle(turn)
            wrist = tilt @ matrix_from_axis_angle(descent.poses.rotations[:, 0])
            rotations = descent.poses.rotations.clone()
            rotations[:, 0] = axis_angle_from_matrix(wrist)
            # About the hand's middle, so that it stays where it is seen.
            middle = _middles(descent)
            joint = descent.points_of(descent.shared, 0).hand.rest_joints[0]
            arm = middle - joint - descent.poses.translation
            translation = descent.poses.translation + arm - (tilt @ arm[..., None])[..., 0]
            _try(
                descent,
                look,
                frames,
                HandPose(rotations[frames], translation[frames]),
                _TRIED_STEPS,
            )


def begin_like_neighbours(descent: Descent, look: Look) -> None:
    """Tries every frame with the joints of the frame before it, and of the one after it."""
    count = len(descent.observations)
    for step in (-1, 1):
        frames = torch.arange(max(0, -step), count - max(0, step))
        rotations = descent.poses.rotations[frames + step]
        start = HandPose(rotations, descent.poses.translation[frames])
        _try(descent, look, frames, start, _TRIED_STEPS)


def _middles(descent: Descent) -> Float[Tensor, "frames 3"]:
    hand = descent.points_of(descent.shared, 0).hand
    return hand.posed(descent.poses).vertices.mean(1)


def _try(
    descent: Descent, look: Look, frames: Int[Tensor, "tried"], start: HandPose, steps: int
) -> None:
    """Descends from other poses, and keeps those that explain their frames better."""
    part = descent.select(frames)
    before = part.energies(look)
    part.poses = start
    for outlier in (_WIDE, _MIDDLE, look.outlier):
        part.step_poses(replace(look, outlier=outlier), steps)
    is_better = part.energies(look) < before
    chosen = frames[is_better]
    rotations, translation = descent.poses.rotations.clone(), descent.poses.translation.clone()
    rotations[chosen] = part.poses.rotations[is_better]
    translation[chosen] = part.poses.translation[is_better]
    descent.poses = HandPose(rotations, translation)
    descent.damping[chosen] = 1e-2


def _information(degrees: float, count: int) -> Float[Tensor, "count 51 51"]:
    """Of poses whose every joint is off by so many degrees, root mean square."""
    turn = torch.deg2rad(torch.tensor(degrees)) / 3**0.5
    shift = 1e-3 * _MILLIMETRES_PER_DEGREE * degrees
    sigma = torch.cat([turn.expand(NUM_UNKNOWNS - 3), torch.full((3,), shift)])
    return torch.diag(sigma**-2).expand(count, -1, -1)


def _learned_error(descent: Descent, look: Look, error: float) -> float:
    """How far tracked poses are off: by how far they moved, and how unsure that still is.

    One step of expectation and maximisation for a single variance, of all frames that are well
    explained.
    """
    energies, covariances = descent.judge(look)
    is_good = energies < _BAD * energies.median()
    moved = pose_difference(descent.tracked, descent.poses)[is_good, :-3]
    variances = covariances.diagonal(dim1=-2, dim2=-1)[is_good, :-3]
    mean = (moved.square() + variances).mean()
    found = float(torch.rad2deg((3 * mean).sqrt()))
    return min(max(found, _LEAST_ERROR), _MOST_ERROR)
