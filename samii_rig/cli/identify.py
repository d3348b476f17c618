"""`samii-rig identify`: parameters of the rig's model from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, rig_of, say_json, without_rig
from samii_rig.cli.estimate import (
    GAPS,
    BandOption,
    GapsOption,
    PoseOption,
    RigOverride,
    estimated,
    read_all,
)
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from samii_rig.rig.schema.pose import Angle
    from samii_rig.types import FrequencyResponse, Recording


def identify(
    logs: Annotated[
        list[Path] | None, typer.Argument(help="Recordings (.mcap).", show_default=False)
    ] = None,
    rig: RigOverride = None,
    modes: Annotated[
        list[Path] | None,
        typer.Option(
            help="Modes that modes --save kept, in place of recordings; with --rig. May be repeated"
        ),
    ] = None,
    use: Annotated[
        str | None,
        typer.Option(
            help="Of --modes: residues (all), shapes (no calibrated input needed), or poles "
            "(frequencies and damping alone) [default: residues]"
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter to identify, as element.symbol; may be repeated. "
            "Without it all that the rig file gives a tolerance, which is then used as a prior."
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="likelihood, or the methods of paper 1: 1 (two frequencies and a zero), "
            "2 (braced base: a frequency and a mode shape ratio)."
        ),
    ] = "likelihood",
    output: Annotated[
        list[str] | None,
        typer.Option(
            help="Output channel; may be repeated. Methods 1 and 2: the accelerometers whose "
            "zero or mode shape ratio counts."
        ),
    ] = None,
    pose: PoseOption = None,
    gaps: GapsOption = "refuse",
    band: BandOption = None,
    json: JsonOption = False,
) -> None:
    """Identify parameters by maximum likelihood, with intervals and what cannot be known.

    All channels and levels count, in units of their noise. A model that does not fit is said so.
    Recordings in several poses share one set of parameters (docs/method/identify.md). With --modes:
    from measured modes, weighted by the covariance of their poles and residues.

    Example: samii-rig identify runs/*.mcap --free joint_1.k --free joint_2.k
    """
    from samii_rig.cli.arguments import (
        check_band,
        check_channels,
        check_choice,
        check_free,
        check_logs,
        check_poses,
        check_rig,
    )

    check_choice("--method", method, ("likelihood", "1", "2"))
    check_choice("--gaps", gaps, GAPS)
    check_choice("--use", use or "residues", ("residues", "shapes", "poles"))
    check_rig(rig)
    check_band(band)
    if modes:
        given = {"LOGS": logs, "--output": output, "--pose": pose, "--band": band}
        given["--method"] = None if method == "likelihood" else [method]
        given["--gaps"] = None if gaps == "refuse" else [gaps]
        check_free(free or (), rig)
        _of_modes(modes, given, rig, free or (), use or "residues", json=json)
        return
    if use:
        raise InputError("--use", "", use, "--modes FILE beside it: it is of modes")
    if not logs:
        raise InputError.saying("LOGS", "", "missing; expected recordings (.mcap) or --modes FILE")
    check_logs(logs)
    if method != "likelihood" and not free:
        raise InputError("--free", "", None, "what to identify, as --free ELEMENT.SYMBOL")
    check_free(free or (), rig, logs)
    check_poses(pose, rig, logs)
    check_channels("--output", output, logs)

    from typing import cast

    from rich.console import Console

    from samii_rig.identify import methods
    from samii_rig.identify.maximum_likelihood import identify as maximum_likelihood
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.poses import at_pose, poses_of
    from samii_rig.identify.table import method_table, summary_table
    from samii_rig.report.summary import working

    recordings = read_all(logs)
    held = rig_of(recordings, rig)
    if held is None:
        raise without_rig()
    console = Console(highlight=False)
    at = poses_of(recordings, held[0], pose or ())
    if method != "likelihood":
        if len(set(at)) > 1:
            expected = "recordings in one pose, or --method likelihood"
            raise InputError("--method", "", method, expected)
        responses = estimated(recordings, None, None, "auto", gaps, band)
        with working(console, "identifying", quiet=json):
            by = methods.from_responses(
                cast("methods.Method", method), responses, at_pose(held[0], at[0]), free or (),
                outputs=output, band=band,
            )  # fmt: skip
        if json:
            say_json(by.plain())
        else:
            console.print(method_table(by))
        return
    in_pose = _in_poses(recordings, at, output, gaps, band)
    with working(console, "identifying", quiet=json) as say:
        found = maximum_likelihood(
            [response for response, _ in in_pose], held[0], free or uncertain(held[0]),
            prior=not free, band=band, poses=[one for _, one in in_pose],
            progress=say,
        )  # fmt: skip
    if json:
        say_json(found.plain())
    else:
        console.print(summary_table(found))


def _in_poses(
    recordings: list[Recording],
    at: list[Angle],
    output: list[str] | None,
    gaps: str,
    band: tuple[float, float] | None,
) -> list[tuple[FrequencyResponse, Angle]]:
    """Responses with the pose of their recordings; those of one pose are pooled."""
    from samii_rig.identify.poses import by_pose

    return [
        (r, pose)
        for pose, alike in by_pose(recordings, at)
        for r in estimated(alike, None, output, "auto", gaps, band)
    ]


def _of_modes(
    files: list[Path],
    given: Mapping[str, object],
    rig: str | None,
    free: Sequence[str],
    use: str,
    *,
    json: bool,
) -> None:
    """From saved modes. given : options that are for recordings alone."""
    from typing import cast

    from rich.console import Console

    from samii_rig.identify.from_modes import Use, identify_modes
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.table import from_modes_table
    from samii_rig.modal.saved import saved_modes
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig

    for option, value in given.items():
        if value:
            shown = value if isinstance(value, tuple) else str(value[0])  # type: ignore[index]
            raise InputError(option, "", shown, "none beside --modes: it is for recordings")
    if rig is None:
        raise InputError("--rig", "", None, "a rig: saved modes carry none")
    for i, path in enumerate(files):
        if path.resolve() in [other.resolve() for other in files[:i]]:
            raise InputError("--modes", "", str(path), "each file once, or its noise counts twice")
    saved = [level for path in files for level in saved_modes(path)]
    console = Console(highlight=False)
    own = load_rig(rig)[0]
    with working(console, "identifying", quiet=json):
        found = identify_modes(
            saved, own, free or uncertain(own), prior=not free, use=cast("Use", use)
        )
    if json:
        say_json(found.plain())
    else:
        console.print(from_modes_table(found))
