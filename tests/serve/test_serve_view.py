"""What a person sees at once: the page during a run at the sizes of a bench, a desk and a hand;
lamps, fields, switches of the responses, and what a browser keeps.

Skips where no Chromium is installed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from browser_kit import Browser, violations
from serve_kit import Service, sweep

from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import load_experiment, plan_of
from samii_rig.serve.planned import averages

# At the bench, without scrolling.
NEEDED = ("stop", "now", "bar", "lamps", "diagnosis-what", "scope", "frf-fill", "motion")
CHANNELS = [
    {"name": "v_2", "unit": "V", "role": "command"},
    {"name": "a_0", "unit": "m/s^2", "role": "sensor"},
]
# A frame of the live data: one row of two channels.
FRAME = """
((values) => { const b = new ArrayBuffer(32 + 4 * values.length), v = new DataView(b);
  v.setUint8(0, 1); v.setUint16(2, 2, true); v.setUint32(4, 1, true); v.setUint32(8, 1, true);
  v.setFloat64(16, 500, true); values.forEach((x, k) => v.setFloat32(32 + 4 * k, x, true));
  lamps.take(b); lamps.show(); })(%s);
[...document.querySelectorAll('.lamp')].map((l) => l.textContent)
"""
# 1/(1 + jf) with a band, as a run and as a recording tell it.
F = [0.5, 1.0, 2.0, 4.0]
PARTS = [(1 / (1 + f * f), -f / (1 + f * f)) for f in F]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("view")
    with Service(folder / "runs", "--pace", "1") as service, Browser(folder / "browser") as browser:
        browser.size(1440, 900)
        browser.go(service.url)
        browser.until("document.querySelectorAll('#margins, #fields input').length > 3")
        browser.until("Object.keys(lamps.bounds).length > 3")
        browser.until("document.getElementById('link').textContent === 'live'")
        browser.service = service  # type: ignore[attr-defined]
        yield browser
        assert browser.errors == []


def typed(browser: Browser, key: str, name: str, value: str) -> None:
    """Type into the field of this name."""
    found = f"[...document.querySelectorAll('#fields label')].find((l) => l.textContent.startsWith('{name}'))"  # noqa: E501
    browser.value(
        f"(e => {{ e.value = {value!r}; e.dispatchEvent(new Event('input')); }})({found}.querySelector('input'))"  # noqa: E501
    )


def state(**progress: Any) -> str:
    run = {"id": "1", "experiment": "short", "phase": "running", "time": "2026-11-01T10:00:00Z"}
    run |= {"recording": "r.mcap", "progress": progress, "diagnosis": False}
    whole = {"rig": "SAMII", "started": "x", "channels": CHANNELS, "queue": [], "held": ""}
    whole |= {"operator": "Ada", "viewers": 1, "pace": 1, "time_left_s": 0, "fault": None}
    return json.dumps({**whole, "running": run, "last": None, "so_far": None, "stop_port": 0})


def test_averages_are_of_segments_that_are_averaged_together(tmp_path: Path) -> None:
    _, toml = load_rig("samii")
    rig = parse(Rig, toml, "rig file")
    file = tmp_path / "e.toml"
    file.write_text(sweep(duration=1.0, repeats=3).replace("[0.02]", "[0.01, 0.02]"))
    plan = plan_of(load_experiment(str(file), rig)[0], rig)
    assert [averages(plan, k + 1) for k in range(6)] == [(0, 3), (1, 3), (2, 3)] * 2


def test_a_lamp_says_what_is_left_and_stays_red_after_an_overload(page: Browser) -> None:
    """SAMII's v_2 may be 5 V, a_0 30 m/s^2, less than its converter's 50."""
    about = {"segment": 1, "n_segments": 2, "averages": 3, "of_averages": 12, "worst_margin": 1}
    more = {"name": "s", "level": 0.5, "unit": "V", "duration": 1, "time_left": 1, "margin": 1}
    told = state(**about, **more)
    shown = f"show({told}); lamps.lay({json.dumps(CHANNELS)});"
    assert page.value(shown + FRAME % "[1.0, 0.0]") == ["v_220 %", "a_00 %"]
    assert page.value(shown + "document.getElementById('averages').textContent") == "3 / 12"
    assert page.value(f"show({told});" + FRAME % "[4.5, -30.5]") == ["v_290 %", "a_0OVER"]
    page.value("lamps.boxes.forEach((b) => { b.at = -1e9; }); lamps.show()")
    states = page.value("[...document.querySelectorAll('.lamp')].map((l) => l.dataset.state)")
    assert states == ["fine", "was"]
    high = page.value(
        f"show({told}); parseFloat(getComputedStyle(document.getElementById('averages')).fontSize)"
    )
    assert high >= 40  # px; 10 mm on a screen of 24 inches, read from three metres


def test_a_field_writes_the_file_and_each_limit_says_what_would_be_left(page: Browser) -> None:
    page.choose("experiment", "step")
    page.until("document.getElementById('checked').textContent === 'Within every limit.'")
    left = "[...document.querySelectorAll('#margins tbody tr')].map((r) => r.textContent)"
    before = page.value(left)
    assert any(row.startswith("theta_2 limit0.350 rad") for row in before)
    # Without gravity there is no pose to stand in.
    assert page.value("document.getElementById('stands').hidden")
    typed(page, "amplitudes", "Levels [rad]", "0.1, 0.05")
    page.until("document.getElementById('text').value.includes('amplitudes = [0.1, 0.05]')")
    page.until(f"({left}).length > 0 && ({left})[0] !== {before[0]!r}")
    typed(page, "amplitudes", "Levels [rad]", "9")
    page.until("document.getElementById('checked').textContent.startsWith('Refused: theta_2')")
    typed(page, "repeats", "Repeats", "2.5")
    page.until("document.getElementById('checked').textContent.includes('repeats is 2.5')")
    assert page.value("document.querySelectorAll('[aria-invalid=true]').length") == 1
    # What is no number does not reach the file, and nothing is ordered from it.
    typed(page, "repeats", "Repeats", "two")
    assert "Repeats: two is not a number." in page.text("checked")
    page.click("plan")
    page.until("document.getElementById('alarm').textContent.startsWith('A field is wrong')")
    page.click("as-shipped")
    page.until("document.getElementById('checked').textContent === 'Within every limit.'")


def test_the_responses_are_shown_in_every_view_with_cursors(page: Browser) -> None:
    gain = [(x * x + y * y) ** 0.5 for x, y in PARTS]
    curve = {"output": "a_0", "unit": "m/s^2/V", "gain": gain, "phase": [-26.6, -45, -63.4, -76]}
    bands = {"low": [0.9 * g for g in gain], "high": [1.1 * g for g in gain], "half": [5.0] * 4}
    run = {"level": 1, "unit": "V", "n": 2, "frequency": F, "low_hz": 0.5, "high_hz": 4.0}
    run["curves"] = [{**curve, **bands, "input": "v_2", "coherence": [0.99] * 4}]
    data = {"low_hz": 0.5, "high_hz": 4.0, "responses": [run]}
    data["model"] = {"frequency": F, "curves": [{**curve, "input": "v_2"}]}
    laid = {"level": 1, "level_unit": "V", "frequency": F}
    re, im = zip(*PARTS, strict=True)
    parts = {"re": re, "im": im, "sd": [0.01] * 4, "coherence": [0.98] * 4}
    laid["curves"] = [{"output": "a_0", "input": "v_2", "unit": "m/s^2/V", **parts}]
    notes = [{"text": "at 2 Hz: squeaks"}, {"text": "of no frequency"}]
    old = {"id": "7", "name": "old.mcap", "responses": [laid], "notes": notes}
    page.value(f"panel.set({json.dumps(data)}, false); panel.lay({json.dumps(old)})")
    assert page.value("panel.flags()") == [{"at": 2, "text": "squeaks"}]
    if not page.value("document.getElementById('frf-cursors').checked"):
        page.click("frf-cursors")
    page.value("document.getElementById('frf-a').value = 333.333; panel.draw()")  # 1 Hz
    said = {}
    for view in page.value("[...document.getElementById('frf-show').options].map((o) => o.value)"):
        page.choose("frf-show", view)
        cells = "[...document.querySelectorAll('#frf-read tbody tr')].map((r) => r.cells[1].textContent)"  # noqa: E501
        said[view] = page.value(cells)
        assert page.value("panel.boxes.length") == 1
    # Model, run, recording: half of the power at 1 Hz, 45 degrees behind.
    assert said["db"][1].startswith("-3.01 (-3.925 to -2.182)")
    assert [v.split(" ")[0] for v in said["gain"]] == ["0.7071", "0.7071", "0.7071"]
    assert [v.split(" ")[0] for v in said["phase"]] == ["-45", "-45", "-45"]
    assert said["real"][2].startswith("0.5 (0.488")
    assert said["nyquist"][2] == "0.5 \u2212 0.5i"
    assert said["coherence"] == ["\u2013", "0.99", "0.98"]
    page.value("document.querySelector('#frf-laid button').click(); panel.set(null, false)")
    assert page.value("document.getElementById('frf-section').hidden")


def test_while_a_run_is_diagnosed_the_page_says_what_is_tried_and_for_how_long(
    page: Browser,
) -> None:
    told = json.loads(state())
    doing = "what is missing, round 2: 3 of 30, 4 s left of this round, 20 s to 60 s to the end"
    ended = {"phase": "analysing", "status": "completed", "reason": "", "at_zero": True}
    told["running"] |= {**ended, "ended": "2026-11-01T10:00:00+00:00", "doing": doing}
    told["running"]["diagnosis"] = True
    assert shown(page, told, "now").endswith("Being estimated and diagnosed.")
    assert shown(page, told, "facts") == f"The diagnosis tries{doing}"
    told["running"]["doing"] = ""
    assert shown(page, told, "facts") == ""
    # And while the run goes on, of what is known so far.
    told["running"] |= {"phase": "running", "status": "", "diagnosis": True}
    told["so_far"] = {"responses": "0", "responses_age_s": 0, "diagnosis": None, "failed": False}
    told["so_far"]["doing"] = doing
    assert shown(page, told, "diagnosis-doing") == f"Now: {doing}."
    assert shown(page, json.loads(state()), "diagnosis-doing") == ""


def shown(page: Browser, told: object, id_: str) -> str:
    """What an element says of a state, before the service's own next one arrives."""
    element = f"document.getElementById('{id_}')"
    return str(page.value(f"(show({json.dumps(told)}), {element}.textContent)"))


