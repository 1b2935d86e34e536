"""The fluid picture: the posed mesh with the field's own colours baked on.

The skin's colour is decoded once per vertex, the light once per pose on the anchors; what lies
before an anchor, which the light depends on, is looked up at few of them. So a picture costs a
mesh and two small networks instead of a march along every ray.
"""

from collections import OrderedDict
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar, Rendering
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.field.anchors import nearest_anchors
from handavatar.field.shape import personal_hand
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import (
    carried_to_fine,
    subdivision_levels,
    vertex_normals,
)
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import PosedHand
from handavatar.render.rasterize import Fragments, interpolate, rasterize

NUM_PROBES = 128
"""So many anchors are asked what lies around them; the others take it from the nearest."""
NUM_LIT = 2048
"""The light is decoded on so many anchors; the vertices take it from the nearest."""
_KEPT = 8


@dataclass(frozen=True, eq=False)
class BakedPose:
    """What all pictures of one pose share.

    Attributes:
        posed: the hand; its offsets are those of the coarse mesh, carried to the fine one.
        vertices: its own and the middle of the wrist's cut, metres, world.
        normals: of its own vertices, unit, world.
        lit_normals: of the lit anchors, unit, world.
        surroundings: soft occupancy of every part at the lit anchors; one, once it is needed.
        lights: at the vertices, by which light shines and which bones are lifted; filled as
            pictures need it.
    """

    posed: PosedHand
    vertices: Float[Tensor, "sealed_vertices 3"]
    normals: Float[Tensor, "vertices 3"]
    lit_normals: Float[Tensor, "lit 3"]
    surroundings: list[Float[Tensor, "lit bones"]]
    lights: dict[tuple[int, tuple[int, ...]], Float[Tensor, "vertices"]]


