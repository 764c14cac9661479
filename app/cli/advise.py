"""`nisus advise`: recommend an estimator for a twin from its log, or the roles of a recording's signals."""

from __future__ import annotations

import math
import time
from pathlib import Path

from config.loader import moved, shipped
from config.old_names import rewrite
from estimators.errors import ConfigError
from estimators.log import READING, Log

from ..format_time import counted
from ..render.text import to_text
from ..result import JsonObject, TableColumn, Topic, to_json
from ..study.advice.draft import hint_lines
from ..study.advice.measured import AdviceProgress, Measured, digits, percent, seconds_text, without_faults
from ..study.advice.plan import OMISSIONS, DraftPlan, Moves, plan, redundant, unit_ratio
from ..study.advice.relations import Pair
from ..study.advice.signals import Signal, signals
from ..study.advice.verdict import Advice, advice_json, changed, details, exclusion_text, finding, lasting_lines, lines
from ..study.advice.verdict import advise as recommend
from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from .arguments import AdviseCommand as Arguments
from .log import contents_of
from .new import roles_json
from .options import check_output, overrides_of, roles_of
from .prepare import attend, prepare

MAX_LISTED_SIGNALS = 40

WRITE_DRAFT = "nisus new NAME --log FILE writes the draft of a recording, fitted and checked"


def advise(arguments: Arguments) -> int:
    """Advise which filter to take for twins or recordings.

    Raises:
        ConfigError: If twins and recordings are mixed, or an option does not apply.
    """
    whole = [what for what in arguments.what if what not in shipped() and Path(what).is_dir()]
    twins = [what for what in arguments.what if what in shipped() or Path(what).suffix in (".yaml", ".yml")]
    if not twins and all(Path(what).suffix or what in whole for what in arguments.what):
        if any((arguments.apply, arguments.out, arguments.log, arguments.set, arguments.estimator)):
            raise ConfigError(f"--apply, --out, --log, --set and --estimator are for a twin; {WRITE_DRAFT}")
        return _draft(arguments, tuple(Path(what) for what in arguments.what))
    if len(arguments.what) > 1:
        raise ConfigError(f"{arguments.what[1]}: one twin at a time; name its recordings with --log")
    if any((arguments.dbc, arguments.signals, arguments.sensors, arguments.inputs, arguments.hold_out)):
        raise ConfigError(
            "--dbc, --signals, --sensors, --inputs and --hold-out are for recordings; a twin's YAML names its own"
        )
    return _of_twin(arguments, arguments.what[0])


def _of_twin(arguments: Arguments, name: str) -> int:
    if arguments.out is not None:
        check_output("--out", arguments.out, ".yaml", ".yml", new="choose another name, or use --apply")
    twin = load_twin(name, log_files=arguments.log or None, overrides=overrides_of(arguments))
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    progress, begun = AdviceProgress(), time.monotonic()

    def work() -> Advice:
        clean, excluded = without_faults(twin, log)
        return recommend(Measured(twin, clean, excluded, progress))

    def text() -> str:
        left = progress.left(time.monotonic() - begun)
        return progress.question + ("" if left is None else f" About {left:.0f} s left")

    advice: Advice = attend(twin.model, work, "measuring", text=text)
    print(to_json(advice_json(twin, log, advice)) if arguments.json else to_text(_topics(twin, log, advice)))
    if arguments.apply or arguments.out is not None:
        path, out = twin.path, arguments.out
        kept = rewrite(path, lambda text: moved(changed(text, lines(advice), advice.sections), path, out or path), out)
        if not arguments.json:
            before = f"; the previous file is {kept}" if kept else ""
            print(f"\n{arguments.out or twin.path}: its estimator is {advice.estimator}{before}")
    return 0


def _topics(twin: Twin, log: Log, advice: Advice) -> list[Topic]:
    """Return the recommendation, the claims in the order of the tree, the lines for the YAML, and other remedies."""
    seconds = log.events.seconds
    readings = int((log.events.kind == READING).sum())
    same = "as now" if advice.estimator == twin.estimator else f"now {twin.estimator}"
    title = advice.title if advice.title.startswith(("Kalman", "Rao")) else advice.title[0].lower() + advice.title[1:]
    claims = []
    for claim in advice.claims:
        claims += [f"{finding(claim)}{' *' * (claim.key in advice.because)}", f"    {details(claim)}"]
    excluded = [exclusion_text(item) for item in advice.excluded]
    measured = f"measured on {seconds:.4g} s of its log, {counted(readings, 'reading')}"
    topics = [
        Topic(f"{twin.name}: {twin.title}", (measured,)),
        Topic(f"Use {advice.estimator}, {title} ({same})", tuple(advice.reasons)),
        *([Topic("Excluded: faults of sensors", tuple(excluded))] if excluded else []),
        Topic("Findings (* decided), with their figures", tuple(claims)),
        Topic(f"Lines for {twin.path.name}", tuple((lines(advice) + lasting_lines(advice)).splitlines())),
    ]
    return topics + ([Topic("Also", tuple(f"- {text}" for text in advice.remedies))] if advice.remedies else [])


