import pytest
import torch
import trimesh
from torch import Tensor

from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.render.skylight import even_directions, sky_light


def square(half: float, height: float) -> tuple[Tensor, Tensor]:
    corners = torch.tensor([[-half, -half], [half, -half], [half, half], [-half, half]])
    vertices = torch.cat([corners, torch.full((4, 1), height)], dim=-1)
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_directions_are_unit_and_even() -> None:
    directions = even_directions(200)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(200))
    assert float(directions.mean(0).norm()) < 0.01
    nearest = (directions @ directions.T - 2 * torch.eye(200)).amax(-1).clamp(-1, 1).acos()
    # An even lattice of n points has neighbours about sqrt(4 pi / n) apart.
    assert float(nearest.min()) > 0.7 * (4 * torch.pi / 200) ** 0.5
    with pytest.raises(ValueError, match="at least 1"):
        even_directions(0)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_shadow_ends_below_the_edge_that_casts_it(axis: int) -> None:
    """A square over a line of points, moved by parts of a pixel of the depth picture."""
    steps = torch.linspace(-0.1, 0.1, 2001)
    points = torch.zeros(len(steps), 3)
    points[:, axis] = steps
    up = torch.tensor([[0.0, 0.0, 1.0]])
    ground, ground_faces = square(0.2, -0.01)
    beside = []
    for part in range(10):
        roof, faces = square(0.05, 0.05)
        edge = 0.02 + 0.0005 * part
        roof[:, axis] += edge - 0.05
        vertices = torch.cat([ground, roof])
        light = sky_light(
            vertices, torch.cat([ground_faces, faces + 4]), points, up.expand_as(points), up
        )[:, 0]
        assert float(light.min()) >= 0 and float(light.max()) <= 1 + 1e-5
        # As much light as there is beyond the edge, in metres; the other edge lies outside.
        seen = light[steps > edge - 0.05].sum() * float(steps[1] - steps[0])
        beside.append(0.1 - float(seen) - edge)
    # The picture spans 0.58 m with 128 pixels, 4.5 mm each; its edges err by half of one either
    # way, and by a tenth on the average.
    assert abs(sum(beside) / len(beside)) < 0.0009


def test_a_ball_sees_half_of_the_sky() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    vertices = torch.from_numpy(ball.vertices).float()
    normals = torch.nn.functional.normalize(vertices, dim=-1)
    directions = even_directions(100)
    light = sky_light(vertices, torch.from_numpy(ball.faces), vertices, normals, directions)
    cosine = normals @ directions.T
    assert float(light[cosine <= 0].max()) == 0
    # Nothing hides another part of a ball; near the horizon the facets may.
    is_high = cosine > 0.2
    torch.testing.assert_close(light[is_high], cosine[is_high], atol=1e-5, rtol=0)


def test_a_plate_casts_its_shadow_where_the_light_says() -> None:
    floor, floor_faces = square(0.1, 0.0)
    plate, plate_faces = square(0.02, 0.05)
    vertices, faces = torch.cat([floor, plate]), torch.cat([floor_faces, plate_faces + 4])
    across = torch.linspace(-0.09, 0.09, 181)
    points = torch.stack([across, torch.zeros(181), torch.zeros(181)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(181, 3)
    slope = torch.nn.functional.normalize(torch.tensor([0.6, 0.0, 0.8]), dim=0)
    light = sky_light(vertices, faces, points, up, torch.stack([up[0], slope, -slope]))
    # The slanted light moves the shadow by height times 0.6 / 0.8 away from it.
    for number, middle in ((0, 0.0), (1, -0.05 * 0.75)):
        distance = (across - middle).abs()
        assert float(light[distance < 0.017, number].max()) == 0
        assert float(light[distance > 0.023, number].min()) > 0.79
    assert float(light[:, 2].abs().max()) == 0


@pytest.mark.parametrize("gesture", ["fist", "flat", "pinch"])
def test_a_hand_agrees_with_rays_through_its_triangles(gesture: str) -> None:
    rig = load_open_hand("778")
    pose = HandPose(gesture_rotations(rig, gesture), torch.zeros(3))
    vertices = rig.shaped().posed(pose).vertices
    normals = vertex_normals(vertices, rig.faces)
    directions = even_directions(12)
    light = sky_light(vertices, rig.faces, vertices, normals, directions)
    cosine = normals @ directions.T
    start = vertices + 1.5e-3 * normals
    is_free = torch.stack(
        [~hits_a_triangle(vertices, rig.faces, start, direction) for direction in directions], dim=1
    )
    expected = cosine.clamp_min(0) * is_free
    wrong = (light - expected).abs()
    # Only at the edge of a shadow, a pixel of 1.5 mm wide, may they differ.
    assert float(wrong.mean()) < 0.01
    assert float((wrong > 0.5 * cosine.clamp_min(0.2)).float().mean()) < 0.02


def hits_a_triangle(vertices: Tensor, faces: Tensor, origins: Tensor, direction: Tensor) -> Tensor:
    """Moeller and Trumbore, every ray against every triangle, float64."""
    a, b, c = vertices.double()[faces].unbind(1)
    direction = direction.double()
    edge, other = b - a, c - a
    across = torch.linalg.cross(direction.expand_as(other), other)
    determinant = (edge * across).sum(-1)
    offset = origins.double()[:, None] - a
    u = (offset * across).sum(-1) / determinant
    q = torch.linalg.cross(offset, edge.expand_as(offset))
    v = q @ direction / determinant
    t = (q * other).sum(-1) / determinant
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any(1)
