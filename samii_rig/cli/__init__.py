"""The command line: `samii-rig COMMAND`. The commands are thin; the work is in the rooms."""

import os
import sys


def main() -> None:
    """Entry point of `samii-rig`: errors of ours end in one line and their exit code."""
    from typer import Abort
    from typer.exceptions import TyperException

    from samii_rig.cli.app import app
    from samii_rig.errors import SamiiRigError

    try:
        sys.exit(app(prog_name="samii-rig", standalone_mode=False))
    except SamiiRigError as error:
        print(f"samii-rig: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except TyperException as error:
        print(_usage(error), file=sys.stderr)
        sys.exit(2)
    except Abort:
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our output went away (`samii-rig ... | head`): not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _usage(error: Exception) -> str:
    """One line for a wrong option or argument; the help itself where nothing was asked for."""
    message = error.format_message() if hasattr(error, "format_message") else str(error)
    if message.startswith("Usage:"):
        return message
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "samii-rig"
    return f"{command}: {message.rstrip('.')}; see {command} --help"
