"""The page in a real browser: plan, start, watch, stop by Escape, a service that is killed; the
responses and the diagnosis of a run that goes on; accessible to axe in dark and light.

Skips where no Chromium is installed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_kit import Browser, violations
from index_kit import write_small
from serve_kit import Service, sweep

from samii_rig.record.reader import read_recording

# Some of the scope's pixels are of a channel's colour: a curve is drawn.
DRAWN = """
(() => { const c = document.getElementById('scope'), g = c.getContext('2d');
  const d = g.getImageData(100, 0, c.width - 120, c.height - 30).data; let n = 0;
  for (let i = 0; i < d.length; i += 4)
    if (d[i + 3] > 200 && Math.max(d[i], d[i+1], d[i+2]) - Math.min(d[i], d[i+1], d[i+2]) > 90) n++;
  return n > 500; })()
"""

# Where it says what is now.
AT_ZERO = "document.getElementById('now').textContent.includes('The output is at zero.')"


# What came of *Plan* is seen without scrolling, where it was pressed.
IN_VIEW = """
(() => { const r = document.getElementById('planned').getBoundingClientRect();
  return r.height > 0 && r.top >= 0 && r.bottom <= innerHeight; })()
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def test_an_afternoon_at_the_page(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    # Markup in what people write stays text.
    write_small(tmp_path / "runs" / "old.mcap", operator="<img src=x onerror=alert(1)>")
    with Service(tmp_path / "runs", "--pace", "2") as service:
        browser.go(service.url)
        browser.until("document.getElementById('link').textContent === 'live'")
        assert browser.text("rig-name") == "SAMII"
        browser.until("document.getElementById('kind').textContent !== ''")
        assert browser.text("kind") == "simulated rig, 2 × real time"
        assert browser.text("now") == "No run. One is started under Drive."
        browser.until("document.querySelectorAll('#drawing svg text').length > 10")
        browser.until("document.querySelectorAll('#list tr').length === 1")
        assert browser.value("document.querySelectorAll('#list img').length") == 0
        assert browser.value("document.getElementById('start').disabled")

        browser.choose("experiment", "step")
        assert "[0.2]" in browser.value("document.getElementById('text').value")
        # An order of its own: what is wrong with it is said, what is right is run.
        type_into(browser, "text", "'[0.2]', '[9.0]'")
        browser.click("plan")
        browser.until("document.getElementById('planned').textContent.includes('Refused')")
        browser.size(1440, 900)
        browser.until(IN_VIEW)
        browser.call("Emulation.clearDeviceMetricsOverride")
        type_into(browser, "text", "'[9.0]', '[0.1]'")
        assert not browser.value("document.getElementById('changed').hidden")
        browser.click("plan")
        browser.until("document.getElementById('planned').textContent.includes('nearest to a')")
        browser.choose("operator", "")
        browser.click("take")
        # What is missing is said by its field, and is no alarm.
        browser.until("!document.getElementById('name-hint').hidden")
        assert browser.value("document.getElementById('alarm').hidden")
        assert browser.value("document.activeElement.id") == "operator"
        browser.choose("operator", "Ada")
        assert browser.value("document.getElementById('name-hint').hidden")
        browser.click("take")
        browser.until("document.getElementById('driver').textContent.startsWith('Ada drives')")
        assert browser.text("start") == "Start"
        browser.click("start")
        browser.until("document.getElementById('now').textContent.includes('segment 1 of 2')")
        browser.until("document.getElementById('facts').textContent.includes('Run left')")
        browser.until(DRAWN)

        # The service dies: nothing on the page looks live, and the run goes on.
        service.kill()
        browser.until("document.getElementById('link').textContent.includes('connection lost')")
        assert "Unknown" in browser.text("now")
        assert browser.text("facts") == ""
        service.begin()
        browser.until("document.getElementById('link').textContent === 'live'")
        browser.until("document.getElementById('now').textContent.includes('segment')")
        # Nobody watches over the run until somebody takes control again.
        browser.until("!document.getElementById('unwatched').hidden")
        assert "The service was started anew at" in browser.text("unwatched-text")
        assert "no operator's page watches over this run" in browser.text("unwatched-text")
        browser.click("take-here")
        browser.until("document.getElementById('driver').textContent.startsWith('Ada drives')")
        browser.until("document.getElementById('unwatched').hidden")
        assert browser.text("start") == "Queue"

        browser.press("Escape")
        browser.until(AT_ZERO)
        assert browser.text("now").startswith("step: stopped by Ada at 127.0.0.1, ")
        browser.until("document.querySelectorAll('#list tr').length === 2")
        (path,) = (tmp_path / "runs").glob("*_step.mcap")
        recording = read_recording(path)
        assert recording.stop.reason == "stop asked by Ada at 127.0.0.1"
        assert recording.values[-1, recording.column("v_2")] == 0.0
        assert "[0.1]" in recording.experiment_toml
        browser.until("document.getElementById('scope-state').textContent.includes('is over')")
        browser.until("document.getElementById('motion').ariaLabel.includes('no run')")
        # Where it says what is now: the recording and its report.
        browser.until("!document.getElementById('kept').hidden")
        assert browser.text("kept-name") == path.name
        report = service.http.get(browser.value("document.getElementById('kept-report').href"))
        assert report.status_code == 200
        assert path.name in report.text

        browser.value("document.querySelector('#list button').click()")
        browser.until("document.getElementById('one-about').textContent.includes('stopped')")
        browser.until("document.getElementById('one-notes').textContent.includes('stop asked by')")
        page = service.http.get(browser.value("document.getElementById('report').href"))
        assert page.status_code == 200
        assert path.name in page.text
    assert browser.errors == []


def type_into(browser: Browser, id_: str, replaced: str) -> None:
    """Change a text as a person does. replaced : what by what, as JavaScript."""
    browser.value(
        f"(e => {{ e.value = e.value.replace({replaced}); e.dispatchEvent(new Event('input')); }})"
        f"(document.getElementById('{id_}'))"
    )


@pytest.mark.slow  # minutes on a loaded machine, of diagnoses while a run goes on
def test_a_run_tells_what_it_knows_while_it_goes_on(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    write_small(tmp_path / "runs" / "old.mcap", operator="Ada")
    with Service(tmp_path / "runs", "--pace", "4") as service:
        browser.go(service.url)
        browser.until("document.getElementById('link').textContent === 'live'")
        for scheme in ("dark", "light"):
            browser.colours(scheme)
            assert violations(browser) == []
        with service.lease() as lease:
            service.start(lease, sweep(duration=8.0, repeats=150), diagnosis=True)
            # Nothing is measured: all is hatched, and says so.
            browser.until("document.getElementById('frf-about').textContent.includes('0 of 150')")
            browser.until("/[1-9] repeats/.test(document.getElementById('frf-about').textContent)")
            assert "of 150 segments whole" in browser.text("frf-about")
            # A diagnosis comes after everything else of the machine; the run is long enough for it.
            old = "document.getElementById('diagnosis-age').textContent.includes(' old')"
            browser.until(old, within=280.0)
            # Before there are repeats there is no answer, and no chance of one.
            nothing = "textContent.includes('Chance that nothing is missing')"
            browser.until(f"document.getElementById('diagnosis-facts').{nothing}")
            browser.until("document.getElementById('motion').ariaLabel.includes('times as large')")
            # Everything that can be opened is open.
            browser.choose("trigger", "single")
            browser.click("cursors")
            browser.value("document.getElementById('change').open = true")
            browser.until("document.getElementById('cursor-read').textContent.includes('Δt')")
            browser.value("document.querySelector('#list button').click()")
            browser.until("document.getElementById('one-about').textContent.includes('download')")
            for scheme in ("dark", "light"):
                browser.colours(scheme)
                assert violations(browser) == []
            browser.press("Escape")
            browser.until(AT_ZERO)
        # What was measured until then stays, as of a run that is over.
        browser.until("document.getElementById('frf-about').textContent.startsWith('Last run')")
        assert "goes on" not in browser.text("frf-about")
        browser.until("document.getElementById('frf-about').textContent.includes('all that was')")
        assert re.search(r"recorded: \d+ of 150 segments whole", browser.text("frf-about"))
        assert browser.value("document.getElementById('frf-hatched').hidden")
        service.kill()
        browser.until("document.getElementById('motion').ariaLabel.includes('not live')")
    assert browser.errors == []
