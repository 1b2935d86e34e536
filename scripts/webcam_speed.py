"""How fast and how right a live hand is followed: python scripts/webcam_speed.py FILM.

FILM is a video; where its truth lies beside it, as :mod:`handavatar.synthetic.films` writes it,
errors are told as well. Every picture goes the way that the page's pictures go, without a browser:
JPEG, hand, pose, warnings, coverage, and with --drive RUN the avatar's picture; one thread sees,
another draws. `--make FOLDER` makes the film first. Times are medians: by the clock, and in
brackets those that the thread has computed, which others on the machine disturb less.
"""

import argparse
import io
import statistics
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.capture.decoding import Sampling, VideoFrame, video_frames
from handavatar.geometry.cameras import project
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.rigs import load_rig
from handavatar.synthetic.films import FilmOptions, make_film
from handavatar.synthetic.truth import FilmTruth, read_film_truth
from handavatar.tracker.model import shipped_tracker
from handavatar.tracker.network import INPUT_SIDE
from handavatar.view.driven import DrivenAvatar
from handavatar.view.studio import encoded
from handavatar.view.webcam_answers import read_picture
from handavatar.webcam.session import LiveSession, LiveView

GESTURES = ("spread", "relaxed", "flat", "fist", "spread", "relaxed")
FILM = FilmOptions("turn", 23, 0.35, GESTURES, "turn", "room", seconds=8.0)


def timed(times: list[tuple[float, float]], work: Callable[[], Any]) -> Any:
    """What the work gives; its seconds by the clock and in this thread are added to the times."""
    begin, own = time.perf_counter(), time.thread_time()
    found = work()
    times.append((time.perf_counter() - begin, time.thread_time() - own))
    return found


def told(name: str, times: list[tuple[float, float]]) -> None:
    clock, own = (1000 * statistics.median(column) for column in zip(*times, strict=True))
    print(f"{name}: {clock:.0f} ms ({own:.0f} ms)")


def jpeg_of(frame: VideoFrame) -> bytes:
    """As a page sends it."""
    picture, buffer = Image.fromarray(frame.image), io.BytesIO()
    picture.thumbnail((640, 640))
    picture.save(buffer, "JPEG", quality=90)
    return buffer.getvalue()


def errors(film: FilmTruth, index: int, view: LiveView, width: int) -> tuple[float, float] | None:
    """Of landmarks in the picture, in units of the hand's extent there, and of joints, metres."""
    if view.live is None:
        return None
    points = shipped_tracker().points
    true = points.positions(film.rest_hand, film.pose(index))[:NUM_LANDMARKS]
    wanted = project(film.camera, true)[0].numpy() * (width / film.camera.width)
    apart = np.linalg.norm(view.landmarks - wanted, axis=-1).mean()
    found = points.positions(view.live.hand, view.live.pose)[:NUM_LANDMARKS]
    # About their means, and as large: how far the hand is away, one picture does not tell.
    found, true = found - found.mean(0), true - true.mean(0)
    found = found * ((found * true).sum() / found.square().sum())
    return float(apart / np.ptp(wanted, axis=0).max()), float((found - true).norm(dim=-1).mean())


parser = argparse.ArgumentParser()
parser.add_argument("film", type=Path, nargs="?")
parser.add_argument("--make", type=Path)
parser.add_argument("--drive", type=Path)
parser.add_argument("--fps", type=float, default=10.0)
options = parser.parse_args()
torch.set_num_threads(1)
path = make_film(FILM, options.make) if options.make else options.film
frames = list(video_frames(path, Sampling(options.fps), print))
truth = read_film_truth(path) if path.with_suffix(".json").is_file() else None
avatar = DrivenAvatar(HandAvatar.load(options.drive)) if options.drive else None
session = LiveSession(load_rig("open-hand").shaped() if avatar is None else avatar.hand)
reading: list[tuple[float, float]] = []
seeing: list[tuple[float, float]] = []
drawing: list[tuple[float, float]] = []
off: list[tuple[float, float]] = []


def drawn(view: LiveView) -> bytes:
    assert avatar is not None and view.live is not None and view.followed is not None
    live, is_left = view.live, view.followed.is_mirrored
    return timed(drawing, lambda: encoded(avatar.picture(live, is_left), "JPEG"))


begin, count = 0.0, 0
waiting: Future[bytes] | None = None
with ThreadPoolExecutor(1) as pool:
    for number, frame in enumerate(frames):
        if number == 3:  # What is done once is done.
            begin, count = time.perf_counter(), 0
        data = jpeg_of(frame)
        image = timed(reading, lambda data=data: read_picture(data))
        view = timed(seeing, lambda image=image, at=frame.time: session.see(image, at))
        if truth is not None and (error := errors(truth, frame.index, view, image.shape[1])):
            off.append(error)
        if waiting is not None:
            waiting.result()
            waiting = None
        if avatar is not None and view.live is not None:
            waiting = pool.submit(drawn, view)
        count += 1
    if waiting is not None:
        waiting.result()
seconds = time.perf_counter() - begin
print(f"{path}: {len(frames)} pictures, {count / seconds:.1f} a second")
look = np.zeros((1, INPUT_SIDE, INPUT_SIDE, 3), dtype=np.uint8)
looking: list[tuple[float, float]] = []
for _ in range(20):
    timed(looking, lambda: shipped_tracker().tell(look))
told("for comparison, one look by the network", looking)
told("reading a picture", reading)
told("seeing it: hand, pose, warnings, coverage", seeing)
if drawing:
    told("drawing the avatar", drawing)
if off:
    places, joints = (statistics.median(column) for column in zip(*off, strict=True))
    print(f"landmarks: {100 * places:.1f} % of the hand; joints: {1000 * joints:.1f} mm")
    print(f"no hand was told in {len(frames) - len(off)} of {len(frames)} pictures")
