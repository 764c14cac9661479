"""`nisus why TWIN`: attribute a change of the estimate to the model, the inputs and the measurements."""

from __future__ import annotations

import numpy as np

from estimators.attribution import Attribution, attribution
from estimators.errors import ConfigError, nearest

from ..render.text import to_text
from ..result import to_json
from ..study.why import why_json, why_topics
from ..twin.log_reader import read_log
from .arguments import WhyCommand as Arguments
from .options import moment_of
from .prepare import attend, prepared

MAX_COLUMNS = 4  # states in a table; --state names others


def explain_change(arguments: Arguments) -> int:
    """Print what the estimate at a time is owed to."""
    twin = prepared(arguments)
    names = [state.name for state in twin.model.shown_states]
    for name in arguments.state:
        if name not in names:
            raise ConfigError(f"--state {name}: {twin.name} has no such state; {nearest(name, names)}")
    log, _ = read_log(twin, arguments.duration)
    events = log.events
    until = int(events.t[-1]) if arguments.at is None else moment_of("--at", arguments.at, events)
    span = twin.config.view.window if arguments.span is None else arguments.span
    if not span > 0.0:
        raise ConfigError(f"--span {span:g}: must be positive")
    fold = twin.fold(log, policy=twin.policy, expected=twin.expected)
    found: Attribution = attend(twin.model, lambda: attribution(fold, until - round(span * 1e9), until), "folding")
    origin = int(events.t[0])
    if arguments.json:
        print(to_json({"twin": twin.name, "estimator": twin.estimator, **why_json(twin.model, found, origin)}))
        return 0
    std = fold.track.std[fold.n - 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        order = np.argsort(-np.abs(found.after - found.before) / np.where(std > 0.0, std, np.inf), kind="stable")
    chosen = [names.index(name) for name in arguments.state] or sorted(order[:MAX_COLUMNS].tolist())
    print(to_text(why_topics(twin.model, found, origin, chosen)))
    if not arguments.state and len(names) > MAX_COLUMNS:
        print(f"\n  {len(names) - MAX_COLUMNS} other states moved by fewer σ; --state names them")
    return 0
