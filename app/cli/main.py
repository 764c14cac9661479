"""The command line: `nisus run`, `fold`, `compare`, `review` and the others, one file each."""

from __future__ import annotations

import functools
import operator
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from estimators.errors import NisusError

from ..terminal import complain
from .arguments import (
    COMMANDS,
    Advise,
    Bus,
    Check,
    Command,
    Commission,
    Compare,
    Filters,
    Fold,
    Guard,
    Learn,
    Log,
    Review,
    Run,
    Schema,
    Stress,
    Tune,
    Tunings,
    Twins,
)
from .given import check_numbers


def carry_out(command: Command) -> int:
    """Run one command; imports only what it needs, so that `nisus twins` answers at once."""
    if isinstance(command, Run):
        from ..live.compilers import first_workers

        workers = first_workers() if command.twin is not None and not command.headless else ()
        from .run import run_twin

        return run_twin(command, workers)
    if isinstance(command, Fold):
        from .fold import fold_twin

        return fold_twin(command)
    if isinstance(command, Check):
        from .check import check_twin

        return check_twin(command)
    if isinstance(command, Advise):
        from .advise import advise

        return advise(command)
    if isinstance(command, Compare):
        from .compare import compare_twin

        return compare_twin(command)
    if isinstance(command, Guard):
        from .guard import guard

        return guard(command)
    if isinstance(command, Commission):
        from .commission import commission_twin

        return commission_twin(command)
    if isinstance(command, Tune):
        from .tune import tune_twin

        return tune_twin(command)
    if isinstance(command, Learn):
        from .learn import learn_correction

        return learn_correction(command)
    if isinstance(command, Stress):
        from .stress import stress_twin

        return stress_twin(command)
    if isinstance(command, Filters):
        from .filters import show_filters

        return show_filters(command)
    if isinstance(command, Review):
        from .review import review_recording

        return review_recording(command)
    if isinstance(command, Bus):
        from .bus import play_bus

        return play_bus(command)
    if isinstance(command, Twins):
        from .twins import show_twins

        return show_twins(command)
    if isinstance(command, Tunings):
        from .tunings import tunings_of

        return tunings_of(command)
    if isinstance(command, Schema):
        from config.json_schema import json_schema_text

        text = json_schema_text()
        if command.out is None:
            print(text)
        else:
            command.out.write_text(text + "\n", encoding="utf-8")
        return 0
    if isinstance(command, Log):
        from .log import show_log

        return show_log(command)
    from .new import new_twin

    for path in new_twin(command):
        print(path)
    return 0


def parse(arguments: Sequence[str]) -> Command:
    """The command that the words say; leaves with tyro's explanation if they say none.

    That of a subcommand that is there gets its words alone, so that only its own options are suggested.
    """
    if arguments and arguments[0] in COMMANDS:
        name = arguments[0]
        check_numbers(COMMANDS[name], arguments[1:])
        return tyro.cli(COMMANDS[name], args=arguments[1:], prog=f"nisus {name}")  # type: ignore[no-any-return]
    named = [Annotated[command, tyro.conf.subcommand(name)] for name, command in COMMANDS.items()]
    union: Any = functools.reduce(operator.or_, named)
    return tyro.cli(union, args=arguments, prog="nisus", description=__doc__)  # type: ignore[no-any-return]


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point: 0 when all went well, 2 with one line on standard error when it did not."""
    try:
        return carry_out(parse(sys.argv[1:] if arguments is None else arguments))
    except NisusError as error:
        complain(error)
        return 2
    except BrokenPipeError:
        # Whoever read the output has had enough of it (`| head`). Python's own flush at exit must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        complain(f"{error.filename or ''}: {error.strerror or error}")
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
