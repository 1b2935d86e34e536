"""A personal textured mesh under harmonics of the normal: the idea of HARP and SelfRecon.

The personal mesh of the capture is rasterised, its texture is a colour per texel, and light is a
function of the normal alone, nine harmonics in the world's axes. Nothing casts a shadow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.evaluate.descent import descend
from handavatar.field.anchors import Neighbours, nearest_anchors
from handavatar.geometry.meshes import SurfacePoints, sample_surface, vertex_normals
from handavatar.render.rasterize import interpolate, rasterize

NUM_TEXELS = 30_000
"""A texel each 1.3 mm: finer than the pictures' pixels."""
RAYS = 2
"""Of a pixel in each direction: the outline is as smooth as ours."""
_PIXELS, _RATE = 4096, 3e-2


class TexturedMesh(nn.Module):
    """Texture times light."""

    def __init__(self, num_texels: int, color: Float[Tensor, "3"]) -> None:
        """One colour under even light.

        Args:
            num_texels: points on the surface that carry a colour.
            color: mean of the hand's pixels.
        """
        super().__init__()
        start = torch.logit((color / 0.65).clamp(0.05, 0.95))
        self.texture = nn.Parameter(start.expand(num_texels, 3).clone())
        light = torch.zeros(9)
        light[0] = 0.65
        self.light = nn.Parameter(light)

    def forward(
        self, neighbours: Neighbours, normals: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points 3"]:
        """Colours in [0, 1] and above."""
        texture = neighbours.interpolated(self.texture).sigmoid()
        return texture * (harmonics(normals) @ self.light).clamp_min(0)[:, None]


def harmonics(normals: Float[Tensor, "points 3"]) -> Float[Tensor, "points 9"]:
    """Nine polynomials of the normal that hold diffuse light (Ramamoorthi and Hanrahan 2001)."""
    x, y, z = normals.unbind(-1)
    columns = [torch.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    return torch.stack(columns, dim=-1)


@dataclass(frozen=True, eq=False)
class MeshPoints:
    """Surface points behind a picture's rays.

    Attributes:
        pixels: the pixel of each point; a pixel has up to four.
        neighbours: nearest texels.
        normals: unit, world.
    """

    pixels: Int[Tensor, "points"]
    neighbours: Neighbours
    normals: Float[Tensor, "points 3"]


@torch.no_grad()
def mesh_points(
    avatar: HandAvatar, texels: SurfacePoints, frame: Frame, rays: int = RAYS
) -> MeshPoints:
    """Rasterises the personal mesh in the frame's pose, ``rays`` a pixel in each direction."""
    pose, camera = frame.pose.to(avatar.device), frame.camera.to(avatar.device)
    posed = avatar.personal(pose).posed(pose)
    fine = camera.resized(rays * camera.width, rays * camera.height)
    fragments = rasterize(posed.vertices, avatar.rig.faces, fine)
    y, x = fragments.mask.nonzero().unbind(-1)
    normals = vertex_normals(posed.vertices, avatar.rig.faces)
    values = torch.cat([posed.vertices, normals], dim=-1)
    found = interpolate(fragments, avatar.rig.faces, values)[y, x]
    neighbours = nearest_anchors(texels.positions(posed.vertices), found[:, :3])
    pixels = (y // rays) * camera.width + x // rays
    normals = nn.functional.normalize(found[:, 3:], dim=-1).cpu()
    neighbours = Neighbours(neighbours.indices.cpu(), neighbours.weights.cpu())
    return MeshPoints(pixels.cpu(), neighbours, normals)


def fit_textured_mesh(
    avatar: HandAvatar,
    frames: Sequence[Frame],
    color: Float[Tensor, "3"],
    steps: int,
    seed: int,
    rays: int = RAYS,
) -> Callable[[Frame], Float[Tensor, "height width 4"]]:
    """Fits texture and light to the known pixels of the frames, without their gain.

    Args:
        avatar: its personal mesh and nothing else.
        frames: of training, each in the pose that the mesh shall have.
        color: mean of their hand pixels.
        steps: of Adam.
        seed: of texels and pixels.
        rays: of a pixel in each direction, in the frames that it learns from.

    Returns:
        Colour on black and coverage of another frame's pose and camera, as the capture's average
        picture is exposed.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    vertices, faces = avatar.rig.template_vertices.cpu(), avatar.rig.faces.cpu()
    found = sample_surface(vertices, faces, NUM_TEXELS, generator)
    device = avatar.device
    texels = SurfacePoints(found.faces.to(device), found.barycentric.to(device))
    mesh = TexturedMesh(NUM_TEXELS, color)
    indices, weights, normals, truth = [], [], [], []
    for frame in frames:
        points = mesh_points(avatar, texels, frame, rays)
        image = frame.colors.flatten(0, 1)[points.pixels]
        # Pixels that the hand covers in part show background as well.
        kept = ((frame.alpha > 0.99) & frame.known).flatten()[points.pixels]
        indices.append(points.neighbours.indices[kept])
        weights.append(points.neighbours.weights[kept])
        normals.append(points.normals[kept])
        truth.append(image[kept])
    index, weight, normal, colors = (
        torch.cat(parts) for parts in (indices, weights, normals, truth)
    )

    def loss() -> Tensor:
        chosen = torch.randint(len(colors), (_PIXELS,), generator=generator)
        found = mesh(Neighbours(index[chosen], weight[chosen]), normal[chosen])
        return (found - colors[chosen]).abs().mean()

    descend(mesh, loss, steps, _RATE)

    @torch.no_grad()
    def picture(frame: Frame) -> Tensor:
        points = mesh_points(avatar, texels, frame)
        values = mesh(points.neighbours, points.normals).clamp(0, 1)
        values = torch.cat([values, torch.ones_like(values[:, :1])], dim=-1) / RAYS**2
        flat = values.new_zeros(frame.camera.height * frame.camera.width, 4)
        flat.index_add_(0, points.pixels, values)
        return flat.view(frame.camera.height, frame.camera.width, 4)

    return picture
