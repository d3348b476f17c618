"""Inputs that nothing excited: their references rest, and their own loops alone move them.

With one experiment the sensors y = H_d v_d + H_u v_u do not distinguish the columns of the driven
inputs v_d from those of the undriven ones v_u. What is measured is the response with these loops
closed,

    y/v_d = H_d + H_u T,    T = v_u/v_d,

and T, which needs no knowledge of the loops. A model's H is held against the same sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.types import Complex, Finding, FrequencyResponse, Recording


def driven_of(
    recordings: Sequence[Recording], moving: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Of the commands that move, those that a reference drives, and those that none does.

    All are taken for driven where a recording has no reference in use, or one that does not end
    with the name of a command: then it is not known which.
    """
    driven: set[str] = set()
    for recording in recordings:
        used = [n for n in recording.names("reference") if recording.largest(n) > 0]
        own = {c for c in moving for n in used if n.endswith(f"_{c}")}
        if not used or len(own) < len(used):
            return tuple(moving), ()
        driven |= own
    if not driven:
        return tuple(moving), ()
    return tuple(n for n in moving if n in driven), tuple(n for n in moving if n not in driven)


def apart(response: FrequencyResponse, undriven: Sequence[str]) -> FrequencyResponse:
    """A response whose outputs hold the undriven commands, with these as `followers`."""
    names = [c.name for c in response.outputs]
    rows = [k for k, n in enumerate(names) if n in undriven]
    if not rows:
        return response
    kept = np.array([k for k in range(len(names)) if k not in rows])
    n_in = len(response.inputs)
    entries = (kept[:, None] * n_in + np.arange(n_in)).ravel()

    def of_outputs(x: np.ndarray | None) -> np.ndarray | None:
        return None if x is None else x[:, kept]

    every, drove = ", ".join(names[k] for k in rows), ", ".join(c.name for c in response.inputs)
    text = (
        f"{every} was not excited, its loop alone moved it: no response to it is estimated, and "
        f"that to {drove} holds with the loop of {every} closed"
    )
    mine = [f for f in response.findings if f.channel not in undriven]
    return replace(
        response,
        H=response.H[:, kept],
        covariance=response.covariance[:, entries[:, None], entries],
        coherence=response.coherence[:, kept],
        outputs=tuple(response.outputs[k] for k in kept),
        even=of_outputs(response.even),
        odd=of_outputs(response.odd),
        noise=of_outputs(response.noise),
        distortion=of_outputs(response.distortion),
        followers=tuple(response.outputs[k] for k in rows),
        follow=response.H[:, rows],
        findings=(*mine, Finding("closed_loop", "note", text, channel=every)),
    )


def as_measured(response: FrequencyResponse, H: Complex, inputs: Sequence[str]) -> Complex:
    """(n_freq, n_out, n_in) what a model's H (n_freq, n_out, len(inputs)) makes of `response`:
    its columns of the driven inputs, with the loops of the followers closed.

    inputs : names of the model's columns.
    """
    out = H[:, :, [inputs.index(c.name) for c in response.inputs]]
    if response.follow is not None:
        own = H[:, :, [inputs.index(c.name) for c in response.followers]]
        out = out + own @ response.follow
    return np.asarray(out)