class BakedAvatar:
    """An avatar's pictures without a march along rays; for one thread.

    Departs: the light sees what lies around a place of the skin (for traced light: what hid it in
        the first pose), not what the view ray has passed; outlines are the mesh's, and hard.
    """

    def __init__(self, avatar: HandAvatar, first: HandPose) -> None:
        """Decodes the skin's colour.

        Args:
            avatar: read only, its own edit included, which is applied.
            first: a pose of it; traced light keeps the shadows of this one. Another clip's light
                keeps those of the typical view of that clip.
        """
        self._avatar = avatar
        self._first = first.to(avatar.device)
        self._anchors = avatar.anchors
        template = avatar.rig.template_vertices
        places = self._anchors.positions(template)
        every = max(len(places) // NUM_LIT, 1)
        lit = places[::every]
        self._lit = self._anchors.chosen(slice(None, None, every))
        every = max(len(lit) // NUM_PROBES, 1)
        self._probes = self._lit.chosen(slice(None, None, every))
        with torch.no_grad():
            self._at_vertices = nearest_anchors(places, template)
            self._at_lit = nearest_anchors(places, lit)
            self._from_lit = nearest_anchors(lit, template)
            self._from_probes = nearest_anchors(lit[::every], lit)
            detail = avatar.detail_near(template, template, self._at_vertices)
            self._albedo = avatar.albedo(self._at_vertices, detail)
        base = avatar.base_rig
        self._levels = subdivision_levels(base.faces, base.num_vertices, avatar.rounds)
        self._poses: OrderedDict[bytes, BakedPose] = OrderedDict()
        self._visible: OrderedDict[tuple[int, tuple[int, ...]], Tensor] = OrderedDict()

    @torch.no_grad()
    def render(
        self, pose: HandPose, camera: Camera, edit: Edit, lit_as: HandPose | None = None
    ) -> Rendering:
        """As :meth:`HandAvatar.render`, but fast; the depth is left out (zero).

        Args:
            pose: of the hand in the world.
            camera: decides the size of the picture.
            edit: changes of the look.
            lit_as: another pose, near this one, of which the light is known; half of a new pose's
                time goes into its light.
        """
        baked = self.posed(pose)
        lit = baked if lit_as is None else self.posed(lit_as)
        edit = self._avatar.edit.then(edit)
        albedo = edit.painted(edit.of_albedo(self._albedo), self._at_vertices)
        light = edit.of_illumination(self._light(lit, edit))[:, None]
        values = torch.cat([albedo * light, albedo, light, baked.normals], dim=-1)
        cut = values[self._avatar.rig.rim].mean(0, keepdim=True)
        camera = camera.to(self._avatar.device)
        faces = self._facing(baked.vertices, camera)
        fragments = rasterize(baked.vertices, faces, camera)
        mask = fragments.mask
        # Most pixels see nothing; a row of those that do is a picture, too.
        covered = Fragments(
            fragments.face_index[mask][None],
            fragments.depth[mask][None],
            fragments.barycentric[mask][None],
        )
        seen = values.new_zeros(*mask.shape, values.shape[1])
        seen[mask] = interpolate(covered, faces, torch.cat([values, cut]))[0]
        color, albedo, light, normal = seen.split([3, 3, 1, 3], dim=-1)
        alpha = mask.to(color)
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
        pixel = camera.to(vertices.device).cropped(float(column), float(row), 1.0, 1.0)
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
        offsets = carried_to_fine(avatar.shape(coarse, pose.rotations), self._levels)
        posed = personal_hand(avatar.rig.shaped(avatar.coefficients), offsets).posed(pose)
        normals = vertex_normals(posed.vertices, avatar.rig.faces)
        lit_normals = torch.nn.functional.normalize(self._lit.positions(normals), dim=-1)
        return BakedPose(posed, posed.sealed_vertices, normals, lit_normals, [], {})

    def _surroundings(self, baked: BakedPose) -> Float[Tensor, "lit bones"]:
        """What lies around the lit anchors."""
        avatar, posed = self._avatar, baked.posed
        chosen = avatar.illumination.chosen
        if chosen.num_directions or chosen.name == "plain":
            return baked.lit_normals.new_zeros(len(baked.lit_normals), len(posed.pose.rotations))
        codes = avatar.occupancy.encode(avatar.parts, posed)
        around = avatar.occupancy(codes, self._probes.positions(posed.vertices)).soft_parts
        return self._from_probes.interpolated(around)

    def _facing(
        self, vertices: Float[Tensor, "sealed_vertices 3"], camera: Camera
    ) -> Int[Tensor, "faces 3"]:
        """The sealed mesh's faces that look to the camera: the others are behind them."""
        faces = self._avatar.rig.sealed_faces
        rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
        a, b, c = (vertices + rotation.T @ translation)[faces].unbind(1)
        return faces[(torch.linalg.cross(b - a, c - a) * a).sum(-1) < 0]

    def _light(self, baked: BakedPose, edit: Edit) -> Float[Tensor, "vertices"]:
        """The illumination at the vertices, before its gain."""
        key = (self._avatar.light_of(edit), edit.lifted_bones)
        if key not in baked.lights:
            field = self._avatar.illumination
            if not baked.surroundings:
                baked.surroundings.append(self._surroundings(baked))
            traced = baked.lit_normals @ field.directions.T
            if traced.shape[1]:
                traced = traced.clamp_min(0) * self._visibility(*key)
            light = field(
                baked.posed.pose.rotations,
                self._at_lit,
                edit.of_directed(baked.surroundings[0]),
                baked.lit_normals,
                traced,
                key[0],
            )
            baked.lights[key] = self._from_lit.interpolated(light[:, None])[:, 0]
        return baked.lights[key]

    def _visibility(self, light: int, lifted: tuple[int, ...]) -> Float[Tensor, "lit directions"]:
        """Which share of a light in each direction reaches each lit anchor, in the first pose."""
        key = (light, lifted)
        if key not in self._visible:
            first = self._first
            if light != self._avatar.light_of():
                view = self._avatar.view(Edit(light=light))
                first = start_of(view).to(self._avatar.device)
            state = self._avatar.prepare(first, lifted)
            every = len(state.anchors) // len(self._lit.faces)
            cosine = state.anchor_normals[::every] @ self._avatar.illumination.directions.T
            share = (state.light[::every] / cosine.clamp_min(1e-3)).clamp(0, 1)
            self._visible[key] = torch.where(cosine > 0, share, 1.0)
            while len(self._visible) > _KEPT:
                self._visible.popitem(last=False)
        return self._visible[key]


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
