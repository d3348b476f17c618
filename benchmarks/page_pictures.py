"""The pictures of the page in docs/images, made anew: service.png and service-so-far.png.

    python benchmarks/page_pictures.py [--into docs/images]

A simulated run of the shipped swept sine, 20 times as fast, seen by Chromium: during its first
minute, and once a diagnosis of what is known so far stands on the page.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from browser_kit import Browser
from serve_kit import Service

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
LONG = 900.0  # s to wait: a diagnosis takes a minute of a processor, which others may use too


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=IMAGES)
    into = parser.parse_args().into
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["SAMII_RIG_STATE"] = str(folder / "state")
        with (
            Service(folder / "runs", "--pace", "20") as service,
            Browser(folder / "browser") as browser,
        ):
            browser.size(1440, 900)
            browser.go(service.url)
            browser.until("document.getElementById('link')?.textContent === 'live'", LONG)
            browser.until("document.querySelectorAll('#fields input').length > 3", LONG)
            browser.until("document.querySelectorAll('#drawing svg').length === 1", LONG)
            browser.choose("operator", "Ada")
            browser.click("take")
            browser.until("document.getElementById('driver').textContent.startsWith('Ada')", LONG)
            browser.click("start")
            browser.until("/^[1-9]/.test(document.getElementById('averages').textContent)", LONG)
            browser.picture(into / "service.png")
            browser.until(
                "document.getElementById('diagnosis-age').textContent.includes(' old')", LONG
            )
            browser.picture(into / "service-so-far.png")
            browser.press("Escape")
            browser.until(
                "document.getElementById('now').textContent.includes('output is at zero')", LONG
            )
    for made in ("service.png", "service-so-far.png"):
        print(into / made)


if __name__ == "__main__":
    main()
