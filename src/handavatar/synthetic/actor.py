"""The hand of a made video with its forearm: one closed skin, lit and rasterised.

Camera axes (OpenCV, the camera's centre as origin), metres; light and colours are linear.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from handavatar.capture.skin import smooth_noise
from handavatar.capture.synthetic import Subject
from handavatar.geometry.cameras import Camera
from handavatar.geometry.colors import linear_from_srgb
from handavatar.geometry.meshes import face_cross_products, vertex_normals
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import Fragments, rasterize
from handavatar.render.skylight import even_directions, sky_light

_LENGTH = 0.34
_RINGS = 30
_SLEEVE_FROM = 0.055
# Along the arm (share of its length): girth, in units of the wrist's; the rest is between.
_PLACES = (0.0, 0.06, 0.18, 0.45, 0.75, 1.0)
_GIRTH = (1.0, 0.97, 1.02, 1.38, 1.52, 1.5)
_SHINE = 0.05
_SHARPNESS = 18


@dataclass(frozen=True, eq=False)
class Lights:
    """Light from far away.

    Attributes:
        directions: unit, towards the lights.
        colors: what a white surface that faces the light sends back.
        key: which direction is the middle of the strongest lamp.
    """

    directions: Float[Tensor, "lights 3"]
    colors: Float[Tensor, "lights 3"]
    key: int


def draw_lights(random: np.random.Generator) -> Lights:
    """A soft lamp above one side, and light from everywhere that is warmer below."""
    sky = even_directions(16)
    side = random.choice([-1.0, 1.0])
    towards = np.array([side * random.uniform(0.4, 0.8), -random.uniform(0.5, 0.9), -0.8])
    key = normalize(torch.from_numpy(towards).float(), dim=0)
    spread = torch.tensor([[0.0, 0, 0], [0.16, 0, 0.06], [-0.1, 0.12, 0], [0, -0.13, -0.1]])
    lamps = normalize(key + spread, dim=-1)
    above = (0.5 - 0.5 * sky[:, 1])[:, None]
    warm = torch.tensor([1.0, 0.93, 0.86]) * (1 - above) + torch.tensor([0.93, 0.98, 1.05]) * above
    share = random.uniform(0.42, 0.6)
    # Sixteen even lights of strength s bring 4 s to every unhidden point.
    colors = torch.cat(
        [
            share / 4 * (0.6 + 0.8 * above) * warm,
            (1 - share) * 0.36 * torch.tensor([1.0, 0.97, 0.92]).expand(4, 3),
        ]
    )
    return Lights(torch.cat([sky, lamps]), colors, len(sky))


@dataclass(frozen=True, eq=False)
class PosedActor:
    """Hand and forearm in one pose.

    Attributes:
        vertices: the hand's, then the forearm's, metres, camera axes.
        normals: unit.
    """

    vertices: Float[Tensor, "vertices 3"]
    normals: Float[Tensor, "vertices 3"]


class Actor:
    """A subject with a forearm, bare or in a sleeve."""

    def __init__(self, subject: Subject, base: Rig, sleeved: bool, seed: int) -> None:
        """Paints the arm.

        Args:
            subject: on a subdivided rig.
            base: the rig before subdivision; its mesh casts the shadows.
            sleeved: whether cloth covers the arm from some centimetres behind the wrist on.
            seed: of the arm's skin or cloth.
        """
        self.subject, self.sleeved = subject, sleeved
        rig = subject.rig
        self.num_hand_vertices, self.num_hand_faces = rig.num_vertices, len(rig.faces)
        self._rim = rig.rim
        self._along = torch.linspace(0, 1, _RINGS + 1)[1:] ** 1.25
        arm_faces = self._arm_faces()
        self.faces = torch.cat([rig.faces, arm_faces])
        self.caster_faces = torch.cat([base.faces, arm_faces])
        self._texture = linear_from_srgb(subject.texture).permute(2, 0, 1)[None]
        self._arm_colors = self._painted_arm(np.random.default_rng([seed, 77]))

    def _arm_faces(self) -> Int[Tensor, "faces 3"]:
        count = len(self._rim)
        rings = [self._rim] + [
            self.num_hand_vertices + ring * count + torch.arange(count) for ring in range(_RINGS)
        ]
        faces = []
        for near, far in pairwise(rings):
            # The hand's faces run along the rim; the arm's run against them: one orientation.
            a, b, c, d = near, near.roll(-1), far, far.roll(-1)
            faces += [torch.stack([b, a, c], -1), torch.stack([b, c, d], -1)]
        arm = torch.cat(faces)
        own = torch.stack([self.subject.rig.faces, self.subject.rig.faces.roll(-1, 1)], -1)
        is_same = bool((own == self._rim[:2].flip(0)).all(-1).any())
        return arm.flip(-1) if is_same else arm

    def _painted_arm(self, random: np.random.Generator) -> Float[Tensor, "vertices 3"]:
        """Colours of the rim and the arm's rings, linear."""
        rig, count = self.subject.rig, len(self._rim)
        place = torch.zeros(rig.num_vertices, dtype=torch.long)
        place[rig.faces.flatten()] = rig.uv_faces.flatten()
        own = self._texels(rig.uv_coordinates[place[self._rim]])
        smooth = own
        for _ in range(30):
            smooth = (smooth.roll(1, 0) + smooth + smooth.roll(-1, 0)) / 3
        along = torch.cat([torch.zeros(1), self._along])
        share = (along * _LENGTH / 0.02).clamp(0, 1)[:, None, None]
        colors = own * (1 - share) + smooth * share
        angle = torch.arange(count) / count * 2 * torch.pi
        grid_along, grid_angle = torch.meshgrid(along * _LENGTH * 1000, angle, indexing="ij")
        places = torch.stack([grid_along, 28 * grid_angle.cos(), 28 * grid_angle.sin()], -1)
        points = places.reshape(-1, 3).double().numpy()
        noise = 0.05 * smooth_noise(points, np.full(3, 45.0), random)
        noise += 0.04 * smooth_noise(points, np.full(3, 13.0), random)
        mottled = torch.from_numpy(noise).float().reshape(colors.shape[:2])[..., None]
        colors = colors * (1 + share * mottled * torch.tensor([0.7, 1.0, 1.1]))
        if self.sleeved:
            cloth = torch.from_numpy(random.uniform(0.03, 0.35, 3)).float()
            stripes = 1 + 0.25 * torch.sin(grid_along / 4.5)[..., None]
            is_cloth = (grid_along > _SLEEVE_FROM * 1000)[..., None]
            colors = torch.where(is_cloth, cloth * stripes, colors)
        return colors.reshape(-1, 3)

    def _texels(self, uv: Float[Tensor, "points 2"]) -> Float[Tensor, "points 3"]:
        grid = (2 * uv - 1)[None, None]
        return grid_sample(self._texture, grid, padding_mode="border", align_corners=False)[
            0, :, 0
        ].T

    def posed(self, pose: HandPose, elbow: Float[Tensor, "3"]) -> PosedActor:
        """Places hand and arm.

        Args:
            pose: camera axes.
            elbow: where the arm comes from, metres.
        """
        hand = self.subject.posed_vertices(pose)
        rim = hand[self._rim]
        center = rim.mean(0)
        offsets = rim - center
        wrist = matrix_from_axis_angle(pose.rotations[0])
        start = wrist @ torch.tensor([1.0, 0.0, 0.0])
        end = normalize(0.75 * start + 0.55 * normalize(elbow - center, dim=0), dim=0)
        bend = (self._along * _LENGTH / 0.06).clamp(0, 1)
        bend = (bend * bend * (3 - 2 * bend))[:, None]
        directions = normalize((1 - bend) * start + bend * end, dim=-1)
        steps = torch.diff(self._along, prepend=torch.zeros(1))[:, None] * _LENGTH
        centers = center + (directions * steps).cumsum(0)
        # The rim, brought upright on the axis, rounder and wider towards the elbow.
        flat = offsets - (offsets @ start)[:, None] * start
        radius = flat.norm(dim=-1, keepdim=True)
        round_ = flat / radius * radius.mean()
        turn = _turns(start, directions)
        girth = torch.from_numpy(np.interp(self._along.numpy(), _PLACES, _GIRTH)).float()
        if self.sleeved:
            girth = girth + 0.22 * (self._along * _LENGTH > _SLEEVE_FROM)
        level = (self._along * _LENGTH / 0.05).clamp(0, 1)[:, None, None]
        is_round = (self._along * 0.7)[:, None, None]
        shape = (1 - level) * offsets + level * ((1 - is_round) * flat + is_round * round_)
        rings = centers[:, None] + torch.einsum("rij,rcj->rci", turn, shape * girth[:, None, None])
        vertices = torch.cat([hand, rings.reshape(-1, 3)])
        return PosedActor(vertices, vertex_normals(vertices, self.faces))

    def light(self, actor: PosedActor, lights: Lights) -> Float[Tensor, "vertices 3"]:
        """What arrives at every vertex, shadows of the hand on itself included."""
        brought = sky_light(
            actor.vertices, self.caster_faces, actor.vertices, actor.normals, lights.directions
        )
        return brought @ lights.colors

    def fragments(self, actor: PosedActor, camera: Camera) -> Fragments:
        """What every pixel sees; faces that are turned away are hidden by others."""
        corners = actor.vertices[self.faces]
        is_front = (face_cross_products(actor.vertices, self.faces) * corners[:, 0]).sum(-1) < 0
        front = is_front.nonzero()[:, 0]
        seen = rasterize(actor.vertices, self.faces[front], camera)
        face = torch.where(seen.mask, front[seen.face_index.clamp_min(0)], -1)
        return replace(seen, face_index=face)

    def is_hand(self, fragments: Fragments) -> Bool[Tensor, "height width"]:
        """Pixels that see the hand, not the forearm."""
        return fragments.mask & (fragments.face_index < self.num_hand_faces)

    def colors(
        self,
        fragments: Fragments,
        actor: PosedActor,
        light: Float[Tensor, "vertices 3"],
        lights: Lights,
    ) -> Float[Tensor, "pixels 3"]:
        """Linear colours of the covered pixels, in row order."""
        covered = fragments.mask
        face = fragments.face_index[covered]
        weights = fragments.barycentric[covered]
        corners = self.faces[face]

        def at_pixels(values: Tensor) -> Tensor:
            return (values[corners] * weights[..., None]).sum(-2)

        albedo = torch.zeros(len(face), 3)
        on_hand = face < self.num_hand_faces
        rig = self.subject.rig
        uv = rig.uv_coordinates[rig.uv_faces[face[on_hand]]]
        albedo[on_hand] = self._texels((uv * weights[on_hand, :, None]).sum(-2))
        arm_color = torch.zeros(len(actor.vertices), 3)
        arm_color[self._rim] = self._arm_colors[: len(self._rim)]
        arm_color[self.num_hand_vertices :] = self._arm_colors[len(self._rim) :]
        albedo[~on_hand] = (arm_color[corners[~on_hand]] * weights[~on_hand, :, None]).sum(-2)
        arriving = at_pixels(light)
        normal = normalize(at_pixels(actor.normals), dim=-1)
        view = normalize(-at_pixels(actor.vertices), dim=-1)
        half = normalize(view + lights.directions[lights.key], dim=-1)
        shine = (normal * half).sum(-1).clamp_min(0) ** _SHARPNESS
        is_skin = on_hand if self.sleeved else torch.ones_like(on_hand)
        gloss = _SHINE * shine * is_skin * arriving.mean(-1)
        return albedo * arriving + gloss[:, None]


def _turns(
    start: Float[Tensor, "3"], directions: Float[Tensor, "rings 3"]
) -> Float[Tensor, "rings 3 3"]:
    """The shortest turns that bring one direction to others."""
    axis = torch.linalg.cross(start.expand_as(directions), directions)
    sine, cosine = axis.norm(dim=-1, keepdim=True), (directions @ start)[:, None]
    return matrix_from_axis_angle(axis / sine.clamp_min(1e-9) * torch.atan2(sine, cosine))
