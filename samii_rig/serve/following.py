"""The experiment that a diagnosis asks for, as a file, where the service can run it.

Another band, other levels, more repeats are lines of the file that was run. What a person does to
the rig (a brace, a mass, a sensor) is not.
"""

from __future__ import annotations

import re

from samii_rig.errors import InputError
from samii_rig.rig.load import tables

NUMBER = r"([-+.\deE]+)"
STARTS, ENDS = ("start_hz", "low_hz"), ("stop_hz", "high_hz")


def following(words: str, experiment_toml: str) -> str:
    """The file of the next experiment; "" where these words ask for none that can be run.

    words : `Diagnosis.experiment`. experiment_toml : of the run that was diagnosed.
    """
    try:
        before = tables(experiment_toml, "experiment.toml")
    except InputError:
        return ""
    levels = before.get("amplitudes", [])
    changes: dict[str, object] = {}
    if found := re.search(rf"widen the band to {NUMBER} Hz", words):
        changes |= {k: float(found[1]) for k in ENDS if k in before}
    elif found := re.search(rf"start the sweep at {NUMBER} Hz", words):
        changes |= {k: float(found[1]) for k in STARTS if k in before}
    elif re.search(r"at half .*twice the .*amplitude", words) and levels:
        changes["amplitudes"] = [0.5 * min(levels), 2.0 * max(levels)]
    elif "repeat each run three times" in words and before.get("repeats", 3) < 3:
        changes["repeats"] = 3
    if not changes or all(before.get(k) == v for k, v in changes.items()):
        return ""
    changes["name"] = f"{before.get('name', 'run')}_next"
    text = experiment_toml
    for key, value in changes.items():
        said = f'"{value}"' if isinstance(value, str) else str(value)
        text = re.sub(rf"(?m)^{key}\s*=.*$", f"{key} = {said}", text)
    try:
        after = tables(text, "experiment.toml")
    except InputError:
        return ""
    # A value that was written over several lines is none that we change.
    return text if after == before | changes else ""
