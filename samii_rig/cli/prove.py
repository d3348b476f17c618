"""`samii-rig prove`: concealed trials, diagnosed and scored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import JsonOption, SchedulerOption, WorkersOption, rigs, say_json
from samii_rig.cli.options import takes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from samii_rig.prove.outcomes import Outcome
    from samii_rig.prove.score import Score


@dataclass(frozen=True, kw_only=True)
class ProveOptions:
    """Words of `samii-rig prove`."""

    out: Annotated[Path, typer.Option("--out", help="Folder of trials, answers and the page.")] = (
        Path("proof")
    )
    rig: Annotated[
        list[str] | None,
        typer.Option(
            "--rig",
            help="Shipped rig or path of a rig file, may be repeated; by default all shipped.",
            autocompletion=rigs,
        ),
    ] = None
    plant: Annotated[
        list[str] | None,
        typer.Option("--plant", help="What makes the recordings, may be repeated; by default all."),
    ] = None
    nothing: Annotated[int, typer.Option(min=0, help="Trials that conceal nothing.")] = 300
    one: Annotated[int, typer.Option(min=0, help="Trials that conceal one effect.")] = 430
    two: Annotated[int, typer.Option(min=0, help="Trials that conceal two.")] = 150
    joints: Annotated[int, typer.Option(min=0, help="Trials that conceal every joint's give.")] = 40
    force: Annotated[
        int, typer.Option(min=0, help="Trials that conceal one effect that depends on the level.")
    ] = 150
    varying: Annotated[
        int, typer.Option(min=0, help="Trials that conceal a stiffness that is not constant.")
    ] = 60
    outside: Annotated[
        int, typer.Option(min=0, help="Trials that conceal what the vocabulary has no word for.")
    ] = 150
    seed: Annotated[
        int,
        typer.Option(help="Seed of the first trial of each kind. Thresholds were set below 1e6."),
    ] = 1_000_000
    hours: Annotated[
        float, typer.Option(min=0.0, help="Begin no trial after that long; 0 for no end.")
    ] = 0.0
    workers: WorkersOption = None
    scheduler: SchedulerOption = ""
    keep: Annotated[bool, typer.Option("--keep", help="Keep the recordings (12 MB a trial).")] = (
        False
    )
    page: Annotated[
        Path | None,
        typer.Option(help="Write the documentation's page (.md), and the outcomes beside it."),
    ] = None
    of: Annotated[
        Path | None,
        typer.Option("--of", help="Score the outcomes kept in this file (.jsonl.xz), make none."),
    ] = None
    calibrate: Annotated[
        Path | None,
        typer.Option(
            help="Write the weights of stated probabilities that these trials give to this file."
        ),
    ] = None
    json: JsonOption = False

    @property
    def counts(self) -> dict[str, int]:
        """Trials of each kind."""
        kinds = ("nothing", "one", "two", "outside", "joints", "force", "varying")
        return {kind: getattr(self, kind) for kind in kinds}


@takes(ProveOptions)
def prove(o: ProveOptions) -> None:
    """Conceal physics from the diagnosis, trial by trial, and score what it says.

    Plant, rig and style of recording are drawn for every trial. Trials that have an answer are not
    done again: stop at any time, call again to go on.

    Example: samii-rig prove --nothing 6 --one 28 --two 4 --outside 3 --out proof
    """
    from samii_rig.cli.arguments import check_rig
    from samii_rig.cli.common import check_target
    from samii_rig.files import check_file, check_folder

    for name in o.rig or ():
        check_rig(name)
    if o.page is not None:
        check_target("--page", o.page, (".md",))
    if o.calibrate is not None:
        check_file("--calibrate", o.calibrate)
    if o.of is None:
        check_folder("--out", o.out)
    from samii_rig.prove import outcomes as kept

    failures: list[str] = []
    if o.of is None:
        failures = _made(o)
        made, found = kept.collected(o.out.resolve())
    else:
        made, found = kept.read(o.of)
    if o.calibrate is not None:
        _calibrate(o.calibrate, found)
    _report(o, made, found, failures)
    if failures:
        raise typer.Exit(1)


def _made(o: ProveOptions) -> list[str]:
    """Carry out what is asked for; what failed, in words."""
    import time

    from samii_rig.progress import Counted
    from samii_rig.prove.campaign import Campaign, carry_out, claim
    from samii_rig.prove.jobs import jobs, pairs, plants
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig
    from samii_rig.rig.shipped import shipped
    from samii_rig.workers import workers as at_work

    names = tuple(o.plant or plants())
    rigs = {name: load_rig(name)[1] for name in o.rig or shipped()}
    having, left_out = pairs(names, rigs, asked=o.rig or ())
    asked = jobs(o.counts, o.seed, having)
    if not asked:
        return []
    out = o.out.resolve()
    made = {"plants": names, "rigs": tuple(rigs), "left_out": left_out,
            "command": _command(), "commit": _commit()}  # fmt: skip
    claim(out, made)
    campaign = Campaign(out, rigs, keep=o.keep)
    until = time.monotonic() + 3600 * o.hours if o.hours else float("inf")
    with (
        working("proof", quiet=o.json) as say,
        at_work(o.workers, o.scheduler) as executor,
    ):

        def told(done: int, failed: int) -> None:
            say(Counted("trials", done, len(asked), f"{failed} failed" if failed else ""))

        return carry_out(campaign, asked, executor, told, until)


# Options that say where and how fast, not which trials.
ELSEWHERE = ("--out", "--page", "--calibrate", "--workers", "--scheduler", "--hours")


def _command() -> str:
    """This call as a person would type it to have the same trials."""
    import shlex
    import sys

    words, skip = ["samii-rig"], False
    for word in sys.argv[1:]:
        if not skip and word.split("=")[0] not in (*ELSEWHERE, "--keep", "--json"):
            words.append(word)
        skip = word in ELSEWHERE
    return shlex.join(words)


def _commit() -> str:
    """The commit of the code, with + where files differ from it; else the version."""
    import subprocess
    from importlib.metadata import version

    here = Path(__file__).parent
    asked = ["git", "describe", "--always", "--dirty=+", "--abbrev=10", "--exclude=*"]
    try:
        done = subprocess.run(asked, cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return version("samii-rig")
    return done.stdout.strip()


def _calibrate(file: Path, found: Sequence[Outcome]) -> None:
    from samii_rig.prove import calibrate as regression
    from samii_rig.prove.outcomes import evidence

    rows, groups, places, place_groups = evidence(found)
    seeds = [o["seed"] for o in found]
    origin = (
        f"{len(rows)} trials with an effect found, of seeds from {min(seeds, default=0)} to "
        f"{max(seeds, default=0)}; every plant and excitation counts alike"
    )
    weights = regression.fit(rows, groups)
    regression.write(file, weights, origin, regression.fit(places, place_groups))


def _report(
    o: ProveOptions, made: dict[str, Any], found: Sequence[Outcome], failures: Sequence[str]
) -> None:
    """Write the pages, that of a campaign into its folder; print the scores."""
    from rich.console import Console

    from samii_rig.prove import evidence
    from samii_rig.prove import outcomes as kept
    from samii_rig.prove.page import write_page
    from samii_rig.prove.score import scores

    trials = kept.trials(found)
    broken = sum(o.get("at") == "diagnosis" for o in found if "error" in o)
    result = scores(trials, broken)
    pages = [] if o.of else [write_page(o.out / "proof.html", trials, failed=broken)]
    if o.page is not None:
        file = o.page.with_name("proof-trials.jsonl.xz")
        kept.write(file, made, found)
        known = {"command": "", "commit": "", "left_out": (), **made}
        known["page"] = f"samii-rig prove --of {file} --page {o.page}"
        evidence.write(o.page, known, found, file.name)
        pages += [o.page, file]
    if o.json:
        data = {"trials": len(trials), "failures": failures, "page": pages[0] if pages else None}
        say_json({**data, "scores": [_plain(s) for s in result]})
        return
    console = Console(highlight=False)
    for s in result:
        console.print(_line(s), soft_wrap=True)
    for failure in failures:
        console.print(f"failed     {failure}", soft_wrap=True)
    for path in pages:
        console.print(f"page       {path}", soft_wrap=True)


def _plain(s: Score) -> dict[str, Any]:
    return {
        "what": s.what,
        "value": s.value,
        "low": s.low,
        "high": s.high,
        "n": s.n,
        "goal": s.goal,
        "met": s.met,
    }


def _line(s: Score) -> str:
    word = {True: "met", False: "missed", None: ""}[s.met]
    return f"{s.what:<60} {s.value:7.3f}  ({s.low:.3f} to {s.high:.3f}, n = {s.n})  {word}"
