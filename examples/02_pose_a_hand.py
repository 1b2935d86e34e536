"""Pose a hand: gestures by name, joint angles of your own, and several cameras.

Needs an avatar; 01_first_avatar.py makes one.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from handavatar.animate import camera_on, orbited, pass_pictures, posed_as_seen
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import Motion, middle_of_hand, write_motion
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, NUM_BONES
from handavatar.hand.pose_sampling import clamped_angles, rotations_from_angles


# %% Options
@dataclass(frozen=True)
class Options:
    """Pose a hand.

    Attributes:
        avatar: folder of a run, or an avatar file.
        out: folder for the pictures.
        size: pixels along a side of each picture.
    """

    avatar: Path = Path("examples-out/run")
    out: Path = Path("examples-out")
    size: int = 160


options = tyro.cli(Options)
if not options.avatar.exists():
    sys.exit(f"{options.avatar} is missing: run 01_first_avatar.py, or name one with --avatar")
options.out.mkdir(parents=True, exist_ok=True)

# %% Poses
avatar = HandAvatar.load(options.avatar)
rig = avatar.base_rig

# A pose is one rotation for each of sixteen bones, and where the wrist is. Nobody thinks in
# axis-angles, so say it in the angles of a hand: flexion (into the palm), abduction (towards the
# thumb) and twist. What no joint can do is clamped to what it can.
degrees = torch.zeros(NUM_BONES, 3)
degrees[list(FINGER_BONES["ring"]), 0] = 70.0
degrees[list(FINGER_BONES["little"]), 0] = 70.0
degrees[BONE_NAMES.index("index1"), 1] = 200.0  # An index finger spreads by 16 degrees at most.
own = rotations_from_angles(rig, clamped_angles(degrees.deg2rad()))

# An avatar has learned its light as well. It looks right where its capture has seen the hand, so
# take the wrist from there. Gestures have names.
gestures = ("spread", "relaxed", "victory")
poses = [posed_as_seen(avatar, name) for name in gestures] + [posed_as_seen(avatar, own)]

# %% Cameras
# One that holds the hand in all the poses, and the same one carried around the hand. From the side
# a hand may reach farther than from the front: the view leaves room all around.
front = camera_on(avatar, poses, options.size, room=0.44)
middle = middle_of_hand(rig, poses[0])
cameras = [orbited(front, middle, math.radians(turn)) for turn in (-50, 0, 50)]

rows = []
for pose in poses:
    views = avatar.render_batch([pose] * len(cameras), cameras)
    side = avatar.info.get("side", "right")
    rows.append(np.concatenate([pass_pictures(view, side)["rgb"] for view in views], axis=1))
sheet = np.concatenate(rows, axis=0)
Image.fromarray(sheet).save(options.out / "poses.png")
print(f"{options.out / 'poses.png'}: {', '.join(gestures)} and our own, each from three sides")

# %% A motion
# Poses in a row are a motion; the command line renders it to a video:
# handavatar render examples-out/run --motion examples-out/poses.json --out examples-out/video
rotations = torch.stack([pose.rotations for pose in poses])
translations = torch.stack([pose.translation for pose in poses])
write_motion(options.out / "poses.json", Motion(2.0, rotations, translations))
print(f"{options.out / 'poses.json'}: the poses as a motion, two a second")
