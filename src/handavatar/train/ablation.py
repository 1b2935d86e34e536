"""The ablation: one part after the other, on the same frames, with the same budget and seeds.

The core of ``handavatar bench --table ablation``. Geometry is fitted once per capture and kind of
shape, from masks alone; what shades it is trained anew for every row and seed, on samples that
stay, as the warm steps of a training do. Rows of one geometry therefore see the very same samples,
weights and pixels, and differ in nothing but the part that their name says.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Tensor, nn

from handavatar.avatar import START_LIGHT, HandAvatar, HandState, RenderSettings
from handavatar.capture.frames import FITTED_SIDE, Capture, Frame, read_capture
from handavatar.capture.synthetic import crop_camera
from handavatar.evaluate.baselines import judged_frame
from handavatar.evaluate.metrics import (
    JudgedFrame,
    albedo_psnr,
    masked_flip,
    masked_psnr,
    masked_ssim,
    mean_color,
    paper_scores,
    shading_correlation,
)
from handavatar.evaluate.perceptual import PerceptualLoss, perceptual_loss
from handavatar.evaluate.run import held_out_poses, true_picture
from handavatar.field.anchors import Neighbours
from handavatar.field.layers import MLP
from handavatar.field.shading import (
    CODE_SPREAD,
    CODE_WIDTH,
    AlbedoField,
    CueSet,
    IlluminationField,
    OrientedCues,
    PaperCues,
    PlainCues,
    TracedCues,
)
from handavatar.geometry.cameras import Camera, Rays, pixel_centers, rays_through_pixels
from handavatar.geometry.colors import eight_bits
from handavatar.hand.rig import ShapedHand
from handavatar.jobs.files import write_aside
from handavatar.jobs.finite import require_finite
from handavatar.render.volume import composite_sparse
from handavatar.train.appearance import (
    SeenSamples,
    chosen_samples,
    find_seen_samples,
    with_hidden_poses,
)
from handavatar.train.loop import (
    METHODS,
    Method,
    TrainOptions,
    begin_training,
    corrected_frames,
    fit_geometry,
    training_frames,
)
from handavatar.train.losses import color_loss
from handavatar.train.muon import Muon
from handavatar.train.pretraining import wide_and_narrow
from handavatar.train.sky import place_directions

Shape = Literal["coefficients", "personal", "corrected"]
"""Shape by coefficients; personal offsets, poses as tracked; offsets, and poses drawn to masks."""

_TURNED_VIEWS = 4
_TURNED_POSES = 2
_FACING = 0.3
"""Cosine to the camera from which on an anchor counts as seen."""
_NEAR = 1.5e-3
"""Metres between an anchor and where its ray ends."""


class NoOffsets(nn.Module):
    """The shape that the coefficients give, and nothing else."""

    def forward(
        self, rest: ShapedHand, rotations: Float[Tensor, "bones 3"]
    ) -> Float[Tensor, "vertices 3"]:
        """Zeros, metres."""
        return torch.zeros_like(rest.rest_vertices)


@dataclass(frozen=True, eq=False)
class Samples:
    """What a shading may look at, sample by sample; the fields are those of ``SeenSamples``."""

    neighbours: Neighbours
    directed: Float[Tensor, "samples bones"]
    normals: Float[Tensor, "samples 3"]
    light: Float[Tensor, "samples directions"]
    rotations: Float[Tensor, "samples bones 3"]


class SplitShading(nn.Module):
    """Albedo times illumination."""

    def __init__(
        self,
        anchors: Float[Tensor, "anchors 3"],
        cues: CueSet,
        color: Float[Tensor, "3"],
        change: Callable[[Tensor], Tensor] = lambda directed: directed,
    ) -> None:
        """Starts as one colour under one light.

        Args:
            anchors: on the template.
            cues: what the illumination sees.
            color: mean of the hand's pixels.
            change: of the directed occupancy, for controls.
        """
        super().__init__()
        self.albedo = AlbedoField(len(anchors))
        self.illumination = IlluminationField(anchors, cues)
        self.change = change
        self.pose_dropout = cues.pose_dropout
        _start(self.albedo.mlp, color / START_LIGHT)
        _start(self.illumination.mlp, torch.tensor([START_LIGHT]))

    def forward(self, samples: Samples) -> Float[Tensor, "samples 7"]:
        """Colour, albedo, illumination."""
        albedo = self.albedo(samples.neighbours)
        light = self.illumination(
            samples.rotations,
            samples.neighbours,
            self.change(samples.directed),
            samples.normals,
            samples.light,
        )[:, None]
        return torch.cat([albedo * light, albedo, light], dim=-1)


class EntangledShading(nn.Module):
    """One colour from code, place and pose: what the paper splits."""

    pose_dropout = 0.0

    def __init__(self, anchors: Float[Tensor, "anchors 3"], color: Float[Tensor, "3"]) -> None:
        """Starts as one colour."""
        super().__init__()
        field = IlluminationField(anchors, PlainCues())
        self.register_buffer("position_codes", field.position_codes)
        self.codes = nn.Parameter(CODE_SPREAD * torch.randn(len(anchors), CODE_WIDTH))
        self.mlp = MLP(CODE_WIDTH + 69, 256, 4, 3)
        _start(self.mlp, color)

    def forward(self, samples: Samples) -> Float[Tensor, "samples 7"]:
        """Colour, the same as albedo, and ones."""
        at = samples.neighbours.interpolated
        pose = samples.rotations.flatten(-2)
        places = at(self.get_buffer("position_codes"))
        color = self.mlp(torch.cat([at(self.codes), places, pose], dim=-1)).sigmoid()
        return torch.cat([color, color, torch.ones_like(color[:, :1])], dim=-1)


def _start(mlp: MLP, value: Float[Tensor, "channels"]) -> None:
    with torch.no_grad():
        mlp.output.weight.mul_(0.1)
        mlp.output.bias.copy_(torch.logit(value.clamp(0.05, 0.95)))


def _noise(directed: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(len(directed))
    return torch.rand(directed.shape, generator=generator)


def _hard(directed: Tensor) -> Tensor:
    """The softness 1 in place of 0.05; zero, where no box is, stays."""
    logits = torch.logit(directed, eps=1e-6) / 0.05
    return torch.where(directed > 0, logits.sigmoid(), 0.0)


Shading = SplitShading | EntangledShading


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        shape: of the geometry.
        make: the shading, from anchors on the template and the mean colour.
        against: the row that it is compared with, frame by frame.
    """

    shape: Shape
    make: Callable[[Tensor, Tensor], Shading]
    against: str


