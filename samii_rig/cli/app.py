"""All commands, by name. Heavy imports wait until a command needs them."""

from __future__ import annotations

from typing import Annotated

import typer

import samii_rig
from samii_rig.cli import (
    bench,
    control,
    diagnose,
    estimate,
    files,
    identify,
    modes,
    papers,
    prove,
    record,
    recordings,
    serve,
    study,
)

app = typer.Typer(
    name="samii-rig",
    help="Drive a flexible robot, record it, estimate its frequency responses, "
    "hold the model against them.",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Exit codes: 0 done, 1 a file holds nothing, 2 bad input, 3 a recording is damaged, "
    "4 the plan would break a limit, 5 the safety gate tripped, 6 the device or the disk failed, "
    "7 recorded but not evaluated, 130 stopped.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"samii-rig {samii_rig.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
) -> None:
    pass


app.command("run")(record.run)
app.command("import")(files.import_)
app.command("export")(files.export)
app.command("frf")(estimate.frf)
app.command("report")(estimate.report)
app.command("modes")(modes.modes)
app.command("identify")(identify.identify)
app.command("diagnose", cls=diagnose.Spread)(diagnose.diagnose)
app.command("study")(study.study)
app.command("control")(control.control)
app.command("papers")(papers.papers)
app.command("prove")(prove.prove)
app.command("verify")(files.verify)
app.command("recover")(files.recover)
app.command("recordings")(recordings.recordings)
app.command("replay")(recordings.replay)
app.command("serve")(serve.serve)
app.command("devices")(bench.devices)
app.command("doctor")(bench.doctor)
app.command("jog")(bench.jog)
app.command("calibrate")(bench.calibrate)
app.command("clear-fault")(bench.clear_fault)
