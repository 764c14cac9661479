"""`nisus new NAME`: a working pair of files, one YAML and one Python, for a user to change into a twin of their own."""

from __future__ import annotations

from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

from config.yaml_files import writing
from estimators.errors import ConfigError

from ..result import JsonObject, to_json
from .options import roles_of

if TYPE_CHECKING:
    from ..study.advice.draft import Draft
    from ..study.advice.plan import DraftPlan
    from .arguments import NewCommand as Arguments
    from .arguments import SchemaCommand

MAX_OMISSION_TEXT = 200  # characters of a line of omitted signals

_YAML = Path(__file__).with_name("new.yaml").read_text(encoding="utf-8")

_PYTHON = '''\
"""A tank that a pump fills and a valve empties.

level' = (delivery · speed - outlet · valve · √level) / area,   delivery' = 0
"""

import math

from nisus import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel

# Every function is written for ONE state and fills `out`. x: states, u: inputs, p: parameters, in the order below.
# They are compiled, with the functions that they call: keep to numbers, math and loops; other names must be constants.


def tank(x, u, p, dt, out):
    """The next state, dt seconds later."""
    level, delivery = x[0], x[1]
    speed, valve = u[0], u[1]
    area, outlet = p[0], p[1]
    outflow = outlet * valve * math.sqrt(max(level, 0.0))
    out[0] = level + dt * (delivery * speed - outflow) / area
    out[1] = delivery  # wears slowly; the noise lets it move


def level(x, u, p, out):
    """Measurement of the level sensor, m."""
    out[0] = x[0]


def outflow(x, u, p, out):
    """Measurement of the flow meter behind the valve, m³/s."""
    out[0] = p[1] * u[1] * math.sqrt(max(x[0], 0.0))


{model} = StateSpaceModel(
    name="{name}",
    title="Tank with pump and valve",
    states=(
        State("level", "m", mean=1.0, std=0.3),
        State("delivery", "m³", mean=0.001, std=0.0003),  # a turn
    ),
    inputs=(
        Input("speed", "1/s", default=0.0),
        Input("valve", "1", default=0.0),
    ),
    parameters=(
        Parameter("area", "m²", 0.5, low=0.01, high=100.0),
        Parameter("outlet", "m²·√m/s", 0.02, low=0.0, high=1.0),
    ),
    noises=(
        Noise("level", "m²/s", variance=1e-6),
        Noise("delivery", "m⁶/s", variance=4e-12),
    ),
    sensors=(
        Sensor("level", (Row("level", "m", variance=1e-4),), h=level),
        Sensor("outflow", (Row("outflow", "m³/s", variance=2.5e-7),), h=outflow),
    ),
    f=tank,
    max_step=1.0,  # seconds; the crude integration above is split into steps no longer than this
)
'''


def write_schema(arguments: SchemaCommand) -> int:
    """Write the JSON Schema of a twin's YAML."""
    from config.extensions import leave_out_undescribed

    leave_out_undescribed()
    from config.schema import json_schema_text

    text = json_schema_text()
    if arguments.out is None:
        print(text)
    else:
        with writing(arguments.out, "--out"):
            arguments.out.write_text(text + "\n", encoding="utf-8")
    return 0


def new_twin(arguments: Arguments) -> int:
    """Write the two files of a new twin, a pump or the signals of a recording, and print their paths.

    Raises:
        ConfigError: If the twin cannot be written so.
        SourceError: If a recording cannot be read.
    """
    if arguments.log:
        from ..study.advice.draft import check_new, write_draft
        from ..study.advice.plan import plan
        from .log import complain_of, contents_of, databases_of

        check_new(arguments.name, arguments.folder)
        found = contents_of(arguments.log, arguments)
        planned = plan(found, roles_of(arguments))
        complain_of(found)
        drafted = fit_draft(planned)
        written = write_draft(drafted, found, arguments.name, arguments.folder, databases_of(arguments))
        report_draft(written, arguments.json)
        return 0
    if any((arguments.signals, arguments.sensors, arguments.inputs, arguments.hold_out, arguments.dbc)):
        raise ConfigError(
            "--signals, --sensors, --inputs, --hold-out and --dbc are for recordings; name one with --log FILE"
        )
    paths = write_twin(arguments.name, arguments.folder)
    print(to_json({"written": [str(path) for path in paths]}) if arguments.json else "\n".join(map(str, paths)))
    return 0


def fit_draft(drafted: DraftPlan) -> DraftPlan:
    """Fit a draft and check it, with progress; Ctrl-C keeps what has been fitted, and checks that."""
    from estimators.fit.objective import FitProgress

    from ..study.advice.draft_fit import fit_all
    from .prepare import attend

    state, steps = FitProgress(), [""]

    def stop() -> None:
        state.stop = True

    found: DraftPlan = attend(
        None,
        lambda: fit_all(drafted, steps.append, state),
        "drafting",
        text=lambda: f"{steps[-1]}, {state.folds:,} folds",
        stop=stop,
    )
    return found


def roles_json(drafted: DraftPlan) -> JsonObject:
    """Return the role of every signal, and the check of a fitted draft, for scripts."""
    check = drafted.check
    sensors = [
        one._asdict() | {key: getattr(one, key).value for key in ("coverage", "correlation", "held_out")}
        for one in (check.sensors if check else ())
    ]
    return {
        "check": {**check._asdict(), "sensors": sensors, "consistent": not check.reason} if check else None,
        "roles": [
            {"signal": one.signal.name, "role": one.role, "name": one.name, "reason": one.reason}
            for one in drafted.roles
        ],
    }


def report_draft(draft: Draft, json: bool) -> None:
    """Print the files of a draft, its check, and the next step."""
    from ..study.advice.draft import check_lines, hint_lines, omission_lines
    from ..study.advice.plan import YAML_NAME

    check = draft.plan.check
    written = [str(path) for path in draft.paths]
    if json:
        print(to_json({"written": written, **roles_json(draft.plan)}))
        return
    print("\n".join(written))
    if check is None:
        print("\nNot checked: the filter fails on this recording; choose other signals with --sensors.")
    else:
        print(f"\n{check.fitted_to}:")
        print("\n".join([check.words.replace(YAML_NAME, written[0]), *(f"  {line}" for line in check_lines(check))]))
    for line in hint_lines(draft.plan):
        print(f"\n{line}")
    if omitted := omission_lines(draft.plan):
        print(
            "\n"
            + "\n".join(shorten(line, MAX_OMISSION_TEXT, placeholder=" ... (the YAML lists all)") for line in omitted)
        )
    if check is not None:
        print(f"\nNext: nisus run {written[0]}")


def write_twin(name: str, folder: Path) -> tuple[Path, Path]:
    """Write NAME.yaml and NAME.py, a pair that runs.

    Args:
        name: Letters, digits, _ and -, beginning with a letter.
        folder: An existing folder.

    Returns:
        The two paths.

    Raises:
        ConfigError: If the name or the folder will not do, or one of the files is there already.
    """
    from ..study.advice.draft import check_new, model_of, write_pair

    check_new(name, folder)
    model = model_of(name)
    return write_pair(
        name, folder, *(text.replace("{name}", name).replace("{model}", model) for text in (_YAML, _PYTHON))
    )
