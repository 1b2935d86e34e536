"""The pose of an avatar in one picture, from a pose that is nearly right."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from handavatar.avatar import HandAvatar
from handavatar.capture.arrays import Array, coverage_from_array, image_from_array
from handavatar.capture.frames import FITTED_SIDE, Frame
from handavatar.capture.guided_masks import pixels_before_wrist
from handavatar.capture.registration import poses_of, register_frames
from handavatar.capture.windows import resized
from handavatar.errors import ArgumentError, require_range
from handavatar.evaluate.registered import fitted_hand, registered_pose
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.rotations import apply_rigid
from handavatar.geometry.tensors import require_type
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import ShapedHand

_CENTIMETRE = 0.01
_WRIST_MARGIN = 0.015
"""Metres before the avatar's end from where on the mask is believed."""
_ROOM = 1.25
"""Side of what is looked at, in units of the hand's."""


@torch.no_grad()
def fit_pose(
    avatar: HandAvatar,
    image: Array,
    mask: Array,
    camera: Camera,
    start: HandPose,
    known: Array | None = None,
    *,
    pose_error: float = 10.0,
    uses_texture: bool = True,
    light: int = 0,
) -> HandPose:
    """The pose in which the avatar agrees best with a picture: its outline, and then its texture.

    The avatar stays as it is. What neither outline nor texture tells stays near ``start``. Second
    derivatives decide each step, no gradient descent: some ten steps, a second or a few. For a loss
    of your own, :meth:`handavatar.avatar.HandAvatar.silhouette` carries gradient.

    Args:
        avatar: whose hand it is.
        image: height width 3, sRGB; levels of 8 bits, or floats in [0, 1].
        mask: height width, what of each pixel the hand covers: booleans, floats in [0, 1] or levels
            of 8 bits. Whether it goes on along the forearm plays no part.
        camera: of the picture.
        start: a pose that is nearly right; a tracker's, or the last picture's.
        known: height width, booleans; false where neither hand nor background can be told.
        pose_error: degrees by which joints of ``start`` may be off; per ten of them the hand may be
            a centimetre off.
        uses_texture: whether the colours of the avatar, as it is rendered, have a say at last.
        light: of an avatar of several recordings, number of the one whose light the picture has.

    Raises:
        ArgumentError: an argument is of another kind, size or range; it is named. So is the mask if
            it is empty.
    """
    for name, value, kind in (
        ("avatar", avatar, HandAvatar),
        ("camera", camera, Camera),
        ("start", start, HandPose),
    ):
        require_type(name, value, kind)
    require_range("pose_error", pose_error, 0.01, 180)
    coverage = coverage_from_array("mask", mask)
    is_known = torch.ones_like(coverage, dtype=torch.bool)
    frame = Frame(
        name="picture",
        image=image_from_array("image", image),
        coverage=coverage,
        camera=camera.to("cpu"),
        pose=start.to("cpu"),
        confidence=0.5,
        split="test",
        time=0.0,
        covariance=_covariance(pose_error),
        known=is_known if known is None else coverage_from_array("known", known) > 127,
        clip=light,
    )
    options = RegisterOptions(pose_error=pose_error, learns_pose_error=False, texture_sigmas=())
    if not bool(frame.mask.any()):
        raise ArgumentError("mask", "nothing of a hand", "some pixels of it that are known")
    hand = fitted_hand(avatar, frame.pose)
    frame = _around_hand(hand, frame)
    frame = replace(frame, known=frame.known & _before_wrist(hand, frame))
    (pose,) = poses_of(register_frames([hand], [frame], options, learns_shape=False))
    pose = pose.to(avatar.device)
    return registered_pose(avatar, frame, pose) if uses_texture else pose


def _around_hand(hand: ShapedHand, frame: Frame) -> Frame:
    """The part of a frame that holds the mask, and the hand to begin with, in the fit's size."""
    places, _ = project(frame.camera, hand.posed(frame.pose).vertices)
    seen = frame.mask.nonzero().flip(-1)
    low, high = (torch.stack([seen.amin(0), seen.amax(0) + 1])).float()
    inside = places.isfinite().all(-1)
    # A pose that is far beside the mask does not make the hand small in what is looked at.
    reach = high - low
    first = torch.maximum(torch.minimum(low, places[inside].amin(0)), low - reach)
    last = torch.minimum(torch.maximum(high, places[inside].amax(0)), high + reach)
    side = math.ceil(_ROOM * float((last - first).max()))
    left, top = ((first + last - side) / 2).floor().int().tolist()
    camera = frame.camera
    around = (-left, left + side - camera.width, -top, top + side - camera.height)

    def cut(values: Float[Tensor, "height width channels"]) -> Float[Tensor, "side side channels"]:
        return resized(pad(values.permute(2, 0, 1), around).permute(1, 2, 0), FITTED_SIDE)

    return replace(
        frame,
        image=cut(frame.image.float()).round().to(torch.uint8),
        coverage=cut(frame.coverage[..., None].float())[..., 0].round().to(torch.uint8),
        known=cut(frame.known[..., None].float())[..., 0] > 0.999,
        camera=camera.cropped(*map(float, (left, top, side, side))).resized(
            FITTED_SIDE, FITTED_SIDE
        ),
    )


def _before_wrist(hand: ShapedHand, frame: Frame) -> Bool[Tensor, "height width"]:
    """Pixels on the hand's side of where the avatar ends, in the pose to begin with."""
    vertices = apply_rigid(frame.camera.camera_from_world, hand.posed(frame.pose).vertices)
    camera = replace(frame.camera, camera_from_world=torch.eye(4))
    return torch.from_numpy(pixels_before_wrist(camera, hand.rig, vertices, _WRIST_MARGIN))


def _covariance(pose_error: float) -> Float[Tensor, "51 51"]:
    radians = torch.full((48,), torch.pi / 180 * pose_error / 3**0.5)
    metres = torch.full((3,), _CENTIMETRE * pose_error / 10)
    return torch.diag(torch.cat([radians, metres]).square())
