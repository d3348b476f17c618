"""The pictures of the page and of the report in docs/images, made anew.

    python benchmarks/page_pictures.py [--into docs/images]

A simulated run of the shipped swept sine, twice as fast, seen by Chromium: while it goes on at
each width in light and dark (service-WIDTH-COLOURS.png; service.png is the one at 1440 in light),
once a diagnosis of what is known so far stands on the page (service-so-far.png), after a stop
(service-stopped.png), replayed (service-replay.png); and the report of a whole run (report.png).
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from browser_kit import Browser
from serve_kit import Service, sweep
from wait_kit import found

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
LONG = 900.0  # s to wait: a diagnosis takes a minute of a processor, which others may use too
SIZES = {390: 844, 1440: 900, 1920: 1080}  # px: a phone, a notebook, a screen on a bench
SMALL = 320, 240  # px while it is waited for, which costs little
SETTLES = "new Promise((done) => setTimeout(done, 700))"  # ms; the page draws at its own pace


def text(id_: str, test: str) -> str:
    return f"document.getElementById('{id_}')?.textContent{test}"


def warm(service: Service) -> None:
    """Have the service make what the page asks for before a browser takes the processor, which
    draws sixty pictures a second whether or not anybody looks."""
    asked = [("GET", "/api/rig", None), ("POST", "/api/dry-run", {"experiment": "swept_sine"})]
    for method, path, body in asked:
        service.http.request(method, path, json=body, timeout=LONG).raise_for_status()


def begun(browser: Browser, service: Service) -> None:
    browser.size(*SMALL)
    browser.go(service.url)
    browser.until(text("link", " === 'live'"), LONG)
    browser.until("document.querySelectorAll('#fields input').length > 3", LONG)
    browser.until("document.querySelectorAll('#drawing svg').length === 1", LONG)
    browser.choose("operator", "Ada")
    browser.click("take")
    browser.until(text("driver", ".startsWith('Ada')"), LONG)


def running(browser: Browser, into: Path) -> list[str]:
    browser.click("start")
    browser.until(f"/^[1-9]/.test({text('averages', '')})", LONG)
    # Something is measured: a response, and a curve of it.
    browser.until("window.panel.live?.responses.length > 0", LONG)
    made = []
    for width, height in SIZES.items():
        for colours in ("light", "dark"):
            browser.size(width, height)
            browser.colours(colours)
            browser.value(SETTLES)
            made.append(f"service-{width}-{colours}.png")
            browser.picture(into / made[-1])
    browser.size(*SMALL)
    browser.colours("light")
    shutil.copy(into / "service-1440-light.png", into / "service.png")
    # Of a run that is over on a busy machine, the last one.
    answer = text("diagnosis-what", "")
    browser.until(f"{answer}.length > 0 && !/^No(ne| answer)/.test({answer})", LONG)
    browser.size(1440, 900)
    browser.value(SETTLES)
    browser.picture(into / "service-so-far.png")
    browser.press("Escape")
    browser.until(text("now", ".includes('output is at zero')"), LONG)
    browser.until("!document.getElementById('kept').hidden", LONG)
    browser.value(SETTLES)
    browser.picture(into / "service-stopped.png")
    return ["service.png", *made, "service-so-far.png", "service-stopped.png"]


def recorded(browser: Browser, service: Service, into: Path) -> list[str]:
    """A whole run, replayed, and its report."""
    browser.size(*SMALL)
    # What is ordered before a stopped run is over waits for somebody's word.
    found(lambda: service.state()["running"] is None, LONG)
    with service.lease() as lease:
        id_ = service.start(lease, sweep(duration=12.0, repeats=3))
        found(lambda: (service.state()["last"] or {}).get("id") == id_, LONG)
    name = service.job(id_)["recording"]
    kept = service.http.get("/api/recordings").json()["recordings"]
    recording = next(e["id"] for e in kept if e["path"] == name)
    listed = "[...document.querySelectorAll('#list button')]"
    of_it = f"b => b.textContent === '{name}'"
    browser.until(f"{listed}.some({of_it})", LONG)
    browser.value(f"{listed}.find({of_it}).click()")
    browser.until("!document.getElementById('replay').disabled", LONG)
    browser.size(1440, 900)
    browser.click("replay")
    browser.choose("replay-place", "400")
    browser.until("!window.scope.empty", LONG)
    browser.value(SETTLES)
    browser.value(SETTLES)
    browser.value("scrollTo(0, 0)")
    browser.value(SETTLES)
    browser.picture(into / "service-replay.png")
    browser.size(1100, 1150)
    browser.go(f"{service.url}/api/recordings/{recording}/report")
    browser.until("document.querySelectorAll('.plot .main-svg').length > 3", LONG)
    browser.picture(into / "report.png")
    return ["service-replay.png", "report.png"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--into", type=Path, default=IMAGES)
    into = parser.parse_args().into
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["SAMII_RIG_STATE"] = str(folder / "state")
        with Service(folder / "runs", "--pace", "2") as service:
            warm(service)
            with Browser(folder / "browser") as browser:
                begun(browser, service)
                made = running(browser, into)
                browser.click("take")
                browser.until(text("take", " === 'Take control'"), LONG)
                made += recorded(browser, service, into)
    for one in made:
        print(into / one)


if __name__ == "__main__":
    main()
