"""Levenberg and Marquardt's descent of the one energy: poses frame by frame, shape for all at once.

Each frame has its own damping, and keeps its pose where a step does not lower its energy. A step
of the shape moves all poses with it (Schur complement), and is taken back as a whole.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.fit.appearance import SeenTexture, SkinTexture, see_texture
from handavatar.fit.energy import (
    EnergyOptions,
    HandPoints,
    Linearised,
    Observation,
    linearise_frame,
)
from handavatar.fit.habits import habit_residuals
from handavatar.fit.kinematics import NUM_UNKNOWNS, moved_pose, pose_difference
from handavatar.fit.motion import MotionTerms, motion_terms, solve_chain
from handavatar.fit.pictures import PictureBand
from handavatar.hand.pose import HandPose
from handavatar.jobs.threads import mapped

_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e4
_LONGEST_TURN = 0.35
"""Radians of one step."""
_FURTHER, _BACK = 0.25, 6.0
_MOST_BYTES = 1100 * 2**20
"""Of pictures, and of their bands that are kept; one 256 wide has half a MB, and 1 MB a band."""
_ADDED = 64
"""Frames whose part of the shared unknowns is added up at once."""


@dataclass(frozen=True, eq=False)
class Look:
    """How frames are looked at in one stage.

    Attributes:
        sigma: of the pictures' band, pixels.
        outlier: at which an outline loses its pull, pixels of 256.
        texture: to compare with; None leaves it out.
        texture_error: expected, of one channel.
    """

    sigma: float
    outlier: float
    texture: SkinTexture | None = None
    texture_error: float = 1.0


@dataclass(eq=False)
class Descent:
    """The unknowns of a fit, and where they are now.

    Attributes:
        observations: frame by frame.
        times: of the frames, seconds; successive ones keep each other even.
        tracked: poses to stay near.
        information: how near, the inverse covariance of each tracked pose's errors.
        points_of: the hand for given shared unknowns.
        shared_sigmas: expected size of the shared unknowns.
        options: expected errors.
        is_sequence: whether the frames follow each other in time.
        poses: as found so far.
        shared: unknowns that all frames share: shape, offsets of landmarks.
        threads: among which the frames are shared out.
    """

    observations: list[Observation]
    times: Float[Tensor, "frames"]
    tracked: HandPose
    information: Float[Tensor, "frames 51 51"]
    points_of: Callable[[Float[Tensor, "shared"], int], HandPoints]
    shared_sigmas: Float[Tensor, "shared"]
    options: EnergyOptions
    is_sequence: bool
    poses: HandPose
    shared: Float[Tensor, "shared"]
    threads: int
    damping: Float[Tensor, "frames"] = field(init=False)
    shared_damping: float = 1e-2
    _bands: dict[tuple[int, float], PictureBand] = field(default_factory=dict)
    _room: int = field(init=False)

    def __post_init__(self) -> None:
        """Begins with little damping."""
        self.damping = torch.full((len(self.observations),), _DAMPING)
        self._room = _MOST_BYTES - sum(seen.picture.num_bytes for seen in self.observations)

    def select(self, frames: Int[Tensor, "selected"]) -> "Descent":
        """A descent of some frames, each for itself; they may repeat."""
        numbers = frames.tolist()
        selected = replace(
            self,
            observations=[self.observations[number] for number in numbers],
            times=self.times[frames],
            tracked=_at(self.tracked, frames),
            information=self.information[frames],
            is_sequence=False,
            poses=_at(self.poses, frames),
            points_of=lambda shared, place: self.points_of(shared, numbers[place]),
        )
        selected._bands, selected._room = {}, self._room
        for place, number in enumerate(numbers):
            for (frame, sigma), picture in self._bands.items():
                if frame == number:
                    selected._bands[place, sigma] = picture
        return selected

    def band(self, frame: int, sigma: float) -> PictureBand:
        """A band of a frame's picture; kept, unless those of very many frames are already."""
        key = (frame, sigma)
        if (kept := self._bands.get(key)) is not None:
            return kept
        band = self.observations[frame].picture.band(sigma)
        if (len(self._bands) + 1) * band.channels.nbytes <= self._room:
            self._bands[key] = band
        return band

    def forget_other_bands(self, sigma: float) -> None:
        """Frees what belongs to other blurs."""
        self._bands = {key: value for key, value in self._bands.items() if key[1] == sigma}

    def see(self, look: Look) -> list[SeenTexture]:
        """The texture that every frame shows, with the poses as they are."""

        def seen(frame: int) -> SeenTexture:
            points = self.points_of(self.shared, frame)
            vertices = points.hand.posed(_at(self.poses, frame)).vertices
            picture = self.observations[frame].picture
            band = self.band(frame, look.sigma)
            return see_texture(points.hand.rig, vertices, points.surface, picture, band)

        return mapped(seen, range(len(self.observations)), self.threads, tidies=True)

    def energies(self, look: Look) -> Float[Tensor, "frames"]:
        """Of each frame, priors included."""
        return self._linearised(look, self.poses).energies

    def judge(self, look: Look) -> tuple[Float[Tensor, "frames"], Float[Tensor, "frames 51 51"]]:
        """Energies, and covariances of the poses' errors as the curvature of the energy says.

        For these, neighbours in time are held still.
        """
        here = self._linearised(look, self.poses)
        return here.energies, torch.linalg.inv(here.pose_blocks().double()).float()

    def tracked_information(self) -> Float[Tensor, "frames 51 51"]:
        """What motion and the tracked poses say of each pose: no landmarks, masks or colours.

        Whoever goes on from the poses found, with these observations at hand, holds them by this.
        """
        times = self.times if self.is_sequence else self.times[:0]
        curvature = motion_terms(self.poses, times).curvature(len(self.information))
        return self.information + torch.diag_embed(curvature)

    def step_poses(self, look: Look, steps: int) -> None:
        """Descends in the poses; every frame keeps what is best for it."""
        here = self._linearised(look, self.poses)
        for _ in range(steps):
            change = here.solve(self.damping)
            candidate = moved_pose(self.poses, change)
            there = self._linearised(look, candidate)
            is_better = there.energies < here.energies
            self._damp(is_better)
            self.poses = _merged(is_better, candidate, self.poses)
            if bool(is_better.all()):
                here = there
            else:
                here = here.merged(is_better, there)
                if self.is_sequence:
                    here = replace(here, motion=motion_terms(self.poses, self.times))

    def step_shape(self, look: Look, steps: int) -> None:
        """Descends in shape and poses together; taken back unless the whole energy falls."""
        if len(self.shared) == 0:
            self.step_poses(look, steps)
            return
        here = self._linearised(look, self.poses, self.shared)
        for _ in range(steps):
            change, shared_change = here.solve_shared(
                self.damping, self.shared, self.shared_sigmas, self.shared_damping
            )
            candidate = moved_pose(self.poses, change)
            shared = self.shared + shared_change
            there = self._linearised(look, candidate, shared)
            prior = (self.shared / self.shared_sigmas).square().sum()
            new_prior = (shared / self.shared_sigmas).square().sum()
            if there.energies.sum() + new_prior < here.energies.sum() + prior:
                self.poses, self.shared, here = candidate, shared, there
                self.shared_damping = max(self.shared_damping * _FURTHER, _LEAST_DAMPING)
            else:
                self.shared_damping *= _BACK
                self.damping = (self.damping * _BACK).clamp_max(_MOST_DAMPING)

    def _damp(self, is_better: Bool[Tensor, "frames"]) -> None:
        factor = torch.where(is_better, _FURTHER, _BACK)
        self.damping = (self.damping * factor).clamp(_LEAST_DAMPING, _MOST_DAMPING)

    def _linearised(
        self, look: Look, poses: HandPose, shared: Float[Tensor, "shared"] | None = None
    ) -> "_Whole":
        """What all frames say at some poses; of the shared unknowns' slopes only if these move."""
        count, num_shared = len(self.observations), 0 if shared is None else len(shared)
        # Of a thousand frames these matrices are the most that is held: those of the shared
        # unknowns are added up, some frames at a time.
        blocks = torch.zeros(count, NUM_UNKNOWNS, NUM_UNKNOWNS)
        mixed = torch.zeros(count, NUM_UNKNOWNS, num_shared)
        gradient, energies = torch.zeros(count, NUM_UNKNOWNS), torch.zeros(count)
        curvature, slope = torch.zeros(num_shared, num_shared), torch.zeros(num_shared)
        own, others = slice(NUM_UNKNOWNS), slice(NUM_UNKNOWNS, None)

        def linearised(frame: int) -> Linearised:
            points = self.points_of(self.shared if shared is None else shared, frame)
            return linearise_frame(
                points.with_shared_fixed() if shared is None else points,
                _at(poses, frame),
                self.observations[frame],
                self.band(frame, look.sigma),
                look.texture,
                look.texture_error,
                look.sigma,
                look.outlier,
                self.options,
            )

        for start in range(0, count, _ADDED):
            some = slice(start, min(start + _ADDED, count))
            parts = mapped(linearised, range(count)[some], self.threads, tidies=True)
            hessians = torch.stack([part.hessian for part in parts])
            gradients = torch.stack([part.gradient for part in parts])
            blocks[some], mixed[some] = hessians[:, own, own], hessians[:, own, others]
            gradient[some] = gradients[:, own]
            energies[some] = torch.tensor([part.energy for part in parts])
            curvature += hessians[:, others, others].sum(0)
            slope += gradients[:, others].sum(0)
        rig = self.points_of(self.shared, 0).hand.rig
        residuals, jacobian = habit_residuals(rig, poses.rotations)
        energies += residuals.square().sum(-1)
        jacobian = torch.nn.functional.pad(jacobian, (0, 3))
        blocks += jacobian.mT @ jacobian + self.information
        away = pose_difference(self.tracked, poses)
        pull = (self.information @ away[..., None])[..., 0]
        gradient += (jacobian.mT @ residuals[..., None])[..., 0] + pull
        energies += (away * pull).sum(-1)
        motion = motion_terms(poses, self.times if self.is_sequence else self.times[:0])
        return _Whole(blocks, gradient, energies, motion, mixed, curvature, slope)


