"""A name that is mistyped is answered at once, with what would be right and what was meant.

Plan: every kind of name has its list and its suggestion; what a command is given is looked at
before numpy and the model's compiler are imported, which is counted, not timed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from fake_device import RIG as TEXT
from typer.testing import CliRunner

from samii_rig.cli import bench
from samii_rig.cli.app import app
from samii_rig.cli.common import FIGURES, SAMPLES
from samii_rig.cli.estimate import GAPS, METHODS
from samii_rig.cli.papers import FORMATS
from samii_rig.errors import InputError, SamiiRigError, one_of
from samii_rig.record.export_samples import WRITERS
from samii_rig.record.reader import read_rig_toml
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.report.figures import SUFFIXES
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.run import session
from samii_rig.run.catalogue import kinds
from samii_rig.run.experiments import load_experiment
from samii_rig.signal.choose import Method
from samii_rig.signal.gather import Gaps
from samii_rig.types import Channel, StopRecord

HEAVY = ("numpy", "scipy", "numba", "mcap", "matplotlib", "plotly", "control", "rich.progress")
WRONG = [
    "ruin",
    "run --sed 1 swept_sine",
    "run swept_sin",
    "run swept_sine --rig sami",
    "frf no.mcap",
    "frf there.mcap --band 5 1",
    "modes there.mcap --band 5 1",
    "report there.mcap --band -1 5",
    "identify there.mcap --band 5 1",
    "diagnose there.mcap --band 5 1",
    "frf no.mcap --rig sami",
    "report no.mcap",
    "modes no.mcap",
    "identify no.mcap --method x",
    "diagnose no.mcap",
    "diagnose no.mcap --gaps leave",
    "study --vary joint_1.k=1:2:3 --rig sami",
    "control --rig sami",
    "prove --rig sami",
    "prove --out there.mcap",
    "serve --rig sami",
    "serve --new-token anna",
    "serve --tls-key key.pem",
    "papers no",
    "papers --format gif",
    "recordings nowhere",
    "recordings . --since soon",
    "verify no.mcap",
    "recover no.mcap",
    "replay no.mcap",
    "import no.csv --map sflr",
    "import x.csv --map slfr",
    "devices --rig sami",
    "doctor --rig sami",
    "jog --rig sami",
    "calibrate a_0 --to new.toml --rig sami",
    "clear-fault --name a --reason b --rig sami",
    # Of files that are there: where the result shall go.
    "run step --out nodir.txt",
    "run step --out there.mcap/run.mcap",
    "frf there.mcap --export nodir/frf.csv",
    "frf there.mcap --export frf.xls",
    "frf there.mcap --save there.mcap",
    "report there.mcap --out nodir/page.html",
    "report there.mcap --figure bode.gif",
    "modes there.mcap --out nodir/modes.html",
    "study --vary joint_1.k=1:2:3 --plot nodir/study.png",
    "control --out there.mcap",
    "jog --to 0.05 --out there.mcap",
    "doctor --move --out there.mcap",
    "calibrate a_0 --to there.mcap",
    "import there.mcap --map sflr --out there.mcap",
    "export there.mcap --out run.xls",
    "recover there.mcap --out nodir/new.mcap",
    "diagnose there.mcap --rig samii --out there.mcap",
]
# These ask the rig file for its elements, which takes numpy; the model is not asked.
WRONG_FOR_THE_RIG = [
    "run broken.toml",
    *(f"run {kind}.toml --dry-run" for kind in kinds()),
    "study --vary nope",
    "study --vary joint_1.q=1:2:3",
    "identify there.mcap --rig samii --free joint_1.q",
    "identify there.mcap --rig two_masses --free spring_1",
    "identify there.mcap --rig samii --pose 30",
    "diagnose there.mcap --rig two_masses --known joint_1.k=3",
    "diagnose there.mcap --rig two_masses --known spring_1.k",
    "diagnose there.mcap --rig two_masses --pose 30deg",
    "control --rig samii --sensor theta_2",
    "calibrate nope --rig samii --to new.toml",
    "jog --speed 9",
    "jog --to 9",
    "jog --to nan",
]
COUNT = """
import json, sys
from samii_rig.cli import main
found = {{}}
for line in {lines!r}:
    sys.argv = ["samii-rig", *line.split()]
    try:
        main()
    except SystemExit as end:
        found[line] = [end.code, [m for m in {heavy!r} if m in sys.modules]]
