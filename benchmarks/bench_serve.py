"""The service under viewers and kills.

    python benchmarks/bench_serve.py [--viewers 20] [--slow 5] [--stops 5] [--kills 20]

Viewers: a simulated rig in real time, so many viewers of whom some never read. Prints how long a
stop takes from the request to its answer (the signal is sent by then; the run obeys at its next
tick), the same of a plain request, what the viewers got and lost, and that no sample is missing
in the recordings. Kills: one run after another, the service killed at a moment drawn anew in each
and started again; prints what of the recordings and the index is not as it should be.
"""

import argparse
import random
import statistics
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

from websockets.sync.client import connect

from samii_rig.record.reader import read_recording
from samii_rig.record.verify import verify

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from serve_kit import Service, sweep  # found by the line above


class Viewer(threading.Thread):
    """One who looks, or holds the line and never reads."""

    def __init__(self, url: str, slow: bool) -> None:
        super().__init__(daemon=True)
        self.url, self.slow, self.frames, self.lost = url, slow, 0, 0

    def run(self) -> None:
        with suppress(Exception), connect(self.url, max_size=None) as socket:
            while True:
                if self.slow:
                    time.sleep(3600)
                frame = socket.recv()
                if isinstance(frame, bytes):
                    self.frames += 1
                    self.lost = int.from_bytes(frame[12:16], "little")


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
        stops, plain, missing = [], [], 0
        with service.lease() as lease:
            for _ in range(arguments.stops):
                id_ = service.start(lease, sweep(duration=60.0))
                service.until(service.progressing)
                for _ in range(100):
                    start = time.perf_counter()
                    service.http.get("/page/page.css")
                    plain.append(1e3 * (time.perf_counter() - start))
                    time.sleep(0.04)
                start = time.perf_counter()
                service.http.post("/api/stop")
                stops.append(1e3 * (time.perf_counter() - start))
                job = ended(service, id_)
                missing += read_recording(Path(folder) / job["recording"]).stop.missing_samples
        plain.sort()
        print(f"{len(all_)} viewers, {arguments.slow} of them never read")
        print(
            f"stop, request to answer: median {statistics.median(stops):.0f} ms, "
            f"worst of {len(stops)} {max(stops):.0f} ms"
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--slow", type=int, default=5)
    parser.add_argument("--stops", type=int, default=5)
    parser.add_argument("--kills", type=int, default=20)
    arguments = parser.parse_args()
    if arguments.stops:
        viewers(arguments)
    if arguments.kills:
        kills(arguments)


if __name__ == "__main__":
    main()
