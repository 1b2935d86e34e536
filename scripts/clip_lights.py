#!/usr/bin/env python3
"""What a light for each clip is worth: one made hand under two lightings, with and without.

    handavatar capture synth --out A --train-frames 20 --test-frames 8 --size 128 --samples 64 \\
        --seed 102 --tone 0.45 --lighting key
    handavatar capture synth --out B (the same) --lighting dome
    .venv/bin/python scripts/clip_lights.py OUT A B [--cues oriented|traced]

Joins captures of one subject into one of several clips, learns the appearance (200 steps on the
prior's geometry; poses are known), and judges the held-out frames of all clips at 64 pixels, each
in its own clip's light; then once more with the clips' numbers erased. Prints one JSON object for
each: masked PSNR (decibels), that of every clip, and what the truth says of albedo and shading.
"""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Capture, read_capture, write_capture
from handavatar.edit import Edit
from handavatar.evaluate.baselines import judged_frame
from handavatar.evaluate.metrics import masked_psnr
from handavatar.evaluate.run import _against_truth
from handavatar.field.shading import CueSet, OrientedCues, TracedCues
from handavatar.train.appearance import find_seen_samples
from handavatar.train.loop import (
    METHODS,
    TrainOptions,
    _set_learning_rates,
    begin_training,
    training_frames,
    warm_step,
)
from handavatar.train.sky import place_directions

CUES: dict[str, CueSet] = {"oriented": OrientedCues(), "traced": TracedCues(56)}
STEPS = 200
JUDGED_SIDE = 64


def join_captures(folder: Path, captures: list[Capture], are_erased: bool) -> Capture:
    """One capture of all frames, a clip each; or as if all were of one."""
    first = captures[0]
    frames = [
        replace(frame, name=f"{clip}-{frame.name}", clip=0 if are_erased else clip)
        for clip, capture in enumerate(captures)
        for frame in map(capture.frame, range(len(capture.records)))
    ]
    names = ("rig_name", "rig_sha256", "subject", "source", "licence", "shape_coefficients")
    write_capture(folder, frames, **{name: getattr(first, name) for name in names})
    for clip, capture in enumerate(captures):
        for kind in ("albedo", "shading"):
            (folder / "truth" / kind).mkdir(parents=True, exist_ok=True)
            for file in (capture.folder / "truth" / kind).iterdir():
                shutil.copy(file, folder / "truth" / kind / f"{clip}-{file.name}")
    return read_capture(folder)


def learn_appearance(capture: Capture, cues: CueSet) -> HandAvatar:
    """Albedo and light alone."""
    method = replace(
        METHODS["quick"], cues=cues, rounds=1, num_anchors=2048, warm_pixels=1536, steps=STEPS
    )
    frames = training_frames(capture, method)
    training = begin_training(capture, frames, method, TrainOptions(capture.folder))
    training.avatar.occupancy.sharpness = method.sharpness
    seen = find_seen_samples(training.avatar, frames, RenderSettings(num_samples=48), 5)
    if cues.num_directions:
        seen = place_directions(training.avatar, frames, seen, 0)
    for step in range(1, STEPS + 1):
        _set_learning_rates(training, method.decay ** ((step - 1) / STEPS))
        warm_step(training, seen, method, step, 0)
    return training.avatar


def judge(capture: Capture, avatar: HandAvatar) -> dict[str, Any]:
    """Of the held-out frames."""
    frames = [capture.frame(index).binned(JUDGED_SIDE) for index in capture.split("test")]
    renderings = [avatar.render(f.pose, f.camera, Edit(light=f.clip)) for f in frames]
    decibels = torch.tensor(
        [
            masked_psnr(judged_frame(frame, rendering.color, rendering.alpha))
            for frame, rendering in zip(frames, renderings, strict=True)
        ]
    )
    clips = torch.tensor([int(frame.name.split("-")[0]) for frame in frames])
    each = [float(decibels[clips == clip].mean()) for clip in clips.unique().tolist()]
    return {
        "masked_psnr": float(decibels.mean()),
        "of_each_clip": each,
        "truth": _against_truth(capture, frames, renderings),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="a new folder for the joined captures")
    parser.add_argument("captures", type=Path, nargs="+", help="made captures of one subject")
    parser.add_argument("--cues", choices=CUES, default="oriented")
    options = parser.parse_args()
    torch.use_deterministic_algorithms(True)
    captures = [read_capture(folder) for folder in options.captures]
    for name, are_erased in (("a light each", False), ("one light", True)):
        capture = join_captures(options.out / name.replace(" ", "-"), captures, are_erased)
        avatar = learn_appearance(capture, CUES[options.cues])
        print(json.dumps({"lights": name, "cues": options.cues} | judge(capture, avatar)))


if __name__ == "__main__":
    main()
