"""Measures of surfaces: fields whose faults are known, slow references, laws."""

import math

import pytest
import torch

from handavatar.evaluate.geometry import (
    CONTACT_REACH,
    Skin,
    Truth,
    chamfer,
    contact_errors,
    roughness,
    seams,
)
from handavatar.geometry.extraction import ExtractedSurface, Field
from handavatar.geometry.meshes import unique_edges, vertex_normals
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.surface import extract_hand

RESOLUTION = 48


def _truth(gesture: str) -> Truth:
    rig = load_open_hand("778")
    pose = HandPose(gesture_rotations(rig, gesture), torch.zeros(3))
    return Truth(rig.shaped().posed(pose), Skin.of(rig))


@pytest.fixture(scope="module")
def flat() -> Truth:
    return _truth("flat")


@pytest.fixture(scope="module")
def fist() -> Truth:
    return _truth("fist")


def _extracted(truth: Truth, field: Field) -> ExtractedSurface:
    boxes = divide_into_parts(truth.hand.rig).boxes(truth.hand, 0.0)
    return extract_hand(field, boxes, truth.hand, RESOLUTION)


@pytest.fixture(scope="module")
def exact(flat: Truth) -> ExtractedSurface:
    return _extracted(flat, flat.occupancy)


def test_roughness_is_that_of_a_loop_and_grows_with_noise(exact: ExtractedSurface) -> None:
    vertices, faces = exact.vertices[:], exact.faces
    neighbours: dict[int, list[int]] = {}
    for a, b in unique_edges(faces).tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    slow = [
        float((vertices[around].mean(0) - vertices[vertex]).norm())
        for vertex, around in neighbours.items()
    ]
    smooth = roughness(vertices, faces)
    assert smooth == pytest.approx(sum(slow) / len(slow), rel=1e-4)
    noise = 1e-3 * torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0))
    assert roughness(vertices + noise, faces) > smooth + 5e-4


def test_a_perfect_field_has_no_distance_and_a_swollen_one_its_swelling(
    flat: Truth, exact: ExtractedSurface
) -> None:
    distance = chamfer(exact.vertices, exact.faces, flat)
    # Vertices lie on a linear interpolation of the true distance; chords sag by h^2 / 8r.
    assert distance.to_truth < 0.03 * exact.voxel
    assert distance.from_truth < 0.15 * exact.voxel
    assert distance.mean == (distance.to_truth + distance.from_truth) / 2
    thick = _extracted(flat, lambda p: torch.sigmoid(1000 * (flat.signed_distances(p) + 2e-3)))
    swollen = chamfer(thick.vertices, thick.faces, flat)
    # The cut at the wrist does not swell; chords of 4.5 mm cut the corners off fingertips.
    assert 1.7e-3 < swollen.to_truth < 2.05e-3
    assert 1.5e-3 < swollen.from_truth < 2.05e-3
    # A missing thumb is noticed from the truth's side only.
    kept = (exact.vertices[exact.faces][..., 2] < 0.04).all(-1)
    lost = chamfer(exact.vertices, exact.faces[kept], flat)
    assert lost.to_truth == pytest.approx(distance.to_truth)
    assert lost.from_truth > distance.from_truth + 1e-3


def test_steps_at_part_borders_show_and_even_swelling_does_not(flat: Truth) -> None:
    """The truth's own mesh, finer, with some parts thicker or all."""
    fine = subdivided(flat.hand.rig, 2)
    vertices, faces = fine.template_vertices, fine.faces
    labels = fine.skin_weights.argmax(-1)
    fingertips = torch.tensor([bones[-1] for bones in FINGER_BONES.values()])
    outward = 1e-3 * vertex_normals(vertices, faces)
    is_tip = torch.isin(labels, fingertips)[:, None]
    smooth, step, swollen = (
        seams(places, faces, flat)
        for places in (vertices, vertices + is_tip * outward, vertices + outward)
    )
    assert abs(smooth.excess) < math.radians(2) and smooth.step < 1e-6
    # Five of nineteen borders have a step of 1 mm, smeared over the faces that straddle it.
    assert 1e-4 < step.step < 5e-3 / 19 and swollen.step < 0.2 * step.step
    assert step.excess > smooth.excess + math.radians(0.9)
    assert step.worst_angle > smooth.worst_angle + math.radians(5)
    assert abs(swollen.excess - smooth.excess) < math.radians(0.3)


