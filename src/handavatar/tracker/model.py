"""The trained tracker and its file."""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save

from handavatar.errors import HandAvatarError, raise_if_refused
from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import find_not_finite, require_finite
from handavatar.jobs.threads import one_thread
from handavatar.tracker.network import HandNetwork, Told
from handavatar.tracker.points import TrackedPoints

SCHEMA = 1
_ASSET = "tracker.safetensors"


class TrackerError(HandAvatarError):
    """A file that is no trained tracker."""


@dataclass(frozen=True, eq=False)
class TrainedTracker:
    """A network and the points that it tells.

    Attributes:
        network: in evaluation mode.
        points: of a rig.
    """

    network: HandNetwork
    points: TrackedPoints

    @torch.no_grad()
    @one_thread()
    def tell(self, crops: UInt8[np.ndarray, "crops side side 3"]) -> Told:
        """What the network says of square pieces of a picture that show a right hand.

        Args:
            crops: sRGB, ``INPUT_SIDE`` pixels a side.
        """
        pixels = torch.from_numpy(crops).permute(0, 3, 1, 2).float() / 255
        told: Told = self.network(pixels)
        return told


def save_tracker(path: Path, tracker: TrainedTracker, record: dict[str, object]) -> None:
    """Writes weights in half precision.

    Args:
        path: of the file.
        tracker: to write.
        record: what it was taught, kept as JSON.

    Raises:
        NotFinite: if a weight is NaN or infinite, or too large for half precision; nothing is
            written then.
    """
    tensors = {
        name: value.half().contiguous() if value.is_floating_point() else value
        for name, value in tracker.network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    require_finite(tensors, f"{path}: not saved, in half precision", "train with a lower rate")
    points = tracker.points
    header = {
        "schema": str(SCHEMA),
        "rig_name": points.rig_name,
        "rig_sha256": points.rig_sha256,
        "tips": json.dumps(points.tips.tolist()),
        "vertices": json.dumps(points.vertices.tolist()),
        "record": json.dumps(record),
    }
    write_atomically({path: save(tensors, header)})


def read_tracker(path: Path) -> TrainedTracker:
    """Reads a trained tracker.

    Raises:
        TrackerError: if it is none, or holds NaN or infinity.
    """
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
        tensors = {name: values.float() for name, values in load_file(path).items()}
        if header.get("schema") != str(SCHEMA):
            raise TrackerError(f"{path}: is no tracker of schema {SCHEMA}; train it again")
        if found := find_not_finite(tensors):
            raise TrackerError(f"{path}: {found}; copy the file again, or train it again")
        points = TrackedPoints(
            header["rig_name"],
            header["rig_sha256"],
            torch.tensor(json.loads(header["tips"])),
            torch.tensor(json.loads(header["vertices"])),
        )
        network = HandNetwork(len(points))
        network.load_state_dict(tensors, strict=False)
    except TrackerError:
        raise
    except (
        *(OSError, SafetensorError, KeyError, ValueError, RuntimeError),
        *(TypeError, OverflowError, RecursionError),
    ) as error:
        raise_if_refused(error)
        raise TrackerError(f"{path}: cannot be read as a tracker ({error})") from error
    return TrainedTracker(network.eval(), points)


@lru_cache(maxsize=1)
def shipped_tracker() -> TrainedTracker:
    """The one in the package."""
    with resources.as_file(resources.files("handavatar") / "assets" / _ASSET) as path:
        return read_tracker(path)
