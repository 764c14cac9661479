"""Command line of Nisus: `nisus run`, `fold`, `compare`, `review` and others."""

from __future__ import annotations

import contextlib
import errno
import functools
import importlib
import operator
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from estimators.errors import NisusError

from ..terminal import complain
from .arguments import COMMANDS, NAMES, RunCommand
from .options import check_numbers

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # errors of a device that takes no more output


def carry_out(command: Any) -> int:
    """Run one command; only its own module is imported, so that `nisus twins` answers at once."""
    module, _, function = COMMANDS[type(command)].partition(":")
    workers: tuple[Any, ...] = ()
    if isinstance(command, RunCommand) and command.twin is not None and not command.headless:
        from ..live.compilers import first_compilers

        workers = (first_compilers(),)  # started before the imports of `run`, which take seconds
    result = getattr(importlib.import_module(f".{module}", __package__), function)(command, *workers)
    sys.stdout.flush()
    return int(result)


def parse(arguments: Sequence[str]) -> Any:
    """Return the command that the arguments name, or exit with tyro's explanation.

    A known command is parsed alone, so that tyro suggests only its options.
    """
    if arguments and arguments[0] in NAMES:
        command = NAMES[arguments[0]]
        check_numbers(command, arguments[1:])
        return tyro.cli(command, args=arguments[1:], prog=f"nisus {arguments[0]}")
    named: list[Any] = [Annotated[command, tyro.conf.subcommand(name)] for name, command in NAMES.items()]
    return tyro.cli(functools.reduce(operator.or_, named), args=arguments, prog="nisus", description=__doc__)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point: 0 if all went well, 2 with one line on standard error if not."""
    try:
        return carry_out(parse(sys.argv[1:] if arguments is None else arguments))
    except NisusError as error:
        complain(error)
        return 2
    except BrokenPipeError:
        _drop_output()  # its reader has ended (`| head`)
        return 0
    except OSError as error:
        # Files that a command writes are named by `config.yaml_files.writing`.
        name = error.filename or ("standard output" if error.errno in FULL else "")
        complain(f"{name}: {error.strerror or error}".removeprefix(": "))
        _drop_output()
        return 2
    except KeyboardInterrupt:
        return 130


def _drop_output() -> None:
    """Discard what is left to print, so that Python's own flush at exit does not fail again."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
