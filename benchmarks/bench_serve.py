"""The service under viewers and kills.

    python benchmarks/bench_serve.py [--viewers 20] [--slow 5] [--stops 15] [--attacked 15]
        [--each 0] [--kinds heads tokens] [--most 1] [--pairs 3] [--kills 20] [--seed 1]

Stops: a simulated rig in real time, so many viewers of whom some never read. Prints the machine's
load, how long a stop takes from the request to its answer and to zero volts, how long an order and
a plain request take, what the viewers got and lost, and that no sample is missing in the
recordings. When the output was zero is read from the recording; the device's clock is laid against
this machine's by the promptest block that a viewer got, so that what is printed is too long by that
block's own delay. By turns the service and the stop's own listener are asked.

Attacked: the same, with tokens and 1,024 descriptors, while another process at the same address
holds 1,100 half-sent heads at each of the two ports (and opens those that are closed anew, 500 a
second), shows 20 wrong tokens and sends 5 heads of 100 kB a second. With a viewer's token it has
plans of three hours predicted all the time, and the index is overwritten every second. It yields to
all others where they want a processor: an attacker has one of their own. Where a proxy answers the
the service's port with an error, the listener's figures are what a page gets.

Each: so many stops under each of these by itself, and where a proxy answers the service's port with
503. There the stop is asked at both at once, as the page does. With --most N under every two and up
to N of them at once too; how long zero volts took is then printed by their number.

Pairs: the simulated serial node in real time, a run without viewers and one with them by turns;
prints how late the loop's sleeps ended in either, and that no sample is missing.

Kills: one run after another, the service killed at a moment drawn anew in each and started again;
prints what of the recordings and the index is not as it should be.

Page: how long until it can be used, just after the service was started and later; what a picture
costs in Chromium with four channels of 1 kHz, and how far apart
its pictures are, beside those of an empty page on the same machine.

So far: what an estimate and a diagnosis of a run that goes on cost, in s of a processor, on the
shipped swept sine as far as each of its segments, and as the page would ask.

--autogroup N gives the service and its runs that nice level among the programs of a loaded machine
(/proc/PID/autogroup of Linux; below 0 wants root).
"""

import argparse
import asyncio
import json
import math
import os
import random
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import httpx
import numpy as np
from websockets.sync.client import connect

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.index.store import FILE, PRIVATE
from samii_rig.record.reader import read_events, read_recording
from samii_rig.record.verify import verify
from samii_rig.rig.load import load_rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.order import RunOrder
from samii_rig.run.priority import PRIORITY
from samii_rig.serve.access import Tokens
from samii_rig.serve.sofar import SoFar
from samii_rig.types import Recording

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))

from browser_kit import Browser  # found by the line above
from device_kit import TIMED, installed
from serve_kit import Service, sweep
from wire_kit import Wire

HEAD = struct.Struct("<BBHIIIdq")  # see samii_rig/serve/viewers.py


class Viewer(threading.Thread):
    """One who looks, or holds the line and never reads.

    apart : s, this machine's clock less the device's, by the promptest block of the run.
    """

    def __init__(self, url: str, slow: bool, headers: dict[str, str]) -> None:
        super().__init__(daemon=True)
        self.headers = headers
        self.url, self.slow, self.frames, self.lost, self.apart = url, slow, 0, 0, math.inf
        self.leave = threading.Event()

    def run(self) -> None:
        more = {"additional_headers": self.headers, "ping_interval": None}
        with suppress(Exception), connect(self.url, max_size=None, **more) as socket:
            if self.slow:
                self.leave.wait()
                socket.socket.shutdown(2)
            while not self.leave.is_set():
                frame = socket.recv()
                if isinstance(frame, bytes):
                    now = time.monotonic()
                    _, _, _, rows, _, self.lost, rate, first = HEAD.unpack_from(frame)
                    self.frames += 1
                    self.apart = min(self.apart, now - (first + rows - 1) / rate)


