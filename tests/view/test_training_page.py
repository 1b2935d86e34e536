"""``train --view`` as a person meets it: a real training, a real browser."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import MARKS, late, visit
from patience import PATIENCE, until
from source_tree import TOP

from handavatar.train.runs import open_run, read_log

pytestmark = MARKS
# The pages' process begins with this program as well, but is not the one to run it.
PROGRAM = """
import sys
if __name__ == "__main__":
    from conftest import TINY
    from handavatar.train.loop import METHODS
    METHODS["quick"] = TINY
    from handavatar.cli import main
    sys.exit(main(sys.argv[1:]))
"""


class Training:
    """``handavatar train`` of a method of seconds, in a process of its own."""

    def __init__(self, folder: Path, capture: Path, name: str, *words: str) -> None:
        self.run = folder / name
        (folder / "tiny.py").write_text(PROGRAM, encoding="utf-8")
        self._out = (folder / f"{name}.out").open("w")
        self._err = (folder / f"{name}.err").open("w")
        options = ["--out", str(self.run), "--perceptual", "substitute", "--device", "cpu", *words]
        here = {"PYTHONPATH": os.pathsep.join([str(TOP / "src"), str(TOP / "tests")])}
        self.process = subprocess.Popen(
            [sys.executable, str(folder / "tiny.py"), "train", str(capture), *options],
            stdout=self._out,
            stderr=self._err,
            cwd=folder,
            env=os.environ | here | {"OMP_NUM_THREADS": "1"},
        )

    @property
    def out(self) -> str:
        return Path(self._out.name).read_text(encoding="utf-8")

    @property
    def err(self) -> str:
        return Path(self._err.name).read_text(encoding="utf-8")

    def address(self) -> str:
        """As it is said, once it is."""
        line = re.compile(r"^open (http://\S+)\n", re.MULTILINE)
        until(lambda: line.search(self.err) is not None or self.process.poll() is not None)
        found = line.search(self.err)
        assert found is not None, self.err
        return found[1]

    def page_processes(self) -> list[int]:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
        return [
            int(child)
            for child in children.split()
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
        ]


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    strays: list[str] = []
    with visit(browser, viewport={"width": 1200, "height": 800}) as context:
        context.on("weberror", lambda error: strays.append(str(error.error)))
        yield context.new_page()
        assert strays == []


def is_gone(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False


def test_losses_and_pictures_change(page: Any, tiny_capture: Path, tmp_path: Path) -> None:
    # Longer than any picture takes where no core is idle.
    training = Training(tmp_path, tiny_capture, "run", "--steps", "100000", "--view", "--port", "0")
    try:
        page.goto(training.address())
        page.select_option("#size", "128")
        page.wait_for_selector("#job[data-phase=training][data-job=train]")
        page.check("input[name=layer][value=rgb]")
        page.wait_for_selector("#picture[data-version][data-stage='0']")
        first = page.evaluate("[picture.toDataURL(), picture.dataset.version]")
        page.wait_for_function(
            "before => picture.dataset.stage == 0 && picture.dataset.version != before[1] &&"
            " picture.toDataURL() != before[0]",
            arg=first,
        )
        page.select_option("#detail", "1")
        page.wait_for_selector("#picture[data-stage='1']")
        first = page.evaluate("[picture.toDataURL(), picture.dataset.version]")
        assert page.locator("#frames canvas").count() == 3
        page.wait_for_selector("[data-curve='train: loss']")
        points = int(page.get_attribute("[data-curve='train: loss']", "data-points"))
        assert "steps/s" in page.inner_text("#job") and "left" in page.inner_text("#job")

        # Another tab, whose first answer comes late; it is closed in the middle of its picture.
        other = page.context.new_page()
        with late(other, "**/training"):
            other.goto(training.address())
            other.select_option("#size", "512")
            other.select_option("#detail", "2")
        other.wait_for_function("() => picture.width == 512")
        other.close()

        page.click("#frames canvas[data-frame='2']")
        page.wait_for_selector("#picture[data-frame='2']")
        assert page.get_attribute("#frame", "data-frame") == "2"
        page.click("#frames canvas[data-frame='0']")
        page.wait_for_function(
            "before => picture.dataset.frame == 0 && picture.dataset.stage == 1 &&"
            " picture.dataset.version != before[1] && picture.toDataURL() != before[0]",
            arg=first,
        )
        page.wait_for_function(
            "before => document.querySelector(\"[data-curve='train: loss']\").dataset.points"
            " > before",
            arg=points,
        )
        training.process.send_signal(signal.SIGINT)
        assert training.process.wait(PATIENCE) == 130
        assert "Traceback" not in training.err
    finally:
        training.process.kill()


def test_the_page_becomes_the_viewer_and_training_is_the_same(
    page: Any, tiny_capture: Path, tmp_path: Path
) -> None:
    steps = ("--steps", "60")
    alone = Training(tmp_path, tiny_capture, "alone", *steps)
    assert alone.process.wait(1800) == 0, alone.err
    training = Training(tmp_path, tiny_capture, "seen", *steps, "--view", "--port", "0")
    try:
        page.goto(training.address())
        # It goes over by itself, and the ordinary page works.
        page.wait_for_selector("#gesture")
        page.wait_for_selector("canvas[data-stage=fluid], canvas[data-stage=half]")
        page.select_option("#gesture", "fist")
        page.wait_for_function("() => picture.dataset.order == order")
        assert f"run: {training.run}" in training.out
        (viewer,) = training.page_processes()
        training.process.send_signal(signal.SIGINT)
        assert training.process.wait(PATIENCE) == 0
        assert is_gone(viewer)
        assert "Traceback" not in training.err and "the page has ended" not in training.err
    finally:
        training.process.kill()
    ours, theirs = (one.run / "avatar.safetensors" for one in (alone, training))
    assert ours.read_bytes() == theirs.read_bytes()
    assert read_log(open_run(alone.run)) == read_log(open_run(training.run))


def test_ctrl_c_ends_both_and_saves(page: Any, tiny_capture: Path, tmp_path: Path) -> None:
    training = Training(tmp_path, tiny_capture, "run", "--steps", "100000", "--view", "--port", "0")
    try:
        page.goto(training.address())
        page.wait_for_selector("#job[data-job=train]")
        page.wait_for_selector("#picture[data-version]")
        (viewer,) = training.page_processes()
        training.process.send_signal(signal.SIGINT)
        assert training.process.wait(PATIENCE) == 130
        assert ": stopped at step" in training.err
        assert is_gone(viewer)
        page.wait_for_function("() => problem.textContent.includes('does not answer')")
        assert list((training.run / "checkpoints").glob("step-*"))
        assert not list(training.run.glob("**/.tmp-*"))
    finally:
        training.process.kill()


def test_a_killed_page_is_said_and_training_goes_on(
    page: Any, tiny_capture: Path, tmp_path: Path
) -> None:
    training = Training(tmp_path, tiny_capture, "run", "--steps", "60", "--view", "--port", "0")
    try:
        page.goto(training.address())
        (viewer,) = training.page_processes()
        os.kill(viewer, signal.SIGKILL)
        assert training.process.wait(300) == 0  # Nothing is left to stay for.
        assert "the page has ended (exit code -9)" in training.err
        assert (training.run / "avatar.safetensors").is_file()
    finally:
        training.process.kill()


def test_a_killed_trainer_takes_its_page_along_and_view_looks_on_at_another(
    page: Any, tiny_capture: Path, tmp_path: Path
) -> None:
    training = Training(tmp_path, tiny_capture, "run", "--steps", "100000", "--view", "--port", "0")
    words = ["view", str(training.run), "--port", "0"]
    watching = None
    try:
        page.goto(training.address())
        page.wait_for_selector("#job[data-job=train]")
        (viewer,) = training.page_processes()
        # `handavatar view` of a run that is being trained looks on as well.
        watching = subprocess.Popen(
            [sys.executable, "-m", "handavatar", *words],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(TOP / "src")},
        )
        assert watching.stdout is not None
        other = page.context.new_page()
        other.goto(watching.stdout.readline().split()[1])
        other.wait_for_selector("#picture[data-version]")
        training.process.kill()
        training.process.wait()
        other.wait_for_selector("#job[data-phase=stopped]")
        assert "has stopped" in other.inner_text("#job")
        until(lambda: is_gone(viewer))
        watching.send_signal(signal.SIGINT)
        assert watching.wait(PATIENCE) == 0
    finally:
        training.process.kill()
        if watching is not None:
            watching.kill()
