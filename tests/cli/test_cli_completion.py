"""A shell completes commands, rigs and experiments by name, and files where none fits."""

import os
import subprocess
import sys

import pytest

from samii_rig.rig.load import shipped


def completed(line: str, shell: str = "bash") -> list[str]:
    """What the shell is offered for the last word of a line, as its completion script asks."""
    words = line.split(" ")
    asked = {
        "_SAMII_RIG_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", "from samii_rig.cli import main; main()"],
        env=os.environ | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("samii-rig rec", ["recover", "recordings"]),
        ("samii-rig run --rig samii_to", ["samii_torque_horizontal", "samii_torque_vertical"]),
        ("samii-rig diagnose --rig sf", ["sflr"]),
        ("samii-rig run torq", ["torque_test"]),
        ("samii-rig run --rig ./bench", []),
    ],
)
def test_the_last_word_is_completed(line: str, offered: list[str]) -> None:
    assert completed(line) == offered


def test_every_rig_and_every_command_is_offered() -> None:
    assert set(completed("samii-rig frf --rig ")) == set(shipped())
    assert {"run", "frf", "diagnose", "serve", "doctor"} <= set(completed("samii-rig "))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_its_script_asks_this_program(shell: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from samii_rig.cli import main; main()"],
        env=os.environ | {"_SAMII_RIG_COMPLETE": f"source_{shell}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "_SAMII_RIG_COMPLETE" in done.stdout
    assert "samii-rig" in done.stdout
