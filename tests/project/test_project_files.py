"""What the project says of itself is said once, or the same everywhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import samii_rig

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_one_version_everywhere():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    released = re.findall(r"^## \[(\d\S*)\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert cited["version"] == released[0] == PROJECT["version"] == samii_rig.__version__
    assert cited["license"] == PROJECT["license"]


@pytest.mark.parametrize("room", ["samii_rig", "samii_rig.diagnose"])
def test_the_layers_that_a_contributor_reads_are_those_that_are_checked(room: str):
    data = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    (layers,) = (
        c["layers"]
        for c in data["tool"]["importlinter"]["contracts"]
        if c["type"] == "layers" and c.get("containers", ["samii_rig"]) == [room]
    )
    order = [name.strip().removeprefix("samii_rig.") for row in layers for name in row.split("|")]
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    (said,) = re.findall(rf"    {re.escape(room)}:((?:.*\n)+?)\n", text)
    told = re.findall(r"\w+", said)
    assert set(told) <= set(order)
    known = [name for name in order if name in told]
    assert [known.index(name) for name in told] == sorted(known.index(name) for name in told)


def test_links_of_the_first_pages_lead_somewhere():
    for page in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", (ROOT / page).read_text("utf-8")):
            assert target.startswith("https://") or (ROOT / target).exists(), (page, target)
