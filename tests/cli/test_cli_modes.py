"""`samii-rig modes`: what it prints, writes and refuses, from recordings of known modes."""

import json
import re

import numpy as np
import pytest
from report_kit import Page
from scipy.signal import lfilter
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import SamiiRigError
from samii_rig.record.store import write_recording
from samii_rig.types import Channel, Recording, Segment, StopRecord

RATE = 200.0
HZ, ZETA = np.array([6.0, 17.0]), (0.02, 0.015)
SHAPES = ((1.0, 0.5), (-0.6, 1.0))


def recorded(path, higher=1.0):
    """A burst, three times, over two modes in closed form; all frequencies `higher` times."""
    n, repeats = 1600, 3
    t = np.arange(n) / RATE
    sweep = np.sin(2 * np.pi * (2.0 * t + 3.0 * t**2)) * (t > 0.1) * (t < 4.5)
    u = np.tile(sweep, repeats)
    y = 0.002 * np.random.default_rng(5).standard_normal((u.size, 2))
    for hz, zeta, shape in zip(HZ * higher, ZETA, SHAPES, strict=True):
        w = 2 * np.pi * hz
        a = w * (-zeta + 1j * np.sqrt(1 - zeta**2))
        z = np.exp(a / RATE)
        # One pole under a hold: x_k+1 = z x_k + (z - 1)/a u_k.
        x = lfilter([0.0, (z - 1) / a], [1.0, -z], u.astype(complex))
        y += 2 * (x[:, None] * np.array(shape) * w / (2j * a.imag)).real
    channels = (Channel("u", "N", "reference"), Channel("f", "N", "command"),
                Channel("a_1", "m/s^2"), Channel("a_2", "m/s^2"))  # fmt: skip
    at = np.arange(u.size, dtype=np.int64)
    values = np.column_stack([u, u, y])
    segments = tuple(
        Segment(f"burst_{k}", "burst", k * n, (k + 1) * n, 1.0, "N", k) for k in range(repeats)
    )
    recording = Recording(
        channels, RATE, at * 5_000_000, at, values, np.zeros(values.shape, np.uint8), segments,
        stop=StopRecord("completed", "all segments"),
    )  # fmt: skip
    write_recording(path, recording)
    return path


def call(*arguments):
    """Exit code and what was printed, as `samii-rig` itself would end."""
    result = CliRunner().invoke(app, ["modes", *map(str, arguments)])
    if isinstance(result.exception, SamiiRigError):
        return result.exception.exit_code, str(result.exception)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("modes") / "run.mcap")


def test_the_json_holds_the_modes_with_their_intervals(log):
    code, said = call(log, "--json")
    assert code == 0
    data = json.loads(said)
    assert set(data) == {"modes", "without", "written"}
    (level,) = data["modes"]
    assert level["outputs"] == ["a_1", "a_2"]
    assert "nothing divided out" in level["divided"]
    assert len(level["modes"]) == 2
    for mode, hz, zeta, shape in zip(level["modes"], HZ, ZETA, SHAPES, strict=True):
        low, high = mode["frequency_hz_90"]
        # Twice the interval's half width holds the truth but once in a thousand.
        assert abs(mode["frequency_hz"] - hz) < high - low
        low, high = mode["damping_90"]
        assert abs(mode["damping"] - zeta) < high - low
        assert mode["model"] is None
        there = mode["shape"]["a_2" if mode["reference"] == "a_1" else "a_1"]["real"]
        truth = shape[1] / shape[0] if mode["reference"] == "a_1" else shape[0] / shape[1]
        assert there == pytest.approx(truth, abs=0.02)


def test_the_terminal_shows_the_same(log):
    code, said = call(log)
    assert code == 0
    assert re.search(r"(5\.99|6\.00)\d* \u00b1", said)
    assert "\u00b1" in said
    assert "of what the command drives" in said


def test_another_recording_is_held_against_it(log, tmp_path):
    other = recorded(tmp_path / "other.mcap", higher=1.02)
    data = json.loads(call(log, "--against", other, "--json")[1])
    for mode in data["modes"][0]["modes"]:
        assert mode["against"]["differs"]
        assert mode["against"]["mac"] > 0.99
        ratio = mode["against"]["frequency_hz"] / mode["frequency_hz"]
        assert ratio == pytest.approx(1.02, abs=0.005)
    same = json.loads(call(log, "--against", log, "--json")[1])
    assert not any(mode["against"]["differs"] for mode in same["modes"][0]["modes"])


def test_the_page_shows_diagram_shapes_and_table_and_loads_nothing(log, tmp_path):
    page, figure = tmp_path / "modes.html", tmp_path / "modes.svg"
    code, said = call(log, "--out", page, "--figure", figure)
    assert code == 0
    assert f"written  {page}" in said.replace("\n", "")
    text = page.read_text(encoding="utf-8")
    parsed = Page(text)
    assert all(address.startswith("#") for address in parsed.addresses)
    assert {"data-poles-0", "data-shape-0", "data-shape-1"} <= set(parsed.scripts)
    diagram = json.loads(parsed.scripts["data-poles-0"])
    assert len(diagram["layout"]["shapes"]) == 2
    assert "shape, too" in [trace["name"] for trace in diagram["data"]]
    assert "sum of responses" in figure.read_text(encoding="utf-8")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["modes.html", "modes.svg"]


def test_a_person_may_pick(log):
    (level,) = json.loads(call(log, "--pick", "17.1", "--json")[1])["modes"]
    (mode,) = level["modes"]
    assert mode["frequency_hz"] == pytest.approx(17.0, rel=0.005)


BAD = {
    "a pick that is no number": (("--pick", "7.4,x"), "--pick is '7.4,x'"),
    "a pick where there is no pole": (("--pick", "11"), "expected a frequency next to a pole"),
    "an output that there is not": (("--output", "a_9"), "a_9"),
    "a page of another kind": (("--out", "modes.pdf"), "a name that ends in .html"),
    "a folder that there is not": (("--out", "nowhere/modes.html"), "in a folder that exists"),
    "a band without lines": (("--band", "6", "6.1"), "a wider band"),
    "another recording that there is not": (("--against", "none.mcap"), "none.mcap"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_line(log, case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options, words = BAD[case]
    code, said = call(log, *options)
    assert code == 2
    assert words in said
    assert "\n" not in said.strip().replace("modes ...\n", "")
    assert not list(tmp_path.iterdir())
