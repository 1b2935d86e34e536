"""The fluid picture: the posed mesh with the field's own colours baked on.

The skin's colour is decoded once per vertex, the light once per pose on the anchors; what lies
before an anchor, which the light depends on, is looked up at few of them. So a picture costs a
mesh and two small networks instead of a march along every ray.
"""

from collections import OrderedDict
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.avatar import HandAvatar, Rendering
from handavatar.edit import Edit
from handavatar.field.anchors import nearest_anchors
from handavatar.field.shape import personal_hand
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import SurfacePoints, subdivide_midpoint, vertex_normals
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand
from handavatar.render.rasterize import interpolate, rasterize

NUM_PROBES = 512
"""So many anchors are asked what lies around them; the others take it from the nearest."""
_KEPT = 8


@dataclass(frozen=True, eq=False)
class BakedPose:
    """What all pictures of one pose share.

    Attributes:
        posed: the hand; its offsets are those of the coarse mesh, carried to the fine one.
        normals: unit, world.
        anchor_normals: unit, world.
        surroundings: soft occupancy of every part at the anchors.
    """

    posed: PosedHand
    normals: Float[Tensor, "vertices 3"]
    anchor_normals: Float[Tensor, "anchors 3"]
    surroundings: Float[Tensor, "anchors bones"]