def prefer(level: int | None, pid: int | str = "self") -> None:
    """Give the session of this process the level among others; a run has a session of its own."""
    if level is not None and Path("/proc/self/autogroup").exists():
        Path(f"/proc/{pid}/autogroup").write_text(str(level))


def progressing(service: Service, level: int | None) -> None:
    for children in Path(f"/proc/{service.process.pid}/task").glob("*/children"):
        for pid in children.read_text().split():
            prefer(level, pid)
    service.until(service.progressing)


def awake(service: Service, lease: dict) -> None:
    """Its workers have loaded what a prediction needs, which a busy machine takes minutes for."""
    for _ in range(10):
        with suppress(httpx.TransportError):
            service.http.post("/api/dry-run", headers=lease, json={"experiment_toml": sweep()})
            return


@contextmanager
def watching(service: Service, count: int, slow: int):
    """So many viewers, of whom some never read, until the end."""
    url = service.url.replace("http", "ws") + "/api/live"
    with ExitStack() as kept:
        all_ = [Viewer(url, i < slow, service.headers) for i in range(count)]
        for v in all_:
            kept.callback(v.leave.set)
            v.start()
        service.until(lambda: service.state()["viewers"] == count)
        yield all_
    service.until(lambda: service.state()["viewers"] == 0)


def told(what: str, ms: Sequence[float], unit: str = "ms") -> None:
    p50, p99 = np.percentile(ms, [50, 99])
    print(f"{what}: p50 {p50:.1f}, p99 {p99:.1f}, worst {max(ms):.1f} {unit} of {len(ms):,}")


def ended(service: Service, id_: str) -> dict:
    def over() -> dict | None:
        last = service.state()["last"]
        return service.job(id_) if last and last["id"] == id_ else None

    return service.until(over)


HALF = b"GET / HTTP/1.1\r\nhost: x\r\n"
HELD, ANEW = 1100, 500  # half-sent heads at each port, and so many a second opened anew
WRONG, LARGE = 20, 5  # wrong tokens and heads of 100 kB a second
PLANNED = 4  # plans that are asked for at once, of which two are predicted and two wait


ATTACKS = ("heads", "tokens", "large heads", "plans", "index")