print(json.dumps(found))
"""


RUNS = [line for line in WRONG_FOR_THE_RIG if line.startswith("run ")]


@pytest.mark.parametrize(
    ("lines", "heavy"),
    [
        (WRONG, HEAVY),
        (WRONG_FOR_THE_RIG, set(HEAVY) - {"numpy"}),
        (RUNS, ("rich.console",)),  # another 0.05 s
    ],
)
def test_a_wrong_argument_imports_nothing_heavy(tmp_path: Path, lines, heavy) -> None:
    (tmp_path / "there.mcap").touch()
    (tmp_path / "broken.toml").write_text("a = {")
    for kind in kinds():
        (tmp_path / f"{kind}.toml").write_text(f'experiment = "{kind}"\nrepeatz = 3\n')
    code = COUNT.format(lines=lines, heavy=tuple(heavy))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert json.loads(done.stdout) == {line: [2, []] for line in lines}
    assert len(done.stderr.splitlines()) == len(lines)


def test_the_words_of_the_options_are_those_of_the_estimate() -> None:
    assert get_args(Method) == METHODS
    assert get_args(Gaps) == GAPS
    assert {f".{name}" for name in FORMATS} == set(SUFFIXES)
    assert FIGURES == SUFFIXES
    assert (bench.FASTEST, bench.FURTHEST) == (session.FASTEST, session.FURTHEST)
    assert tuple(WRITERS) == SAMPLES


@pytest.mark.parametrize(
    ("given", "names", "said"),
    [
        ("sami", ["samii", "sflr"], "one of samii, sflr; did you mean samii?"),
        ("SFLR", ["samii", "sflr"], "one of samii, sflr; did you mean sflr?"),
        ("x", ["samii", "sflr"], "one of samii, sflr"),
        (None, ["a"], "one of a"),
        ("x", [], "one of none"),
    ],
)
def test_what_was_probably_meant_is_said(given: object, names: list[str], said: str) -> None:
    assert one_of(given, names) == said


def refused(*words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert isinstance(result.exception, SamiiRigError), result.output
    return str(result.exception)


def test_a_name_to_free_is_held_against_the_rig_at_hand_before_samples_are_read(tmp_path) -> None:
    # A recording is read for its rig file alone; the example is one of that rig's own parameters.
    (tmp_path / "there.mcap").touch()
    words = ("identify", str(tmp_path / "there.mcap"), "--rig", "two_masses", "--free")
    assert refused(*words, "spring_1").endswith("element.symbol, for example spring_1.k")
    assert refused(*words, "spring_1.q").startswith("--free is 'spring_1.q'")
    run = tmp_path / "run.mcap"
    toml = load_rig("two_masses")[1]
    with RunWriter(run, (), 500.0, Origin(toml)) as writer:
        writer.close(StopRecord("completed", "all segments done"))
    assert read_rig_toml(run) == toml
    assert "an element of Two masses" in refused("identify", str(run), "--free", "joint_1.k")


@pytest.mark.parametrize("command", ["frf", "report", "modes", "identify", "diagnose"])
def test_a_channel_that_no_sample_has_is_said_before_samples_are_read(tmp_path, command) -> None:
    run = tmp_path / "run.mcap"
    channels = (Channel("v", "V", "command", -1.0, 1.0, 0.0), Channel("a", "1", "sensor", -1, 1, 0))
    with RunWriter(run, channels, 500.0) as writer:
        writer.close(StopRecord("completed", "all segments done"))
    said = refused(command, str(run), "--output", "v_9")
    assert "--output is 'v_9'; expected one of v, a" in said


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("run", "swept_sin"), "swept_sine"),
        (("run", "step", "--rig", "sami"), "samii"),
        (("import", "x", "--map", "slfr"), "sflr"),
        (("papers", "tabel-1"), "table-1"),
    ],
)
def test_every_name_has_its_suggestion(words: tuple[str, ...], meant: str) -> None:
    said = refused(*words)
    assert "one of " in said
    assert said.endswith(f"did you mean {meant}?")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz", "rate_hzz", "rate_hzz: no such field; expected rate_hz"),
        ("kp = 4.0", "kp = 4.0\nscael = 1", "scael: no such field; expected no more than there is"),
        ('kind = "rigid_link"', 'kind = "rigid_lnk"', "did you mean rigid_link?"),
        ("low = -2.0", "low = -2.0\nresoluton = 1", "did you mean resolution?"),
        ('reason = "the frame"', 'reason = "the frame"\nmax_rat = 1', "did you mean max_rate?"),
    ],
)
def test_a_field_that_is_not_known_is_told_from_those_that_are(
    old: str, new: str, said: str
) -> None:
    with pytest.raises(InputError) as wrong:
        parse(Rig, TEXT.replace(old, new, 1), "rig.toml")
    assert said in str(wrong.value)


def test_what_is_wrong_with_a_text_is_said_as_such(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    for content, said in (
        (b"a = {b = 1", "is not valid TOML: unclosed inline table"),
        ("name = 'x'".encode("utf-16"), "the file begins as UTF-16"),
    ):
        path.write_bytes(content)
        for load in (load_rig, lambda name: load_experiment(name, parse(Rig, TEXT, "rig"))):
            with pytest.raises(InputError, match=said):
                load(str(path))
