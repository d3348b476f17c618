"""Every notebook runs from its first cell to its last, shows what it says, and keeps no output.

The code cells are executed one after another in a namespace of their own, and the value of each
cell's last expression is made into what a notebook would show.
"""

import ast
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from few_kit import only

from samii_rig.model.modes import natural_frequencies

Names = dict[str, Any]
# What a clamp can give; `prove` and docs/evidence/proof.md are of the whole vocabulary.
CLAMP = ("translational_compliance", "torsional_compliance")

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def cells(path: Path, kind: str) -> list[str]:
    read = json.loads(path.read_text("utf-8"))
    assert (read["nbformat"], read["nbformat_minor"]) == (4, 5)
    return ["".join(c["source"]) for c in read["cells"] if c["cell_type"] == kind]


def run(code: str, namespace: Names) -> object:
    """Execute a cell; the value of its last expression, None where it ends in a statement."""
    body = ast.parse(code).body
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), "<cell>", "exec"), namespace)
    if last is None:
        return None
    return eval(compile(ast.Expression(last.value), "<cell>", "eval"), namespace)


def shown(value: object) -> str:
    """What a notebook shows of a value."""
    if hasattr(value, "to_plotly_json"):
        return value.to_html(full_html=False, include_plotlyjs=False)
    return value._repr_html_() if hasattr(value, "_repr_html_") else repr(value)


def sweep(n: Names) -> bool:
    """The model that simulated it lies within the noise."""
    model = n["curve"](n["rig"], "SAMII", [n["response"]])
    return all(c.agrees for c in n["compare"](n["response"], model))


def modes(n: Names) -> bool:
    """Paper 1, Table I and III."""
    first = [natural_frequencies(n[rig], 0.3, 30.0).hz[:2] for rig in ("rigid", "flexible")]
    return np.allclose(first, [[2.299, 21.417], [1.703, 7.394]], rtol=0.002)


def concealed(n: Names) -> bool:
    """Fourteen sigma: the name is found, or stands among what the data do not tell from it."""
    (hidden,) = n["truth"]["effects"]
    causes = [(c.physics, c.site) for c in n["found"].causes]
    named = [*causes, *(e for c in n["found"].causes for e in c.equivalents)]
    return (hidden["physics"], hidden["site"]) in named


def joint(n: Names) -> bool:
    """Within three times the 90 % interval: a true interval misses that once in a million."""
    half = (n["high"][0] - n["low"][0]) / 2
    return abs(n["found"].value("joint_1.k") - 13600.0) < 3 * half


def elsewhere(n: Names) -> bool:
    same = np.array_equal(n["back"]["H"], n["response"].H)
    return same and bool(n["lines"]["H"].shape == n["response"].H.shape)


SAYS = dict(zip("12345", (sweep, modes, concealed, joint, elsewhere), strict=True))


def test_there_are_five() -> None:
    assert [p.name[0] for p in NOTEBOOKS] == list("12345")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_keeps_no_output(path: Path) -> None:
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        assert cell.get("outputs", []) == []
        assert cell.get("execution_count") is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if path.name[0] == "5":
        pytest.importorskip("xarray")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    only(monkeypatch, *((physics, "clamp") for physics in CLAMP))
    namespace: Names = {"__name__": "__main__"}
    for code in cells(path, "code"):
        value = run(code, namespace)
        if value is not None:
            assert shown(value)
    assert capsys.readouterr().out
    assert SAYS[path.name[0]](namespace)
