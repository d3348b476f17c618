"""What the command line makes of a run that is over, when what follows does not go."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from samii_rig.cli import one_run as module
from samii_rig.errors import RecordedError


@pytest.mark.parametrize(("status", "code"), [("completed", 7), ("tripped", 5)])
def test_memory_that_runs_out_after_a_run_says_that_the_recording_is_there(
    status: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise MemoryError

    outcome = SimpleNamespace(stop=SimpleNamespace(status=status))
    monkeypatch.setattr(module, "_driven", lambda *_: outcome)
    monkeypatch.setattr(module, "_evaluated", fails)
    with pytest.raises(RecordedError, match=r"run\.mcap; .* no memory left") as failed:
        module.one_run(None, Path("run.mcap"), None, diagnosis=False)  # type: ignore[arg-type]
    assert failed.value.exit_code == code
