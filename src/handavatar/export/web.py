"""One page that shows an avatar in any browser with WebGL2, from disk or from any server.

The page is one file: its content policy names the hash of every script and style in it and allows
nothing else, so nothing is loaded and nothing can be injected. A policy by hashes also holds for
files opened from disk, where browsers disagree on what a page's own origin is.
"""

import json
import re
from base64 import b64encode
from hashlib import sha256
from importlib import resources
from typing import Any

import torch

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import MORE_GESTURES, Motion, gesture, middle_of_hand
from handavatar.capture.view import camera_holding, start_of
from handavatar.edit import Edit
from handavatar.errors import HandAvatarError
from handavatar.export.capsules import REACH
from handavatar.export.lightweight import LightweightHand
from handavatar.export.packing import Packed, packed_bytes, quantised
from handavatar.export.skeletons import skeleton_of
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import GESTURES, joint_angles

SCRIPTS = ("hand.js", "picture.js", "headset.js", "page.js")
LARGEST = 2_000_000
"""Bytes that a page may have."""
_HELD = ("spread", "flat", "fist")
"""Gestures that the camera holds, besides the first pose."""


def web_files(
    avatar: HandAvatar, light: LightweightHand, edit: Edit, motion: Motion | None = None
) -> dict[str, bytes]:
    """The files of a folder that shows an avatar.

    Args:
        avatar: on the CPU; its own edit is where the page begins.
        light: fitted to it.
        edit: on top of that.
        motion: that the page plays.

    Returns:
        ``index.html``, which is all that is needed, and ``loss.json``, what the page loses.

    Raises:
        ValueError: if the page is larger than ``LARGEST``.
    """
    arrays = light.arrays()
    if motion is not None:
        arrays["motion_rotations"] = quantised(motion.rotations, "i2")
        arrays["motion_translations"] = Packed(motion.translations.numpy())
    index, content = packed_bytes(arrays)
    about = facts(avatar, light, edit, motion) | {"arrays": index}
    page = page_bytes(about, content)
    if len(page) > LARGEST:
        raise HandAvatarError(
            f"the page has {len(page)} bytes, at most {LARGEST} are allowed: "
            "leave out `motion`, or train on a coarser rig"
        )
    figures = {name: round(value, 4) for name, value in light.loss.items()}
    loss = json.dumps(figures | {"bytes": len(page)}, indent=2) + "\n"
    return {"index.html": page, "loss.json": loss.encode()}


def page_bytes(about: dict[str, Any], content: bytes) -> bytes:
    """The page with its facts and arrays in it."""
    texts = {name: _text(name) for name in ("index.html", "page.css", *SCRIPTS)}
    hashes = " ".join(_hash(texts[name]) for name in SCRIPTS)
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src {_hash(texts['page.css'])}; "
        "img-src data:; base-uri 'none'; form-action 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    )
    parts = {
        "policy": policy,
        "style": texts["page.css"],
        # A closing tag inside would end the block.
        "about": json.dumps(about, allow_nan=False).replace("<", "\\u003c"),
        "arrays": b64encode(content).decode(),
        "scripts": "\n  ".join(f"<script>{texts[name]}</script>" for name in SCRIPTS),
    }
    page = re.sub(r"\{(\w+)\}", lambda found: parts[found[1]], texts["index.html"])
    return page.encode()


def facts(
    avatar: HandAvatar, light: LightweightHand, edit: Edit, motion: Motion | None
) -> dict[str, Any]:
    """What the page knows besides arrays; lengths in metres, angles of gestures in degrees."""
    info = avatar.info
    start, side = start_of(avatar.view(edit)), str(info.get("side", "right"))
    joint = light.correctives.joints[0]
    known = {**GESTURES, **MORE_GESTURES}
    whole = avatar.edit.then(edit)
    skeleton = skeleton_of(light.hand, "webxr", side)
    turns = skeleton.file_from_joint[list(skeleton.carriers), :3, :3]
    view = _camera(avatar, light, start, edit)
    named = [str(info[name]) for name in ("subject", "method", "licence") if name in info]
    if avatar.base_rig.is_licensed:
        named.append("mesh and weights derive from a licensed rig")
    return {
        "title": f"HandAvatar: {info['subject']}" if "subject" in info else "HandAvatar",
        "facts": " · ".join(named),
        "side": side,
        "rounds": avatar.rounds,
        "reach": REACH,
        "fingers": {finger: list(bones) for finger, bones in FINGER_BONES.items()},
        "joints": [vars(angle) for angle in joint_angles()],
        "gestures": {
            name: [[round(v, 3) for v in row] for row in made.angles().rad2deg().tolist()]
            for name, made in known.items()
        },
        "joint": joint.tolist(),
        "start": {
            "rotations": start.rotations.tolist(),
            "wrist": (joint + start.translation).tolist(),
        },
        # From the wrist to the middle of the palm, about which the hand turns.
        "palm": (light.correctives.joints[4] - joint).tolist(),
        "camera": view,
        "edit": {
            "light_gain": whole.light_gain,
            "albedo_shift": list(whole.albedo_shift),
            "lifted_bones": sorted(whole.lifted_bones),
        },
        "motion": None if motion is None else {"fps": motion.fps, "steps": len(motion)},
        "xr": {
            "names": [skeleton.names[joint] for joint in skeleton.carriers],
            "rest": turns.flatten(1).tolist(),
            "turn": skeleton.file_from_rest[:3, :3].flatten().tolist(),
        },
    }


def _camera(
    avatar: HandAvatar, light: LightweightHand, start: HandPose, edit: Edit
) -> dict[str, Any]:
    """Where the page's camera begins, with focal length and centre in sides of the picture."""
    poses = [start.rotations]
    for name in _HELD:
        fingers = gesture(avatar.base_rig, name)[1:]
        poses.append(torch.cat([start.rotations[:1], fingers]))
    held = light.hand.posed(HandPose(torch.stack(poses), start.translation.expand(len(poses), 3)))
    middle = middle_of_hand(avatar.base_rig, start)
    camera = camera_holding(avatar.view(edit), held.vertices.flatten(0, 1), middle, 1)
    pose = camera.camera_from_world
    return {
        "turn": pose[:3, :3].flatten().tolist(),
        "shift": pose[:3, 3].tolist(),
        "focal": list(camera.focal),
        "center": list(camera.center),
    }


def _text(name: str) -> str:
    return (resources.files("handavatar.export") / "page" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"
