"""Damaged files give an error of ours in one line, or load; a hundred thousand of each:
benchmarks/file_fuzz.py."""

import random

from file_fuzz_kit import buses, count, recordings, tables


def test_no_damaged_rig_experiment_or_map_file_escapes():
    c = count(tables(random.Random(3)), 800)
    assert not c.escaped
    assert c.loaded
    assert c.refused > 400


def test_no_damaged_recording_escapes(tmp_path):
    c = count(recordings(random.Random(3), tmp_path), 800)
    assert not c.escaped
    assert c.loaded > 100
    assert c.refused > 100


def test_no_damaged_dbc_file_escapes_or_takes_the_memory(tmp_path):
    c = count(buses(random.Random(3), tmp_path), 300)
    assert not c.escaped
    assert c.loaded > 30
    assert c.refused > 100
    assert c.grown < 100.0
