"""The benchmark with truth: named captures of three subjects under three lightings, and worse ones.

A name says what it is: ``medium-key`` is the subject of medium skin under key and fill,
``dark-dome-direct`` a dark one under even light without light bounced off skin, ``light-key-pose5``
the first one's capture with poses that are off by five degrees. Everything follows from the name
and the size: subjects, skins, motions, noise.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from handavatar.capture.checks import CaptureError
from handavatar.capture.degraded import DegradeOptions, degrade_capture
from handavatar.capture.pathtracer import LIGHTINGS
from handavatar.capture.synthetic import SynthOptions, make_capture
from handavatar.jobs.files import FolderKind, claim_folder, make_folder
from handavatar.jobs.progress import SILENT, Progress


def _is_older(folder: Path) -> bool:
    """Whether a version that left no marker has made captures there."""
    return any((folder / size / name).is_dir() for size in _SIZES for name in benchmark_names())


BENCHMARK = FolderKind("benchmark", is_older=_is_older)
"""A folder of captures, each in a folder of its name."""

SUBJECTS: dict[str, tuple[int, float]] = {
    "light": (101, 0.05),
    "medium": (102, 0.45),
    "dark": (103, 0.95),
}
"""Seed of shape, personal detail, skin and motion; tone of the skin."""
_SIZES: dict[str, SynthOptions] = {
    "mini": SynthOptions(train_frames=40, test_frames=16, size=128, samples=324),
    "standard": SynthOptions(train_frames=120, test_frames=40, size=256, samples=324),
}
DEGRADATIONS: dict[str, DegradeOptions] = {
    "pose2": DegradeOptions(Path(), pose_noise=2.0),
    "pose5": DegradeOptions(Path(), pose_noise=5.0),
    "pose10": DegradeOptions(Path(), pose_noise=10.0),
    "eroded": DegradeOptions(Path(), mask_erosion=2),
    "blurred": DegradeOptions(Path(), blur=1.0),
    "jpeg": DegradeOptions(Path(), jpeg=40),
}
"""Of the captures under key and fill with all transport of light."""


def benchmark_names() -> tuple[str, ...]:
    """All captures: those that are rendered first."""
    rendered = [
        f"{subject}-{lighting}{transport}"
        for subject in SUBJECTS
        for lighting in LIGHTINGS
        for transport in ("", "-direct")
    ]
    worse = [f"{subject}-key-{name}" for subject in SUBJECTS for name in DEGRADATIONS]
    return (*rendered, *worse)


@dataclass(frozen=True)
class BenchmarkOptions:
    """The named captures with known truth.

    Attributes:
        size: ``mini`` renders in a minute a capture (128 pixels, 40 and 16 frames), ``standard``
            has 256 pixels, 120 and 40 frames.
        only: names of captures; by default all of them. What they are made from is made too.
    """

    size: Literal["mini", "standard"] = "mini"
    only: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """The captures to make, in an order in which sources come first.

        Raises:
            CaptureError: for a name that the benchmark does not have.
        """
        known = benchmark_names()
        for name in self.only:
            if name not in known:
                raise CaptureError(f"the benchmark has no {name!r}", f"choose: {', '.join(known)}")
        wanted = set(self.only or known)
        wanted |= {_source(name) for name in wanted}
        return tuple(name for name in known if name in wanted)


def _source(name: str) -> str:
    """The capture that a worse one is made from, else the same."""
    clean, _, ending = name.rpartition("-")
    return clean if ending in DEGRADATIONS else name


def synth_options(name: str, size: Literal["mini", "standard"]) -> SynthOptions:
    """How one of the rendered captures is made."""
    subject, lighting, *transport = name.split("-")
    seed, tone = SUBJECTS[subject]
    return replace(
        _SIZES[size],
        seed=seed,
        tone=tone,
        lighting=next(known for known in LIGHTINGS if known == lighting),
        transport="direct" if transport else "full",
        contacts=True,
        test_views=4,
    )


def make_benchmark(
    folder: Path,
    options: BenchmarkOptions,
    progress: Progress = SILENT,
) -> list[Path]:
    """Makes the captures that are not there yet, each in a folder of its name.

    An interrupted call goes on where it stopped: a capture appears whole or not at all.

    Args:
        folder: where they are to be.
        options: size and names.
        progress: told how far it is, and the name of each capture.

    Raises:
        CaptureError: for an unknown name, or if Mitsuba is missing.
        FolderInUse: if ``folder`` holds something else.
    """
    claim_folder(folder, BENCHMARK)
    make_folder(folder / options.size, BENCHMARK)
    folders = []
    parts = progress.stages({name: 1.0 for name in options.names()})
    for name in options.names():
        target = folder / options.size / name
        if target.exists():
            parts[name].skip()
        else:
            source = _source(name)
            if source == name:
                make_capture(target, synth_options(name, options.size), progress=parts[name])
            else:
                worse = DEGRADATIONS[name.rpartition("-")[2]]
                seed = SUBJECTS[name.split("-")[0]][0]
                how = replace(worse, source=folder / options.size / source, seed=seed)
                degrade_capture(target, how, progress=parts[name])
        folders.append(target)
        parts[name](1.0)
    return folders
