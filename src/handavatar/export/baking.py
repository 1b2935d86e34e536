"""Baking: what the avatar's fields say of points on its skin, once and for all poses."""

import io
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.motion import middle_of_hand, placed
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.field.anchors import Neighbours, nearest_anchors
from handavatar.geometry.cameras import Rays
from handavatar.geometry.colors import eight_bits, linear_from_srgb
from handavatar.geometry.meshes import SurfacePoints
from handavatar.geometry.rotations import invert_rigid, matrix_from_axis_angle
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses
from handavatar.hand.rig import ShapedHand
from handavatar.render.chart import Texels, texels_of

NUM_LIGHT_POSES = 20
"""Poses, and as many turns of the wrist, whose light is averaged: an anchor's mean over them is
within 0.07 of full light (rms) of that over 64."""
_SETTINGS = RenderSettings(num_samples=32)
"""Half the samples of a picture change an anchor's mean by 0.02."""
_LEAST_COSINE = 0.3
_LEAST_ALPHA = 0.9
_SAME_PLACE = 5e-3
"""Metres between an anchor and what its ray sees there, at most."""
_BRIGHT = 0.95
"""Share of the anchors that are darker than what counts as full light."""
_POINTS_AT_ONCE = 65536


@dataclass(frozen=True, eq=False)
class MeanLight:
    """Illumination of each anchor, averaged over poses.

    Attributes:
        anchors: with the edit, its gain included, as it multiplies the albedo in pictures.
        level: what counts as full light: of the bright anchors, without the edit's gain.
        gain: of the edit.
    """

    anchors: Float[Tensor, "anchors"]
    level: float
    gain: float

    @property
    def occlusion(self) -> Float[Tensor, "anchors"]:
        """Share of full light in [0, 1], linear, as glTF multiplies it.

        The avatar multiplies stored colours, an engine light: the share is decoded as a colour is,
        so that the product looks the same.
        """
        return linear_from_srgb((self.anchors / self.level).clamp(0, 1))


def anchors_near(
    avatar: HandAvatar, hand: ShapedHand, points: Float[Tensor, "points 3"]
) -> Neighbours:
    """Nearest anchors of points on a hand in its zero pose."""
    return nearest_anchors(avatar.anchors.positions(hand.rest_vertices), points)


@torch.no_grad()
def albedo_at(
    avatar: HandAvatar,
    neighbours: Neighbours,
    edit: Edit,
    detail: Float[Tensor, "points 3"] | None = None,
) -> Float[Tensor, "points 3"]:
    """Albedo as pictures show it: sRGB in [0, 1], with its detail, shifted and painted.

    Args:
        avatar: its own edit comes first.
        neighbours: nearest anchors of the points.
        edit: on top.
        detail: of the avatar's texture at the points, where it has one.
    """
    edit = avatar.edit.then(edit)
    found = []
    for start in range(0, max(len(neighbours.indices), 1), _POINTS_AT_ONCE):
        window = slice(start, start + _POINTS_AT_ONCE)
        part = Neighbours(neighbours.indices[window], neighbours.weights[window])
        albedo = avatar.albedo(part, None if detail is None else detail[window])
        found.append(edit.painted(edit.of_albedo(albedo), part))
    return torch.cat(found)


def points_of_texels(hand: ShapedHand, texels: Texels) -> Float[Tensor, "texels 3"]:
    """Where each texel lies on the hand in its zero pose, metres."""
    on_faces = SurfacePoints(hand.rig.faces[texels.faces], texels.barycentric)
    return on_faces.positions(hand.rest_vertices)


def _detail_of_texels(avatar: HandAvatar, texels: Texels) -> Float[Tensor, "texels 3"] | None:
    """What the avatar's texture, which is on the same chart, says of texels of another size."""
    if avatar.texture is None:
        return None
    places = (torch.stack([texels.columns, texels.rows], dim=-1) + 0.5) / texels.size
    return avatar.texture(places)


@dataclass(frozen=True, eq=False)
class Textures:
    """Pictures for a material.

    Attributes:
        base_color: PNG, sRGB.
        occlusion: PNG, grey, linear; empty where the light is in the base colour.
        full_light: illumination that the occlusion calls one; 0 if none was asked for.
    """

    base_color: bytes
    occlusion: bytes
    full_light: float


