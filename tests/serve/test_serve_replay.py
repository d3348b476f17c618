"""Recordings through the page's scope, in a real browser: every sample, at any speed, never as if
it were live. Skips where no Chromium is installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_kit import Browser, violations
from record_kit import block, write_run
from replay_kit import opened, replayed
from serve_kit import Service, sweep

from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.record.reader import read_recording
from samii_rig.record.store import write_recording

GAPPED = "gapped.mcap"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened_:
        yield opened_


@pytest.fixture(scope="module")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    runs = tmp_path_factory.mktemp("runs")
    # 36 s with 40 samples lost in the midst.
    write_run(
        runs / GAPPED, [block(n, 500) for n in (*range(0, 9000, 500), *range(9040, 18040, 500))]
    )
    with Service(runs, "--pace", "4") as started:
        yield started


@pytest.fixture
def service(serving: Service, browser: Browser) -> Iterator[Service]:
    """With the one recording, and a page that was just opened."""
    serving.until(lambda: serving.state()["running"] is None)
    for path in serving.folder.glob("*.mcap"):
        if path.name != GAPPED:
            path.unlink()
    listed = [GAPPED]
    serving.until(lambda: [e["path"] for e in recorded(serving)] == listed)
    browser.go(serving.url)
    browser.until("document.getElementById('link').textContent === 'live'")
    yield serving
    assert browser.errors == []


def recorded(service: Service) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = service.http.get("/api/recordings").json()["recordings"]
    return found


def test_every_sample_is_shown_and_a_gap_is_one(service: Service, browser: Browser) -> None:
    opened(browser, GAPPED)
    assert replayed(browser, service.folder / GAPPED) == 18_000
    assert browser.value("scope.samples.gaps") == [9040]
    # Nothing runs and no state comes: what is shown is the replay, not a run that is over.
    assert browser.value("[scope.over, motion.over]") == [False, False]
    assert browser.value("scope.samples.value(0, 9039) === scope.samples.value(0, 9039)") is False

    # Another speed, from another place: a person's time passes.
    browser.choose("replay-speed", "10")
    browser.choose("replay-place", "250")
    browser.until("scope.samples.end > 6000")
    assert 4500 <= browser.value("scope.samples.begin") < 4600
    browser.click("replay-pause")
    browser.until("document.getElementById('replay-state').textContent.includes('held')")
    held = browser.value("scope.samples.end")
    assert held < 18_040
    assert browser.value(
        f"new Promise((done) => setTimeout(() => done(scope.samples.end === {held}), 300))"
    )

    browser.click("replay-end")
    assert browser.value("document.getElementById('replay-row').hidden")
    assert browser.value("[scope.over, motion.over]") == [True, True]
    browser.until("scope.why === 'No run'")


def test_a_rig_with_two_outputs_shows_the_responses_to_both(tmp_path: Path) -> None:
    """Live, after the run, and replayed."""
    text = sweep(duration=12.0, repeats=1).replace('"v_2"', '"v_2"\nbeside = ["v_3"]')
    options = "--rig", "samii_two_joints", "--pace", "8"
    with Service(tmp_path / "runs", *options) as service, Browser(tmp_path / "browser") as browser:
        browser.size(1440, 900)
        browser.go(service.url)
        browser.until("document.getElementById('link').textContent === 'live'")
        with service.lease() as lease:
            job = service.start(lease, text)
            browser.until("['v_2', 'v_3'].every((n) => scope.channels.some((c) => c.name === n))")
            names = ["v_2", "v_3", "theta_2", "theta_3", "a_0", "a_1", "a_2"]
            lamps = "[...document.querySelectorAll('.lamp b')].map((b) => b.textContent)"
            browser.until(f"{lamps}.length === {len(names)}")
            assert browser.value(lamps) == names
            service.until(lambda: service.job(job)["phase"] == "done")
        assert service.job(job)["at_zero"]
        pairs = [f"{y} / {v}" for y in names[2:] for v in names[:2]]
        browser.until("panel.live?.final && panel.live.responses.length === 1")
        assert browser.value("panel.entries().map((e) => e.title)") == pairs
        drawn = "panel.entries().map((e) => panel.curves(e.output, e.input).map((c) => c.name))"
        assert browser.value(drawn) == [["model", "measured"]] * len(pairs)
        name = service.job(job)["recording"]
        opened(browser, name)
        path = service.folder / name
        assert replayed(browser, path) == len(read_recording(path))
        assert browser.value("scope.channels.map((c) => c.name)") == [
            c.name for c in read_recording(path).channels
        ]
        assert browser.errors == []


def test_a_run_that_begins_ends_a_replay(service: Service, browser: Browser) -> None:
    opened(browser, GAPPED)
    browser.choose("replay-speed", "0.1")
    browser.click("replay")
    with service.lease() as lease:
        service.start(lease, sweep(duration=60.0))
        browser.until("document.getElementById('replay-row').hidden")
        browser.until("scope.channels.some((c) => c.name === 'theta_2') && !scope.empty")
        # While it goes on, an old one can be looked at; the stop is as near as ever.
        browser.click("replay")
        browser.until("scope.channels.every((c) => c.name !== 'theta_2') && !scope.empty")
        assert browser.text("now").startswith("short: ")
        # Nobody takes it for what is now, wherever they look.
        assert browser.value("document.body.classList.contains('replaying')")
        assert violations(browser) == []
        assert browser.text("replay-name") == f"REPLAY of {GAPPED}: not live."
        browser.click("replay-end")
        browser.until("!scope.empty && scope.live")
        browser.press("Escape")
        browser.until("document.getElementById('now').textContent.includes('output is at zero')")
        browser.until("document.getElementById('scope-state').textContent.includes('is over')")
        # What was said of the run is not said of the recording that is shown after it.
        browser.click("replay")
        browser.until("!scope.empty && scope.recorded")
        browser.until("document.getElementById('scope-state').textContent === ''")
        browser.click("replay-end")
        assert not browser.value("document.body.classList.contains('replaying')")


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("2009-07-07_full-robot_swept_sine_amp-50_test_1.txt", "sflr"),
        ("2009-08-03_motor-only_ol_step_response_amp-50_test_1.txt", "sflr_motor_open"),
    ],
)
def test_a_real_recording_is_replayed(
    service: Service, browser: Browser, recordings: Path, name: str, layout: str
) -> None:
    """All of them: `python benchmarks/replay_page.py`."""
    path = service.folder / f"{Path(name).stem}.mcap"
    the_map, text = load_map(layout)
    write_recording(path, import_file(recordings / name, the_map, text))
    browser.until(
        "(document.querySelector('#search button').click(), "
        "document.querySelectorAll('#list tr').length === 2)"
    )
    opened(browser, path.name)
    assert replayed(browser, path) == len(read_recording(path)) >= 500
    # The rig that is drawn is another one: it does not move with it.
    assert browser.value("motion.y.length") == 0
