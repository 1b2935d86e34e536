"""The exported page in a real browser, opened from disk: it poses, shades and saves as it should.

There is no headset here: tracked hands are made up, and WebXR is played by a few objects.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chromium import MARKS, visit, watched
from conftest import camera_above
from PIL import Image
from scipy import ndimage

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import gesture, named_motion
from handavatar.edit import Edit, Paint
from handavatar.export.capsules import occlusion_by_bones
from handavatar.export.lightweight import Effort, LightweightHand, lightweight_hand
from handavatar.export.shading_network import turned_normals
from handavatar.export.skeletons import skeleton_of
from handavatar.export.web import web_files
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    invert_rigid,
    quaternion_from_matrix,
    rigid_transform,
)
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import PosedHand

pytestmark = MARKS
FAKE_XR = (Path(__file__).parent / "fake_webxr.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def avatar(small_avatar: HandAvatar) -> HandAvatar:
    """With light that every part takes away where it is, as a trained one has it."""
    made = HandAvatar(
        small_avatar.base_rig, torch.zeros(10), rounds=0, num_anchors=256, info={"side": "right"}
    )
    made.load_state_dict(small_avatar.state_dict())
    mlp = made.illumination.mlp
    with torch.no_grad():
        made.albedo.codes.mul_(0.3)
        # Occupancy of the parts comes first among the paper's cues; it is handed on to the end.
        for layer in (*mlp.hidden, mlp.output):
            layer.weight.zero_()
            layer.bias.zero_()
        for layer in mlp.hidden:
            layer.weight[:16, :16] = torch.eye(16)
        mlp.output.weight[:, :16] = -4
        mlp.output.bias.fill_(3.0)
    return made


@pytest.fixture(scope="module")
def light(avatar: HandAvatar) -> LightweightHand:
    return lightweight_hand(avatar, Edit(), effort=Effort(35, 500))


@pytest.fixture(scope="module")
def folder(
    avatar: HandAvatar, light: LightweightHand, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    made = tmp_path_factory.mktemp("web page")  # A space, as in many a path.
    motion = named_motion(avatar.base_rig, "pinch", HandPose.flat())
    write(made, web_files(avatar, light, Edit(), motion))
    return made


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).write_bytes(content)


def write_of_side(side: str, avatar: HandAvatar, light: LightweightHand, folder: Path) -> None:
    before = avatar.info
    avatar.info = before | {"side": side}
    try:
        write(folder, web_files(avatar, light, Edit()))
    finally:
        avatar.info = before


@pytest.fixture
def context(browser: Any) -> Iterator[Any]:
    with visit(browser, viewport={"width": 1000, "height": 760}) as made:
        yield made


def opened(context: Any, folder: Path, script: str = "") -> Any:
    """The page from disk, and a list ``strays`` of what went wrong or was asked for."""
    address = (folder / "index.html").as_uri()
    page = watched(
        context.new_page(), lambda url: url == address or url.startswith(("data:", "blob:"))
    )
    if script:
        page.add_init_script(script)
    page.goto(address)
    settled(page)
    return page


@pytest.fixture
def page(context: Any, folder: Path) -> Iterator[Any]:
    made = opened(context, folder)
    yield made
    assert made.strays == []


def settled(page: Any) -> np.ndarray:
    """What is seen once all wishes are drawn."""
    page.wait_for_function("() => picture.dataset.pictures > 0")
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return np.array(Image.open(io.BytesIO(page.locator("#picture").screenshot())).convert("RGB"))


def move(page: Any, selector: str, value: float) -> None:
    page.eval_on_selector(
        selector,
        "(input, value) => { input.value = value;"
        " input.dispatchEvent(new Event('input', { bubbles: true })); }",
        value,
    )


def shot(
    page: Any,
    pose: HandPose,
    camera: Camera,
    layer: str = "rgb",
    lifted: tuple[int, ...] = (),
    **look: Any,
) -> np.ndarray:
    """A picture by the page's own means, RGB in [0, 1]."""
    size = camera.height
    placed = camera.camera_from_world
    wish = {
        "rotations": pose.rotations.tolist(),
        "translation": pose.translation.tolist(),
        "size": size,
        "lifted": list(lifted),
        "look": {"layer": layer, **look},
        "camera": {
            "turn": placed[:3, :3].flatten().tolist(),
            "shift": placed[:3, 3].tolist(),
            "focal": [value / size for value in camera.focal],
            "center": [value / size for value in camera.center],
        },
    }
    values = page.evaluate("(wish) => Array.from(window.handavatar.shot(wish))", wish)
    return np.array(values, dtype=np.uint8).reshape(size, size, 4)[::-1, :, :3] / 255.0


