"""One self-contained page that shows how good an avatar is: no script, nothing loaded from outside.

Knows pictures, numbers and words, nothing of how they were made.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from handavatar.geometry.colors import eight_bits
from handavatar.jobs.files import write_atomically

Metric = float | int | str | bool | None
"""A figure; ``None`` was not measured."""

Figures = Metric | Mapping[str, Any]
"""A figure, or a group of figures and groups."""

ERROR_CEILING = 0.25
"""The error, of colours in [0, 1], that the error picture paints brightest."""

_CHART_WIDTH, _CHART_HEIGHT = 640, 220
_PLOT_LEFT, _PLOT_RIGHT, _PLOT_TOP, _PLOT_BOTTOM = 56, 14, 14, 30


@dataclass(frozen=True, eq=False)
class ReportRow:
    """One frame: its pictures side by side.

    Attributes:
        caption: e.g. the frame's name and its PSNR.
        pictures: by column, e.g. truth, rendered, albedo, illumination, normal, error; a column
            that a row lacks stays empty.
    """

    caption: str
    pictures: Mapping[str, UInt8[np.ndarray, "height width *channels"]]


@dataclass(frozen=True)
class Curve:
    """A figure over the steps of the training.

    Attributes:
        name: what it is, with its unit.
        points: (step, value); values that are not finite are left out.
    """

    name: str
    points: Sequence[tuple[int, float]]


def write_report(
    path: Path,
    title: str,
    metrics: Mapping[str, Figures],
    rows: Sequence[ReportRow] = (),
    unseen: Sequence[ReportRow] = (),
    curves: Sequence[Curve] = (),
    notes: Sequence[str] = (),
    subtitle: str = "",
) -> None:
    """Writes the page as one HTML file, all at once: a reader never sees half of it.

    Args:
        path: the file; its folder must exist.
        title: heading, plain text like all the others.
        metrics: figures by name; a group becomes a block of its own, and what is a group in it
            lines with longer names. ``mean``, ``low`` and ``high`` are printed as an interval.
        rows: frames with their pictures.
        unseen: pictures that show which skin was never seen.
        curves: charts; those with fewer than two points are left out.
        notes: what a reader must know to judge the figures.
        subtitle: a line below the heading.
    """
    sections = [
        _section("Figures", _metrics_html(metrics)),
        _section("Held-out frames", _rows_html(rows)),
        _section("Skin that was never seen", _rows_html(unseen)),
        _section("Training", "".join(_curve_svg(curve) for curve in curves)),
        _section("Notes", "".join(f"<li>{escape(note)}</li>" for note in notes), tag="ul"),
    ]
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body><main>"
        f"<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>\n"
        + "\n".join(section for section in sections if section)
        + "\n</main></body></html>\n"
    )
    write_atomically({path: page.encode()})


def picture(
    values: Float[Tensor, "height width *channels"],
) -> UInt8[np.ndarray, "height width *channels"]:
    """Values in [0, 1] as 8-bit pixels; outside they saturate, NaN is black."""
    filled = torch.nan_to_num(values.detach().float().cpu(), nan=0.0)
    pixels: np.ndarray = eight_bits(filled).numpy()
    return pixels


def error_picture(
    rendered: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Mean absolute error of the channels, from black over violet and orange to pale yellow."""
    error = (rendered - truth).detach().float().cpu().abs().mean(-1).numpy() / ERROR_CEILING
    stops = np.linspace(0, 1, len(_HEAT))
    channels = [np.interp(error, stops, channel) for channel in np.array(_HEAT).T]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def greyed(
    pixels: UInt8[np.ndarray, "height width 3"], known: Bool[Tensor, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with a middle grey where nothing is known."""
    shown = pixels.copy()
    shown[~known.cpu().numpy()] = 128
    return shown


def contact_sheet(
    rows: Sequence[ReportRow], columns: Mapping[str, str], limit: int = 12
) -> UInt8[np.ndarray, "height width 3"]:
    """One picture of frames below each other, captions above them.

    Args:
        rows: with colour pictures of one size, at least one row.
        columns: which pictures, with their headings.
        limit: of more rows so many are shown, evenly spread, the first and the last among them.
    """
    places = np.unique(np.linspace(0, len(rows) - 1, min(limit, len(rows))).round().astype(int))
    chosen = [rows[place] for place in places]
    height, width = next(iter(chosen[0].pictures.values())).shape[:2]
    sheet = Image.new("RGB", (width * len(columns), _LINE + (height + _LINE) * len(chosen)))
    draw = ImageDraw.Draw(sheet)
    for place, heading in enumerate(columns.values()):
        draw.text((place * width + 4, 2), heading, fill=(255, 255, 255))
    for number, row in enumerate(chosen):
        top = _LINE + number * (height + _LINE)
        draw.text((4, top + 2), row.caption, fill=(200, 200, 200))
        for place, name in enumerate(columns):
            pixels = np.ascontiguousarray(row.pictures[name])
            sheet.paste(Image.fromarray(pixels), (place * width, top + _LINE))
    return np.asarray(sheet)


_LINE = 16
"""Pixels of a line of text in the sheet."""

_HEAT = ((0, 0, 0), (62, 18, 92), (150, 38, 90), (226, 92, 42), (250, 176, 48), (255, 250, 205))


def _section(heading: str, content: str, tag: str = "div") -> str:
    return f"<section><h2>{heading}</h2><{tag}>{content}</{tag}></section>" if content else ""


def _metrics_html(metrics: Mapping[str, Figures]) -> str:
    """Single figures first, in one block; then a block for every group."""
    single = {name: value for name, value in metrics.items() if not isinstance(value, Mapping)}
    groups = {name: value for name, value in metrics.items() if isinstance(value, Mapping)}
    blocks = [("", single)] if single else []
    blocks += [(name, _flattened(group)) for name, group in groups.items() if group]
    tables = []
    for name, block in blocks:
        caption = f"<caption>{escape(_words(name))}</caption>" if name else ""
        lines = "".join(
            f'<tr><th scope="row">{escape(_words(key))}</th><td>{escape(_figure(value))}</td></tr>'
            for key, value in block.items()
        )
        tables.append(f"<table>{caption}{lines}</table>")
    return f'<div class="tables">{"".join(tables)}</div>' if tables else ""


def _flattened(group: Mapping[str, Any], before: str = "") -> dict[str, Metric]:
    """Groups within a group as lines with longer names; an interval is one line."""
    lines: dict[str, Metric] = {}
    for name, value in group.items():
        if isinstance(value, Mapping) and value.keys() == {"mean", "low", "high"}:
            mean, low, high = (_figure(value[key]) for key in ("mean", "low", "high"))
            lines[before + name] = f"{mean} [{low}, {high}]"
        elif isinstance(value, Mapping):
            lines |= _flattened(value, f"{before}{name} ")
        else:
            lines[before + name] = value
    return lines


def _words(name: str) -> str:
    return name.replace("_", " ")


def _figure(value: Metric) -> str:
    """Four significant digits; a dash for what was not measured."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)


def _rows_html(rows: Sequence[ReportRow]) -> str:
    """A grid with one column per kind of picture, in the order of their first appearance."""
    columns = list(dict.fromkeys(name for row in rows for name in row.pictures))
    if not columns:
        return ""
    heads = "".join(f'<div class="head">{escape(_words(name))}</div>' for name in columns)
    cells = []
    for row in rows:
        cells.append(f'<div class="caption">{escape(row.caption)}</div>')
        for name in columns:
            label = escape(f"{_words(name)}, {row.caption}", quote=True)
            source = _data_url(row.pictures[name]) if name in row.pictures else ""
            cells.append(f'<img alt="{label}" src="{source}">' if source else "<div></div>")
    style = f"grid-template-columns: repeat({len(columns)}, minmax(96px, 256px))"
    return (
        f'<div class="scroll"><div class="grid" style="{style}">{heads}{"".join(cells)}</div></div>'
    )


def _data_url(pixels: UInt8[np.ndarray, "height width *channels"]) -> str:
    """Colour as JPEG of high quality, everything else as PNG."""
    image = Image.fromarray(np.ascontiguousarray(pixels.squeeze()))
    encoded = io.BytesIO()
    if image.mode == "RGB":
        image.save(encoded, "JPEG", quality=92, subsampling=0)
    else:
        image.save(encoded, "PNG", optimize=True)
    kind = "jpeg" if image.mode == "RGB" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(encoded.getvalue()).decode('ascii')}"


def _curve_svg(curve: Curve) -> str:
    """A line chart with round ticks."""
    points = [(float(x), y) for x, y in curve.points if math.isfinite(x) and math.isfinite(y)]
    if len(points) < 2:
        return ""
    x_ticks = _ticks(min(x for x, _ in points), max(x for x, _ in points))
    y_ticks = _ticks(min(y for _, y in points), max(y for _, y in points))
    right, bottom = _CHART_WIDTH - _PLOT_RIGHT, _CHART_HEIGHT - _PLOT_BOTTOM

    def across(x: float) -> float:
        return _PLOT_LEFT + (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0]) * (right - _PLOT_LEFT)

    def up(y: float) -> float:
        return bottom - (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0]) * (bottom - _PLOT_TOP)

    lines = "".join(
        f'<line x1="{_PLOT_LEFT}" x2="{right}" y1="{up(y):.1f}" y2="{up(y):.1f}"/>'
        f'<text class="y" x="{_PLOT_LEFT - 8}" y="{up(y) + 4:.1f}">{y:g}</text>'
        for y in y_ticks
    )
    labels = "".join(
        f'<text class="x" x="{across(x):.1f}" y="{bottom + 20}">{x:,g}</text>' for x in x_ticks
    )
    path = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in _thinned(points))
    return (
        f"<figure><figcaption>{escape(curve.name)}</figcaption>"
        f'<svg role="img" viewBox="0 0 {_CHART_WIDTH} {_CHART_HEIGHT}">{lines}{labels}'
        f'<polyline points="{path}"/></svg></figure>'
    )


