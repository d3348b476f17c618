"""The index of recordings says what is in the folder, at any time, whatever happened to it.

Plan: what is found by which question; that nothing but the folder decides what is in it (files
that come, change, go; remarks); damage of every kind is noticed and mended; several processes.
"""

from __future__ import annotations

import multiprocessing
import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from index_kit import lab, write_small
from mcap.opcode import Opcode
from record_kit import CHANNELS, RATE, block

from samii_rig.errors import InputError, RecordingError
from samii_rig.index.query import Query
from samii_rig.index.remarks import add_note, read_remarks, remarks_path, set_diagnosis, set_tags
from samii_rig.index.store import FILE, PRIVATE, Index, index_for_reading
from samii_rig.record import scan
from samii_rig.record.writer import Origin, RunWriter


def names(index: Index, **asked: str) -> list[str]:
    return [e.path for e in index.search(Query(**asked)).entries]  # type: ignore[arg-type]


@pytest.fixture
def index(tmp_path: Path) -> Index:
    lab(tmp_path)
    found = Index(tmp_path)
    done = found.refresh()
    assert (done.recordings, done.read, done.rebuilt) == (3, 3, False)
    return found


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, ["c.mcap", "march/b.mcap", "a.mcap"]),
        ({"rig": "samii"}, ["march/b.mcap", "a.mcap"]),
        ({"experiment": "swept_sine"}, ["c.mcap", "a.mcap"]),
        ({"operator": "ada", "rig": "SFLR"}, ["c.mcap"]),
        ({"status": "tripped"}, ["march/b.mcap"]),
        ({"since": "2026-03-01"}, ["c.mcap", "march/b.mcap", "a.mcap"]),
        ({"since": "2026-03-01T08:30:00"}, ["c.mcap", "march/b.mcap"]),
        ({"until": "2026-03-05"}, ["march/b.mcap", "a.mcap"]),
        ({"until": "2026-03-01T09:00:00+01:00"}, ["a.mcap"]),
        ({"text": "A_TIP limit"}, ["march/b.mcap"]),
        ({"text": "100%' OR 1=1 --"}, []),
    ],
)
def test_a_question_finds_what_fits_newest_first(
    index: Index, asked: dict[str, str], expected: list[str]
) -> None:
    assert names(index, **asked) == expected


def test_an_entry_says_what_the_recording_says(index: Index) -> None:
    (entry,) = index.search(Query(status="tripped")).entries
    assert entry.reason == "a_tip over its limit"
    assert (entry.samples, entry.rate_hz, entry.duration_s) == (30, RATE, 30 / RATE)
    assert entry.channels == tuple(c.name for c in CHANNELS)
    assert index.get(entry.id) == entry
    assert index.path_of(entry) == (index.folder / "march" / "b.mcap").resolve()
    assert index.get("0" * 16) is None


def test_pages_of_an_answer_make_the_whole(index: Index) -> None:
    pages = [index.search(Query(limit=1, offset=i)) for i in range(3)]
    assert [p.total for p in pages] == [3, 3, 3]
    assert [p.entries[0].path for p in pages] == names(index)