def baked_textures(
    avatar: HandAvatar,
    hand: ShapedHand,
    edit: Edit,
    size: int,
    has_light_baked: bool = False,
    has_occlusion: bool = True,
    light_poses: int = NUM_LIGHT_POSES,
) -> Textures:
    """Albedo, and the mean light in a picture of its own or in the colours.

    Args:
        avatar: its own edit comes first.
        hand: of the avatar, in the zero pose, with the chart of the pictures.
        edit: on top.
        size: texels along a side of the albedo; the occlusion has half.
        has_light_baked: multiply the colours by the mean light, as pictures do on average.
        has_occlusion: otherwise make the occlusion.
        light_poses: that the mean light is taken over.
    """
    texels = texels_of(hand.rig, size)
    near = anchors_near(avatar, hand, points_of_texels(hand, texels))
    colors = albedo_at(avatar, near, edit, _detail_of_texels(avatar, texels))
    if not has_light_baked and not has_occlusion:
        return Textures(_png(texels.filled(colors)), b"", 0.0)
    light = mean_light(avatar, hand, edit, light_poses)
    if has_light_baked:
        colors = colors * near.interpolated(light.anchors[:, None])
        return Textures(_png(texels.filled(colors)), b"", light.level)
    coarse = texels_of(hand.rig, size // 2)
    around = anchors_near(avatar, hand, points_of_texels(hand, coarse))
    grey = around.interpolated(light.occlusion[:, None])
    return Textures(_png(texels.filled(colors)), _png(coarse.filled(grey)), light.level)


def colors_at_vertices(
    avatar: HandAvatar,
    hand: ShapedHand,
    edit: Edit,
    has_light_baked: bool = False,
    light_poses: int = NUM_LIGHT_POSES,
) -> Float[Tensor, "vertices 3"]:
    """Colours of a hand's vertices; see :func:`baked_textures`."""
    near = anchors_near(avatar, hand, hand.rest_vertices)
    detail = avatar.detail_near(hand.rest_vertices, hand.rest_vertices, near)
    colors = albedo_at(avatar, near, edit, detail)
    if not has_light_baked:
        return colors
    return colors * near.interpolated(mean_light(avatar, hand, edit, light_poses).anchors[:, None])


@torch.no_grad()
def mean_light(
    avatar: HandAvatar, hand: ShapedHand, edit: Edit, count: int = NUM_LIGHT_POSES
) -> MeanLight:
    """What light the anchors get on average, as rendering sees it.

    The hand takes random poses where its capture was and turns once about its length before the
    capture's camera, so that each anchor faces the camera, as it did when its light was learned. A
    ray to each anchor that faces the camera tells its illumination; rays that end elsewhere count
    for nothing.

    Args:
        avatar: on the CPU.
        hand: of the avatar, in the zero pose: an anchor that is never seen takes the mean of the
            nearest ones that are.
        edit: on top of the avatar's own.
        count: poses.
    """
    rig, start = avatar.base_rig, start_of(avatar.view(edit))
    eye = _eye(avatar, edit)
    generator = torch.Generator().manual_seed(1)
    fingers = resolve_penetration(rig, sample_poses(rig, count, generator))
    turns = torch.zeros(count, 3)
    turns[:, 0] = 2 * math.pi * torch.arange(count) / count
    wrists = matrix_from_axis_angle(start.rotations[0]) @ matrix_from_axis_angle(turns)
    motion = placed(rig, fingers, wrists, middle_of_hand(rig, start), 1.0)
    total = torch.zeros(len(avatar.anchor_corners))
    times = torch.zeros_like(total)
    for step in range(count):
        state = avatar.prepare(motion.pose(step), edit.lifted_bones)
        away = state.anchors - eye
        distance = away.norm(dim=-1)
        cosine = -(state.anchor_normals * away).sum(-1) / distance
        facing = (cosine > _LEAST_COSINE).nonzero()[:, 0]
        rays = Rays(eye.expand(len(facing), 3), (away / distance[:, None])[facing])
        seen = avatar.render_rays(state, rays, _SETTINGS, edit=edit)
        is_there = seen.alpha > _LEAST_ALPHA
        depth = seen.depth / seen.alpha.clamp_min(_LEAST_ALPHA)
        is_there &= (depth - distance[facing]).abs() < _SAME_PLACE
        found = facing[is_there]
        total[found] += (seen.illumination / seen.alpha.clamp_min(_LEAST_ALPHA))[is_there]
        times[found] += 1
    gain = avatar.edit.then(edit).light_gain
    if not bool((times > 0).any()):  # An avatar whose fields hold nothing.
        return MeanLight(torch.full_like(total, gain), 1.0, gain)
    known = (times > 0).nonzero()[:, 0]
    light = total / times.clamp_min(1)
    places = avatar.anchors.positions(hand.rest_vertices)
    count_near = min(4, len(known))
    around = nearest_anchors(places[known], places, count_near)
    guessed = around.interpolated(light[known, None])[:, 0]
    light = torch.where(times > 0, light, guessed)
    bright = float(light.quantile(_BRIGHT))
    level = bright / gain if gain > 0 else 1.0
    return MeanLight(light, max(level, 1e-3), gain)


def _eye(avatar: HandAvatar, edit: Edit) -> Float[Tensor, "3"]:
    """Where the capture's camera stood, metres, world; over the back of the hand if unknown."""
    view = avatar.view(edit)
    if view is None:
        middle = middle_of_hand(avatar.base_rig, start_of(None))
        return middle + torch.tensor([0.0, 0.6, 0.0])
    return invert_rigid(torch.tensor(view["camera_from_world"]))[:3, 3]


def _png(picture: Float[Tensor, "size size channels"]) -> bytes:
    pixels = eight_bits(picture).numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels).save(buffer, "PNG")
    return buffer.getvalue()
