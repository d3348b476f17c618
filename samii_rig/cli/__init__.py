"""The command line: `samii-rig COMMAND`. The commands are thin; the work is in the rooms."""

import os
import signal
import sys
import threading


def main() -> None:
    """Entry point of `samii-rig`: errors of ours end in one line and their exit code."""
    from samii_rig.run.interrupts import one_press_counts
    from samii_rig.workers import ONE_THREAD

    # Matrices here are small: threads that wait for each other take longer than one. Whoever set
    # a number knows better; read by numpy when it is imported first, which is after this.
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    # Only Python's main thread may handle signals.
    handles = threading.current_thread() is threading.main_thread()
    if handles:
        one_press_counts()
    try:
        code = _command()
    finally:
        if handles:
            # It is over: another press has nothing left to break but the way out.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)


def _command() -> int:
    """Carry out the command; its exit code."""
    from typer import Abort
    from typer.exceptions import TyperException

    from samii_rig.cli.app import app
    from samii_rig.errors import NO_MEMORY, DiskError, SamiiRigError
    from samii_rig.files import DISK_ERRORS
    from samii_rig.units import pretty

    try:
        return int(app(prog_name="samii-rig", standalone_mode=False) or 0)
    except SamiiRigError as error:
        print(f"samii-rig: {pretty(str(error))}", file=sys.stderr)
        return error.exit_code
    except TyperException as error:
        print(_usage(error), file=sys.stderr)
        return 2
    except (Abort, KeyboardInterrupt):
        return 130
    except MemoryError:
        print(f"samii-rig: {NO_MEMORY}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of our output went away (`samii-rig ... | head`): not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise  # a defect of ours: where a name is wrong, it was looked at before
        name = f"{error.filename}: " if error.filename else ""
        print(f"samii-rig: {name}{error.strerror}", file=sys.stderr)
        return DiskError.exit_code


def _usage(error: Exception) -> str:
    """One line for a wrong option or argument; the help itself where nothing was asked for."""
    message = error.format_message() if hasattr(error, "format_message") else str(error)
    if message.startswith("Usage:"):
        return message
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "samii-rig"
    return f"{command}: {message.rstrip('.')}; see {command} --help"
