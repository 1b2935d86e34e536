"""The avatar: one box that turns a pose and a camera into pictures.

``HandAvatar`` receives its parts ready-made: rig, shape offsets, occupancy field, albedo and
illumination. ``prepare`` does what is needed once per pose, ``render_rays`` what is needed per
ray; training and rendering go through the same two calls.
"""

import copy
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Int
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from handavatar.edit import Edit, Paint
from handavatar.errors import (
    ArgumentError,
    HandAvatarError,
    argument,
    raise_if_refused,
    require_ranges,
)
from handavatar.field.anchors import Neighbours, nearest_anchors, place_anchors
from handavatar.field.kernels import SHORTER, Kernel, settled_kernel
from handavatar.field.occupancy import HandCodes, PairItems, PairOccupancy, decided_items
from handavatar.field.shading import (
    AlbedoField,
    CueSet,
    IlluminationField,
    PaperCues,
    cue_set,
    directed_occupancy,
)
from handavatar.field.shape import ShapeOffsets, personal_hand
from handavatar.field.texture import DetailTexture
from handavatar.geometry.cameras import (
    Camera,
    Rays,
    pixel_centers,
    project,
    rays_through_pixels,
)
from handavatar.geometry.meshes import SurfacePoints, vertex_normals
from handavatar.geometry.rotations import invert_rigid
from handavatar.geometry.tensors import require_tensor, require_type
from handavatar.hand.parts import finer_rig
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import RIG_ARRAYS, PosedHand, Rig, ShapedHand
from handavatar.hand.rigs import find_rig
from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import find_not_finite, require_finite
from handavatar.jobs.threads import mapped
from handavatar.render.chart import charted
from handavatar.render.rasterize import covered_pixels
from handavatar.render.sampling import depths_along, intervals_through_boxes
from handavatar.render.silhouette import soft_silhouette
from handavatar.render.skylight import even_directions, sky_light
from handavatar.render.volume import composite_sparse, visibility
from handavatar.replay import Replay

if TYPE_CHECKING:
    from handavatar.field.fused import Decided

SCHEMA = 5
START_LIGHT = 0.65
"""Illumination of an untrained avatar: room to grow brighter and darker."""
_FEW_ON_A_GPU = 1 << 18
"""Samples that a GPU evaluates all at once in less time than it takes to choose among them."""
_LARGEST = 1e8
"""Of the weights of an avatar file."""
_OF_LICENSED_RIG = ("illumination.position_codes",)
"""Weights that a licensed rig's arrays could be read from; they follow from the rig."""


def _stored_rig(name: str, tensors: dict[str, Tensor]) -> Rig:
    sets = {key[4:]: value for key, value in tensors.items() if key.startswith("set.")}
    arrays: dict[str, Any] = {key: tensors[f"rig.{key}"] for key in RIG_ARRAYS}
    if "rig.pose_directions" in tensors:
        arrays["pose_directions"] = tensors["rig.pose_directions"]
    return Rig(name=name, vertex_sets=sets, **arrays)


def _stored_part_points(tensors: dict[str, Tensor]) -> SurfacePoints | None:
    """None in files of versions that drew them anew at every load."""
    if "parts.corners" not in tensors:
        return None
    return SurfacePoints(tensors["parts.corners"].long(), tensors["parts.barycentric"])


def _stored_edit(about: dict[str, Any], tensors: dict[str, Tensor]) -> Edit:
    red, green, blue = (float(value) for value in about["albedo_shift"])
    bones = tuple(int(bone) for bone in about["lifted_bones"])
    paint = None
    if "paint.colors" in tensors:
        paint = Paint(tensors["paint.colors"], tensors["paint.opacity"])
    light = about.get("light")
    return Edit(
        float(about["light_gain"]),
        (red, green, blue),
        bones,
        paint,
        None if light is None else int(light),
    )


_DAMAGE = (KeyError, IndexError, RuntimeError, TypeError, ValueError, OverflowError)
"""What a header or tensors that do not belong together make of reading them."""
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("rig", "rig_sha256", "cues"), (str,)),
    **dict.fromkeys(("margin", "softness", "sharpness"), (int, float)),
    **dict.fromkeys(("edit", "info"), (dict,)),
    "rounds": (int,),
}
_VIEW = {"camera_from_world": (4, 4), "rotations": (NUM_BONES, 3), "translation": (3,)}
_MAX_BYTES = 1 << 30
"""Of an avatar file; 10 to 100 MB are usual."""
_MAX_DIRECTIONS = 1024
_MAX_LIGHTS = 64


def rendering_seconds(width: int, height: int) -> float:
    """How long a picture of so many pixels usually takes on two cores: what progress expects."""
    return 1e-4 * width * height + 0.3


def chosen_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one.

    Args:
        name: ``auto``, ``cpu``, ``cuda``, or one of several GPUs such as ``cuda:1``.

    Raises:
        ArgumentError: there is no such device, or it is of a kind that nothing here runs on.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        name = "cuda" if count else "cpu"
    found = re.fullmatch(r"cpu|cuda(?::(\d{1,3}))?", name)
    if found is None:
        raise ArgumentError(
            "device",
            name[:20],
            "auto, cpu, cuda, or cuda:N for one of several GPUs (NVIDIA's; on others use cpu)",
        )
    if name != "cpu" and not count:
        raise ArgumentError(
            "device", f"{name}, but no CUDA device is visible to torch", "", "use `device='cpu'`"
        )
    if found[1] and int(found[1]) >= count:
        raise ArgumentError("device", name, f"one of the {count} that torch sees, from cuda:0")
    return torch.device(name)


class CheckpointError(HandAvatarError):
    """A file of weights that cannot be used: which, what is wrong with it, what to do."""


