"""``handavatar motion``: motions that drive avatars."""


def from_source(words: list[str]) -> int:
    """A capture or a video -> motion file that drives any avatar."""
    from handavatar.capture.motion import write_motion
    from handavatar.capture.motion_import import MotionFromOptions, motion_from
    from handavatar.cli.arguments import parse
    from handavatar.train.progress import Progress

    options = parse(MotionFromOptions, words, "motion from", positional=("source",))
    notes: list[str] = []
    with Progress("motion from", 100) as progress:
        motion = motion_from(
            options,
            notes.append,
            lambda share, stage: progress.update(round(100 * share), stage),
        )
    write_motion(options.out, motion)
    for note in notes:
        print(f"note: {note}")
    print(f"motion: {options.out}, {len(motion)} steps at {motion.fps:.4g} a second")
    print(f"next: handavatar render RUN --motion {options.out}")
    return 0
