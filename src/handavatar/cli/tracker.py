"""``handavatar tracker``: our own eyes, taught by made pictures."""

from handavatar.cli.failures import say
from handavatar.jobs.progress import Progress


def train(words: list[str], progress: Progress) -> int:
    """Teach the hand tracker on made pictures."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import TRACKER
    from handavatar.synthetic.lessons import TrackerTrainOptions, train_made_tracker

    options = parse(TrackerTrainOptions, words, "tracker train", reads={"start_from": TRACKER})
    with progress:
        train_made_tracker(options, progress)
    say(f"tracker: {options.out}")
    say(f"next: handavatar tracker evaluate --tracker {options.out}")
    return 0


def evaluate(words: list[str], progress: Progress) -> int:
    """How well a tracker sees made pictures that it was not taught with."""
    from dataclasses import asdict

    from handavatar.cli.arguments import JSON, parse_with, print_figures, print_json
    from handavatar.cli.inputs import TRACKER
    from handavatar.synthetic.lessons import TrackerEvaluateOptions, evaluate_made_tracker

    options, extras = parse_with(
        TrackerEvaluateOptions, (JSON,), words, "tracker evaluate", reads={"tracker": TRACKER}
    )
    with progress:
        figures: dict[str, object] = asdict(evaluate_made_tracker(options))
    (print_json if extras["json"] else print_figures)(figures)
    return 0
