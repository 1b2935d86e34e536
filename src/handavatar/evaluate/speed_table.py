"""The table of speed: the plain reference against the fast ways of making the same picture.

All in one run, on the same poses, at the same places of the rays. The plain reference costs the
same for every ray, so it is timed on some rays of each picture, drawn at random, and scaled to all.
"""

import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from handavatar.avatar import (
    EXACT,
    HandAvatar,
    HandState,
    RayValues,
    RenderSettings,
    chosen_device,
)
from handavatar.errors import require_range, require_ranges
from handavatar.evaluate.published_coap import published_coap_query
from handavatar.evaluate.tables import Cell, ResultTable, step_counter
from handavatar.geometry.cameras import (
    Camera,
    Rays,
    framing_camera,
    pixel_centers,
    rays_through_pixels,
)
from handavatar.hand.pose import BONE_PARENTS, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import GESTURES, gesture_rotations
from handavatar.jobs.progress import SILENT, Progress
from handavatar.plain import plain_rays

_WAYS = {
    "exact": replace(EXACT, edge_rays=1, kernel="torch"),
    "near-exact": RenderSettings(edge_rays=1, kernel="torch"),
}
"""As ``render --quality`` has them, but with one ray a pixel like the reference."""
_KERNEL_WAYS = {
    "exact, triton": replace(_WAYS["exact"], kernel="triton"),
    "near-exact, triton": replace(_WAYS["near-exact"], kernel="triton"),
    "near-exact, triton-tf32": replace(_WAYS["near-exact"], kernel="triton-tf32"),
    "near-exact, triton-bf16": replace(_WAYS["near-exact"], kernel="triton-bf16"),
}
"""The same with the kernels of :mod:`handavatar.field.fused`, where there is a GPU."""
_VIEWS = ((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, -0.7, 0.7), (0.0, 0.7, 0.7))
"""Where the camera stands, in turn: palm, back and two sides, in the hand's rest axes."""
_DISTANCE = 0.6
_ROOM = 1.3
"""The picture's side for a hand's side, as in the authors' crops."""
_COUNTED_RAYS = 64


def _ways(device: torch.device) -> dict[str, RenderSettings]:
    return _WAYS | (_KERNEL_WAYS if device.type == "cuda" else {})


@dataclass(frozen=True)
class SpeedTableOptions:
    """What is timed.

    Attributes:
        avatar: a trained one: how much can be left out depends on what it has learned.
        size: pixels along a side of the pictures.
        poses: gestures, one picture of each.
        plain_rays: rays of each picture that the plain reference evaluates.
        plain_points: points at a time of the plain reference; the best of these counts.
        sizes: pixels along a side, of one pose, by the fast ways alone.
        hands: numbers of hands rendered as one batch, by the fast ways alone.
        device: where the fields run; on a GPU the kernels of the pair decoder are rows of their
            own.
    """

    avatar: Path
    size: int = 256
    poses: int = 8
    plain_rays: int = 512
    plain_points: tuple[int, ...] = (512, 1024, 2048)
    sizes: tuple[int, ...] = (64, 128, 256, 512)
    hands: tuple[int, ...] = (1, 2, 4, 8)
    device: str = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            size=(2, 4096),
            poses=(1, len(GESTURES)),
            plain_rays=(1, 4096**2),
            plain_points=(1, 10**6),
            sizes=(2, 4096),
            hands=(1, 64),
        )

    @property
    def total_steps(self) -> int:
        """Pictures and the choice of the reference's pieces."""
        alone = len(_ways(chosen_device(self.device))) * (len(self.sizes) + len(self.hands))
        return self.poses + len(self.plain_points) + alone


@dataclass(frozen=True, eq=False)
class Scene:
    """One pose, its camera, and rays of the picture that every way evaluates.

    Attributes:
        pose: of the hand.
        camera: of the picture.
        state: what all rays share.
        pixels: numbers of the chosen pixels, row by row.
        rays: through them.
    """

    pose: HandPose
    camera: Camera
    state: HandState
    pixels: Int[Tensor, "rays"]
    rays: Rays