@dataclass(frozen=True, eq=False)
class _Whole:
    """All frames, linearised.

    Attributes:
        blocks: each frame's own matrix.
        gradient: of each frame's pose.
        own_energies: of each frame, without motion.
        motion: what joins neighbours.
        mixed: of each frame's pose with the shared unknowns, if these move.
        curvature: of the shared unknowns, sum of all frames.
        slope: their gradient, sum of all frames.
    """

    blocks: Float[Tensor, "frames 51 51"]
    gradient: Float[Tensor, "frames 51"]
    own_energies: Float[Tensor, "frames"]
    motion: MotionTerms
    mixed: Float[Tensor, "frames 51 shared"]
    curvature: Float[Tensor, "shared shared"]
    slope: Float[Tensor, "shared"]

    @property
    def energies(self) -> Float[Tensor, "frames"]:
        return self.own_energies + self.motion.frame_energy(len(self.own_energies))

    def pose_blocks(self) -> Float[Tensor, "frames 51 51"]:
        """Each frame's own matrix with its neighbours held still."""
        return self.blocks + torch.diag_embed(self.motion.curvature(len(self.blocks)))

    def merged(self, is_other: Bool[Tensor, "frames"], other: "_Whole") -> "_Whole":
        """Some frames of another; of poses alone."""
        return replace(
            self,
            blocks=torch.where(is_other[:, None, None], other.blocks, self.blocks),
            gradient=torch.where(is_other[:, None], other.gradient, self.gradient),
            own_energies=torch.where(is_other, other.own_energies, self.own_energies),
        )

    def _damped(self, damping: Float[Tensor, "frames"]) -> Float[Tensor, "frames 51 51"]:
        diagonal = self.blocks.diagonal(dim1=-2, dim2=-1)
        return self.blocks + torch.diag_embed(damping[:, None] * diagonal)

    def solve(self, damping: Float[Tensor, "frames"]) -> Float[Tensor, "frames 51"]:
        """The step of all poses, the shape held still."""
        gradient = self.gradient + self.motion.gradient(len(damping))
        step = -solve_chain(self._damped(damping), self.motion, gradient[..., None])[..., 0]
        return _bounded(step)

    def solve_shared(
        self,
        damping: Float[Tensor, "frames"],
        shared: Float[Tensor, "shared"],
        sigmas: Float[Tensor, "shared"],
        shared_damping: float,
    ) -> tuple[Float[Tensor, "frames 51"], Float[Tensor, "shared"]]:
        """The step of poses and shared unknowns together."""
        gradient = self.gradient + self.motion.gradient(len(damping))
        right = torch.cat([gradient[..., None], self.mixed], dim=-1)
        solved = solve_chain(self._damped(damping), self.motion, right)
        own, along = solved[..., 0], solved[..., 1:]
        curvature = self.curvature + torch.diag(sigmas**-2)
        slope = self.slope + shared / sigmas**2
        reduced = curvature - torch.einsum("fps,fpt->st", self.mixed, along)
        slope = slope - torch.einsum("fps,fp->s", self.mixed, own)
        reduced = reduced + shared_damping * torch.diag(curvature.diagonal())
        change = -torch.linalg.solve(reduced.double(), slope.double()).float()
        return _bounded(-own - along @ change), change


def _bounded(step: Float[Tensor, "frames 51"]) -> Float[Tensor, "frames 51"]:
    """The step, shortened where it turns a joint too far."""
    longest = step[:, :-3].abs().amax(-1, keepdim=True)
    return step * (_LONGEST_TURN / longest.clamp_min(_LONGEST_TURN))


def _at(poses: HandPose, frames: Int[Tensor, "selected"] | int) -> HandPose:
    return HandPose(poses.rotations[frames], poses.translation[frames])


def _merged(is_first: Bool[Tensor, "frames"], first: HandPose, second: HandPose) -> HandPose:
    return HandPose(
        torch.where(is_first[:, None, None], first.rotations, second.rotations),
        torch.where(is_first[:, None], first.translation, second.translation),
    )
