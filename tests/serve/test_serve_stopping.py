"""The page's stop, in a real browser: it is believed when the run is seen to be at rest.

What answers is a service that a test makes up: a page's `fetch` is replaced, as a proxy would; and
what a page says of a run's end, by states that are made up. Skips where no Chromium is installed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from browser_kit import Browser, violations
from serve_kit import Service, sweep

# Of every call to the stop: `world.answers`, by turns, the last one for ever; `world.asked` counts.
FAKE = """
window.world = { answers: %s, asked: [], running: false };
window.real = window.real ?? window.fetch;
window.fetch = (url, more = {}) => {
  if (!String(url).includes('/api/stop')) return real(url, more);
  world.asked.push(more.method);
  const next = world.answers.length > 1 ? world.answers.shift() : world.answers[0];
  if (next === null) return Promise.reject(new TypeError('gone'));
  return Promise.resolve(new Response(typeof next === 'number' ? 'proxy' : JSON.stringify(next), { status: typeof next === 'number' ? next : 200 }));
};
undefined
"""  # noqa: E501
MADE = """
(async () => {
  const { Stop } = await import('/page/stop.js');
  sessionStorage.clear();
  window.tell = { said: '', alarm: '' };
  window.made = () => new Stop({ urls: () => ['/api/stop'], running: () => world.running,
    said: (t) => { tell.said = t; }, alarm: (t) => { tell.alarm = t; } });
  window.one = made();
})()
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("lab"), "--pace", "2") as started:
        yield started


@pytest.fixture
def page(browser: Browser, service: Service) -> Iterator[Browser]:
    browser.go(service.url)
    browser.until("document.getElementById('link').textContent === 'live'")
    yield browser
    assert browser.errors == []


@pytest.fixture(scope="module")
def shown(browser: Browser, service: Service) -> Browser:
    """A page that is told states, one after the other."""
    browser.go(service.url)
    browser.until("document.getElementById('link').textContent === 'live'")
    return browser


def pressed(page: Browser, answers: str) -> None:
    page.value(FAKE % answers)
    page.value(MADE)
    page.value("one.press()")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ("503", "answered with 503"),
        ("null", "no answer"),
        ("{}", "answered by something else"),
        ("{'stopped': true}", "answered by something else"),
    ],
)
def test_an_answer_that_does_not_tell_of_the_run_is_none(
    page: Browser, bad: str, said: str
) -> None:
    pressed(page, f"[{bad}]")
    page.until(f"tell.alarm.startsWith('THE STOP HAS NOT REACHED THE SERVICE ({said})')")
    assert page.value("tell.said") == "The stop has not reached the service."
    page.until("world.asked.length > 2 && world.asked.every((m) => m === 'POST')")
    # Once it is heard, the alarm is over.
    page.value("world.answers = [{ stopped: true, moving: false }]; undefined")
    page.until("tell.alarm === '' && tell.said === 'The stop is done: nothing moves.'")
    assert page.value("sessionStorage.length") == 0


def test_a_run_that_goes_on_is_told_again(page: Browser) -> None:
    pressed(page, "[{ moving: true }]")
    page.until("tell.said.includes('the run has not ended yet')")
    page.until("world.asked.filter((m) => m === 'POST').length > 1")
    assert "GET" in page.value("world.asked")
    page.until("tell.alarm.startsWith('THE STOP WAS RECEIVED, BUT THE RUN HAS NOT ENDED')")
    page.value("world.answers = [{ moving: false }]; world.running = true; undefined")
    page.until("world.asked.filter((m) => m === 'POST').length > 3")
    # An answer is held against what the page sees of the run.
    assert page.value("tell.said").startswith("The stop was received")
    page.value("world.running = false; undefined")
    page.until("tell.alarm === '' && tell.said === 'The stop is done: nothing moves.'")


def test_a_page_that_slept_offers_the_stop_and_one_that_was_loaded_anew_goes_on(
    page: Browser,
) -> None:
    pressed(page, "[503]")
    page.until("tell.alarm.includes('503')")
    page.value("one.end = one.round = () => {}; window.one = made(); undefined")
    page.until("tell.alarm.includes('(answered with 503)')")
    page.value(
        "one.last -= 60000; one.keep(); clearTimeout(one.timer); world.asked = []; undefined"
    )
    page.value("window.one = made(); undefined")
    page.until("tell.alarm.includes('did not reach the service, as far as this page knows')")
    assert page.value("world.asked.length") == 0
    page.value("world.answers = [{ moving: false }]; one.press(); undefined")
    page.until("tell.said === 'The stop is done: nothing moves.'")
    page.value("world.answers = [503]; one.press(); undefined")
    page.until("tell.alarm.includes('503')")
    page.value("one.drop()")
    assert page.value("tell.alarm + tell.said + sessionStorage.length") == "0"


