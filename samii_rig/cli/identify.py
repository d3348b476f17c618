"""`samii-rig identify`: parameters of the rig's model from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import JsonOption, rig_of, say_json, without_rig
from samii_rig.cli.estimate import (
    GAPS,
    BandOption,
    Estimating,
    GapsOption,
    PoseOption,
    RigOverride,
    read_all,
)
from samii_rig.cli.options import takes
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import RenderableType

    from samii_rig.rig.schema import Rig
    from samii_rig.rig.schema.pose import Angle
    from samii_rig.types import Recording

    Identified = tuple[Any, Callable[[Any], RenderableType]]  # what was found, and its table


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    """Words of `samii-rig identify`."""

    logs: Annotated[
        list[Path] | None, typer.Argument(help="Recordings (.mcap).", show_default=False)
    ] = None
    rig: RigOverride = None
    modes: Annotated[
        list[Path] | None,
        typer.Option(
            help="Modes that modes --save kept, in place of recordings; with --rig. May be repeated"
        ),
    ] = None
    use: Annotated[
        str | None,
        typer.Option(
            help="Of --modes: residues (all), shapes (no calibrated input needed), or poles "
            "(frequencies and damping alone) [default: residues]"
        ),
    ] = None
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter to identify, as element.symbol; may be repeated. "
            "Without it all that the rig file gives a tolerance, which is then used as a prior."
        ),
    ] = None
    method: Annotated[
        str,
        typer.Option(
            help="likelihood, or the methods of paper 1: 1 (two frequencies and a zero), "
            "2 (braced base: a frequency and a mode shape ratio)."
        ),
    ] = "likelihood"
    output: Annotated[
        list[str] | None,
        typer.Option(
            help="Output channel; may be repeated. Methods 1 and 2: the accelerometers whose "
            "zero or mode shape ratio counts."
        ),
    ] = None
    pose: PoseOption = None
    gaps: GapsOption = "refuse"
    band: BandOption = None
    json: JsonOption = False


@takes(IdentifyOptions)
def identify(o: IdentifyOptions) -> None:
    """Identify parameters by maximum likelihood, with intervals and what cannot be known.

    All channels and levels count, in units of their noise. A model that does not fit is said so.
    Recordings in several poses share one set of parameters (docs/method/identify.md). With --modes:
    from measured modes, weighted by the covariance of their poles and residues.

    Example: samii-rig identify runs/*.mcap --free joint_1.k --free joint_2.k
    """
    from samii_rig.cli.arguments import check_band, check_choice, check_rig

    check_choice("--method", o.method, ("likelihood", "1", "2"))
    check_choice("--gaps", o.gaps, GAPS)
    check_choice("--use", o.use or "residues", ("residues", "shapes", "poles"))
    check_rig(o.rig)
    check_band(o.band)
    result, table = _of_modes(o, o.modes) if o.modes else _of_recordings(o)
    if o.json:
        say_json(result.plain())
        return

    from rich.console import Console

    Console(highlight=False).print(table(result))


def _of_recordings(o: IdentifyOptions) -> Identified:
    """By the likelihood, or by a method of paper 1."""
    logs = _checked(o)

    from samii_rig.identify.poses import poses_of

    recordings = read_all(logs)
    held = rig_of(recordings, o.rig)
    if held is None:
        raise without_rig()
    at = poses_of(recordings, held[0], o.pose or ())
    by = _by_likelihood if o.method == "likelihood" else _by_paper
    return by(o, recordings, held[0], at)


def _checked(o: IdentifyOptions) -> list[Path]:
    """The recordings, when everything beside them is possible."""
    from samii_rig.cli.arguments import check_channels, check_free, check_logs, check_poses

    if o.use:
        raise InputError("--use", "", o.use, "--modes FILE beside it: it is of modes")
    if not o.logs:
        raise InputError.saying("LOGS", "", "missing; expected recordings (.mcap) or --modes FILE")
    check_logs(o.logs)
    if o.method != "likelihood" and not o.free:
        raise InputError("--free", "", None, "what to identify, as --free ELEMENT.SYMBOL")
    check_free(o.free or (), o.rig, o.logs)
    check_poses(o.pose, o.rig, o.logs)
    check_channels("--output", o.output, o.logs)
    return o.logs


def _by_paper(
    o: IdentifyOptions, recordings: list[Recording], rig: Rig, at: list[Angle]
) -> Identified:
    from typing import cast

    from samii_rig.identify import methods
    from samii_rig.identify.poses import at_pose
    from samii_rig.identify.table import method_table
    from samii_rig.report.summary import working

    if len(set(at)) > 1:
        expected = "recordings in one pose, or --method likelihood"
        raise InputError("--method", "", o.method, expected)
    responses = Estimating(gaps=o.gaps, band=o.band).of(recordings)
    with working("identifying", quiet=o.json):
        found = methods.from_responses(
            cast("methods.Method", o.method), responses, at_pose(rig, at[0]), o.free or (),
            outputs=o.output, band=o.band,
        )  # fmt: skip
    return found, method_table


def _by_likelihood(
    o: IdentifyOptions, recordings: list[Recording], rig: Rig, at: list[Angle]
) -> Identified:
    from samii_rig.identify.maximum_likelihood import problem, solve
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.poses import by_pose
    from samii_rig.identify.table import summary_table
    from samii_rig.report.summary import working

    # Recordings of one pose are pooled.
    estimating = Estimating(output=o.output, gaps=o.gaps, band=o.band)
    in_pose = [(r, pose) for pose, alike in by_pose(recordings, at) for r in estimating.of(alike)]
    with working("identifying", quiet=o.json) as say:
        posed = problem(
            [response for response, _ in in_pose], rig, o.free or uncertain(rig),
            prior=not o.free, band=o.band, poses=[one for _, one in in_pose],
        )  # fmt: skip
        found = solve(posed, progress=say)
    return found, summary_table


def _of_modes(o: IdentifyOptions, files: list[Path]) -> Identified:
    """From saved modes."""
    from typing import cast

    from samii_rig.cli.arguments import check_free

    check_free(o.free or (), o.rig)

    from samii_rig.identify.from_modes import Use, identify_modes
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.table import from_modes_table
    from samii_rig.modal.saved import saved_modes
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig

    _no_recordings(o)
    if o.rig is None:
        raise InputError("--rig", "", None, "a rig: saved modes carry none")
    for i, path in enumerate(files):
        if path.resolve() in [other.resolve() for other in files[:i]]:
            raise InputError("--modes", "", str(path), "each file once, or its noise counts twice")
    saved = [level for path in files for level in saved_modes(path)]
    own = load_rig(o.rig)[0]
    with working("identifying", quiet=o.json):
        found = identify_modes(
            saved, own, o.free or uncertain(own), prior=not o.free,
            use=cast("Use", o.use or "residues"),
        )  # fmt: skip
    return found, from_modes_table


def _no_recordings(o: IdentifyOptions) -> None:
    """InputError for options that are for recordings alone."""
    given = (
        ("LOGS", o.logs and str(o.logs[0])),
        ("--output", o.output and o.output[0]),
        ("--pose", o.pose and o.pose[0]),
        ("--band", o.band),
        ("--method", None if o.method == "likelihood" else o.method),
        ("--gaps", None if o.gaps == "refuse" else o.gaps),
    )
    for option, value in given:
        if value:
            raise InputError(option, "", value, "none beside --modes: it is for recordings")
