"""``handavatar motion``: motions that drive avatars."""

from handavatar.cli.failures import say, shown
from handavatar.jobs.progress import Progress


def from_source(words: list[str], progress: Progress) -> int:
    """A capture, a video or another tool's file -> motion that drives any avatar."""
    from handavatar.capture.motion import write_motion
    from handavatar.capture.motion_import import MotionFromOptions, motion_from
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import MOTION_SOURCE

    options = parse(MotionFromOptions, words, "motion from", ("source",), {"source": MOTION_SOURCE})
    notes: list[str] = []
    with progress:
        motion = motion_from(options, notes.append, progress)
    write_motion(options.out, motion)
    for note in notes:
        print(shown(f"note: {note}"))
    say(f"motion: {options.out}, {len(motion)} steps at {motion.fps:.4g} a second")
    say(f"next: handavatar render RUN --motion {options.out}")
    return 0


def to_file(words: list[str], progress: Progress) -> int:
    """A motion -> npz of SOMA-X, to move other hands and bodies."""
    from handavatar.capture.motion_export import MotionToOptions, motion_to
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import MOTION

    options = parse(MotionToOptions, words, "motion to", ("source",), {"source": MOTION})
    with progress:
        motion = motion_to(options)
    say(f"SOMA-X: {options.out}, {len(motion)} steps at {motion.fps:.4g} a second")
    say("next: SOMAHandLayer.pose(poses, absolute_pose=True, global_translation=transl)")
    return 0
