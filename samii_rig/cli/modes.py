"""`samii-rig modes`: frequencies, damping and shapes from recordings, with intervals."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import FIGURES, JsonOption, Logs, check_target, rig_of, say_json
from samii_rig.cli.estimate import Estimating, RigOverride, read_all, say_written
from samii_rig.cli.options import takes
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from samii_rig.report.modes import Modes
    from samii_rig.types import FrequencyResponse


@dataclass(frozen=True, kw_only=True)
class ModesOptions(Estimating):
    """Words of `samii-rig modes`."""

    logs: Logs
    rig: RigOverride = None
    pick: Annotated[
        str,
        typer.Option(help="Take the poles next to these frequencies, Hz: 7.4,21.4 [default: all]"),
    ] = ""
    against: Annotated[
        list[Path] | None,
        typer.Option(help="Recording to compare the modes with; may be repeated."),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(help="The page (.html) with diagrams and shapes, replaced if it exists."),
    ] = None
    figure: Annotated[
        Path | None,
        typer.Option(
            help="The last level's stabilisation diagram as .png, .svg or .pdf, replaced if it "
            "exists."
        ),
    ] = None
    save: Annotated[
        Path | None,
        typer.Option(
            help="The modes as data (.json), with residues and covariance, for identify --modes; "
            "replaced if it exists."
        ),
    ] = None
    json: JsonOption = False

    @property
    def every(self) -> list[Path]:
        """Recordings, and those they are compared with."""
        return [*self.logs, *(self.against or [])]


@takes(ModesOptions)
def modes(o: ModesOptions) -> None:
    """Find the modes: natural frequencies, damping and shapes, with 90 % intervals.

    No person has to choose poles; with --pick one may. They are held against the rig's model.

    Example: samii-rig modes runs/*.mcap --out modes.html
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    check_rig(o.rig)
    check_logs(o.every)
    o.check(o.every)
    wanted = _picked(o.pick)
    files = (
        ("--out", o.out, (".html",)),
        ("--figure", o.figure, FIGURES),
        ("--save", o.save, (".json",)),
    )
    for option, path, suffixes in files:
        if path is not None:
            check_target(option, path, suffixes, o.every)

    from rich.console import Console

    from samii_rig.report.modes import modes_table

    console = Console(highlight=False)
    found, lost = _found(o, wanted)
    written = [str(p) for p in (o.out, o.figure, o.save) if p]
    if o.json:
        say_json({"modes": [m.plain() for m in found], "without": list(lost), "written": written})
        return
    console.print(modes_table(found, lost), soft_wrap=True)
    say_written(console, written)


def _found(o: ModesOptions, wanted: Sequence[float]) -> tuple[Sequence[Modes], Sequence[str]]:
    """The modes, written where it is asked for, and what has none in words."""
    from json import dumps

    from samii_rig.record.export import replacing
    from samii_rig.report.figures import save_figure
    from samii_rig.report.modes import modes_of
    from samii_rig.report.modes_page import modes_page
    from samii_rig.report.modes_plots import picture
    from samii_rig.report.summary import working

    with ExitStack() as stack:
        # Opened first: a place that cannot be written to is said before the work, not after it.
        page, drawn, kept = (
            stack.enter_context(replacing(p)) if p else None for p in (o.out, o.figure, o.save)
        )
        recordings, compared = read_all(o.logs), read_all(o.against or [])
        held = rig_of(recordings, o.rig)
        with working("modes", quiet=o.json) as say:
            say("frequency responses")
            found, lost = modes_of(
                _ordered(o.of(recordings)),
                held[0] if held else None,
                band=o.band,
                pick=wanted,
                against=_ordered(o.of(compared)) if compared else (),
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
    return found, lost


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
