"""What the report's page does in a browser: gain in dB, a video beside the samples by its stamp.

The video is the head of an MP4 file that says when it was made; no picture of it need be shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser_kit import Browser, violations
from report_kit import measured, model, recorded

from samii_rig.report.page import Subject, write_report

STAMP = 1_790_000_000_250  # ms since 1970: when the first sample was taken
# A file whose first picture was taken seconds later, in whole seconds since 1904 as MP4 has it.
FILM = """
(async (seconds) => {
  const box = (kind, ...parts) => {
    const n = 8 + parts.reduce((sum, p) => sum + p.length, 0), head = new Uint8Array(8);
    new DataView(head.buffer).setUint32(0, n);
    head.set([...kind].map((c) => c.charCodeAt(0)), 4);
    return new Uint8Array([head, ...parts].flatMap((p) => [...p]));
  };
  const mvhd = new Uint8Array(100);
  new DataView(mvhd.buffer).setUint32(4, seconds + 2082844800);
  const boxes = { ftyp: new Uint8Array(16), mdat: new Uint8Array(5000), moov: box("mvhd", mvhd) };
  const bytes = Object.entries(boxes).map(([kind, part]) => box(kind, part));
  const held = new DataTransfer(), input = document.getElementById("video-file");
  held.items.add(new File(bytes, "film.mp4", { type: "video/mp4" }));
  input.files = held.files;
  await input.onchange();
})
"""
LINE = "document.querySelector('[data-figure=data-time]').layout.shapes"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder: Path = tmp_path_factory.mktemp("report")
    recording = recorded()
    offset = STAMP * 1_000_000 - int(recording.time[0])
    page = write_report(
        folder / "r.html",
        Subject(
            [replace(recording, clock_offset=offset)],
            [measured(2.0, seed=1), measured(1.0)],
            model=model(0.6),
        ),
    )
    with Browser(folder / "browser") as made:
        made.go(page.as_uri())
        made.until("document.querySelectorAll('.plot .main-svg').length > 3")
        yield made


def drawn(browser: Browser) -> tuple[np.ndarray, str, str]:
    """First curve of the first panel, its axis' kind and title."""
    div = "document.querySelector('[data-figure=data-bode]')"
    y = browser.value(f"[...{div}.data.find((t) => t.hovertemplate).y]")
    axis = browser.value(f"[{div}.layout.yaxis.type, {div}.layout.yaxis.title.text]")
    return np.array(y), *axis


def test_the_gain_is_shown_in_decibels_and_back(browser: Browser) -> None:
    gain, kind, title = drawn(browser)
    assert (kind, title) == ("log", "gain [rad/V]")
    browser.value("document.getElementById('decibels-bode').click()")
    in_db, kind, title = drawn(browser)
    assert (kind, title) == ("linear", "gain [dB re 1 rad/V]")
    np.testing.assert_allclose(in_db, 20 * np.log10(gain), atol=1e-4)
    browser.value("document.getElementById('decibels-bode').click()")
    np.testing.assert_array_equal(drawn(browser)[0], gain)


def test_a_video_stands_beside_the_sample_of_its_picture(browser: Browser) -> None:
    browser.value(f"document.querySelector('.film').open = true; {FILM}({STAMP // 1000 + 2})")
    shown = browser.value("document.getElementById('video-stamp').value")
    assert shown == "2026-09-21T14:13:22.000"
    assert browser.value(f"{LINE}[0].x0") == pytest.approx(1.75)
    # A stamp that is corrected moves the line; one outside of the recording takes it away.
    browser.choose("video-stamp", "2026-09-21T14:13:20.750")
    assert browser.value(f"{LINE}[0].x0") == pytest.approx(0.5)
    browser.choose("video-stamp", "2026-09-21T14:13:00.000")
    assert browser.value(f"{LINE}.length") == 0
    assert browser.text("video-said").startswith("No sample at 2026-09-21T14:13:00.000 UTC")
    browser.choose("video-stamp", "2026-09-21T14:13:20.750")
    assert violations(browser) == []
    assert browser.errors == []
