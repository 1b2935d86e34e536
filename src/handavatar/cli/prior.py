"""``handavatar prior``: the occupancy field before it has seen a person."""

from handavatar.cli.failures import say
from handavatar.jobs.progress import Progress


def train(words: list[str], progress: Progress) -> int:
    """Pre-train the occupancy prior on sampled poses and shapes."""
    import shlex

    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import PRIOR
    from handavatar.processes import is_first_process
    from handavatar.train.prior import PriorEvaluationOptions, PriorOptions, train_prior

    options = parse(PriorOptions, words, "prior train", reads={"start_from": PRIOR})
    with progress:
        train_prior(options, progress)
    if not is_first_process():
        return 0
    say(f"prior: {options.out}")
    judged = ["--prior", str(options.out)]
    for name in ("rig", "level", "rounds"):
        if getattr(options, name) != getattr(PriorEvaluationOptions, name):
            judged += [f"--{name}", str(getattr(options, name))]
    say(f"next: handavatar prior evaluate {shlex.join(judged)}")
    return 0


def evaluate(words: list[str], progress: Progress) -> int:
    """How well a prior knows inside from outside, on unseen poses and shapes."""
    from handavatar.cli.arguments import JSON, Extra, parse_with, print_figures, print_json
    from handavatar.cli.inputs import PRIOR
    from handavatar.hand.rigs import load_rig
    from handavatar.train.prior import PriorEvaluationOptions, evaluate_prior
    from handavatar.train.prior_measures import measure_prior_file

    extras_wanted = (
        Extra(
            "meshes",
            int,
            "extract meshes of so many unseen poses and fists as well",
            0,
            least=0,
            most=10**5,
        ),
        Extra(
            "resolution", int, "cells along the longest side of their box", 128, least=2, most=1024
        ),
        JSON,
    )
    options, extras = parse_with(
        PriorEvaluationOptions, extras_wanted, words, "prior evaluate", reads={"prior": PRIOR}
    )
    with progress:
        figures: dict[str, object] = {**evaluate_prior(options)}
        if extras["meshes"] > 0:
            base = load_rig(options.rig, options.level)
            figures |= measure_prior_file(
                options.prior, base, options.rounds, extras["meshes"], extras["resolution"]
            )
    (print_json if extras["json"] else print_figures)(figures)
    return 0


def picture(words: list[str], progress: Progress) -> int:
    """Show the surfaces of priors side by side: flat, fist, pinch, crossed fingers."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import PRIOR
    from handavatar.train.prior_pictures import PriorPictureOptions, picture_priors

    options = parse(PriorPictureOptions, words, "prior picture", reads={"priors": PRIOR})
    with progress:
        paths = picture_priors(options)
    for path in paths:
        say(path)
    return 0
