"""Every real recording through the page.

    python benchmarks/replay_page.py [--data FOLDER] [--speed 100]

Imports each, opens it in Chromium, replays it to its end and holds what the scope was given against
the file, sample by sample; ends with 1 if one differs or the page reports an error.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))

from browser_kit import Browser  # found by the line above
from replay_kit import opened, replayed
from serve_kit import Service

from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.record.store import write_recording

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "sflr"


def layout_of(name: str) -> str:
    """The shipped map for a file of this name."""
    if "full-robot" in name:
        return "sflr"
    return "sflr_motor_open" if "_ol_" in name else "sflr_motor"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=FOLDER)
    parser.add_argument("--speed", default="100", choices=("0.1", "0.5", "1", "2", "10", "100"))
    arguments = parser.parse_args()
    files = sorted(arguments.data.glob("*.txt"))
    if not files:
        sys.exit(f"no recordings in {arguments.data}; expected --data FOLDER with .txt files")
    with tempfile.TemporaryDirectory() as name:
        runs, samples = Path(name) / "runs", 0
        runs.mkdir()
        for file in files:
            the_map, text = load_map(layout_of(file.name))
            write_recording(runs / f"{file.stem}.mcap", import_file(file, the_map, text))
        begun = time.perf_counter()
        with Service(runs, "--rig", "sflr") as service, Browser(Path(name) / "browser") as browser:
            browser.go(service.url)
            browser.until(f"document.querySelectorAll('#list tr').length === {len(files)}")
            for file in files:
                opened(browser, f"{file.stem}.mcap")
                samples += replayed(browser, runs / f"{file.stem}.mcap", arguments.speed)
                if browser.errors:
                    sys.exit(f"{file.name}: {browser.errors}")
        took = time.perf_counter() - begun
    print(f"{len(files)} recordings, {samples:,} samples, each as in its file, in {took:.0f} s")


if __name__ == "__main__":
    main()
