"""The pinned packages against the known vulnerabilities of PyPI, by pip-audit.

Ends with 0 if every package was looked up and none is vulnerable, 1 if one is or was not looked
up, and 3 if the list of vulnerabilities could not be reached: then nothing is known.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PINNED = ("--requirement", "requirements-dev.txt", "--disable-pip")
VULNERABLE, UNREACHED = 1, 3  # exit codes


def verdict(packages: list[dict[str, Any]]) -> tuple[int, list[str]]:
    """Exit code and lines of what pip-audit found: its `dependencies`."""
    unknown = [p for p in packages if "skip_reason" in p]
    found = [(p, v) for p in packages for v in p.get("vulns", ())]
    if unknown and len(unknown) == len(packages):
        return UNREACHED, [
            f"audit: none of the {len(packages)} packages is in the list of vulnerabilities: "
            f"it was not reached. Nothing is known. It said: {unknown[0]['skip_reason']}"
        ]
    lines = [
        f"{p['name']} {p['version']}: {v['id']}, mended in {', '.join(v['fix_versions']) or 'none'}"
        for p, v in found
    ]
    lines += [f"{p['name']}: not looked up: {p['skip_reason']}" for p in unknown]
    looked = len(packages) - len(unknown)
    lines.append(f"audit: {len(found)} vulnerabilities; {looked} of {len(packages)} looked up")
    return VULNERABLE if found or unknown else 0, lines


def main(arguments: list[str]) -> int:
    """Ask, and say what was found."""
    options = ("--format", "json", "--progress-spinner", "off")
    command = [sys.executable, "-m", "pip_audit", *PINNED, *options, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        last = (done.stderr.strip().splitlines() or [f"pip-audit ended with {done.returncode}"])[-1]
        print(
            f"audit: the list of vulnerabilities was not reached. Nothing is known. It said: {last}"
        )
        return UNREACHED
    code, lines = verdict(packages)
    print("\n".join(lines))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
