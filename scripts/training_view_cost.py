"""What a page costs a training: its speed with the page open and with the page's process halted.

    handavatar train CAPTURE --view --out RUN &
    python scripts/training_view_cost.py RUN PORT

The two states alternate every few seconds, so that what else the machine does meets both alike.
Needs Chromium, which shows the page on the machine that trains; while the page's process is halted
it waits. Copies of the avatar, at most a hundredth of the trainer's time, are made in both states.
"""

import argparse
import json
import os
import shutil
import signal
import statistics
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

SETTLE = 0.5
"""Seconds after a change of state that are not counted."""


def cpu_seconds(process: int) -> float:
    """CPU time of a process, its threads included."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(word) for word in found]


def page_process(trainer: int) -> int:
    for child in children(trainer):
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            return child
    raise SystemExit(f"process {trainer} has no page: train with --view")


def steps_in(log: Path, seconds: float, page: Any) -> tuple[int, float]:
    """Whole steps, and the time from the first one's end to the last one's."""
    lines: list[tuple[float, int]] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        size = log.stat().st_size
        if not lines or size != lines[-1][1]:
            lines.append((time.monotonic(), size))
        page.wait_for_timeout(10)  # It must be let do its work.
    # The first one was begun before.
    return len(lines) - 2, lines[-1][0] - lines[1][0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("port", type=int)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=8.0)
    options = parser.parse_args()
    state = json.loads((options.run / "live" / "progress.json").read_text())
    trainer = int(state["process"])
    page_of = page_process(trainer)
    rates: dict[str, list[float]] = {"without": [], "with": []}
    costs: dict[str, list[float]] = {"without": [], "with": []}
    own: list[float] = []
    with sync_playwright() as manager:
        browser = manager.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page: Any = browser.new_page(viewport={"width": 1200, "height": 800})
        try:
            page.goto(f"http://127.0.0.1:{options.port}/", timeout=300_000)
            page.wait_for_selector("#picture[data-stage]", timeout=300_000)
            for _ in range(options.pairs):
                for name in ("without", "with"):
                    os.kill(page_of, signal.SIGSTOP if name == "without" else signal.SIGCONT)
                    page.wait_for_timeout(1000 * SETTLE)
                    before, page_before = cpu_seconds(trainer), cpu_seconds(page_of)
                    steps, seconds = steps_in(options.run / "log.jsonl", options.seconds, page)
                    rates[name].append(steps / seconds)
                    costs[name].append((cpu_seconds(trainer) - before) / options.seconds)
                    if name == "with":
                        own.append((cpu_seconds(page_of) - page_before) / options.seconds)
                one, other = rates["without"][-1], rates["with"][-1]
                print(f"{one:.3f} {other:.3f} steps/s, ratio {other / one:.3f}", flush=True)
        finally:
            os.kill(page_of, signal.SIGCONT)
            browser.close()
    ratios = [b / a for a, b in zip(rates["without"], rates["with"], strict=True)]
    mean = statistics.fmean(ratios)
    cores = {name: statistics.fmean(values) for name, values in costs.items()}
    error = statistics.stdev(ratios) / len(ratios) ** 0.5
    print(
        f"with a page open {mean:.3f} of the speed (standard error {error:.3f}, "
        f"median {statistics.median(ratios):.3f}); all windows together "
        f"{sum(rates['with']) / sum(rates['without']):.3f}; the page's process takes "
        f"{statistics.fmean(own):.3f} of a core; the trainer {cores['without']:.2f} cores "
        f"without, {cores['with']:.2f} with; load {os.getloadavg()[0]:.1f}"
    )


if __name__ == "__main__":
    main()