def _split(cues: CueSet) -> Callable[[Tensor, Tensor], Shading]:
    return lambda anchors, color: SplitShading(anchors, cues, color)


_TRACED = _split(TracedCues())
ROWS: dict[str, Row] = {
    "coefficients, entangled": Row("coefficients", EntangledShading, ""),
    "+ personal shape": Row("personal", EntangledShading, "coefficients, entangled"),
    "+ illumination": Row("personal", _split(PlainCues()), "+ personal shape"),
    "+ directed occupancy (paper)": Row("personal", _split(PaperCues()), "+ illumination"),
    "control: noise for directed": Row(
        "personal",
        lambda anchors, color: SplitShading(anchors, PaperCues(), color, _noise),
        "+ directed occupancy (paper)",
    ),
    "control: tau = 1": Row(
        "personal",
        lambda anchors, color: SplitShading(anchors, PaperCues(), color, _hard),
        "+ directed occupancy (paper)",
    ),
    "normals, poses corrected (quick)": Row(
        "corrected", _split(OrientedCues()), "+ directed occupancy (paper)"
    ),
    "traced light": Row("personal", _TRACED, "+ directed occupancy (paper)"),
    "traced light, poses corrected (best)": Row(
        "corrected", _TRACED, "+ directed occupancy (paper)"
    ),
}
"""Each names the part that it adds to the row it is compared with."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture that shadings are judged on, as samples that stay.

    Attributes:
        frame: the truth, or only its pose.
        camera: of the samples; the frame's, or one that looks the same way.
        samples: of every pixel near the hand, in the order of ``pixels``.
        pixels: their numbers in the camera's picture.
    """

    frame: Frame
    camera: Camera
    samples: SeenSamples
    pixels: Int[Tensor, "pixels"]


