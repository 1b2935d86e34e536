"""The real page in a real browser: what a person moves is what is seen, and nothing goes astray."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from chromium import MARKS, late, visit, watched
from live import live_server
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.view.server import ViewServer

pytestmark = MARKS


@pytest.fixture(scope="module")
def server(
    small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ViewServer]:
    with live_server(small_avatar, tmp_path_factory.mktemp("page") / "edited") as running:
        yield running


@pytest.fixture
def page(browser: Any, server: ViewServer) -> Iterator[Any]:
    """The page with a small picture, and a list ``strays`` of what went wrong on it."""
    with visit(browser, viewport={"width": 1100, "height": 800}) as context:
        made = watched(context.new_page(), lambda url: url.startswith(own_addresses(server)))
        made.goto(server.address)
        made.select_option("#size", "64")
        yield made
        assert made.strays == []


def own_addresses(server: ViewServer) -> tuple[str, str]:
    return server.address, f"blob:{server.address}"


def settled(page: Any, stage: str = "full") -> np.ndarray:
    """The picture's pixels once the newest wish has reached a stage."""
    page.wait_for_function(
        "stage => order > 0 && picture.dataset.order == order && picture.dataset.stage == stage",
        arg=stage,
    )
    return pixels(page)


def pixels(page: Any) -> np.ndarray:
    data, width = page.evaluate(
        "() => [Array.from(picture.getContext('2d').getImageData(0, 0, picture.width,"
        " picture.height).data), picture.width]"
    )
    return np.array(data, dtype=np.uint8).reshape(-1, width, 4)[..., :3]


def move(page: Any, selector: str, value: float) -> None:
    """Moves a slider as a person does."""
    page.eval_on_selector(
        selector,
        "(input, value) => { input.value = value;"
        " input.dispatchEvent(new Event('input', { bubbles: true })); }",
        value,
    )


def test_the_first_picture_is_refined_to_the_full_one(page: Any) -> None:
    full = settled(page)
    assert full.shape == (64, 64, 3) and 0.05 < full.any(-1).mean() < 0.9
    assert "full" in page.inner_text("#state")
    assert page.is_hidden("#problem")


def test_a_slider_moves_the_finger(page: Any) -> None:
    before = settled(page)
    page.click("summary:has-text('index')")
    move(page, "input[aria-label='index1 flexion']", 80)
    after = settled(page)
    changed = (before.astype(int) - after).any(-1)
    assert 0.005 < changed.mean() < 0.5
    page.click("#unpose")
    assert (settled(page) == before).all()


def test_a_shadow_is_lifted_and_laid_again(page: Any) -> None:
    page.select_option("#gesture", "fist")
    page.check("input[value=illumination]")
    before = settled(page)
    page.uncheck("#shadows input[value=thumb]")
    lifted = settled(page)
    assert (lifted != before).any()
    page.check("#shadows input[value=thumb]")
    assert (settled(page) == before).all()


def test_light_and_skin_change_and_come_back(page: Any) -> None:
    before = settled(page)
    move(page, "#light", 1.8)
    brighter = settled(page)
    assert brighter.sum() > 1.3 * before.sum()
    move(page, "#red", 0.4)
    redder = settled(page)
    assert redder[..., 0].sum() > brighter[..., 0].sum()
    assert (redder[..., 1] == brighter[..., 1]).all()
    page.click("#unedit")
    assert (settled(page) == before).all()
    assert page.input_value("#light") == "1"


def test_an_avatar_of_several_clips_offers_their_lights_and_no_other_does(
    page: Any, browser: Any, two_lights: HandAvatar, tmp_path: Path
) -> None:
    assert page.is_hidden("#lights")
    with live_server(two_lights, tmp_path) as running, visit(browser) as context:
        of_two = watched(context.new_page(), lambda url: url.startswith(own_addresses(running)))
        of_two.goto(running.address)
        of_two.select_option("#size", "64")
        first = settled(of_two)
        assert of_two.is_visible("#lights") and of_two.input_value("#clip") == "0"
        of_two.select_option("#clip", "1")
        second = settled(of_two)
        assert (second != first).any()
        of_two.click("#unedit")
        assert (settled(of_two) == first).all() and of_two.input_value("#clip") == "0"
        assert of_two.strays == []


