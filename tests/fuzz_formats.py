"""Formats of files, and how they fare with mutants: ``python tests/fuzz_formats.py COUNT [NAME]``.

Run by ``test_fuzz.py`` in a process of its own: the type checks of the tests would refuse what a
user's program has to refuse itself, and a decoder may end the process.
"""

import argparse
import faulthandler
import json
import pickle
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from conftest import avatar_of_the_prior, camera_above, lit_frame, write_tiny_capture
from fuzz_videos import FILMS, Film, changed_video, save_film
from fuzzing import (
    MOST_SECONDS,
    changed_arrays,
    changed_bytes,
    changed_json_bytes,
    changed_pickle,
    changed_tensors,
    changed_text,
    fault_of,
    limit_memory,
)
from mano_files import write_mano
from PIL import Image, ImageCms
from safetensors.torch import save_file

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.decoding import Sampling
from handavatar.capture.frames import read_capture
from handavatar.capture.given_masks import read_mask
from handavatar.capture.motion import Motion, open_motion, write_motion
from handavatar.capture.motion_files.soma import soma_arrays
from handavatar.capture.motion_import import MotionFromOptions, motion_from
from handavatar.capture.picture_folders import frames_of
from handavatar.capture.soundness import find_problems
from handavatar.capture.video_cameras import pinhole_of, read_camera
from handavatar.capture.view import start_of, view_of
from handavatar.cli.inputs import kind_of
from handavatar.hand.detail import refined, subdivided
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.rigs import read_rig
from handavatar.hand.skin_refinement import strongest_bones
from handavatar.hand.sparse_skin import SparseSkin
from handavatar.jobs.stage_states import StageStates, WorkState
from handavatar.retouch import paint_from
from handavatar.synthetic.truth import encoded_masks, read_film_truth
from handavatar.tracker.model import read_tracker
from handavatar.train.kept import origin, read_kept, write_kept
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


def _stage_state(folder: Path, avatar: HandAvatar) -> Format:
    def states() -> StageStates:
        return StageStates(folder / "work", "a work", ("first", "second"))

    state = WorkState({"poses": torch.rand(4, 16, 3), "order": torch.arange(4)}, {"rounds": 2})
    states().begin("second", lambda: state)

    def read() -> None:
        # It is what was written, or the work is begun anew.
        found = states().whole
        if found is not None:
            assert found.facts == state.facts and found.tensors.keys() == state.tensors.keys()
            assert all(torch.equal(found.tensors[n], v) for n, v in state.tensors.items())

    return Format(folder / "work.safetensors", changed_tensors, read)


def _kept_figures(folder: Path, avatar: HandAvatar) -> Format:
    file = folder / "figures.json"
    rows = {"quick": [24.0, 23.5], "best": [25.0, None]}
    write_kept(file, {"rows": rows, "steps": 8} | origin("abc", rows))
    return Format(file, changed_json_bytes, lambda: read_kept(file, "abc", True))


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


def _other_motions(folder: Path, avatar: HandAvatar) -> list[Format]:
    """Motions of other programs, in every kind of file."""
    sys.path.append(str(Path(__file__).parent / "capture/motion_files"))
    import layout_files as other

    twin = other.write_twin(folder)
    truth = other.make_truth(folder, steps=3)
    filmed = Motion(30.0, truth.rotations.float(), truth.places.float())

    def of(
        name: str, mutate: Mutate, data: Any, layout: str = "auto", mean: str = "auto"
    ) -> Format:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".npz":
            np.savez(file, **data)
        elif file.suffix == ".npy":
            np.save(file, np.array(data, dtype=object), allow_pickle=True)
        elif file.suffix == ".pkl":
            file.write_bytes(pickle.dumps(data, 4))
        else:
            file.write_text(json.dumps(data))
        options = MotionFromOptions(
            file, folder / "m.json", 30.0, None, "open-hand", layout, "right", str(twin), mean
        )
        return Format(file, mutate, lambda: motion_from(options, lambda note: None))

    smplx = other.smplx_arrays(truth)
    lists = {name: value.tolist() for name, value in smplx.items()}
    other.write_hawor(folder, truth)
    chunk = folder / "cam_space/1/0_2.json"
    return [
        of("amass.npz", changed_arrays, other.amass_arrays(truth)),
        of("hamer.npz", changed_arrays, other.hamer_arrays(truth), "hamer"),
        of("wilor.npz", changed_arrays, other.wilor_mini_arrays(truth), "wilor-mini"),
        of("mano.npz", changed_arrays, smplx, "auto", "true"),
        of("soma.npz", changed_arrays, soma_arrays(filmed, load_open_hand(), "right")),
        of("mano.pkl", changed_pickle, smplx, "auto", "true"),
        of("arctic.npy", changed_bytes, other.arctic_fields(truth), "arctic"),
        of("mano.json", changed_json_bytes, lists, "auto", "true"),
        of("interhand.json", changed_json_bytes, other.interhand_frames(truth)),
        of("cam_space/1/0_2.json", changed_json_bytes, json.loads(chunk.read_bytes())),
    ]


