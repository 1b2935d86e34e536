"""Formats of files, and how they fare with mutants: ``python tests/fuzz_formats.py COUNT [NAME]``.

Run by ``test_fuzz.py`` in a process of its own: the type checks of the tests would refuse what a
user's program has to refuse itself.
"""

import json
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from conftest import avatar_of_the_prior, camera_above, lit_frame, write_tiny_capture
from fuzzing import changed_bytes, changed_json_bytes, changed_tensors, fault_of
from PIL import Image
from safetensors.torch import save_file

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import read_capture
from handavatar.capture.motion import Motion, open_motion, write_motion
from handavatar.capture.motion_import import MotionFromOptions, motion_from
from handavatar.capture.soundness import find_problems
from handavatar.capture.view import start_of, view_of
from handavatar.cli.inputs import kind_of
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.rigs import read_rig
from handavatar.retouch import paint_from
from handavatar.tracker.model import read_tracker
from handavatar.train.live import LiveState, live_folder, read_live
from handavatar.train.prior import SHIPPED_PRIOR, open_prior
from handavatar.train.runs import (
    Checkpoint,
    Run,
    append_log,
    create_run,
    load_checkpoint,
    open_run,
    read_log,
    save_checkpoint,
    truncate_log,
)

Mutate = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Format:
    """A kind of file, and how it is read.

    Attributes:
        file: whole, to be mutated.
        mutate: its bytes.
        read: reads the mutant, which lies where the file did.
    """

    file: Path
    mutate: Mutate
    read: Callable[[], Any]


def _avatar(folder: Path, avatar: HandAvatar) -> Format:
    file = folder / "avatar.safetensors"
    avatar.info["view"] = view_of([lit_frame(0, "train", size=8)])
    avatar.save(file)

    def read() -> None:
        loaded = HandAvatar.load(file)
        start = start_of(loaded.view())
        loaded.render(start, camera_above(8), settings=RenderSettings(num_samples=4))

    return Format(file, changed_tensors, read)


def _rig(folder: Path, avatar: HandAvatar) -> Format:
    rig = load_open_hand("778")
    file = folder / "rig.safetensors"
    names = ("template_vertices", "faces", "skin_weights", "joint_regressor", "shape_directions")
    more = ("uv_coordinates", "uv_faces", "joint_axes", "pose_directions")
    tensors = {n: getattr(rig, n).contiguous() for n in (*names, *more) if hasattr(rig, n)}
    tensors |= {f"set_{name}": members for name, members in rig.vertex_sets.items()}
    facts = {"schema": "1", "name": "mano-x", "side": "right", "sha256": rig.sha256}
    save_file(tensors, file, facts | {"left_shape": "kept", "source_sha256": "0"})
    return Format(file, changed_tensors, lambda: read_rig(file))


def _capture(folder: Path, avatar: HandAvatar) -> Format:
    capture = write_tiny_capture(folder / "capture", "ab", size=24)

    def read() -> None:
        find_problems(capture)
        read_capture(capture).frame(0)

    return Format(capture / "transforms.json", changed_json_bytes, read)


def _frame(folder: Path, avatar: HandAvatar) -> Format:
    capture = write_tiny_capture(folder / "capture", "ab", size=24)

    def read() -> None:
        find_problems(capture)
        read_capture(capture).frame(0)

    return Format(capture / "images/000000.png", changed_bytes, read)


def _mask(folder: Path, avatar: HandAvatar) -> Format:
    capture = write_tiny_capture(folder / "capture", "ab", size=24)

    def read() -> None:
        find_problems(capture)
        read_capture(capture).frame(0)

    return Format(capture / "masks/000000.png", changed_bytes, read)


def _paint(folder: Path, avatar: HandAvatar) -> Format:
    picture = Image.new("RGBA", (16, 16), (200, 20, 30, 0))
    picture.paste((10, 200, 30, 255), (4, 4, 12, 12))
    picture.save(folder / "paint.png")
    file = folder / "paint.png"
    return Format(file, changed_bytes, lambda: paint_from(file, avatar))


def _motion(folder: Path, avatar: HandAvatar) -> Format:
    file = folder / "motion.json"
    write_motion(file, Motion(30.0, torch.zeros(3, 16, 3), torch.zeros(3, 3)))
    rig = load_open_hand("778")
    return Format(file, changed_json_bytes, lambda: open_motion(str(file), rig, HandPose.flat()))


def _prior(folder: Path, avatar: HandAvatar) -> Format:
    file = folder / "prior.safetensors"
    file.write_bytes(SHIPPED_PRIOR.read_bytes())
    return Format(file, changed_tensors, lambda: open_prior(file))