@pytest.mark.parametrize(
    ("field", "value"),
    [("since", "yesterday"), ("until", "2026-13-01"), ("limit", 0), ("offset", -1)],
)
def test_a_question_that_makes_no_sense_is_refused(index: Index, field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        index.search(Query(**{field: value}))  # type: ignore[arg-type]


def test_only_what_changed_is_read_again(index: Index) -> None:
    write_small(index.folder / "d.mcap")
    (index.folder / "a.mcap").unlink()
    done = index.refresh()
    assert (done.recordings, done.read, done.removed) == (3, 1, 1)
    assert set(names(index)) == {"c.mcap", "march/b.mcap", "d.mcap"}


def test_remarks_are_found_and_leave_the_recording_as_it_is(index: Index) -> None:
    path = index.folder / "a.mcap"
    before = path.read_bytes()
    set_tags(path, ["New clamp", "paper"])
    add_note(path, "Ada", "Bolts at 40 N m, joint 2 squeaks")
    set_diagnosis(path, {"verdict": "named", "mismatch": {"chi2_per_dof": float("inf")}})
    assert index.refresh().read == 1
    for asked in ({"tag": "paper"}, {"tag": "new clamp"}, {"text": "squeaks"}):
        assert names(index, **asked) == ["a.mcap"]
    assert names(index, verdict="named") == ["a.mcap"]
    assert names(index, tag="pap") == []
    assert path.read_bytes() == before
    assert read_remarks(path).diagnosis["mismatch"] == {"chi2_per_dof": None}


def test_remarks_of_one_recording_are_read_again_alone(index: Index) -> None:
    set_tags(index.folder / "a.mcap", ["x"])
    entry = index.update("a.mcap")
    assert entry is not None
    assert entry.tags == ("x",)
    assert names(index, tag="x") == ["a.mcap"]
    (index.folder / "a.mcap").unlink()
    assert index.update("a.mcap") is None
    assert "a.mcap" not in names(index)


@pytest.mark.parametrize("tag", ["", "../x", "a\nb", "x" * 41, "<b>"])
def test_a_tag_is_a_short_word(index: Index, tag: str) -> None:
    with pytest.raises(InputError, match="tag"):
        set_tags(index.folder / "a.mcap", [tag])


def test_damaged_remarks_are_said_and_never_overwritten(index: Index) -> None:
    beside = remarks_path(index.folder / "a.mcap")
    beside.write_text(
        '{"format": "samii-rig remarks 1", "tags": ["\\ud800"], "notes": [], "diagnosis": {}}'
    )
    index.refresh()
    assert any("is damaged" in e.problem for e in index.search(Query()).entries)
    beside.write_text("{")
    index.refresh()
    entry = next(e for e in index.search(Query()).entries if e.path == "a.mcap")
    assert "a.mcap.remarks.json is damaged" in entry.problem
    with pytest.raises(RecordingError, match="damaged"):
        add_note(index.folder / "a.mcap", "Ada", "x")
    assert beside.read_text() == "{"


def test_what_is_cut_off_or_foreign_is_listed_with_its_problem(index: Index) -> None:
    cut = RunWriter(index.folder / "cut.mcap", CHANNELS, RATE, Origin('name = "SAMII"\n'))
    cut.write(block(0, 30))
    cut.abort()
    (index.folder / "foreign.mcap").write_bytes(b"not one of ours")
    (index.folder / "empty.mcap").touch()
    index.refresh()
    assert names(index, status="unfinished") == ["cut.mcap.partial"]
    (entry,) = index.search(Query(status="unfinished")).entries
    assert (entry.rig, entry.samples) == ("SAMII", 30)
    assert "samii-rig recover" in entry.problem
    assert set(names(index, status="unreadable")) == {"foreign.mcap", "empty.mcap"}


def test_a_recording_whose_bytes_changed_is_listed_as_damaged(index: Index) -> None:
    whole = (index.folder / "a.mcap").read_bytes()
    chunk = next(
        s for s in scan.spans(memoryview(whole), 8, len(whole)) if s.opcode == Opcode.CHUNK
    )
    changed = bytearray(whole)
    changed[chunk.end - 1] ^= 1
    (index.folder / "changed.mcap").write_bytes(changed)
    (index.folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    index.refresh()
    found = {e.path: e for e in index.search(Query(status="damaged")).entries}
    assert set(found) == {"changed.mcap", "cut.mcap"}
    assert "samii-rig verify" in found["changed.mcap"].problem
    assert "samii-rig recover" in found["cut.mcap"].problem
    assert len(index.search(Query(status="completed")).entries) == 2


def test_a_folder_that_cannot_be_written_to_is_listed_nevertheless(tmp_path: Path) -> None:
    lab(tmp_path)
    (tmp_path / PRIVATE).write_text("in the way")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(RecordingError, match="cannot be written"):
        Index(tmp_path).refresh()
    with index_for_reading(tmp_path) as index:
        index.refresh()
        assert len(names(index)) == 3
    assert sorted(tmp_path.rglob("*")) == before


def test_an_index_that_is_there_is_used_where_it_cannot_be_written(
    index: Index, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(option: str, path: Path) -> None:
        raise InputError(option, "", str(path), "a place that can be written to")

    monkeypatch.setattr("samii_rig.index.store.check_folder", refused)
    with index_for_reading(index.folder) as found:
        assert found.refresh().read == 0
        assert len(names(found)) == 3


def test_a_recording_of_a_newer_version_says_so(
    index: Index, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("samii_rig.record.layout.FORMAT", "samii-rig recording 2")
        write_small(index.folder / "new.mcap")
    index.refresh()
    entry = next(e for e in index.search(Query()).entries if e.path == "new.mcap")
    assert entry.status == "unreadable"
    assert "written by a newer samii-rig" in entry.problem


def test_a_link_out_of_the_folder_is_not_followed(
    index: Index, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = write_small(tmp_path_factory.mktemp("elsewhere") / "secret.mcap")
    (index.folder / "link.mcap").symlink_to(elsewhere)
    index.refresh()
    entry = next(e for e in index.search(Query()).entries if e.path == "link.mcap")
    with pytest.raises(InputError, match="in the folder"):
        index.path_of(entry)


def database(index: Index) -> Path:
    return index.folder / PRIVATE / FILE


def cut_short(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def scribble(path: Path) -> None:
    path.write_bytes(b"\x00" * 100 + path.read_bytes()[100:])


def another_version(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()


def no_table(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE recording")
    connection.close()


def a_letter(path: Path) -> None:
    data = path.read_bytes()
    assert data.count(b"swept_sine") > 0
    path.write_bytes(data.replace(b"swept_sine", b"swept_sinx"))


@pytest.mark.parametrize("damage", [cut_short, scribble, another_version, no_table, a_letter])
def test_damage_to_the_index_is_noticed_and_mended(index: Index, damage) -> None:
    expected = index.search(Query())
    damage(database(index))
    assert index.refresh().rebuilt
    assert index.search(Query()) == expected


@pytest.mark.parametrize("damage", [cut_short, scribble, another_version, no_table])
def test_a_question_mends_a_broken_index_too(index: Index, damage) -> None:
    expected = index.search(Query())
    damage(database(index))
    assert index.search(Query()) == expected


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_bytes_change_the_answer_is_right(index: Index, data: st.DataObject) -> None:
    expected = index.search(Query())
    path = database(index)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    index.refresh()
    assert index.search(Query()) == expected


def _write_and_read(folder: Path, number: int) -> None:
    index = Index(folder)
    for i in range(5):
        write_small(folder / f"{number}-{i}.mcap", operator=str(number))
        index.refresh()
        # What the other saw half written may still stand there until it looks again.
        assert {f"{number}-{k}.mcap" for k in range(i + 1)} <= set(names(index, rig="SAMII"))


def test_several_processes_write_and_read_at_once(index: Index) -> None:
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_write_and_read, args=(index.folder, n)) for n in range(2)]
    for w in workers:
        w.start()
    for w in workers:
        w.join(60)
    assert [w.exitcode for w in workers] == [0, 0]
    index.refresh()
    assert index.search(Query()).total == 13


def test_the_folder_alone_decides(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    index = Index(tmp_path)
    there: set[str] = set()
    for i in range(12):
        if there and rng.random() < 0.4:
            gone = sorted(there)[int(rng.integers(len(there)))]
            (tmp_path / gone).unlink()
            there.discard(gone)
        else:
            write_small(tmp_path / f"{i}.mcap")
            there.add(f"{i}.mcap")
        index.refresh()
        assert set(names(index)) == there


def test_no_folder_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a folder of recordings"):
        Index(tmp_path / "missing")
