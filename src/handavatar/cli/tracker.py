"""``handavatar tracker``: our own eyes, taught by made pictures."""


def train(words: list[str]) -> int:
    """Teach the hand tracker on made pictures."""
    from contextlib import ExitStack

    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import TRACKER
    from handavatar.synthetic.lessons import TrackerTrainOptions, train_made_tracker
    from handavatar.train.progress import Progress

    options = parse(TrackerTrainOptions, words, "tracker train", reads={"start": TRACKER})
    bars: dict[str, Progress] = {}
    with ExitStack() as shown:

        def report(doing: str, done: int, total: int, loss: float) -> None:
            if doing not in bars:
                shown.close()
                bars[doing] = shown.enter_context(Progress(doing, total))
            bars[doing].update(done, loss=loss)

        train_made_tracker(options, report)
    print(f"tracker: {options.out}")
    print(f"next: handavatar tracker evaluate --tracker {options.out}")
    return 0


def evaluate(words: list[str]) -> int:
    """How well a tracker sees made pictures that it was not taught with."""
    from dataclasses import asdict

    from handavatar.cli.arguments import JSON, parse_with, print_figures, print_json
    from handavatar.cli.inputs import TRACKER
    from handavatar.synthetic.lessons import TrackerEvaluateOptions, evaluate_made_tracker

    options, extras = parse_with(
        TrackerEvaluateOptions, (JSON,), words, "tracker evaluate", reads={"tracker": TRACKER}
    )
    figures: dict[str, object] = asdict(evaluate_made_tracker(options))
    (print_json if extras["json"] else print_figures)(figures)
    return 0
