"""The one energy of a hand laid onto a picture, linearised: what each observation says of a pose.

Every term is a weighted sum of squared residuals in units of their expected error. Points of an
outline, and details of neighbouring points, err together: a term's weight is the number of
independent observations it stands for, however many points it is evaluated at.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.errors import require_ranges
from handavatar.fit.appearance import SkinTexture, look_up_points
from handavatar.fit.contact import Balls, overlaps
from handavatar.fit.kinematics import (
    NUM_UNKNOWNS,
    RestPoints,
    Skeleton,
    pixel_jacobian,
    rest_with_pose,
)
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.fit.pictures import FramePicture, PictureBand, drawing_camera
from handavatar.fit.shape import ShapeSpace, fixed_shape
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import SurfacePoints, vertex_normals
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import ShapedHand
from handavatar.render.silhouette import outline_points

VIDEO_TEXTURE_SHARE = 2.0
"""Weight of details in frames of a video: what tracked poses are off by lasts from frame to frame
there, and the texture knows better. Of poses with noise that is new in every frame it is not sharp
enough to be told so much."""
_LEAST_TRUST = 0.5
"""Views from the front by which a point's texture is known."""


@dataclass(frozen=True)
class EnergyOptions:
    """What observations are expected to be off by. Pixels are those of a picture 256 wide."""

    outline_error: float = 0.5
    """Pixels between the outlines of mesh and mask in a good fit."""
    outline_outlier: float = 1.5
    """Pixels beyond which something else than the pose is at fault; begins eight times as wide."""
    outline_points: float = 90.0
    """Independent points of an outline, each way."""
    turn_cost: float = 8.0
    """Pixels that a point of the mask's outline goes rather than turn its normal by a radian."""
    texture_outlier: float = 3.5
    """Standard deviations beyond which a detail has other causes: a shadow's edge, a fold."""
    texture_share: float = 0.1
    """Weight of the details that a picture of the hand has room for, each of a blurred pixel."""
    contact_error: float = 3e-3
    """Metres that a hand sinks into itself, beyond what flesh gives; infinite lets it pass."""
    landmark_outlier: float = 8.0
    """Standard deviations beyond which a landmark is misplaced: where a finger lies on the palm
    the outline says nothing, and would be let to have its way."""
    skin_share: float = 0.3
    """Weight of a point of the skin that a tracker sees: neighbours err together."""
    depth_share: float = 0.5
    """Weight of a landmark's depth."""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            outline_error=(1e-3, 1e3),
            outline_outlier=(1e-3, 1e3),
            outline_points=(0, 1e6),
            turn_cost=(0, 1e4),
            texture_outlier=(1e-3, math.inf),
            texture_share=(0, 1e3),
            contact_error=(1e-6, math.inf),
            landmark_outlier=(1e-3, math.inf),
            skin_share=(0, 1e3),
            depth_share=(0, 1e3),
        )


@dataclass(frozen=True, eq=False)
class Observation:
    """All that one frame says of its hand.

    Attributes:
        picture: colours and outline.
        time: seconds.
        landmarks: of a tracker, if there is one.
    """

    picture: FramePicture
    time: float
    landmarks: LandmarkSightings | None = None


@dataclass(frozen=True, eq=False)
class Linearised:
    """A frame's energy at one place, and its slope.

    Attributes:
        hessian: Gauss and Newton's, of 51 unknowns of the pose and then the shared ones.
        gradient: half of the energy's.
        energy: of the outlines, the texture and the landmarks.
    """

    hessian: Float[Tensor, "unknowns unknowns"]
    gradient: Float[Tensor, "unknowns"]
    energy: float


@dataclass(frozen=True, eq=False)
class HandPoints:
    """The hand to lay onto pictures: its shape, and points of it to compare.

    Attributes:
        hand: rest hand.
        space: shared unknowns of its shape.
        surface: points whose texture is compared.
        balls: that fill it.
        landmarks: what a tracker's landmarks are on the rest hand; no points without a tracker.
            Their directions are those of the shape and then of each landmark's own offset.
    """

    hand: ShapedHand
    space: ShapeSpace
    surface: SurfacePoints
    balls: Balls
    landmarks: RestPoints

    @property
    def num_shared(self) -> int:
        """Unknowns that all frames share: of the shape, and of the landmarks' offsets."""
        return max(self.space.directions.shape[-1], self.landmarks.directions.shape[-1])

    def with_shared_fixed(self) -> "HandPoints":
        """The same hand without shared unknowns: a pose alone costs a tenth of all together."""
        landmarks = replace(self.landmarks, directions=self.landmarks.directions[..., :0])
        return replace(self, space=fixed_shape(self.hand.rig), landmarks=landmarks)