def _tracker(folder: Path, avatar: HandAvatar) -> Format:
    file = folder / "tracker.safetensors"
    file.write_bytes((SHIPPED_PRIOR.parent / "tracker.safetensors").read_bytes())
    return Format(file, changed_tensors, lambda: read_tracker(file))


def _covariances(folder: Path, avatar: HandAvatar) -> Format:
    capture = write_tiny_capture(folder / "capture", "ab", size=24)
    save_file({"covariance": torch.eye(51).repeat(2, 1, 1)}, capture / "covariances.safetensors")
    return Format(
        capture / "covariances.safetensors",
        changed_tensors,
        lambda: read_capture(capture).frame(0),
    )


def _arrays(folder: Path, avatar: HandAvatar) -> Format:
    """AMASS: another program's motion, both hands."""
    file = folder / "motion.npz"
    zeros = np.zeros((4, 156))
    np.savez(file, poses=zeros, trans=zeros[:, :3], mocap_framerate=30.0, gender="neutral")
    options = MotionFromOptions(file, folder / "m.json", side="right")
    return Format(file, changed_bytes, lambda: motion_from(options, lambda note: None))


def _run_facts(folder: Path, avatar: HandAvatar) -> Format:
    run = _run(folder)

    def read() -> None:
        open_run(run.folder)
        _ = run.facts, run.options

    return Format(run.folder / "run.json", changed_json_bytes, read)


def _run_log(folder: Path, avatar: HandAvatar) -> Format:
    run = _run(folder)
    for step in range(1, 40):
        append_log(run, step, {"psnr": 20.0 + step, "loss": 1.0, "silhouette": 0.1, "color": 0.2})

    def mutate(data: bytes, chance: random.Random) -> bytes:
        lines = data.splitlines(keepends=True)
        place = chance.randrange(len(lines))
        lines[place] = changed_json_bytes(lines[place], chance) + b"\n" * chance.randrange(2)
        return b"".join(lines)

    def read() -> None:
        read_log(run)
        truncate_log(run, 20)

    return Format(run.log, mutate, read)


def _checkpoint(folder: Path, avatar: HandAvatar) -> Format:
    run = _run(folder)
    save_checkpoint(run, 7, {"model": {"a": torch.zeros(3)}}, {"adam": {"lr": 0.1}})
    step = run.checkpoints / "step-000000007"
    return Format(
        step / "MANIFEST.json", changed_json_bytes, lambda: load_checkpoint(Checkpoint(step, 7))
    )


def _progress(folder: Path, avatar: HandAvatar) -> Format:
    run = _run(folder)
    live_folder(run).mkdir()
    state = LiveState(
        phase="training",
        step=3,
        total=10,
        steps_per_second=1.0,
        seconds_left=7.0,
        time=1.0,
        figures={},
    )
    file = live_folder(run) / "progress.json"
    file.write_text(json.dumps(vars(state)))

    def read() -> None:
        found = read_live(run)
        _ = found is not None and found.is_going_on

    return Format(file, changed_json_bytes, read)


def _run(folder: Path) -> Run:
    facts = dict(seed=0, capture=folder, capture_sha256="0", perceptual="none")
    return create_run(folder / "run", {"method": "quick"}, **facts)


FORMATS: dict[str, Callable[[Path, HandAvatar], Format]] = {
    "avatar": _avatar,
    "checkpoint": _checkpoint,
    "rig": _rig,
    "capture": _capture,
    "frame": _frame,
    "mask": _mask,
    "paint": _paint,
    "motion": _motion,
    "another program's motion": _arrays,
    "prior": _prior,
    "tracker": _tracker,
    "covariances": _covariances,
    "run.json": _run_facts,
    "log.jsonl": _run_log,
    "progress.json": _progress,
}


def faults_of(name: str, count: int, folder: Path, avatar: HandAvatar) -> Counter[str]:
    tried = FORMATS[name](folder, avatar)
    whole = tried.file.read_bytes()
    assert fault_of(tried.read) == "", "the whole file is not read"
    faults: Counter[str] = Counter()
    for number in range(count):
        tried.file.write_bytes(tried.mutate(whole, random.Random(f"{name} {number}")))
        fault = fault_of(lambda: (kind_of(tried.file), tried.read()))
        if fault:
            faults[f"{fault} (mutant {number})" if not faults else fault] += 1
    return faults


if __name__ == "__main__":
    torch.set_num_threads(1)
    chosen = sys.argv[2:] or list(FORMATS)
    found = {}
    for tried_name in chosen:
        with tempfile.TemporaryDirectory() as place:
            found[tried_name] = faults_of(
                tried_name, int(sys.argv[1]), Path(place), avatar_of_the_prior()
            )
    print(json.dumps(found))
