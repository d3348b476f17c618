"""The service under viewers and kills.

    python benchmarks/bench_serve.py [--viewers 20] [--slow 5] [--stops 15] [--kills 20]

Viewers: a simulated rig in real time, so many viewers of whom some never read. Prints how long a
stop takes from the request to its answer and to zero volts, how long a plain request takes, what
the viewers got and lost, and that no sample is missing in the recordings. When the output was zero
is read from the recording; the device's clock is laid against this machine's by the promptest
block that a viewer got, so that what is printed is too long by that block's own delay.

Kills: one run after another, the service killed at a moment drawn anew in each and started again;
prints what of the recordings and the index is not as it should be.

Page: what a picture of the page costs in Chromium with four channels of 1 kHz, and how far apart
its pictures are, beside those of an empty page on the same machine.
"""

import argparse
import math
import random
import statistics
import struct
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from samii_rig.record.reader import read_recording
from samii_rig.record.verify import verify
from samii_rig.rig.load import load_rig

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from browser_kit import Browser  # found by the line above
from serve_kit import Service, sweep

HEAD = struct.Struct("<BBHIIIdq")  # see samii_rig/serve/viewers.py


class Viewer(threading.Thread):
    """One who looks, or holds the line and never reads.

    apart : s, this machine's clock less the device's, by the promptest block of the run.
    """

    def __init__(self, url: str, slow: bool) -> None:
        super().__init__(daemon=True)
        self.url, self.slow, self.frames, self.lost, self.apart = url, slow, 0, 0, math.inf

    def run(self) -> None:
        with suppress(Exception), connect(self.url, max_size=None, ping_interval=None) as socket:
            while True:
                if self.slow:
                    time.sleep(3600)
                frame = socket.recv()
                if isinstance(frame, bytes):
                    now = time.monotonic()
                    _, _, _, rows, _, self.lost, rate, first = HEAD.unpack_from(frame)
                    self.frames += 1
                    self.apart = min(self.apart, now - (first + rows - 1) / rate)


def ended(service: Service, id_: str) -> dict:
    def over() -> dict | None:
        last = service.state()["last"]
        return service.job(id_) if last and last["id"] == id_ else None

    return service.until(over)


