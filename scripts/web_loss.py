#!/usr/bin/env python3
"""What an exported page loses: its own pictures in Chromium beside what the avatar renders.

    .venv/bin/python scripts/web_loss.py demo/avatar.safetensors FOLDER [--size 256] [--picture P]

FOLDER is what `handavatar export AVATAR web --out FOLDER` wrote. Ten novel poses: four random ones
that the export has not seen, where the capture's hand was; six steps of the motion `gestures`, two
of them from other sides; and of two of those once more with a lifted shadow. Prints for each, and
as means, the PSNR (decibels, whole picture on black) and that of the pixels which both cover, and
how fast the page is in this browser.
"""

import argparse
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import sync_playwright

from handavatar.animate import camera_on, orbited
from handavatar.avatar import HandAvatar
from handavatar.capture.motion import middle_of_hand, named_motion
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.geometry.cameras import Camera
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or ""
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
RANDOM, STEPS = 4, 6
SPEED = """(wish) => {
  const { hand, picture, shot } = window.handavatar;
  shot(wish);
  const rotations = wish.rotations.map(turnOf);
  const milliseconds = (count, act) => {
    const begin = performance.now();
    for (let at = 0; at < count; at += 1) act();
    // Reading ends what is still on its way.
    picture.gl.readPixels(0, 0, 1, 1, picture.gl.RGBA, picture.gl.UNSIGNED_BYTE, new Uint8Array(4));
    return (performance.now() - begin) / count;
  };
  const posed = hand.posed(rotations, wish.translation);
  return {
    pose_script_ms: milliseconds(50, () => hand.posed(rotations, wish.translation)),
    pose_shader_ms: milliseconds(50, () => picture.pose(posed, new Set())),
    picture_ms: milliseconds(20, () => shot(wish)),
  };
}"""


@dataclass(frozen=True)
class Shot:
    name: str
    pose: HandPose
    camera: Camera
    lifted: tuple[int, ...] = ()

    def wish(self) -> dict[str, Any]:
        """As the page takes it."""
        camera, placed = self.camera, self.camera.camera_from_world
        return {
            "rotations": self.pose.rotations.tolist(),
            "translation": self.pose.translation.tolist(),
            "size": camera.height,
            "lifted": list(self.lifted),
            "look": {},
            "camera": {
                "turn": placed[:3, :3].flatten().tolist(),
                "shift": placed[:3, 3].tolist(),
                "focal": [value / camera.height for value in camera.focal],
                "center": [value / camera.height for value in camera.center],
            },
        }


def shots(avatar: HandAvatar, size: int) -> list[Shot]:
    rig, start = avatar.base_rig, start_of(avatar.view())
    generator = torch.Generator().manual_seed(2026)
    fingers = resolve_penetration(rig, sample_poses(rig, RANDOM, generator))
    wrists = start.rotations[0] + 0.15 * torch.randn(RANDOM, 3, generator=generator)
    motion = named_motion(rig, "gestures", start)
    steps = [motion.pose(step) for step in torch.linspace(0, len(motion) - 1, STEPS).long()]
    random = [
        HandPose(torch.cat([wrist[None], turned[1:]]), start.translation)
        for wrist, turned in zip(wrists, fingers, strict=True)
    ]
    camera = camera_on(avatar, [*random, *steps], size)
    found = [Shot(f"random {number}", pose, camera) for number, pose in enumerate(random)]
    for number, pose in enumerate(steps):
        middle = middle_of_hand(rig, pose)
        view = {4: 0.6, 5: -0.6}.get(number)
        seen = camera if view is None else orbited(camera, middle, view)
        found.append(Shot(f"gestures {number}", pose, seen))
    for number, finger in ((2, "thumb"), (3, "index")):
        name = f"gestures {number}, no shadow of the {finger}"
        found.append(Shot(name, steps[number], camera, FINGER_BONES[finger]))
    return found


def measure(
    avatar: HandAvatar, folder: Path, size: int, picture: Path | None, is_speed_alone: bool
) -> dict[str, Any]:
    wanted = shots(avatar, size)
    with sync_playwright() as manager:
        browser = manager.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page()
        page.goto((folder / "index.html").resolve().as_uri())
        taken = []
        for shot in [] if is_speed_alone else wanted:
            values = page.evaluate("(wish) => Array.from(handavatar.shot(wish))", shot.wish())
            pixels = np.array(values, dtype=np.uint8).reshape(size, size, 4)[::-1, :, :3]
            taken.append(torch.from_numpy(pixels.copy()).float() / 255)
        speed = page.evaluate(SPEED, wanted[0].wish())
        browser.close()
    speed = {name: round(value, 2) for name, value in speed.items()}
    if is_speed_alone:
        return {"speed": speed, "load": os.getloadavg()[0]}
    rows: dict[str, dict[str, float]] = {}
    strips = []
    for shot, seen in zip(wanted, taken, strict=True):
        rendered = avatar.render(shot.pose, shot.camera, Edit(lifted_bones=shot.lifted))
        truth = rendered.color.clamp(0, 1)
        error = (seen - truth).square().mean(-1)
        both = (seen.sum(-1) > 0) & (rendered.alpha > 0.99)
        rows[shot.name] = {"psnr": _decibels(error), "inside_psnr": _decibels(error[both])}
        strips.append(torch.cat([truth, seen], 0))
        print(shot.name, json.dumps({name: round(v, 3) for name, v in rows[shot.name].items()}))
    if picture is not None:
        whole = (torch.cat(strips, 1) * 255).round().byte().numpy()
        Image.fromarray(whole).save(picture)
    plain = [row for shot, row in zip(wanted, rows.values(), strict=True) if not shot.lifted]
    lifted = [row for shot, row in zip(wanted, rows.values(), strict=True) if shot.lifted]
    means = {
        label: {name: round(float(np.mean([row[name] for row in part])), 3) for name in part[0]}
        for label, part in (("plain", plain), ("lifted", lifted))
    }
    return means | {"speed": speed, "load": os.getloadavg()[0]}


def _decibels(error: torch.Tensor) -> float:
    return float(-10 * error.mean().log10())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=256, help="pixels along a side")
    parser.add_argument("--picture", type=Path, help="field above page, side by side (PNG)")
    parser.add_argument("--speed", action="store_true", help="measure the speed alone")
    arguments = parser.parse_args()
    if not CHROMIUM:
        raise SystemExit("no chromium: apt-get install chromium, or set CHROMIUM")
    found = measure(
        HandAvatar.load(arguments.avatar),
        arguments.folder,
        arguments.size,
        arguments.picture,
        arguments.speed,
    )
    print(json.dumps(found, indent=2))
