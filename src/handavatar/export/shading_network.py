"""A network so small that a vertex shader evaluates it: illumination from pose, place and bones.

The trained illumination field asks an occupancy field, or traces light, and then runs four layers
of 256. Here each vertex has a few latents; what hides it is told by capsules around the bones
(:mod:`handavatar.export.capsules`); the pose, which is the same for all vertices, only sets the
biases of the first of two layers of 32.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from handavatar.export.capsules import Capsules, occlusion_by_bones
from handavatar.export.field_samples import FieldSamples
from handavatar.geometry.meshes import Subdivision, carried_to_fine
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_features import NUM_POSE_FEATURES, pose_features
from handavatar.hand.rig import PosedHand, ShapedHand
from handavatar.jobs.progress import SILENT, Progress

NUM_LATENTS = 8
WIDTH = 32
POSE_WIDTH = 32
STEPS = 3000
_POSES, _POINTS = 16, 512
"""Per step of the fit."""
_LR, _DECAY = 1e-2, 1e-2


class ShadingNetwork(nn.Module):
    """Illumination in (0, 1).

    Attributes:
        latents: of the vertices before subdivision; finer vertices take the mean of their ends.
    """

    def __init__(self, num_vertices: int, light: float = 0.5) -> None:
        """Random weights.

        Args:
            num_vertices: before subdivision.
            light: illumination to begin with.
        """
        super().__init__()
        self.latents = nn.Parameter(0.1 * torch.randn(num_vertices, NUM_LATENTS))
        self.pose_hidden = nn.Linear(NUM_POSE_FEATURES + 6, POSE_WIDTH)
        self.pose_output = nn.Linear(POSE_WIDTH, WIDTH)
        self.first = nn.Linear(NUM_LATENTS + 3 + 2 * NUM_BONES, WIDTH, bias=False)
        self.second = nn.Linear(WIDTH, WIDTH)
        self.output = nn.Linear(WIDTH, 1)
        nn.init.constant_(self.output.bias, float(torch.tensor(light).logit()))

    def biases(self, rotations: Float[Tensor, "poses bones 3"]) -> Float[Tensor, "poses 32"]:
        """What a pose adds in the first layer; the wrist's rotation is the hand's in its light."""
        wrist = matrix_from_axis_angle(rotations[:, 0])[:, :, :2].flatten(1)
        features = torch.cat([wrist, pose_features(rotations)], dim=-1)
        return self.pose_output(self.pose_hidden(features).tanh())

    def forward(
        self,
        biases: Float[Tensor, "poses 32"],
        latents: Float[Tensor, "poses points 8"],
        normals: Float[Tensor, "poses points 3"],
        occlusion: Float[Tensor, "poses points 2 bones"],
    ) -> Float[Tensor, "poses points"]:
        """Illumination of points.

        Args:
            biases: of their poses.
            latents: of the points.
            normals: unit, world.
            occlusion: by the bones, zero for lifted ones.
        """
        inputs = torch.cat([latents, normals, occlusion.flatten(-2)], dim=-1)
        hidden = (self.first(inputs) + biases[:, None]).relu()
        return self.output(self.second(hidden).relu())[..., 0].sigmoid()


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the network sees of the points of :class:`FieldSamples`.

    Attributes:
        normals: unit, world.
        occlusion: by the bones, none lifted.
    """

    normals: Float[Tensor, "poses points 3"]
    occlusion: Float[Tensor, "poses points 2 bones"]


def turned_normals(
    posed: PosedHand, normals: Float[Tensor, "vertices 3"], points: Int[Tensor, "points"]
) -> Float[Tensor, "points 3"]:
    """Rest normals of some vertices, turned as skinning turns what is around them."""
    turn = posed.rig.skin_weights[points] @ posed.world_from_bone[:, :3, :3].flatten(1)
    turned = (turn.unflatten(-1, (3, 3)) @ normals[points, :, None])[..., 0]
    return torch.nn.functional.normalize(turned, dim=-1)


@torch.no_grad()
def surroundings(
    samples: FieldSamples,
    hand: ShapedHand,
    normals: Float[Tensor, "vertices 3"],
    capsules: Capsules,
) -> Surroundings:
    """Normals and occlusion of the samples' points.

    Args:
        samples: whose poses and points.
        hand: the average one, of the fine mesh.
        normals: of its vertices in the zero pose, as shading has them.
        capsules: around its bones.
    """
    rows = []
    for rotations, points in zip(samples.rotations, samples.points, strict=True):
        posed = hand.posed(HandPose(rotations, torch.zeros(3)))
        turned = turned_normals(posed, normals, points)
        ends = capsules.posed(posed.world_from_bone)
        places = posed.vertices[points]
        rows.append(
            (turned, occlusion_by_bones(ends, capsules.radii, capsules.bones, places, turned))
        )
    return Surroundings(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_shading(
    samples: FieldSamples,
    around: Surroundings,
    levels: list[Subdivision],
    steps: int = STEPS,
    seed: int = 0,
    progress: Progress = SILENT,
) -> ShadingNetwork:
    """A network that says of the samples' points what the field says, lifted shadows included.

    Args:
        samples: what the field says.
        around: what the network sees of them.
        levels: of subdivision.
        steps: of the optimisation; every other one sees lifted shadows.
        seed: of the weights and of the draw; the same one gives the same network.
        progress: told the steps done.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        mean = samples.light.mean().clamp(0.01, 0.99)
        network = ShadingNetwork(samples.surface.shape[1], float(mean))
    generator = torch.Generator().manual_seed(seed)
    weights = [value for name, value in network.named_parameters() if name != "latents"]
    groups = [
        {"params": [network.latents], "weight_decay": 0.0},
        {"params": weights, "weight_decay": _DECAY},
    ]
    optimizer = torch.optim.AdamW(groups, lr=_LR)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=_LR, total_steps=max(steps, 2), pct_start=0.1
    )
    num_poses, num_points = samples.points.shape
    for step in range(steps):
        poses = torch.randint(num_poses, (_POSES, 1), generator=generator)
        points = torch.randint(num_points, (_POSES, _POINTS), generator=generator)
        occlusion, light = around.occlusion[poses, points], samples.light[poses, points]
        if step % 2:
            occlusion = shown(occlusion, samples.lifted[poses[:, 0]])
            light = samples.lifted_light[poses, points]
        latents = carried_to_fine(network.latents, levels)[samples.points[poses, points]]
        biases = network.biases(samples.rotations[poses[:, 0]])
        found = network(biases, latents, around.normals[poses, points], occlusion)
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(found, light).backward()
        optimizer.step()
        schedule.step()
        progress(step + 1, steps)
    return network.eval().requires_grad_(False)


def shown(
    occlusion: Float[Tensor, "poses points 2 bones"], lifted: Bool[Tensor, "poses bones"]
) -> Float[Tensor, "poses points 2 bones"]:
    """Occlusion without that by lifted bones."""
    return occlusion.masked_fill(lifted[:, None, None], 0.0)


@torch.no_grad()
def shading_error(
    network: ShadingNetwork,
    samples: FieldSamples,
    around: Surroundings,
    levels: list[Subdivision],
) -> tuple[Float[Tensor, "poses points"], Float[Tensor, "poses points"]]:
    """Illumination by the network less that by the field, without and with lifted shadows."""
    biases = network.biases(samples.rotations)
    latents = carried_to_fine(network.latents, levels)[samples.points]
    lifted = shown(around.occlusion, samples.lifted)
    return (
        network(biases, latents, around.normals, around.occlusion) - samples.light,
        network(biases, latents, around.normals, lifted) - samples.lifted_light,
    )
