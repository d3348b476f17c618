"""The simulated rig in a lab's own tests: fixtures for pytest, and two assertions.

    from samii_rig.pytest_plugin import assert_no_mismatch

    @pytest.mark.samii_rig(rig="bench.toml", experiment="sweep.toml")
    def test_the_sweep_shows_nothing_that_is_missing(recording, rig):
        assert_no_mismatch(recording, rig)

pytest finds this module by itself once samii-rig is installed. It is loaded in every project's
tests there, so everything but pytest is imported when it is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.rig.schema import Device, Rig
    from samii_rig.types import FrequencyResponse, Recording

MARKER = "samii_rig"
IN_PROCESS, ON_THE_WIRE = "simulated", "simulated_node"  # entry points of samii_rig.devices
SEED = 1  # of the noise: a test that passes once passes again
ENDED = ("completed", "unknown")  # a recording of another program does not say how it ended
_KEPT: pytest.StashKey[dict[tuple[str, str], Recording]] = pytest.StashKey()


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the marker may say; `faults` is one text or several."""

    rig: str = "samii"
    experiment: str = "swept_sine"
    wire: bool = False
    faults: str | Sequence[str] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    pose: str = ""


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker, and a place for recordings."""
    config.addinivalue_line(
        "markers",
        f"{MARKER}(rig='samii', experiment='swept_sine', wire=False, faults=(), settings={{}}, "
        "pose=''): "
        "what the fixtures `rig` and `recording` simulate; files are found from the root folder",
    )
    config.stash[_KEPT] = {}


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Rig:
    """The simulated rig of the marker `samii_rig`: its file, with a simulated device.

    The file's own device is replaced, so that no test moves a real rig. It can be parametrised
    by the name or path of a rig file, with `indirect=True`.
    """
    from samii_rig.rig.load import load_rig
    from samii_rig.rig.pose import posed

    with _one_line():
        asked = _asked(request)
        named = str(getattr(request, "param", asked.rig))
        loaded, _ = load_rig(_found(named, request.config))
        if asked.pose:
            loaded = posed(loaded, asked.pose, f"marker {MARKER}, pose")
    return loaded.model_copy(update={"device": _simulated(loaded.device, asked)})


@pytest.fixture
def recording(
    rig: Rig, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Recording:
    """The recording of the marker's experiment on the fixture `rig`; made once for equal tests.

    What `samii-rig run` would refuse fails the test with the same line. A run that trips is
    recorded as well; its `stop` says so.
    """
    experiment = _found(_asked(request).experiment, request.config)
    kept, key = request.config.stash[_KEPT], (rig.model_dump_json(), experiment)
    if key not in kept:
        folder = tmp_path_factory.mktemp("samii_rig")
        with _one_line(), pytest.MonkeyPatch.context() as patch:
            # A fault that a test asked for is none of the user's own rig.
            patch.setenv("SAMII_RIG_STATE", str(folder))
            kept[key] = _recorded(rig, experiment, folder / "run.mcap")
    return kept[key]


def assert_no_mismatch(
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    rig: Rig | str | Path,
    *,
    band: tuple[float, float] | None = None,
) -> Diagnosis:
    """Pass if the rig file explains these recordings, taken together, to the noise.

    recordings : one or several, or their paths; each is held in the pose that its own rig file
    has. rig : or the name or path of a rig file.
    band : Hz, where the model is held against them.

    Returns the diagnosis. AssertionError with verdict, causes, chi-square and threshold if anything
    is missing, or if a run did not come to its end; EstimateError if they do not tell.
    """
    __tracebackhide__ = True
    found = _all(recordings)
    for r in found:
        if r.stop.status not in ENDED:
            raise AssertionError(f"{_name(r)}: the run {r.stop.status}: {r.stop.reason}")
    diagnosis, name = _diagnosed(found, rig, band)
    if diagnosis.verdict != "no_mismatch":
        which = ", ".join(_name(r) for r in found)
        raise AssertionError("\n".join(_lines(diagnosis, name, which)))
    return diagnosis


def assert_still_explained(
    rig: Rig | str | Path, *paths: str | Path, band: tuple[float, float] | None = None
) -> None:
    """Pass if a rig file explains each of these recordings by itself, such as last month's.

    paths : recordings (.mcap), or folders of them. In folders, runs that ended early and those
    from which no response is estimated (a jog, a step) are passed over.

    The test is skipped where the folders are not there yet or are empty. AssertionError with all
    that are not explained or cannot be read, or if no recording tells anything.
    """
    __tracebackhide__ = True
    from samii_rig.errors import SamiiRigError

    logs = [log for path in paths for log in _logs(Path(path))]
    if not logs and paths and not any(_holds_files(Path(path)) for path in paths):
        pytest.skip(f"no recording yet in {', '.join(map(str, paths))}: put some .mcap there")
    if not logs:
        raise AssertionError(f"no recording in {', '.join(map(str, paths)) or 'nothing'}")
    wrong = []
    for log in logs:
        try:
            assert_no_mismatch(log, rig, band=band)
        except AssertionError as error:
            wrong.append(str(error))
        except SamiiRigError as error:
            wrong.append(f"{log.name}: {error}")
    if wrong:
        of = f"{len(wrong)} of {len(logs)} recordings are not explained"
        raise AssertionError("\n\n".join([of, *wrong]))


@contextmanager
def _one_line() -> Iterator[None]:
    """Our own errors are lines for a person: they fail the test without a traceback."""
    from samii_rig.errors import SamiiRigError

    try:
        yield
        return
    except SamiiRigError as error:
        line = str(error)
    # The error that it stands for would be printed above it once more.
    raise pytest.fail.Exception(line, pytrace=False) from None


def _asked(request: pytest.FixtureRequest) -> _Asked:
    marker = request.node.get_closest_marker(MARKER)
    try:
        return _Asked(*marker.args, **marker.kwargs) if marker else _Asked()
    except TypeError as error:
        from samii_rig.errors import InputError

        said = str(error).removeprefix("_Asked.__init__() ")
        raise InputError.saying(request.node.nodeid, f"marker {MARKER}", said) from error


def _found(name: str, config: pytest.Config) -> str:
    """A file of the project wherever pytest is started, or the name of a shipped one."""
    file = config.rootpath / name
    return str(file) if file.is_file() else name


def _simulated(device: Device, asked: _Asked) -> Device:
    """The device that stands for the file's own."""
    from samii_rig.rig.schema import Device

    driver = ON_THE_WIRE if asked.wire else IN_PROCESS
    own = dict(device.settings) if device.driver == driver else {}
    if asked.wire and device.driver == "serial_node":
        own = {"node": dict(device.settings)}
    new = [asked.faults] if isinstance(asked.faults, str) else asked.faults
    faults = (*own.pop("faults", ()), *new)
    settings = {"seed": SEED, **own, **asked.settings, **({"faults": faults} if faults else {})}
    return Device(driver=driver, settings=settings)


