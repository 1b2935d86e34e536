"""What an avatar has to beat on its own frames: one flat colour, and a textured mesh."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture.frame_sequence import spread_numbers
from handavatar.capture.frames import FITTED_SIDE, Capture, Frame
from handavatar.evaluate.metrics import JudgedFrame, exposed, masked_psnr, mean_color
from handavatar.evaluate.textured_mesh import fit_textured_mesh
from handavatar.hand.pose import HandPose

MESH_FRAMES, MESH_STEPS = 30, 300
"""The textured mesh sees at most so many training frames, evenly spread; so many steps."""


def training_color(capture: Capture) -> Float[Tensor, "3"] | None:
    """Mean colour of the training frames' hand pixels, without their gain; None without frames."""
    frames = [capture.frame(index).binned(FITTED_SIDE) for index in capture.split("train")]
    frames = [frame for frame in frames if bool(frame.mask.any())]
    if not frames:
        return None
    return mean_color((frame.colors, frame.mask) for frame in frames)


def textured_mesh_psnr(
    avatar: HandAvatar,
    capture: Capture,
    color: Float[Tensor, "3"],
    frames: Sequence[Frame],
    poses: Sequence[HandPose],
    poses_of: Callable[[list[Frame]], list[HandPose]],
) -> float:
    """Masked PSNR of a textured mesh of the avatar's shape, fitted to the training frames.

    Args:
        avatar: its personal mesh and nothing else.
        capture: of the training frames.
        color: :func:`training_color`.
        frames: to be judged.
        poses: of these.
        poses_of: the poses of training frames.

    Returns:
        Decibels, mean over the frames.
    """
    indices = capture.split("train")
    places = spread_numbers(len(indices), MESH_FRAMES)
    # As large as what is judged.
    side = max(frames[0].camera.width, frames[0].camera.height)
    training = [capture.frame(indices[place]).binned(side) for place in places]
    found = zip(training, poses_of(training), strict=True)
    training = [replace(frame, pose=pose) for frame, pose in found]
    picture_of = fit_textured_mesh(avatar, training, color, MESH_STEPS, seed=0, rays=1)
    ratios = []
    for frame, pose in zip(frames, poses, strict=True):
        values = picture_of(replace(frame, pose=pose))
        judged = judged_frame(frame, values[..., :3], values[..., 3])
        ratios.append(masked_psnr(judged))
    return sum(ratios) / len(ratios)


def judged_frame(
    frame: Frame, color: Float[Tensor, "height width 3"], alpha: Float[Tensor, "height width"]
) -> JudgedFrame:
    """A picture beside its frame: exposed as the frame is, and judged where the frame is known.

    Args:
        frame: with its gain and what is known of it.
        color: rendered on black, sRGB.
        alpha: how much of each pixel the rendered hand covers.
    """
    return JudgedFrame(
        exposed(color, frame.gain),
        alpha > 0.5,
        frame.image.float() / 255,
        frame.alpha,
        frame.known,
    )
