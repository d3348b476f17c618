"""Names that a command is given, looked at before what it takes to use them is imported.

Numpy, the model's compiler and the plots take seconds to import; a typing mistake shall not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from samii_rig.errors import InputError, one_of
from samii_rig.files import require_file


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
    """InputError unless there is an experiment of this name, for some rig at least, or a file."""
    from samii_rig.run.catalogue import shipped

    names = shipped()
    if not any(known.startswith(f"{name}_") for known in names):
        _shipped_or_file("EXPERIMENT", name, names, "an experiment file")


def check_logs(logs: Iterable[Path]) -> None:
    """RecordingError unless every recording is a file."""
    for path in logs:
        require_file(path)


def check_recordings(folder: Path) -> None:
    """InputError unless it is a folder."""
    if not folder.is_dir():
        raise InputError("FOLDER", "", str(folder), "a folder of recordings")


def check_free(names: Sequence[str], rig: str | None, logs: Sequence[Path] = ()) -> None:
    """InputError unless every name is a parameter of the rig: the one named, else the one that the
    first recording carries."""
    from samii_rig.identify.parameters import check_names
    from samii_rig.rig.load import load_rig, parse
    from samii_rig.rig.schema import Rig

    if not names:
        return
    if rig is not None:
        check_names(load_rig(rig)[0], names, "--free")
        return

    from samii_rig.record.reader import read_rig_toml

    text = next(filter(None, map(read_rig_toml, logs)), "")
    if text:
        check_names(parse(Rig, text, "the recording's rig file"), names, "--free")


def check_choice(option: str, value: str, choices: Iterable[str]) -> None:
    """InputError unless an option is one of its words."""
    if value not in choices:
        raise InputError(option, "", value, one_of(value, choices))


def _shipped_or_file(option: str, name: str, names: Iterable[str], what: str) -> None:
    if name not in names and not Path(name).exists():
        raise InputError(option, "", name, f"the path of {what} or {one_of(name, names)}")
