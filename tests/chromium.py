"""Headless Chromium for tests of pages; where it is missing they are skipped with the reason."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

PROGRAM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)


@contextmanager
def page(width: int = 1280, height: int = 800, **options: Any) -> Iterator[Any]:
    """A page in a window of that size; leaving it fails the test where the page reported an error."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not PROGRAM:
        pytest.skip("no Chromium is installed")
    errors: list[str] = []
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=PROGRAM, args=["--no-sandbox"])
        window = browser.new_page(viewport={"width": width, "height": height}, **options)
        window.on("console", lambda told: errors.append(told.text) if told.type == "error" else None)
        window.on("pageerror", lambda problem: errors.append(str(problem)))
        try:
            yield window
        finally:
            browser.close()
    assert not errors, errors