def attack(url: str, ports: Sequence[int], viewer: str, index: Path, kinds: Sequence[str]) -> None:
    """All of these kinds at once, until it is killed; it has descriptors enough of its own."""

    os.nice(19)

    async def hold(port: int) -> None:
        held = list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]()
        while True:
            held = [(r, w) for r, w in held if not r.at_eof() and not w.is_closing()]
            for _ in range(min(ANEW // 10, HELD - len(held))):
                with suppress(OSError):
                    held.append(await asyncio.open_connection("127.0.0.1", port))
                    held[-1][1].write(HALF)
            await asyncio.sleep(0.1)

    async def ask(rate: float, headers: dict[str, str]) -> None:
        async with httpx.AsyncClient(timeout=2.0) as http:
            while True:
                with suppress(httpx.HTTPError):
                    await http.get(f"{url}/api/state", headers=headers)
                await asyncio.sleep(1.0 / rate)

    async def plan() -> None:
        body = {"experiment_toml": sweep(duration=900.0, repeats=11)}
        headers = {"authorization": f"Bearer {viewer}"}
        async with httpx.AsyncClient(timeout=300.0) as http:
            while True:
                with suppress(httpx.HTTPError):
                    await http.post(f"{url}/api/dry-run", headers=headers, json=body)
                await asyncio.sleep(0.1)

    async def damage() -> None:
        while True:
            with suppress(OSError):
                index.write_bytes(random.randbytes(20_000))
            await asyncio.sleep(1.0)

    async def all_() -> None:
        made = {
            "heads": lambda: [hold(port) for port in ports],
            "tokens": lambda: [ask(WRONG, {"authorization": "Bearer wrong"})],
            "large heads": lambda: [ask(LARGE, {"x": "y" * 100_000})],
            "plans": lambda: [plan() for _ in range(PLANNED)],
            "index": lambda: [damage()],
        }
        await asyncio.gather(*(one for kind in kinds for one in made[kind]()))

    asyncio.run(all_())


@contextmanager
def attacked(service: Service, viewer: str, kinds: Sequence[str]):
    if not kinds:
        yield
        return
    ports = [int(service.port), int(service.stop_port)]
    given = (service.url, ports, viewer, service.folder / PRIVATE / FILE, kinds)
    process = get_context("spawn").Process(target=attack, args=given, daemon=True)
    process.start()
    time.sleep(5.0)  # until all are held
    try:
        yield
        assert process.is_alive()
    finally:
        process.kill()
        process.join()


class Proxy(BaseHTTPRequestHandler):
    """Stands before the service's port and reaches nothing behind it."""

    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        self.send_error(503)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def refusing():
    with ThreadingHTTPServer(("127.0.0.1", 0), Proxy) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server.server_port
        finally:
            server.shutdown()


def ask(port: int | str) -> HTTPConnection:
    """A stop asked on a line of its own, as that of a page that was idle is."""
    line = HTTPConnection("127.0.0.1", int(port), timeout=60.0)
    line.request("POST", "/api/stop")
    return line


def stops(
    arguments: argparse.Namespace, count: int, kinds: Sequence[str] = (), proxy: bool = False
) -> list[float]:
    """Prints what they took; ms from the request to zero volts of each."""
    at: dict[str, tuple[list[float], list[float]]] = {"service": ([], []), "listener": ([], [])}
    plain, orders, missing, viewer = [], [], 0, ""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as kept:
        options, more = ["--pace", "1"], {}
        if kinds:
            tokens = Path(folder) / "tokens.json"
            more = {"token": Tokens(tokens).add("Ada", "operator"), "descriptors": 1024}
            viewer = Tokens(tokens).add("Eve", "viewer")
            options += ["--tokens", str(tokens)]
        service = kept.enter_context(Service(Path(folder) / "runs", *options, **more))
        # A line that is kept owes its next head, and is closed where the places are taken.
        service.http = kept.enter_context(
            httpx.Client(
                base_url=service.url,
                headers=service.headers,
                timeout=60.0,
                limits=httpx.Limits(max_keepalive_connections=0),
            )
        )
        all_ = kept.enter_context(watching(service, arguments.viewers, arguments.slow))
        lease = kept.enter_context(service.lease())
        awake(service, lease)
        kept.enter_context(attacked(service, viewer, kinds))
        before = kept.enter_context(refusing()) if proxy else 0
        for i in range(count):
            for v in all_:
                v.apart = math.inf
            start = time.perf_counter()
            id_ = service.start(lease, sweep(duration=60.0))
            orders.append(time.perf_counter() - start)
            progressing(service, arguments.autogroup)
            for _ in range(10):
                start = time.perf_counter()
                service.http.get("/page/page.css")
                plain.append(1e3 * (time.perf_counter() - start))
                time.sleep(random.uniform(0.02, 0.06))
            asked = "listener" if proxy else list(at)[i % 2]
            port = service.stop_port if asked == "listener" else service.port
            start = time.monotonic()
            refused = ask(before) if proxy else None
            line = ask(port)
            assert json.load(line.getresponse())["stopped"]
            line.close()
            at[asked][0].append(1e3 * (time.monotonic() - start))
            if refused:
                assert refused.getresponse().status == 503
                refused.close()
            job = ended(service, id_)
            recording = read_recording(Path(folder) / "runs" / job["recording"])
            missing += recording.stop.missing_samples
            v = recording.values[:, recording.column("v_2")]
            zero = recording.sequence[np.flatnonzero(v)[-1] + 1] / recording.rate_hz
            at[asked][1].append(1e3 * (zero + min(v.apart for v in all_) - start))
    said = "under attack: " + ", ".join(kinds) if kinds else "not attacked"
    said += "; a proxy answers the service's port with 503" if proxy else ""
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    print(f"{len(all_)} viewers, {arguments.slow} of them never read; {said}; load {load}")
    for asked, (took, zeros) in at.items():
        if took:
            told(f"stop at the {asked}, request to answer", took)
            told(f"stop at the {asked}, request to zero volts", zeros)
    told("stop, request to zero volts", at["service"][1] + at["listener"][1])
    told("a small file", plain)
    told("an order, request to answer", orders, "s")
    reading = [v for v in all_ if not v.slow]
    print(
        f"frames got {min(v.frames for v in reading)} to {max(v.frames for v in reading)}, "
        f"lost {sum(v.lost for v in reading)}; samples missing in the recordings: {missing}"
    )
    return [*at["service"][1], *at["listener"][1]]


def combined(arguments: argparse.Namespace, kinds: Sequence[str]) -> None:
    """Under every one of these attacks, every two, and up to `--most`."""
    for n in range(1, arguments.most + 1):
        zeros = [
            ms
            for some in combinations(kinds, n)
            for ms in stops(arguments, arguments.each, some)
        ]  # fmt: skip
        told(f"STOP, REQUEST TO ZERO VOLTS, {n} ATTACK(S) AT ONCE", zeros)


def pairs(arguments: argparse.Namespace) -> None:
    wire = Wire()
    with tempfile.TemporaryDirectory() as name, ExitStack() as kept:
        kept.callback(wire.close)
        folder, late = Path(name), Path(name) / "late.npy"
        os.environ["PYTHONPATH"] = installed(folder / "package", "timed_node", TIMED)
        # The simulated node stands for a device, which no load of this machine holds up.
        with suppress(OSError):
            os.sched_setscheduler(wire.process.pid, os.SCHED_RR, os.sched_param(PRIORITY + 1))
        rig = wire.rig_file(folder)
        text = rig.read_text().replace('driver = "serial_node"', 'driver = "timed_node"')
        rig.write_text(text.replace("[device.settings]", f'[device.settings]\nlate = "{late}"', 1))
        service = kept.enter_context(Service(folder / "runs", "--rig", str(rig)))
        found: dict[int, list[np.ndarray]] = {0: [], arguments.viewers: []}
        missing, ticks = dict.fromkeys(found, 0), dict.fromkeys(found, 0)
        for i in range(2 * arguments.pairs):
            # By turns which of them is first.
            count = arguments.viewers if i % 4 in (1, 2) else 0
            with watching(service, count, min(count, arguments.slow)), service.lease() as lease:
                id_ = service.start(lease, sweep(duration=20.0, repeats=1))
                progressing(service, arguments.autogroup)
                job = ended(service, id_)
                wire.rest()
                if job["status"] != "completed":
                    print(f"{count} viewers: {job['status']}, {job['reason']}")
                    why = {"name": "bench", "reason": "the machine was late"}
                    service.http.post("/api/clear-fault", headers=lease, json=why)
                    continue
            stop = read_recording(folder / "runs" / job["recording"]).stop
            missing[count] += stop.missing_samples
            ticks[count] += stop.late_ticks
            found[count].append(np.load(late))
    for count, runs in ((c, r) for c, r in found.items() if r):
        told(f"{count} viewers, a sleep of the loop ends late by", np.concatenate(runs))
        print(
            f"  worst of each run: {', '.join(f'{r.max():.1f}' for r in runs)} ms; "
            f"late ticks {ticks[count]}, samples missing {missing[count]}"
        )


def kills(arguments: argparse.Namespace) -> None:
    rng = random.Random(arguments.seed)
    wrong = []
    with tempfile.TemporaryDirectory() as folder, Service(Path(folder), "--pace", "20") as service:
        names = []
        for i in range(arguments.kills):
            with service.lease() as lease:
                awake(service, lease)
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
    print(f"{arguments.kills} kills during runs, seed {arguments.seed}: {len(wrong)} wrong")
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


READY = "performance.getEntriesByName('interactive')"


def page() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = folder / "kilohertz.toml"
        rig.write_text(load_rig("samii")[1].replace("rate_hz = 500.0", "rate_hz = 1000.0"))
        options = ("--pace", "1", "--rig", str(rig))
        with Browser(folder / "browser") as browser:
            first, later = [], []
            for i in range(5):
                with Service(folder / f"empty_{i}") as service:
                    for n in range(5):
                        browser.go(service.url)
                        browser.until(f"{READY}.length === 1")
                        (first if n == 0 else later).append(browser.value(f"{READY}[0].startTime"))
            told("page can be used, just after the start of the service", first)
            told("page can be used, later", later)
            browser.go("about:blank")
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


def so_far() -> None:
    rig, rig_toml = load_rig("samii")
    experiment, text = load_experiment("swept_sine", rig)
    plan = experiment.plan(rig)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        carry_out(RunOrder(rig, rig_toml, text, plan, predict(plan, rig), {"seed": 1}), path)
        start = next(int(e.payload["start"]) for e in read_events(path) if e.name == "plan")
        begun = time.process_time()
        recording = read_recording(path)
        reading = time.process_time() - begun
    known, going_on, whole, found = SoFar(plan), [], [], []
    before = start
    for s, planned in zip(recording.segments, plan.segments, strict=True):
        ends = [before + round(part * len(planned.u)) for part in (0.3, 0.6, 0.9)]
        before += len(planned.u)
        for stop, times in ((e, going_on) for e in ends if known.growing):
            begun = time.process_time()
            if known.take(until(recording, stop), start):
                times.append(time.process_time() - begun)
        begun = time.process_time()
        known.take(until(recording, s.stop), start)
        whole.append(time.process_time() - begun)
        asked = known.sound or [r for r, _ in known.responses()]
        begun = time.process_time()
        diagnose(asked, rig)
        found.append(time.process_time() - begun)
    print(f"reading {len(recording):,} samples {reading:.2f} s")
    for what, took in (
        ("estimate of a sweep that goes on", going_on),
        ("estimate of what is whole", whole),
        ("diagnosis, nothing missing (the first compiles)", found),
    ):
        print(f"{what}: {min(took):.2f} to {max(took):.2f} s, median {np.median(took):.2f}")


def until(recording: Recording, stop: int) -> Recording:
    """As it is on the disk when its newest sample is `stop` - 1."""
    n = int(np.searchsorted(recording.sequence, stop))
    return replace(
        recording,
        sequence=recording.sequence[:n],
        time=recording.time[:n],
        values=recording.values[:n],
        quality=recording.quality[:n],
        segments=tuple(s for s in recording.segments if s.stop <= stop),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--slow", type=int, default=5)
    parser.add_argument("--stops", type=int, default=15)
    parser.add_argument("--attacked", type=int, default=15)
    parser.add_argument("--each", type=int, default=0)
    every = ("proxy", *ATTACKS)
    parser.add_argument("--kinds", nargs="+", choices=every, default=every, help="of --each")
    parser.add_argument("--most", type=int, default=1, help="of --kinds at once")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1, help="of the moments of the kills")
    parser.add_argument("--so-far", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--autogroup", type=int, metavar="N")
    parser.add_argument("--page", action=argparse.BooleanOptionalAction, default=True)
    arguments = parser.parse_args()
    prefer(arguments.autogroup)
    if arguments.stops:
        stops(arguments, arguments.stops)
    if arguments.attacked:
        stops(arguments, arguments.attacked, ATTACKS)
    if arguments.each:
        if "proxy" in arguments.kinds:
            stops(arguments, arguments.each, proxy=True)
        combined(arguments, [k for k in arguments.kinds if k != "proxy"])
    if arguments.pairs:
        pairs(arguments)
    if arguments.kills:
        kills(arguments)
    if arguments.page:
        page()
    if arguments.so_far:
        so_far()


if __name__ == "__main__":
    main()
