"""Edit an avatar: its light, the colour of its skin, paint, and the shadow of a finger.

Needs an avatar; 01_first_avatar.py makes one. Nothing is trained again: an edit is a value.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from handavatar.animate import camera_on, pass_pictures, posed_as_seen
from handavatar.avatar import HandAvatar
from handavatar.edit import Edit, Paint, bones_named
from handavatar.hand.pose import FINGER_BONES


# %% Options
@dataclass(frozen=True)
class Options:
    """Edit an avatar.

    Attributes:
        avatar: folder of a run, or an avatar file; it stays as it is.
        out: folder for a picture and the edited avatar.
        size: pixels along a side of each picture.
    """

    avatar: Path = Path("examples-out/run")
    out: Path = Path("examples-out")
    size: int = 192


options = tyro.cli(Options)
if not options.avatar.exists():
    sys.exit(f"{options.avatar} is missing: run 01_first_avatar.py, or name one with --avatar")
options.out.mkdir(parents=True, exist_ok=True)

# %% Edits
avatar = HandAvatar.load(options.avatar)

# Paint is a colour and an opacity for each anchor, a point fixed on the skin. Here every anchor of
# the index finger: whatever is known of the mesh's vertices, such as which bone moves them, is
# known of the anchors too. A picture in the texture chart is another way: retouch.paint_from.
shares = avatar.anchors.positions(avatar.rig.skin_weights)
opacity = shares[:, list(FINGER_BONES["index"])].sum(-1).gt(0.5).float()
green = torch.tensor([0.1, 0.55, 0.25]).expand(len(opacity), 3)

edits = {
    "as it is": Edit(),
    "brighter": Edit(light_gain=1.4),
    "cooler skin": Edit(albedo_shift=(-0.05, 0.05, 0.2)),
    "painted": Edit(paint=Paint(green, opacity)),
    "no thumb shadow": Edit(lifted_bones=bones_named(("thumb",))),
}

# %% Before and after
# A thumb before the palm, so that there is a shadow to lift. An avatar of method "quick" guesses
# its shadows from what the view ray passes: what is left without them may even be darker. "best"
# traces light to the hand instead.
pose = posed_as_seen(avatar, "four")
camera = camera_on(avatar, [pose], options.size)

side = avatar.info.get("side", "right")
pictures = {
    name: pass_pictures(avatar.render(pose, camera, edit), side)["rgb"]
    for name, edit in edits.items()
}
sheet = np.concatenate(list(pictures.values()), axis=1)
Image.fromarray(sheet).save(options.out / "edits.png")
print(f"{options.out / 'edits.png'}: {', '.join(edits)}")

# %% Keep an edit
# Edits follow each other, and what an avatar has as its own is saved with it: whatever renders or
# exports the file shows it.
avatar.edit = avatar.edit.then(edits["cooler skin"]).then(edits["painted"])
avatar.save(options.out / "edited.safetensors")
print(f"{options.out / 'edited.safetensors'}: cooler skin and paint")