@dataclass(frozen=True, eq=False)
class Place:
    """Anchors as one camera sees them, along a ray through each.

    Attributes:
        samples: of these rays.
        anchors: the number of each ray's anchor.
        is_there: the ray ends at the anchor, nothing lies before it.
        num_anchors: of all that are looked at.
    """

    samples: SeenSamples
    anchors: Int[Tensor, "rays"]
    is_there: Bool[Tensor, "rays"]
    num_anchors: int


@dataclass(frozen=True, eq=False)
class FittedGeometry:
    """What all shadings of one geometry share.

    Attributes:
        avatar: its shape and decoder are fitted, its colours are not.
        frames: of training, their poses as training sees them.
        anchors: on the template.
        seen: of the training frames.
        views: the test frames.
        turned: the anchors in some test poses, each as several cameras see them.
        color: mean of the training frames' hand pixels.
        hidden: share of the sky that the hand itself takes from what each test frame shows.
    """

    avatar: HandAvatar
    frames: Sequence[Frame]
    anchors: Float[Tensor, "anchors 3"]
    seen: SeenSamples
    views: list[View]
    turned: list[list[Place]]
    color: Float[Tensor, "3"]
    hidden: list[float]


def fitted_geometry(capture: Capture, shape: Shape, method: Method, seed: int) -> FittedGeometry:
    """Fits shape, poses and decoder to the masks, and finds what each picture sees."""
    frames = training_frames(capture, method)
    method = replace(
        method,
        cues=TracedCues(),
        corrects_poses=shape == "corrected",
        outline_rounds=0 if shape == "coefficients" else method.outline_rounds,
    )
    options = TrainOptions(capture.folder, method="best", seed=seed, device="cpu")
    training = begin_training(capture, frames, method, options)
    avatar = training.avatar
    if shape == "coefficients":
        avatar.shape = NoOffsets()  # type: ignore[assignment]
    fit_geometry(training, frames, method, seed)
    frames = corrected_frames(training, frames)
    settings = RenderSettings(num_samples=method.num_samples)
    seen = find_seen_samples(avatar, frames, settings, method.warm_stride)
    seen = place_directions(avatar, frames, seen, seed)
    tests = [capture.frame(index).binned(FITTED_SIDE) for index in capture.split("test")]
    tests = _aligned(avatar, tests)
    views = [view_of_frame(avatar, frame, frame.camera, settings) for frame in tests]
    chosen = torch.linspace(0, len(tests) - 1, _TURNED_POSES).round().long().tolist()
    return FittedGeometry(
        avatar,
        frames,
        avatar.anchors.positions(avatar.rig.template_vertices),
        seen,
        views,
        [_turned(avatar, tests[number], replace(settings, num_samples=256)) for number in chosen],
        mean_color((frame.colors, frame.mask) for frame in frames),
        [_hidden(view.samples, avatar) for view in views],
    )


def _aligned(avatar: HandAvatar, frames: list[Frame]) -> list[Frame]:
    """Tracked poses of test frames are drawn to their masks, as ``evaluate`` does."""
    tracked = [frame for frame in frames if frame.confidence < 1]
    if not tracked:
        return frames
    found = {
        frame.name: pose
        for frame, pose in zip(tracked, held_out_poses(avatar, tracked), strict=True)
    }
    return [replace(frame, pose=found.get(frame.name, frame.pose)) for frame in frames]


@torch.no_grad()
def view_of_frame(
    avatar: HandAvatar, frame: Frame, camera: Camera, settings: RenderSettings
) -> View:
    """All pixels near the hand, one ray each."""
    state = avatar.prepare(frame.pose)
    near = avatar.near_mesh(state, camera, settings.mask_margin).flatten().nonzero()[:, 0]
    rays = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1)[near])
    seen = _samples_along(avatar, state, rays, settings).seen
    return View(frame, camera, seen, near)


@dataclass(frozen=True, eq=False)
class _Along:
    """Samples of rays, and how far along them they lie, metres."""

    seen: SeenSamples
    depths: Float[Tensor, "samples"]


