"""Take an avatar away: a rigged GLB for engines, a posed PLY, and where the joints are.

Needs an avatar; 01_first_avatar.py makes one.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import gesture
from handavatar.export.run import ExportOptions, export_avatar
from handavatar.hand.pose import BONE_NAMES, HandPose


# %% Options
@dataclass(frozen=True)
class Options:
    """Take an avatar away.

    Attributes:
        avatar: folder of a run, or an avatar file.
        out: folder for the files.
        texture_size: texels along a side of the GLB's colours.
    """

    avatar: Path = Path("examples-out/run")
    out: Path = Path("examples-out")
    texture_size: int = 1024


options = tyro.cli(Options)
if not options.avatar.exists():
    sys.exit(f"{options.avatar} is missing: run 01_first_avatar.py, or name one with --avatar")

# %% For engines
# A GLB has bones, skin weights and textures, and here a motion as well. The names of the bones are
# what the engine looks for: "webxr" for three.js, or "unity", "vrm", "mano".
glb = export_avatar(
    ExportOptions(
        run=options.avatar,
        format="glb",
        out=options.out / "hand.glb",
        bones="webxr",
        texture_size=options.texture_size,
        motion="pinch",
        overwrite=True,
    )
)
print(f"{glb}: rigged and textured, with the motion pinch")

# %% For mesh programs
# A PLY is the surface in one pose, with a colour for each vertex.
ply = export_avatar(
    ExportOptions(options.avatar, "ply", options.out / "fist.ply", pose="fist", overwrite=True)
)
print(f"{ply}: a fist, its wrist at the origin")

# %% For your own program
# Without any file: the personal hand in a pose has its vertices and joints as tensors, in metres.
avatar = HandAvatar.load(options.avatar)
pose = HandPose(gesture(avatar.base_rig, "fist"), torch.zeros(3))
with torch.no_grad():
    hand = avatar.personal(pose).posed(pose)
joints = dict(zip(BONE_NAMES, hand.joints.tolist(), strict=True))
(options.out / "joints.json").write_text(json.dumps(joints, indent=1) + "\n", encoding="utf-8")
reach = (hand.vertices - hand.joints[0]).norm(dim=-1).max()
print(f"{options.out / 'joints.json'}: {len(joints)} joints of the same fist, metres")
print(f"from the wrist the fist reaches {100 * reach:.1f} cm")
