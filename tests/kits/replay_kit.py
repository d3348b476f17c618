"""Replay a recording through the page, and hold what the scope was given against the file."""

from __future__ import annotations

from base64 import b64decode
from pathlib import Path

import numpy as np
from browser_kit import Browser

from samii_rig.record.reader import read_recording
from samii_rig.serve.viewers import HEAD

# Every frame that the scope takes is kept.
LISTEN = """
window.seen = [];
delete scope.take;
scope.take = function (data) { seen.push(data); return Object.getPrototypeOf(this).take.call(this, data); };
0
"""  # noqa: E501
TOLD = """
(async () => {
  const url = await new Promise((done) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.readAsDataURL(new Blob(seen));
  });
  return url.slice(url.indexOf(',') + 1);
})()
"""


def opened(browser: Browser, name: str) -> None:
    """Look at a recording of the list."""
    found = f"[...document.querySelectorAll('#list button')].find(b => b.textContent === '{name}')"
    browser.until(f"Boolean({found})")
    browser.value(f"{found}.click()")
    browser.until(f"document.getElementById('h-one').textContent === '{name}'")


def replayed(browser: Browser, path: Path, speed: str = "100") -> int:
    """Replay the recording that is looked at to its end; how many samples were shown, each of them
    as it stands in the file."""
    browser.choose("replay-speed", speed)
    browser.value(LISTEN)
    browser.click("replay")
    browser.until(
        f"document.getElementById('replay-state').textContent.startsWith('Replay of {path.name}')"
    )
    browser.until("document.getElementById('replay-state').textContent.includes('over. Not live')")
    recording = read_recording(path)
    data, at, shown = b64decode(browser.value(TOLD)), 0, 0
    while at < len(data):
        _, _, columns, rows, step, _, rate, first = HEAD.unpack_from(data, at)
        assert (step, rate) == (1, recording.rate_hz)
        values = np.frombuffer(data, "<f4", rows * columns, at + HEAD.size).reshape(rows, columns)
        np.testing.assert_array_equal(
            first + np.arange(rows), (recording.sequence - recording.sequence[0])[shown:][:rows]
        )
        np.testing.assert_array_equal(values, recording.values[shown:][:rows].astype("<f4"))
        at += HEAD.size + values.nbytes
        shown += rows
    assert shown == len(recording)
    return shown