def _recorded(rig: Rig, experiment: str, path: Path) -> Recording:
    """One run of one experiment, as `samii-rig run` does it, through the gate."""
    from samii_rig.diagnose.fit.rigfile import toml
    from samii_rig.errors import InputError
    from samii_rig.run.campaign import carry_out
    from samii_rig.run.order import Order

    if rig.device.driver not in (IN_PROCESS, ON_THE_WIRE):
        expected = f"{IN_PROCESS} or {ON_THE_WIRE}: no test moves a real rig"
        raise InputError("fixture recording", "rig.device.driver", rig.device.driver, expected)
    order = Order.named(experiment, rig, toml(rig))
    if len(order.setups) != 1:
        expected = "an experiment of one run"
        raise InputError("fixture recording", experiment, f"{len(order.setups)} runs", expected)
    outcome = carry_out(order.run(0).predict(), path)
    made = outcome.recording
    for array in (made.time, made.sequence, made.values, made.quality):
        array.flags.writeable = False  # other tests get the same one
    return made


def _all(given: Recording | str | Path | Sequence[Recording | str | Path]) -> list[Recording]:
    from samii_rig.types import Recording

    return [_read(x) for x in ([given] if isinstance(given, Recording | str | Path) else given)]


def _read(recording: Recording | str | Path) -> Recording:
    from samii_rig.record.reader import read_recording

    return read_recording(Path(recording)) if isinstance(recording, str | Path) else recording