RUN = {"id": "1", "experiment": "short", "progress": {}, "time": "2026-11-01T10:00:00+00:00"}
LAST: dict[str, Any] = {**RUN, "verdict": "", "error": "", "early": "", "at_zero": True}


def shows(page: Browser, id_: str, **changes: Any) -> str:
    """What the page says there in a state; at once, as the service goes on to tell of its own."""
    state = {"rig": "SAMII", "started": "2026-11-01", "channels": [], "queue": [], "held": ""}
    state |= {"operator": "", "viewers": 1, "pace": 1, "time_left_s": 0, "fault": None}
    state |= {"running": None, "last": None, "so_far": None, "stop_port": 0, **changes}
    found = f"document.getElementById('{id_}').textContent"
    return str(page.value(f"show({json.dumps(state)}); {found}"))


@pytest.mark.parametrize(
    ("last", "said"),
    [
        ({"status": "stopped", "reason": "stop asked by Ada at 10.0.0.7"}, "stopped by Ada at 10."),
        ({"status": "completed", "reason": "done"}, "completed, "),
        ({"status": "tripped", "reason": "a_2 is 41"}, "stopped by a limit, "),
        ({"status": "tripped", "reason": "a_2 is 41"}, ": a_2 is 41. The output is at zero."),
        ({"status": "failed", "reason": "x", "at_zero": False}, "NOT SEEN AT ZERO"),
        ({"phase": "refused", "status": "", "error": "no rig"}, "did not start"),
        ({"phase": "refused", "status": "", "error": "no rig"}, "Nothing moved."),
        ({"phase": "refused", "status": "failed", "error": "disk full"}, "FAILED, "),
        ({"phase": "refused", "status": "failed", "error": "disk full"}, ": disk full. The output"),
        (
            {"phase": "died", "status": "failed", "reason": "its process ended", "at_zero": None},
            "deadman drops",
        ),
        (
            {"phase": "died", "status": "failed", "reason": "stopped before", "at_zero": None},
            "Nothing moved.",
        ),
    ],
)
def test_where_it_says_what_is_it_says_how_the_run_ended(
    shown: Browser, last: dict[str, Any], said: str
) -> None:
    ended = {**LAST, "phase": "done", "reason": "", **last}
    now = shows(shown, "now", last=ended)
    assert said in now
    at_zero = bool(ended["at_zero"] and ended["status"])
    assert ("The output is at zero." in now) == at_zero
    if last.get("status") in ("stopped", "completed", "tripped"):
        running = {**ended, "phase": "analysing", "diagnosis": True}
        # Of a run that did not go through no diagnosis is made.
        made = "estimated and diagnosed" if last["status"] == "completed" else "estimated"
        assert shows(shown, "now", running=running).endswith(f"Being {made}.")
        # At rest is not stale, though no sample comes.
        shown.value("motion.y = [[0]]; motion.arrived = -1e6; undefined")
        assert shown.value("motion.stale()") in ("no run", "not live")
        assert shown.value("document.getElementById('bar').hidden")


def test_a_fault_is_said_first(shown: Browser) -> None:
    fault = {"reason": "a_2 is 41", "time": "t", "program": "p"}
    assert shows(shown, "now", fault=fault) == "FAULT: a_2 is 41. "


def test_a_run_that_nobody_watches_over_says_so(shown: Browser) -> None:
    running = {**RUN, "phase": "running", "status": "", "reason": ""}
    said = shows(shown, "unwatched-text", running=running)
    assert said.endswith("Nobody drives: no operator's page watches over this run.")
    shows(shown, "unwatched-text", running=running, operator="Ada")
    assert shows(shown, "start", running=running, operator="Ada") == "Queue"
    assert shown.value("document.getElementById('unwatched').hidden")


def test_a_stop_that_a_proxy_swallows_ends_the_run_and_its_alarm(
    page: Browser, service: Service
) -> None:
    """First nobody hears it; then the stop's own listener does, and later the service."""
    with service.lease() as lease:
        service.start(lease, sweep(duration=60.0))
        page.until("document.getElementById('now').textContent.includes('segment 1')")
        page.value(FAKE % "[503]")
        page.press("Escape")
        page.until("!document.getElementById('stop-alarm').hidden")
        assert "answered with 503" in page.text("stop-failed")
        assert violations(page) == []
        assert service.progressing()
        # The listener is reached, the service still is not.
        page.value(
            "window.fetch = (url, more) => String(url).startsWith('/api/stop') "
            "? Promise.resolve(new Response('', { status: 503 })) : real(url, more); undefined"
        )
        page.until("document.getElementById('now').textContent.includes('output is at zero')")
        page.until("document.getElementById('stop-alarm').hidden")
        page.until("document.getElementById('stopping').textContent.includes('nothing moves')")