def vertices(page: Any) -> np.ndarray:
    """Place, normal and light of every vertex of the last picture."""
    return np.array(page.evaluate("() => Array.from(window.handavatar.picture.read())")).reshape(
        -1, 7
    )


def poses(avatar: HandAvatar, count: int = 4) -> list[HandPose]:
    generator = torch.Generator().manual_seed(9)
    rotations = sample_poses(avatar.base_rig, count, generator)
    rotations[:, 0] = 0.8 * torch.randn(count, 3, generator=generator)
    shifts = 0.05 * torch.randn(count, 3, generator=generator)
    return [HandPose(*both) for both in zip(rotations, shifts, strict=True)]


def posed(light: LightweightHand, pose: HandPose) -> PosedHand:
    shaped = light.correctives.shaped(light.hand.rig, light.levels, pose.rotations)
    return shaped.posed(pose)


def test_the_page_opens_from_disk_and_shows_a_hand(page: Any) -> None:
    seen = settled(page)
    assert 0.08 < (seen.sum(-1) > 40).mean() < 0.7
    assert page.is_hidden("#problem") and page.is_hidden("#headset")


def test_nothing_that_is_not_in_the_policy_runs(context: Any, folder: Path) -> None:
    page = opened(context, folder)
    # Later, and not at once: what a debugger evaluates itself is exempt.
    tried = page.evaluate(
        """() => new Promise((done) => setTimeout(() => {
          const found = [];
          for (const act of [() => (0, eval)("1"), () => new Function("1")()]) {
            try { act(); found.push(String(act)); } catch { /* good */ }
          }
          const script = document.createElement("script");
          try { script.textContent = "window.injected = true"; } catch { /* no trusted type */ }
          document.body.append(script);
          done([found, Boolean(window.injected)]);
        }))"""
    )
    assert tried == [[], False]


def test_posed_vertices_and_their_light_are_ours(
    page: Any, avatar: HandAvatar, light: LightweightHand
) -> None:
    for number, pose in enumerate(poses(avatar)):
        lifted = FINGER_BONES["thumb"] if number % 2 else ()
        shot(page, pose, camera_above(32), lifted=lifted)
        found = vertices(page)
        hand = posed(light, pose)
        np.testing.assert_allclose(found[:-1, :3], hand.vertices.numpy(), atol=1e-5)
        rim = hand.vertices[hand.rig.rim].mean(0)
        np.testing.assert_allclose(found[-1, :3], rim.numpy(), atol=1e-3)
        every = torch.arange(hand.rig.num_vertices)
        # Eight bits a component, in the page.
        normals = turned_normals(hand, light.normals, every)
        assert np.abs(found[:-1, 3:6] - normals.numpy()).max() < 0.03
        own = torch.from_numpy(found[:-1, 3:6]).float()
        around = occlusion_by_bones(
            light.capsules.posed(hand.world_from_bone),
            light.capsules.radii,
            light.capsules.bones,
            hand.vertices,
            own,
        )
        around[..., list(lifted)] = 0
        with torch.no_grad():
            network = light.network
            biases = network.biases(pose.rotations[None])
            expected = network(biases, network.latents[None], own[None], around[None])[0]
        np.testing.assert_allclose(found[:-1, 6], expected.numpy(), atol=2e-3)


def test_the_picture_is_the_field_s(page: Any, avatar: HandAvatar) -> None:
    """After a fit of seconds; docs/export.md has the figures of a whole one."""
    camera = camera_above(64)
    for name in ("flat", "point"):
        pose = HandPose(gesture(avatar.base_rig, name), torch.zeros(3))
        rendered = avatar.render(pose, camera)
        seen = shot(page, pose, camera)
        error = np.square(seen - rendered.color.clamp(0, 1).numpy()).mean()
        assert -10 * np.log10(error) > 24
        mask = seen.sum(-1) > 0
        hand = rendered.alpha.numpy() > 0.5
        assert (mask & hand).sum() / (mask | hand).sum() > 0.9


def test_layers_and_edits_are_as_the_avatar_has_them(page: Any, avatar: HandAvatar) -> None:
    camera, pose = camera_above(64), HandPose.flat()
    albedo, light = (shot(page, pose, camera, layer) for layer in ("albedo", "illumination"))
    color = shot(page, pose, camera)
    # The outline's pixels are covered in part.
    inside = ndimage.binary_erosion(albedo.sum(-1) > 0, iterations=2)
    # And so are those where a finger ends before another.
    assert np.quantile(np.abs(color - albedo * light)[inside], 0.98) < 0.01
    half = shot(page, pose, camera, gain=0.5)
    np.testing.assert_allclose(half, color / 2, atol=0.01)
    redder = shot(page, pose, camera, "albedo", shift=[0.2, 0, 0])
    expected = np.clip(albedo + np.array([0.2, 0, 0]), 0, 1)
    assert np.quantile(np.abs(redder - expected)[inside], 0.98) < 0.01
    normal = shot(page, pose, camera, "normal")
    assert normal[32, 32, 1] > 0.9  # The back of the hand looks up, to the camera.


