"""What a rig file leaves out is named on the page while the run goes on, and what would settle it
is one click away.

The rig that moves is not the rig file's: behind the service is a simulated SAMII whose joint 3
gives, which the file calls rigid. Skips where no Chromium is installed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_kit import Browser
from device_kit import CONCEALED, installed
from serve_kit import Service, sweep

from samii_rig.rig.load import load_rig

pytestmark = pytest.mark.slow
LEVEL = "[0.2]"
ANALYSED = 400.0  # s: a cause takes ten seconds of a processor that other tests load
# Each request of the page shows its lease, with which the test may ask too.
LISTEN = """
(() => { const asked = window.fetch;
  window.fetch = (to, how) => { window.lease = how?.headers?.['X-Lease'] ?? window.lease;
    return asked(to, how); }; })()
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A rig of whose joint 3 the file knows nothing, four times as fast as it is."""
    toml = load_rig("samii")[1]
    tables = re.split(r"(?m)^(?=\[\[)", toml[: toml.index("[device]")])
    known = [t for t in tables if 'name = "joint_3"' not in t]
    assert len(known) == len(tables) - 1
    file = tmp_path / "rigid.toml"
    settings = 'truth = "samii"\npace = 4\nseed = 1\n'
    file.write_text(
        f'{"".join(known)}[device]\ndriver = "concealed"\n\n[device.settings]\n{settings}'
    )
    monkeypatch.setenv("PYTHONPATH", installed(tmp_path / "package", "concealed", CONCEALED))
    with Service(tmp_path / "runs", "--rig", str(file)) as started:
        yield started


def test_the_cause_is_named_while_the_run_goes_on(service: Service, browser: Browser) -> None:
    browser.go(service.url)
    browser.until("document.getElementById('link').textContent === 'live'")
    with service.lease() as lease:
        text = sweep(duration=8.0, repeats=100).replace("[0.02]", LEVEL)
        service.start(lease, text, diagnosis=True)
        browser.until(
            "document.getElementById('diagnosis-what').textContent"
            ".startsWith('Left out: torsional compliance at link_2')",
            ANALYSED,
        )
        assert service.progressing()
        assert "of 100 segments" in browser.text("diagnosis-age")
        facts = browser.text("diagnosis-facts")
        assert "Chance that nothing is missingunder 0.1 %" in facts
        assert re.search(r"Chance of the answer(9\d|over 99)", facts)
        assert "Siteslink_2" in facts
        browser.press("Escape")
        browser.until("document.getElementById('now').textContent.includes('output is at zero')")
    assert browser.errors == []


def test_the_experiment_that_would_settle_it_is_one_click_away(
    service: Service, browser: Browser
) -> None:
    """From one sweep the noise is not known: the button asks for repeats, which the queue gets."""
    browser.go(service.url)
    browser.until("document.getElementById('link').textContent === 'live'")
    browser.value(LISTEN)
    browser.click("take")
    browser.until("Boolean(window.lease)")
    lease = {"x-lease": browser.value("lease")}
    one = sweep(duration=60.0, repeats=1).replace("[0.02]", LEVEL)
    first = service.start(lease, one, diagnosis=True)
    browser.until("!document.getElementById('next').hidden", ANALYSED)
    assert "repeat each run three times" in browser.text("next")
    browser.click("next")

    def asked_for() -> list[dict]:
        state = service.state()
        known = [state["running"], state["last"], *state["queue"]]
        return [j for j in known if j and j["experiment"] == "short_next"]

    (job,) = service.until(asked_for)
    assert job["id"] > first
    assert job["duration_s"] == pytest.approx(3 * service.job(first)["duration_s"], rel=0.1)
    assert job["diagnosis"]
    assert browser.value("document.getElementById('alarm').hidden")
    assert browser.errors == []
