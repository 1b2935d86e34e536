"""``handavatar rig``: facts of a rig, MANO files made into one, refined skinning weights."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from handavatar.cli.failures import say
from handavatar.jobs.progress import Progress
from handavatar.jobs.signals import is_stopping, unbroken

if TYPE_CHECKING:
    from handavatar.hand.rig import Rig


@dataclass(frozen=True)
class _InfoOptions:
    """Prints the facts of a rig.

    Attributes:
        rig: ``open-hand`` is the default rig, ``open-hand-778`` the one of MANO's size; else the
            name of an imported rig, or its file.
    """

    rig: str = "open-hand"


def info(words: list[str], progress: Progress) -> int:
    """Facts of a rig: counts, size, fingerprint."""
    from handavatar.cli.arguments import JSON, parse_with, print_figures, print_json
    from handavatar.hand.rigs import load_rig

    options, extras = parse_with(_InfoOptions, (JSON,), words, "rig info")
    with progress:
        facts = _facts(load_rig(options.rig))
    (print_json if extras["json"] else print_figures)(facts)
    return 0


@dataclass(frozen=True)
class _ImportOptions:
    """Converts a user's own MANO file once, without running anything in it.

    Attributes:
        file: ``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl`` from https://mano.is.tue.mpg.de.
        out: safetensors file to write; by default one in ``~/.local/share/handavatar/rigs`` (or
            ``$HANDAVATAR_HOME/rigs``), where captures and avatars find it again.
        left_shape: the released left hand's shape directions have the wrong sign in x;
            ``mirrored`` mends them, ``kept`` leaves them, ``auto`` looks whether they need it.
    """

    file: Path
    out: Path | None = None
    left_shape: Literal["auto", "kept", "mirrored"] = "auto"


def import_mano(words: list[str], progress: Progress) -> int:
    """Convert a user's MANO file once, safely."""
    from handavatar.cli.arguments import JSON, OVERWRITE, parse_with, print_figures, print_json
    from handavatar.cli.inputs import MANO_FILE
    from handavatar.hand.mano import LICENCE, read_mano
    from handavatar.hand.rigs import save_rig

    options, extras = parse_with(
        _ImportOptions,
        (JSON, OVERWRITE),
        words,
        "rig import-mano",
        ("file",),
        reads={"file": MANO_FILE},
    )
    with progress:
        model = read_mano(options.file, options.left_shape)
        path = save_rig(model, options.out, extras["overwrite"])
    facts = {"file": str(path), "side": model.side, "left_shape": model.left_shape}
    facts |= _facts(model.rig) | {"licence": LICENCE}
    if extras["json"]:
        print_json(facts)
        return 0
    print_figures(facts)
    reference = model.rig.name if options.out is None else path
    say(f"\nnext: handavatar capture video FILE --out D --rig {reference}")
    return 0


def _facts(rig: "Rig") -> dict[str, Any]:
    from handavatar.hand.detail import subdivided

    fine = subdivided(rig)
    extent = rig.template_vertices.amax(0) - rig.template_vertices.amin(0)
    return {
        "name": rig.name,
        "vertices": rig.num_vertices,
        "faces": len(rig.faces),
        "bones": rig.skin_weights.shape[1],
        "shape_directions": rig.shape_directions.shape[-1],
        "pose_directions": rig.pose_directions.shape[-1],
        "size_metres": [round(value, 4) for value in extent.tolist()],
        "vertex_sets": {name: len(members) for name, members in rig.vertex_sets.items()},
        "high_resolution": {"vertices": fine.num_vertices, "faces": len(fine.faces)},
        "sha256": rig.sha256,
    }


def refine(words: list[str], progress: Progress) -> int:
    """Refine the skinning weights of the high-resolution rig; four bones per vertex."""
    import json
    from dataclasses import asdict

    from handavatar.cli.arguments import (
        JSON,
        OVERWRITE,
        Extra,
        parse_with,
        print_figures,
        print_json,
    )
    from handavatar.evaluate.skin_table import evaluation_poses, measure_skin
    from handavatar.hand.open_hand import Level, load_open_hand
    from handavatar.hand.skin_refinement import (
        RefinementOptions,
        RefinementState,
        SkinRefinement,
        refine_skin,
    )
    from handavatar.hand.sparse_skin import SparseSkin
    from handavatar.jobs.files import refuse_file_in_use

    extras_wanted = (
        Extra("out", Path, "file to write (safetensors)", Path("skin.safetensors")),
        Extra("level", Level, "full is the default rig, 778 the one of MANO's size", "full"),
        Extra("rounds", int, "midpoint subdivisions", 2, least=0, most=4),
        Extra("resume", bool, "continue from OUT.part, which a stopped run has left", False),
        JSON,
        OVERWRITE,
    )
    options, extras = parse_with(RefinementOptions, extras_wanted, words, "rig refine")
    out: Path = extras["out"]
    part = out.with_name(out.name + ".part")
    refuse_file_in_use(out, extras["overwrite"])
    refuse_file_in_use(part, extras["overwrite"] or extras["resume"])
    base = load_open_hand(extras["level"])
    problem = SkinRefinement.of(base, extras["rounds"], options)
    is_continued = extras["resume"] and part.is_file()
    state = RefinementState.load(part, problem) if is_continued else problem.begin()
    progress.skip(state.step, problem.total_steps)
    with progress:

        def keep(now: RefinementState, figures: dict[str, float]) -> None:
            if now.step % 50 == 0 or is_stopping():
                with unbroken():
                    now.save(part, problem)
            note = "refit" if now.step > options.steps else ""
            progress(now.step, problem.total_steps, note, **figures)

        skins = refine_skin(problem, state, keep)
        made = SparseSkin.of(skins.fitted, base, extras["rounds"])
        made.save(out, {"rig": base.name, "options": json.dumps(asdict(options))})
        part.unlink(missing_ok=True)
    poses = evaluation_poses(base, 20)
    rows = {
        "averaged": problem.fine.skin_weights,
        "refined, any number of bones": skins.free,
        "cut to four bones": skins.projected,
        "fitted again": made.dense(),
    }
    figures = {
        name: measure_skin(base, problem.fine, weights, poses).summary()
        for name, weights in rows.items()
    }
    if extras["json"]:
        print_json({"file": str(out), "figures": figures})
    else:
        print_figures(figures)
        say(f"skin weights: {out}")
    return 0