def linearise_frame(
    points: HandPoints,
    pose: HandPose,
    seen: Observation,
    band: PictureBand,
    texture: SkinTexture | None,
    texture_error: float,
    sigma: float,
    outlier: float,
    options: EnergyOptions,
) -> Linearised:
    """What outlines, texture and landmarks of one frame say.

    Args:
        points: the hand.
        pose: where.
        seen: of the frame.
        band: of the frame's picture.
        texture: of the surface's points; None leaves it out.
        texture_error: expected, of one channel.
        sigma: of the band's blur, pixels.
        outlier: pixels (of 256) at which an outline loses its pull.
        options: expected errors.
    """
    hand = rest_with_pose(points.hand, pose)
    skeleton = Skeleton.of(hand, pose, points.space.joint_directions)
    vertices = skeleton.positions(
        RestPoints(
            hand.rest_vertices, hand.rig.skin_weights, hand.rest_vertices[..., None][..., :0]
        )
    )
    total = _Sum(NUM_UNKNOWNS + points.num_shared)
    if options.outline_points > 0:
        _add_outlines(total, points, hand, skeleton, vertices, seen, band, outlier, options)
    if texture is not None:
        _add_texture(
            total,
            points,
            hand,
            skeleton,
            vertices,
            seen.picture,
            band,
            texture,
            texture_error,
            sigma,
            options,
        )
    if math.isfinite(options.contact_error):
        _add_contact(total, points, hand, skeleton, options)
    if seen.landmarks is not None:
        _add_landmarks(
            total, points.landmarks, skeleton, seen.picture.camera, seen.landmarks, options
        )
    return Linearised(total.hessian, total.gradient, total.energy)


def linearise_landmarks(
    rest: RestPoints,
    hand: ShapedHand,
    pose: HandPose,
    camera: Camera,
    landmarks: LandmarkSightings,
    options: EnergyOptions,
) -> Linearised:
    """What a tracker's landmarks alone say of one pose; the hand's shape is held still.

    Args:
        rest: what the landmarks are on the rest hand; without directions.
        hand: the rest hand.
        pose: where.
        camera: of the picture.
        landmarks: seen in it.
        options: expected errors.
    """
    still = hand.rest_joints.new_zeros(*hand.rest_joints.shape, 0)
    total = _Sum(NUM_UNKNOWNS)
    _add_landmarks(total, rest, Skeleton.of(hand, pose, still), camera, landmarks, options)
    return Linearised(total.hessian, total.gradient, total.energy)


class _Sum:
    """Adds up terms."""

    def __init__(self, size: int) -> None:
        self.hessian = torch.zeros(size, size)
        self.gradient = torch.zeros(size)
        self.energy = 0.0

    def add(
        self,
        residuals: Float[Tensor, "residuals"],
        jacobian: Float[Tensor, "residuals unknowns"],
        weights: Float[Tensor, "residuals"],
        outlier: float,
        distances: Float[Tensor, "residuals"] | None = None,
    ) -> None:
        """Geman and McClure's robust sum.

        Args:
            residuals: in standard deviations.
            jacobian: of the residuals.
            weights: of each.
            outlier: standard deviations.
            distances: what tells outliers, in standard deviations; the residuals if None.
        """
        squared = (residuals if distances is None else distances).square() / outlier**2
        trust = weights / (1 + squared).square()
        self.energy += float((weights * residuals.square() / (1 + squared)).sum())
        weighted = jacobian * trust[:, None]
        width = jacobian.shape[1]
        self.hessian[:width, :width] += jacobian.T @ weighted
        self.gradient[:width] += weighted.T @ residuals


def _add_outlines(
    total: _Sum,
    points: HandPoints,
    hand: ShapedHand,
    skeleton: Skeleton,
    vertices: Float[Tensor, "vertices 3"],
    seen: Observation,
    band: PictureBand,
    outlier: float,
    options: EnergyOptions,
) -> None:
    """The mesh's outline lies on the mask's, and the mask's on the mesh's."""
    picture = seen.picture
    camera = picture.camera
    unit = camera.width / 256 * options.outline_error
    far = outlier / options.outline_error
    outline = outline_points(vertices, hand.rig.faces, drawing_camera(camera))
    if len(outline.ends) == 0:
        return
    rest = RestPoints.between(outline.of, hand, points.space.directions)
    positions = skeleton.positions(rest)
    pixels, _, moving = pixel_jacobian(camera, positions)
    values, slopes = band.sample(pixels)
    is_known = picture.sees_outline(pixels)
    moving = moving @ skeleton.jacobian(rest)
    weights = outline.lengths * is_known
    weights = weights * (options.outline_points / outline.lengths.sum())
    jacobian = (slopes[:, 3, None] @ moving)[:, 0]
    total.add(values[:, 3] / unit, jacobian / unit, weights, far)

    border, normals = picture.border, picture.border_normals
    if len(border) == 0:
        return
    facing = outline.of(vertex_normals(vertices, hand.rig.faces))
    facing = normalize((facing @ camera.camera_from_world[:3, :3].T)[:, :2], dim=-1)
    turn = options.turn_cost * camera.width / 256
    tree = cKDTree(torch.cat([pixels, turn * facing], dim=1).numpy())
    _, nearest = tree.query(torch.cat([border, turn * normals], dim=1).numpy())
    nearest = torch.from_numpy(nearest)
    apart = pixels[nearest] - border
    across = (apart * normals).sum(-1)
    jacobian = (normals[:, None] @ moving[nearest])[:, 0]
    weights = torch.full((len(border),), options.outline_points / len(border))
    total.add(across / unit, jacobian / unit, weights, far, apart.norm(dim=-1) / unit)


