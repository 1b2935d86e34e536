"""The skin's detail: a texture over the albedo's codes, from the training pictures.

After the appearance is learned, every pixel of the hand is rendered once; its light, its albedo
and its place on the chart stay. A step then costs a look into the texture and the losses, so that
hundreds of them fit into a minute.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.evaluate.metrics import ssim_map
from handavatar.evaluate.perceptual import PerceptualLoss
from handavatar.field.anchors import Neighbours, nearest_anchors
from handavatar.field.texture import DetailTexture, detailed, texture_at
from handavatar.geometry.cameras import project
from handavatar.geometry.meshes import face_cross_products
from handavatar.geometry.rotations import invert_rigid
from handavatar.jobs.finite import require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import unbroken
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState, named_tensors
from handavatar.jobs.threads import mapped
from handavatar.render.chart import texels_of
from handavatar.render.rasterize import Fragments, covered_pixels, interpolate, rasterize
from handavatar.train.appearance import SeenSamples
from handavatar.train.losses import color_loss
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)
from handavatar.train.unwrap import UnwrapView, known_numbers, unwrap_pictures

PATCH = 64
"""Pixels along a side of what a step compares."""
_PATCHES = 2
_COVERED = 0.98
"""Pixels that the hand covers by more, in mask and rendering, are learned from."""
_DARKEST = 0.02
"""Colours are not taken to be darker where their logarithm is asked for."""
_SMALLEST_PATCH = 16
_LARGEST_GAP = 0.01
"""Of the distance to the camera, between mesh and occupancy; more is another surface."""
_FINE = 5e-3
"""Metres on the skin by which what is unwrapped is blurred, to take away what is coarser."""
_AT_ONCE = 32768
_FADE = 8
"""Passes of a mean over 5 x 5 texels by which what was seen runs out into what was not."""
_LEVELS = (2, 4)
"""What is learned on top of what was unwrapped is a sum of textures so many times coarser: single
texels, which few pixels see, would learn noise."""
_RATE, _DECAY = 1e-3, 0.1
_SSIM_WEIGHT = 0.2
_ROUGHNESS_WEIGHT = 0.02
_SEEN = 0.05
"""Sum of weights from which a texel counts as seen."""


@dataclass(frozen=True, eq=False)
class DetailView:
    """A training frame as the texture's steps see it, cut to the hand.

    Attributes:
        truth: the picture; grey where nothing is known of it.
        is_known: pixels that are learned from; only they have what follows, row by row.
        albedo: without the texture.
        light: illumination.
        places: on the chart, (u, v) of what each pixel shows.
        top: row of the first pixel in the frame.
        left: its column.
        gain: of the picture's red, green and blue, as in :class:`Frame`.
    """

    truth: UInt8[Tensor, "height width 3"]
    is_known: Bool[Tensor, "height width"]
    albedo: Float[Tensor, "known 3"]
    light: Float[Tensor, "known"]
    places: Float[Tensor, "known 2"]
    top: int
    left: int
    gain: Float[Tensor, "3"]

    @property
    def colors(self) -> Float[Tensor, "height width 3"]:
        """The picture's colours at the capture's average exposure, as :attr:`Frame.colors`."""
        return self.truth.float() / 255 / self.gain

    def picture(
        self, values: Float[Tensor, "known channels"]
    ) -> Float[Tensor, "height width channels"]:
        """Values of the known pixels where they are; zero elsewhere."""
        found = values.new_zeros(*self.is_known.shape, values.shape[-1])
        found[self.is_known] = values
        return found


@dataclass(frozen=True, eq=False)
class LearnedDetail:
    """What :func:`learn_detail` tells beside the texture that it leaves in the avatar.

    Attributes:
        seen: how well the frames saw each texel, a sum of weights; 0 where none did, and beside
            the chart.
        seen_share: of the skin's area that some frame saw.
    """

    seen: Float[Tensor, "size size"]
    seen_share: float


@torch.no_grad()
def find_detail_views(
    avatar: HandAvatar, frames: Sequence[Frame], seen: SeenSamples, progress: Progress = SILENT
) -> list[DetailView]:
    """Every pixel that the hand covers, in every frame, without a march along its ray.

    The posed mesh says where the pixels' places are. The light, and how far beside the mesh the
    occupancy ends, are those of the nearest pixels in ``seen``; the albedo's codes are decoded at
    the vertices, which are closer to each other than the anchors.

    Args:
        avatar: with a texture, which plays no part.
        frames: of training, their poses as training sees them.
        seen: pixels of the same frames, of pictures of any size.
        progress: told how many frames are done.
    """
    vertices = avatar.rig.template_vertices
    near = nearest_anchors(avatar.anchors.positions(vertices), vertices)
    pieces = zip(near.indices.split(_AT_ONCE), near.weights.split(_AT_ONCE), strict=True)
    albedo = torch.cat([avatar.albedo(Neighbours(*piece)) for piece in pieces])
    light = light_of_pixels(avatar, seen)
    owners = seen.frames[seen.starts[:-1]]

    def view_of(number: int) -> DetailView:
        mine = owners == number
        return _view_of(avatar, frames[number], albedo, seen.points[mine], light[mine])

    return mapped(view_of, range(len(frames)), progress=progress, tidies=True)


@torch.no_grad()
def light_of_pixels(avatar: HandAvatar, seen: SeenSamples) -> Float[Tensor, "pixels"]:
    """Illumination of the pixels in ``seen``, as the avatar has it now."""
    total = torch.zeros_like(seen.alpha)
    ray = torch.arange(len(total), device=total.device).repeat_interleave(seen.starts.diff())
    for start in range(0, len(ray), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        light = avatar.illumination(
            seen.rotations[seen.frames[part]],
            Neighbours(seen.neighbours.indices[part], seen.neighbours.weights[part]),
            seen.directed[part],
            seen.normals[part],
            seen.light[part].float(),
            seen.clips[seen.frames[part]],
        )
        total.index_add_(0, ray[part], seen.weights[part] * light)
    return total / seen.alpha


def _view_of(
    avatar: HandAvatar,
    frame: Frame,
    albedo: Float[Tensor, "vertices 3"],
    seen: Float[Tensor, "pixels 3"],
    light: Float[Tensor, "pixels"],
) -> DetailView:
    """A view from the albedo at the vertices, and pixels whose place and light are known."""
    pose, camera = frame.pose.to(avatar.device), frame.camera.to(avatar.device)
    posed = avatar.personal(pose).posed(pose)
    vertices, faces = posed.vertices, avatar.rig.faces
    # The wrist's cut hides what is behind it and has no place on the chart.
    whole = rasterize(posed.sealed_vertices, avatar.rig.sealed_faces, camera)
    is_known = ((frame.alpha > _COVERED) & frame.known).to(avatar.device) & (len(seen) > 0)
    is_known &= whole.mask & (whole.face_index < len(faces))
    rows, columns = is_known.nonzero().unbind(-1)
    top, left = (int(v.min()) if len(v) else 0 for v in (rows, columns))
    bottom, right = (int(v.max()) + 1 if len(v) else 1 for v in (rows, columns))
    window = (slice(top, bottom), slice(left, right))
    # A copy: a window would hold all of the picture that it is cut from.
    is_known = is_known[window].clone()
    places, lights = light.new_zeros(len(rows), 2), light.new_zeros(len(rows))
    fragments = Fragments(*(value[window] for value in vars(whole).values()))
    values = torch.cat([vertices, albedo], dim=-1)
    surface = interpolate(
        replace(fragments, face_index=fragments.face_index.clamp_max(len(faces) - 1)), faces, values
    )
    surface = surface[is_known]
    if len(rows):
        hits = surface[:, :3]
        around = nearest_anchors(seen, hits, min(4, len(seen)))
        # How far beyond the mesh the pixels in ``seen`` end, along their rays.
        eye = invert_rigid(camera.camera_from_world)[:3, 3]
        pixels, depths = project(camera, seen)
        x, y = pixels.long().unbind(-1)
        x, y = x.clamp(0, camera.width - 1), y.clamp(0, camera.height - 1)
        beyond = depths / whole.depth[y, x] - 1
        beyond = torch.where(beyond.abs() < _LARGEST_GAP, beyond, 0.0)
        values = around.interpolated(torch.stack([light, beyond], dim=-1))
        lights = values[:, 0]
        points = eye + (hits - eye) * (1 + values[:, 1:])
        near = nearest_anchors(avatar.anchors.positions(vertices), points)
        places = _texture_of(avatar).places(vertices, points, near)
    return DetailView(
        truth=frame.shown[window].clone().to(avatar.device),
        is_known=is_known,
        albedo=surface[:, 3:].half(),
        light=lights.half(),
        places=places,
        top=top,
        left=left,
        gain=frame.gain.to(avatar.device),
    )


def learn_detail(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    seen: SeenSamples,
    size: int,
    steps: int,
    perceptual: PerceptualLoss,
    perceptual_weight: float,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> LearnedDetail:
    """Gives the avatar a texture: unwrapped from the frames, then learned on patches.

    Nothing else of the avatar changes. The same seed gives the same bits on a CPU.

    Args:
        avatar: whose appearance is learned; a texture that it has is replaced.
        frames: of training, their poses as training sees them.
        seen: pixels of the same frames, of pictures of any size.
        size: texels along a side.
        steps: on patches; 0 leaves what was unwrapped.
        perceptual: beside the colour loss and SSIM.
        perceptual_weight: of it.
        seed: of the patches.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.

    Departs: the paper has no texture.
    """
    count = len(frames)
    seconds = {"views": 0.2 * count, "unwrapping": 0.3 * count, "detail": 0.06 * steps}
    parts = progress.stages(seconds)
    texture = avatar.give_texture(size)
    views = find_detail_views(avatar, frames, seen, parts["views"])
    unwrapped = unwrap_frames(avatar, frames, views, parts["unwrapping"])
    learned = learn_texels(
        unwrapped.residual,
        views,
        steps,
        perceptual,
        perceptual_weight,
        seed,
        parts["detail"],
        kept,
    )
    with torch.no_grad():
        texture.texels.copy_(faded(learned, unwrapped.seen))
    return LearnedDetail(unwrapped.seen, unwrapped.seen_share)


@dataclass(frozen=True, eq=False)
class UnwrappedTexture:
    """What the frames say, as pictures on the chart.

    Attributes:
        residual: logarithm of what multiplies the albedo; beside the chart its nearest texel's.
        seen: as in :class:`LearnedDetail`.
        seen_share: of the skin's area that some frame saw.
    """

    residual: Float[Tensor, "size size 3"]
    seen: Float[Tensor, "size size"]
    seen_share: float


@torch.no_grad()
def unwrap_frames(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    views: list[DetailView],
    progress: Progress = SILENT,
) -> UnwrappedTexture:
    """Unwraps the frames onto the chart of the avatar's texture.

    Args:
        avatar: with a texture.
        frames: of training.
        views: of the same frames.
        progress: told how far it is.
    """
    parts = progress.stages({"unwrapping": 1.0, "medians": 1.0})
    texture = _texture_of(avatar)
    rig, size = avatar.rig.to("cpu"), texture.size
    corners = texture.corners.cpu()
    # Three texture coordinates for each face are as good as the chart's own.
    chart = replace(
        rig,
        uv_coordinates=corners.flatten(0, 1),
        uv_faces=torch.arange(3 * len(corners)).view(-1, 3),
    )
    texels = texels_of(chart, size)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv_areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).abs() / 2
    pictures = mapped(
        lambda number: _unwrap_view(avatar, frames[number], views[number]),
        range(len(views)),
        progress=parts["unwrapping"],
        tidies=True,
    )
    found = unwrap_pictures(pictures, rig.faces, texels, corners, parts["medians"])
    residual = texels.filled(found.residual * (found.seen / (found.seen + _SEEN))[:, None])
    residual = residual * believed_share(residual, pictures)
    seen = torch.zeros(size, size)
    seen[texels.rows, texels.columns] = found.seen
    on_skin = face_cross_products(rig.template_vertices, rig.faces).norm(dim=-1)
    area = (on_skin / uv_areas.clamp_min(1e-12))[texels.faces]
    share = float((area * (found.seen > _SEEN)).sum() / area.sum())
    return UnwrappedTexture(residual.to(avatar.device), seen.to(avatar.device), share)


def _texture_of(avatar: HandAvatar) -> DetailTexture:
    if avatar.texture is None:
        raise ValueError("the avatar has no texture: give it one first (give_texture)")
    return avatar.texture


def _unwrap_view(avatar: HandAvatar, frame: Frame, view: DetailView) -> UnwrapView:
    pose = frame.pose.to(avatar.device)
    vertices = avatar.personal(pose).posed(pose).vertices.cpu()
    height, width = view.is_known.shape
    truth, is_known = view.colors.cpu(), view.is_known.cpu()
    rendered = view.picture(view.albedo.float() * view.light.float()[:, None]).cpu()
    wanted = truth.clamp_min(_DARKEST).log() - rendered.clamp_min(_DARKEST).log()
    grey = truth.mean(-1)
    # What lies beside the known, the wall or a grey of ours, makes no picture sharper.
    inner = is_known[1:-1, 1:-1] & is_known[:-2, 1:-1] & is_known[2:, 1:-1]
    inner = inner & is_known[1:-1, :-2] & is_known[1:-1, 2:]
    curved = (
        4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    )
    sharpness = float(curved.abs()[inner].mean()) if bool(inner.any()) else 0.0
    camera = frame.camera.to("cpu")
    _, depths = project(camera, vertices)
    sigma = _FINE * camera.focal[0] / float(depths.mean())
    pixel = camera.width / 256
    return UnwrapView(
        residual=fine_part(wanted, is_known, sigma)[is_known],
        places=view.places.cpu(),
        is_known=is_known,
        camera=camera.cropped(float(view.left), float(view.top), float(width), float(height)),
        vertices=vertices,
        sharpness=sharpness,
        fit_error=outline_error(vertices, avatar.rig.to("cpu").faces, frame) / pixel,
        pixel=pixel,
    )


def believed_share(residual: Float[Tensor, "size size 3"], views: list[UnwrapView]) -> float:
    """By how much unwrapped texels are to be multiplied so that they fit all pictures best.

    Less than one where frames disagree: half of the amplitude of a line that is now here and now
    there is less wrong than all of it.

    Args:
        residual: what was unwrapped.
        views: what it was unwrapped from.
    """
    product = square = 0.0
    for view in views:
        found = texture_at(residual, view.places).double()
        product += float((found * view.residual).sum())
        square += float(found.square().sum())
    return min(max(product / square, 0.0), 1.0) if square > 0 else 0.0


def fine_part(
    values: Float[Tensor, "height width channels"],
    is_known: Bool[Tensor, "height width"],
    sigma: float,
) -> Float[Tensor, "height width channels"]:
    """A picture less its blurred self; only known pixels count, and others are zero.

    What is coarser, the albedo's codes have learned from all frames; what of it differs between
    frames is error of the light.

    Args:
        values: a picture.
        is_known: pixels that count.
        sigma: of the Gaussian blur, pixels.
    """
    steps = torch.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    weights = torch.exp(-0.5 * (steps / max(sigma, 1e-3)).square())
    known = is_known[..., None].to(values)
    both = torch.cat([values * known, known], dim=-1).movedim(-1, 0)[:, None]
    radius = len(steps) // 2
    both = functional.conv2d(both, weights[None, None, None], padding=(0, radius))
    both = functional.conv2d(both, weights[None, None, :, None], padding=(radius, 0))
    total = both[:, 0].movedim(0, -1)
    return (values - total[..., :-1] / total[..., -1:].clamp_min(1e-6)) * known


def outline_error(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], frame: Frame
) -> float:
    """Mean distance between the outlines of a posed mesh and of a frame's mask, pixels.

    The area between the two over the length of the mask's, both of the known pixels alone.

    Args:
        vertices: metres, world.
        faces: of the mesh.
        frame: whose mask, known pixels and camera.
    """
    covered = covered_pixels(vertices, faces, frame.camera.to("cpu"))
    mask, known = frame.mask.cpu(), frame.known.cpu()
    between_rows = (mask[1:] != mask[:-1]) & known[1:] & known[:-1]
    between_columns = (mask[:, 1:] != mask[:, :-1]) & known[:, 1:] & known[:, :-1]
    length = int(between_rows.sum() + between_columns.sum())
    return int(((covered != mask) & known).sum()) / max(length, 1)


def learn_texels(
    start: Float[Tensor, "size size 3"],
    views: list[DetailView],
    steps: int,
    perceptual: PerceptualLoss,
    perceptual_weight: float,
    seed: int,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> Float[Tensor, "size size 3"]:
    """Texels that make patches look like the photographs.

    Args:
        start: residuals to begin with.
        views: of the training frames.
        steps: each sees a few patches.
        perceptual: beside the colour loss and SSIM.
        perceptual_weight: of it.
        seed: of the patches.
        progress: told the steps done.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.
    """
    views = [view for view in views if bool(view.is_known.any())]
    if not views or steps == 0:
        return start
    size = len(start)
    levels = [
        torch.zeros(max(size // coarser, 1), max(size // coarser, 1), 3, device=start.device)
        for coarser in _LEVELS
    ]
    for level in levels:
        level.requires_grad_(True)
    optimizer = torch.optim.Adam(levels, lr=_RATE, betas=(0.9, 0.99))
    done = 0
    if (begun := kept.read()) is not None:
        with torch.no_grad():
            for number, level in enumerate(levels):
                level.copy_(begun.tensors[f"level.{number}"])
        restore_optimizer(optimizer, named_tensors(begun.tensors, "adam."), begun.facts["adam"])
        done = int(begun.facts["step"])

    def state() -> WorkState:
        tensors = {f"level.{number}": level for number, level in enumerate(levels)}
        tensors |= {f"adam.{name}": v for name, v in optimizer_tensors(optimizer).items()}
        return WorkState(tensors, {"step": done, "adam": optimizer_options(optimizer)})

    progress.skip(done, steps)
    with kept.kept(state) as now_and_then:
        for step in range(done + 1, steps + 1):
            with unbroken():
                figures = _texel_step(
                    start,
                    views,
                    levels,
                    optimizer,
                    perceptual,
                    perceptual_weight,
                    seed,
                    step,
                    steps,
                )
                done = step
            now_and_then()
            progress(step, steps, **figures)
    with torch.no_grad():
        return start + sum((_enlarged(level, size) for level in levels), torch.zeros_like(start))


def _texel_step(
    start: Float[Tensor, "size size 3"],
    views: list[DetailView],
    levels: list[Tensor],
    optimizer: torch.optim.Optimizer,
    perceptual: PerceptualLoss,
    perceptual_weight: float,
    seed: int,
    step: int,
    steps: int,
) -> dict[str, float]:
    """One optimiser step on a few patches; returns its figures."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    for group in optimizer.param_groups:
        group["lr"] = _RATE * _DECAY ** ((step - 1) / steps)
    optimizer.zero_grad(set_to_none=True)
    loss = start.new_zeros(())
    squared = 0.0
    for _ in range(_PATCHES):
        view = views[int(torch.randint(len(views), (), generator=generator))]
        window = _window(view, generator)
        found, truth = _patch(view, window, start, levels)
        loss = loss + _patch_loss(found, truth, perceptual, perceptual_weight) / _PATCHES
        squared += float((found.detach() - truth).square().mean()) / _PATCHES
    loss = loss + _ROUGHNESS_WEIGHT * levels[0].square().mean()
    loss.backward()
    optimizer.step()
    figures = {"loss": float(loss.detach()), "psnr": -10 * math.log10(max(squared, 1e-10))}
    require_finite(figures, f"detail, step {step}")
    return figures


