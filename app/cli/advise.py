"""`nisus advise`: which estimator for a twin, by what its log shows, with the figure behind each claim."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from config.loader import shipped
from estimators.errors import ConfigError

from ..studies.advice.advice_json import advice_json
from ..studies.advice.lines import apply, lines
from ..studies.advice.measured import Measured
from ..studies.advice.verdict import Advice
from ..studies.advice.verdict import advise as verdict
from ..twin.twin import load_twin
from .advise_text import as_text
from .fold import read_log
from .given import settings
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
        from .advise_log import advise_log

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
