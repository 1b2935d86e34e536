"""Chromium for the tests of pages; a module that imports this is skipped where there is none."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from patience import PATIENCE

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or ""
MARKS = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM, reason="needs chromium: apt-get install chromium"),
]
"""Of every test of a page."""
_ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def launched(*arguments: str) -> Iterator[Any]:
    """The browser, as long as the block lasts; the fixture ``browser`` is one for a module.

    Args:
        arguments: of its command line, besides those that all tests need.
    """
    with playwright.sync_playwright() as manager:
        running = manager.chromium.launch(executable_path=CHROMIUM, args=[*_ARGUMENTS, *arguments])
        yield running
        running.close()


@contextmanager
def visit(browser: Any, **options: Any) -> Iterator[Any]:
    """Somebody of an own context, with the context's options; opens pages, and has patience."""
    context = browser.new_context(**options)
    context.set_default_timeout(1000 * PATIENCE)
    try:
        yield context
    finally:
        context.close()


@contextmanager
def late(page: Any, pattern: str) -> Iterator[None]:
    """What the page asks for within the block is answered after it, if its address matches."""
    held: list[Any] | None = []
    page.route(pattern, lambda route: route.continue_() if held is None else held.append(route))
    yield
    ready, held = held, None
    for route in ready:
        route.continue_()


def watched(page: Any, is_expected: Callable[[str], bool]) -> Any:
    """The page, with a list ``strays`` of what goes wrong or is asked for unexpectedly.

    Args:
        page: that has not gone anywhere yet.
        is_expected: of an address, whether the page may ask for it.
    """
    page.strays = []
    page.on(
        "console",
        lambda message: page.strays.append(message.text) if message.type == "error" else None,
    )
    page.on("pageerror", lambda error: page.strays.append(str(error)))
    page.on(
        "request",
        lambda request: None if is_expected(request.url) else page.strays.append(request.url),
    )
    return page
