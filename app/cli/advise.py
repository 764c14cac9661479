"""`nisus advise`: which estimator for a twin, by what its log shows, with the figure behind each claim."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from config.loader import shipped
from estimators.errors import ConfigError
from estimators.log import READING, Log

from ..present.result import WIDTH
from ..studies.advice.draft import python_text, yaml_text
from ..studies.advice.measured import Measured, digits, percent, seconds_text
from ..studies.advice.plan import Moves, Plan, plan
from ..studies.advice.relations import Pair
from ..studies.advice.signals import Signal, signals
from ..studies.advice.verdict import Advice, advice_json, apply, lasting_lines, lines
from ..studies.advice.verdict import advise as verdict
from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from .log import WIDTH as LOG_WIDTH
from .log import database_of, look
from .new import check_new, model_of, write_pair
from .options import settings
from .prepare import attend, prepare

if TYPE_CHECKING:
    from .arguments import Advise as Arguments


def advise(arguments: Arguments) -> int:
    """Carry the command out.

    Raises:
        ConfigError: If twins and recordings are mixed, or an option is for the other.
    """
    for what in arguments.what:
        if what not in shipped() and Path(what).is_dir():
            raise ConfigError(f"{what}: it is a folder; name a twin's YAML or recordings in it")
    twins = [what for what in arguments.what if what in shipped() or Path(what).suffix in (".yaml", ".yml")]
    if not twins and all(Path(what).suffix for what in arguments.what):
        if arguments.apply or arguments.log or arguments.set or arguments.estimator:
            raise ConfigError("--apply, --log, --set and --estimator are for a twin; a recording is drafted with --out")
        return advise_log(arguments, tuple(Path(what) for what in arguments.what))
    if len(arguments.what) > 1:
        raise ConfigError(f"{arguments.what[1]}: one twin at a time; name its recordings with --log")
    if arguments.dbc or arguments.signals:
        raise ConfigError("--dbc and --signals are for recordings; a twin's YAML names its own")
    return _of_twin(arguments, arguments.what[0])


def _of_twin(arguments: Arguments, name: str) -> int:
    twin = load_twin(name, log_files=arguments.log or None, overrides=settings(arguments.set, arguments.estimator))
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    told: Advice = attend(twin.model, lambda: verdict(Measured(twin, log)), "measuring")
    if arguments.json:
        print(json.dumps(advice_json(twin, log, told), allow_nan=False))
    else:
        print("\n".join(as_text(twin, log, told)))
    if arguments.apply or arguments.out is not None:
        kept = apply(twin.path, lines(told), arguments.out, told.sections)
        if not arguments.json:
            was = f"; as it was: {kept}" if kept else ""
            print(f"\n{arguments.out or twin.path}: its estimator is {told.estimator}{was}")
    return 0


def as_text(twin: Twin, log: Log, told: Advice) -> list[str]:
    """The page: the recommendation, the claims in the order of the tree, the lines, and what else to do."""
    seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
    readings = int((log.kind[: log.n] == READING).sum())
    same = " (it has it)" if told.estimator == twin.estimator else f" (it has {twin.estimator})"
    page = [
        f"{twin.name}: {twin.title}",
        f"  measured on {seconds:.4g} s of its log, {readings:,} readings",
        "",
        f"Use {told.estimator}, {_lower(told.title)}{same}",
        *(line for reason in told.reasons for line in _wrapped(f"because {reason}", 2)),
        "",
        "Why",
    ]
    for claim in told.claims:
        mark = " *" if claim.key in told.because else ""
        page.append(f"  {claim.question} {claim.answer}{mark}")
        page += _wrapped(claim.reason, 6)
    page += [
        "",
        f"Lines for {twin.path.name}",
        *(f"  {line}" for line in (lines(told) + lasting_lines(told)).splitlines()),
    ]
    if told.remedies:
        page += ["", "What else to do", *(line for text in told.remedies for line in _wrapped(f"- {text}", 2))]
    return page


def _lower(title: str) -> str:
    """A title within a sentence."""
    return title if title.startswith(("Kalman", "Rao")) else title[0].lower() + title[1:]


def _wrapped(text: str, indent: int) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=" " * indent, subsequent_indent=" " * (indent + 2))


MAX_LISTED_SIGNALS = 40
"""Signals that are listed; those that stand still are only counted."""

MEANING = {"switch": "a switch", "counter": "time, counter or status", "constant": "stands still", "short": "too few"}


def advise_log(arguments: Arguments, files: tuple[Path, ...]) -> int:
    """Carry the command out on recordings."""
    found = look(files, arguments.dbc, arguments.time, arguments.time_unit)
    wanted = [text.strip() for text in arguments.signals.split(",") if text.strip()]
    drafted = plan(found, wanted)
    every = signals(found)
    if arguments.json:
        print(json.dumps(log_json(every, drafted), allow_nan=False))
    else:
        console = Console()
        if not console.is_terminal:
            console = Console(width=LOG_WIDTH)
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
    for one in shown[:MAX_LISTED_SIGNALS]:
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
    more = len(every) - len(shown[:MAX_LISTED_SIGNALS])
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


def log_json(every: list[Signal], drafted: Plan) -> dict[str, Any]:
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
