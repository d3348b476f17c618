"""The service runs an experiment in a pose: its rig stands in it, and the recording says so."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from arm_kit import SWEEP, files
from browser_kit import Browser, violations
from serve_kit import Service

from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    rig, _ = files(tmp_path_factory.mktemp("rig"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
        lab = tmp_path_factory.mktemp("lab")
        with Service(lab, "--rig", rig, "--pace", "20") as started:
            yield started


def dry(service: Service, **more: str) -> dict:
    return service.http.post("/api/dry-run", json={"experiment_toml": SWEEP, **more})


def test_each_run_is_made_and_recorded_in_the_pose_that_was_asked_for(service):
    with service.lease() as lease:
        asked = {"120": {"pose": "120 deg"}, "0": {}}
        ids = {name: service.start(lease, SWEEP, **more) for name, more in asked.items()}
        for degrees, id_ in ids.items():
            service.until(lambda i=id_: service.job(i)["phase"] == "done")
            found = read_recording(service.folder / service.job(id_)["recording"])
            assert found.stop.status == "completed"
            pose = parse(Rig, found.rig_toml, "recorded").pose
            assert math.degrees(pose.value) == pytest.approx(float(degrees), abs=1e-9)


def test_a_dry_run_is_of_the_pose(service):
    hanging, standing = dry(service).json(), dry(service, pose="120 deg").json()
    assert dry(service, pose="0 deg").json() == hanging
    assert standing["runs"] != hanging["runs"]


@pytest.mark.parametrize("pose", ["30", "30 kg", "up"])
def test_what_is_no_pose_is_one_line_and_nothing_is_queued(service, pose):
    answer = dry(service, pose=pose)
    assert answer.status_code == 422
    assert "expected an angle with its unit" in answer.text
    with service.lease() as lease:
        body = {"experiment_toml": SWEEP, "pose": pose}
        assert service.http.post("/api/runs", headers=lease, json=body).status_code == 422
    assert service.state()["queue"] == []


def test_the_page_has_a_field_for_the_pose_and_orders_in_it(service, tmp_path):
    with Browser(tmp_path / "browser") as page:
        page.size(1440, 900)
        page.go(service.url)
        page.until("document.getElementById('stands')?.hidden === false")
        assert page.value("document.getElementById('pose').value") == "0"  # the rig file's
        page.value(f"document.getElementById('text').value = {SWEEP!r}; undefined")
        page.value("document.getElementById('text').dispatchEvent(new Event('input'))")
        within = "document.getElementById('checked').textContent === 'Within every limit.'"
        page.until(within)
        left = "[...document.querySelectorAll('#margins tbody tr')].map((r) => r.title).join()"
        hanging = page.value(left)
        stand(page, "up")
        assert page.text("checked") == "Pose: up is not a number of degrees."
        assert page.value("document.getElementById('pose').getAttribute('aria-invalid')") == "true"
        page.click("plan")
        page.until("document.getElementById('alarm').textContent.startsWith('A field is wrong')")
        stand(page, "120")
        page.until(f"{within} && ({left}) !== {hanging!r}")
        assert violations(page) == []
        page.choose("operator", "Ada")
        page.click("take")
        page.click("start")
        page.until("document.getElementById('now').textContent.startsWith('sweep at 120 deg')")
        page.until("document.getElementById('last').textContent.startsWith('Last: sweep at 120')")
        assert page.errors == []
    last = service.state()["last"]
    assert last["pose"] == "120 deg"
    found = read_recording(service.folder / last["recording"])
    pose = parse(Rig, found.rig_toml, "recorded").pose
    assert math.degrees(pose.value) == pytest.approx(120.0, abs=1e-9)


def stand(page: Browser, at: str) -> None:
    """Type it into the field of the pose."""
    page.value(
        f"(e => {{ e.value = {at!r}; e.dispatchEvent(new Event('input')); }})"
        "(document.getElementById('pose'))"
    )
