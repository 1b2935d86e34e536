"""A first avatar, from the capture that ships: train it, then look at a pose it never saw.

The whole training takes minutes on two cores. Fewer ``--steps`` are for a look at the road: the
shape is fitted before the first step, so the hand stands there early, and its colours come later.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from handavatar.animate import pass_pictures
from handavatar.avatar import HandAvatar
from handavatar.capture.default import default_capture
from handavatar.capture.frames import read_capture
from handavatar.evaluate.metrics import psnr
from handavatar.train.loop import TrainOptions, train


# %% Options
@dataclass(frozen=True)
class Options:
    """A first avatar.

    Attributes:
        capture: folder of a capture, such as `handavatar capture video` makes of your own video.
        out: folder for the avatar and a picture.
        steps: of training; by default the whole method.
    """

    capture: Path = default_capture().folder
    out: Path = Path("examples-out")
    steps: int | None = None


options = tyro.cli(Options)

# %% Train
# A capture is a folder of pictures with masks, each with its camera and the pose of the hand.
# Training leaves a run: checkpoints, a log, and avatar.safetensors, the one file that matters. Told
# again, an interrupted run continues, and a finished one is left as it is.
run = train(TrainOptions(options.capture, out=options.out / "run", steps=options.steps))
avatar = HandAvatar.load(run)

# %% Look
# Frames of split "test" were kept from training; of each we know what should be seen.
capture = read_capture(options.capture)
frame = capture.frame(capture.split("test")[0])
rendering = avatar.render(frame.pose, frame.camera)

# Truth and avatar side by side, then the parts that the avatar multiplies: albedo is the colour of
# the skin in full light, illumination is how much light arrives. A left hand is stored mirrored;
# pass_pictures mirrors it back.
passes = pass_pictures(rendering, capture.side)
truth = (frame.image * frame.mask[..., None]).numpy()
truth = truth[:, ::-1] if capture.side == "left" else truth
sheet = np.concatenate([truth, passes["rgb"], passes["albedo"], passes["illumination"]], axis=1)
Image.fromarray(sheet).save(options.out / "first_avatar.png")

on_hand = psnr(rendering.color[frame.mask], frame.image[frame.mask] / 255)
print(f"{run / 'avatar.safetensors'}: {on_hand:.1f} dB on the hand in a pose it never saw")
print(f"{options.out / 'first_avatar.png'}: truth, avatar, albedo, illumination")