def test_contacts_are_where_fingers_touch_and_nowhere_on_a_flat_hand(
    flat: Truth, fist: Truth
) -> None:
    assert len(flat.contacts) == 0 and contact_errors(flat.occupancy, flat, _random()) is None
    assert len(fist.contacts) > 20
    # Each place is near the skin of two parts at least that are not joined.
    near = torch.cdist(fist.contacts, fist.vertices) < 0.004
    for vertices in near:
        apart = fist.skin.distances[:, vertices.nonzero()[:, 0]].amax(1)
        assert float(apart.max()) > 0.012
    # Only the webs between the fingers are so narrow that a vertex may count as buried.
    assert float(flat.is_outmost.float().mean()) > 0.995
    assert 0.5 < float(fist.is_outmost.float().mean()) < 0.99


def test_contact_errors_are_those_of_the_field(fist: Truth) -> None:
    perfect = contact_errors(fist.occupancy, fist, _random(), 500)
    full = contact_errors(lambda points: torch.ones(len(points)), fist, _random(), 500)
    empty = contact_errors(lambda points: torch.zeros(len(points)), fist, _random(), 500)
    assert perfect is not None and full is not None and empty is not None
    assert (perfect.whole, perfect.flesh, perfect.gap) == (0, 0, 0)
    assert (full.flesh, full.gap, empty.flesh, empty.gap) == (0, 1, 1, 0)
    assert full.whole + empty.whole == pytest.approx(1) and 0.02 < full.whole < 0.98


def test_contacts_are_judged_in_balls_about_them(fist: Truth) -> None:
    """Evenly: an eighth of the points lies within half of the reach."""
    truth = Truth(fist.hand, fist.skin)
    truth.__dict__["contacts"] = fist.contacts[:1]
    asked = []

    def field(points: torch.Tensor) -> torch.Tensor:
        asked.append((points - fist.contacts[0]).norm(dim=-1))
        return torch.zeros(len(points))

    contact_errors(field, truth, _random(), 4000)
    distances = torch.cat(asked)
    assert float(distances.max()) <= CONTACT_REACH
    # Three standard deviations of a share of 1/8 among 4000.
    half = float((distances < CONTACT_REACH / 2).float().mean())
    assert half == pytest.approx(1 / 8, abs=0.016)


def test_skin_that_is_buried_in_folds_is_missed_by_nobody(fist: Truth) -> None:
    """Of a fist without the faces that nobody can see from outside nothing is missing."""
    is_outside = fist.is_outmost[fist.faces].any(-1)
    assert 10 < int((~is_outside).sum()) < 200
    found = chamfer(fist.vertices, fist.faces[is_outside], fist)
    # In float32: vertices of a mesh lie on its own faces.
    assert found.from_truth < 1e-7


def _random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_distances_along_the_skin_are_zero_on_the_part_and_grow_away(flat: Truth) -> None:
    distances, labels = flat.skin.distances, flat.skin.labels
    assert bool(torch.isfinite(distances).all())
    for bone in range(NUM_BONES):
        assert float(distances[bone][labels == bone].max()) == 0
    places = flat.vertices.double()
    straight = torch.cdist(places, places)
    shortest = torch.stack([straight[:, labels == bone].amin(1) for bone in range(NUM_BONES)])
    assert float((distances - shortest).min()) > -1e-6
    tips = [FINGER_BONES["index"][-1], FINGER_BONES["middle"][-1]]
    assert float(distances[tips[0]][labels == tips[1]].min()) > 4 * CONTACT_REACH