# Of what the page asks for of a job: which, and answers that are made up.
ASKS = """
window.asked = []; window.real = window.real ?? window.fetch;
window.fetch = (url, more = {}) => {
  const of = /\\/api\\/jobs\\/(.+)/.exec(String(url));
  if (!of) return real(url, more);
  asked.push(of[1]);
  return Promise.resolve(new Response(JSON.stringify(%s), { status: 200 }));
};
undefined
"""
NO_RESPONSE = {"low_hz": 1, "high_hz": 20, "first_s": 30, "done": 0, "of": 6, "took_s": 0}
NO_RESPONSE |= {"trouble": "", "final": False, "responses": []}
NO_RESPONSE["model"] = {"frequency": [1, 20], "curves": []}


def test_before_there_is_an_estimate_the_page_says_when_one_is_expected(page: Browser) -> None:
    page.value(ASKS % json.dumps(NO_RESPONSE))
    told = json.loads(state(segment=1, n_segments=6, time_left=90.0, duration=100.0))
    told["running"] |= {"diagnosis": True, "id": "awaited"}
    told["so_far"] = {"responses": "1", "responses_age_s": 0, "diagnosis": None, "failed": False}
    told["pace"] = 2
    said = "The first estimate is expected in about 13 s."  # (30 - 10)/2, and what it takes
    page.until(f"show({json.dumps(told)}); soFar.data?.first_s === 30")
    assert shown(page, told, "diagnosis-what").endswith(said)
    assert said in page.text("frf-about")
    told["running"]["progress"]["time_left"] = 60.0
    assert shown(page, told, "diagnosis-what").endswith("The first estimate is being made.")
    # Of a run that was stopped before there was one nothing is expected, nor asked for.
    ended = {"phase": "analysing", "status": "stopped", "reason": "", "at_zero": True}
    told["running"] |= {**ended, "ended": "2026-11-01T10:00:00+00:00"}
    assert shown(page, told, "diagnosis-what") == "None: the run ended before there was one."
    last = {**told["running"], "phase": "done", "estimated": False, "diagnosed": False}
    page.value("asked.length = 0")
    told |= {"running": None, "so_far": None, "last": {**last, "recording_id": ""}}
    page.value(f"show({json.dumps(told)})")
    page.until("document.getElementById('diagnosis-section').hidden && soFar.seen === 'over'")
    assert page.value("asked") == []
    page.value("window.fetch = real; undefined")


