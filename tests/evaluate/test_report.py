import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from handavatar.evaluate.report import (
    ERROR_CEILING,
    Curve,
    ReportRow,
    contact_sheet,
    error_picture,
    greyed,
    picture,
    write_report,
)

VOID = {"meta", "img", "br", "hr", "link", "line", "polyline"}


class Page(HTMLParser):
    """Elements, text and attributes of a page; complains about wrong nesting."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> inside {self.open}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.text += data + "\n"


def written(path: Path, **content: object) -> str:
    write_report(path, **content)  # type: ignore[arg-type]
    return path.read_text(encoding="utf-8")


def full_report(path: Path) -> str:
    color = (np.random.default_rng(0).random((32, 24, 3)) * 255).astype(np.uint8)
    rows = [
        ReportRow("frame 12 · 31.2 dB", {"truth": color, "rendered": color, "albedo": color}),
        ReportRow("frame 40", {"truth": color, "illumination": color[..., 0]}),
    ]
    return written(
        path,
        title="Avatar of a hand",
        metrics={
            "frames": 40,
            "mask_iou": 0.95678,
            "paper": {"psnr": 31.234567, "lpips": None},
            "masked": {"psnr": float("nan")},
            "protocol mask": {"core": {"psnr": 33.33}, "gain": {"mean": 2, "low": 1.5, "high": 3}},
            "perceptual": "lpips-vgg",
        },
        rows=rows,
        curves=[Curve("PSNR, dB", [(0, 10.0), (100, float("nan")), (2000, 30.5)])],
        notes=["LPIPS was not measured."],
    )


def test_page_is_well_formed_and_shows_everything(tmp_path: Path) -> None:
    page = Page(full_report(tmp_path / "report.html"))
    for text in ("Avatar of a hand", "mask iou", "0.9568", "31.23", "frame 12 · 31.2 dB"):
        assert text in page.text
    for text in (
        "core psnr",
        "33.33",
        "2 [1.5, 3]",
        "LPIPS was not measured.",
        "PSNR, dB",
        "lpips-vgg",
        "illumination",
    ):
        assert text in page.text
    assert "nan" not in page.text.lower() and page.text.count("–") == 2
    assert page.tags.count("img") == 5
    assert list(tmp_path.iterdir()) == [tmp_path / "report.html"]


def test_page_stands_alone(tmp_path: Path) -> None:
    html = full_report(tmp_path / "report.html")
    page = Page(html)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    sources = [value for name, value in page.attributes if name in ("src", "href")]
    assert sources and all(value.startswith("data:image/") for value in sources)
    assert "://" not in html and "@import" not in html and "url(" not in html
    assert not [name for name, _ in page.attributes if name.startswith("on")]


def test_pictures_survive(tmp_path: Path) -> None:
    grey = (np.random.default_rng(1).random((9, 7)) * 255).astype(np.uint8)
    smooth = np.linspace(0, 255, 32 * 24 * 3).reshape(32, 24, 3).astype(np.uint8)
    html = written(
        tmp_path / "report.html",
        title="",
        metrics={},
        rows=[ReportRow("", {"grey": grey, "grey1": grey[..., None], "color": smooth})],
    )
    pictures = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
        for data in re.findall(r"base64,([^\"]+)\"", html)
    ]
    assert np.array_equal(pictures[0], grey) and np.array_equal(pictures[1], grey)
    assert np.abs(pictures[2].astype(int) - smooth).mean() < 2  # JPEG of high quality


def test_text_is_escaped_everywhere(tmp_path: Path) -> None:
    evil = '<script>alert("1")</script>\'&'
    html = written(
        tmp_path / "report.html",
        title=evil,
        subtitle=evil,
        metrics={evil: evil, "group " + evil: {evil: evil}},
        rows=[ReportRow(evil, {evil: np.zeros((4, 4, 3), np.uint8)})],
        curves=[Curve(evil, [(0, 0.0), (1, 1.0)])],
        notes=[evil],
    )
    page = Page(html)
    assert "script" not in page.tags and "<script" not in html
    assert page.text.count(evil) == 12


def test_empty_parts_leave_no_heading(tmp_path: Path) -> None:
    page = Page(written(tmp_path / "report.html", title="T", metrics={}))
    assert "section" not in page.tags
    page = Page(
        written(tmp_path / "report.html", title="T", metrics={}, curves=[Curve("c", [(0, 1.0)])])
    )
    assert "svg" not in page.tags


@pytest.mark.parametrize(
    "values", [[3.0, 3.0], [0.0, 0.0], [-1e-9, 1e-9], [1e6, 3e9], [20.1, 31.9], [-5.0, 5.0]]
)
def test_curves_stay_inside_their_chart(tmp_path: Path, values: list[float]) -> None:
    points = [(step, values[step % 2]) for step in range(5000)]
    html = written(tmp_path / "report.html", title="", metrics={}, curves=[Curve("c", points)])
    (line,) = re.findall(r'<polyline points="([^"]+)"', html)
    places = np.array([pair.split(",") for pair in line.split()], dtype=float)
    assert len(places) < 1000
    assert places[:, 0].min() >= 56 and places[:, 0].max() <= 626
    assert places[:, 1].min() >= 14 and places[:, 1].max() <= 190


def test_picture_saturates() -> None:
    values = torch.tensor([[-1.0, 0.0, 0.5, 1.0, 2.0, float("nan")]])
    assert picture(values).tolist() == [[0, 0, 128, 255, 255, 0]]


def test_error_picture_brightens_with_the_error() -> None:
    errors = torch.linspace(0, 1.5 * ERROR_CEILING, 50)[None, :, None].expand(1, 50, 3)
    brightness = error_picture(errors, torch.zeros(1, 50, 3)).astype(int).sum(-1)[0]
    assert brightness[0] == 0
    assert (np.diff(brightness) >= 0).all()
    assert (np.diff(brightness[:33]) > 0).all()


def test_unknown_pixels_are_grey() -> None:
    known = torch.tensor([[True, False]])
    pixels = np.array([[[1, 2, 3], [4, 5, 6]]], dtype=np.uint8)
    assert greyed(pixels, known).tolist() == [[[1, 2, 3], [128, 128, 128]]]
    assert pixels.tolist() == [[[1, 2, 3], [4, 5, 6]]]


def test_the_sheet_holds_the_first_and_the_last_row_and_at_most_so_many() -> None:
    rows = [
        ReportRow(
            f"row {n}",
            {"a": np.full((20, 30, 3), n, np.uint8), "b": np.zeros((20, 30, 3), np.uint8)},
        )
        for n in range(40)
    ]
    sheet = contact_sheet(rows, {"b": "B", "a": "A"}, limit=12)
    assert sheet.shape == (16 + 12 * 36, 60, 3)
    values = [int(sheet[16 + 36 * place + 20, 45, 0]) for place in range(12)]
    assert values[0] == 0 and values[-1] == 39 and values == sorted(set(values))
    assert contact_sheet(rows[:3], {"a": "A"}).shape == (16 + 3 * 36, 30, 3)