def surface_rest(
    points: HandPoints, hand: ShapedHand, index: Int[Tensor, "selected"]
) -> RestPoints:
    """Some points of the surface, at rest."""
    chosen = points.surface.chosen(index)
    return RestPoints.between(chosen.positions, hand, points.space.directions)


def _add_texture(
    total: _Sum,
    points: HandPoints,
    hand: ShapedHand,
    skeleton: Skeleton,
    vertices: Float[Tensor, "vertices 3"],
    picture: FramePicture,
    band: PictureBand,
    texture: SkinTexture,
    texture_error: float,
    sigma: float,
    options: EnergyOptions,
) -> None:
    """Visible points that face the camera, inside the mask, show what they show in others."""
    camera = picture.camera
    found = look_up_points(hand.rig, vertices, points.surface, picture, band)
    index = (found.is_compared & (texture.trust > _LEAST_TRUST)).nonzero()[:, 0]
    if len(index) < 10:
        return
    residuals = (found.values[index] - texture.values[index]) / texture_error
    rest = surface_rest(points, hand, index)
    _, _, moving = pixel_jacobian(camera, skeleton.positions(rest))
    moving = moving @ skeleton.jacobian(rest)
    jacobian = (found.slopes[index] @ moving / texture_error).flatten(0, 1)
    blur_area = 4 * math.pi * (sigma**2 + 0.5)
    count = options.texture_share * float(picture.hand.sum()) / blur_area
    weights = found.seen.facing[index]
    weights = weights * (count / weights.sum())
    distance = residuals.norm(dim=-1, keepdim=True).expand(-1, 3)
    total.add(
        residuals.flatten(),
        jacobian,
        weights[:, None].expand(-1, 3).flatten(),
        options.texture_outlier,
        distance.flatten(),
    )


def _add_contact(
    total: _Sum,
    points: HandPoints,
    hand: ShapedHand,
    skeleton: Skeleton,
    options: EnergyOptions,
) -> None:
    """The hand does not sink into itself."""
    depths, jacobian = overlaps(points.balls, hand, points.space, skeleton)
    error = options.contact_error
    total.add(depths / error, jacobian / error, torch.ones_like(depths), math.inf)


def _add_landmarks(
    total: _Sum,
    rest: RestPoints,
    skeleton: Skeleton,
    camera: Camera,
    landmarks: LandmarkSightings,
    options: EnergyOptions,
) -> None:
    """A tracker's landmarks, in the picture and in depth."""
    skeleton = skeleton.padded(rest.directions.shape[-1])
    positions = skeleton.positions(rest)
    pixels, depths, moving = pixel_jacobian(camera, positions)
    jacobian = skeleton.jacobian(rest)
    focal, center = pixels.new_tensor(camera.focal), pixels.new_tensor(camera.center)
    errors = landmarks.errors[:, None] * focal
    in_picture = (moving @ jacobian) / errors[..., None]
    apart = (pixels - landmarks.directions * focal - center) / errors
    distance = apart.norm(dim=-1, keepdim=True).expand(-1, 2)
    shares = torch.ones(len(apart))
    shares[NUM_LANDMARKS:] = options.skin_share
    total.add(
        apart.flatten(),
        in_picture.flatten(0, 1),
        shares[:, None].expand(-1, 2).flatten(),
        options.landmark_outlier,
        distance.flatten(),
    )
    sight = camera.camera_from_world[2, :3]
    along = (sight @ jacobian).reshape(len(depths), -1)
    # About their mean, in which a point counts for what it knows.
    known = shares / landmarks.depth_errors.square()
    known = known / known.sum()
    along = (along - known @ along) / landmarks.depth_errors[:, None]
    seen_depths = landmarks.depths - known @ landmarks.depths
    depths = (depths - known @ depths - seen_depths) / landmarks.depth_errors
    total.add(depths, along, options.depth_share * shares, options.landmark_outlier)