def _samples_along(
    avatar: HandAvatar, state: HandState, rays: Rays, settings: RenderSettings
) -> _Along:
    found = avatar.visible_samples(state, rays, settings)
    ones = torch.ones_like(found.weights)[:, None]
    counts = torch.bincount(found.rays, minlength=len(rays.origins))
    places = composite_sparse(found.weights, found.rays, found.points, len(rays.origins))
    alpha = composite_sparse(found.weights, found.rays, ones, len(rays.origins))
    seen = SeenSamples(
        weights=found.weights,
        directed=found.directed,
        neighbours=found.neighbours,
        normals=found.neighbours.interpolated(state.anchor_normals),
        light=found.neighbours.interpolated(state.light).half(),
        frames=torch.zeros_like(found.rays),
        starts=torch.cat([counts.new_zeros(1), counts.cumsum(0)]),
        colors=found.weights.new_zeros(len(rays.origins), 3),
        alpha=alpha[:, 0],
        points=places / alpha.clamp_min(1e-6),
        rotations=state.posed.pose.rotations[None],
        clips=found.rays.new_zeros(1),
    )
    return _Along(seen, found.depths)


@torch.no_grad()
def _turned(avatar: HandAvatar, frame: Frame, settings: RenderSettings) -> list[Place]:
    """Every fourth anchor, looked at by each of the cameras that see it."""
    state = avatar.prepare(frame.pose)
    places, normals = state.anchors[::4], state.anchor_normals[::4]
    found = []
    for number in range(_TURNED_VIEWS):
        camera = crop_camera(state.posed.vertices, frame.camera.width, number)
        rotation, translation = camera.camera_from_world.split([3, 1], dim=-1)
        offsets = places + (translation[:3, 0] @ rotation[:3])
        distances = offsets.norm(dim=-1)
        directions = offsets / distances[:, None]
        facing = ((directions * normals).sum(-1) < -_FACING).nonzero()[:, 0]
        origin = (places - offsets)[facing]
        samples = _samples_along(avatar, state, Rays(origin, directions[facing]), settings)
        ray = torch.arange(len(facing)).repeat_interleave(samples.seen.starts.diff())
        weighted = samples.depths[:, None]
        depth = composite_sparse(samples.seen.weights, ray, weighted, len(facing))[:, 0]
        is_there = (samples.seen.alpha > 0.95) & (
            (depth / samples.seen.alpha.clamp_min(1e-6) - distances[facing]).abs() < _NEAR
        )
        found.append(Place(samples.seen, facing, is_there, len(places)))
    return found


def _hidden(samples: SeenSamples, avatar: HandAvatar) -> float:
    """One minus light over what would arrive without shadows, weighted as the pixels are."""
    open_sky = (samples.normals @ avatar.illumination.directions.T).clamp_min(0).sum(-1)
    share = samples.light.float().sum(-1) / open_sky.clamp_min(1e-3)
    return 1 - float((share.clamp(0, 1) * samples.weights).sum() / samples.weights.sum())


def _rows_of(seen: SeenSamples, sample: Int[Tensor, "samples"]) -> Samples:
    return Samples(
        Neighbours(seen.neighbours.indices[sample], seen.neighbours.weights[sample]),
        seen.directed[sample],
        seen.normals[sample],
        seen.light[sample].float(),
        seen.rotations[seen.frames[sample]],
    )


def trained_shading(
    row: Row, geometry: FittedGeometry, method: Method, steps: int, seed: int
) -> Shading:
    """Trains a row's shading as the warm steps of ``quick`` would."""
    torch.manual_seed(seed)
    shading = row.make(geometry.anchors, geometry.color)
    seen, generator = geometry.seen, torch.Generator().manual_seed(seed)
    codes = [value for name, value in shading.named_parameters() if name.endswith("codes")]
    others = [value for name, value in shading.named_parameters() if not name.endswith("codes")]
    wide, narrow = wide_and_narrow(others)
    groups = [
        {"params": narrow, "lr": method.lr},
        {"params": codes, "lr": method.lr_codes},
    ]
    optimizers = [torch.optim.Adam(groups), Muon(wide, method.lr_matrices or method.lr)]
    first = [[group["lr"] for group in optimizer.param_groups] for optimizer in optimizers]
    for step in range(steps):
        factor = method.decay ** (step / steps)
        for optimizer, rates in zip(optimizers, first, strict=True):
            optimizer.zero_grad(set_to_none=True)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * factor
        pixels = torch.randint(len(seen.colors), (method.warm_pixels,), generator=generator)
        sample, ray = chosen_samples(seen, pixels)
        shown = with_hidden_poses(seen, shading.pose_dropout, generator)
        values = shading(_rows_of(shown, sample))[:, :3]
        color = composite_sparse(seen.weights[sample], ray, values, len(pixels))
        loss = color_loss(color / seen.alpha[pixels][:, None], seen.colors[pixels])
        require_finite({"loss": loss}, f"ablation, step {step + 1}")
        loss.backward()
        for optimizer in optimizers:
            optimizer.step()
    require_finite(shading.state_dict(), f"ablation, step {steps}")
    return shading


