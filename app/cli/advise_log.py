"""`nisus advise LOG...`: what a recording holds, what belongs together in it, and a draft of a twin."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimators.errors import ConfigError

from ..studies.advice.log.draft import python_text, yaml_text
from ..studies.advice.log.pairs import Pair
from ..studies.advice.log.plan import Moves, Plan, plan
from ..studies.advice.log.signals import Signal, signals
from ..studies.advice.words import digits, percent, seconds_text
from .log import WIDTH, database_of, look
from .new import check_new, model_of, write_pair

if TYPE_CHECKING:
    from .arguments import Advise as Arguments

MOST = 40
"""Signals that are listed; those that stand still are only counted."""

MEANING = {"switch": "a switch", "counter": "time, counter or status", "constant": "stands still", "short": "too few"}


def advise_log(arguments: Arguments, files: tuple[Path, ...]) -> int:
    """Carry the command out on recordings."""
    found = look(files, arguments.dbc, arguments.time, arguments.time_unit)
    wanted = [text.strip() for text in arguments.signals.split(",") if text.strip()]
    drafted = plan(found, wanted)
    every = signals(found)
    if arguments.json:
        print(json.dumps(as_dict(every, drafted), allow_nan=False))
    else:
        console = Console()
        if not console.is_terminal:
            console = Console(width=WIDTH)
        console.print(_table(every))
        for line in _said(drafted):
            console.print(escape(line), highlight=False, soft_wrap=True)
    if arguments.out is not None:
        _write(arguments, files, found, drafted)
    elif not arguments.json:
        print("\nWrite the draft with --out NAME.yaml; take other signals with --signals A,B.")
    return 0


def _write(arguments: Arguments, files: tuple[Path, ...], found: Any, drafted: Plan) -> None:
    """The two files of the draft, and what to do next."""
    assert arguments.out is not None
    out = arguments.out
    if out.suffix not in (".yaml", ".yml", ""):
        raise ConfigError(f"--out {out}: must end in .yaml")
    name, folder = out.stem, out.parent
    check_new(name, folder)
    model, databases = model_of(name), [database_of(text) for text in arguments.dbc]
    written = write_pair(
        name,
        folder,
        yaml_text(name, model, drafted, found, databases, arguments.time_unit, folder),
        python_text(name, model, drafted),
    )
    if not arguments.json:
        print("\nWritten: " + " and ".join(map(str, written)))
        print(f"Next: nisus advise {written[0]}    whether its filter and noises bear out")
        print(f"      nisus run {written[0]}       to look at it")


def _table(every: list[Signal]) -> Table:
    table = Table()
    table.add_column("signal", no_wrap=True)
    for title in ("unit", "a second", "holes", "longest gap", "levels", "step", "noise"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("is", no_wrap=True)
    shown = [one for one in every if one.kind != "constant"]
    for one in shown[:MOST]:
        table.add_row(
            escape(one.name),
            escape(one.series.unit),
            digits(one.rate) if math.isfinite(one.rate) else "",
            str(one.holes or ""),
            seconds_text(one.longest) if one.longest else "",
            str(one.levels),
            digits(one.resolution),
            digits(one.noise),
            MEANING.get(one.kind, "an angle that wraps" if one.wraps else _bound(one)),
        )
    more = len(every) - len(shown[:MOST])
    if more:
        table.caption = f"{more} more stand still or are left out; --json has all"
    return table


def _bound(one: Signal) -> str:
    """What bounds the noise of a signal."""
    return "noise is its resolution" if one.noise <= 1.01 * one.resolution / math.sqrt(12.0) else ""


def _said(drafted: Plan) -> list[str]:
    """Pairs, candidates for states, inputs, in words."""
    lines = ["", "What belongs together"]
    lines += [f"  {_pair(drafted, pair)}" for pair in drafted.pairs] or ["  no two of the signals taken say the same"]
    lines += ["", "Candidates for states"]
    lines += [f"  {_state(item)}" for item in drafted.states]
    if drafted.inputs:
        lines += ["", "Inputs", *(f"  {name}: drives a state, and follows none" for name, _ in drafted.inputs)]
    return lines


def _pair(drafted: Plan, pair: Pair) -> str:
    one, other = drafted.signals[pair.first].name, drafted.signals[pair.second].name
    share = f"explains {percent(pair.explained)}"
    line = f"{digits(pair.offset)} + {digits(pair.gain)}"
    if pair.rate:
        return f"{one}' = {line} {other} {share} of the changes: one state with a speed, two sensors"
    behind = f", {digits(pair.lag)} s later" if pair.lag else ""
    left = f"what is left, {digits(pair.left)}, follows itself with {pair.related:+.2f}"
    kind = "noise, so two sensors of one state" if pair.one else "more than noise, so two states"
    return f"{other} = {line} {one}{behind} {share}; {left}: {kind}"


def _state(item: Moves) -> str:
    sensors = ", ".join(reads.name for reads in item.sensors)
    r = f"σ of {sensors}: {', '.join(digits(math.sqrt(reads.r)) for reads in item.sensors)}"
    if item.lag is not None:
        moves = (
            f"follows {', '.join(item.inputs)} with {seconds_text(item.lag.tau)}, which explains "
            f"{percent(item.lag.explained)} of the second half when fitted to the first"
        )
        moves += "; what is left drifts" if item.smooth else "; what is left walks"
    else:
        moves = "moves with a speed of its own" if item.smooth else "walks at random"
    return f"{item.name}: {moves}; Q {digits(item.q)} a second; {r}"


def as_dict(every: list[Signal], drafted: Plan) -> dict[str, Any]:
    """For scripts: `signals`, `pairs`, `states`, `inputs`."""
    names = [one.name for one in drafted.signals]
    return {
        "signals": [
            {
                "name": one.name,
                "message": one.message,
                "unit": one.series.unit,
                "number": int(one.series.values.size),
                "rate": one.rate if math.isfinite(one.rate) else None,
                "holes": one.holes,
                "longest_gap": one.longest,
                "levels": one.levels,
                "step": one.resolution,
                "noise": one.noise,
                "kind": one.kind,
                "wraps": one.wraps,
            }
            for one in every
        ],
        "pairs": [
            {**pair._asdict(), "first": names[pair.first], "second": names[pair.second], "one": pair.one}
            for pair in drafted.pairs
        ],
        "states": [
            {
                "name": item.name,
                "speed": item.smooth,
                "q": item.q,
                "sensors": {reads.name: math.sqrt(reads.r) for reads in item.sensors},
                "follows": list(item.inputs),
                "lag": item.lag.tau if item.lag is not None else None,
                "explained": item.lag.explained if item.lag is not None else None,
            }
            for item in drafted.states
        ],
        "inputs": [name for name, _ in drafted.inputs],
    }
