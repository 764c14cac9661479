"""`nisus advise`: which estimator for a twin, by what its log shows, with the figure behind each claim."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from ..advice.lines import apply, lines
from ..advice.measured import Measured
from ..advice.verdict import Advice, advise
from ..twin.twin import load_twin
from .advise_text import as_dict, as_text
from .arguments import settings
from .fold import read_log
from .prepare import attend, prepare

if TYPE_CHECKING:
    from .arguments import Advise as Arguments


def advise_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set, arguments.estimator)
    )
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    told: Advice = attend(twin.model, lambda: advise(Measured(twin, log)), "measuring")
    if arguments.json:
        print(json.dumps(as_dict(twin, log, told), allow_nan=False))
    else:
        print("\n".join(as_text(twin, log, told)))
    if arguments.apply or arguments.out is not None:
        kept = apply(twin.path, lines(told), arguments.out)
        print(f"{arguments.out or twin.path}: estimator is {told.estimator}" + (f"; as it was: {kept}" if kept else ""))
    return 0
