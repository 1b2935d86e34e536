"""The how-to page's pieces run as they are, in their order, in a folder that holds an avatar."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import TINY
from PIL import Image
from source_tree import TOP

from handavatar.avatar import HandAvatar
from handavatar.capture.soundness import find_problems
from handavatar.train import loop

PAGE = (TOP / "docs" / "howto.md").read_text(encoding="utf-8")
PIECES = re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```python\n(.*?)^```", PAGE, re.M | re.S)


def test_every_section_has_a_piece() -> None:
    titles = re.findall(r"^## (.+)$", PAGE, re.M)
    assert [title for title, _ in PIECES] == titles and len(titles) >= 10


@pytest.mark.slow
def test_every_piece_runs(
    two_lights: HandAvatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(loop.METHODS, "quick", TINY)
    two_lights.save("avatar.safetensors")
    left: dict[str, dict[str, Any]] = {}
    for title, piece in PIECES:
        left[title] = {"__name__": "piece"}
        exec(compile(piece, f"docs/howto.md: {title}", "exec"), left[title])
    assert np.asarray(Image.open("victory.png")).max() > 60
    alpha = np.asarray(Image.open("hand.png"))[..., 3]
    assert 0.02 < (alpha > 127).mean() < 0.8 and alpha[0].max() == 0
    assert len(trimesh.load("fist.obj", process=False).vertices) == 778
    pose = left["The pose in a picture"]
    before, after = (
        float((pose[name].translation - pose["truth"].translation).norm())
        for name in ("start", "found")
    )
    assert after < 0.7 * before
    blue, plain = HandAvatar.load("blue.safetensors"), HandAvatar.load("avatar.safetensors")
    assert not blue.albedo.codes.equal(plain.albedo.codes)
    assert blue.occupancy.state_dict().keys() == plain.occupancy.state_dict().keys()
    assert find_problems(Path("my-capture")) == []
    capture = left["A capture from arrays, and an avatar from it"]["capture"]
    assert [record.split for record in capture.records] == ["train"] * 4 + ["test"]
    assert left["How good is it?"]["metrics"]["frames"] == 1
    assert any(Path("film").iterdir()) and Path("hand.glb").stat().st_size > 50_000