def _draft(arguments: Arguments, files: tuple[Path, ...]) -> int:
    """Print what a draft of recordings would be made of."""
    found = contents_of(files, arguments)
    drafted, every = plan(found, roles_of(arguments)), signals(found)
    if arguments.json:
        print(to_json(_draft_json(every, drafted)))
    else:
        print(to_text([_signals_topic(every), *_plan_topics(drafted)]), f"\n{WRITE_DRAFT}.", sep="\n")
    return 0


def _signals_topic(every: list[Signal]) -> Topic:
    shown = [one for one in every if one.kind != "constant"][:MAX_LISTED_SIGNALS]
    rows = tuple(
        (
            one.name,
            one.series.unit,
            one.rate,
            one.holes or None,
            seconds_text(one.longest) if one.longest else "",
            one.levels,
            one.resolution,
            one.noise,
            OMISSIONS.get(
                one.kind,
                "an angle that wraps"
                if one.wraps
                else "noise is its resolution"
                if one.noise <= 1.01 * one.resolution / math.sqrt(12.0)
                else "",
            ),
        )
        for one in shown
    )
    gaps = TableColumn("gaps", absent="")
    columns = ("signal", "unit", "rate [1/s]", gaps, "longest gap", "levels", "resolution", "noise", "")
    more = len(every) - len(shown)
    notes = (f"{more} more are constant or not listed; --json has all",) if more else ()
    return Topic("Signals", notes, columns, rows)


def _plan_topics(drafted: DraftPlan) -> list[Topic]:
    """Return related signals, states and inputs in words."""
    pairs = tuple(_pair_text(drafted, pair) for pair in drafted.pairs) or ("no two of these signals are related",)
    topics = [Topic("Related signals", pairs), Topic("States", tuple(_state_text(item) for item in drafted.states))]
    inputs = tuple(
        f"{name}: drives {', '.join(item.name for item in drafted.states if name in item.inputs) or 'no state'}"
        for name, _ in drafted.inputs
    )
    topics += [Topic("Inputs", inputs)] if inputs else []
    return topics + ([Topic("Hints", tuple(hints))] if (hints := hint_lines(drafted)) else [])


def _pair_text(drafted: DraftPlan, pair: Pair) -> str:
    one, other = drafted.signals[pair.first].name, drafted.signals[pair.second].name
    share = f"explains {percent(pair.explained)}"
    line = f"{digits(pair.offset)} + {digits(pair.gain)}"
    if pair.rate:
        return f"{one}' = {line} {other} {share} of the changes: one state with a speed, two sensors"
    behind = f", {digits(pair.lag)} s later" if pair.lag else ""
    residual = f"residuals of {digits(pair.left)} are correlated by {pair.related:+.2f}"
    if pair.one or redundant(pair, drafted.signals):
        ratio = unit_ratio(drafted.signals[pair.first], drafted.signals[pair.second], pair.gain)
        units = [drafted.signals[k].series.unit for k in (pair.first, pair.second)]
        scaled = f", of which {digits(ratio)} is the unit ({units[1]} per {units[0]})" if all(units) and ratio else ""
        noise = "noise, so " if pair.one else "so "
        kind = f"{noise}two sensors of one state{scaled if units[0] != units[1] else ''}"
    else:
        kind = "more than noise, so two states"
    return f"{other} = {line} {one}{behind} {share}; {residual}: {kind}"


def _state_text(item: Moves) -> str:
    sensors = ", ".join(reads.name for reads in item.sensors)
    r = f"σ of {sensors}: {', '.join(digits(math.sqrt(reads.r)) for reads in item.sensors)}"
    if item.lag is not None:
        moves = (
            f"follows {', '.join(item.inputs)} with {seconds_text(item.lag.tau)}, which explains "
            f"{percent(item.lag.explained)} of the second half when fitted to the first"
        )
        moves += "; the residual drifts" if item.smooth else "; the residual is a random walk"
    else:
        moves = "has a speed that is a random walk" if item.smooth else "is a random walk"
    return f"{item.name}: {moves}; Q {digits(item.q)} per second; {r}"


def _draft_json(every: list[Signal], drafted: DraftPlan) -> JsonObject:
    """Return `signals`, `pairs`, `states` and `inputs` for scripts."""
    names = [one.name for one in drafted.signals]
    return {
        "signals": [
            {key: getattr(one, key) for key in ("name", "message", "rate", "holes", "levels", "noise", "kind", "wraps")}
            | {"unit": one.series.unit, "number": one.series.values.size}
            | {"longest_gap": one.longest, "step": one.resolution}
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
        "roles": roles_json(drafted)["roles"],
    }