def test_a_slider_moves_the_finger_and_the_first_pose_comes_back(page: Any) -> None:
    before = settled(page)
    page.click("summary:has-text('index')")
    move(page, "input[aria-label='index1 flexion']", 80)
    after = settled(page)
    changed = (np.abs(before.astype(int) - after) > 8).any(-1)
    assert 0.005 < changed.mean() < 0.5
    page.click("#unpose")
    assert np.abs(settled(page).astype(int) - before).max() <= 2


def test_a_lifted_shadow_brightens_what_the_thumb_hides(page: Any, avatar: HandAvatar) -> None:
    page.select_option("#gesture", "fist")
    page.check("input[value=illumination]")
    before = settled(page).astype(int)
    page.uncheck("#shadows input[value=thumb]")
    lifted = settled(page).astype(int)
    assert (lifted - before).max() > 25 and (lifted - before).min() > -25
    page.check("#shadows input[value=thumb]")
    assert np.abs(settled(page).astype(int) - before).max() <= 2
    # The same place becomes brighter in the field.
    camera, pose = camera_above(48), HandPose(gesture(avatar.base_rig, "fist"), torch.zeros(3))
    bones = FINGER_BONES["thumb"]
    plain, without = (
        avatar.render(pose, camera, Edit(lifted_bones=lift)).illumination.numpy()
        for lift in ((), bones)
    )
    here, there = (shot(page, pose, camera, "illumination", lift)[..., 0] for lift in ((), bones))
    gained, shown = without - plain, there - here
    assert gained.max() > 0.1
    assert np.corrcoef(gained.ravel(), shown.ravel())[0, 1] > 0.6


def test_light_and_skin_change_and_come_back(page: Any) -> None:
    before = settled(page).astype(int)
    move(page, "#light", 0.5)
    assert settled(page).sum() < 0.7 * before.sum()
    move(page, "#red", 0.4)
    page.click("#unedit")
    assert np.abs(settled(page).astype(int) - before).max() <= 2
    assert page.input_value("#light") == "1"


def test_dragging_turns_the_hand_and_the_wheel_zooms(page: Any) -> None:
    before = settled(page)
    box = page.locator("#picture").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y, steps=6)
    page.mouse.up()
    turned = settled(page)
    assert (np.abs(turned.astype(int) - before) > 8).any(-1).mean() > 0.05
    page.mouse.wheel(0, -400)
    assert (settled(page).sum(-1) > 40).mean() > 1.3 * (turned.sum(-1) > 40).mean()
    page.click("#home")
    assert np.abs(settled(page).astype(int) - before).max() <= 2


def test_the_motion_plays(page: Any, avatar: HandAvatar, light: LightweightHand) -> None:
    motion = named_motion(avatar.base_rig, "pinch", HandPose.flat())
    move(page, "#step", 60)
    settled(page)
    expected = posed(light, motion.pose(60)).vertices.numpy()
    np.testing.assert_allclose(vertices(page)[:-1, :3], expected, atol=2e-5)
    page.click("#play")
    page.wait_for_function("() => document.getElementById('step').value != 60")
    page.click("#play")
    assert page.inner_text("#play") == "play"


def test_a_picture_is_saved(page: Any) -> None:
    seen = settled(page)
    with page.expect_download() as waiting:
        page.click("#save")
    assert waiting.value.suggested_filename == "hand-rgb.png"
    picture = np.array(Image.open(waiting.value.path()).convert("RGB"))
    assert picture.shape == seen.shape
    # The screenshot's corners are rounded.
    inner = slice(20, -20)
    assert np.abs(picture[inner, inner].astype(int) - seen[inner, inner]).max() <= 2


def test_paint_covers_the_skin(
    context: Any, avatar: HandAvatar, light: LightweightHand, tmp_path: Path
) -> None:
    blue = torch.tensor([0.1, 0.2, 0.9])
    count = len(avatar.anchor_corners)
    paint = Paint(blue.expand(count, 3).contiguous(), torch.ones(count))
    painted = lightweight_hand(avatar, Edit(paint=paint), effort=Effort(2, 1))
    write(tmp_path, web_files(avatar, painted, Edit()))
    page = opened(context, tmp_path)
    seen = shot(page, HandPose.flat(), camera_above(32), "albedo", shift=[0.3, 0, 0])
    # Paint lies over the shifted skin.
    np.testing.assert_allclose(seen[16, 16], blue.numpy(), atol=0.01)
    assert page.strays == []


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_left_hand_is_the_mirror_image(
    context: Any, avatar: HandAvatar, light: LightweightHand, tmp_path: Path, side: str
) -> None:
    write_of_side(side, avatar, light, tmp_path)
    page = opened(context, tmp_path)
    camera, pose = camera_above(64), HandPose.flat()
    seen = shot(page, pose, camera, "albedo").sum(-1) > 0
    rendered = avatar.render(pose, camera).alpha.numpy() > 0.5
    expected = rendered if side == "right" else rendered[:, ::-1]
    assert (seen & expected).sum() / (seen | expected).sum() > 0.9
    assert page.strays == []


