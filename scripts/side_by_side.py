"""Held-out frames that two runs of one capture were both judged on: the best, middle and worst.

    python scripts/side_by_side.py RUN_A RUN_B --out docs/images/real_video.png

Columns: truth, A, B, B's albedo, B's illumination, B's error. Rows are ordered by B's masked PSNR,
which is printed with A's for every frame that is shown.
"""

import argparse
import json
import re
from pathlib import Path

import numpy as np
from PIL import Image

COUNT = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs=2, type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=200, help="pixels along a side of one picture")
    options = parser.parse_args()
    scores = [frame_scores(run / "evaluation") for run in options.runs]
    both = scores[0].keys() & scores[1].keys()
    names = sorted(both, key=lambda name: -scores[1][name])
    chosen = [names[place] for place in np.linspace(0, len(names) - 1, COUNT).round().astype(int)]
    rows = []
    for name in chosen:
        first, second = (columns(run / "evaluation" / f"{name}.png") for run in options.runs)
        shown = [second[0], first[1], second[1], second[2], second[3], second[5]]
        size = (options.size, options.size)
        rows.append(np.concatenate([np.asarray(p.resize(size, 1)) for p in shown], axis=1))
        print(f"{name}: {scores[0][name]:.1f} and {scores[1][name]:.1f} dB masked")
    Image.fromarray(np.concatenate(rows)).save(options.out)
    means = [json.loads((run / "evaluation/metrics.json").read_text()) for run in options.runs]
    for run, metrics in zip(options.runs, means, strict=True):
        print(run, json.dumps(metrics["masked"]), metrics["mask_iou"])


def frame_scores(folder: Path) -> dict[str, float]:
    """Masked PSNR by frame, as the report has them."""
    text = (folder / "report.html").read_text()
    return {name: float(value) for name, value in re.findall(r"(\w+)  ([\d.]+) dB masked", text)}


def columns(strip: Path) -> list[Image.Image]:
    picture = Image.open(strip)
    side = picture.height
    return [picture.crop((x, 0, x + side, side)) for x in range(0, picture.width, side)]


if __name__ == "__main__":
    main()
