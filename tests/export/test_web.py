"""``handavatar export RUN web``: the folder, its size, its content policy, and what it says."""

import base64
import hashlib
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch

from handavatar import cli
from handavatar.avatar import HandAvatar
from handavatar.edit import Edit
from handavatar.export import run, web
from handavatar.export.lightweight import Effort, LightweightHand, lightweight_hand
from handavatar.export.web import LARGEST, SCRIPTS, facts, web_files
from handavatar.field.shading import TracedCues
from handavatar.hand.rig import Rig

PAGE = Path(run.__file__).parent / "page"


@pytest.fixture(scope="module", autouse=True)
def quick_fit() -> Any:
    """Three poses and two steps: what is tested here is not the light."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            run,
            "lightweight_hand",
            lambda avatar, edit, progress: lightweight_hand(avatar, edit, progress, Effort(3, 2)),
        )
        yield


@pytest.fixture(scope="module")
def light(small_avatar: HandAvatar) -> LightweightHand:
    return lightweight_hand(small_avatar, Edit(), effort=Effort(3, 2))


@pytest.fixture(scope="module")
def saved(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "avatar.safetensors"
    small_avatar.save(path)
    return path


class Reading(HTMLParser):
    """Tags of a page, and what stands in its scripts and styles."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.is_inside = False
        self.texts: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self.is_inside = True
            self.texts.append((tag, dict(attrs), ""))

    def handle_endtag(self, tag: str) -> None:
        self.is_inside = False

    def handle_data(self, data: str) -> None:
        if self.is_inside:
            tag, attributes, text = self.texts[-1]
            self.texts[-1] = (tag, attributes, text + data)


