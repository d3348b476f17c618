"""Names that a command is given, looked at before what it takes to use them is imported.

Numpy, the model's compiler and the plots take seconds to import; a typing mistake shall not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from samii_rig.errors import InputError, one_of
from samii_rig.files import require_file

if TYPE_CHECKING:
    from samii_rig.rig.schema import Rig


def check_rig(name: str | None) -> None:
    """InputError unless there is a rig of this name, or a file; None asks for none."""
    from samii_rig.rig.shipped import shipped

    if name is not None:
        _shipped_or_file("--rig", name, shipped(), "a rig file")


def check_map(name: str) -> None:
    """InputError unless there is a map of this name, or a file."""
    from importlib import resources

    from samii_rig.rig.shipped import names_in

    names = names_in(resources.files("samii_rig.record") / "data")
    _shipped_or_file("--map", name, names, "a map file")


def check_experiment(name: str) -> None:
    """InputError unless there is an experiment of this name, for some rig at least, or a file whose
    fields are right."""
    from samii_rig.run.catalogue import shipped

    names = shipped()
    if any(known.startswith(f"{name}_") for known in names):
        return
    _shipped_or_file("EXPERIMENT", name, names, "an experiment file")
    if name not in names:
        from samii_rig.rig.load import read_text, tables

        text = read_text(Path(name), "experiment file")
        tables(text, name)

        from samii_rig.run.experiments import parse_experiment

        parse_experiment(text, name)


def check_logs(logs: Iterable[Path]) -> None:
    """RecordingError unless every recording is a file."""
    for path in logs:
        require_file(path)


def check_recordings(folder: Path) -> None:
    """InputError unless it is a folder."""
    if not folder.is_dir():
        raise InputError("FOLDER", "", str(folder), "a folder of recordings")


def check_band(band: tuple[float, float] | None) -> None:
    """InputError unless the lower frequency comes first."""
    if band is not None and not 0 <= band[0] < band[1]:
        given = " ".join(f"{f:g}" for f in band)
        raise InputError("--band", "", given, "two frequencies in Hz, 0 or more, low before high")


def check_channels(option: str, names: Sequence[str] | None, logs: Sequence[Path]) -> None:
    """InputError unless every recording of samples has a channel of each name."""
    if not names:
        return

    from samii_rig.record.reader import read_channels

    for path in logs:
        known = [c.name for c in read_channels(path)]
        unknown = [n for n in names if n not in known]
        if known and unknown:
            raise InputError(str(path), option, unknown[0], one_of(unknown[0], known))


def check_free(names: Sequence[str], rig: str | None, logs: Sequence[Path] = ()) -> None:
    """InputError unless every name is a parameter of the rig at hand."""
    if not names:
        return

    from samii_rig.identify.parameters import check_names

    own = _rig_at_hand(rig, logs)
    if own is not None:
        check_names(own, names, "--free")


def check_accelerometer(rig: Rig, name: str) -> None:
    """InputError unless a sensor of the rig is one, by this name."""
    known = [s.name for s in rig.sensor if s.kind == "acceleration"]
    if name not in known:
        raise InputError("--sensor", "", name, f"an accelerometer, {one_of(name, known)}")


def check_known(words: Sequence[str], option: str, rig: str | None, logs: Sequence[Path]) -> None:
    """InputError unless each is ELEMENT.PARAMETER=VALUE of the rig at hand."""
    if not words:
        return

    from samii_rig.diagnose.fit.known import check_names, stated

    values = stated(words, option)
    own = _rig_at_hand(rig, logs)
    if own is not None:
        check_names(own, values, option)


def check_poses(poses: Sequence[str] | None, rig: str | None, logs: Sequence[Path]) -> None:
    """InputError unless there is none, or an angle for each recording of a rig with gravity."""
    if not poses:
        return

    from samii_rig.identify.poses import given_poses

    own = _rig_at_hand(rig, logs)
    if own is not None:
        given_poses(len(logs), own, poses)


def _rig_at_hand(rig: str | None, logs: Sequence[Path]) -> Rig | None:
    """The rig that is named, else the one that the first recording carries; no sample is read."""
    from samii_rig.rig.load import load_rig, parse
    from samii_rig.rig.schema import Rig

    if rig is not None:
        return load_rig(rig)[0]

    from samii_rig.record.reader import read_rig_toml

    text = next(filter(None, map(read_rig_toml, logs)), "")
    return parse(Rig, text, "the recording's rig file") if text else None


def check_choice(option: str, value: str, choices: Iterable[str]) -> None:
    """InputError unless an option is one of its words."""
    if value not in choices:
        raise InputError(option, "", value, one_of(value, choices))


def _shipped_or_file(option: str, name: str, names: Iterable[str], what: str) -> None:
    if name not in names and not Path(name).exists():
        raise InputError(option, "", name, f"the path of {what} or {one_of(name, names)}")