def _window(view: DetailView, generator: torch.Generator) -> tuple[slice, slice]:
    """A square around a known pixel, inside the view."""
    known = view.is_known.nonzero()
    middle = known[int(torch.randint(len(known), (), generator=generator))].tolist()
    sides = []
    for at, extent in zip(middle, view.is_known.shape, strict=True):
        side = min(PATCH, extent)
        low = min(max(at - side // 2, 0), extent - side)
        sides.append(slice(low, low + side))
    return sides[0], sides[1]


def _patch(
    view: DetailView,
    window: tuple[slice, slice],
    start: Float[Tensor, "size size 3"],
    levels: list[Tensor],
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
    """The picture with the texture, and the photograph; the same where nothing is known."""
    is_known = view.is_known[window]
    numbers = known_numbers(view.is_known)[window][is_known]
    places = view.places[numbers]
    residual = texture_at(start, places)
    for level in levels:
        residual = residual + texture_at(level, places)
    albedo = detailed(view.albedo[numbers].float(), residual)
    truth = view.colors[window]
    color = albedo * view.light[numbers].float()[:, None]
    return truth.masked_scatter(is_known[..., None], color), truth


def _patch_loss(
    found: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    perceptual: PerceptualLoss,
    perceptual_weight: float,
) -> Float[Tensor, ""]:
    loss = color_loss(found.flatten(0, 1), truth.flatten(0, 1))
    if min(found.shape[:2]) >= _SMALLEST_PATCH:
        loss = loss + _SSIM_WEIGHT * (1 - ssim_map(found, truth).mean())
        loss = loss + perceptual_weight * perceptual(found[None], truth[None])[0]
    return loss


@torch.no_grad()
def faded(
    texels: Float[Tensor, "size size 3"], seen: Float[Tensor, "size size"]
) -> Float[Tensor, "size size 3"]:
    """The texels as learned where frames saw them; elsewhere they fade to zero.

    Args:
        texels: residuals.
        seen: how well each was seen, on the chart; 0 beside it.
    """
    share = seen / (seen + _SEEN)
    weight, total = share, texels * share[..., None]
    for _ in range(_FADE):
        weight, total = _blurred(weight[..., None])[..., 0], _blurred(total)
    around = total / (weight + 0.05)[..., None]
    return texels * share[..., None] + around * (1 - share)[..., None]


def _blurred(values: Float[Tensor, "size size channels"]) -> Float[Tensor, "size size channels"]:
    return functional.avg_pool2d(
        values.movedim(-1, 0)[None], 5, stride=1, padding=2, count_include_pad=False
    )[0].movedim(0, -1)


def _enlarged(level: Float[Tensor, "small small 3"], size: int) -> Float[Tensor, "size size 3"]:
    whole = functional.interpolate(
        level.movedim(-1, 0)[None], (size, size), mode="bilinear", align_corners=False
    )
    return whole[0].movedim(0, -1)
