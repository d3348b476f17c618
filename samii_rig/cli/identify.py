"""`samii-rig identify`: parameters of the rig's model from recordings."""

from __future__ import annotations

from typing import Annotated

import typer

from samii_rig.cli.common import JsonOption, Logs, rig_of, say_json
from samii_rig.cli.estimate import (
    BandOption,
    GapsOption,
    OutputOption,
    RigOverride,
    estimated,
    read_all,
)


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
    output: OutputOption = None,
    gaps: GapsOption = "refuse",
    band: BandOption = None,
    json: JsonOption = False,
) -> None:
    """Identify parameters by maximum likelihood, with intervals and what cannot be known.

    All channels and levels count, in units of their noise. A model that does not fit is said so.

    Example: samii-rig identify runs/*.mcap --free joint_1.k --free joint_2.k
    """
    from rich.console import Console

    from samii_rig.errors import InputError
    from samii_rig.identify.maximum_likelihood import identify as maximum_likelihood
    from samii_rig.identify.parameters import uncertain
    from samii_rig.identify.table import summary_table

    recordings = read_all(logs)
    held = rig_of(recordings, rig)
    if held is None:
        raise InputError("--rig", "", None, "a rig: these recordings carry none")
    responses = estimated(recordings, None, output, "auto", gaps, band)
    console = Console(highlight=False)
    with console.status("identifying ..."):
        found = maximum_likelihood(
            responses, held[0], free or uncertain(held[0]), prior=not free, band=band
        )
    if json:
        say_json(found.plain())
    else:
        console.print(summary_table(found))
