"""What this machine and this installation can do, and the command that mends what they cannot.

Nothing here changes anything or reaches out of the machine.
"""

import ctypes.util
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

State = Literal["ok", "missing", "optional"]

_ASSETS = Path(__file__).parent / "assets"
_GIGABYTE = 2**30
_MEMORY_WANTED = 4 * _GIGABYTE
_DISK_WANTED = 2 * _GIGABYTE
_LPIPS_BACKBONE = "vgg16-397923af.pth"
_LPIPS_HEADS = ("lpips_vgg_v0.1.pth", "vgg.pth")
_MEND = "install handavatar again: scripts/setup, or pip install --force-reinstall handavatar"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: what was looked at.
        state: ``ok``; ``missing`` if demo, train, evaluate or render need it; ``optional`` if
            something is absent that only some commands or more speed need.
        found: what is there.
        remedy: the command or step that mends it; empty if nothing is to be done.
    """

    name: str
    state: State
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        """One line, and the remedy on a second."""
        mark = {"ok": "ok  ", "missing": "MISS", "optional": "-   "}[self.state]
        remedy = f"\n{'':18}-> {self.remedy}" if self.remedy else ""
        return f"{mark} {self.name:<12} {self.found}{remedy}"


def examine() -> list[Finding]:
    """Looks at everything; the order is that of importance."""
    return [
        _python(),
        *_torch(),
        _cores(),
        _memory(),
        _disk(),
        _video_codecs(),
        *_shipped_files(),
        _extra("video", ("cv2",), "handavatar capture video"),
        _mediapipe(),
        _made_captures(),
        _lpips(),
    ]


def _python() -> Finding:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    return Finding("python", "ok", found)


def _torch() -> list[Finding]:
    try:
        torch = importlib.import_module("torch")
    except Exception as error:  # a broken install fails in many ways
        return [Finding("torch", "missing", f"does not import: {error}", _MEND)]
    if not torch.cuda.is_available():
        device = Finding(
            "cuda",
            "optional",
            "no GPU found; everything runs on the CPU",
            "with an NVIDIA GPU: install its driver and a CUDA build of torch",
        )
    else:
        properties = torch.cuda.get_device_properties(0)
        memory = f"{properties.total_memory / _GIGABYTE:.0f} GB"
        device = Finding("cuda", "ok", f"{properties.name}, {memory}: use --device cuda")
    return [Finding("torch", "ok", str(torch.__version__)), device]


def _cores() -> Finding:
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        count = os.cpu_count() or 1
    return Finding("cores", "ok", str(count))


def _memory() -> Finding:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return Finding("memory", "ok", "not known")
    found = f"{total / _GIGABYTE:.1f} GB"
    if total < _MEMORY_WANTED:
        return Finding("memory", "optional", found, "4 GB are advised: close other programs")
    return Finding("memory", "ok", found)


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    found = f"{free / _GIGABYTE:.1f} GB free in {Path.cwd()}"
    if free < _DISK_WANTED:
        return Finding("disk", "missing", found, "make 2 GB of room, or write elsewhere with --out")
    return Finding("disk", "ok", found)


def _video_codecs() -> Finding:
    try:
        av = importlib.import_module("av")
        has_encoder = "libx264" in av.codecs_available
    except Exception as error:
        return Finding("video files", "missing", f"PyAV does not import: {error}", "pip install av")
    found = f"PyAV {_version('av')}" + (", writes H.264" if has_encoder else ", no H.264 encoder")
    if not has_encoder:
        return Finding("video files", "optional", found, "pip install --force-reinstall av")
    return Finding("video files", "ok", found)


def _shipped_files() -> list[Finding]:
    names = {
        "hand": ("open_hand.safetensors", "the open hand"),
        "prior": ("prior.safetensors", "the occupancy prior"),
        "capture": ("default_capture/transforms.json", "the default capture"),
    }
    findings = []
    for name, (file, label) in names.items():
        path = _ASSETS / file
        if path.is_file():
            findings.append(Finding(name, "ok", f"{label}: {path}"))
        else:
            findings.append(Finding(name, "missing", f"{label} is not at {path}", _MEND))
    return findings


def _extra(extra: str, packages: tuple[str, ...], needed_by: str) -> Finding:
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    if absent:
        remedy = f"scripts/setup, or pip install 'handavatar[{extra}]'"
        found = f"{' and '.join(absent)} not installed: {needed_by} will not run"
        return Finding(f"extra {extra}", "optional", found, remedy)
    return Finding(f"extra {extra}", "ok", f"{packages[0]} {_version(packages[0])}: {needed_by}")


def _mediapipe() -> Finding:
    if importlib.util.find_spec("mediapipe") is not None:
        found = f"mediapipe {_version('mediapipe')}: capture video --tracker both"
        return Finding("mediapipe", "ok", found)
    found = "not installed: capture video finds hands by its own tracker alone, less exactly"
    remedy = "with Python 3.12 or older: pip install 'handavatar[video]'"
    return Finding("mediapipe", "optional", found, remedy)


def _made_captures() -> Finding:
    finding = _extra("synth", ("mitsuba",), "handavatar capture synth")
    if finding.state != "ok" or platform.system() != "Linux":
        return finding
    # Mitsuba's vectorised variants load LLVM at run time; versions 15 and 16 abort the process.
    library = os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM-19")
    if library is None:
        remedy = "apt-get install libllvm19 (without it made captures are slow)"
        return Finding(finding.name, "optional", f"{finding.found}, no LLVM 19", remedy)
    return Finding(finding.name, "ok", f"{finding.found}, {library}")


def _lpips() -> Finding:
    home = Path(os.environ.get("TORCH_HOME") or _cache_folder() / "torch").expanduser()
    folder = home / "hub" / "checkpoints"
    has_heads = any((folder / name).is_file() for name in _LPIPS_HEADS)
    if has_heads and (folder / _LPIPS_BACKBONE).is_file():
        return Finding("lpips", "ok", f"weights in {folder}")
    return Finding(
        "lpips",
        "optional",
        f"no weights in {folder}: a weight-free substitute takes their place and is named",
        f"put torchvision's {_LPIPS_BACKBONE} and the lpips package's weights/v0.1/vgg.pth there",
    )


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()


def _version(package: str) -> str:
    # Some have another name where they are installed from: cv2 is opencv-python or a sibling.
    named = importlib.metadata.packages_distributions().get(package, [package])
    try:
        return importlib.metadata.version(named[0])
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"
