"""The service runs an experiment in a pose: its rig stands in it, and the recording says so."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from arm_kit import SWEEP, files
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