@torch.no_grad()
def shaded_view(shading: Shading, view: View) -> dict[str, Tensor]:
    """Colour, albedo, illumination and alpha of a whole picture, on black."""
    seen, camera = view.samples, view.camera
    every = torch.arange(len(seen.weights))
    counts = seen.starts.diff()
    ray = torch.arange(len(view.pixels)).repeat_interleave(counts)
    values = torch.cat([shading(_rows_of(seen, part)) for part in every.split(16384)])
    values = torch.cat([values, torch.ones_like(values[:, :1])], dim=-1)
    total = composite_sparse(seen.weights, ray, values, len(view.pixels))
    flat = total.new_zeros(camera.height * camera.width, 8).index_copy(0, view.pixels, total)
    color, albedo, light, alpha = flat.view(camera.height, camera.width, 8).split(
        [3, 3, 1, 1], dim=-1
    )
    return {"color": color, "albedo": albedo, "light": light[..., 0], "alpha": alpha[..., 0]}


@torch.no_grad()
def view_spread(shading: Shading, turned: list[list[Place]]) -> float:
    """How much the light of the same places changes when only the camera moves.

    Mean over anchors that three views or more show of the deviation of their illumination between
    views, in per cent of the mean illumination.
    """
    deviations, means = [], []
    for views in turned:
        lights = []
        for view in views:
            seen = view.samples
            ray = torch.arange(len(view.anchors)).repeat_interleave(seen.starts.diff())
            light = shading(_rows_of(seen, torch.arange(len(seen.weights))))[:, 6:]
            total = composite_sparse(seen.weights, ray, light, len(view.anchors))[:, 0]
            light = torch.full((view.num_anchors,), math.nan)
            kept = view.is_there
            light[view.anchors[kept]] = total[kept] / seen.alpha[kept]
            lights.append(light)
        stacked = torch.stack(lights)
        chosen = stacked[:, (~stacked.isnan()).sum(0) >= 3]
        mean = chosen.nanmean(0)
        deviations.append((chosen - mean).square().nanmean(0).sqrt())
        means.append(mean)
    return 100 * float(torch.cat(deviations).mean() / torch.cat(means).mean())


