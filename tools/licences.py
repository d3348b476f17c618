"""The licence of every package that an installation brings, as the package itself states it.

Ends with 1 if a plain installation brings a package without a licence, or one whose licence asks
for more than an MIT program may promise.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from email.message import Message
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import cast

ROOT = Path(__file__).resolve().parent.parent
# The LGPL may be imported by any program; the GPL and its kin would be ours too.
STRICT = re.compile(r"(?<!L)(A?GPL|SSPL)|(?<!Lesser )General Public License|Affero", re.I)
NONE = "none stated"
ELSEWHERE = "not installed on this system"


@dataclass(frozen=True, slots=True)
class Package:
    """A pinned package; `plain` if an installation without extras brings it."""

    name: str
    version: str
    licence: str
    plain: bool

    @property
    def refused(self) -> bool:
        """Whether a plain installation must not bring it."""
        return self.plain and (self.licence == NONE or bool(STRICT.search(self.licence)))


def stated(data: Message) -> str:
    """One line: the SPDX expression, else the classifiers, else the first line of the text."""
    if expression := data.get("License-Expression"):
        return str(expression)
    classifiers = [c.split(" :: ")[-1] for c in data.get_all("Classifier", ()) if "License ::" in c]
    named = [c for c in classifiers if c != "OSI Approved"]
    if named:
        return "; ".join(named)
    text = (data.get("License") or "").strip()
    return text.splitlines()[0] if text else NONE


def packages() -> Iterator[Package]:
    """All that is pinned, in order of names."""
    name = re.compile(r"^([\w.-]+)==(\S+)", re.M)
    plain = dict(name.findall((ROOT / "requirements.txt").read_text("utf-8")))
    for found, version in name.findall((ROOT / "requirements-dev.txt").read_text("utf-8")):
        try:
            licence = stated(cast(Message, metadata(found)))
        except PackageNotFoundError:
            licence = ELSEWHERE
        yield Package(found, version, licence, found in plain)


def main() -> int:
    """A line a package; first those that a plain installation brings."""
    found = sorted(packages(), key=lambda p: (not p.plain, p.name.lower()))
    width = max(len(p.name) + len(p.version) for p in found) + 1
    for p in found:
        who = "plain" if p.plain else "extra"
        print(f"{f'{p.name} {p.version}':{width}}  {who}  {p.licence}")
    refused = [p for p in found if p.refused]
    for p in refused:
        print(f"licences: {p.name} {p.version}: {p.licence}: not for a plain installation")
    return 1 if refused else 0


if __name__ == "__main__":
    sys.exit(main())
