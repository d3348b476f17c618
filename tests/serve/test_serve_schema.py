"""The whole API as its own description says it, asked by schemathesis: never a server error.

The service stands in this process, behind its guard; the draw is the same each time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from index_kit import lab
from schemathesis.checks import not_a_server_error
from serve_kit import HOST
from serve_kit import settings as service_settings

from samii_rig.serve import access
from samii_rig.serve.app import application, guarded
from samii_rig.serve.rooms import Rooms

EXAMPLES = 8  # of each operation


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("lab")
    lab(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
        # What is asked too often would not be answered.
        patch.setattr(access, "RATE", 1e6)
        patch.setattr(access, "BURST", 1e6)
        rooms = Rooms(service_settings(folder))
        app = guarded(rooms, int(HOST.rpartition(":")[2]), application(rooms))
        yield schemathesis.openapi.from_asgi("/api/openapi.json", app, headers={"host": HOST})
        rooms.analysis.close()
        rooms.desk.close()


def test_no_request_of_the_description_makes_the_service_fail(api: Any) -> None:
    asked = set()
    for found in api.get_all_operations():
        operation = found.ok()

        @settings(
            max_examples=EXAMPLES,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy())
        def ask(case: Any) -> None:
            answer = case.call(headers={"host": HOST})
            # The guard let it through: what answers is the service itself.
            assert answer.status_code not in (401, 403, 421, 429)
            case.validate_response(answer, checks=[not_a_server_error])

        ask()
        asked.add((operation.method.upper(), operation.path))
    assert len(asked) > 20