class BakedAvatar:
    """An avatar's pictures without a march along rays; for one thread.

    Departs: the light sees what lies around a place of the skin (for traced light: what hid it in
        the first pose), not what the view ray has passed; outlines are the mesh's, and hard.
    """

    def __init__(self, avatar: HandAvatar, first: HandPose) -> None:
        """Decodes the skin's colour.

        Args:
            avatar: read only, its own edit included, which is applied.
            first: a pose of it; traced light keeps the shadows of this one.
        """
        self._avatar = avatar
        self._first = first.to(avatar.device)
        self._anchors = SurfacePoints(avatar.anchor_corners, avatar.anchor_barycentric)
        template = avatar.rig.template_vertices
        places = self._anchors.positions(template)
        step = max(len(places) // NUM_PROBES, 1)
        self._probes = torch.arange(0, len(places), step, device=avatar.device)
        with torch.no_grad():
            self._at_vertices = nearest_anchors(places, template)
            self._at_anchors = nearest_anchors(places, places)
            self._from_probes = nearest_anchors(places[self._probes], places)
            self._albedo = avatar.albedo(self._at_vertices)
        self._levels = []
        faces, count = avatar.base_rig.faces, avatar.base_rig.num_vertices
        for _ in range(avatar.rounds):
            level = subdivide_midpoint(faces, count)
            self._levels.append(level)
            faces, count = level.faces, count + len(level.edges)
        self._poses: OrderedDict[bytes, BakedPose] = OrderedDict()
        self._visible: OrderedDict[tuple[int, ...], Tensor] = OrderedDict()

    @torch.no_grad()
    def render(self, pose: HandPose, camera: Camera, edit: Edit) -> Rendering:
        """As :meth:`HandAvatar.render`, but fast; the depth is left out (zero).

        Args:
            pose: of the hand in the world.
            camera: decides the size of the picture.
            edit: changes of the look.
        """
        baked = self.posed(pose)
        faces = self._avatar.rig.faces
        edit = self._avatar.edit.then(edit)
        albedo = edit.painted(edit.of_albedo(self._albedo), self._at_vertices)
        light = self._at_vertices.interpolated(self._light(baked, edit)[:, None])
        values = torch.cat([albedo * light, albedo, light, baked.normals], dim=-1)
        fragments = rasterize(baked.posed.vertices, faces, camera.to(self._avatar.device))
        seen = interpolate(fragments, faces, values)
        color, albedo, light, normal = seen.split([3, 3, 1, 3], dim=-1)
        alpha = fragments.mask.to(color)
        return Rendering(color, albedo, light[..., 0], normal, torch.zeros_like(alpha), alpha)

    @torch.no_grad()
    def posed(self, pose: HandPose) -> BakedPose:
        """The part that only depends on the pose; the last few are kept."""
        key = pose.rotations.cpu().numpy().tobytes() + pose.translation.cpu().numpy().tobytes()
        if key not in self._poses:
            self._poses[key] = self._bake(pose.to(self._avatar.device))
            while len(self._poses) > _KEPT:
                self._poses.popitem(last=False)
        self._poses.move_to_end(key)
        return self._poses[key]

    def nearest_anchor(self, pose: HandPose, camera: Camera, column: int, row: int) -> int | None:
        """The anchor nearest to what a pixel sees; None beside the hand.

        Args:
            pose: of the hand in the world.
            camera: of the picture.
            column: of the pixel, from 0.
            row: of the pixel, from 0.
        """
        vertices = self.posed(pose).posed.vertices
        pixel = camera.to(vertices.device).cropped(column, row, 1, 1)
        fragments = rasterize(vertices, self._avatar.rig.faces, pixel)
        if not bool(fragments.mask[0, 0]):
            return None
        point = interpolate(fragments, self._avatar.rig.faces, vertices)[0]
        anchors = self._anchors.positions(vertices)
        return int((anchors - point).square().sum(-1).argmin())

    def template_anchors(self) -> tuple[Float[Tensor, "anchors 3"], Float[Tensor, "anchors 3"]]:
        """Places (metres) and unit normals of the anchors on the template."""
        rig = self._avatar.rig
        normals = self._anchors.positions(vertex_normals(rig.template_vertices, rig.faces))
        normals = torch.nn.functional.normalize(normals, dim=-1)
        return self._anchors.positions(rig.template_vertices), normals

    def _bake(self, pose: HandPose) -> BakedPose:
        avatar = self._avatar
        coarse = avatar.coarse_rig.shaped(avatar.coefficients)
        offsets = avatar.shape(coarse, pose.rotations)
        for level in self._levels:
            offsets = level.carried(offsets)
        posed = personal_hand(avatar.rig.shaped(avatar.coefficients), offsets).posed(pose)
        normals = vertex_normals(posed.vertices, avatar.rig.faces)
        anchor_normals = torch.nn.functional.normalize(self._anchors.positions(normals), dim=-1)
        chosen = avatar.illumination.chosen
        surroundings = anchor_normals.new_zeros(len(anchor_normals), len(pose.rotations))
        if chosen.num_directions == 0 and chosen.name != "plain":
            codes = avatar.occupancy.encode(avatar.parts, posed)
            probes = self._anchors.positions(posed.vertices)[self._probes]
            around = avatar.occupancy(codes, probes).soft_parts
            surroundings = self._from_probes.interpolated(around)
        return BakedPose(posed, normals, anchor_normals, surroundings)

    def _light(self, baked: BakedPose, edit: Edit) -> Float[Tensor, "anchors"]:
        field = self._avatar.illumination
        traced = baked.anchor_normals @ field.directions.T
        if traced.shape[1]:
            traced = traced.clamp_min(0) * self._visibility(edit.lifted_bones)
        light = field(
            baked.posed.pose.rotations,
            self._at_anchors,
            edit.of_directed(baked.surroundings),
            baked.anchor_normals,
            traced,
        )
        return edit.of_illumination(light)

    def _visibility(self, lifted: tuple[int, ...]) -> Float[Tensor, "anchors directions"]:
        """Which share of a light in each direction reaches each anchor, in the first pose."""
        if lifted not in self._visible:
            state = self._avatar.prepare(self._first, lifted)
            cosine = state.anchor_normals @ self._avatar.illumination.directions.T
            share = (state.light / cosine.clamp_min(1e-3)).clamp(0, 1)
            self._visible[lifted] = torch.where(cosine > 0, share, 1.0)
            while len(self._visible) > _KEPT:
                self._visible.popitem(last=False)
        return self._visible[lifted]


def dabbed(
    places: Float[Tensor, "anchors 3"],
    normals: Float[Tensor, "anchors 3"],
    middle: int,
    radius: float,
) -> Float[Tensor, "anchors"]:
    """Opacity of a dab of paint: 1 in its middle, 0 from the radius (metres) on.

    Only skin that looks the same way takes it, so that paint does not reach through a finger.
    """
    distance = (places - places[middle]).norm(dim=-1) / radius
    inside = (1 - distance).clamp(0, 1)
    # Smooth at both ends, and full over the inner half.
    share = (2 * inside).clamp(max=1)
    share = share * share * (3 - 2 * share)
    return torch.where(normals @ normals[middle] > 0, share, 0.0)
