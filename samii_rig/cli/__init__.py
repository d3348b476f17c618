"""The command line: `samii-rig COMMAND`. The commands are thin; the work is in the rooms."""

import os
import sys


def main() -> None:
    """Entry point of `samii-rig`: errors of ours end in one line and their exit code."""
    from samii_rig.cli.app import app
    from samii_rig.errors import SamiiRigError

    try:
        app()
    except SamiiRigError as error:
        print(f"samii-rig: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        # The reader of our output went away (`samii-rig ... | head`): not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
