"""Which parts of the skin a capture has seen, and which nobody will ever know."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.capture.frames import Frame
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import face_cross_products, vertex_normals
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import rasterize

# Cosine between normal and line of sight: flatter skin has hardly a pixel.
_FACING = 0.3
# Metres behind the nearest surface at which a vertex counts as hidden.
_HIDDEN = 0.003
# Of a region: as much of it must be unseen to be named.
_NAMED = 0.5
_BONES = {name: number for number, name in enumerate(BONE_NAMES)}
_SIDES = ("palm", "back", "thumb's side", "little finger's side")


@dataclass(frozen=True, eq=False)
class SeenSkin:
    """How often the skin was seen.

    Attributes:
        counts: of each vertex of the rig, frames that saw it from the front.
        unseen_share: of the skin's area, in [0, 1].
        unseen_regions: names of those of which most was never seen, and how much of each.
    """

    counts: Int[Tensor, "vertices"]
    unseen_share: float
    unseen_regions: dict[str, float]


@torch.no_grad()
def count_seen_skin(
    rig: Rig, coefficients: Float[Tensor, "shapes"], frames: Sequence[Frame]
) -> SeenSkin:
    """In how many frames each vertex faces the camera, unhidden, in a known pixel.

    Args:
        rig: the poses' own.
        coefficients: of its shape.
        frames: cameras and poses as fitted.
    """
    hand = rig.shaped(coefficients)
    counts = torch.zeros(rig.num_vertices, dtype=torch.long)
    for frame in frames:
        vertices = hand.posed(frame.pose).vertices
        counts += seen_vertices(vertices, rig.faces, frame.camera, frame.known)
    area = vertex_areas(hand.rest_vertices, rig.faces)
    unseen = area * (counts == 0)
    return SeenSkin(counts, float(unseen.sum() / area.sum()), unseen_regions(rig, area, unseen))


def vertex_areas(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "vertices"]:
    """A third of each face's area for each of its corners, square metres.

    Args:
        vertices: of a mesh, metres.
        faces: of the mesh.
    """
    area = torch.zeros(len(vertices))
    per_corner = face_cross_products(vertices, faces).norm(dim=-1) / 6
    return area.index_add_(0, faces.flatten(), per_corner.repeat_interleave(3))


def unseen_regions(
    rig: Rig, area: Float[Tensor, "vertices"], unseen: Float[Tensor, "vertices"]
) -> dict[str, float]:
    """Names of the regions of which most was never seen, and how much of each, in [0, 1].

    Args:
        rig: its vertices have regions.
        area: of the skin that belongs to each vertex, in any unit.
        unseen: of it, what nobody has seen.
    """
    shares = {
        name: float(unseen[vertices].sum() / area[vertices].sum().clamp_min(1e-12))
        for name, vertices in skin_regions(rig).items()
    }
    return {name: round(share, 3) for name, share in shares.items() if share > _NAMED}


@torch.no_grad()
def seen_vertices(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    camera: Camera,
    known: Bool[Tensor, "height width"],
    least_cosine: float = _FACING,
) -> Bool[Tensor, "vertices"]:
    """Which vertices of a mesh face the camera, unhidden, in a known pixel.

    Args:
        vertices: of the posed hand, metres, world.
        faces: of its mesh.
        camera: of the picture.
        known: pixels of it that show what is there.
        least_cosine: between normal and line of sight; flatter skin counts as not seen.
    """
    camera = camera.to(vertices.device)
    pixels, depths = project(camera, vertices)
    rotation, shift = camera.camera_from_world.split([3, 1], dim=-1)
    eye = -(rotation[:3].T @ shift[:3, 0])
    towards = torch.nn.functional.normalize(eye - vertices, dim=-1)
    faces_camera = (vertex_normals(vertices, faces) * towards).sum(-1) > least_cosine
    x, y = pixels.floor().long().unbind(-1)
    is_inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    x, y = x.clamp(0, camera.width - 1), y.clamp(0, camera.height - 1)
    nearest = rasterize(vertices, faces, camera).depth
    known = known.to(vertices.device)
    return faces_camera & is_inside & known[y, x] & (depths < nearest[y, x] + _HIDDEN)


def skin_regions(rig: Rig) -> dict[str, Int[Tensor, "_"]]:
    """Vertices of the palm, the back, the edges of the hand and the four sides of every finger."""
    rest = rig.shaped()
    joints, normals = rest.rest_joints, vertex_normals(rest.rest_vertices, rig.faces)
    fingers = torch.nn.functional.normalize(joints[_BONES["middle1"]] - joints[0], dim=0)
    thumb = joints[_BONES["index1"]] - joints[_BONES["little1"]]
    thumb = torch.nn.functional.normalize(thumb - (thumb @ fingers) * fingers, dim=0)
    # Of a right hand.
    back = torch.linalg.cross(fingers, thumb)
    labels = rig.skin_weights.argmax(-1)
    regions = {}
    parts = {"": (0,), **FINGER_BONES}
    for part, bones in parts.items():
        mine = torch.isin(labels, torch.tensor(bones))
        up, aside = back, thumb
        if part == "thumb":
            # The thumb's nail looks to the thumb's side of the hand.
            up, aside = _axes_of_thumb(rig, joints, back)
        values = torch.stack([normals @ -up, normals @ up, normals @ aside, normals @ -aside])
        side = values.argmax(0)
        for number, name in enumerate(_SIDES):
            chosen = (mine & (side == number)).nonzero()[:, 0]
            if len(chosen):
                regions[_region_name(part, name)] = chosen
    return regions


def _axes_of_thumb(
    rig: Rig, joints: Float[Tensor, "bones 3"], back: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Away from the thumb's pad, and away from the fingers; its joints bend about their axes."""
    bones = FINGER_BONES["thumb"]
    along = torch.nn.functional.normalize(joints[bones[-1]] - joints[bones[0]], dim=0)
    bending = torch.nn.functional.normalize(rig.joint_axes[bones[-1], 0], dim=0)
    nail = torch.nn.functional.normalize(torch.linalg.cross(along, bending), dim=0)
    little = joints[_BONES["little1"]] - joints[bones[-1]]
    nail = nail if float(nail @ little) < 0 else -nail
    aside = torch.linalg.cross(nail, along)
    return nail, aside if float(aside @ back) < 0 else -aside


def _region_name(part: str, side: str) -> str:
    if not part:
        return {"palm": "palm", "back": "back"}.get(side, f"edge on the {side}")
    if part == "thumb":
        side = {
            "palm": "pad's side",
            "back": "nail's side",
            _SIDES[2]: "palm's side",
            _SIDES[3]: "back's side",
        }[side]
        return f"thumb, {side}"
    return f"{part} finger, {'palm side' if side == 'palm' else side}"