def _thinned(
    points: Sequence[tuple[float, float]], limit: int = 600
) -> Sequence[tuple[float, float]]:
    """At most about ``limit`` points, evenly chosen, the last one always among them."""
    stride = max(1, math.ceil(len(points) / limit))
    return [*points[:-1][::stride], points[-1]]


def _ticks(lowest: float, highest: float) -> list[float]:
    """Three to seven round numbers that enclose the range."""
    span = highest - lowest or abs(highest) or 1.0
    rough = span / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= rough)
    first, last = math.floor(lowest / step), math.ceil(highest / step)
    last = max(last, first + 1)
    return [round(number * step, 12) for number in range(first, last + 1)]


_STYLE = """
:root { --ink: #1d2229; --quiet: #667080; --paper: #f6f7f9; --card: #ffffff; --line: #e3e6eb;
  --accent: #2f6fde; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ee; --quiet: #95a0b0; --paper: #14171c;
  --card: #1c2027; --line: #2d333d; --accent: #7fa9ff; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 48px 24px 72px; }
h1 { font-size: 28px; font-weight: 650; letter-spacing: -0.015em; margin: 0; }
h2 { font-size: 13px; font-weight: 600; letter-spacing: 0.06em; text-transform: uppercase;
  color: var(--quiet); margin: 0 0 16px; }
header p { margin: 4px 0 0; color: var(--quiet); }
section { margin-top: 28px; padding: 24px; background: var(--card); border: 1px solid var(--line);
  border-radius: 12px; }
.tables { display: flex; flex-wrap: wrap; gap: 16px 48px; align-items: flex-start; }
table { border-collapse: collapse; min-width: 200px; }
caption { text-align: left; font-weight: 600; padding-bottom: 6px; }
th { text-align: left; font-weight: 400; color: var(--quiet); padding: 4px 24px 4px 0; }
td { text-align: right; font-variant-numeric: tabular-nums; padding: 4px 0; }
tr + tr > * { border-top: 1px solid var(--line); }
.scroll { overflow-x: auto; }
.grid { display: grid; gap: 6px; width: max-content; max-width: 100%; }
.grid img { display: block; width: 100%; border-radius: 6px; background: #000; }
.head, .caption { font-size: 13px; color: var(--quiet); }
.caption { grid-column: 1 / -1; padding-top: 8px; }
.head + .caption { padding-top: 0; }
figure { display: inline-block; width: min(100%, 540px); margin: 0 12px 12px 0; }
figcaption { font-weight: 600; margin-bottom: 4px; }
svg { width: 100%; height: auto; }
svg line { stroke: var(--line); }
svg text { fill: var(--quiet); font-size: 12px; }
svg text.x { text-anchor: middle; }
svg text.y { text-anchor: end; }
svg polyline { fill: none; stroke: var(--accent); stroke-width: 2; stroke-linejoin: round; }
ul { margin: 0; padding-left: 20px; }
li { margin: 4px 0; max-width: 78ch; }
""".strip()
