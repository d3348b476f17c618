"""What a run is predicted to do, said before anything moves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from samii_rig.cli.common import say_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from samii_rig.run.dryrun import DryRun
    from samii_rig.run.setups import Setup


def say_predictions(
    setups: Sequence[Setup],
    predicted: Sequence[DryRun],
    console: Console,
    *,
    dry_run: bool,
    json: bool,
) -> None:
    """What the runs will come to. As plain data only where a dry run is all that is asked for:
    the run itself ends with one object, which holds it."""
    from samii_rig.report.summary import show_dry_run

    if json:
        if dry_run and len(setups) == 1:
            say_json({"status": "predicted", "dry_run": prediction(predicted[0])})
        elif dry_run:
            say_json({"status": "predicted", "dry_runs": [prediction(p) for p in predicted]})
        return
    # Of several runs the one that comes nearest to a limit.
    worst = min(range(len(setups)), key=lambda i: predicted[i].margins[0].margin)
    if len(setups) > 1:
        which = f"{setups[worst].instruction}, nearest to a limit of {len(setups)} runs"
        console.print(f"run {worst + 1}, {which}:")
    show_dry_run(predicted[worst], console)


def prediction(predicted: DryRun) -> dict[str, Any]:
    """A prediction as plain data."""
    return {
        "duration_s": predicted.duration,
        "shortest_s": predicted.shortest,
        "margins": [
            {
                "channel": m.channel,
                "what": m.what,
                "predicted": m.predicted,
                "limit": m.limit,
                "unit": m.unit,
                "margin": m.margin,
                "largest_level": m.largest_level,
                "level_unit": m.level_unit,
            }
            for m in predicted.margins
        ],
        "bands": [
            {
                "channel": b.channel,
                "level": b.level,
                "low_hz": b.low_hz,
                "high_hz": b.high_hz,
                "std": b.std,
                "relative": b.relative,
                **({"input": b.input} if b.input else {}),
            }
            for b in predicted.bands
        ],
    }