def judged(
    shading: Shading, geometry: FittedGeometry, capture: Capture
) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Figures of every test frame, and figures of the whole; those of the split need the truth."""
    scores = FrameScores()
    is_split_known = knows_split(capture)
    albedos, lights, true_albedos, shadings, masks = [], [], [], [], []
    for view in geometry.views:
        picture, frame = shaded_view(shading, view), view.frame
        pair = scores.add(frame, picture["color"], picture["alpha"])
        alpha = picture["alpha"].clamp_min(1e-6)
        albedos.append(picture["albedo"] / alpha[..., None])
        lights.append(picture["light"] / alpha)
        masks.append(frame.mask & pair.rendered_mask)
        if is_split_known:
            true_albedos.append(true_picture(capture, frame, "albedo"))
            shadings.append(true_picture(capture, frame, "shading"))
    whole = {}
    if is_split_known:
        whole["albedo"] = albedo_psnr(albedos, true_albedos, masks)
    if isinstance(shading, SplitShading):
        if is_split_known:
            whole["shading r"] = shading_correlation(lights, shadings, masks)
        whole["view spread %"] = view_spread(shading, geometry.turned)
    return scores.by_name, whole


def knows_split(capture: Capture) -> bool:
    """Whether the true albedo and light of its frames are there."""
    return (capture.folder / "truth" / "albedo").is_dir()


@cache
def _distance() -> PerceptualLoss:
    """Its weights, where there are any, are read once for all rows."""
    return perceptual_loss("auto")


def _column(shading: Shading, views: list[View]) -> Float[Tensor, "height width 3"]:
    parts = []
    for view in views:
        picture = shaded_view(shading, view)
        light = picture["light"][..., None].expand(-1, -1, 3)
        parts += [picture["color"], light]
    return torch.cat(parts)


def _true_column(capture: Capture, frames: list[Frame]) -> Float[Tensor, "height width 3"]:
    parts = []
    for frame in frames:
        color = frame.shown.float() / 255 * frame.alpha[..., None]
        shading = torch.zeros_like(color)
        if knows_split(capture):
            shading = true_picture(capture, frame, "shading")[..., None].expand(-1, -1, 3)
        parts += [color, shading]
    return torch.cat(parts)


class FrameScores:
    """Figures of pictures, one after the other.

    Attributes:
        by_name: masked PSNR, SSIM and FLIP, the perceptual metric by its name, and PSNR by the
            paper's protocol.
    """

    def __init__(self) -> None:
        """None yet."""
        self._distance = _distance()
        names = ("psnr", "ssim", "flip", self._distance.name, "psnr_paper")
        self.by_name: dict[str, list[float]] = {name: [] for name in names}

    def add(
        self,
        frame: Frame,
        color: Float[Tensor, "height width 3"],
        alpha: Float[Tensor, "height width"],
    ) -> JudgedFrame:
        """Judges a picture on black against a frame."""
        pair = judged_frame(frame, color, alpha)
        rendered, truth = pair.on_black()
        self.by_name["psnr"].append(masked_psnr(pair))
        self.by_name["ssim"].append(masked_ssim(pair))
        self.by_name["flip"].append(masked_flip(pair))
        self.by_name[self._distance.name].append(float(self._distance(rendered[None], truth[None])))
        self.by_name["psnr_paper"].append(paper_scores([pair]).psnr)
        return pair


def ablate(
    folder: Path,
    names: Sequence[str],
    seeds: tuple[int, ...],
    steps: int,
    finished: Callable[[], None] = lambda: None,
    pictures: Path | None = None,
) -> dict[str, Any]:
    """Some rows on one capture, as JSON takes it: ``rows`` by name and seed, ``hidden`` by frame.

    Args:
        folder: of a capture.
        names: of the rows.
        seeds: of the shadings; the geometry is fitted once.
        steps: of each shading.
        finished: called after every row and seed.
        pictures: a PNG to write: the most open, the middle and the most occluded test frame, truth
            first and then every row by the first seed, colours above illumination.
    """
    capture, method = read_capture(folder), METHODS["quick"]
    known: dict[Shape, FittedGeometry] = {}
    rows: dict[str, dict[str, Any]] = {}
    begin = time.perf_counter()
    hidden: list[float] = []
    shown: list[int] = []
    columns: dict[str, Float[Tensor, "height width 3"]] = {}
    trained: dict[tuple[Shape, Callable[[Tensor, Tensor], Shading]], str] = {}
    for name in names:
        row = ROWS[name]
        # Where poses are exact there is nothing to correct.
        shape = row.shape
        if shape == "corrected" and not capture.is_tracked:
            shape = "personal"
        if shape not in known:
            known = {kept: value for kept, value in known.items() if kept == "personal"}
            known[shape] = fitted_geometry(capture, shape, method, 0)
        hidden = known[shape].hidden
        if not columns:
            order = sorted(range(len(hidden)), key=lambda place: hidden[place])
            shown = [order[0], order[len(order) // 2], order[-1]]
            frames = [known[shape].views[n].frame for n in shown]
            columns["truth"] = _true_column(capture, frames)
        # Where nothing is corrected, two rows are the same trainings.
        same = trained.setdefault((shape, row.make), name)
        if same != name:
            rows[name], columns[name] = rows[same], columns[same]
            for _ in seeds:
                finished()
            continue
        rows[name] = {}
        for seed in seeds:
            shading = trained_shading(row, known[shape], method, steps, seed)
            scores, whole = judged(shading, known[shape], capture)
            rows[name][str(seed)] = {"frames": scores, "whole": whole}
            if seed == seeds[0]:
                columns[name] = _column(shading, [known[shape].views[n] for n in shown])
            finished()
    if pictures is not None:
        sheet = torch.cat(list(columns.values()), dim=1)
        with write_aside(pictures) as aside:
            Image.fromarray(eight_bits(sheet).numpy()).save(aside)
    return {
        "capture": folder.name,
        "steps": steps,
        "hidden": hidden,
        "seconds": round(time.perf_counter() - begin, 1),
        "rows": rows,
    }
