"""Command line of Nisus: `nisus run`, `fold`, `compare`, `review` and others."""

from __future__ import annotations

import contextlib
import errno
import functools
import gc
import importlib
import inspect
import io
import logging
import operator
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from config.extensions import left_out, maker, schemas
from config.yaml_files import shown_path
from estimators.errors import ConfigError, NisusError, nearest, shown_name

from ..terminal import complain, use_lines_of_json
from .arguments import COMMANDS, NAMES, RunCommand
from .options import check_options, environment_options

HEAD = """Keep a digital twin in step with its asset: fold, tune, check and watch it.

`nisus COMMAND --help` describes a command, with examples. `nisus --tyro-print-completion bash` prints a script that
completes words."""

COMPLETION, SHELLS = "--tyro-print-completion", ("bash", "zsh")
"""Option of tyro, the library of the command line, and the shells for which it prints a script."""


class Complaints(logging.Handler):
    """Prints what the registry of extensions reports as other errors are."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a line."""
        complain(record.getMessage())


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # errors of a device that takes no more output


def carry_out(command: object) -> int:
    """Run one command; only its own module is imported, so that `nisus twins` answers at once."""
    if getattr(command, "log_format", None) == "json":
        use_lines_of_json()
    if type(command) not in COMMANDS:
        name = next(name for name, options in schemas("commands").items() if options is type(command))
        return int(maker("commands", name)(command))
    module, _, function = COMMANDS[type(command)].partition(":")
    workers: tuple[object, ...] = ()
    if isinstance(command, RunCommand) and command.twin is not None and not command.headless:
        from ..engine.compilers import first_compilers

        workers = (first_compilers(),)  # started before the imports of `run`, which take seconds
    return int(getattr(_imported(f"{__package__}.{module}"), function)(command, *workers))


def _imported(name: str) -> ModuleType:
    """Import a module without a search for garbage, which takes a sixth of the time, and then exempt what it made."""
    if name not in sys.modules:
        gc.disable()
        try:
            importlib.import_module(name)
        finally:
            gc.freeze()
            gc.enable()
    return sys.modules[name]


def parse(arguments: Sequence[str]) -> object:
    """Return the command that the arguments name, or exit with its help or the script of a shell.

    Raises:
        ConfigError: If the command or an option does not exist, or a value must be a number and is not.
    """
    name = arguments[0] if arguments else "--help"
    commands = NAMES if name in NAMES else NAMES | schemas("commands") | NAMES
    if name in commands:
        command = commands[name]
        given = [*arguments[1:]]
        if getattr(command, "from_environment", False):
            given += environment_options(name, command, given, os.environ)
        check_options(name, command, given)
        return tyro.cli(command, args=given, prog=f"nisus {name}", description=described(command))
    if name not in ("-h", "--help", COMPLETION):
        kind = "option" if name.startswith("-") else "command"
        names = ["--help", "--version", COMPLETION] if name.startswith("-") else list(commands)
        raise ConfigError(f"{shown_name(name)}: there is no such {kind}; {nearest(name, names)}{left_out()}")
    named: list[object] = [
        Annotated[command, tyro.conf.subcommand(name, description=described(command).split("\n")[0])]
        for name, command in commands.items()
    ]
    show = functools.partial(tyro.cli, functools.reduce(operator.or_, named), prog="nisus", description=HEAD)
    if name != COMPLETION:
        return show(args=["--help"])
    if (shell := arguments[1] if len(arguments) == 2 else "") not in SHELLS:
        raise ConfigError(f"{COMPLETION}: give one of {', '.join(SHELLS)}")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        show(args=[COMPLETION, shell])
    # Each line of a description would be a word that completes.
    print(re.sub("^COMPLETION_SPEC = .*", lambda spec: spec[0].replace(r"\n", " "), printed.getvalue(), flags=re.M))
    sys.exit()


def described(command: type) -> str:
    """Return a command's docstring, whose paragraphs are one line each, with its examples line by line."""
    text, _, examples = inspect.cleandoc(command.__doc__ or "").partition("\n\nExamples:\n")
    return "\n\n".join([*(" ".join(part.split()) for part in text.split("\n\n")), f"Examples:\n{examples}"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point: 0 if all went well, 2 with one line on standard error if not."""
    given = sys.argv[1:] if arguments is None else arguments
    logging.getLogger("nisus").handlers = [Complaints()]
    if not sys.warnoptions:
        warnings.showwarning = _show_warning
    try:
        try:
            return _answered(given)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()  # its reader has ended (`| head`), perhaps that of standard error too
        return 0
    except OSError as error:
        complain(f"standard output: {error.strerror or error}")
        _drop_output()
        return 2


def _show_warning(message: object, category: type, filename: str, lineno: int, *_: object, **__: object) -> None:
    """Print a warning in one line; none of arithmetic, whose results are checked and shown as missing or failed."""
    if not issubclass(category, RuntimeWarning):
        complain(f"{shown_path(Path(filename))}:{lineno}: {message}")


def _answered(arguments: Sequence[str]) -> int:
    """Run the command that the arguments name; an error is one line."""
    try:
        if arguments and arguments[0] == "--version":
            from importlib.metadata import version

            print(f"nisus {version('nisus')}")
            return 0
        return carry_out(parse(arguments))
    except NisusError as error:
        complain(error)
    except BrokenPipeError:
        raise
    except OSError as error:
        # Files that a command writes are named by `config.yaml_files.writing`.
        name = error.filename or ("standard output" if error.errno in FULL else "")
        complain(f"{name}: {error.strerror or error}".removeprefix(": "))
        _drop_output()
    except KeyboardInterrupt:
        return 130
    return 2


def _drop_output() -> None:
    """Discard what is left to print, so that Python's own flush at exit does not fail again."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(main())