def _mano(folder: Path, avatar: HandAvatar) -> list[Format]:
    """The licensed file, by Python 2 and 3."""

    def of(name: str, protocol: int) -> Format:
        file = write_mano(folder / name, protocol=protocol)
        return Format(file, changed_bytes, lambda: read_mano(file))

    return [of("MANO_RIGHT.pkl", 2), of("old_right.pkl", 0)]


def _motion_of_capture(folder: Path, avatar: HandAvatar) -> Format:
    capture = write_tiny_capture(folder / "capture", "ab", size=24)
    options = MotionFromOptions(capture, folder / "m.json")
    return Format(
        capture / "transforms.json",
        changed_json_bytes,
        lambda: motion_from(options, lambda note: None),
    )


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


def _skin(folder: Path, avatar: HandAvatar) -> Format:
    rig = load_open_hand("778")
    fine = subdivided(rig, 1)
    file = folder / "skin.safetensors"
    SparseSkin.of(strongest_bones(fine.skin_weights), rig, 1).save(file)
    return Format(file, changed_tensors, lambda: refined(rig, 1, file, fine))


def _film_truth(folder: Path, avatar: HandAvatar) -> list[Format]:
    rig = load_open_hand("778")
    masks, ends = encoded_masks([np.zeros((48, 64), np.uint8)] * 2)
    arrays = {"rotations": torch.zeros(2, 16, 3), "translations": torch.zeros(2, 3)}
    arrays |= {"shape_coefficients": torch.zeros(10), "rest_vertices": rig.template_vertices}
    arrays |= {"gains": torch.ones(2, 3), "inside": torch.ones(2)}
    facts = {"schema": 1, "rig_name": rig.name, "rig_sha256": rig.sha256, "size": [64, 48]}
    facts |= {"focal": 60.0, "center": [32.0, 24.0], "fps": 30.0, "options": {"seed": 1}}
    file = folder / "film.safetensors"
    save_file(arrays | {"mask_bytes": masks, "mask_ends": ends}, file)
    file.with_suffix(".json").write_text(json.dumps(facts))

    def read() -> None:
        truth = read_film_truth(file)
        for frame in range(len(truth)):
            truth.mask(frame)
            truth.posed(frame)

    return [
        Format(file, changed_tensors, read),
        Format(file.with_suffix(".json"), changed_json_bytes, read),
    ]


def _videos(folder: Path, avatar: HandAvatar) -> list[Format]:
    def of(film: Film) -> Format:
        file = save_film(folder, film)
        return Format(file, changed_video, lambda: _read_pictures(file))

    return [of(film) for film in FILMS]


def _read_pictures(source: Path) -> None:
    """As ``capture video`` takes pictures from whatever it is given."""
    for _ in frames_of(source, Sampling(fps=25, max_frames=12), lambda note: None):
        pass


