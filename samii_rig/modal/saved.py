"""Modes as a file keeps them: poles and residues with the covariance of all of them together.

The numbers are mode by mode Re a, Im a (rad/s), then Re R, Im R of each entry, all inputs of the
first output first (rad/s times output over input). `samii-rig modes --save` writes what
`saved_modes` reads.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.modal.modes import ModalModel
from samii_rig.types import Complex, Float

RANK = 1e-10  # smallest over largest eigenvalue of the correlations, below which they are singular
EVEN = 1e-6  # of 1, difference of a correlation and its mirror image that is rounding
WHAT = "a file of `samii-rig modes --save`"


@dataclass(frozen=True, slots=True)
class SavedModes:
    """Modes of one response.

    where : the file. poles : (m,) rad/s. residues : (m, n_out, n_in). covariance : (n, n) of the
    numbers, n = m (2 + 2 n_out n_in). units : of the outputs. closed_loop, divided : as of
    `ModalModel`.
    """

    where: str
    level: float
    level_unit: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...]
    closed_loop: bool
    divided: str
    poles: Complex
    residues: Complex
    covariance: Float

    @property
    def name(self) -> str:
        """The level, which distinguishes it from the others."""
        return f"{self.level:g} {self.level_unit}"

    def numbers(self) -> Float:
        """(n,) as the covariance has them."""
        return numbers(self.poles, self.residues)


def numbers(poles: Complex, residues: Complex) -> Float:
    """(n,) real numbers of poles (m,) and residues (m, ...), in the order of the covariance."""
    each = np.concatenate([poles[:, None], residues.reshape(len(poles), -1)], axis=1)
    return np.stack([each.real, each.imag], axis=-1).reshape(-1)


def of_model(found: ModalModel) -> SavedModes:
    """The modes of a response, as a file would have them."""
    return SavedModes(
        where="modes",
        level=found.level,
        level_unit=found.level_unit,
        outputs=found.outputs,
        units=found.units,
        inputs=found.inputs,
        closed_loop=found.closed_loop,
        divided=found.divided,
        poles=found.poles,
        residues=found.residues,
        covariance=found.covariance,
    )


def saved_modes(path: Path) -> tuple[SavedModes, ...]:
    """The modes that a file holds, level by level; a level that shows none is left out.

    Raises InputError, in one line, for what is no such file.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(str(path), "", type(error).__name__, WHAT) from error
    rows = data.get("modes") if isinstance(data, dict) else None
    if not isinstance(rows, list) or not rows:
        raise InputError(str(path), "modes", type(rows).__name__, f"modes, {WHAT}")
    levels = [_level(f"{path}: modes[{i}]", row) for i, row in enumerate(rows)]
    found = tuple(level for level in levels if level.poles.size)
    if not found:
        raise InputError(str(path), "modes", "none at any level", "one mode or more")
    return found


def _level(where: str, row: Any) -> SavedModes:
    try:
        saved = SavedModes(
            where=where,
            level=float(row["level"]),
            level_unit=str(row["level_unit"]),
            outputs=tuple(map(str, row["outputs"])),
            units=tuple(map(str, row["units"])),
            inputs=tuple(map(str, row["inputs"])),
            closed_loop=bool(row["closed_loop"]),
            divided=str(row["divided"]),
            poles=_complex(row["poles"]),
            residues=_complex(row["residues"]),
            covariance=np.array(row["covariance"], float),
        )
    except (IndexError, KeyError, TypeError, ValueError) as error:
        what = f"{type(error).__name__} {error}"
        raise InputError(where, "", what, f"poles, residues and covariance of {WHAT}") from error
    if saved.poles.size:
        _check(saved)
    return saved


def _complex(pairs: Sequence[Any]) -> Complex:
    values = np.array(pairs, float)
    if not values.size:
        return np.zeros(values.shape[:-1] if values.ndim > 1 else (0,), np.complex128)
    if values.shape[-1] != 2:
        raise ValueError(f"{values.shape[-1]} numbers where a real and an imaginary part belong")
    return np.asarray(values[..., 0] + 1j * values[..., 1])


def _check(saved: SavedModes) -> None:
    shape = (len(saved.poles), len(saved.outputs), len(saved.inputs))
    if saved.residues.shape != shape or len(saved.units) != shape[1]:
        raise InputError(saved.where, "residues", saved.residues.shape, f"the shape {shape}")
    y, C = saved.numbers(), saved.covariance
    if C.shape != (y.size, y.size):
        raise InputError(saved.where, "covariance", C.shape, f"the shape {(y.size, y.size)}")
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(C))):
        raise InputError(saved.where, "covariance", "not finite", "finite numbers")
    if not np.all(saved.poles.imag > 0):
        bad = complex(saved.poles[int(np.argmin(saved.poles.imag))])
        raise InputError(saved.where, "pole", bad, "an imaginary part above 0")
    sd = np.sqrt(np.maximum(np.diag(C), 0.0))
    scaled = C / np.outer(sd, sd) if np.all(sd > 0) else np.zeros((1, 1))
    values = np.linalg.eigvalsh(scaled)
    even = np.allclose(scaled, scaled.T, rtol=0.0, atol=EVEN)
    if not (even and values[0] > RANK * values[-1]):
        what = "a covariance, symmetric and positive definite"
        raise InputError(saved.where, "covariance", "singular" if even else "not symmetric", what)
