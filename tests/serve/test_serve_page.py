"""The page needs nobody but the service, and its parts fit together."""

from __future__ import annotations

import asyncio
import re
from importlib import resources
from pathlib import Path

import httpx
import pytest
from serve_kit import client, settings

from samii_rig.serve.rooms import Rooms

FILES = {f.name: f.read_text() for f in (resources.files("samii_rig.serve") / "page").iterdir()}
HTML, JS = FILES["index.html"], FILES["page.js"]


def test_nothing_is_asked_of_another_host() -> None:
    for name, text in FILES.items():
        assert not re.search(r"https?://|//[\w-]+\.\w", text.replace("location.host", "")), name


def test_every_part_that_the_script_works_on_is_there_once() -> None:
    ids = re.findall(r'id="([\w-]+)"', HTML)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'\$\("([\w-]+)"\)', JS)) <= set(ids)
    for label in re.findall(r'aria-labelledby="([\w-]+)"', HTML):
        assert label in ids


def test_every_file_that_is_named_is_served_and_runs_under_the_policy(tmp_path: Path) -> None:
    named = set(re.findall(r"/page/([\w.]+)", "".join(FILES.values())))
    assert named == set(FILES) - {"index.html"}

    async def ask() -> list[httpx.Response]:
        async with client(rooms) as http:
            return [await http.get("/"), *[await http.get(f"/page/{n}") for n in sorted(named)]]

    rooms = Rooms(settings(tmp_path))
    try:
        answers = asyncio.run(ask())
    finally:
        rooms.desk.close()
    assert {a.status_code for a in answers} == {200}
    for answer in answers:
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "unsafe-eval" not in answer.headers["content-security-policy"]
    # Scripts stand in files: the policy runs no others.
    assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=", HTML)


@pytest.mark.parametrize("control", ["input", "select", "button"])
def test_every_control_has_a_name_for_who_does_not_see_it(control: str) -> None:
    labelled = re.sub(r"<label[^>]*>.*?</label>", "", HTML, flags=re.DOTALL)
    for tag, text in re.findall(rf"<({control}\b[^>]*)>([^<]*)", labelled):
        assert text.strip() or "aria-label" in tag or "hidden" in tag, tag
