"""The made capture that ships with the package, so that everything can be tried offline."""

from importlib import resources
from pathlib import Path

from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import Capture, read_capture


def default_capture() -> Capture:
    """80 frames to train on and 20 of other poses, 256 x 256, with albedo and shading known.

    Raises:
        CaptureError: if the package was installed without its assets.
    """
    folder = Path(str(resources.files("handavatar") / "assets" / "default_capture"))
    if not folder.is_dir():
        raise CaptureError(f"{folder} is missing", "install handavatar again")
    return read_capture(folder)