def viewers(arguments: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder, Service(Path(folder), "--pace", "1") as service:
        url = service.url.replace("http", "ws") + "/api/live"
        all_ = [Viewer(url, i < arguments.slow) for i in range(arguments.viewers)]
        for v in all_:
            v.start()
        service.until(lambda: service.state()["viewers"] == len(all_))
        stops, zeros, plain, missing = [], [], [], 0
        with service.lease() as lease:
            for _ in range(arguments.stops):
                id_ = service.start(lease, sweep(duration=60.0))
                for v in all_:
                    v.apart = math.inf
                service.until(service.progressing)
                for _ in range(50):
                    start = time.perf_counter()
                    service.http.get("/page/page.css")
                    plain.append(1e3 * (time.perf_counter() - start))
                    time.sleep(0.04)
                start = time.monotonic()
                service.http.post("/api/stop")
                stops.append(1e3 * (time.monotonic() - start))
                job = ended(service, id_)
                recording = read_recording(Path(folder) / job["recording"])
                missing += recording.stop.missing_samples
                v = recording.values[:, recording.column("v_2")]
                zero = recording.sequence[np.flatnonzero(v)[-1] + 1] / recording.rate_hz
                apart = min(v.apart for v in all_)
                zeros.append(1e3 * (zero + apart - start))
        plain.sort()
        print(f"{len(all_)} viewers, {arguments.slow} of them never read")
        print(
            f"stop, request to answer: median {statistics.median(stops):.0f} ms, "
            f"worst of {len(stops)} {max(stops):.0f} ms"
        )
        print(
            f"stop, request to zero volts: median {statistics.median(zeros):.0f} ms, "
            f"worst of {len(zeros)} {max(zeros):.0f} ms"
        )
        print(
            f"a small file: median {statistics.median(plain):.0f} ms, "
            f"p99 {plain[int(0.99 * len(plain))]:.0f} ms"
        )
        reading = [v for v in all_ if not v.slow]
        print(
            f"frames got {min(v.frames for v in reading)} to {max(v.frames for v in reading)}, "
            f"lost {sum(v.lost for v in reading)}; samples missing in the recordings: {missing}"
        )


def kills(arguments: argparse.Namespace) -> None:
    rng = random.Random(1)
    wrong = []
    with tempfile.TemporaryDirectory() as folder, Service(Path(folder), "--pace", "20") as service:
        names = []
        for i in range(arguments.kills):
            with service.lease() as lease:
                id_ = service.start(lease, sweep(repeats=4))
                time.sleep(rng.uniform(0.0, 6.0))
                service.kill()
                service.begin()
                job = ended(service, id_)
            names.append(job["recording"])
            if job["status"] != "completed":
                wrong.append(f"{i}: {job['phase']}, {job['status']}, {job['error']}")
            elif verify(Path(folder) / job["recording"]).status != "whole":
                wrong.append(f"{i}: {job['recording']} is not whole")
        found = {e["path"] for e in service.http.get("/api/recordings").json()["recordings"]}
        if found != set(names):
            wrong.append(f"index: {sorted(found ^ set(names))}")
    print(f"{arguments.kills} kills during runs: {len(wrong)} wrong")
    for line in wrong:
        print(f"  {line}")


# Times between 400 pictures, and what the drawing of each takes of them, sorted.
PICTURES = """
new Promise((done) => {
  const times = [], took = [], all = [window.scope, window.motion].filter(Boolean);
  for (const one of all) {
    const draw = one.draw.bind(one);
    one.draw = () => { const t = performance.now(); draw(); took.push(performance.now() - t); };
  }
  const next = (t) => {
    times.push(t);
    if (times.length <= 400) { requestAnimationFrame(next); return; }
    for (const one of all) delete one.draw;
    const apart = times.slice(1).map((x, i) => x - times[i]).sort((a, b) => a - b);
    const pairs = took.map((x, i) => x + (took[i + 1] ?? 0)).filter((_, i) => i % 2 === 0);
    done([apart, pairs.sort((a, b) => a - b)]);
  };
  requestAnimationFrame(next);
})
"""


def page() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = folder / "kilohertz.toml"
        rig.write_text(load_rig("samii")[1].replace("rate_hz = 500.0", "rate_hz = 1000.0"))
        options = ("--pace", "1", "--rig", str(rig))
        with Browser(folder / "browser") as browser:
            empty, _ = browser.value(PICTURES)
            with Service(folder / "runs", *options) as service, service.lease() as lease:
                browser.go(service.url)
                browser.until("document.getElementById('link').textContent === 'live'")
                service.start(lease, sweep(duration=120.0))
                service.until(service.progressing)
                for span in (2, 20):
                    browser.choose("span", str(span))
                    time.sleep(span)
                    apart, took = browser.value(PICTURES)
                    print(
                        f"span {span} s: pictures apart median {apart[200]:.1f} ms, p95 "
                        f"{apart[380]:.1f} ms (empty page {empty[200]:.1f}, {empty[380]:.1f}); "
                        f"drawing median {took[len(took) // 2]:.1f} ms, "
                        f"p95 {took[int(0.95 * len(took))]:.1f} ms"
                    )
                service.http.post("/api/stop")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--slow", type=int, default=5)
    parser.add_argument("--stops", type=int, default=15)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--page", action=argparse.BooleanOptionalAction, default=True)
    arguments = parser.parse_args()
    if arguments.stops:
        viewers(arguments)
    if arguments.kills:
        kills(arguments)
    if arguments.page:
        page()


if __name__ == "__main__":
    main()
