"""``handavatar bench --table peers``: prior art and ours on the same frames and the same hand."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.avatar import RenderSettings
from handavatar.capture.frames import Frame, read_capture
from handavatar.errors import SEEDS, require_ranges
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import TABLES, Cell, ResultTable, step_counter
from handavatar.evaluate.textured_mesh import RAYS, fit_textured_mesh
from handavatar.jobs.files import make_folder
from handavatar.jobs.progress import SILENT, Progress
from handavatar.peers.inverse_skinning import fit_inverse_skinning
from handavatar.train.ablation import (
    ROWS,
    FittedGeometry,
    FrameScores,
    Shading,
    View,
    fitted_geometry,
    shaded_view,
    trained_shading,
    view_of_frame,
)
from handavatar.train.kept import (
    capture_fingerprint,
    origin,
    origin_notes,
    read_kept,
    write_kept,
)
from handavatar.train.loop import METHODS

OURS = {"ours (paper)": "+ directed occupancy (paper)", "ours (best)": "traced light"}
PEERS = ("textured mesh", "inverse skinning")


@dataclass(frozen=True)
class PeersTableOptions:
    """What is compared.

    Attributes:
        captures: folders of captures whose poses are known, one after the other.
        kept: folder; what was reached on a capture is kept there as ``peers-CAPTURE.json`` and is
            not measured again with the same steps and seeds. Figures of another capture are
            refused.
        seeds: of all trainings; geometry is fitted once per capture.
        steps: of our shadings.
        peer_steps: of the others.
        any_commit: kept figures that another commit measured are shown too, and the table says
            which; else they are refused.
    """

    captures: tuple[Path, ...]
    kept: Path = Path("peers")
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 310
    peer_steps: int = 600
    any_commit: bool = False

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, seeds=SEEDS, steps=(1, 10**8), peer_steps=(1, 10**8))

    @property
    def total_steps(self) -> int:
        """Rows and seeds of all captures."""
        return (len(OURS) + len(PEERS)) * len(self.seeds) * len(self.captures)


def peers_table(options: PeersTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Fits everything to every capture, and judges the frames that none has seen.

    Args:
        options: what to compare.
        progress: told the number of trainings done.

    Raises:
        CaptureError: if a capture is damaged, or what is kept is of another capture or commit.

    Source: paper Sec. 4.3, comparison with prior art.
    """
    finished = step_counter(progress, options.total_steps)
    measured: list[dict[str, Any]] = []
    about = {
        "seeds": list(options.seeds),
        "steps": options.steps,
        "peer_steps": options.peer_steps,
        "rays": RAYS,
    }
    for folder in options.captures:
        path = options.kept / f"peers-{folder.name}.json"
        read_capture(folder)
        sha256 = capture_fingerprint(folder)
        found = read_kept(path, sha256, options.any_commit)
        if {name: found.get(name) for name in about} == about:
            for _ in range((len(OURS) + len(PEERS)) * len(options.seeds)):
                finished()
        else:
            rows = _measured(folder, options, finished)
            found = about | {"capture": folder.name, "rows": rows} | origin(sha256, rows)
            make_folder(options.kept, TABLES)
            found = write_kept(path, found)
        measured.append(found)
    return _table(measured, options)


def _measured(
    folder: Path, options: PeersTableOptions, finished: Callable[[], None]
) -> dict[str, dict[str, Any]]:
    capture, method = read_capture(folder), METHODS["quick"]
    geometry = fitted_geometry(capture, "personal", method, 0)
    views = [_finer_view(geometry, view.frame, method.num_samples) for view in geometry.views]
    rows: dict[str, dict[str, Any]] = {}
    for seed in options.seeds:
        for name in PEERS:
            picture = _fitted_peer(name, geometry, options, seed)
            pictures = (picture(view.frame) for view in geometry.views)
            rows.setdefault(name, {})[str(seed)] = _scores(pictures, geometry)
            finished()
        for name, part in OURS.items():
            shading = trained_shading(ROWS[part], geometry, method, options.steps, seed)
            pictures = (_smooth_picture(shading, view) for view in views)
            rows.setdefault(name, {})[str(seed)] = _scores(pictures, geometry)
            finished()
    return rows


