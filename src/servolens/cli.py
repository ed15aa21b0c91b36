"""The command ``servolens``: every failure becomes one line and an exit status."""

from __future__ import annotations

import os
import re
import sys
import traceback
import warnings
from typing import Any, NoReturn

import click

from servolens import __version__
from servolens.commands import COMMANDS
from servolens.errors import ServolensError
from servolens.rendering import escaped

__all__ = ["group", "main"]

DEBUG = "SERVOLENS_DEBUG"
POSSIBLE = re.compile(r"\. \(?Did you mean (?:one of: )?(.+)\?\)?$")
"""How click ends what it says of a name that it does not know."""
BAD_INPUT, FAULT, INTERRUPTED, BROKEN_PIPE = 2, 3, 130, 141
FAULT_TEXT = (
    "stopped by an unexpected {kind}. This is a fault of servolens, not of your data: run the command again with"
    f" {DEBUG}=1 and report what it prints, with the command, in an issue of the project"
)


class _Commands(click.Group):
    """A group whose failures are one line, also under click's test runner."""

    def main(  # type: ignore[override]  # the overload that returns is not for a command line
        self, args: Any = None, prog_name: str | None = None, **extra: Any
    ) -> NoReturn:
        """Run the command line and exit with its status."""
        if f"_{(prog_name or 'servolens').upper()}_COMPLETE" in os.environ:
            super().main(args, prog_name, **extra)
        given = list(sys.argv[1:] if args is None else args)
        sys.exit(_status(self, given or ["--help"]))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order in which they are used."""
        return list(self.commands)


@click.group(
    cls=_Commands,
    commands={command.name or "": command for command in COMMANDS},
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="`servolens COMMAND --help` lists every option with an example, such as `servolens check kp60.csv`.",
)
@click.version_option(__version__, prog_name="servolens", message="%(prog)s %(version)s")
def group() -> None:
    """From one measured step to a PD gain you can trust.

    RECORD is a log (CSV, Excel, MAT and others), a folder of logs, or a campaign TOML. Results go to standard output,
    or as JSON to the file of --json; messages go to standard error. Exit status: 0 done, 1 the answer is no, 2 unusable
    input, 3 a numerical failure.
    """


def main() -> NoReturn:
    """Run the command line of this process."""
    _mend_streams()
    if not os.environ.get(DEBUG):
        warnings.simplefilter("ignore")
    group.main(prog_name="servolens")


def _status(command: click.Group, args: list[str]) -> int:
    try:
        with command.make_context("servolens", args) as context:
            status = command.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as done:
        return done.exit_code
    except BrokenPipeError:
        _drop_output()
        return BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        if os.environ.get(DEBUG):
            traceback.print_exception(error)
        status, sentence = _failure(error)
        click.echo(f"servolens: error: {escaped(sentence)}", err=True)
        return status
    return int(status or 0)


def _failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the sentence of a failure."""
    match error:
        case click.ClickException():
            return BAD_INPUT, _usage(error)
        case ServolensError():
            return error.exit_status, " ".join(str(error).split("\n"))
        case KeyboardInterrupt() | click.Abort():
            return INTERRUPTED, "interrupted; no files were written"
        case MemoryError():
            return FAULT, "there is not enough memory for these records; give fewer or shorter ones"
        case OSError() if error.filename is None:
            _drop_output()
            return BAD_INPUT, f"the output cannot be written: {(error.strerror or 'unknown error').lower()}"
    return FAULT, FAULT_TEXT.format(kind=type(error).__name__)


def _usage(error: click.ClickException) -> str:
    """Return click's message as one sentence that says which command's help to read."""
    text = " ".join(error.format_message().split()).rstrip(".")
    text = POSSIBLE.sub(lambda found: f"; did you mean {' or '.join(found[1].split(', '))}?", text)
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "servolens"
    return f"{text[:1].lower()}{text[1:]}{' See' if text.endswith('?') else '; see'} {path} --help"


def _mend_streams() -> None:
    """Let output survive a terminal that lacks a character, and a closed stream."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123 - open until the end
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace" if name == "stderr" else "replace")


def _drop_output() -> None:
    """Send what is still buffered nowhere, so that the interpreter does not fail on it at exit."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123 - open until the end