def test_a_queue_that_is_held_and_what_was_recorded_are_seen_at_once(page: Browser) -> None:
    told = json.loads(state())
    last = {**told["running"], "phase": "done", "status": "stopped", "reason": "stop asked by Ada"}
    last |= {"recording": "a.mcap", "recording_id": "ab12", "estimated": False, "at_zero": True}
    waiting = [{"id": "2", "experiment": "short", "duration_s": 5.0}]
    told |= {"running": None, "last": last, "held": "stop asked by Ada", "queue": waiting}
    page.size(1440, 900)
    page.call("Page.reload")
    page.until("document.getElementById('link')?.textContent === 'live'")
    page.until("document.querySelectorAll('#fields input').length > 3 && Boolean(window.show)")
    page.until("document.querySelectorAll('#drawing svg').length === 1")
    page.value(f"scrollTo(0, 0); show({json.dumps(told)})")
    assert page.text("held-now") == "Queue held, 1 run waits."
    assert page.text("held") == "Held: stop asked by Ada"
    assert page.text("kept-name") == "a.mcap"
    report = "document.getElementById('kept-report').getAttribute('href')"
    assert page.value(report) == "/api/recordings/ab12/report"
    for id_ in ("held-now", "h-queue", "held", "kept-report"):
        box = page.value(f"document.getElementById('{id_}').getBoundingClientRect().toJSON()")
        assert box["height"] > 10, id_
        assert 0 < box["top"] < box["bottom"] <= 900, (id_, box)
    page.value(f"show({state()})")
    assert page.value("document.getElementById('held-here').hidden")
    assert page.value("document.getElementById('kept').hidden")


