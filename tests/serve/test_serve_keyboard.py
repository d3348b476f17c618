"""A run and a recording without a mouse, and the page to axe in all that it is looked at on.

Skips where no Chromium is installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_kit import Browser, violations
from serve_kit import Service

FOCUS = "document.activeElement"
LONG = 300.0  # s for what loads and predicts
MOST = 12  # presses of Tab to whatever is needed, from where the one before was
# What has the focus is seen to have it: an outline, and inside the window.
SEEN = f"""
(() => {{ const e = {FOCUS}, s = getComputedStyle(e), b = e.getBoundingClientRect();
  const header = document.querySelector('header');
  return s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) >= 2
    && b.bottom > 0 && b.top < innerHeight
    && (header.contains(e) || b.bottom > header.offsetHeight); }})()
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def tab_to(browser: Browser, selector: str, most: int = MOST) -> None:
    """By Tab alone, and each stop on the way is seen."""
    passed = []
    for _ in range(most):
        browser.press("Tab")
        assert browser.value(SEEN), browser.value(f"{FOCUS}.outerHTML.slice(0, 200)")
        passed.append(browser.value(f"{FOCUS}.id || {FOCUS}.textContent.slice(0, 20)"))
        if browser.value(f"{FOCUS}.matches({selector!r})"):
            return
    raise AssertionError(f"no {selector} after {passed}")


def test_a_run_and_a_recording_without_a_mouse(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    with Service(tmp_path / "runs", "--pace", "2") as service:
        browser.size(1440, 900)
        browser.go(service.url)
        browser.until("document.getElementById('link')?.textContent === 'live'")
        browser.until("document.querySelectorAll('#fields input').length > 3")

        tab_to(browser, "#to-drive", 1)
        browser.press("Enter")
        tab_to(browser, "#take")
        browser.press("Enter")  # without a name it asks for one, and goes there
        browser.until(f"{FOCUS}.id === 'operator'")
        browser.call("Input.insertText", text="Ada")
        tab_to(browser, "#take", 1)
        browser.press("Enter")
        browser.until("document.getElementById('driver').textContent.startsWith('Ada drives')")
        tab_to(browser, "#experiment")
        # The next that begins with the letter each time, however long it takes between two presses.
        for _ in range(MOST):
            if browser.value(f"{FOCUS}.value") == "step":
                break
            browser.press("s")
        assert browser.value(f"{FOCUS}.value") == "step"
        tab_to(browser, "#start")
        browser.press("Enter")
        browser.until("/segment . of 2/.test(document.getElementById('now').textContent)", LONG)
        browser.press("Escape")
        browser.until("document.getElementById('now').textContent.includes('at zero')", LONG)

        browser.until("document.querySelectorAll('#list tr').length === 1")
        browser.until("document.querySelector('#list').textContent.includes('stopped')")
        # Anew, without the place in its address to which a link led: Tab begins at the top.
        browser.go("about:blank")
        browser.go(service.url)
        browser.until("document.querySelectorAll('#list tr').length === 1")
        browser.until("document.querySelectorAll('#fields input').length > 3")
        tab_to(browser, "#to-list", 2)
        browser.press("Enter")
        tab_to(browser, "#list button")
        browser.press("Enter")
        browser.until("document.getElementById('one-about').textContent.includes('stopped')")
        browser.until(f"{FOCUS}.id === 'h-one'")  # the next Tab goes on from what was opened
        browser.until("!document.getElementById('replay').disabled")
        tab_to(browser, "#replay")
        browser.press("Enter")
        browser.until("!document.getElementById('replay-mark').hidden")
        axe_everywhere(browser)
    assert browser.errors == []


def axe_everywhere(browser: Browser) -> None:
    """With a recording open and replayed: all that the page has is on it."""
    for width, height in ((1440, 900), (1920, 1080), (390, 844)):
        browser.size(width, height)
        for scheme in ("light", "dark"):
            for medium in ("", "print"):
                browser.colours(scheme, medium)
                assert violations(browser) == [], (width, scheme, medium)
    browser.colours("light")
