"""Pages in a real browser, Debian's Chromium without a window: nothing is cut off, nothing is loaded, nothing fails."""

import os
import shutil

import pytest

from sb3_combrel import explain
from sb3_combrel.experiments.dashboard import BROWSERS

CHROMIUM = next(filter(None, map(shutil.which, BROWSERS)), None)
WIDTHS = (400, 1400)


@pytest.fixture(scope="module")
def browser():
    """A browser; the tests are skipped where there is none, but in CI, where that would hide a page that is broken."""
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        sync_playwright = None
    if sync_playwright is None or CHROMIUM is None:
        missing = "playwright (pip install playwright)" if sync_playwright is None else "Chromium (apt-get install chromium)"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"a real browser needs {missing}")
    with sync_playwright() as playwright:
        # Chromium's sandbox does not work for root, as in a container.
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module", params=["prior", "none", "comparison"])
def page_file(request, models, comparison, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    if request.param == "comparison":
        return comparison.save(folder / "report.html")
    explain(models[request.param], folder)
    return folder / "report.html"


@pytest.mark.parametrize("width", WIDTHS)
def test_a_page_is_complete_and_legible_at_any_width(width, browser, page_file, tmp_path):
    page = browser.new_page(viewport={"width": width, "height": 900})
    asked, failed = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: failed.append(message.text))
    page.on("pageerror", lambda error: failed.append(str(error)))
    page.goto(page_file.as_uri())
    assert not failed and all(url.startswith(("file:", "data:")) for url in asked)
    # Nothing sticks out to the side.
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    images = page.evaluate(
        "[...document.images].map(i => [i.complete, i.naturalWidth, i.clientWidth, i.currentSrc.length, i.alt])"
    )
    assert images and all(done and natural > 0 and source > 1000 and words for done, natural, _, source, words in images)
    # Text of the pictures, of 9 points, is neither tiny nor huge.
    assert all(0.8 < shown / natural < 1.6 for _, natural, shown, _, _ in images)
    sizes = page.evaluate("[...document.querySelectorAll('td, p, li')].map(e => parseFloat(getComputedStyle(e).fontSize))")
    assert min(sizes) >= 12
    file = tmp_path / "screenshot.png"
    page.screenshot(path=file, full_page=True)
    assert file.stat().st_size > 20_000
    page.close()


def test_a_telephone_is_shown_the_narrow_pictures(browser, page_file):
    sources = []
    for width in WIDTHS:
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.goto(page_file.as_uri())
        sources.append(page.evaluate("[...document.images].map(i => i.currentSrc)"))
        page.close()
    assert all(narrow != wide for narrow, wide in zip(*sources, strict=True))
