"""What the terminal shows: live progress of the whole plan, then a summary in few lines."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from samii_rig.progress import Aside, Counted, Pace, duration
from samii_rig.report.compare import Comparison, ModelCurve, compare, percent
from samii_rig.report.entries import channels, entries, showing
from samii_rig.report.facts import names
from samii_rig.report.modes import Modes, modes_table
from samii_rig.report.plots import unit
from samii_rig.report.verdicts import Verdict, verdicts
from samii_rig.types import FrequencyResponse, Recording
from samii_rig.units import pretty

if TYPE_CHECKING:  # it compiles the model, which showing needs not
    from samii_rig.run.dryrun import DryRun

_STYLES = {"good": "green", "found": "blue", "note": "blue", "warning": "yellow", "bad": "bold red"}
_WORDS = {"good": "good", "found": "found", "note": "note", "warning": "look", "bad": "ATTENTION"}
_WHERE = 20  # characters of a segment's name that fit beside the rest; what tells is its end
_MARGIN_CLOSE = 0.2  # of a limit left: shown as close
_BAR = 30  # characters
KERNELS = logging.getLogger("samii_rig.model.kernels")


class ProgressLike(Protocol):
    """How far a run is: the fields of `samii_rig.run.progress.Progress` that are shown."""

    @property
    def segment(self) -> int:
        """1-based, of `n_segments`."""

    @property
    def n_segments(self) -> int:
        """Of the whole plan."""

    @property
    def name(self) -> str:
        """Name of the segment."""

    @property
    def level(self) -> float:
        """Amplitude of the segment in `unit`."""

    @property
    def unit(self) -> str:
        """Unit of `level`."""

    @property
    def time_left(self) -> float:
        """s."""

    @property
    def frequency(self) -> float:
        """Hz now, NaN at rest, inf where the whole band is driven at once."""

    @property
    def worst_channel(self) -> str:
        """The channel that came nearest to its limit, "" for none."""

    @property
    def worst_margin(self) -> float:
        """1 - |value|/limit of that channel."""


def progress_line(progress: ProgressLike, total_s: float, of: str = "") -> RenderableType:
    """One line of bar and one of words: `sweep 3/9 ... 41 s left, 12.3 Hz at 2 V, ...`.

    of : said after the time that is left.
    """
    p = progress
    done = max(0.0, min(1.0, 1 - p.time_left / total_s)) if total_s > 0 else 1.0
    head = Table.grid(padding=(0, 1))
    head.add_row(
        f"{p.name} {p.segment}/{p.n_segments}",
        ProgressBar(total=1.0, completed=done, width=_BAR),
        f"{percent(done)}",
        f"{duration(max(p.time_left, 0.0))}{of} left",
    )
    now = "at rest" if math.isnan(p.frequency) else f"{p.frequency:.2f} Hz"
    now = "the whole band" if math.isinf(p.frequency) else now
    words = Text(f"{now} at {p.level:g} {pretty(p.unit)}")
    if p.worst_channel:
        style = "green" if p.worst_margin > _MARGIN_CLOSE else "yellow"
        style = "bold red" if p.worst_margin <= 0 else style
        words.append("; nearest to a limit so far: ")
        words.append(f"{p.worst_channel}, {percent(p.worst_margin)} left", style=style)
    return Group(head, words)


class LiveProgress:
    """Shows a run while it goes; call it with each progress report.

    >>> with LiveProgress(console, total_s=180.0) as show:   # doctest: +SKIP
    ...     run(plan, rig, device, sink, progress=show)

    Without a terminal (a pipe, a log file) it prints one plain line a segment instead.
    """

    def __init__(self, console: Console, total_s: float, clock: str = "") -> None:
        """clock : whose time is left, where it is not that of who waits."""
        self._console, self._total = console, total_s
        self._of = f" of {clock}" if clock else ""
        self._live = Live(console=console, refresh_per_second=4, transient=True)
        self._segment = 0

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def __call__(self, progress: ProgressLike) -> None:
        """Show `progress`."""
        if self._console.is_terminal:
            self._live.update(progress_line(progress, self._total, self._of))
        elif progress.segment != self._segment:
            self._segment = progress.segment
            self._console.print(
                f"{progress.segment}/{progress.n_segments} {progress.name}, "
                f"{progress.level:g} {pretty(progress.unit)}, "
                f"{duration(progress.time_left)}{self._of} left",
                highlight=False,
            )


@contextmanager
def working(
    what: str, *, quiet: bool = False, console: Console | None = None
) -> Iterator[Callable[[str], None]]:
    """Say what is being done and for how long; what is given says what comes next.

    Without a terminal it is one line for each stage that begins, whatever is counted in it: a log
    is read for the answer below.
    quiet : say nothing. console : where it is said, the error output if None.
    """
    console = console or Console(stderr=True)
    pace = Pace()
    if quiet:
        yield lambda stage: None
    elif console.is_terminal:
        columns = SpinnerColumn(), TextColumn("{task.description} ..."), TimeElapsedColumn()
        with Progress(*columns, console=console, transient=True) as shown:
            task = shown.add_task(what, total=None)
            with _compiling(
                lambda stage: shown.update(task, description=f"{what}: {pace.words(stage)}")
            ) as say:
                yield say
    else:
        begun, last = time.monotonic(), ""

        def say_line(stage: str) -> None:
            nonlocal last
            now, words = time.monotonic(), pace.words(stage)
            name = stage.stage if isinstance(stage, Counted) else stage.partition(",")[0]
            if name != last:
                last = name
                line = f"{what}: {words} ... (after {duration(now - begun)})"
                console.print(line, highlight=False, soft_wrap=True)

        console.print(f"{what} ...", highlight=False)
        with _compiling(say_line) as say:
            yield say


@contextmanager
def _compiling(say: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Say it, too, when the kernels are compiled meanwhile."""

    class Heard(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            say(Aside(record.getMessage()))

    heard = Heard()
    KERNELS.addHandler(heard)
    try:
        yield say
    finally:
        KERNELS.removeHandler(heard)


def summary(
    recordings: Sequence[Recording],
    responses: Sequence[FrequencyResponse],
    model: ModelCurve | None = None,
    band_hz: tuple[float, float] = (0.0, math.inf),
    modes: Sequence[Modes] = (),
) -> RenderableType:
    """The verdicts, the modes, and a table of model over measurement, per level and output."""
    responses = sorted(responses, key=lambda r: (not math.isfinite(r.level), r.level))
    compared = [
        compare(r, model, band_hz, len(responses)) if model is not None else () for r in responses
    ]
    found = [c for of_one in compared for c in of_one]
    parts: list[RenderableType] = [verdict_line(v) for v in verdicts(recordings, responses, found)]
    notes = dict.fromkeys(f.message for r in responses for f in r.findings if f.severity == "note")
    parts += [Text.assemble((f"{'note':<9} ", _STYLES["note"]), message) for message in notes]
    if modes:
        parts += [Text(""), modes_table(modes)]
    if found:
        parts += [Text(""), _comparisons(responses, compared)]
    return Group(*parts)


def _comparisons(
    responses: Sequence[FrequencyResponse], compared: Sequence[Sequence[Comparison]]
) -> Table:
    """One row a level of each output; `compared` holds those of each response."""
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for name in ("response", "level", "model/measured", "lines outside 90 %"):
        table.add_column(name, overflow="fold")
    for entry in entries(responses):
        shown = f"{'/'.join(entry)} [{unit(*channels(showing(responses, entry)[0], entry))}]"
        for name, own in zip(names(responses), compared, strict=True):
            c = next((c for c in own if (c.output, c.input) == entry), None)
            if c is None:
                continue
            phase = round(c.phase_deg, 1) + 0.0
            agreement = f"\u00d7 {c.gain:.3f}, {phase:+.1f}\u00b0"
            table.add_row(*map(Text, (shown, name, agreement, percent(c.outside))))
    return table


def dry_run_summary(predicted: DryRun) -> RenderableType:
    """What a plan will come to: duration, margins (worst first), expected error per band."""
    margins = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for name in ("channel", "held to its", "predicted", "limit", "margin", "where", ""):
        margins.add_column(name)
    peaks_of = dict(zip(predicted.channels, predicted.peaks.max(axis=0), strict=True))
    outputs = predicted.outputs or predicted.channels[:1]
    # The worst of each channel; the others are no nearer.
    worst = {m.channel: m for m in reversed(predicted.margins)}
    for m in sorted(worst.values(), key=lambda m: m.margin):
        style = "green" if m.margin > _MARGIN_CLOSE else "yellow" if m.margin >= 0 else "bold red"
        value = f"{m.predicted:.3g} {pretty(m.unit)}"
        if m.channel in outputs and m.what == "limit":
            # The gate judges the output by a bound on what the device may add to the reference.
            value = f"\u2264 {value}, peak {peaks_of[m.channel]:.3g}"
        margins.add_row(
            m.channel,
            m.what,
            value,
            f"{m.limit:g} {pretty(m.unit)}",
            Text(percent(m.margin), style=style),
            m.segment if len(m.segment) <= _WHERE else f"\u2026{m.segment[1 - _WHERE :]}",
            Text("OVER", style=style) if m.margin < 0 else "",
        )
    channels = list(dict.fromkeys(b.channel for b in predicted.bands))
    errors = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for name in ("expected error at", *channels):
        errors.add_column(name)
    rows: dict[str, dict[str, str]] = {}
    for b in predicted.bands:
        by = f"{b.input}, " if b.input else ""
        key = f"{by}{b.level:g} {b.level_unit}, {b.low_hz:.3g}\u2013{b.high_hz:.3g} Hz"
        seen = b.relative < 1.0  # an error larger than the response itself has no size
        rows.setdefault(key, {})[b.channel] = f"{100 * b.relative:.2g} %" if seen else "not seen"
    for key, cells in rows.items():
        errors.add_row(key, *(cells.get(c, "") for c in channels))
    below: list[RenderableType] = [Text(""), errors]
    if any(b.relative >= 1.0 for b in predicted.bands):
        below.append(Text("not seen: the noise is larger than what comes there"))
    takes = duration(predicted.duration)
    if predicted.shortest < predicted.duration:
        takes = f"{duration(predicted.shortest)} to {takes}"
    head = Text(f"The plan takes {takes}. Predicted by the model:")
    refused = any(m.margin < 0 for m in predicted.margins)  # then nothing will be measured
    return Group(head, margins, *(below if rows and not refused else ()))


def show_dry_run(predicted: DryRun, console: Console | None = None) -> None:
    """Print `dry_run_summary`."""
    (console or Console(highlight=False)).print(dry_run_summary(predicted))


def verdict_line(verdict: Verdict) -> Text:
    """`good  The response is measured. Standard deviation ...`, the mark in colour."""
    line = Text(f"{_WORDS[verdict.mark]:<9} ", style=_STYLES[verdict.mark])
    line.append(f"{verdict.title}. ", style="bold default")
    line.append(verdict.text, style="not bold default")
    return line