def _holds_files(path: Path) -> bool:
    """Whether a recording is there, whatever it tells."""
    return path.suffix == ".mcap" or (path.is_dir() and any(path.rglob("*.mcap")))


def _logs(path: Path) -> list[Path]:
    """The recording itself; of a folder, those that can tell something. A folder that is not there
    has none, a recording that is not there is one that cannot be read."""
    if not path.is_dir():
        return [path] if path.suffix or path.exists() else []
    return [log for log in sorted(path.rglob("*.mcap")) if _tells(log)]


def _tells(log: Path) -> bool:
    """Whether it is to be explained; one that cannot be read is, so that this is said."""
    from samii_rig.errors import SamiiRigError

    try:
        recording = _read(log)
    except SamiiRigError:
        return True
    kinds = {s.kind for s in recording.segments}
    return recording.stop.status in ENDED and kinds != {"transient"}


def _name(recording: Recording) -> str:
    return Path(recording.source).name or recording.metadata.get("experiment", "the recording")


def _diagnosed(
    recordings: Sequence[Recording], rig: Rig | str | Path, band: tuple[float, float] | None
) -> tuple[Diagnosis, str]:
    """What the rig leaves out of them, and its name."""
    from samii_rig.diagnose.diagnose import diagnose
    from samii_rig.diagnose.posed import in_poses, sorted_by_pose
    from samii_rig.identify.poses import poses_of
    from samii_rig.rig.load import load_rig
    from samii_rig.rig.pose import at_pose
    from samii_rig.signal.estimate import estimate

    held = load_rig(str(rig))[0] if isinstance(rig, str | Path) else rig
    poses = poses_of(recordings, held, ())

    def responses(runs: Sequence[Recording]) -> Sequence[FrequencyResponse]:
        # As `samii-rig diagnose` does: what is done about segments with gaps is said.
        return estimate(runs, gaps="auto", band=band)

    if len(set(poses)) > 1:
        each = sorted_by_pose(recordings, poses, responses)
        return in_poses(each, held, band=band), held.name
    if poses:
        held = at_pose(held, poses[0])
    return diagnose(responses(recordings), held, band=band, runs=recordings), held.name


def _lines(found: Diagnosis, rig: str, recordings: str) -> list[str]:
    """What a person reads of a test that failed."""
    from samii_rig.diagnose.result import percent

    said = [
        f"{recordings}: the rig file {rig!r} does not explain it",
        f"  verdict     {found.verdict}",
        f"  chi-square  {found.chi2_per_dof:.4g} per degree of freedom, "
        f"threshold {found.threshold:.4g}",
    ]
    for c in found.causes:
        at = f"{c.physics.replace('_', ' ')} at {c.site}"
        said.append(f"  left out    {at}, probability {percent(c.probability)}")
        said += [
            f"              {k} = {v.value:.4g} {v.unit}, 90 % interval {v.low:.4g} to {v.high:.4g}"
            for k, v in c.parameters.items()
        ]
    worst = max(found.bands, key=lambda b: b.chi2_per_dof, default=None)
    if worst:
        where = f"{worst.channel}, {worst.low_hz:.3g} to {worst.high_hz:.3g} Hz"
        said.append(f"  worst       {where}: chi-square {worst.chi2_per_dof:.4g}")
    # The first line says again what the list of causes holds.
    return [*said, *(f"  {line}" for line in found.lines()[1 if found.causes else 0 :])]
