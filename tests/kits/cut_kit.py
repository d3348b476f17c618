"""Sweeps of the concealed plant that end with their record, once each, nothing repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from concealed_kit import SAMII_TOML

from samii_rig.record.reader import read_recording
from samii_rig.types import Recording
from sim.concealed.runs import Design
from sim.concealed.stated import Stated
from sim.concealed.trial import make

DESIGN = Design(levels=(0.5, 1.0), bursts=1, burst=30.0, steps=1, periods=2, settle=1, period=4.0)


def cut_sweeps(
    folder: Path, *effects: str, design: Design = DESIGN, toml: str = SAMII_TOML
) -> list[Recording]:
    """One sweep a level, each record cut off where its sweep ends. toml : the rig file."""
    stated = tuple(Stated.of(words.split()) for words in effects)
    kind = "stated" if stated else "nothing"
    made = make(kind, 11, folder, toml, design, stated)
    out = []
    for path in sorted(made.glob("*.mcap")):
        run = read_recording(path)
        first = run.segments[0]
        if first.kind != "burst":
            continue
        n = round((design.burst - design.ring_down) * run.rate_hz)
        whole = replace(first, kind="single", start=0, stop=n)
        out.append(
            replace(
                run,
                time=run.time[:n],
                sequence=run.sequence[:n],
                values=run.values[:n],
                quality=run.quality[:n],
                segments=(whole,),
            )
        )
    assert len(out) == len(design.levels)
    return out
