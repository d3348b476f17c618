"""What several commands share: output, options, the model over a measurement."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.plain import plain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from samii_rig.errors import InputError
    from samii_rig.record.reader import SavedResponses
    from samii_rig.report.compare import ModelCurve
    from samii_rig.rig.schema import Rig
    from samii_rig.types import FrequencyResponse, Recording


def rigs(incomplete: str) -> list[str]:
    """Names of shipped rigs, for a shell that completes; where none fits it takes files."""
    from samii_rig.rig.shipped import shipped

    return [name for name in shipped() if name.startswith(incomplete)]


def experiments(incomplete: str) -> list[str]:
    """Names of shipped experiments, likewise."""
    from samii_rig.run.catalogue import shipped

    return [name for name in shipped() if name.startswith(incomplete)]


RigOption = Annotated[
    str,
    typer.Option(
        "--rig", help="Name of a shipped rig, or the path of a rig file.", autocompletion=rigs
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object, for machines.")]
Logs = Annotated[list[Path], typer.Argument(help="Recordings (.mcap).", show_default=False)]

# What is drawn, and what samples are exported as, by the file's suffix.
FIGURES = (".png", ".svg", ".pdf")
SAMPLES = (".csv", ".parquet", ".mat", ".wav", ".uff", ".unv")

WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes; by default one a core.")]
SchedulerOption = Annotated[
    str, typer.Option(help="Address of a dask.distributed scheduler to run on instead.")
]


def check_target(
    option: str, path: Path, suffixes: Sequence[str], inputs: Sequence[Path] = ()
) -> None:
    """InputError unless `path` can be written, ends in one of `suffixes` and is none of the
    `inputs`. To be asked before the work whose result goes there."""
    from samii_rig.errors import InputError
    from samii_rig.files import check_file

    if path.suffix.lower() not in suffixes:
        *most, last = suffixes
        named = f"{', '.join(most)} or {last}" if most else last
        raise InputError(option, "", str(path), f"a name that ends in {named}")
    if any(path.exists() and i.exists() and path.samefile(i) for i in inputs):
        raise InputError(option, "", str(path), "another file than the recordings that are read")
    check_file(option, path)


def say_json(data: dict[str, Any]) -> None:
    """One JSON object on standard output; numbers that JSON has not become null."""
    json.dump(plain(data), sys.stdout, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def rig_of(
    recordings: Sequence[Recording | SavedResponses], option: str | None
) -> tuple[Rig, str] | None:
    """The rig to hold against recordings: the one asked for, else the one they carry.

    InputError if a channel of theirs measures another quantity than the rig's of that name.
    """
    from samii_rig.rig.load import load_rig, parse
    from samii_rig.rig.schema import Rig

    if option:
        held = load_rig(option)
    else:
        text = next((r.rig_toml for r in recordings if r.rig_toml), "")
        if not text:
            return None
        held = parse(Rig, text, "the recording's rig file"), text
    _check_units(recordings, held[0])
    return held


def _check_units(recordings: Sequence[Recording | SavedResponses], rig: Rig) -> None:
    """Counts that nobody scaled, held against radians, would be minutes of work for nothing. What
    is a factor off, as g from m/s^2, the diagnosis sees by itself."""
    from samii_rig.errors import InputError
    from samii_rig.types import Recording
    from samii_rig.units import factor

    units = rig.units()
    for r in recordings:
        if isinstance(r, Recording):
            channels = r.channels
        else:
            channels = tuple(c for x in r.responses for c in (*x.inputs, *x.outputs))
        for c in channels:
            wanted = units.get(c.name, c.unit)
            if c.unit and c.unit != wanted and factor(c.unit, wanted) is None:
                remedy = "give unit and scale in the map of samii-rig import"
                expected = f"{wanted!r}, as in the rig {rig.name!r}; {remedy}"
                raise InputError(r.source, f"channel {c.name}: unit", c.unit, expected)


def without_rig() -> InputError:
    """What is said where a model is needed and nobody named one."""
    from samii_rig.errors import InputError

    none = "these recordings carry no rig file; expected its name or path (docs/reference/rig.md)"
    return InputError.saying("--rig", "", none)


def comparisons(
    responses: Sequence[FrequencyResponse], curve: ModelCurve | None
) -> list[dict[str, Any]]:
    """Model over measurement for every output and level, as plain data."""
    from dataclasses import asdict

    from samii_rig.report.compare import compare

    return [asdict(c) for r in responses if curve for c in compare(r, curve, among=len(responses))]


def response_json(r: FrequencyResponse) -> dict[str, Any]:
    """What one frequency response is, without its lines: those are for `frf --export`."""
    return {
        "inputs": [c.name for c in r.inputs],
        "outputs": [c.name for c in r.outputs],
        "level": r.level,
        "level_unit": r.level_unit,
        "lines": len(r.frequency),
        "low_hz": r.frequency[0],
        "high_hz": r.frequency[-1],
        "method": r.method,
        "why": r.why,
        "n_averages": r.n_averages,
        "findings": [f.message for f in r.findings],
    }
