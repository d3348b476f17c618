"""Responses to several inputs in files: every entry under the names of its output and input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from record_kit import response

from samii_rig.errors import RecordingError
from samii_rig.record import cdr
from samii_rig.record import response as message
from samii_rig.record.export import export_response, table
from samii_rig.record.uff.file import UffFile
from samii_rig.report.figures import bode_figure
from samii_rig.report.notebook import bode
from samii_rig.signal.coherence import partial_coherence
from samii_rig.types import Channel, FrequencyResponse

N = 7


@pytest.fixture
def two() -> FrequencyResponse:
    """2 outputs x 2 inputs, noise and distortion apart."""
    rng = np.random.default_rng(5)
    half = rng.normal(size=(N, 4, 6)) + 1j * rng.normal(size=(N, 4, 6))
    one = response(n=N)
    return replace(
        one,
        H=rng.normal(size=(N, 2, 2)) + 1j * rng.normal(size=(N, 2, 2)),
        covariance=0.01 * half @ half.conj().transpose(0, 2, 1),
        inputs=(one.inputs[0], Channel("v_3", "V", "command")),
        input_rms=rng.uniform(size=(N, 2)),
        odd=None,
        noise=rng.uniform(size=(N, 2)),
        distortion=rng.uniform(size=(N, 2)),
    )


def test_a_message_gives_back_every_entry_and_its_names(two):
    back = message.decode(message.encode(two))
    for name in ("frequency", "H", "covariance", "dof", "coherence", "input_rms", "noise"):
        np.testing.assert_array_equal(getattr(back, name), getattr(two, name))
    np.testing.assert_array_equal(back.distortion, two.distortion)
    assert back.odd is None
    assert [c.name for c in back.inputs] == [two.inputs[0].name, "v_3"]
    assert back.outputs == two.outputs


@pytest.mark.parametrize("fewer", [3, 5])
def test_a_message_of_an_older_layout_can_be_read(fewer):
    """From before inputs were told that nothing drives, and before noise and distortion were."""
    kinds = [kind for kind, _, _ in message._FIELDS]
    one = response(n=N)
    older = cdr.encode(kinds[:-fewer], cdr.decode(kinds, message.encode(one))[:-fewer])
    back = message.decode(older)
    assert back.followers == ()
    np.testing.assert_array_equal(back.H, one.H)
    np.testing.assert_array_equal(back.odd, one.odd)
    assert back.noise is None
    with pytest.raises(RecordingError, match="ends before its last field"):
        message.decode(older[:-9])


def test_a_table_names_each_entry(two):
    names, values = table(two)
    u = two.inputs[0].name
    y = two.outputs[0].name
    columns = dict(zip([n.split(" [")[0] for n in names], values.T, strict=True))
    np.testing.assert_array_equal(columns[f"Re H {y}/v_3"], two.H[:, 0, 1].real)
    np.testing.assert_array_equal(columns[f"Im C {y}/{u}, {y}/v_3"], two.covariance[:, 0, 1].imag)
    np.testing.assert_array_equal(columns["noise a"], two.noise[:, 1])
    np.testing.assert_array_equal(columns["distortion a"], two.distortion[:, 1])
    expected = partial_coherence(two)[:, 1, 1]
    np.testing.assert_array_equal(columns["partial coherence a/v_3"], expected)
    assert columns["amplitude v_3"][0] == two.input_rms[0, 1]


def test_arrays_and_python_control_keep_the_axes(two, tmp_path):
    held = np.load(export_response(tmp_path / "two.npz", two))
    np.testing.assert_array_equal(held["H"], two.H)
    np.testing.assert_array_equal(held["covariance"], two.covariance)
    assert list(held["inputs"]) == [c.name for c in two.inputs]
    assert held["partial_coherence"].shape == (N, 2, 2)
    frd = two.to_control()
    assert frd.input_labels == [c.name for c in two.inputs]
    assert frd.output_labels == [c.name for c in two.outputs]
    at = frd(2j * np.pi * two.frequency[3])
    np.testing.assert_allclose(at, two.H[3])


def test_a_universal_file_holds_each_entry_and_both_coherences(two, tmp_path):
    path = export_response(tmp_path / "two.uff", two)
    sets = [s.fields for s in UffFile(path)]
    kinds = [int(f["function_type"]) for f in sets]
    assert kinds.count(4) == 4
    assert kinds.count(21) == 4
    assert kinds.count(26) == 2
    last = next(f for f in sets if f["function_type"] == 4 and f["id1"] == "FRF a/v_3")
    np.testing.assert_allclose(last["data"], two.H[:, 1, 1])


def test_figures_show_every_input(two):
    figure = bode_figure([two])
    titles = {a.get_title() or a.get_ylabel() for a in figure.axes}
    assert len(figure.axes) == 8
    assert any("v_3" in t for t in titles)
    drawn = bode([two], output="a", input="v_3")
    assert any("partial" in str(t.name) for t in drawn.data)