def _pictures(folder: Path, avatar: HandAvatar) -> list[Format]:
    """Of every kind that lies in folders of pictures, with all that their headers may say."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    exif = Image.Exif()
    exif[0x0112], exif[0x010E] = 6, "a hand"
    exif.get_ifd(0x8769)[0x9003] = "2026:11:30 12:00:00"
    image = Image.new("RGB", (96, 104), (90, 100, 110))
    image.paste((224, 172, 105), (20, 20, 60, 60))

    def of(name: str, picture: Image.Image, **facts: Any) -> Format:
        file = folder / Path(name).stem / name
        file.parent.mkdir()
        picture.save(file, **facts)
        return Format(file, changed_bytes, lambda: _read_pictures(file.parent))

    about: dict[str, Any] = {"exif": exif, "icc_profile": profile}
    deep = Image.fromarray(np.full((100, 100), 50_000, np.uint16))
    return [
        of("phone.jpg", image, **about),
        of("cmyk.jpg", image.convert("CMYK"), progressive=True, **about),
        of("png.png", image.convert("RGBA"), **about),
        of("palette.png", image.quantize(9), transparency=3),
        of("deep.png", deep),
        of("webp.webp", image, **about),
        of("tiff.tif", image, compression="tiff_lzw", **about),
        of("jpeg.tiff", image, compression="jpeg"),
        of("float.tif", deep.convert("F")),
        of("bmp.bmp", image),
        of("ppm.ppm", image),
    ]


def _given_masks(folder: Path, avatar: HandAvatar) -> list[Format]:
    """Masks that a user gives, of every mode that programs write."""
    grey = Image.new("L", (96, 96))
    grey.paste(255, (20, 20, 70, 70))
    labels = grey.point(lambda level: level // 255).convert("P")
    labels.putpalette([0, 0, 0, 128, 0, 0])

    def of(name: str, picture: Image.Image) -> Format:
        file = folder / name
        picture.save(file)
        return Format(file, changed_bytes, lambda: read_mask(file))

    return [
        of("grey.png", grey),
        of("labels.png", labels),
        of("alpha.png", Image.merge("LA", (grey, grey))),
        of("mask.jpg", grey),
        of("mask.tif", grey),
        of("mask.webp", Image.merge("RGBA", (grey, grey, grey, grey))),
        of("one.png", grey.convert("1")),
    ]


def _cameras(folder: Path, avatar: HandAvatar) -> list[Format]:
    """What nerfstudio and COLMAP say of the camera of a video."""
    views = [np.eye(4).tolist() for _ in range(3)]
    content = {"camera_model": "OPENCV", "w": 640, "h": 480, "fl_x": 600.0, "fl_y": 605.0}
    content |= {"cx": 322.0, "cy": 236.5, "k1": -0.12, "k2": 0.03, "p1": 0.001, "p2": -0.002}
    content |= {
        "frames": [
            {"file_path": f"images/{number}.png", "transform_matrix": view}
            for number, view in enumerate(views)
        ]
    }
    scene, model = folder / "scene", folder / "model"
    scene.mkdir()
    model.mkdir()
    (scene / "transforms.json").write_text(json.dumps(content))
    lens = "1 OPENCV 640 480 600 605 322 236.5 -0.12 0.03 0.001 -0.002"
    (model / "cameras.txt").write_text(f"# Camera list\n{lens}\n")
    lines = [f"{number} 1 0 0 0 0.1 0 {number} 1 {number}.png\n1.5 2.5 -1" for number in range(3)]
    (model / "images.txt").write_text("\n".join(["# Image list", *lines, ""]))

    def read(source: Path) -> None:
        camera = read_camera(source)
        straighten = pinhole_of(camera.lens, (96, 72), camera.source, lambda note: None).straighten
        straighten(np.zeros((72, 96, 3), np.uint8))

    return [
        Format(scene / "transforms.json", changed_json_bytes, lambda: read(scene)),
        Format(model / "cameras.txt", changed_text, lambda: read(model)),
        Format(model / "images.txt", changed_text, lambda: read(model)),
    ]


FORMATS: dict[str, Callable[[Path, HandAvatar], Format | list[Format]]] = {
    "avatar": _avatar,
    "checkpoint": _checkpoint,
    "rig": _rig,
    "capture": _capture,
    "frame": _frame,
    "mask": _mask,
    "stage state": _stage_state,
    "kept figures": _kept_figures,
    "paint": _paint,
    "motion": _motion,
    "another program's motion": _other_motions,
    "motion of a capture": _motion_of_capture,
    "mano": _mano,
    "prior": _prior,
    "tracker": _tracker,
    "covariances": _covariances,
    "run.json": _run_facts,
    "log.jsonl": _run_log,
    "progress.json": _progress,
    "video": _videos,
    "pictures": _pictures,
    "given masks": _given_masks,
    "cameras": _cameras,
    "skin": _skin,
    "film truth": _film_truth,
}


def _read_as_told(tried: Format) -> None:
    """As a command does: first what it is, then what it says."""
    kind_of(tried.file)
    tried.read()


def faults_of(
    name: str, count: int, folder: Path, avatar: HandAvatar, seed: int = 0
) -> Counter[str]:
    """How often the reader of a format failed on so many mutants, and how; and the first of each.

    Args:
        name: of the format; of one of several files, with a slash and the file's name behind it.
        count: of mutants.
        folder: to work in.
        avatar: any.
        seed: other mutants.
    """
    name, _, only = name.partition("/")
    made = FORMATS[name](folder, avatar)
    files = [
        each for each in (made if isinstance(made, list) else [made]) if only in each.file.name
    ]
    wholes = [each.file.read_bytes() for each in files]
    for tried in files:
        assert fault_of(tried.read) == "", f"{tried.file.name}: the whole file is not read"
    faults: Counter[str] = Counter()
    firsts: dict[str, int] = {}
    slowest = (0.0, 0)
    for number in range(count):
        tried, whole = files[number % len(files)], wholes[number % len(files)]
        chance = random.Random(f"{name} {number} {seed}" if seed else f"{name} {number}")
        # Names the mutant that ends the process.
        print(f"\r{name} {tried.file.name} {number}", end="", file=sys.stderr)
        faulthandler.dump_traceback_later(3 * MOST_SECONDS, exit=True)
        tried.file.write_bytes(tried.mutate(whole, chance))
        begin = time.monotonic()
        fault = fault_of(partial(_read_as_told, tried))
        slowest = max(slowest, (time.monotonic() - begin, number))
        tried.file.write_bytes(whole)
        if fault:
            firsts.setdefault(f"{tried.file.name}: {fault}", number)
            faults[f"{tried.file.name}: {fault}"] += 1
    faulthandler.cancel_dump_traceback_later()
    print(f"\n{name}: {count} mutants, slowest {slowest[0]:.1f} s ({slowest[1]})", file=sys.stderr)
    return Counter({f"{fault} (mutant {firsts[fault]})": faults[fault] for fault in faults})


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    faulthandler.enable()
    torch.set_num_threads(1)
    limit_memory()
    found, avatar = {}, avatar_of_the_prior()
    for name in asked.names or FORMATS:
        with tempfile.TemporaryDirectory() as place:
            found[name] = faults_of(name, asked.count, Path(place), avatar, asked.seed)
    print(json.dumps(found))


if __name__ == "__main__":
    _main()
