"""The lightweight hand: a mesh with pose correctives, and a shading network for its vertices.

It stands for the whole avatar where there is no field: what it holds is quantised already, and what
it loses is measured on poses that it was not fitted to.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.edit import Edit
from handavatar.export.capsules import Capsules, fit_capsules
from handavatar.export.correctives import PoseCorrectives, fit_correctives
from handavatar.export.field_samples import (
    FieldSamples,
    is_traced,
    sample_field,
    sampled_poses,
)
from handavatar.export.packing import Packed, quantised
from handavatar.export.shading_network import (
    STEPS,
    ShadingNetwork,
    Surroundings,
    fit_shading,
    shading_error,
    surroundings,
)
from handavatar.export.surface import average_hand
from handavatar.field.anchors import Neighbours, nearest_anchors
from handavatar.geometry.colors import eight_bits
from handavatar.geometry.meshes import (
    Subdivision,
    carried_to_fine,
    subdivision_levels,
    vertex_normals,
)
from handavatar.hand.rig import ShapedHand
from handavatar.hand.sparse_skin import SparseSkin
from handavatar.jobs.progress import SILENT, Progress

NUM_POSES = 420
"""Poses of the fingers; of them one in seven is held out."""
NUM_TRACED_POSES = 280
"""Where light is traced, which takes thrice as long; half as many lose 0.7 dB of colour."""
_HELD_OUT = 7
"""Hears what is being done, how many steps of it are done, and of how many."""


@dataclass(frozen=True)
class Effort:
    """How much is spent on a lightweight hand.

    Attributes:
        poses: of the fingers, in which the fields are looked up.
        steps: of the shading network's fit.
    """

    poses: int
    steps: int = STEPS

    @staticmethod
    def for_avatar(avatar: HandAvatar) -> "Effort":
        """As much as the light of an avatar asks for."""
        return Effort(NUM_TRACED_POSES if is_traced(avatar) else NUM_POSES)


@dataclass(frozen=True, eq=False)
class LightweightHand:
    """What a page holds of an avatar; the last vertex closes the wrist.

    Attributes:
        hand: of the fine mesh in its zero pose, at most four bones a vertex.
        coarse_faces: before subdivision.
        levels: of subdivision, up to that mesh.
        correctives: of its rest shape.
        capsules: around its bones.
        network: its illumination.
        normals: for shading, in the zero pose, unit.
        albedo: sRGB in [0, 1], as the field has it.
        paint: colour times opacity, and opacity; None where there is none.
        loss: what it loses, on held-out poses; see :func:`measured_loss`.
    """

    hand: ShapedHand
    coarse_faces: Int[Tensor, "faces 3"]
    levels: list[Subdivision]
    correctives: PoseCorrectives
    capsules: Capsules
    network: ShadingNetwork
    normals: Float[Tensor, "sealed_vertices 3"]
    albedo: Float[Tensor, "sealed_vertices 3"]
    paint: Float[Tensor, "sealed_vertices 4"] | None
    loss: dict[str, float]

    def arrays(self) -> dict[str, Packed]:
        """All arrays as they are stored; those of the mesh are of its coarsest level."""
        rig = self.hand.rig
        coarse = len(self.correctives.vertices)
        skin = SparseSkin.of(rig.skin_weights, rig, 0)
        bones = torch.cat([skin.bones, skin.bones.new_zeros(1, 4)])
        shares = torch.cat([skin.shares, skin.shares.new_tensor([[65535, 0, 0, 0]])])
        kind = "u2" if coarse < 65536 else "u4"
        corrected = self.correctives
        found = {
            "faces": Packed(self.coarse_faces.numpy().astype(kind)),
            "rim": Packed(rig.rim.numpy().astype("u4")),
            "vertices": quantised(corrected.vertices, "i2"),
            "joints": Packed(corrected.joints.numpy()),
            "shapes": quantised(corrected.shapes, "i1"),
            "joint_shapes": Packed(corrected.joint_shapes.numpy()),
            "shape_weights": Packed(corrected.weights.numpy()),
            "bones": Packed(bones.numpy().astype("u1")),
            "shares": Packed(shares.numpy().astype("u2")),
            "normals": Packed((127 * self.normals).round().numpy().astype("i1")),
            "albedo": Packed(eight_bits(self.albedo).numpy()),
            "axes": Packed(rig.joint_axes.numpy()),
            "capsule_bones": Packed(self.capsules.bones.numpy().astype("u1")),
            "capsule_ends": Packed(self.capsules.ends.numpy()),
            "capsule_radii": Packed(self.capsules.radii.numpy()),
        }
        if self.paint is not None:
            found["paint"] = Packed(eight_bits(self.paint).numpy())
        for name, value in self.network.state_dict().items():
            label = name.replace(".", "_")
            is_latent = name == "latents"
            found[label] = quantised(value, "i1") if is_latent else Packed(value.numpy())
        return found


def lightweight_hand(
    avatar: HandAvatar,
    edit: Edit,
    progress: Progress = SILENT,
    effort: Effort | None = None,
) -> LightweightHand:
    """Fits a lightweight hand to an avatar; the same avatar gives the same hand.

    Args:
        avatar: on the CPU.
        edit: its paint is laid on the avatar's own, and it chooses the light; all else of edits is
            for the page.
        progress: told how far it is.
        effort: poses and steps; by default what the avatar asks for.
    """
    effort = effort or Effort.for_avatar(avatar)
    stages = progress.stages(
        {
            "fields": 1.0 * effort.poses,
            "surroundings": 0.1 * effort.poses,
            "shading network": 0.02 * effort.steps,
        }
    )
    hand = average_hand(avatar)
    base = avatar.base_rig
    levels = subdivision_levels(base.faces, base.num_vertices, avatar.rounds)
    generator = torch.Generator().manual_seed(3)
    rotations = sampled_poses(avatar, effort.poses, generator, edit.light)
    samples = sample_field(
        avatar,
        rotations,
        generator,
        stages["fields"],
        light=edit.light,
    )
    is_held_out = torch.arange(effort.poses) % _HELD_OUT == 0
    is_held_out = is_held_out.repeat_interleave(rotations.shape[1])
    known, held_out = samples.chosen(~is_held_out), samples.chosen(is_held_out)
    correctives = stored_correctives(fit_correctives(known, hand))
    rest = carried_to_fine(correctives.vertices, levels)
    hand = replace(hand, rest_vertices=rest, rest_joints=correctives.joints)
    stages["surroundings"](0.0)
    near, normals = _shading_normals(avatar, hand)
    capsules = fit_capsules(hand)
    around, around_held_out = (
        surroundings(part, hand, normals, capsules) for part in (known, held_out)
    )
    network = stored_network(
        fit_shading(
            known,
            around,
            levels,
            effort.steps,
            progress=stages["shading network"],
        )
    )
    with torch.no_grad():
        points = hand.rig.sealed(hand.rest_vertices)
        albedo = avatar.albedo(near, avatar.detail_near(hand.rest_vertices, points, near))
    loss = measured_loss(network, held_out, around_held_out, levels, albedo, correctives, hand)
    paint = avatar.edit.then(edit).paint
    coat = None
    if paint is not None:
        whole = torch.cat([paint.colors * paint.opacity[:, None], paint.opacity[:, None]], dim=-1)
        coat = near.interpolated(whole)
    return LightweightHand(
        hand, base.faces, levels, correctives, capsules, network, normals, albedo, coat, loss
    )


def stored_correctives(correctives: PoseCorrectives) -> PoseCorrectives:
    """Correctives as a file gives them back, the shapes scaled to use all of their eight bits."""
    strength = correctives.shapes.abs().amax((1, 2)).clamp_min(1e-12)
    shapes = correctives.shapes / strength[:, None, None]
    return PoseCorrectives(
        quantised(correctives.vertices, "i2").read(),
        correctives.joints,
        quantised(shapes, "i1").read(),
        correctives.joint_shapes / strength[:, None, None],
        correctives.weights * strength[:, None],
    )


@torch.no_grad()
def stored_network(network: ShadingNetwork) -> ShadingNetwork:
    """The network as a file gives it back, the latents scaled to use all of their eight bits."""
    strength = network.latents.abs().amax(0).clamp_min(1e-12)
    network.latents.copy_(quantised(network.latents / strength, "i1").read())
    network.first.weight[:, : len(strength)] *= strength
    return network


def measured_loss(
    network: ShadingNetwork,
    held_out: FieldSamples,
    around: Surroundings,
    levels: list[Subdivision],
    albedo: Float[Tensor, "sealed_vertices 3"],
    correctives: PoseCorrectives,
    hand: ShapedHand,
) -> dict[str, float]:
    """How far a lightweight hand is from the field on the skin, over poses it was not fitted to.

    Returns:
        ``light_rmse``: of the illumination; ``color_psnr`` and ``lifted_color_psnr``: decibels of
        albedo times illumination on the skin, as it is and with lifted shadows; ``surface_mm`` and
        ``surface_p95_mm``: mean and 95th percentile of the distance between its vertices and the
        field's surface; ``poses``: how many were held out.
    """
    plain, lifted = shading_error(network, held_out, around, levels)
    colors = albedo[held_out.points]
    normals = vertex_normals(hand.rig.sealed(hand.rest_vertices), hand.rig.sealed_faces)
    count = held_out.surface.shape[1]
    truth = held_out.rest_vertices + held_out.surface[..., None] * normals[:count]
    amounts = correctives.coefficients(held_out.rotations)
    own = correctives.vertices + torch.einsum("pk,kvc->pvc", amounts, correctives.shapes)
    distance = (own - truth).norm(dim=-1)
    distance = distance[distance.isfinite()].sort().values
    figures = {
        "poses": float(len(held_out.rotations)),
        "light_rmse": float(plain.square().mean().sqrt()),
        "color_psnr": _decibels(colors * plain[..., None]),
        "lifted_color_psnr": _decibels(colors * lifted[..., None]),
    }
    if len(distance):
        figures["surface_mm"] = 1000 * float(distance.mean())
        figures["surface_p95_mm"] = 1000 * float(distance[int(0.95 * (len(distance) - 1))])
    return figures


def _decibels(error: Tensor) -> float:
    return -10 * math.log10(max(float(error.square().mean()), 1e-20))


def _shading_normals(
    avatar: HandAvatar, hand: ShapedHand
) -> tuple[Neighbours, Float[Tensor, "sealed_vertices 3"]]:
    """Nearest anchors of all vertices, and normals as smooth as light sees them: the anchors'."""
    rig = hand.rig
    vertices = rig.sealed(hand.rest_vertices)
    of_anchors = avatar.anchors.positions(vertex_normals(hand.rest_vertices, rig.faces))
    of_anchors = torch.nn.functional.normalize(of_anchors, dim=-1)
    near = nearest_anchors(avatar.anchors.positions(hand.rest_vertices), vertices)
    return near, torch.nn.functional.normalize(near.interpolated(of_anchors), dim=-1)