@dataclass(frozen=True)
class RenderSettings:
    """How rays are evaluated.

    Attributes:
        num_samples: samples per ray (the paper's N^q).
        smallest_weight: samples that weigh less in their pixel are not shaded; the error of a
            pixel is at most the sum of what it skips.
        stop: a ray ends where less than this share of light is left; the error is at most that.
        coarse: every so many samples are evaluated first, the others only near the hand; 1
            evaluates all.
        refine_above: an interval is near the hand if the soft occupancy at one of its ends is
            larger. Unlike the occupancy, it still tells near from far some millimetres off the
            hand. Validated, not proven: what is much thinner than an interval may be missed.
        group: coarse samples evaluated at a time along the ray before it may end.
        mask_margin: only pixels within this share of the picture's width of the posed mesh are
            looked at; 6 pixels of 256. The occupancy of a trained field ends some millimetres
            off the mesh; infinity looks at all pixels.
        edge_rays: at the hand's outline a pixel is the mean of so many rays in both directions; a
            single one says all or nothing of a pixel that the hand covers in part.
        rays_at_once: bounds the memory; a GPU takes 32 times as many.
        kernel: torch's operations or Triton's kernels for rays and occupancy; see
            :func:`handavatar.field.kernels.chosen_kernel`. With shorter factors, samples that can
            be seen are evaluated once more with long ones.

    Raises:
        ArgumentError: if a number is out of its range.
    """

    num_samples: int = 64
    smallest_weight: float = 1e-4
    stop: float = 1e-4
    coarse: int = 4
    refine_above: float = 0.12
    group: int = 4
    mask_margin: float = 6 / 256
    edge_rays: int = 2
    rays_at_once: int = 4096
    kernel: Kernel = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            num_samples=(1, 4096),
            coarse=(1, 4096),
            group=(1, 4096),
            edge_rays=(1, 64),
            rays_at_once=(1, 10**9),
            mask_margin=(0, math.inf),
            smallest_weight=(0, 1),
            stop=(0, 1),
            refine_above=(0, 1),
        )


EXACT = RenderSettings(smallest_weight=1e-7, stop=1e-7, coarse=1, mask_margin=math.inf)
"""Leaves out only what provably weighs next to nothing: samples of less than 1e-7, what lies behind
such darkness, and what no part box holds, where there is no hand by definition."""


@dataclass(frozen=True, eq=False)
class HandState:
    """Everything about one pose that all rays share.

    Attributes:
        posed: the personal hand in the world.
        offsets: of its rest vertices, metres.
        codes: for the occupancy field.
        anchors: world positions of the anchors, metres.
        anchor_normals: unit, world.
        light: what a light in each of the illumination's directions brings to each anchor.
    """

    posed: PosedHand
    offsets: Float[Tensor, "vertices 3"]
    codes: HandCodes
    anchors: Float[Tensor, "anchors 3"]
    anchor_normals: Float[Tensor, "anchors 3"]
    light: Float[Tensor, "anchors directions"]


@dataclass(frozen=True, eq=False)
class VisibleSamples:
    """Samples that weigh something in their ray.

    Attributes:
        weights: in the ray; with gradient where gradients are enabled.
        rays: ray of each sample, ascending.
        depths: metres along the ray.
        points: where they lie in the world, metres.
        directed: directed soft occupancy, without gradient.
        neighbours: nearest anchors.
    """

    weights: Float[Tensor, "kept"]
    rays: Int[Tensor, "kept"]
    depths: Float[Tensor, "kept"]
    points: Float[Tensor, "kept 3"]
    directed: Float[Tensor, "kept bones"]
    neighbours: Neighbours


@dataclass(frozen=True, eq=False)
class _Weighed:
    """:class:`VisibleSamples` before their anchors are looked for."""

    weights: Float[Tensor, "kept"]
    rays: Int[Tensor, "kept"]
    depths: Float[Tensor, "kept"]
    points: Float[Tensor, "kept 3"]
    directed: Float[Tensor, "kept bones"]


_Found = tuple[
    Int[Tensor, "kept"], Float[Tensor, "kept 3"], Float[Tensor, "kept"], Float[Tensor, "kept bones"]
]


