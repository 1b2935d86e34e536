"""How deep a prior's groove is where one part hands over to another at the thumb's base of a fist.

python scripts/groove.py [PRIOR.safetensors ...]
"""

import sys
from pathlib import Path

import torch

from handavatar.field.occupancy import PairOccupancy
from handavatar.geometry.meshes import distance_to_mesh, is_inside, unique_edges, vertex_normals
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, finer_rig
from handavatar.hand.pose import BONE_NAMES, HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.surface import extract_hand
from handavatar.train.prior import SHIPPED_PRIOR, open_prior

REACH = 0.0005
"""Metres from where the deciding part changes that are judged."""


@torch.no_grad()
def groove(path: Path) -> float:
    """Mean height of the extracted surface over the truth there, millimetres; below 0: a groove."""
    base = load_open_hand("full")
    rig, parts = finer_rig(base, POINT_ROUNDS)
    hand = rig.shaped().posed(HandPose(gesture_rotations(base, "fist"), torch.zeros(3)))
    prior = open_prior(path)
    assert isinstance(prior, PairOccupancy), "only PairOF tells which part decides"
    codes = prior.encode(parts, hand)
    surface = extract_hand(lambda points: prior(codes, points).whole, codes.boxes, hand, 128)
    vertices, faces = surface.vertices, surface.faces
    within = prior(codes, vertices - 0.0002 * vertex_normals(vertices, faces)).items
    deciding = torch.full((len(vertices),), -1)
    deciding[within.points] = prior.pairs[within.pairs][within.is_wanted]
    edges = unique_edges(faces)
    names = {BONE_NAMES.index("wrist"), BONE_NAMES.index("thumb1")}
    is_border = torch.tensor([set(pair) == names for pair in deciding[edges].tolist()])
    border = vertices[edges[is_border]].mean(1)
    near = vertices[torch.cdist(vertices, border).amin(1) < REACH]
    height = distance_to_mesh(hand.sealed_vertices, rig.sealed_faces, near)
    inside = is_inside(hand.sealed_vertices, rig.sealed_faces, near)
    return 1e3 * float(torch.where(inside, -height, height).mean())


for path in [Path(word) for word in sys.argv[1:]] or [SHIPPED_PRIOR]:
    print(f"{path}: {groove(path):+.3f} mm")