def test_the_command_writes_a_whole_folder_and_says_what_is_lost(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "hand"
    words = ["export", str(saved), "web", "--out", str(out), "--motion", "pinch"]
    assert cli.main([*words, "--light-gain", "1.5", "--lift-shadow", "thumb"]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str(out)
    assert sorted(os.listdir(out)) == [".handavatar", "index.html", "loss.json"]
    assert os.listdir(out.parent) == ["hand"]
    loss = json.loads((out / "loss.json").read_text())
    assert loss["bytes"] == (out / "index.html").stat().st_size < LARGEST
    assert {"poses", "light_rmse", "color_psnr", "lifted_color_psnr"} < loss.keys()
    assert '"color_psnr"' in printed.err
    about = json.loads(next(t for _, a, t in Reading((out / "index.html").read_bytes()).texts
                            if a.get("id") == "about"))  # fmt: skip
    assert about["edit"]["light_gain"] == 1.5 and about["edit"]["lifted_bones"] == [13, 14, 15]
    assert about["motion"]["steps"] > 100
    assert cli.main(words) == 2  # It is there already.
    (out / "notes").write_text("hi")
    assert cli.main([*words, "--overwrite"]) == 2
    assert "holds notes, not written by this program" in capsys.readouterr().err
    assert (out / "notes").read_text() == "hi"
    (out / "notes").unlink()
    before = (out / "index.html").stat().st_ino
    assert cli.main([*words, "--overwrite"]) == 0
    assert sorted(os.listdir(out)) == [".handavatar", "index.html", "loss.json"]
    assert (out / "index.html").stat().st_ino != before
    assert os.listdir(out.parent) == ["hand"]


@pytest.mark.parametrize("is_unfinished", [False, True])
def test_a_folder_of_something_else_is_not_replaced(
    saved: Path, tmp_path: Path, is_unfinished: bool
) -> None:
    out = tmp_path / "page"
    other = tmp_path / "page.unfinished" if is_unfinished else out
    other.mkdir()
    (other / "notes").write_text("hi")
    words = ["export", str(saved), "web", "--out", str(out)]
    assert cli.main([*words, "--overwrite"]) == 2
    assert [path.name for path in tmp_path.iterdir()] == [other.name]
    assert (other / "notes").read_text() == "hi"


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--pose", "fist"], "begins in the capture's pose"),
        (["--unlit"], "is lit"),
        (["--lift-shadow", "toe"], "neither a finger nor a bone"),
    ],
)
def test_words_that_mean_nothing_for_a_page_are_refused(
    extra: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # By its name it may be an avatar; whoever read it would find that it is none.
    avatar = tmp_path / "any.safetensors"
    avatar.write_bytes(b"no avatar")
    words = ["export", str(avatar), "web", "--out", str(tmp_path / "out"), *extra]
    assert cli.main(words) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_nothing_is_left_of_an_export_that_fails(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "web_files", lambda *_: {"index.html": b"", "loss.json": None})
    with pytest.raises(TypeError):
        run.export_avatar(run.ExportOptions(saved, "web", tmp_path / "out"))
    assert os.listdir(tmp_path) == []


def test_the_policy_names_every_script_and_allows_nothing_else(
    small_avatar: HandAvatar, light: LightweightHand
) -> None:
    page = web_files(small_avatar, light, Edit())["index.html"]
    reading = Reading(page)
    metas = [a for tag, a in reading.tags if tag == "meta"]
    policy = next(a["content"] for a in metas if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'")
    assert "unsafe" not in policy and "*" not in policy and "http" not in policy
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    run_code = [text for tag, a, text in reading.texts if tag == "script" and "type" not in a]
    assert len(run_code) == len(SCRIPTS)
    for rule, texts in (
        ("script-src", run_code),
        ("style-src", [text for tag, _, text in reading.texts if tag == "style"]),
    ):
        hashes = [
            "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"
            for text in texts
        ]
        assert rules[rule].split() == hashes
    # Neither a handler nor a style in an attribute, which the policy would not let pass.
    for tag, attributes in reading.tags:
        assert not {name for name in attributes if name.startswith("on") or name == "style"}
        assert not {"src", "srcset", "action"} & attributes.keys()
        assert tag not in ("iframe", "object", "embed", "form", "base")


@pytest.mark.parametrize("name", [*SCRIPTS, "index.html", "page.css"])
def test_the_sources_load_and_evaluate_nothing(name: str) -> None:
    text = (PAGE / name).read_text(encoding="utf-8")
    for word in (r"\beval\b", r"\bFunction\b", "innerHTML", r"\bimport\b", r"\bfetch\b", "https?:"):
        assert not re.search(word, text), word
    assert not re.search("XMLHttpRequest|WebSocket|document\\.write|setTimeout\\(['\"]", text)
    assert "</script" not in text or name == "index.html"


def test_the_same_avatar_gives_the_same_bytes(
    small_avatar: HandAvatar, light: LightweightHand
) -> None:
    again = lightweight_hand(small_avatar, Edit(), effort=Effort(3, 2))
    assert web_files(small_avatar, light, Edit()) == web_files(small_avatar, again, Edit())


def test_a_page_that_is_too_large_is_refused(
    small_avatar: HandAvatar, light: LightweightHand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "LARGEST", 100_000)
    with pytest.raises(ValueError, match="at most 100000"):
        web_files(small_avatar, light, Edit())


def test_words_of_a_stranger_stay_words(small_avatar: HandAvatar, light: LightweightHand) -> None:
    before = small_avatar.info
    small_avatar.info = before | {"subject": "</script><script>alert(1)</script>"}
    try:
        page = web_files(small_avatar, light, Edit())["index.html"]
    finally:
        small_avatar.info = before
    reading = Reading(page)
    assert sum(tag == "script" for tag, _ in reading.tags) == len(SCRIPTS) + 2
    about = next(text for _, a, text in reading.texts if a.get("id") == "about")
    assert json.loads(about)["title"].endswith("alert(1)</script>")


def test_the_page_s_joints_are_named_as_webxr_names_them(
    small_avatar: HandAvatar, light: LightweightHand
) -> None:
    found = facts(small_avatar, light, Edit(), None)["xr"]
    assert found["names"][0] == "wrist" and len(set(found["names"])) == 16
    assert found["names"][7] == "pinky-finger-phalanx-proximal"
    assert found["names"][13:] == [
        "thumb-metacarpal", "thumb-phalanx-proximal", "thumb-phalanx-distal"
    ]  # fmt: skip
    for turn in (*found["rest"], found["turn"]):
        matrix = torch.tensor(turn).view(3, 3)
        torch.testing.assert_close(matrix @ matrix.T, torch.eye(3), atol=1e-5, rtol=0)
        assert float(torch.det(matrix)) == pytest.approx(1, abs=1e-5)


def test_the_whole_effort_is_that_of_the_documents(small_avatar: HandAvatar, rig: Rig) -> None:
    traced = HandAvatar(rig, torch.zeros(10), rounds=0, num_anchors=16, cues=TracedCues(4))
    assert Effort.for_avatar(small_avatar) == Effort(420, 3000)
    assert Effort.for_avatar(traced) == Effort(280, 3000)
