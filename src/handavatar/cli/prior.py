"""``handavatar prior``: the occupancy field before it has seen a person."""


def train(words: list[str]) -> int:
    """Pre-train the occupancy prior on sampled poses and shapes."""
    import shlex

    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import PRIOR
    from handavatar.processes import is_first_process
    from handavatar.train.prior import PriorEvaluationOptions, PriorOptions, train_prior
    from handavatar.train.progress import Progress

    options = parse(PriorOptions, words, "prior train", reads={"start_from": PRIOR})
    if not is_first_process():
        train_prior(options)
        return 0
    latest: dict[str, float] = {}
    with Progress("prior", options.steps) as progress:

        def report(step: int, figures: dict[str, float]) -> None:
            latest.update(figures)
            progress.update(step, loss=figures["loss"], samples=figures["samples_per_second"])

        train_prior(options, report)
    print(f"prior: {options.out}")
    if latest:
        shares = [(share, name[6:]) for name, share in latest.items() if name.startswith("share_")]
        listed = ", ".join(f"{name} {share:.0%}" for share, name in sorted(shares, reverse=True))
        print(f"speed: {latest['samples_per_second']:,.0f} labelled points/s; {listed}")
    judged = ["--prior", str(options.out)]
    for name in ("rig", "level", "rounds"):
        if getattr(options, name) != getattr(PriorEvaluationOptions, name):
            judged += [f"--{name}", str(getattr(options, name))]
    print(f"next: handavatar prior evaluate {shlex.join(judged)}")
    return 0


def evaluate(words: list[str]) -> int:
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
    figures: dict[str, object] = {**evaluate_prior(options)}
    if extras["meshes"] > 0:
        base = load_rig(options.rig, options.level)
        figures |= measure_prior_file(
            options.prior, base, options.rounds, extras["meshes"], extras["resolution"]
        )
    (print_json if extras["json"] else print_figures)(figures)
    return 0


def picture(words: list[str]) -> int:
    """Show the surfaces of priors side by side: flat, fist, pinch, crossed fingers."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import PRIOR
    from handavatar.train.prior_pictures import PriorPictureOptions, picture_priors

    options = parse(PriorPictureOptions, words, "prior picture", reads={"priors": PRIOR})
    for path in picture_priors(options):
        print(path)
    return 0
