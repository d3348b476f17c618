"""`samii-rig modes`: frequencies, damping and shapes from recordings, with intervals."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import FIGURES, JsonOption, Logs, check_target, rig_of, say_json
from samii_rig.cli.estimate import (
    BandOption,
    GapsOption,
    InputOption,
    MethodOption,
    OutputOption,
    RigOverride,
    check_estimate,
    estimated,
    read_all,
)
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from samii_rig.types import FrequencyResponse


def modes(
    logs: Logs,
    rig: RigOverride = None,
    pick: Annotated[
        str,
        typer.Option(help="Take the poles next to these frequencies, Hz: 7.4,21.4 [default: all]"),
    ] = "",
    against: Annotated[
        list[Path] | None,
        typer.Option(help="Recording to compare the modes with; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The page (.html) with diagrams and shapes, replaced if it exists."),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="The last level's stabilisation diagram as .png, .svg or .pdf, replaced if it "
            "exists."
        ),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(
            help="The modes as data (.json), with residues and covariance, for identify --modes; "
            "replaced if it exists."
        ),
    ] = None,
    input_: InputOption = None,
    output: OutputOption = None,
    method: MethodOption = "auto",
    gaps: GapsOption = "refuse",
    band: BandOption = None,
    json: JsonOption = False,
) -> None:
    """Find the modes: natural frequencies, damping and shapes, with 90 % intervals.

    No person has to choose poles; with --pick one may. They are held against the rig's model.

    Example: samii-rig modes runs/*.mcap --out modes.html
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    others = against or []
    check_rig(rig)
    check_logs([*logs, *others])
    check_estimate(method, gaps, band, input_, output, [*logs, *others])
    wanted = _picked(pick)
    files = (
        ("--out", out, (".html",)),
        ("--figure", figure, FIGURES),
        ("--save", save, (".json",)),
    )
    for option, path, suffixes in files:
        if path is not None:
            check_target(option, path, suffixes, [*logs, *others])

    from json import dumps

    from rich.console import Console

    from samii_rig.record.export import replacing
    from samii_rig.report.figures import save_figure
    from samii_rig.report.modes import modes_of, modes_table
    from samii_rig.report.modes_page import modes_page
    from samii_rig.report.modes_plots import picture
    from samii_rig.report.summary import working

    console = Console(highlight=False)
    with ExitStack() as stack:
        # Opened first: a place that cannot be written to is said before the work, not after it.
        page, drawn, kept = (
            stack.enter_context(replacing(p)) if p else None for p in (out, figure, save)
        )
        recordings, compared = read_all(logs), read_all(others)
        held = rig_of(recordings, rig)
        with working(console, "modes", quiet=json) as say:
            say("frequency responses")
            responses = _ordered(estimated(recordings, input_, output, method, gaps, band))
            beside: Sequence[FrequencyResponse] = ()
            if compared:
                beside = _ordered(estimated(compared, input_, output, method, gaps, band))
            found, lost = modes_of(
                responses,
                held[0] if held else None,
                band=band,
                pick=wanted,
                against=beside,
                progress=say,
            )
        if not found:
            raise InputError.saying("modes", "", "; ".join(lost))
        if page is not None:
            text = modes_page(recordings, found, lost, held[0] if held else None)
            page.write_text(text, encoding="utf-8")
        if drawn is not None:
            save_figure(drawn, picture(found[-1].response, found[-1].found))
        if kept is not None:
            kept.write_text(dumps({"modes": [m.plain() for m in found]}), encoding="utf-8")
    written = [str(p) for p in (out, figure, save) if p]
    if json:
        say_json({"modes": [m.plain() for m in found], "without": list(lost), "written": written})
        return
    console.print(modes_table(found, lost), soft_wrap=True)
    for name in written:
        console.print(f"written  {name}", soft_wrap=True)


def _ordered(responses: Sequence[FrequencyResponse]) -> list[FrequencyResponse]:
    """By level, as on the report."""
    return sorted(responses, key=lambda r: (not math.isfinite(r.level), r.level))


def _picked(text: str) -> tuple[float, ...]:
    """Frequencies of `--pick`; InputError for what is none."""
    try:
        out = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        out = (math.nan,)
    if not all(math.isfinite(f) and f > 0 for f in out):
        raise InputError("--pick", "", text, "frequencies in Hz, for example 7.4,21.4")
    return out
