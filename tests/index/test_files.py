"""Files that are none, and places that cannot be written to, cost a line and no time.

Plan: a pipe, a socket or a folder under the name of a recording, of its remarks or of a rig file
is named and holds nobody up; every command looks at where its results go before it reads anything,
and leaves nothing there when it fails.
"""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from record_kit import blocks, write_run
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError, RecordingError, SamiiRigError
from samii_rig.files import check_file, check_folder, make_folder, open_file
from samii_rig.index.query import Query
from samii_rig.index.remarks import remarks_path, set_tags
from samii_rig.index.store import Index
from samii_rig.record.reader import read_recording
from samii_rig.record.verify import verify
from samii_rig.rig.load import load_rig

PATIENCE = 20  # s after which whatever waits is ended; all of it takes milliseconds


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError("it waits for a pipe")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def a_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the whole path is too long for the address of a socket
    try:
        with socket.socket(socket.AF_UNIX) as s:
            s.bind(path.name)
    finally:
        os.chdir(here)


def refused(*arguments: object) -> str:
    """The one line of a command that ends with exit code 2."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert isinstance(result.exception, SamiiRigError), (result.output, result.exception)
    assert result.exception.exit_code == 2
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.mark.parametrize(("make", "kind"), [(os.mkfifo, "pipe"), (a_socket, "socket")])
def test_what_is_no_file_is_named_and_holds_nobody_up(
    tmp_path: Path, make: Callable[[Path], None], kind: str
) -> None:
    odd = tmp_path / "x.mcap"
    make(odd)
    with pytest.raises(OSError):  # noqa: PT011  # its words are the callers' business
        open_file(odd)
    for look in (read_recording, lambda path: set_tags(path, ["a"])):
        with pytest.raises(RecordingError, match=kind):
            look(odd)
    assert kind in verify(odd).problems[0]
    with pytest.raises(InputError, match=kind):
        load_rig(str(odd))
    assert kind in refused("import", odd, "--map", "sflr", "--out", tmp_path / "out")
    index = Index(tmp_path)
    index.refresh()
    (entry,) = index.search(Query()).entries
    assert entry.status == "unreadable"
    assert kind in entry.problem


def test_remarks_that_are_no_file_are_a_problem_of_their_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, blocks())
    os.mkfifo(remarks_path(path))
    index = Index(tmp_path)
    index.refresh()
    (entry,) = index.search(Query()).entries
    assert entry.status == "completed"
    assert "pipe" in entry.problem


COMMANDS = [
    ("import no.csv --map sflr --out {folder}", "folder"),
    ("recover no.mcap --out {file}", "file"),
    ("frf no.mcap --export {file}.csv", "file"),
    ("frf no.mcap --save {file}.mcap", "file"),
    ("report no.mcap --out {file}.html", "file"),
    ("modes no.mcap --out {file}.html", "file"),
    ("modes no.mcap --figure {file}.svg", "file"),
    ("report no.mcap --figure {file}.svg", "file"),
    ("diagnose no.mcap --out {folder}", "folder"),
    ("diagnose no.mcap --each --out {folder}", "folder"),
    ("study --vary joint_1.k=1:2:3 --out {file}.csv", "file"),
    ("study --vary joint_1.k=1:2:3 --plot {file}.svg", "file"),
    ("papers table-1 --out {folder}", "folder"),
    ("prove --rig no.toml --out {folder}", "folder"),
    ("prove --rig no.toml --calibrate {file}.toml", "file"),
    ("control --rig no.toml --out {folder}", "folder"),
    ("run no --out {folder}/run.mcap", "folder"),
    ("jog --rig no.toml --out {folder}", "folder"),
    ("doctor --move --rig no.toml --out {folder}", "folder"),
    ("calibrate null --rig no.toml --to {file}.toml", "file"),
    ("calibrate null --rig no.toml --to new.toml --out {folder}", "folder"),
]


@pytest.mark.parametrize(("command", "kind"), COMMANDS)
def test_a_place_that_cannot_be_written_to_is_said_before_the_work(
    command: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What else the command needs is there and worth nothing: it has not been read yet."""
    monkeypatch.chdir(tmp_path)
    given = ("no.csv", "no.mcap", "no.toml", "no")
    for name in given:
        (tmp_path / name).write_text("nothing")
    afile = tmp_path / "afile"
    afile.write_text("kept")
    places = {"folder": "afile", "file": "nowhere/name"}
    said = refused(*command.format(**places).split())
    assert said.split()[0] in ("--out", "--export", "--save", "--figure", "--plot", "--to") or (
        said.startswith("--calibrate")
    ), said
    assert ("afile" if kind == "folder" else "nowhere") in said
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*given, "afile"])
    assert afile.read_text() == "kept"


def test_a_place_that_can_be_written_to_is_left_as_it_is(tmp_path: Path) -> None:
    check_folder("--out", tmp_path / "a" / "b")
    check_file("--out", tmp_path / "c.csv")
    assert not list(tmp_path.iterdir())
    make_folder("--out", tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_each_way_in_which_a_place_can_be_wrong_has_its_words(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for check, name, words in (
        (check_folder, "file", "this is a file"),
        (check_folder, "file/below", "file is a file"),
        (check_folder, "pipe", "this is a file"),
        (check_file, "no/name", "a name in a folder that exists"),
        (check_file, "pipe", "this is a pipe or a device"),
        (check_file, ".", "this is a folder"),
    ):
        with pytest.raises(InputError, match=words):
            check("--out", tmp_path / name)
    # A file system that is no place for files, whoever asks.
    for check in (check_folder, check_file):
        with pytest.raises(InputError, match="a place that can be written to"):
            check("--out", Path("/proc/page.html"))
