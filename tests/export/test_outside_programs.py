"""Files opened by programs that are not ours: the Khronos validator, and three.js in a browser.

Both are npm packages. ``npm install gltf-validator three`` somewhere outside the checkout, and
``HANDAVATAR_NODE_MODULES`` names the ``node_modules`` that they came to; the browser is the
system's chromium, driven by playwright. What is missing is skipped.
"""

import contextlib
import functools
import http.server
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from independent import Reading
from PIL import Image
from scipy.spatial.transform import Rotation

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import Motion
from handavatar.edit import Edit, Paint
from handavatar.export.gltf import glb_bytes
from handavatar.export.rigged import mirrored, skinned_mesh
from handavatar.hand.pose_sampling import sample_poses

pytestmark = pytest.mark.slow
NODE_MODULES = Path(os.environ.get("HANDAVATAR_NODE_MODULES") or "no-node-modules")
SKIN = (0.8, 0.5, 0.4)
"""Painted all over: a colour that tells sRGB from linear."""
STEPS = 6

VALIDATE = """
const { validateBytes } = require(process.argv[1] + '/gltf-validator');
const content = require('fs').readFileSync(process.argv[2]);
validateBytes(new Uint8Array(content)).then((report) => console.log(JSON.stringify(report)));
"""


@pytest.fixture(scope="module")
def folder(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GLB of each kind: of every skeleton with a motion, unlit, and of a left hand."""
    folder = tmp_path_factory.mktemp("glb")
    generator = torch.Generator().manual_seed(3)
    rotations = sample_poses(small_avatar.base_rig, STEPS, generator)
    rotations[:, 0] = 0.3 * torch.randn(STEPS, 3, generator=generator)
    motion = Motion(1.0, rotations, torch.zeros(STEPS, 3))
    count = len(small_avatar.anchor_corners)
    painted = Edit(paint=Paint(torch.tensor(SKIN).expand(count, 3), torch.ones(count)))
    kinds: dict[str, dict[str, Any]] = {
        name: {"bones": name, "motion": motion} for name in ("webxr", "mano", "vrm", "unity")
    }
    kinds["unlit"] = {"is_unlit": True}
    for name, options in kinds.items():
        mesh = skinned_mesh(small_avatar, painted, texture_size=64, light_poses=1, **options)
        (folder / f"{name}.glb").write_bytes(glb_bytes(mesh, "test"))
        if name == "webxr":
            (folder / "left.glb").write_bytes(glb_bytes(mirrored(mesh), "test"))
    return folder


@pytest.mark.skipif(
    shutil.which("node") is None or not (NODE_MODULES / "gltf-validator").is_dir(),
    reason="no node, or no gltf-validator in HANDAVATAR_NODE_MODULES",
)
@pytest.mark.parametrize("kind", ["webxr", "mano", "vrm", "unity", "unlit", "left"])
def test_the_khronos_validator_finds_nothing(folder: Path, kind: str) -> None:
    command = ["node", "-e", VALIDATE, str(NODE_MODULES.resolve()), str(folder / f"{kind}.glb")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    issues = json.loads(done.stdout)["issues"]
    assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, issues["messages"]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing."""


@contextlib.contextmanager
def _served(folder: Path) -> Iterator[str]:
    handler = functools.partial(_Quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="module")
def page(folder: Path) -> Iterator[Any]:
    """A page of three.js in chromium."""
    from chromium import CHROMIUM, launched, visit

    if not CHROMIUM or not (NODE_MODULES / "three").is_dir():
        pytest.skip("no chromium, or no three in HANDAVATAR_NODE_MODULES")
    (folder / "three").symlink_to((NODE_MODULES / "three").resolve())
    shutil.copy(Path(__file__).with_name("three_page.html"), folder / "index.html")
    size = {"width": 640, "height": 640}
    with (
        _served(folder) as address,
        launched() as browser,
        visit(browser, viewport=size) as context,
    ):
        page = context.new_page()
        page.goto(address + "/index.html")
        page.wait_for_function("window.ready")
        yield page


def _picture(page: Any, path: Path, direction: list[float], up: list[float]) -> np.ndarray:
    page.evaluate(f"picture({direction}, {up}, 'even')")
    page.screenshot(path=path)
    return np.asarray(Image.open(path).convert("RGB"))


def test_three_finds_bones_textures_and_their_colour_spaces(page: Any, folder: Path) -> None:
    found = page.evaluate("open_hand('webxr.glb')")
    assert found["joints"] == Reading((folder / "webxr.glb").read_bytes()).names
    assert (found["colorSpace"], found["occlusionSpace"]) == ("srgb", "")
    assert found["material"] == "MeshStandardMaterial" and found["children"] == 1
    assert page.evaluate("open_hand('unlit.glb')")["material"] == "MeshBasicMaterial"


@pytest.mark.parametrize("kind", ["webxr", "vrm", "left"])
def test_three_plays_the_animation_as_we_pose(page: Any, folder: Path, kind: str) -> None:
    page.evaluate(f"open_hand('{kind}.glb')")
    reading = Reading((folder / f"{kind}.glb").read_bytes())
    for step in range(STEPS):
        theirs = np.array(page.evaluate(f"play({step})")).reshape(-1, 3)
        ours = reading.skinned(reading.placed(reading.keyframe(step)))
        assert np.abs(theirs - ours).max() < 1e-5


@pytest.mark.parametrize(("kind", "handedness"), [("webxr", "right"), ("left", "left")])
def test_the_hand_model_of_three_takes_the_file_as_it_is(
    page: Any, folder: Path, kind: str, handedness: str
) -> None:
    page.evaluate(f"open_hand('{kind}.glb')")
    reading = Reading((folder / f"{kind}.glb").read_bytes())
    placed = reading.placed(reading.keyframe(2))
    joints = [
        [name, joint[:3, 3].tolist(), Rotation.from_matrix(joint[:3, :3]).as_quat().tolist()]
        for name, joint in zip(reading.names, placed, strict=True)
    ]
    found = page.evaluate(f"drive('{handedness}', {json.dumps(joints)})")
    assert found["missing"] == 0
    theirs = np.array(found["places"]).reshape(-1, 3)
    assert np.abs(theirs - reading.skinned(placed)).max() < 1e-5


def test_the_colours_on_the_screen_are_those_of_the_avatar(
    page: Any, folder: Path, tmp_path: Path
) -> None:
    """Under light of one from everywhere the hand has its albedo: neither washed out nor darker."""
    page.evaluate("open_hand('webxr.glb')")
    page.evaluate("gltf.scene.getObjectByProperty('type', 'SkinnedMesh').material.aoMap = null")
    picture = _picture(page, tmp_path / "even.png", [0, 1, 0], [0, 0, -1])
    is_hand = np.abs(picture.astype(int) - 0x88).max(-1) > 12
    assert 0.1 < is_hand.mean() < 0.6
    expected = np.round(np.array(SKIN) * 255)
    # Of every surface that is no metal, three keeps some hundredths of the light for its gloss.
    assert np.abs(np.median(picture[is_hand], axis=0) - expected).max() <= 5
    # Five fingers: a row below the tips of four crosses them all, with ground between.
    gaps = [np.diff(row.astype(int)).clip(0).sum() for row in is_hand]
    assert max(gaps) >= 4