@dataclass(frozen=True, eq=False)
class RayValues:
    """What each ray sees. Channels that nothing covers are zero.

    Attributes:
        color: albedo times illumination, edits included, not clipped.
        albedo: RGB in [0, 1], times alpha.
        illumination: scalar, times alpha.
        normal: world normals, times alpha.
        depth: metres along the ray, times alpha.
        alpha: share of the ray that the hand covers.
    """

    color: Float[Tensor, "rays 3"]
    albedo: Float[Tensor, "rays 3"]
    illumination: Float[Tensor, "rays"]
    normal: Float[Tensor, "rays 3"]
    depth: Float[Tensor, "rays"]
    alpha: Float[Tensor, "rays"]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered view on black; see :class:`RayValues` for the channels.

    Colours are in the space of the capture's images (sRGB as stored, divided by 255).
    """

    color: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width 3"]
    illumination: Float[Tensor, "height width"]
    normal: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    alpha: Float[Tensor, "height width"]


class HandAvatar(nn.Module):
    """MANO-HD, PairOF and SelF, joined by volume rendering (paper Fig. 2).

    Attributes:
        edit: changes of the look that belong to the avatar: they are saved with it, and what
            rendering is asked for comes on top.
        texture: detail that is finer than the anchors; None where none was learned.
        seen_frames: training frames that saw each anchor from the front, unhidden; what none has
            seen is a guess. None where nobody counted.
    """

    texture: DetailTexture | None
    seen_frames: Tensor | None
    coefficients: Tensor
    anchor_corners: Tensor
    anchor_barycentric: Tensor

    def __init__(
        self,
        rig: Rig,
        coefficients: Float[Tensor, "shapes"],
        rounds: int = 2,
        num_anchors: int = 4096,
        anchors: SurfacePoints | None = None,
        cues: CueSet | None = None,
        info: dict[str, Any] | None = None,
        num_lights: int = 1,
        part_points: SurfacePoints | None = None,
    ) -> None:
        """An untrained avatar.

        Args:
            rig: the base rig; it is subdivided here.
            coefficients: shape coefficients of the person, zeros for the mean.
            rounds: midpoint subdivisions (the paper's two).
            num_anchors: the paper's N^a.
            anchors: anchors to use instead of placing new ones (when loading).
            cues: what the illumination depends on; by default the paper's.
            info: facts that travel with the avatar (side, subject, method, ...).
            num_lights: one for each clip of the capture; shape and albedo are the same in all.
            part_points: that the occupancy's encoder sees of each part, instead of drawing new ones
                (when loading).
        """
        super().__init__()
        self.base_rig = rig
        self.rounds = rounds
        self.info: dict[str, Any] = dict(info or {})
        self.edit = Edit()
        self.rig, self.parts = finer_rig(rig, rounds, part_points)
        # Subdivision keeps the vertices it finds, and refinement gives them weights too.
        skin_weights = self.rig.skin_weights[: rig.num_vertices]
        self.coarse_rig = replace(rig, skin_weights=skin_weights)
        anchors = anchors or place_anchors(self.rig, num_anchors)
        self.register_buffer("coefficients", coefficients.clone())
        self.register_buffer("anchor_corners", anchors.faces)
        self.register_buffer("anchor_barycentric", anchors.barycentric)
        self.register_buffer("seen_frames", None)
        self.shape = ShapeOffsets()
        self.occupancy = PairOccupancy()
        self.albedo = AlbedoField(len(anchors.faces))
        self.illumination = IlluminationField(
            anchors.positions(self.rig.template_vertices), cues or PaperCues(), num_lights
        )
        self.texture = None
        self._replay: Replay[HandState] = Replay()
        if count := self.illumination.chosen.num_directions:
            self.illumination.directions.copy_(even_directions(count))

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.coefficients.device

    @property
    def anchors(self) -> SurfacePoints:
        """The anchors as points on the rig's faces, which any values at vertices reach."""
        return SurfacePoints(self.anchor_corners, self.anchor_barycentric)

    @property
    def num_lights(self) -> int:
        """One for each clip of the capture."""
        return self.illumination.num_lights

    def light_of(self, edit: Edit | None = None) -> int:
        """Number of the light in which an edit shows the avatar.

        Args:
            edit: on top of the avatar's own.

        Raises:
            ArgumentError: if the avatar has no light of that number.
        """
        chosen = None if edit is None else edit.light
        light = (self.edit.light if chosen is None else chosen) or 0
        if not 0 <= light < self.num_lights:
            known = ", ".join(map(str, range(self.num_lights)))
            raise ArgumentError(
                "light",
                f"this avatar has none of number {light}; choose from {known} (one for each clip "
                "of its capture)",
            )
        return light

    def view(self, edit: Edit | None = None) -> dict[str, Any] | None:
        """Where the capture typically saw the hand, in the light of an edit; None if unknown.

        Every clip has a world of its own, in which its light stands.

        Args:
            edit: on top of the avatar's own.

        Returns:
            As :func:`handavatar.capture.view.view_of` made it.
        """
        views = self.info.get("views")
        return views[self.light_of(edit)] if views else self.info.get("view")

    def moved_to(self, device: torch.device | str) -> "HandAvatar":
        """Moves weights, rig, parts and paint; returns itself."""
        self.to(device)
        self.edit = self.edit.to(device)
        self.base_rig = self.base_rig.to(device)
        self.coarse_rig = self.coarse_rig.to(device)
        self.rig = self.rig.to(device)
        self.parts = self.parts.to(device)
        return self

    @torch.no_grad()
    def start_from_color(self, color: Float[Tensor, "3"]) -> None:
        """Makes an untrained avatar one even colour under one even light.

        Departs: the authors start from random colours; from here less is to be unlearned.

        Args:
            color: mean colour of the hand's pixels, in [0, 1].
        """
        self.illumination.mlp.output.weight.mul_(0.1)
        self.illumination.mlp.output.bias.fill_(math.log(START_LIGHT / (1 - START_LIGHT)))
        albedo = (color / START_LIGHT).clamp(0.05, 0.95)
        self.albedo.mlp.output.weight.mul_(0.1)
        self.albedo.mlp.output.bias.copy_(torch.logit(albedo))

    def give_texture(self, size: int) -> DetailTexture:
        """A texture for detail that is finer than the anchors; it changes nothing yet.

        Args:
            size: texels along a side.
        """
        chart = charted(self.base_rig.to("cpu"), self.rig.to("cpu"), self.rounds)
        anchors = SurfacePoints(self.anchor_corners.cpu(), self.anchor_barycentric.cpu())
        self.texture = DetailTexture(chart, anchors, size).to(self.device)
        return self.texture

    def detail_near(
        self,
        vertices: Float[Tensor, "vertices 3"],
        points: Float[Tensor, "points 3"],
        neighbours: Neighbours,
    ) -> Float[Tensor, "points 3"] | None:
        """The texture's residual of the albedo at points; None where there is no texture.

        Args:
            vertices: of the fine mesh, where the points are meant, metres.
            points: near it, metres.
            neighbours: nearest anchors of the points.
        """
        if self.texture is None:
            return None
        return self.texture(self.texture.places(vertices, points, neighbours))

    def personal(self, pose: HandPose) -> ShapedHand:
        """The personal rest hand of a pose (paper Sec. 3.1)."""
        rest = self.rig.shaped(self.coefficients)
        return personal_hand(rest, self.shape(rest, pose.rotations))

    def coarse_personal(self, pose: HandPose) -> ShapedHand:
        """The same before subdivision: its outline is nearly the same and far cheaper."""
        rest = self.coarse_rig.shaped(self.coefficients)
        return personal_hand(rest, self.shape(rest, pose.rotations))

    def prepare(self, pose: HandPose, lifted_bones: tuple[int, ...] = ()) -> HandState:
        """Does once what all rays of a pose share.

        Args:
            pose: of the hand in the world.
            lifted_bones: bones that shall cast no shadow, where light is traced.

        Raises:
            ArgumentError: if this is not one hand's pose, in numbers as the avatar's are.
        """
        require_type("pose", pose, HandPose)
        for name, shape in (("rotations", (NUM_BONES, 3)), ("translation", (3,))):
            require_tensor(f"pose.{name}", getattr(pose, name), shape, self.coefficients.dtype)
        if self.device.type == "cuda" and not torch.is_grad_enabled():
            state = self._replay(
                self._unlit_state,
                (pose.rotations, pose.translation),
                _copied_state,
                (
                    self.rig,
                    self.parts,
                    self.coefficients,
                    self.anchor_corners,
                    self.anchor_barycentric,
                    *self.shape.parameters(),
                    *self.occupancy.encoder.parameters(),
                ),
                (self.occupancy.margin,),
            )
        else:
            state = self._unlit_state(pose.rotations, pose.translation)
        light = self._light_on(state.posed, state.anchors, state.anchor_normals, lifted_bones)
        return replace(state, posed=replace(state.posed, pose=pose), light=light)

    def _unlit_state(
        self, rotations: Float[Tensor, "bones 3"], translation: Float[Tensor, "3"]
    ) -> HandState:
        """The state of a pose without any traced light."""
        rest = self.rig.shaped(self.coefficients)
        offsets = self.shape(rest, rotations)
        posed = personal_hand(rest, offsets).posed(HandPose(rotations, translation))
        normals = self.anchors.positions(vertex_normals(posed.vertices, self.rig.faces))
        normals = torch.nn.functional.normalize(normals, dim=-1)
        places = self.anchors.positions(posed.vertices)
        codes = self.occupancy.encode(self.parts, posed)
        return HandState(posed, offsets, codes, places, normals, places.new_zeros(len(places), 0))

    def _light_on(
        self,
        posed: PosedHand,
        places: Float[Tensor, "anchors 3"],
        normals: Float[Tensor, "anchors 3"],
        lifted_bones: tuple[int, ...],
    ) -> Float[Tensor, "anchors directions"]:
        """The coarse mesh casts the shadows: on 64 directions its differ by 0.0007 on average."""
        directions = self.illumination.directions
        lifted_bones = (*self.edit.lifted_bones, *lifted_bones)
        if len(directions) == 0:
            return places.new_zeros(len(places), 0)
        vertices = posed.vertices[: self.coarse_rig.num_vertices].detach()
        places, normals = places.detach(), normals.detach()
        faces = self.coarse_rig.faces
        if lifted_bones:
            bones = self.coarse_rig.skin_weights.argmax(-1)[faces]
            lifted = torch.tensor(lifted_bones, device=faces.device)
            faces = faces[~torch.isin(bones, lifted).all(-1)]
        count = torch.get_num_threads() if directions.device.type == "cpu" else 1
        parts = mapped(
            lambda part: sky_light(vertices, faces, places, normals, part),
            directions.tensor_split(count),
        )
        return torch.cat(parts, dim=1)

    def render_rays(
        self,
        state: HandState,
        rays: Rays,
        settings: RenderSettings,
        generator: torch.Generator | None = None,
        edit: Edit | None = None,
    ) -> RayValues:
        """Evaluates rays; with gradient where gradients are enabled.

        Gradient flows from all values of the result to the parameters of the fields (occupancy,
        albedo, illumination, texture) and to the personal shape, if ``state`` was prepared with
        gradient. It also flows to pose and rays, but through the fields at fixed depths: where a
        surface moves across samples it is next to nothing, and no pose can be fitted by it. Fit
        poses by :meth:`silhouette`, or with :func:`handavatar.evaluate.pose_fit.fit_pose`.

        The fields are first evaluated without gradient; the samples that can be seen are then
        evaluated again with gradient, through the pairs alone that decide their occupancy. The
        maximum sends no gradient elsewhere, so the gradient is that of the full evaluation up to
        the samples that weigh less than ``settings.smallest_weight``.

        Args:
            state: of the pose.
            rays: world rays.
            settings: numbers of samples and bounds.
            generator: jitters the samples (training); without it the result is deterministic.
            edit: changes of the look; bones whose shadow it lifts the state must know as well.

        Source: paper Sec. 3.3, Eq. 2, with Eq. 4 along the same samples.
        """
        seen = self.visible_samples(state, rays, settings, generator)
        edit = self.edit.then(edit or Edit())
        normals = seen.neighbours.interpolated(state.anchor_normals)
        detail = self.detail_near(state.posed.vertices, seen.points, seen.neighbours)
        albedo = self.albedo(seen.neighbours, detail)
        albedo = edit.painted(edit.of_albedo(albedo), seen.neighbours)
        illumination = edit.of_illumination(
            self.illumination(
                state.posed.pose.rotations,
                seen.neighbours,
                edit.of_directed(seen.directed),
                normals,
                seen.neighbours.interpolated(state.light),
                self.light_of(edit),
            )
        )
        values = torch.cat(
            [
                albedo * illumination[:, None],
                albedo,
                illumination[:, None],
                normals,
                seen.depths[:, None],
                torch.ones_like(seen.depths)[:, None],
            ],
            dim=-1,
        )
        total = composite_sparse(seen.weights, seen.rays, values, len(rays.origins))
        color, albedo, light, normal, depth, alpha = total.split([3, 3, 1, 3, 1, 1], dim=-1)
        return RayValues(color, albedo, light[:, 0], normal, depth[:, 0], alpha[:, 0])

    def silhouette(
        self, pose: HandPose, camera: Camera, softness: float = 1.0
    ) -> Float[Tensor, "height width"]:
        """How much of each pixel the hand covers, softly, with gradient to pose and shape.

        Of the personal mesh before subdivision, closed at the wrist; the occupancy's own outline
        lies within a millimetre of it. The gradient in the pose is that of the outline's motion.

        Args:
            pose: of the hand in the world; with gradient, where that is wanted.
            camera: of the picture.
            softness: pixels over which an outline fades.

        Raises:
            ArgumentError: if one of them is of another kind.

        Source: paper Sec. 3.1, the silhouette rendering of the shape loss.
        """
        require_type("pose", pose, HandPose)
        require_type("camera", camera, Camera)
        posed = self.coarse_personal(pose).posed(pose)
        faces = self.coarse_rig.sealed_faces
        return soft_silhouette(posed.sealed_vertices, faces, camera.to(self.device), softness)

    def visible_samples(
        self,
        state: HandState,
        rays: Rays,
        settings: RenderSettings,
        generator: torch.Generator | None = None,
    ) -> VisibleSamples:
        """The samples that weigh something in their ray; see :meth:`render_rays`."""
        found = self._weighed(state.codes, rays, settings, generator)
        neighbours = nearest_anchors(state.anchors, found.points, kernel=settings.kernel)
        return VisibleSamples(**vars(found), neighbours=neighbours)

    def alpha(
        self,
        codes: HandCodes,
        rays: Rays,
        settings: RenderSettings,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "rays"]:
        """The alpha of :meth:`render_rays` alone, with the same gradient: nothing is shaded."""
        found = self._weighed(codes, rays, settings, generator)
        return found.weights.new_zeros(len(rays.origins)).index_add(0, found.rays, found.weights)

    def _weighed(
        self,
        codes: HandCodes,
        rays: Rays,
        settings: RenderSettings,
        generator: torch.Generator | None,
    ) -> _Weighed:
        """The samples that weigh something in their ray, and what lies before them."""
        settings = replace(settings, kernel=settled_kernel(settings.kernel, self.device))
        hit, rays, depths = _sampled(codes, rays, settings, generator)
        is_fused = self.occupancy.is_fused(settings.kernel)
        weigh = self._weighed_fused if is_fused else self._weighed_plain
        samples, points, weights, directed = weigh(codes, rays, depths, settings)
        ray = hit[samples // depths.shape[1]]
        return _Weighed(weights, ray, depths.flatten()[samples], points, directed)

    def _weighed_plain(
        self,
        codes: HandCodes,
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
        settings: RenderSettings,
    ) -> _Found:
        """Numbers, places and weights of the samples, and what lies before them."""
        occupancy, soft, items = self._march(codes, rays, depths, settings)
        is_kept = visibility(occupancy) > settings.smallest_weight
        samples = is_kept.flatten().nonzero()[:, 0]
        points = _places(rays, depths, samples)
        if torch.is_grad_enabled():
            position = torch.full((depths.numel(),), -1, device=depths.device)
            position[samples] = torch.arange(len(samples), device=depths.device)
            item_position = position[items.points]
            is_used = item_position >= 0
            used = PairItems(item_position[is_used], items.pairs[is_used], items.is_wanted[is_used])
            again = self.occupancy.of_items(codes, points, used)
            occupancy = _replaced(occupancy, samples, again)
        return samples, points, visibility(occupancy)[is_kept], directed_occupancy(soft)[is_kept]

    def _weighed_fused(
        self,
        codes: HandCodes,
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
        settings: RenderSettings,
    ) -> _Found:
        """The same by kernels. What shorter factors have only found is evaluated again."""
        from handavatar.render.fused_rays import largest_met, sample_weights

        decided = self._march_fused(codes, rays, depths, settings)
        occupancy = decided.whole.view_as(depths)
        weights = sample_weights(occupancy)
        samples = (weights.flatten() > settings.smallest_weight).nonzero()[:, 0]
        points, deciders = _places(rays, depths, samples), decided.deciders[samples]
        if torch.is_grad_enabled():
            items = decided_items(torch.arange(len(samples), device=depths.device), deciders)
            again = self.occupancy.of_items(codes, points, items)
            weights = visibility(_replaced(occupancy, samples, again))
        elif settings.kernel in SHORTER:
            again = self.occupancy.whole_again(codes, points, deciders)
            weights = sample_weights(_replaced(occupancy, samples, again))
        directed = largest_met(decided.soft.view(*depths.shape, -1), samples)
        return samples, points, weights.flatten()[samples], directed

    @torch.no_grad()
    def _march_fused(
        self,
        codes: HandCodes,
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
        settings: RenderSettings,
    ) -> "Decided":
        """:meth:`_march` by kernels; of all samples, by their numbers."""
        from handavatar.render.fused_rays import dim, sample_places, samples_between

        num_rays, num_samples = depths.shape
        decided = self.occupancy.nothing_decided(codes, depths.numel())
        occupancy = decided.whole.view_as(depths)
        light = depths.new_ones(num_rays)
        first = torch.arange(0, depths.numel(), num_samples, device=depths.device)[:, None]

        def evaluate(samples: Int[Tensor, "samples"], stop: float) -> None:
            points = sample_places(rays, depths, samples, light, stop)
            self.occupancy.decide(codes, points, settings.kernel, decided, samples)

        stride, group = _steps(settings, depths)
        looked_at = _looked_at(num_samples, stride, depths.device)
        for window in looked_at.split(group):
            evaluate((first + window).flatten(), settings.stop)
            dim(light, occupancy, window)
        if stride > 1:
            soft = decided.soft.view(*depths.shape, -1)
            evaluate(
                samples_between(occupancy, soft, looked_at, settings.refine_above, settings.stop),
                -1.0,
            )
        return decided

    def _march(
        self,
        codes: HandCodes,
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
        settings: RenderSettings,
    ) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples bones"], PairItems]:
        """Occupancies front to back, without gradient; a ray ends where it is dark.

        First every ``settings.coarse``-th sample; then the samples between two of these where
        either is near the hand. What is left out counts as empty. The running maximum that
        follows loses nothing that linear interpolation of the soft values would add.
        """
        num_rays, num_samples = depths.shape
        occupancy = torch.zeros_like(depths)
        soft = depths.new_zeros(num_rays, num_samples, codes.boxes.lower.shape[0])
        found: list[PairItems] = []

        def evaluate(flat: Int[Tensor, "samples"]) -> None:
            result = self.occupancy(codes, _places(rays, depths, flat), "torch")
            occupancy.view(-1)[flat] = result.whole
            soft.view(-1, soft.shape[-1])[flat] = result.soft_parts
            found.append(replace(result.items, points=flat[result.items.points]))

        stride, group = _steps(settings, depths)
        coarse = _looked_at(num_samples, stride, depths.device)
        light = depths.new_ones(num_rays)
        alive = torch.arange(num_rays, device=depths.device)
        for window in coarse.split(group):
            evaluate((alive[:, None] * num_samples + window).flatten())
            light[alive] *= (1 - occupancy[alive][:, window]).prod(1)
            alive = alive[light[alive] > settings.stop]
        if stride > 1:
            is_near = soft[:, coarse].amax(-1) > settings.refine_above
            is_lit = (1 - occupancy[:, coarse]).cumprod(1) > settings.stop
            ray, interval = ((is_near[:, :-1] | is_near[:, 1:]) & is_lit[:, :-1]).nonzero().T
            between = coarse[interval][:, None] + torch.arange(1, stride, device=coarse.device)
            is_between = between < coarse[interval + 1][:, None]
            evaluate((ray[:, None] * num_samples + between)[is_between])
        items = PairItems(
            torch.cat([part.points for part in found]),
            torch.cat([part.pairs for part in found]),
            torch.cat([part.is_wanted for part in found]),
        )
        return occupancy, soft, items

    @torch.no_grad()
    def render(
        self,
        pose: HandPose,
        camera: Camera,
        edit: Edit | None = None,
        settings: RenderSettings | None = None,
    ) -> Rendering:
        """A whole picture, on black, without gradient; deterministic.

        Args:
            pose: of the hand in the world.
            camera: decides the size of the picture.
            edit: changes of the look.
            settings: samples and bounds.

        Raises:
            ArgumentError: if one of them is of another kind; or if nothing of the hand is in the
                picture, and all of it would be if the camera's transform were inverted.

        Departs: the authors send one ray through every pixel, and the outline is jagged.
        """
        for name, value, kind in (("pose", pose, HandPose), ("camera", camera, Camera)):
            require_type(name, value, kind)
        if edit is not None:
            require_type("edit", edit, Edit)
        state = self.prepare(pose.to(self.device), edit.lifted_bones if edit else ())
        return self._picture(state, camera, edit, settings or RenderSettings())

    def _picture(
        self, state: HandState, camera: Camera, edit: Edit | None, settings: RenderSettings
    ) -> Rendering:
        camera = camera.to(self.device)
        require_tensor(
            "camera.camera_from_world", camera.camera_from_world, (4, 4), self.coefficients.dtype
        )
        near = self.near_mesh(state, camera, settings.mask_margin, settings.kernel)
        near = near.flatten().nonzero()[:, 0]
        if len(near) == 0 or math.isinf(settings.mask_margin):
            _refuse_inverted(camera, state.posed.vertices)
        centers = pixel_centers(camera).flatten(0, 1)
        size = (camera.height, camera.width)
        flat = {
            name: values.new_zeros(camera.height * camera.width, *values.shape[1:]).index_copy_(
                0, near, values
            )
            for name, values in self._along(state, camera, centers[near], settings, edit).items()
        }
        if settings.edge_rays > 1:
            is_edge = _is_edge(flat["alpha"].unflatten(0, size)).flatten()
            edge = near[is_edge[near]]
            places = (torch.arange(settings.edge_rays).to(centers) + 0.5) / settings.edge_rays
            offsets = torch.cartesian_prod(places, places) - 0.5
            inside = (centers[edge][:, None] + offsets).flatten(0, 1)
            for name, values in self._along(state, camera, inside, settings, edit).items():
                mean = values.unflatten(0, (len(edge), len(offsets))).mean(1)
                flat[name].index_copy_(0, edge, mean)
        channels = {name: values.unflatten(0, size) for name, values in flat.items()}
        return Rendering(**channels)

    def render_batch(
        self,
        poses: Sequence[HandPose],
        cameras: Sequence[Camera],
        edit: Edit | Sequence[Edit] | None = None,
        settings: RenderSettings | None = None,
    ) -> list[Rendering]:
        """The pictures that :meth:`render` makes one by one; on a CPU side by side, a thread each.

        What the pictures of a pose share is done once, if it is the same object every time.

        Args:
            poses: of the hand in the world.
            cameras: one for each pose.
            edit: changes of the look; one for all, or one for each pose.
            settings: samples and bounds.

        Raises:
            ArgumentError: if there are not as many cameras, or edits, as poses.
        """
        if len(poses) != len(cameras):
            raise ArgumentError("cameras", str(len(cameras)), f"as many as poses, {len(poses)}")
        edits = [edit or Edit()] * len(poses) if edit is None or isinstance(edit, Edit) else edit
        if len(edits) != len(poses):
            raise ArgumentError("edit", str(len(edits)), f"as many as poses, {len(poses)}")
        settings = settings or RenderSettings()
        keys = [(id(pose), one.lifted_bones) for pose, one in zip(poses, edits, strict=True)]
        wanted = dict(zip(keys, zip(poses, edits, strict=True), strict=True))
        states = mapped(
            lambda pair: self.prepare(pair[0].to(self.device), pair[1].lifted_bones),
            wanted.values(),
        )
        state_of = dict(zip(wanted, states, strict=True))
        views = [
            (state_of[key], camera, one)
            for key, camera, one in zip(keys, cameras, edits, strict=True)
        ]
        return mapped(lambda view: self._picture(*view, settings), views)

    def at_pixels(
        self,
        state: HandState,
        camera: Camera,
        pixels: Int[Tensor, "pixels"],
        settings: RenderSettings,
    ) -> RayValues:
        """What :meth:`render` shows at some pixels, one ray each.

        Args:
            state: of the pose.
            camera: of the picture.
            pixels: their numbers, row by row.
            settings: samples and bounds; ``edge_rays`` plays no part.
        """
        is_seen = self.near_mesh(state, camera, settings.mask_margin, settings.kernel)
        is_seen = is_seen.flatten()[pixels]
        rays = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1)[pixels])
        values = vars(self.render_rays(state, rays, settings))
        return RayValues(
            **{
                name: torch.where(is_seen.view(-1, *(1,) * (value.ndim - 1)), value, 0.0)
                for name, value in values.items()
            }
        )

    def _along(
        self,
        state: HandState,
        camera: Camera,
        positions: Float[Tensor, "rays 2"],
        settings: RenderSettings,
        edit: Edit | None,
    ) -> dict[str, Tensor]:
        """The channels of :class:`RayValues` at places of the picture, pixels."""
        rays = rays_through_pixels(camera, positions)
        pieces = []
        at_once = settings.rays_at_once * (1 if self.device.type == "cpu" else 32)
        for start in range(0, max(len(positions), 1), at_once):
            window = slice(start, start + at_once)
            part = Rays(rays.origins[window], rays.directions[window])
            pieces.append(self.render_rays(state, part, settings, edit=edit))
        names = RayValues.__dataclass_fields__
        return {name: torch.cat([getattr(piece, name) for piece in pieces]) for name in names}

    @torch.no_grad()
    def near_mesh(
        self, state: HandState, camera: Camera, margin: float, kernel: Kernel = "auto"
    ) -> Bool[Tensor, "height width"]:
        """Pixels within ``margin`` (a share of the picture's width) of the posed mesh."""
        if math.isinf(margin):
            return torch.ones(camera.height, camera.width, dtype=torch.bool, device=self.device)
        if settled_kernel(kernel, self.device) == "torch":
            covered = covered_pixels(state.posed.vertices, self.rig.faces, camera)
        else:
            from handavatar.render.fused_coverage import mesh_coverage

            covered = mesh_coverage(state.posed.vertices, self.rig.faces, camera)
        radius = math.ceil(margin * camera.width)
        # Two one-dimensional maxima make a square; it holds the disc of the same radius.
        grown = covered[None, None].float()
        for window in ((2 * radius + 1, 1), (1, 2 * radius + 1)):
            padding = (window[0] // 2, window[1] // 2)
            grown = torch.nn.functional.max_pool2d(grown, window, stride=1, padding=padding)
        return grown[0, 0] > 0

    def save(self, path: Path | str) -> None:
        """Writes one safetensors file, aside first, then renamed into place.

        Of a licensed rig it holds only name and fingerprint.

        Raises:
            NotFinite: if a tensor or a number is NaN or infinite; nothing is written then.
        """
        tensors = {f"avatar.{name}": value for name, value in self.state_dict().items()}
        if self.base_rig.is_licensed:
            for name in _OF_LICENSED_RIG:
                del tensors[f"avatar.{name}"]
        else:
            tensors |= {f"rig.{name}": getattr(self.base_rig, name) for name in RIG_ARRAYS}
            tensors |= {f"set.{name}": value for name, value in self.base_rig.vertex_sets.items()}
            if self.base_rig.pose_directions.numel():
                tensors["rig.pose_directions"] = self.base_rig.pose_directions
        points = self.parts.points
        tensors |= {"parts.corners": points.faces.int(), "parts.barycentric": points.barycentric}
        if self.edit.paint is not None:
            tensors |= {f"paint.{name}": value for name, value in vars(self.edit.paint).items()}
        about: dict[str, Any] = {
            "schema": SCHEMA,
            "rig": self.base_rig.name,
            "rig_sha256": self.base_rig.sha256,
            "rig_is_licensed": self.base_rig.is_licensed,
            "rounds": self.rounds,
            "margin": self.occupancy.margin,
            "softness": self.occupancy.softness,
            "sharpness": self.occupancy.sharpness,
            "cues": self.illumination.chosen.name,
            "edit": {
                "light_gain": self.edit.light_gain,
                "albedo_shift": self.edit.albedo_shift,
                "lifted_bones": self.edit.lifted_bones,
            },
            "info": self.info,
        }
        if self.edit.light is not None:
            about["edit"]["light"] = self.edit.light
        path = Path(path)
        require_finite({**tensors, **about}, f"{path}: not saved")
        stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        write_atomically({path: save(stored, {"handavatar": json.dumps(about)})})

    @staticmethod
    def load(path: Path | str) -> "HandAvatar":
        """Reads an avatar back.

        Args:
            path: an avatar file, or the folder of a finished run.

        Raises:
            CheckpointError: if the file is missing, damaged, not an avatar of this schema, or holds
                NaN or infinity; it names the tensor.
            RigError: if it was made with a licensed rig that is not imported here.
        """
        about, tensors = _stored(Path(path))
        licensed_rig: Rig | None = None
        if about.get("rig_is_licensed"):
            licensed_rig = find_rig(str(about.get("rig_sha256")), str(about.get("rig")))
        try:
            _require_sound_header(about)
            rig = licensed_rig or _stored_rig(about["rig"], tensors)
            if rig.sha256 != about["rig_sha256"]:
                raise ValueError(
                    f"its rig's fingerprint is {rig.sha256[:12]}, the file says "
                    f"{about['rig_sha256'][:12]}"
                )
            state = {name[7:]: v for name, v in tensors.items() if name.startswith("avatar.")}
            _require_possible(state)
            coefficients, known = state["coefficients"], rig.shape_directions[0, 0]
            if (coefficients.shape, coefficients.dtype) != (known.shape, known.dtype):
                raise ValueError(
                    f"{tuple(coefficients.shape)} shape coefficients, {coefficients.dtype}, "
                    f"expected {tuple(known.shape)}, {known.dtype}"
                )
            anchors = SurfacePoints(state["anchor_corners"], state["anchor_barycentric"])
            cues = cue_set(about["cues"], len(state["illumination.directions"]))
            if len(state["illumination.directions"]) > _MAX_DIRECTIONS:
                raise ValueError(f"more than {_MAX_DIRECTIONS} directions of light")
            columns = state["illumination.mlp.hidden.0.weight"].shape[1] - cues.width
            if columns > _MAX_LIGHTS:
                raise ValueError(f"{columns} lights, at most {_MAX_LIGHTS} make sense")
            avatar = HandAvatar(
                rig,
                coefficients,
                rounds=about["rounds"],
                anchors=anchors,
                cues=cues,
                num_lights=max(columns, 1),
                part_points=_stored_part_points(tensors),
            )
            avatar._restore(about, tensors)
            avatar.view()
        except _DAMAGE as error:
            raise CheckpointError(f"{path}: not a complete avatar ({error})") from error
        return avatar

    def reloaded(self, path: Path) -> "HandAvatar":
        """As :meth:`load`, of another state of this very avatar: the rig is not made finer anew.

        Args:
            path: an avatar file; this avatar stays as it is.

        Raises:
            CheckpointError: as :meth:`load`; or if the file is of another rig.
        """
        about, tensors = _stored(path)
        avatar = copy.deepcopy(self)
        try:
            _require_sound_header(about)
            if (about["rig_sha256"], about["rounds"]) != (self.base_rig.sha256, self.rounds):
                raise ValueError("it is of another rig")
            points = _stored_part_points(tensors)
            if points is None:
                parts = finer_rig(self.base_rig, self.rounds)[1]
            else:
                parts = self.parts.with_points(points)
            avatar.parts = parts.to(self.device)
            avatar._restore(about, tensors)
        except _DAMAGE as error:
            raise CheckpointError(f"{path}: not a state of this avatar ({error})") from error
        return avatar

    def _restore(self, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        state = {name[7:]: v for name, v in tensors.items() if name.startswith("avatar.")}
        if self.base_rig.is_licensed:
            state |= {name: self.state_dict()[name] for name in _OF_LICENSED_RIG}
        self.info = about["info"]
        self.occupancy.margin = about["margin"]
        self.occupancy.softness = about["softness"]
        self.occupancy.sharpness = about["sharpness"]
        texels = state.get("texture.texels")
        if texels is None:
            self.texture = None
        elif self.texture is None or self.texture.texels.shape != texels.shape:
            self.give_texture(len(texels))
        seen_frames = state.get("seen_frames")
        self.seen_frames = (
            None if seen_frames is None else torch.zeros_like(seen_frames, device=self.device)
        )
        self.load_state_dict(state)
        self.edit = _stored_edit(about["edit"], tensors)
        self.light_of()


def _require_possible(state: dict[str, Tensor]) -> None:
    """Weights so large that they are damage: what is computed with them is not finite.

    Raises:
        ValueError: if there is one; it names the tensor.
    """
    for name, value in state.items():
        if value.is_floating_point() and value.numel() and float(value.abs().max()) > _LARGEST:
            raise ValueError(
                f"{name} holds {float(value.abs().max()):.3g}, expected at most {_LARGEST:g}"
            )


def _stored(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What an avatar file holds, or the folder of a finished run."""
    if path.is_dir():
        if not (path / "avatar.safetensors").is_file():
            raise CheckpointError(
                f"{path}: holds no avatar.safetensors; finish its training with "
                "handavatar train CAPTURE `resume='auto'`"
            )
        path = path / "avatar.safetensors"
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; train an avatar or name an existing one")
    if path.stat().st_size > _MAX_BYTES:
        raise CheckpointError(
            f"{path}: {path.stat().st_size / 2**30:.1f} GiB; avatars have at most "
            f"{_MAX_BYTES / 2**30:.0f}: it is another file"
        )
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("handavatar", "null"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except Exception as error:
        raise_if_refused(error)
        raise CheckpointError(
            f"{path}: cannot be read as safetensors ({error}); the file is damaged or not "
            "complete: copy it again or take it from the run's last checkpoint"
        ) from error
    if not isinstance(about, dict) or about.get("schema") != SCHEMA:
        raise CheckpointError(
            f"{path}: not an avatar of schema {SCHEMA}; train it again with this version"
        )
    if found := find_not_finite({**tensors, **about}):
        again = "train an avatar again"
        if (path.parent / "run.json").is_file():
            again = (
                "train again into its run, from the last checkpoint: "
                f"handavatar train CAPTURE {argument('out', path.parent)} `resume='auto'`"
            )
        raise CheckpointError(
            f"{path}: {found}, expected finite numbers", "", f"copy the file again, or {again}"
        )
    return about, tensors


def _require_sound_header(about: dict[str, Any]) -> None:
    """Refuses a header whose values are of other kinds than :meth:`HandAvatar.save` writes.

    Raises:
        ValueError: which value, what it is, and what was expected.
        KeyError: which is missing.
    """
    for name, kinds in _KINDS.items():
        value = about[name]
        if not isinstance(value, kinds) or isinstance(value, bool):
            expected = " or ".join(kind.__name__ for kind in kinds)
            raise ValueError(f"{name} is {str(value)[:40]!r}, expected {expected}")
    info = about["info"]
    views = info.get("views") or []
    if not isinstance(views, list) or info.get("side", "right") not in ("left", "right"):
        raise ValueError("info: views is no list, or side neither left nor right")
    for view in [*views, *([info["view"]] if info.get("view") is not None else [])]:
        if not isinstance(view, dict):
            raise ValueError(f"info: a view is {str(view)[:40]!r}, expected an object")
        for name, shape in _VIEW.items():
            if torch.tensor(view[name], dtype=torch.float64).shape != shape:
                raise ValueError(f"info: {name} of a view has not the shape {shape}")


def _copied_state(state: HandState) -> HandState:
    """The same with tensors of its own, but for the pose, which its caller knows."""
    posed = replace(state.posed, **_clones(state.posed, "vertices", "world_from_bone"))
    names = ("bone_from_world", "lower", "upper", "cut_point", "cut_normal")
    boxes = replace(state.codes.boxes, **_clones(state.codes.boxes, *names))
    codes = HandCodes(state.codes.part_codes.clone(), boxes)
    own = _clones(state, "offsets", "anchors", "anchor_normals", "light")
    return replace(state, posed=posed, codes=codes, **own)


def _clones(holder: object, *names: str) -> dict[str, Any]:
    return {name: getattr(holder, name).clone() for name in names}


def _sampled(
    codes: HandCodes, rays: Rays, settings: RenderSettings, generator: torch.Generator | None
) -> tuple[Int[Tensor, "hit"], Rays, Float[Tensor, "hit samples"]]:
    """The rays that meet the hand's part boxes: their numbers, themselves, depths along them."""
    boxes = codes.boxes
    where = boxes.bone_from_world, boxes.lower - boxes.margin, boxes.upper + boxes.margin
    if settings.kernel == "torch":
        near, far, is_hit = intervals_through_boxes(rays, *where)
    else:
        from handavatar.render.fused_rays import box_intervals

        near, far = box_intervals(rays, *where)
        is_hit = near < far
    hit = is_hit.nonzero()[:, 0]
    depths = depths_along(near[hit], far[hit], settings.num_samples, generator)
    return hit, Rays(rays.origins[hit], rays.directions[hit]), depths


def _steps(settings: RenderSettings, depths: Float[Tensor, "rays samples"]) -> tuple[int, int]:
    """Which samples are evaluated first, one of so many, and how many of these at a time."""
    if depths.device.type != "cpu" and depths.numel() <= _FEW_ON_A_GPU:
        return 1, depths.shape[1]
    return settings.coarse, settings.group


@cache
def _looked_at(num_samples: int, stride: int, device: torch.device) -> Int[Tensor, "coarse"]:
    """Every so many samples, and the last."""
    return torch.tensor(sorted({*range(0, num_samples, stride), num_samples - 1}), device=device)


def _places(
    rays: Rays, depths: Float[Tensor, "rays samples"], samples: Int[Tensor, "chosen"]
) -> Float[Tensor, "chosen 3"]:
    """Where samples lie in the world: row by row, their numbers count through all rays."""
    ray = samples // depths.shape[1]
    return rays.origins[ray] + depths.flatten()[samples][:, None] * rays.directions[ray]


def _replaced(
    occupancy: Float[Tensor, "rays samples"],
    samples: Int[Tensor, "chosen"],
    values: Float[Tensor, "chosen"],
) -> Float[Tensor, "rays samples"]:
    """The same with other values at some samples, with their gradient."""
    return occupancy.flatten().index_put((samples,), values).view_as(occupancy)


def _refuse_inverted(camera: Camera, vertices: Float[Tensor, "vertices 3"]) -> None:
    """Refuses a camera that sees nothing of a hand which its inverse has in the picture.

    Raises:
        ArgumentError: if it is such a one.
    """
    inverse = replace(camera, camera_from_world=invert_rigid(camera.camera_from_world))
    if bool(_is_seen(camera, vertices).any()) or not bool(_is_seen(inverse, vertices).all()):
        return
    raise ArgumentError(
        "camera",
        "nothing of the hand is in its picture, and all of it would be with the inverse transform",
        "",
        "camera_from_world takes points of the world to the camera; where the camera stands is "
        "world_from_camera: invert_rigid(world_from_camera)",
    )


def _is_seen(camera: Camera, points: Float[Tensor, "points 3"]) -> Bool[Tensor, "points"]:
    """Which points lie before a camera and in its picture."""
    places, depths = project(camera, points)
    size = places.new_tensor([camera.width, camera.height])
    return (depths > 0) & ((places > 0) & (places < size)).all(-1)


def _is_edge(alpha: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Pixels that the outline crosses: half covered, or unlike one of the four beside them."""
    is_edge = (alpha > 0.1) & (alpha < 0.9)
    down = (alpha[1:] - alpha[:-1]).abs() > 0.25
    across = (alpha[:, 1:] - alpha[:, :-1]).abs() > 0.25
    is_edge[1:] |= down
    is_edge[:-1] |= down
    is_edge[:, 1:] |= across
    is_edge[:, :-1] |= across
    return is_edge
