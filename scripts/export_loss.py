#!/usr/bin/env python3
"""What an export loses: its textured mesh in six poses of a motion, beside what the avatar renders.

    .venv/bin/python scripts/export_loss.py demo/avatar.safetensors [--size 192]

Prints PSNR (decibels, over pixels that both cover) of the albedo texture against the rendered
albedo, PSNR of the colours with baked light (``--unlit``) against the rendered colours, and the
IoU of the outlines: means over the poses.
"""

import argparse
import io
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from handavatar.animate import camera_on
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import named_motion
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.export.baking import baked_textures
from handavatar.export.surface import textured_hand
from handavatar.render.rasterize import rasterize

TEXELS = 1024
POSES = 6


def measure(path: Path, size: int) -> dict[str, float]:
    avatar = HandAvatar.load(path)
    hand = textured_hand(avatar)
    rig = hand.rig
    textures = {
        "albedo_psnr": baked_textures(avatar, hand, Edit(), TEXELS, has_occlusion=False),
        "unlit_psnr": baked_textures(avatar, hand, Edit(), TEXELS, has_light_baked=True),
    }
    pixels = {
        name: torch.from_numpy(np.array(Image.open(io.BytesIO(made.base_color)))) / 255
        for name, made in textures.items()
    }
    motion = named_motion(avatar.base_rig, "gestures", start_of(avatar.view()))
    poses = [motion.pose(step) for step in torch.linspace(0, len(motion) - 1, POSES).long()]
    camera = camera_on(avatar, poses, size)
    found: dict[str, list[float]] = {name: [] for name in (*textures, "outline_iou")}
    for pose in poses:
        rendered = avatar.render(pose, camera)
        fragments = rasterize(hand.posed(pose).vertices, rig.faces, camera)
        corners = rig.uv_coordinates[rig.uv_faces[fragments.face_index.clamp_min(0)]]
        places = (corners * fragments.barycentric[..., None]).sum(-2)
        column, row = (places * TEXELS).long().clamp(0, TEXELS - 1).unbind(-1)
        both = fragments.mask & (rendered.alpha > 0.99)
        truths = {"albedo_psnr": rendered.albedo, "unlit_psnr": rendered.color}
        for name, truth in truths.items():
            error = (pixels[name][row, column] - truth)[both].square().mean()
            found[name].append(float(-10 * error.log10()))
        is_hand = rendered.alpha > 0.5
        shared = (is_hand & fragments.mask).sum() / (is_hand | fragments.mask).sum()
        found["outline_iou"].append(float(shared))
    return {name: round(float(np.mean(values)), 3) for name, values in found.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--size", type=int, default=192, help="pixels along a side")
    arguments = parser.parse_args()
    print(json.dumps(measure(arguments.avatar, arguments.size), indent=2))
