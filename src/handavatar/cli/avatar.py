"""From a capture to an avatar, and all that is done with one: train, evaluate, render, ..."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handavatar.cli.failures import say
from handavatar.errors import ArgumentError
from handavatar.jobs.progress import Progress

if TYPE_CHECKING:
    from handavatar.train.loop import TrainOptions


def train(words: list[str], progress: Progress) -> int:
    """Capture -> avatar; with --view, live in the browser."""
    from handavatar.cli.arguments import Extra, parse_with
    from handavatar.cli.inputs import CAPTURE, PRIOR
    from handavatar.train.loop import TrainOptions, run_folder
    from handavatar.train.loop import train as train_avatar

    page = (
        Extra("view", bool, "a page shows the training, and afterwards the avatar", False),
        Extra(
            "port", int, "of the page; if it is taken, the next free one", 7007, least=0, most=65535
        ),
        Extra("host", str, "where the page listens, as for view", "127.0.0.1"),
        Extra("token", str, "who does not know it does not see the page, as for view", ""),
    )
    reads = {"capture": CAPTURE, "prior": PRIOR}
    options, extras = parse_with(TrainOptions, page, words, "train", ("capture",), reads=reads)
    if extras["view"]:
        return _train_in_view(options, run_folder(options), extras, progress)
    for extra in page:
        if extras[extra.name] != extra.default:
            raise ArgumentError(extra.name, "only with `view=True`")
    with progress:
        run = train_avatar(options, progress)
    _say_trained(run)
    return 0


def _train_in_view(
    options: "TrainOptions", folder: Path, extras: dict[str, Any], progress: Progress
) -> int:
    from handavatar.train.loop import train as train_avatar
    from handavatar.view.beside import PageOptions, page_beside

    place = PageOptions(folder, extras["port"], extras["host"], extras["token"])
    with page_beside(place) as page:
        with progress:
            run = train_avatar(replace(options, out=folder), progress)
        _say_trained(run)
        page.stay()
    return 0


def _say_trained(run: Path) -> None:
    say(f"run: {run}\nnext: handavatar evaluate {run}")


def evaluate(words: list[str], progress: Progress) -> int:
    """PSNR, SSIM, LPIPS, mask IoU and what the truth allows, on held-out frames."""
    from handavatar.cli.arguments import JSON, parse_with, print_figures, print_json
    from handavatar.cli.inputs import AVATAR, CAPTURE
    from handavatar.evaluate.run import EvaluateOptions, evaluate_run

    reads = {"run": AVATAR, "capture": CAPTURE}
    options, extras = parse_with(EvaluateOptions, (JSON,), words, "evaluate", ("run",), reads=reads)
    with progress:
        metrics = evaluate_run(options, progress)
    (print_json if extras["json"] else print_figures)(metrics)
    return 0


def edit(words: list[str], progress: Progress) -> int:
    """Save light, skin colour, paint and lifted shadows into an avatar."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import AVATAR, PAINT
    from handavatar.retouch import EditOptions, save_edited

    reads = {"run": AVATAR, "paint": PAINT}
    options = parse(EditOptions, words, "edit", ("run",), reads)
    with progress:
        saved = save_edited(options)
    say(saved)
    return 0


def render(words: list[str], progress: Progress) -> int:
    """Pictures and video of any pose from any camera."""
    from handavatar.animate import RenderOptions, render_motion
    from handavatar.capture.motion import MOTIONS
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import AVATAR, MOTION, PAINT, named
    from handavatar.processes import is_first_process

    reads = {"run": AVATAR, "motion": named(MOTION, MOTIONS), "paint": PAINT}
    options = parse(RenderOptions, words, "render", ("run",), reads)
    with progress:
        folder = render_motion(options, progress)
    if is_first_process():
        say(folder)
    return 0


def export(words: list[str], progress: Progress) -> int:
    """Avatar -> a rigged GLB, a page for any browser, or a posed surface as PLY or OBJ."""
    import sys

    from handavatar.capture.motion import MOTIONS
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import AVATAR, MOTION, PAINT, named
    from handavatar.export.run import ExportOptions, export_avatar

    reads = {"run": AVATAR, "motion": named(MOTION, MOTIONS), "paint": PAINT}
    options = parse(ExportOptions, words, "export", ("run", "format"), reads)
    with progress:
        out = export_avatar(options, progress)
    if options.format == "web":
        print((out / "loss.json").read_text(), end="", file=sys.stderr)
    say(out)
    return 0


def view(words: list[str], progress: Progress) -> int:
    """Live in the browser: pose, camera, layers, light, skin, paint, shadow per finger."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import MOTION, SHOWN
    from handavatar.view.server import ViewOptions
    from handavatar.view.server import view as serve

    options = parse(ViewOptions, words, "view", ("run",), {"run": SHOWN, "motion": MOTION})
    progress.end()  # It serves until it is stopped.
    serve(options)
    return 0
