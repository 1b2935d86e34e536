"""The names that users' programs may rely on. A change here is a change for them: say so.

The modules of the first table are the library: exactly these names are public in them. Of the
modules in the second, only these names are promised; the rest may change.
"""

import ast

import pytest
from source_tree import TOP, find_definition, imported_modules, modules

EXACTLY = {
    "geometry.cameras": (
        "Camera Rays framing_camera look_at pixel_centers project rays_through_pixels"
    ),
    "geometry.rotations": (
        "apply_rigid axis_angle_from_matrix invert_rigid left_jacobian matrix_from_axis_angle "
        "matrix_from_quaternion mean_rotation mirror_rigid nearest_rotations "
        "quaternion_from_matrix rigid_transform rotations_between skew"
    ),
    "hand.pose": (
        "BONE_NAMES BONE_PARENTS CONNECTED_PAIRS FINGER_BONES HandPose NUM_BONES "
        "bone_transforms linear_blend_skinning skinning_jacobian"
    ),
    "hand.rig": "RIG_ARRAYS LicensedRigMissing PosedHand Rig RigError ShapedHand",
    "hand.open_hand": "Level load_open_hand",
    "hand.mano": (
        "FINGERTIPS LICENCE LeftShape ManoModel Side WHERE_TO_GET_IT absolute_rotations "
        "growth_agreement read_mano"
    ),
    "hand.rigs": "SCHEMA find_rig load_mano load_rig read_rig rigs_folder save_rig",
    "hand.detail": "refined subdivided",
    "errors": (
        "ARGUMENT_MARK ArgumentError ErrorKind HandAvatarError OutOfSpace PlaceRefused SEEDS "
        "argument machine_error printable raise_if_refused require_range require_ranges"
    ),
    "edit": "Edit Paint bones_named",
    "avatar": (
        "CheckpointError EXACT HandAvatar HandState RayValues RenderSettings Rendering "
        "SCHEMA START_LIGHT VisibleSamples chosen_device rendering_seconds"
    ),
    "plain": "plain_rays",
    "capture.default": "default_capture",
}
AT_LEAST = {
    "animate": "RenderOptions render_motion camera_on orbited pass_pictures posed_as_seen",
    "avatar": "HandAvatar.load HandAvatar.render HandAvatar.save",
    "hand.pose": "HandPose.flat",
    "hand.rig": "Rig.shaped ShapedHand.posed",
    "capture.frames": (
        "Capture Capture.frame Capture.split Frame CaptureWriter read_capture write_capture"
    ),
    "capture.soundness": "find_problems require_sound",
    "capture.arrays": "capture_from_arrays camera_from_matrices",
    "capture.checks": "CaptureError",
    "capture.motion": (
        "Motion Motion.pose gesture middle_of_hand named_motion open_motion read_motion "
        "write_motion"
    ),
    "capture.motion_import": "MotionFromOptions motion_from",
    "capture.motion_export": "MotionToOptions motion_to",
    "capture.view": "start_of",
    "capture.video": "VideoOptions capture_video",
    "capture.synthetic": "SynthOptions make_capture",
    "jobs.progress": "Progress Progress.stages Progress.skip shown_progress",
    "jobs.signals": "Interrupted heard_signals stop_point",
    "train.loop": "TrainOptions train",
    "train.prior": "PriorOptions train_prior PriorEvaluationOptions evaluate_prior open_prior",
    "hand.pose_sampling": (
        "angles_from_rotations clamped_angles interpolate_rotations "
        "resolve_penetration rotations_from_angles"
    ),
    "hand.retargeting": "rest_frames retarget",
    "hand.skin_refinement": "RefinementOptions SkinRefinement refine_skin",
    "hand.sparse_skin": "SparseSkin SparseSkin.load SparseSkin.save",
    "geometry.meshes": "SurfacePoints SurfacePoints.positions",
    "evaluate.metrics": "psnr",
    "evaluate.pose_fit": "fit_pose",
    "evaluate.run": "EvaluateOptions evaluate_run",
    "export.run": "ExportOptions export_avatar",
    "export.rigged": "skinned_mesh mirrored",
    "export.gltf": "Clip SkinnedMesh glb_bytes",
    "view.server": "ViewOptions view",
    "view.webcam": "WebcamOptions record_webcam",
    "webcam.session": "LiveSession LiveSession.see LiveView",
    "webcam.following": "HandFollower FollowedHand",
    "webcam.posing": "LivePose PoseFollower",
    "webcam.coverage": "SkinCoverage next_step",
    "retouch": "Look EditOptions save_edited paint_from",
    "doctor": "Finding examine",
    "cli": "main",
}
TREES = modules()


def _public_names(tree: ast.Module) -> set[str]:
    """Classes, functions and values defined at the top of a module; imported names are not."""
    names = set()
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
    return {name for name in names if not name.startswith("_")}


@pytest.mark.parametrize("module", EXACTLY)
def test_the_library_has_exactly_these_names(module: str) -> None:
    assert _public_names(TREES[f"handavatar.{module}"]) == set(EXACTLY[module].split())


@pytest.mark.parametrize("module", AT_LEAST)
def test_these_names_are_promised(module: str) -> None:
    tree = TREES[f"handavatar.{module}"]
    missing = [n for n in AT_LEAST[module].split() if find_definition(tree, n) is None]
    assert not missing


def test_the_examples_use_promised_names_alone() -> None:
    promised = {
        f"handavatar.{module}.{name}"
        for table in (EXACTLY, AT_LEAST)
        for module, names in table.items()
        for name in names.split()
    }
    paths = sorted((TOP / "examples").glob("*.py"))
    assert len(paths) == 4
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                own = {name for name in imported_modules(node) if name.startswith("handavatar")}
                assert own <= promised, f"{path.name}: {own - promised}"


def test_the_package_says_its_version() -> None:
    assert _public_names(TREES["handavatar"]) == set()
    source = ast.unparse(TREES["handavatar"])
    assert "__version__ = " in source
