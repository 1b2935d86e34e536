"""The webcam's page in a real browser, before a camera that shows a made film."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import MARKS, launched, visit, watched
from patience import PATIENCE
from test_webcam import jpeg

from handavatar.avatar import HandAvatar
from handavatar.capture.decoding import Sampling, video_frames
from handavatar.capture.frames import read_capture
from handavatar.hand.rigs import load_rig
from handavatar.view.driven import DrivenAvatar
from handavatar.view.guard import guard_of
from handavatar.view.recording import RecordingFile
from handavatar.view.server import serving
from handavatar.view.webcam import WebcamServer
from handavatar.view.webcam_answers import WebcamAnswers
from handavatar.webcam.session import LiveSession

pytestmark = MARKS

FAKE_CAMERA = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")


@pytest.fixture(scope="module")
def camera(
    hand_pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """A browser whose camera shows the film, forwards and backwards, again and again."""
    film = tmp_path_factory.mktemp("camera") / "film.mjpeg"
    # It shows 30 pictures a second; the film has 10.
    order = [*hand_pictures, *hand_pictures[::-1]]
    film.write_bytes(b"".join(jpeg(image) for image in order for _ in range(3)))
    with launched(*FAKE_CAMERA, f"--use-file-for-fake-video-capture={film}") as running:
        yield running


def opened(browser: Any, address: str) -> Any:
    page = watched(browser.new_page(), lambda url: url.startswith((address, f"blob:{address}")))
    page.goto(address)
    return page


def seen(page: Any, count: int) -> None:
    """Waits for as many answers."""
    page.wait_for_function(
        "count => Number(document.getElementById('state').dataset.order) >= count", arg=count
    )


def test_without_a_camera_or_leave_the_page_says_what_to_do(tmp_path: Path) -> None:
    """Before the other tests: Playwright runs one browser at a time."""
    session = LiveSession(load_rig("open-hand").shaped())
    answers = WebcamAnswers(session, None, RecordingFile(tmp_path / "mine"), 60.0)
    with serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as server:
        for arguments, why in (
            ((), "no camera|may not use the camera"),
            ((FAKE_CAMERA[0], "--deny-permission-prompts"), "may not use the camera"),
        ):
            with launched(*arguments) as browser, visit(browser) as context:
                page = opened(context, server.address)
                page.wait_for_function(
                    "why => new RegExp(why).test($('problem').textContent)", arg=why
                )
                assert page.is_visible("#again") and page.is_disabled("#record")


def test_the_hand_is_marked_and_the_avatar_follows(camera: Any, small_avatar: HandAvatar) -> None:
    driven = DrivenAvatar(small_avatar)
    answers = WebcamAnswers(LiveSession(driven.hand), driven, None, 60.0)
    with (
        serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as server,
        visit(camera, viewport={"width": 1200, "height": 800}) as context,
    ):
        page = opened(context, server.address)
        page.wait_for_function("() => Number(avatar.dataset.order) > 3")
        assert page.get_attribute("#state", "data-side") == "right"
        assert page.is_hidden("#recorder") and page.is_visible("#driven")
        marks, drawn = page.evaluate(
            "() => ['overlay', 'avatar'].map((name) => { const canvas = $(name); return Array.from("
            "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data)"
            ".filter((value, place) => place % 4 < 3 && value > 40).length; })"
        )
        assert marks > 200 and drawn > 1000
        # The mirror is one of the display: what is sent is not mirrored, so the side stays.
        assert page.evaluate("() => document.body.classList.contains('mirrored')")
        page.uncheck("#mirror")
        seen(page, 8)
        assert page.get_attribute("#state", "data-side") == "right"
        page.wait_for_function("() => document.querySelector('#steps progress').value === 1")
        page.wait_for_function("() => $('instruction').textContent.includes('back')")
        page.wait_for_function("() => $('map').naturalWidth === 600")
        assert page.strays == []


def test_a_recording_that_is_thrown_away_leaves_nothing(camera: Any, tmp_path: Path) -> None:
    session = LiveSession(load_rig("open-hand").shaped())
    answers = WebcamAnswers(session, None, RecordingFile(tmp_path / "mine"), 60.0)
    with (
        serving(WebcamServer(answers, guard_of("127.0.0.1", ""), 0)) as server,
        visit(camera) as context,
    ):
        page = opened(context, server.address)
        page.wait_for_function("() => !$('record').disabled")
        page.click("#record")
        page.wait_for_function("() => $('recorded').textContent.includes('MB') && recorder?.size")
        page.click("#drop")
        page.wait_for_function("() => $('record').textContent === 'record' && recorder === null")
        assert list(tmp_path.iterdir()) == [] and page.is_hidden("#problem")


def test_the_whole_way_from_the_page_to_a_capture(camera: Any, tmp_path: Path) -> None:
    # Fourteen pictures, laid on in a hurry.
    words = ["--out", str(tmp_path / "mine"), "--tracker", "own", "--min-confidence", "0"]
    words += ["--fps", "4", "--max-frames", "14", "--fit.landmark-steps", "120"]
    words += ["--register.restarts", "0", "--register.texture-rounds", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "handavatar", "capture", "webcam", "--port", "0", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        with visit(camera) as context:
            page = opened(context, address)
            seen(page, 3)
            page.click("#record")
            page.wait_for_function("() => parseFloat($('recorded').textContent) >= 3")
            page.click("#record")
            page.wait_for_function("() => $('recorded').dataset.path")
            assert "Recorded" in page.inner_text("#instruction") and page.strays == []
        output, errors = process.communicate(timeout=4 * PATIENCE)
    finally:
        process.send_signal(signal.SIGKILL)
    assert process.returncode == 0, errors[-2000:]
    video = tmp_path / "mine.webm"
    frames = list(video_frames(video, Sampling(10.0), lambda told: None))
    assert frames[0].image.shape == (240, 320, 3) and frames[-1].time > 1
    assert f"recorded: {video}" in output and "hand: right" in output
    assert f"next: handavatar train {tmp_path / 'mine'}" in output
    capture = read_capture(tmp_path / "mine")
    assert 8 <= len(capture.records) <= 14 and capture.side == "right"
    assert json.loads((tmp_path / "mine" / "fit.json").read_text())["summary"]["kept"] >= 8
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "mine.webm"}