def tracked(
    light: LightweightHand, pose: HandPose, scale: float, is_left: bool
) -> dict[str, dict[str, Any]]:
    """The 25 joints that a headset would tell of our hand in a pose, in its own axes.

    The headset's x, y, z are the world's x, -y, -z: the avatar has no capture, and then the camera
    of the page looks along the world's +y; see the page's own ``world``.
    """
    hand = light.hand
    skeleton = skeleton_of(hand, "webxr")
    bones = hand.posed(pose).world_from_bone.double()
    axes = torch.eye(3, dtype=torch.float64).expand(16, 3, 3)
    world_from_rest = bones @ invert_rigid(rigid_transform(axes, hand.rest_joints.double()))
    rest_from_joint = invert_rigid(skeleton.file_from_rest) @ skeleton.file_from_joint
    joints = world_from_rest[list(skeleton.bones)] @ rest_from_joint
    wrist = joints[0, :3, 3].clone()
    joints[:, :3, 3] = wrist + scale * (joints[:, :3, 3] - wrist)
    if is_left:
        flip = torch.tensor([-1.0, 1, 1, 1], dtype=torch.float64)
        joints = flip[:, None] * joints * flip
    return {
        name: {
            "place": joint[:3, 3].tolist(),
            "quaternion": quaternion_from_matrix(joint[:3, :3]).roll(-1).tolist(),
        }
        for name, joint in zip(skeleton.names, joints, strict=True)
    }


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_tracked_hand_moves_the_avatar(
    context: Any, avatar: HandAvatar, light: LightweightHand, tmp_path: Path, side: str
) -> None:
    """Joints as a headset tells them, of our own hand: the avatar takes its very pose."""
    write_of_side(side, avatar, light, tmp_path)
    page = opened(context, tmp_path, FAKE_XR)
    page.wait_for_function("() => !document.getElementById('headset').hidden")
    world = torch.tensor(page.evaluate("() => window.handavatar.headset.world")).view(3, 3).float()
    for pose in poses(avatar, 3):
        # The joints are told in the headset's axes: turn the pose there, and see it turned back.
        there = axis_angle_from_matrix(world.T @ _matrix(pose.rotations[0]))
        turned = HandPose(torch.cat([there[None], pose.rotations[1:]]), pose.translation)
        joints = tracked(light, turned, 1.2, side == "left")
        page.evaluate(
            "({ side, joints }) => window.fakeWebXr.show(side, joints)",
            {"side": side, "joints": joints},
        )
        if page.evaluate("() => window.fakeWebXr.frames") == 0:
            page.click("#headset")
        frames = page.evaluate("() => window.fakeWebXr.frames")
        page.wait_for_function(f"() => window.fakeWebXr.frames > {frames + 1}")
        found = vertices(page)[:-1, :3]
        expected = posed(light, HandPose(pose.rotations, torch.zeros(3))).vertices.numpy()
        # The avatar's own bones, at the tracked wrist.
        shift = found - expected
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=2e-5)
        wrist = torch.tensor(joints["wrist"]["place"])
        if side == "left":
            wrist = wrist * torch.tensor([-1.0, 1, 1])
        own = light.correctives.shaped(light.hand.rig, [], pose.rotations).rest_joints[0]
        np.testing.assert_allclose(shift[0], (world @ wrist - own).numpy(), atol=2e-5)
        # As large as the wearer's, and drawn where the hand is.
        size = page.evaluate("() => window.fakeWebXr.size()")
        assert size == pytest.approx(1.2, abs=0.03)
    assert page.evaluate("() => window.fakeWebXr.covered()") > 20
    page.evaluate("() => window.fakeWebXr.end()")
    assert 0.08 < (settled(page).sum(-1) > 40).mean() < 0.7
    assert page.strays == []


def _matrix(axis_angle: torch.Tensor) -> torch.Tensor:
    return torch.linalg.matrix_exp(
        torch.tensor(
            [
                [0, -axis_angle[2], axis_angle[1]],
                [axis_angle[2], 0, -axis_angle[0]],
                [-axis_angle[1], axis_angle[0], 0],
            ]
        )
    )
