"""make.py sets up with nothing but Python: what an earlier attempt left does not stand in the way.

Plan: uv is asked first and pip where uv cannot; each says so in a line; what is half made is made
again; what is installed for these very files is not touched.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from conftest import ROOT
from wait_kit import WITHIN

sys.path.insert(0, str(ROOT))
import make

WHAT = ("--editable", ".")
PINNED = "--constraint constraints.txt"


@pytest.fixture
def called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """make.py with a uv and a pip that write down how they are called, and do not install."""
    calls = tmp_path / "calls"
    for name in ("uv", "python"):
        tool = tmp_path / name
        tool.write_text(f'#!/bin/sh\necho {name} "$@" >> {calls}\ntest ! -e {tmp_path}/no_{name}\n')
        tool.chmod(0o755)
    monkeypatch.setattr(make, "UV", tmp_path / "uv")
    monkeypatch.setattr(make, "PYTHON", tmp_path / "python")
    monkeypatch.setattr(make, "PIP", ("-m", "pip", "install"))
    return calls


def test_uv_installs_and_pip_is_not_asked(called: Path, tmp_path: Path, capsys) -> None:
    make.install(tmp_path / "python", *WHAT)
    (line,) = called.read_text().splitlines()
    assert line == f"uv pip install --quiet --python {tmp_path / 'python'} {PINNED} --editable ."
    assert capsys.readouterr().out == "make.py: installing by uv (10 to 60 s, once)\n"


def test_where_uv_cannot_pip_installs(called: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "no_uv").touch()
    make.install(tmp_path / "python", *WHAT)
    assert called.read_text().splitlines()[1:] == [f"python -m pip install {PINNED} --editable ."]
    assert "uv could not" in capsys.readouterr().out


def test_where_there_is_no_uv_pip_is_asked_for_it_then_installs(called: Path, tmp_path: Path):
    (tmp_path / "uv").unlink()
    make.install(tmp_path / "python", *WHAT)
    first, second = called.read_text().splitlines()
    assert first.startswith("python -m pip install --retries 1 ")
    assert first.endswith(f" {PINNED} uv")
    assert second == f"python -m pip install {PINNED} --editable ."


def test_where_neither_can_it_ends_with_their_exit_code(called: Path, tmp_path: Path) -> None:
    (tmp_path / "no_uv").touch()
    (tmp_path / "no_python").touch()
    with pytest.raises(SystemExit) as end:
        make.install(tmp_path / "python", *WHAT)
    assert end.value.code == 1


def test_an_environment_that_was_left_half_made_is_made_again(tmp_path: Path, monkeypatch) -> None:
    venv = tmp_path / ".venv"
    python = venv / make.PYTHON.relative_to(make.VENV)
    monkeypatch.setattr(make, "VENV", venv)
    monkeypatch.setattr(make, "PYTHON", python)
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    rest = venv / "rest of an earlier attempt"
    rest.touch()
    make.environment()  # what stands there is a Python, but not of this environment
    assert not rest.exists()
    assert make.run(python, "-m", "pip", "--version", quiet=True) == 0
    made = python.stat().st_ctime_ns
    make.environment()
    assert python.stat().st_ctime_ns == made


def test_others_leave_a_processor_to_the_last_until_it_ends(tmp_path: Path, capsys) -> None:
    if len(make.cpus()) < 2:
        pytest.skip("there is one processor here")
    begun, free = str(tmp_path / "begun"), min(make.cpus())
    # A process of a process, as a worker of pytest is, until it is moved; the last waits for it.
    inner = f"""
import os, pathlib, time
before = os.sched_getaffinity(0)
print(before, flush=True)
pathlib.Path({begun!r}).touch()
end = time.monotonic() + {WITHIN}
while os.sched_getaffinity(0) == before and time.monotonic() < end:
    time.sleep(0.01)
print(os.sched_getaffinity(0), flush=True)
"""
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}])"
    last = f"import os, time\nwhile not os.path.exists({begun!r}): time.sleep(0.01)"
    each = [sys.executable, "-c", outer], [sys.executable, "-c", last]
    assert make.side_by_side(*each, but=free) == [0, 0]
    before, after = capsys.readouterr().out.splitlines()
    assert before == str(make.cpus() - {free})
    assert after == str(make.cpus())