def test_units_are_written_one_way(page: Browser) -> None:
    said = "import('/page/units.js').then((m) => m.pretty('%s'))"
    assert page.value(said % "m/s^2") == "m/s²"
    assert page.value(said % "N^2 s/m^4") == "N² s/m⁴"
    files = (resources.files("samii_rig.serve") / "page").iterdir()
    assert [f.name for f in files if "²" in f.read_text()] == ["units.js"]


def test_every_axis_of_frequency_has_its_unit_beside_its_numbers(page: Browser) -> None:
    """At each width of a diagram: the unit is drawn, inside the picture and on no number."""
    drawn = """
    (() => { const out = [], g = document.createElement("canvas").getContext("2d");
      const draw = g.fillText.bind(g);
      g.fillText = (text, x, y) => { const w = g.measureText(text).width;
        const left = x - (g.textAlign === "right" ? w : g.textAlign === "center" ? w / 2 : 0);
        out.push([text, left, left + w, y]); draw(text, x, y); };
      diagram(g, { x: 52, y: 22, w: %d, h: 130 }, { title: "t", unit: "u", x: [%g, %g],
        y: [0, 1, 0.5], logarithmic: true, curves: [] }, () => "black");
      return out.filter(([, , , y]) => y > 160); })()
    """
    page.value("import('/page/chart.js').then((m) => { window.diagram = m.diagram; })")
    for width in (160, 196, 208, 300):
        for low, high in ((0.5, 40.0), (0.5, 20.0), (1.0, 25.0), (0.8, 35.0)):
            found = page.value(drawn % (width, low, high))
            assert [text for text, *_ in found].count("Hz") == 1
            assert max(right for _, _, right, _ in found) <= 52 + width + 10
            spans = sorted((left, right) for _, left, right, _ in found)
            assert all(a[1] <= b[0] for a, b in pairwise(spans)), found


def test_layout_and_colours_stay_with_the_browser(page: Browser) -> None:
    page.choose("theme", "dark")
    page.choose("span", "2")
    page.click("rig-size")
    page.call("Page.reload")
    page.until("document.getElementById('link')?.textContent === 'live'")
    assert page.value("document.documentElement.dataset.theme") == "dark"
    assert page.value("scope.span") == 2
    assert page.value(
        "document.getElementById('rig-here').contains(document.getElementById('motion'))"
    )
    page.click("rig-size")
    page.choose("theme", "")


def test_a_run_is_seen_without_scrolling(page: Browser) -> None:
    service: Service = page.service  # type: ignore[attr-defined]
    with service.lease() as lease:
        # In real time: each repeat that is whole is estimated and diagnosed, and axe takes seconds.
        service.start(lease, sweep(duration=4.0, repeats=60), diagnosis=True)
        try:
            page.until("/[1-9] repeats/.test(document.getElementById('frf-about').textContent)")
            seen_at_once(page)
            for width, height in ((390, 844), (1440, 900)):
                page.size(width, height)
                for scheme in ("dark", "light"):
                    page.colours(scheme)
                    assert violations(page) == []
        finally:
            page.press("Escape")
        page.until("document.getElementById('now').textContent.includes('output is at zero')")
    assert "stopped by " in page.text("now")
    # Why it was stopped is asked once it is at rest, and stands where it says what is now.
    page.until("!document.getElementById('why-stopped').hidden")
    page.value("document.getElementById('why-stopped-text').value = 'a hose touched the frame'")
    page.value("document.querySelector('#why-stopped button').click()")
    page.until("document.getElementById('why-said').textContent.includes('a hose touched')")


def seen_at_once(page: Browser) -> None:
    """All that is needed is on the screen, and on a narrow one below each other by need."""
    boxes = (
        f"{json.dumps(NEEDED)}.map((id) => {{ const b = "
        "document.getElementById(id).getBoundingClientRect(); "
        "return [id, b.width, b.height, b.bottom, b.right]; })"
    )
    for width, height in ((1440, 900), (1920, 1080)):
        page.size(width, height)
        page.value("scrollTo(0, 0)")
        for id_, wide, high, bottom, right in page.value(boxes):
            assert wide > 30, id_
            assert high > 10, id_
            assert bottom <= height, (id_, bottom)
            assert right <= width, (id_, right)
    page.size(390, 844)
    tops = page.value(
        "['stop', 'now', 'scope', 'frf', 'start', 'list']"
        ".map((id) => document.getElementById(id).getBoundingClientRect().top)"
    )
    assert tops == sorted(tops)
    assert page.value("document.documentElement.scrollWidth") <= 390