def speed_table(options: SpeedTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Times the plain reference, the exact and the near-exact way side by side.

    Args:
        options: what to time.
        progress: told the number of pieces of work done.

    Raises:
        CheckpointError: if the avatar cannot be read.
        ValueError: if there are fewer rays or poses than can be chosen.
    """
    require_range("plain_rays", options.plain_rays, 1, options.size**2)
    device = chosen_device(options.device)
    ways = _ways(device)
    avatar = HandAvatar.load(options.avatar).moved_to(device)
    finished = step_counter(progress, options.total_steps)
    with torch.no_grad():
        scenes = [
            _scene(avatar, name, number, options.size, options.plain_rays)
            for number, name in enumerate(list(GESTURES)[: options.poses])
        ]
        points_at_once = _best_pieces(avatar, scenes[0], options, finished)
        timings = {name: Timings() for name in ("plain", *ways)}
        for scene in scenes:
            _time_scene(avatar, scene, points_at_once, ways, timings)
            finished()
        counts = _counts(avatar, scenes[0], points_at_once)
        peak = _peak_flops(device)
        rows = {
            # A kernel does the work of the operations that it replaces.
            name: _row(timing, timings["plain"], counts[name.partition(",")[0]], peak)
            for name, timing in timings.items()
        }
        for name, settings in ways.items():
            for count in options.hands:
                spent = _batch_seconds(avatar, scenes, count, settings)
                rows[f"{name}, {count} hands"] = _short_row(rows["plain"], spent / count)
                finished()
        skinning = _skinning_note(avatar)
        query = _query_note(avatar, scenes[0].state, options.plain_points)
    empty = 0.0
    for name in ways:
        for size in options.sizes:
            spent, empty, memory = _alone(options.avatar, device, name, size)
            rows[f"{name}, {size} pixels"] = _short_row(rows["plain"], spent, memory)
            finished()
    notes: tuple[str, ...] = (
        f"{len(scenes)} poses of {options.size}x{options.size} pixels, {_machine(device)}; the "
        f"plain reference on {options.plain_rays} rays of each, scaled to all, "
        f"{points_at_once} points at a time (the best of {list(options.plain_points)}).",
        "Ratio: seconds of the plain reference for all poses over those of the row [least, most of "
        "a single pose]. Errors: of the colour at the reference's rays, at the same places along "
        "them; PSNR over these rays.",
        f"TFLOP of matrix products and GB through memory, every operation's operands and result, "
        f"of the first pose; this machine reaches {peak / 1e9:,.0f} GFLOP/s in a product of two "
        "2048x2048 matrices.",
        f"Hands: seconds for each of so many poses of {options.size}x{options.size} pixels, "
        "rendered as one batch.",
        "By size of the picture: the first pose in a process of its own; MB: the most that the "
        f"process held, of which {empty:.0f} before the picture was begun.",
        skinning,
        query,
    )
    if device.type == "cuda":
        notes += (
            "Shape and encoder run as one recorded graph on a GPU and are not told apart; the "
            "other stages' shares are of a picture in which the GPU was waited for in between.",
        )
    return ResultTable("Speed of rendering", rows, notes)


# --- scenes ---------------------------------------------------------------------------------------


def hand_camera(
    vertices: Float[Tensor, "vertices 3"], direction: tuple[float, float, float], size: int
) -> Camera:
    """The hand in the middle of a picture, with some room around it."""
    return framing_camera(vertices, direction, size, _DISTANCE, _ROOM)


def _scene(avatar: HandAvatar, gesture: str, number: int, size: int, num_rays: int) -> Scene:
    rotations = gesture_rotations(avatar.base_rig, gesture).to(avatar.device)
    pose = HandPose(rotations, rotations.new_zeros(3))
    state = avatar.prepare(pose)
    camera = hand_camera(state.posed.vertices, _VIEWS[number % len(_VIEWS)], size)
    camera = camera.to(avatar.device)
    generator = torch.Generator().manual_seed(number)
    pixels = torch.randperm(size**2, generator=generator)[:num_rays].to(avatar.device)
    rays = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1)[pixels])
    return Scene(pose, camera, state, pixels, rays)


def _first_rays(scene: Scene) -> Rays:
    return Rays(scene.rays.origins[:_COUNTED_RAYS], scene.rays.directions[:_COUNTED_RAYS])


# --- timing ---------------------------------------------------------------------------------------


def _now(device: torch.device) -> float:
    """Seconds, once all that was asked of the device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _machine(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{torch.get_num_threads()} threads"


class Timings:
    """What one way took and how far it is from the reference, pose by pose."""

    def __init__(self) -> None:
        """Nothing yet."""
        self.seconds: list[float] = []
        self.largest: list[float] = []
        self.squared: list[float] = []
        self.stages: dict[str, float] = {}

    def add(
        self, seconds: float, found: RayValues, truth: RayValues, stages: dict[str, float]
    ) -> None:
        """Takes note of one picture."""
        error = (found.color - truth.color).double()
        self.seconds.append(seconds)
        self.largest.append(float(error.abs().max()))
        self.squared.append(float(error.square().mean()))
        for name, spent in stages.items():
            self.stages[name] = self.stages.get(name, 0.0) + spent


def _best_pieces(
    avatar: HandAvatar, scene: Scene, options: SpeedTableOptions, finished: Callable[[], None]
) -> int:
    """The number of points at a time with which the plain reference is quickest."""
    few = _first_rays(scene)
    spent = {}
    for count in options.plain_points:
        begin = _now(avatar.device)
        plain_rays(avatar, scene.state, few, points_at_once=count)
        spent[count] = _now(avatar.device) - begin
        finished()
    return min(spent, key=spent.__getitem__)


def _time_scene(
    avatar: HandAvatar,
    scene: Scene,
    points_at_once: int,
    ways: dict[str, RenderSettings],
    timings: dict[str, Timings],
) -> None:
    """One picture in each way, one after the other, so that all meet the same machine."""
    scale = scene.camera.width * scene.camera.height / len(scene.pixels)
    with _stages(avatar) as stages:
        begin = _now(avatar.device)
        truth = plain_rays(avatar, scene.state, scene.rays, points_at_once=points_at_once)
        seconds = scale * (_now(avatar.device) - begin)
        spent = {name: scale * value for name, value in stages.items()}
    timings["plain"].add(seconds, truth, truth, spent)
    is_gpu = avatar.device.type == "cuda"
    for name, settings in ways.items():
        if timings[name].seconds == [] and is_gpu:
            # The first time a GPU's kernels are compiled and loaded.
            avatar.render(scene.pose, scene.camera, settings=settings)
        with _stages(avatar) as stages:
            begin = _now(avatar.device)
            avatar.render(scene.pose, scene.camera, settings=settings)
            seconds = _now(avatar.device) - begin
        spent = {stage: value / seconds for stage, value in stages.items()}
        if is_gpu:
            # To tell stages apart, the GPU was waited for in between.
            begin = _now(avatar.device)
            avatar.render(scene.pose, scene.camera, settings=settings)
            seconds = _now(avatar.device) - begin
        found = avatar.at_pixels(scene.state, scene.camera, scene.pixels, settings)
        shares = {stage: share * seconds for stage, share in spent.items()}
        timings[name].add(seconds, found, truth, shares)


@contextmanager
def _stages(avatar: HandAvatar) -> Iterator[dict[str, float]]:
    """Seconds inside the fields, by name, of what runs in the block."""
    spent: dict[str, float] = {}
    # The plain evaluation calls the decoder, the fast one the field, kernels its two halves.
    field = avatar.occupancy
    watched: list[tuple[str, nn.Module, str]] = [
        ("occupancy", field, "forward"),
        ("occupancy", field, "decide"),
        ("occupancy", field, "whole_again"),
        ("occupancy", field.decoder, "forward"),
        ("albedo", avatar.albedo, "forward"),
        ("illumination", avatar.illumination, "forward"),
        ("encoder", field, "encode"),
        ("shape", avatar.shape, "forward"),
    ]

    def timed(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **named: Any) -> Any:
            begin = _now(avatar.device)
            result = work(*arguments, **named)
            spent[stage] = spent.get(stage, 0.0) + _now(avatar.device) - begin
            return result

        return wrapped

    for stage, module, name in watched:
        # An attribute of the object hides the method of its class.
        setattr(module, name, timed(stage, getattr(module, name)))
    try:
        yield spent
    finally:
        for _, module, name in watched:
            delattr(module, name)


def _batch_seconds(
    avatar: HandAvatar, scenes: list[Scene], count: int, settings: RenderSettings
) -> float:
    """Seconds for so many hands at once; where there are more than poses, poses come again."""
    chosen = [scenes[number % len(scenes)] for number in range(count)]
    begin = _now(avatar.device)
    avatar.render_batch(
        [scene.pose for scene in chosen], [scene.camera for scene in chosen], settings=settings
    )
    return _now(avatar.device) - begin


def _alone(path: Path, device: torch.device, way: str, size: int) -> tuple[float, float, float]:
    """One picture in a process of its own: seconds, and the most memory before and with it, MB."""
    # Spawned, not forked: a fork would start with this process's memory.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        threads = torch.get_num_threads()
        return pool.submit(_rendered_alone, path, device, way, size, threads).result()


def _rendered_alone(
    path: Path, device: torch.device, way: str, size: int, threads: int
) -> tuple[float, float, float]:
    torch.set_num_threads(threads)
    settings = _ways(device)[way]
    avatar = HandAvatar.load(path).moved_to(device)
    with torch.no_grad():
        scene = _scene(avatar, next(iter(GESTURES)), 0, size, 1)
    before = most_memory(device)
    if device.type == "cuda":
        avatar.render(scene.pose, scene.camera, settings=settings)
    begin = _now(device)
    avatar.render(scene.pose, scene.camera, settings=settings)
    return _now(device) - begin, before, most_memory(device)


def most_memory(device: torch.device) -> float:
    """The most that this process has held so far on its device, megabytes."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    if sys.platform == "linux":
        # Not `ru_maxrss`: a process that another one starts inherits the other's peak there.
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6
    if sys.platform == "win32":
        raise OSError("Windows does not tell how much memory a process has held at most")
    resource = import_module("resource")

    # Told in kilobytes, but in bytes on a Mac.
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


# --- counting -------------------------------------------------------------------------------------


class _Traffic(TorchDispatchMode):
    """Adds up the bytes of every operation's operands and results."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        # A view moves nothing.
        if not func.is_view:
            leaves = torch.utils._pytree.tree_leaves((args, kwargs, result))
            self.total += sum(
                leaf.numel() * leaf.element_size() for leaf in leaves if torch.is_tensor(leaf)
            )
        return result


def _counts(
    avatar: HandAvatar, scene: Scene, points_at_once: int
) -> dict[str, tuple[float, float]]:
    """Floating-point operations and bytes of the first pose's picture, by way."""
    few = _first_rays(scene)
    scale = scene.camera.width * scene.camera.height / len(few.origins)

    def plain() -> None:
        plain_rays(avatar, scene.state, few, points_at_once=points_at_once)

    found = {"plain": (scale, counted(plain))}
    for name, settings in _WAYS.items():

        def fast(settings: RenderSettings = settings) -> None:
            avatar.render(scene.pose, scene.camera, settings=settings)

        found[name] = (1.0, counted(fast))
    return {
        name: (factor * flops, factor * traffic)
        for name, (factor, (flops, traffic)) in found.items()
    }


def counted(work: Callable[[], None]) -> tuple[int, int]:
    """Floating-point operations and bytes; on one thread, since the counters see only their own."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _Traffic() as traffic, FlopCounterMode(display=False) as flops:
            work()
    finally:
        torch.set_num_threads(threads)
    return flops.get_total_flops(), traffic.total


def _peak_flops(device: torch.device, size: int = 2048, tries: int = 3) -> float:
    """Operations a second of a large product of 32-bit matrices, the best of some tries."""
    left, right = torch.rand(2, size, size, device=device)
    return 2 * size**3 / _best_seconds(lambda: left @ right, device, tries)


def _row(
    timing: Timings, plain: Timings, counts: tuple[float, float], peak: float
) -> dict[str, Cell]:
    ratios = [theirs / ours for theirs, ours in zip(plain.seconds, timing.seconds, strict=True)]
    mean = sum(timing.squared) / len(timing.squared)
    total = sum(timing.seconds)
    row: dict[str, Cell] = {
        "s a picture": round(total / len(timing.seconds), 3),
        "ratio": f"{sum(plain.seconds) / total:.1f} [{min(ratios):.1f}, {max(ratios):.1f}]",
        "max error": None if timing is plain else float(f"{max(timing.largest):.1e}"),
        "PSNR": None if mean == 0 else round(-10 * math.log10(mean), 1),
    }
    row |= {
        f"{name} %": round(100 * timing.stages.get(name, 0.0) / total, 1)
        for name in ("shape", "encoder", "occupancy", "albedo", "illumination")
    }
    row["TFLOP"] = round(counts[0] / 1e12, 4)
    row["GB"] = round(counts[1] / 1e9, 2)
    row["MB at most"] = None
    row["% of peak"] = round(100 * counts[0] / timing.seconds[0] / peak, 1)
    return row


def _short_row(
    like: dict[str, Cell], seconds: float, memory: float | None = None
) -> dict[str, Cell]:
    """A row that only says how long a picture took, and how much memory."""
    return {
        **dict.fromkeys(like),
        "s a picture": round(seconds, 3),
        "MB at most": None if memory is None else round(memory),
    }


def _skinning_note(avatar: HandAvatar, hands: int = 16) -> str:
    """How long it takes to shape and pose a mesh, for us and for smplx, if that is installed."""
    rig = avatar.base_rig
    generator = torch.Generator().manual_seed(0)
    rotations = 0.3 * torch.randn(hands, NUM_BONES, 3, generator=generator).to(avatar.device)
    shapes = torch.randn(hands, rig.shape_directions.shape[-1], generator=generator)
    shapes = shapes.to(avatar.device)
    pose = HandPose(rotations, rotations.new_zeros(hands, 3))
    ours = _best_seconds(lambda: rig.shaped(shapes).posed(pose), avatar.device)
    told = f"Shaping and posing {rig.num_vertices} vertices: {1e3 * ours / hands:.2f} ms a hand"
    if find_spec("smplx") is None:
        return f"{told} in batches of {hands}; smplx is not installed."
    lbs = import_module("smplx.lbs").lbs
    # Multiplied by smplx in any case; the open hand has none.
    no_directions = shapes.new_zeros(9 * (NUM_BONES - 1), 3 * rig.num_vertices)
    theirs = _best_seconds(
        lambda: lbs(
            shapes,
            rotations.flatten(1),
            rig.template_vertices,
            rig.shape_directions,
            no_directions,
            rig.joint_regressor,
            torch.tensor(BONE_PARENTS).to(avatar.device),
            rig.skin_weights,
        ),
        avatar.device,
    )
    return f"{told}, smplx {1e3 * theirs / hands:.2f} ms, in batches of {hands}."


def _query_note(
    avatar: HandAvatar, state: HandState, counts: tuple[int, ...], num_points: int = 8192
) -> str:
    """How long occupancy takes at places around a hand: our field, and COAP's published code."""
    lower, upper = torch.stack(state.posed.vertices.aminmax(dim=0))
    places = torch.rand(num_points, 3, generator=torch.Generator().manual_seed(0))
    points = lower + places.to(avatar.device) * (upper - lower)

    def microseconds(query: Callable[[Tensor], object], count: int) -> float:
        """For a place, with so many at a time."""
        pieces = points.split(count)
        spent = _best_seconds(lambda: [query(piece) for piece in pieces], avatar.device, tries=3)
        return 1e6 * spent / num_points

    ours = microseconds(partial(avatar.occupancy, state.codes), num_points)
    reference = partial(avatar.occupancy.plain, state.codes)
    plain = min(microseconds(reference, count) for count in counts)
    told = (
        f"Occupancy at {num_points} places in the box around a hand: {ours:.2f} microseconds a "
        f"place, the plain reference {plain:.2f}"
    )
    query = published_coap_query(state.codes.boxes)
    if isinstance(query, str):
        return f"{told}; {query}."
    theirs = min(microseconds(query, count) for count in counts)
    return (
        f"{told}, COAP's published query {theirs:.2f} with the same boxes, the best of pieces of "
        f"{list(counts)} places."
    )


def _best_seconds(work: Callable[[], Any], device: torch.device, tries: int = 5) -> float:
    spent = []
    for _ in range(tries):
        begin = _now(device)
        work()
        spent.append(_now(device) - begin)
    return min(spent)
