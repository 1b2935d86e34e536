"""Known poses come back from what a camera would see of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float, Int
from mano_files import write_mano
from torch import Tensor

from handavatar.capture.fitted_hand import HandFit, HandModel, projected
from handavatar.capture.fitting import (
    FitOptions,
    Observations,
    OutlinePairs,
    fit_hands,
    frame_energy,
    initial_fit,
    landmark_errors,
    placed,
    refined,
    retried,
)
from handavatar.capture.outlines import (
    OutlineMatcher,
    is_behind_wrist,
    mask_outline,
    silhouette,
)
from handavatar.capture.tracking import LANDMARK_NAMES
from handavatar.capture.windows import Window, window_camera
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import (
    angles_from_rotations,
    gesture_rotations,
    interpolate_rotations,
    limit_excess,
    rotations_from_angles,
)
from handavatar.hand.rig import Rig

PICTURE = (1280, 720)
CENTER = (640.0, 360.0)
FOCAL = 1280.0
FRAMES = 6


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_open_hand("778")


@pytest.fixture(scope="module")
def truth(rig: Rig) -> HandFit:
    """A hand that goes from spread to pinch, palm to the camera, fingers up, slightly turning."""
    keys = torch.stack([gesture_rotations(rig, name) for name in ("spread", "relaxed", "pinch")])
    rotations = interpolate_rotations(keys, torch.linspace(0, 2, FRAMES))
    # Rest axes are fingers -x, back +y, thumb +z; the camera looks along +z with y downwards.
    upright = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for frame in range(FRAMES):
        turn = matrix_from_axis_angle(torch.tensor([0.1, 0.15 * (frame - 2), 0.05 * frame]))
        rotations[frame, 0] = axis_angle_from_matrix(turn @ upright)
    steps = torch.arange(FRAMES)[:, None] * torch.tensor([0.004, 0.002, 0.003])
    shape = torch.zeros(rig.shape_directions.shape[-1])
    shape[0] = 0.7
    return HandFit(
        rotations,
        torch.tensor([0.02, 0.09, 0.7]) + steps,
        shape,
        torch.tensor(math.log(FOCAL)),
        torch.zeros(21, 3),
    )


def _seen(rig: Rig, truth: HandFit) -> Observations:
    model = HandModel(rig)
    points = model.landmarks(truth)
    return Observations(
        landmarks=projected(points, truth.log_focal.exp(), CENTER),
        uncertainty=torch.full((len(points), 21), 0.5),
        world_landmarks=points - points.mean(1, keepdim=True),
        scale=FOCAL / points[..., 2].mean(1),
        times=torch.arange(len(points)) / 10,
        picture_size=PICTURE,
        principal_point=CENTER,
    )


def _relative(points: Float[Tensor, "frames 21 3"]) -> Float[Tensor, "frames 21 3"]:
    return points - points[:, :1]


def test_landmarks_are_joints_and_fingertips_in_the_tracker_s_order(
    rig: Rig, truth: HandFit
) -> None:
    points = HandModel(rig).landmarks(truth)
    pose = HandPose(truth.rotations, truth.translation)
    hand = rig.shaped(truth.shape_coefficients).posed(pose)
    by_name = dict(zip(LANDMARK_NAMES, points.unbind(1), strict=True))
    assert torch.allclose(by_name["wrist"], hand.joints[:, 0], atol=1e-5)
    assert torch.allclose(by_name["little_pip"], hand.joints[:, 8], atol=1e-5)
    assert torch.allclose(by_name["thumb_ip"], hand.joints[:, 15], atol=1e-5)
    tips = hand.vertices[:, rig.vertex_sets["fingertips"]]
    # A tip is taken to move with its last bone alone; its vertex may lean on the one before.
    for number, finger in enumerate(("thumb", "index", "middle", "ring", "little")):
        assert (by_name[f"{finger}_tip"] - tips[:, number]).norm(dim=-1).max() < 5e-4


def test_single_vertices_equal_the_rig_s(rig: Rig, truth: HandFit) -> None:
    model = HandModel(rig)
    chosen = torch.randint(0, rig.num_vertices, (FRAMES, 50), generator=torch.manual_seed(0))
    pose = HandPose(truth.rotations, truth.translation)
    expected = rig.shaped(truth.shape_coefficients).posed(pose).vertices
    picked = expected.gather(1, chosen[..., None].expand(-1, -1, 3))
    assert torch.allclose(model.vertices(truth, chosen), picked, atol=1e-5)
    assert torch.allclose(model.all_vertices(truth), expected, atol=1e-5)


@pytest.fixture(scope="module")
def blended_rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """MANO's layout, with pose blend shapes that move every vertex by millimetres.

    The fingertips hang on their last bones alone, as landmarks are taken to.
    """
    rig = read_mano(write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")).rig
    weights, tips = rig.skin_weights.clone(), rig.vertex_sets["fingertips"]
    weights[tips] = torch.eye(NUM_BONES)[weights[tips].argmax(1)]
    return replace(rig, skin_weights=weights)


def _any_fit(rig: Rig, frames: int, seed: int) -> HandFit:
    """Any shape in any poses; rotations and shape ask for gradients."""
    generator = torch.Generator().manual_seed(seed)
    shape = torch.randn(rig.shape_directions.shape[-1], generator=generator)
    rotations = 0.6 * torch.randn(frames, NUM_BONES, 3, generator=generator)
    return HandFit(
        rotations.requires_grad_(),
        torch.randn(frames, 3, generator=generator),
        shape.requires_grad_(),
        torch.tensor(math.log(FOCAL)),
        torch.zeros(21, 3),
    )


def test_pose_blend_shapes_move_landmarks_and_vertices_as_they_move_the_rig(
    blended_rig: Rig,
) -> None:
    rig, model = blended_rig, HandModel(blended_rig)
    plain = HandModel(replace(rig, pose_directions=torch.zeros(778, 3, 0)))
    tips = rig.vertex_sets["fingertips"]
    is_tip = torch.tensor([name.endswith("_tip") for name in LANDMARK_NAMES])
    for seed in range(3):
        fit = _any_fit(rig, FRAMES, seed)
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randint(rig.num_vertices, (FRAMES, 50), generator=generator)
        hand = rig.shaped(fit.shape_coefficients).posed(HandPose(fit.rotations, fit.translation))
        pairs = {
            "tips": (model.landmarks(fit)[:, is_tip], hand.vertices[:, tips]),
            "joints": (model.landmarks(fit)[:, 1:4], hand.joints[:, 13:16]),
            "vertices": (
                model.vertices(fit, chosen),
                hand.vertices.gather(1, chosen[..., None].expand(-1, -1, 3)),
            ),
        }
        # The fit learns by gradients: they must be the rig's too.
        learned = [fit.rotations, fit.shape_coefficients]
        for name, (found, expected) in pairs.items():
            torch.testing.assert_close(found, expected, atol=2e-6, rtol=0, msg=name)
            weights = torch.randn(found.shape, generator=generator)
            torch.testing.assert_close(
                torch.autograd.grad((found * weights).sum(), learned, retain_graph=True),
                torch.autograd.grad((expected * weights).sum(), learned, retain_graph=True),
                atol=2e-5,
                rtol=1e-4,
                msg=name,
            )
        torch.testing.assert_close(model.all_vertices(fit), hand.vertices, atol=2e-6, rtol=0)
        moved = (model.landmarks(fit) - plain.landmarks(fit)).detach().norm(dim=-1)
        assert float(moved[:, ~is_tip].max()) == 0 and float(moved[:, is_tip].max()) > 3e-3


def test_placing_is_exact_for_a_known_pose(rig: Rig, truth: HandFit) -> None:
    model, seen = HandModel(rig), _seen(rig, truth)
    away = HandFit(**{**vars(truth), "translation": torch.zeros(FRAMES, 3)})
    assert torch.allclose(placed(model, seen, away).translation, truth.translation, atol=1e-4)


def test_known_poses_come_back_from_their_landmarks(rig: Rig, truth: HandFit) -> None:
    model, seen = HandModel(rig), _seen(rig, truth)
    fit = fit_hands(rig, seen, FitOptions(landmark_steps=200))
    # The tracker's own noise is several pixels; the fit must add little to it.
    assert landmark_errors(model, seen, fit).max() < 2.0
    # One camera cannot tell a large hand from a near one: only the ratio is determined.
    found, true = _relative(model.landmarks(fit)), _relative(model.landmarks(truth))
    size = found.norm(dim=-1).mean() / true.norm(dim=-1).mean()
    assert 0.9 < size < 1.1
    assert (found / size - true).norm(dim=-1).median() < 0.005
    ratio = fit.focal / fit.translation[:, 2] * truth.translation[:, 2] / truth.focal
    assert torch.allclose(size * ratio, torch.ones(FRAMES), atol=0.05)


def test_joints_are_not_bent_beyond_what_hands_can(rig: Rig, truth: HandFit) -> None:
    """Landmarks that show an index finger bent backwards by 50 degrees do not make it so."""
    rotations = truth.rotations.clone()
    middle = FINGER_BONES["index"][1]
    angles = angles_from_rotations(rig, rotations)
    angles[:, middle] = torch.tensor([-50.0, 0, 0]).deg2rad()
    rotations[:, middle] = rotations_from_angles(rig, angles)[:, middle]
    impossible = replace(truth, rotations=rotations)
    assert float(limit_excess(rig, rotations)[:, middle].min()) > math.radians(49)
    model, seen = HandModel(rig), _seen(rig, impossible)
    fit = refined(model, seen, truth, FitOptions(), steps=40)
    # A tenth of it: the limits give way by some degrees. Without them it is bent by 38.
    assert float(limit_excess(rig, fit.rotations)[:, 1:].max()) < math.radians(5)


def test_noise_of_single_frames_does_not_make_the_hand_tremble(rig: Rig, truth: HandFit) -> None:
    model, seen = HandModel(rig), _seen(rig, truth)
    noise = 6 * torch.randn(FRAMES, 21, 2, generator=torch.manual_seed(2))
    shaken = replace(seen, landmarks=seen.landmarks + noise)

    def trembling(options: FitOptions) -> float:
        fit = refined(model, shaken, truth, options, steps=40)
        points = model.landmarks(fit) - model.landmarks(truth)
        return float(points.diff(n=2, dim=0).norm(dim=-1).mean())

    # However fast they change their speed, frames say nothing of each other.
    assert trembling(FitOptions()) < 0.6 * trembling(FitOptions(acceleration=1e6))


def test_one_wrong_landmark_moves_nothing_else(rig: Rig, truth: HandFit) -> None:
    model, seen = HandModel(rig), _seen(rig, truth)
    wrong, tip = seen.landmarks.clone(), LANDMARK_NAMES.index("index_tip")
    wrong[2, tip] += torch.tensor([120.0, -60.0])
    fit = refined(model, replace(seen, landmarks=wrong), truth, FitOptions(), steps=40)
    places = projected(model.landmarks(fit), fit.log_focal.exp(), CENTER)
    beside = (places - seen.landmarks).norm(dim=-1)
    # A tenth of the 134 pixels that it was moved by; of the others half of the 7 that a landmark is
    # taken to be off at this depth.
    assert float(beside[2, tip]) < 13.4
    beside[2, tip] = 0.0
    assert float(beside.max()) < 3.5


class _NoPairs:
    """Sees no outline in any frame: landmarks alone tell how well a frame is explained."""

    def __init__(self, frames: int) -> None:
        self.frames = frames

    def __call__(self, vertices: Float[Tensor, "frames vertices 3"], focal: float) -> OutlinePairs:
        return OutlinePairs(
            torch.zeros(self.frames, 1, dtype=torch.long),
            torch.zeros(self.frames, 1, 2),
            torch.zeros(self.frames, 1, 2),
            torch.zeros(self.frames, 1),
        )

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "_NoPairs":
        return _NoPairs(len(frames))


def test_a_frame_that_fits_badly_is_begun_again_from_its_neighbours(
    rig: Rig, truth: HandFit
) -> None:
    """A fist in one frame of an open hand; one step is all that an attempt has."""
    model, seen, bad = HandModel(rig), _seen(rig, truth), 1
    rotations = truth.rotations.clone()
    rotations[bad, 1:] = gesture_rotations(rig, "fist")[1:]
    spoilt = replace(truth, rotations=rotations)
    options, pairs = FitOptions(retry_steps=1), _NoPairs(FRAMES)
    fit = retried(model, seen, spoilt, options, pairs)
    before, after = (
        frame_energy(model, seen, tried, options, pairs)[bad] for tried in (spoilt, fit)
    )
    assert float(after) < 0.5 * float(before)
    # Of a neighbour's fingers, but for the step; the nearest gesture is half as far again.
    apart = (fit.rotations[bad, 1:] - truth.rotations[[bad - 1, bad + 1], 1:]).abs().amax((-1, -2))
    assert float(apart.min()) < 0.03
    others = [frame for frame in range(FRAMES) if frame != bad]
    assert torch.equal(fit.rotations[others], spoilt.rotations[others])
    assert torch.equal(fit.translation[others], spoilt.translation[others])


def test_outlines_draw_the_mesh_onto_the_mask(rig: Rig, truth: HandFit) -> None:
    model, seen = HandModel(rig), _seen(rig, truth)
    vertices = model.all_vertices(truth)
    outlines = []
    for frame in range(FRAMES):
        low = seen.landmarks[frame].amin(0) - 60
        side = float((seen.landmarks[frame].amax(0) + 60 - low).max())
        corner = (float(low[0]), float(low[1]))
        camera = window_camera(FOCAL, CENTER, corner, side, 256)
        mask = silhouette(rig, vertices[frame], camera)
        window = Window(np.zeros((256, 256, 3), dtype=np.uint8), corner, 256 / side, PICTURE)
        outlines.append(mask_outline(mask, window, float(seen.scale[frame])))
    matcher = OutlineMatcher(rig, outlines, CENTER)

    # Landmarks of a tracker that errs by 8 pixels, towards the same side in all frames.
    noise = 8 * torch.randn(1, 21, 2, generator=torch.manual_seed(1))
    landmarks = seen.landmarks + noise
    unsure = torch.full((FRAMES, 21), 8.0)
    wrong = Observations(**{**vars(seen), "landmarks": landmarks, "uncertainty": unsure})
    options = FitOptions()
    start = refined(model, wrong, initial_fit(model, wrong, options), options, steps=60)
    fit = refined(model, wrong, start, options, steps=60, find_pairs=matcher)

    def overlap(tried: HandFit) -> float:
        shares = []
        for outline, hand in zip(outlines, model.all_vertices(tried), strict=True):
            window = outline.window
            camera = window_camera(tried.focal, CENTER, window.corner, 256 / window.scale, 256)
            mesh = silhouette(rig, hand, camera)
            shares.append((mesh & outline.mask).sum() / (mesh | outline.mask).sum())
        return float(np.mean(shares))

    assert overlap(fit) > 0.94 > overlap(start)


def test_the_outline_of_a_disc_points_outwards() -> None:
    y, x = np.mgrid[:100, :100] + 0.5
    mask = (x - 40) ** 2 + (y - 55) ** 2 < 30**2
    window = Window(np.zeros((100, 100, 3), dtype=np.uint8), (200.0, 100.0), 0.5, (2000, 2000))
    outline = mask_outline(mask, window, 1000.0)
    center = np.array([200 + 40 / 0.5, 100 + 55 / 0.5])
    apart = outline.points - center
    radius = np.linalg.norm(apart, axis=-1)
    # Twice the window's pixels; the border is known to a pixel of the window.
    assert np.abs(radius - 60).max() < 2.0
    assert ((apart / radius[:, None]) * outline.normals).sum(-1).min() > 0.97
    assert outline.covers(
        np.stack([center, center + np.array([70, 0]), np.array([-5.0, 10.0])])
    ).tolist() == [
        True,
        False,
        True,
    ]


def test_the_wrist_line_separates_hand_and_forearm() -> None:
    rim = np.array([[40.0, 100.0], [60.0, 100.0]])
    hand = np.array([50.0, 40.0])
    points = np.array([[50.0, 20.0], [50.0, 95.0], [90.0, 101.0]])
    assert is_behind_wrist(points, rim, hand).tolist() == [False, False, True]
    assert is_behind_wrist(points, rim, hand, margin=10.0).tolist() == [False, True, True]
