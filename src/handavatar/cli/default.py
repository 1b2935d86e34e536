"""``handavatar demo`` and ``handavatar doctor``: what needs nothing of the user's."""

from dataclasses import dataclass

from handavatar.cli.failures import BAD_DATA, say
from handavatar.jobs.progress import Progress


def demo(words: list[str], progress: Progress) -> int:
    """The whole road on the capture that ships, or on your own --video: train, evaluate, render."""
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import VIDEO
    from handavatar.demo import DemoOptions, run_demo

    options = parse(DemoOptions, words, "demo", reads={"video": VIDEO})
    with progress:
        run_demo(options, progress)
    if options.video is not None:
        say(f"open {options.out / 'report.html'}, {options.out / 'own_motion.mp4'}")
        say(f"next: handavatar view {options.out / 'run'}")
    return 0


@dataclass(frozen=True)
class _DoctorOptions:
    """Looks at this machine and this installation: what is missing, and the remedy."""


def doctor(words: list[str], progress: Progress) -> int:
    """What is missing on this machine, and the command that mends it."""
    from handavatar.cli.arguments import JSON, parse_with, print_json
    from handavatar.doctor import examine

    _, extras = parse_with(_DoctorOptions, (JSON,), words, "doctor")
    with progress:
        findings = examine()
    is_able = all(finding.state != "missing" for finding in findings)
    if extras["json"]:
        print_json({"able": is_able, "findings": [vars(finding) for finding in findings]})
    else:
        for finding in findings:
            say(finding)
        say(
            "\nEverything that handavatar demo, train, evaluate and render need is here."
            if is_able
            else "\nSomething is missing that handavatar cannot work without; see above."
        )
    return 0 if is_able else BAD_DATA
