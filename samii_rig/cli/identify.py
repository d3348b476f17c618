"""`samii-rig identify`: parameters of the rig's model from recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, Logs, rig_of, say_json, without_rig
from samii_rig.cli.estimate import (
    GAPS,
    BandOption,
    GapsOption,
    PoseOption,
    RigOverride,
    estimated,
    read_all,
)

if TYPE_CHECKING:
    from samii_rig.rig.schema.pose import Angle
    from samii_rig.types import FrequencyResponse, Recording


def identify(
    logs: Logs,
    rig: RigOverride = None,
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
    Recordings in several poses share one set of parameters (docs/identify.md).

    Example: samii-rig identify runs/*.mcap --free joint_1.k --free joint_2.k
    """
    from samii_rig.cli.arguments import check_choice, check_logs, check_rig

    check_choice("--method", method, ("likelihood", "1", "2"))
    check_rig(rig)
    check_logs(logs)
    check_choice("--gaps", gaps, GAPS)

    from typing import cast

    from rich.console import Console

    from samii_rig.errors import InputError
    from samii_rig.identify import methods
    from samii_rig.identify.maximum_likelihood import identify as maximum_likelihood
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.poses import at_pose, poses_of
    from samii_rig.identify.table import method_table, summary_table
    from samii_rig.report.summary import working

    if method != "likelihood" and not free:
        raise InputError("--free", "", None, "what to identify, for example --free joint_1.k")
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