def _finer_view(geometry: FittedGeometry, frame: Frame, num_samples: int) -> View:
    """With as many rays a pixel as the textured mesh, whose outlines are smooth."""
    camera = frame.camera.resized(RAYS * frame.camera.width, RAYS * frame.camera.height)
    return view_of_frame(geometry.avatar, frame, camera, RenderSettings(num_samples=num_samples))


def _smooth_picture(shading: Shading, fine: View) -> Float[Tensor, "height width 4"]:
    """Colour on black and coverage, the means over the rays of each pixel."""
    picture = shaded_view(shading, fine)
    values = torch.cat([picture["color"], picture["alpha"][..., None]], dim=-1)
    return torch.nn.functional.avg_pool2d(values.movedim(-1, 0)[None], RAYS)[0].movedim(0, -1)


def _fitted_peer(
    name: str, geometry: FittedGeometry, options: PeersTableOptions, seed: int
) -> Callable[[Frame], Float[Tensor, "height width 4"]]:
    avatar, frames, steps = geometry.avatar, geometry.frames, options.peer_steps
    if name == "textured mesh":
        return fit_textured_mesh(avatar, frames, geometry.color, steps, seed)
    return fit_inverse_skinning(avatar, frames, steps, seed)


def _scores(
    pictures: Iterable[Float[Tensor, "height width 4"]], geometry: FittedGeometry
) -> dict[str, list[float]]:
    """Of one picture of every test frame, in order."""
    scores = FrameScores()
    for values, view in zip(pictures, geometry.views, strict=True):
        scores.add(view.frame, values[..., :3], values[..., 3])
    return scores.by_name


def _table(measured: list[dict[str, Any]], options: PeersTableOptions) -> ResultTable:
    def of_frames(name: str, key: str) -> Tensor:
        parts = [
            torch.tensor([values[key] for values in found["rows"][name].values()]).mean(0)
            for found in measured
        ]
        return torch.cat(parts)

    rows: dict[str, dict[str, Cell]] = {}
    keys = list(next(iter(measured[0]["rows"][PEERS[0]].values())))
    for name in (*PEERS, *OURS):
        line: dict[str, Cell] = {
            key: round(float(of_frames(name, key).mean()), 2 if "psnr" in key else 4)
            for key in keys
        }
        for ours in OURS:
            text = None
            if name in PEERS:
                ahead = of_frames(ours, "psnr") - of_frames(name, "psnr")
                text = mean_interval(ahead).of_difference()
            line[f"{ours} ahead by"] = text
        rows[name] = line
    others = [key for key in keys if "psnr" not in key]

    def against(peer: str, ours: str) -> str:
        ahead = {key: mean_interval(of_frames(ours, key) - of_frames(peer, key)) for key in others}
        parts = (
            f"{key} {at.mean:+.4f} [{at.low:+.4f}, {at.high:+.4f}]" for key, at in ahead.items()
        )
        return f"{ours} minus {peer}: {', '.join(parts)}."

    count = len(of_frames(PEERS[0], "psnr"))
    notes = (
        f"Captures: {', '.join(found['capture'] for found in measured)}; {count} test frames of "
        f"poses and cameras never seen, seeds {list(options.seeds)}; {options.steps} steps of ours "
        f"and {options.peer_steps} of the others on the same frames and the same personal mesh; "
        f"ours and the mesh with {RAYS}x{RAYS} rays a pixel. "
        "Ahead: masked PSNR, decibels, paired by frame, mean over seeds [95 % over frames].",
        *(against(peer, ours) for peer in PEERS for ours in OURS),
        *origin_notes({str(found["capture"]): found for found in measured}),
    )
    return ResultTable("Prior art", rows, notes)