def test_dragging_turns_the_hand_and_the_wheel_zooms(page: Any) -> None:
    before = settled(page)
    box = page.locator("#picture").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x + 20 * step, y)
    page.mouse.up()
    turned = settled(page)
    assert (turned != before).any()
    page.mouse.wheel(0, -600)
    zoomed = settled(page)
    assert zoomed.any(-1).sum() > 1.5 * turned.any(-1).sum()
    page.click("#home")
    assert (settled(page) == before).all()
    page.focus("#picture")
    page.keyboard.press("ArrowRight")
    assert (settled(page) != before).any()


def test_every_layer_can_be_seen(page: Any) -> None:
    seen = []
    for layer in ("rgb", "albedo", "illumination", "normal", "mesh"):
        page.check(f"input[name=layer][value={layer}]")
        seen.append(settled(page).tobytes())
    assert len(set(seen)) == 5


def test_paint_stays_where_it_is_put(page: Any) -> None:
    page.check("input[name=layer][value=albedo]")
    before = settled(page)
    rows, columns = before.any(-1).nonzero()
    row, column = rows[len(rows) // 2], columns[len(rows) // 2]
    box = page.locator("#picture").bounding_box()
    page.check("#painting")
    move(page, "#radius", 20)
    at = {"x": (column + 0.5) / 64 * box["width"], "y": (row + 0.5) / 64 * box["height"]}
    with page.expect_response("**/pick") as answer:
        page.click("#picture", position=at)
    assert answer.value.json()["anchor"] is not None
    page.wait_for_function("() => scene.touches.strokes.length == 1")
    painted = settled(page)
    there = (painted.astype(int) - before)[row, column]
    assert there[2] > 0 or there[0] < 0
    page.click("#undo")
    assert (settled(page) == before).all()


def test_a_picture_is_painted_and_taken_back(page: Any, server: ViewServer, tmp_path: Path) -> None:
    page.check("input[name=layer][value=albedo]")
    before = settled(page)
    pixels = np.zeros((32, 32, 4), dtype=np.uint8)
    pixels[...] = (0, 90, 255, 255)
    Image.fromarray(pixels).save(tmp_path / "blue.png")
    page.set_input_files("#paint-picture", tmp_path / "blue.png")
    page.wait_for_function("() => scene.touches.strokes.length == 1")
    painted = settled(page)
    inside = before.min(-1) > 40
    assert np.abs(painted[inside].mean(0) - (0, 90, 255)).max() < 25
    assert "blue.png" in page.inner_text("#saved")
    with page.expect_response("**/avatar") as answer:
        page.click("#save-avatar")
    paint = HandAvatar.load(Path(json.loads(answer.value.body())["path"])).edit.paint
    assert paint is not None and float(paint.opacity.min()) == 1
    page.click("#undo")
    assert (settled(page) == before).all()


def test_what_is_no_picture_is_said_on_the_page(
    browser: Any, server: ViewServer, tmp_path: Path
) -> None:
    with visit(browser) as context:
        page = context.new_page()
        page.goto(server.address)
        page.wait_for_selector("canvas[data-stage]")
        (tmp_path / "text.png").write_text("no picture")
        page.set_input_files("#paint-picture", tmp_path / "text.png")
        page.wait_for_selector("#problem:not([hidden])")
        assert "not a PNG" in page.inner_text("#problem")
        (tmp_path / "large.png").write_bytes(bytes(4 * 2**20 + 1))
        page.set_input_files("#paint-picture", tmp_path / "large.png")
        page.wait_for_function("() => problem.textContent.includes('at most 4194304')")
        assert page.evaluate("scene.touches.strokes.length") == 0


def test_a_motion_plays_and_stands_where_it_is_put(page: Any) -> None:
    settled(page)
    page.select_option("#motion", "wave")
    first = settled(page)
    page.wait_for_function("() => document.querySelector('#step').max == 4")
    move(page, "#step", 4)
    assert (settled(page) != first).any()
    drawn = int(page.get_attribute("#picture", "data-pictures"))
    page.click("#play")
    page.wait_for_function(f"() => picture.dataset.pictures > {drawn + 6}")
    assert page.inner_text("#play") == "pause"
    page.click("#play")
    settled(page)


def test_what_is_saved_is_what_is_seen(page: Any, server: ViewServer) -> None:
    move(page, "#light", 1.4)
    seen = settled(page)
    with page.expect_download() as download:
        page.click("#save-picture")
    assert download.value.suggested_filename == "hand-rgb.png"
    saved = np.asarray(Image.open(download.value.path()))
    assert (saved == seen).all()

    with page.expect_response("**/avatar") as answer:
        page.click("#save-avatar")
    path = Path(json.loads(answer.value.body())["path"])
    assert HandAvatar.load(path).edit.light_gain == 1.4
    page.wait_for_function("path => saved.textContent.includes(path)", arg=path.name)

    page.select_option("#motion", "wave")
    settled(page)
    with page.expect_download() as download:
        page.click("#save-film")
    assert download.value.suggested_filename == "wave-rgb.mp4"
    with av.open(io.BytesIO(Path(download.value.path()).read_bytes())) as film:
        assert sum(1 for _ in film.decode(video=0)) == 5
    page.wait_for_selector("#stop-film", state="hidden")


def test_two_tabs_see_their_own_and_closing_one_leaves_the_other(
    page: Any, browser: Any, server: ViewServer
) -> None:
    before = settled(page)
    with visit(browser) as context:
        other = context.new_page()
        other.goto(server.address)
        other.select_option("#size", "512")
        other.wait_for_function("() => picture.width == 512")
    # It was closed in the middle of its picture in full.
    move(page, "#light", 0.5)
    darker = settled(page)
    assert darker.sum() < before.sum()


def test_a_page_says_that_the_server_is_gone(
    browser: Any, small_avatar: HandAvatar, tmp_path: Path
) -> None:
    with visit(browser) as context:
        page = context.new_page()
        with live_server(small_avatar, tmp_path) as server:
            page.goto(server.address)
            page.wait_for_selector("canvas[data-stage]")
        move(page, "#light", 0.5)
        page.wait_for_selector("#problem:not([hidden])")
        assert "does not answer" in page.inner_text("#problem")


def test_a_hand_that_is_not_there_yet_can_be_dragged(browser: Any, server: ViewServer) -> None:
    with visit(browser) as context:
        page = watched(context.new_page(), lambda url: url.startswith(own_addresses(server)))
        with late(page, "**/about"):
            page.goto(server.address)
            page.hover("#picture")
            page.mouse.down()
            page.mouse.move(20, 30)
            page.mouse.wheel(0, 100)
            page.mouse.up()
            page.press("#picture", "ArrowLeft")
        page.wait_for_selector("canvas[data-stage]")
        assert page.strays == []


def test_pages_of_other_origins_cannot_ask(browser: Any, server: ViewServer) -> None:
    before = set(server.out.glob("*"))  # Other tests save here, too.
    with visit(browser) as context:
        page = context.new_page()
        page.goto("about:blank")
        for path, options in (
            ("about", "{}"),
            ("avatar", "{method: 'POST', body: '{}', mode: 'no-cors'}"),
        ):
            tried = page.evaluate(
                f"fetch('{server.address}{path}', {options}).then(a => a.type, () => 'failed')"
            )
            assert tried in ("failed", "opaque")
    assert set(server.out.glob("*")) == before
