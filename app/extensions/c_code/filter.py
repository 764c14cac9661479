"""C99 source of a twin's filter, for a controller: prediction, update, gate, without allocation, and its test.

    NAME.h, NAME.c         the filter; `-DREAL=float` builds it in single precision
    NAME_vectors.csv       measurements of the twin's own log, with the estimate of the fold after each
    NAME_test.c            a program that folds the vectors with the filter and prints the largest differences

The C code does what estimators/gaussian/ekf.py does with the Joseph form (of a linear model, that is the Kalman
filter), or kf_steady.py. What surrounds a filter stays in the twin: screening, the reopening of its gate, detectors,
health.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimators.compiled.context import SLACK
from estimators.errors import ConfigError, EstimatorError, ModelError
from estimators.estimator import Options
from estimators.fold import folded
from estimators.gaussian import kf_steady
from estimators.gaussian.robust import OWN
from estimators.log import BEFORE, INPUT, MARK, READING, TICK, TRUTH, Log
from estimators.model.parts import Sensor, covariance_of
from estimators.model.state_space import StateSpaceModel
from estimators.model.wrapping import is_derived
from estimators.numerics.jit import plain
from estimators.numerics.quantiles import chi_square_quantile
from estimators.registry import find_estimator
from estimators.track import GATED, MISSING, USED
from estimators.tuning import Tuning

from .terms import COMPARISONS, Reader, Statements, number

FILTERS = ("kf", "kf-steady", "ekf")
"""Filters that are written as C."""

MAX_STATES = 32
"""States of a model that a controller folds."""

MAX_OPERATIONS = 20_000
"""Operations of the formulas of a model for a controller."""

STEADY_STATE = "kf-steady"

CYCLES = {"/": 14, "sqrt": 14, "floor": 3, "fabs": 1, "pow": 150, "atan2": 90}
"""Cycles of an operation on a processor with a floating-point unit of single precision (Cortex-M4F)."""

FUNCTION_CYCLES = 70
"""Cycles of another function, as exp and sin."""

BYTES_PER_OPERATION = 6
"""Bytes of an operation's instructions with its share of loads and stores, in Thumb-2."""

UPDATE_BYTES = 2_000
"""Bytes of prediction and update of the covariance."""

VERDICTS = {USED: 0, GATED: 1, MISSING: 2}
"""Numbers of the C code for verdicts; every other one is 3, failed."""

INPUTS_KIND, QUERY_KIND = -1, -2
"""First column of the vectors, in place of a sensor: inputs; a time at which the estimate is only predicted."""

SHORTEST_ENDS = ("a reset or a maintenance", "the twin reopens the gate, which the C code does not")


@dataclass(frozen=True)
class CSource:
    """Files of an exported filter: names and texts, with their costs.

    state_bytes: size of the filter's memory in single precision. code_bytes: size of its instructions, estimated.
    predict_cycles, update_cycles: cycles of a step, and of an update by the longest sensor, estimated.
    events: rows of the vectors. ends: why they end before the log does; empty if they do not.
    """

    files: dict[str, str]
    state_bytes: int
    code_bytes: int
    predict_cycles: int
    update_cycles: int
    events: int
    ends: str


def export_c(name: str, estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, events: int) -> CSource:
    """Return the C source of a filter.

    Args:
        name: Prefix of files, types and functions.
        estimator: One of `FILTERS`.
        model: The model.
        tuning: Q, R, parameters, gate, options, sensors in use.
        log: Log of the test vectors.
        events: Largest number of their rows.

    Raises:
        ConfigError: If the filter, its options or the model cannot be written as C, with the reason and the remedy.
    """
    options = find_estimator(estimator, model).complete_for(model, tuning.options)
    if reason := _refusal(estimator, model, tuning, options):
        raise ConfigError(f"{name}: {reason}")
    try:
        formulas = Formulas(model, tuning)
    except ModelError as error:
        raise ConfigError(
            f"{name}: {model.name} cannot be written as C: {error}; write it as a formula, "
            "or move branches to functions of their own"
        ) from None
    if formulas.size > MAX_OPERATIONS:
        raise ConfigError(
            f"{name}: the formulas of {model.name} have {formulas.size:,} operations, more than {MAX_OPERATIONS:,}; "
            "export a smaller model of the same asset"
        )
    prefix = _identifier(name)
    parts = Steady if estimator == STEADY_STATE else Kalman
    try:
        text = parts(prefix, model, tuning, options, formulas)
    except EstimatorError as error:
        raise ConfigError(f"{name}: {error}") from None
    vectors, ends = _vectors(estimator, model, tuning, log, events)
    files = {
        f"{prefix}.h": text.header(f"{model.title}: {estimator}, written by Nisus."),
        f"{prefix}.c": text.source(),
        f"{prefix}_test.c": text.test(),
        f"{prefix}_vectors.csv": "".join(f"{','.join(map(repr, row))}\n" for row in vectors),
    }
    predict, update = text.cycles()
    code = BYTES_PER_OPERATION * formulas.size + UPDATE_BYTES
    return CSource(files, 4 * text.numbers, code, predict, update, len(vectors), ends)


def _refusal(estimator: str, model: StateSpaceModel, tuning: Tuning, options: Options) -> str:
    """Return why a filter cannot be written as C, with the remedy; empty if it can."""
    if estimator not in FILTERS:
        return f"{estimator} cannot be written as C; choose one of {', '.join(FILTERS)} (--estimator)"
    if model.nx > MAX_STATES:
        return f"{model.nx:,} states are more than {MAX_STATES}; export a smaller model of the same asset"
    if model.black_box or model.jump is not None:
        return "a black box and a model with a mode have no formulas; export another model of the same asset"
    if any(sensor.log_likelihood for sensor in model.sensors):
        return "a sensor with a likelihood function has no variance; give it rows with one"
    if not tuning.used.any():
        return "all sensors are held out; use one (--set use.NAME=true)"
    if tuning.gate is not None and tuning.gate_kind == "soft":
        return "a soft gate cannot be written as C; use --set gate.kind=hard"
    if estimator == STEADY_STATE and model.correlated:
        return "kf-steady with correlated rows cannot be written as C; use kf"
    for name, neutral in (("inflation", 1.0), ("robust", 0.0), ("adapt", 0.0)):
        if options.get(name, neutral) != neutral:
            return f"the option {name} cannot be written as C; leave it at its default"
    return ""


class Formulas:
    """The formulas of a model: f, its Jacobian F, the noise Q, and h and H of each sensor in use, as terms."""

    def __init__(self, model: StateSpaceModel, tuning: Tuning) -> None:
        reader, n = Reader(), model.nx
        sizes = {"x": n, "u": model.nu, "p": len(model.parameters), "q": len(model.noises)}
        x, u, p, q = (reader.symbols(name, size) for name, size in sizes.items())
        dt = reader.term("symbol", "dt")
        self.f = reader.read(model.f, (x, u, p, dt), (n,))
        own = model.F is not None and not is_derived(model.F)
        self.F = reader.read(model.F, (x, u, p, dt), (n, n)) if own else reader.jacobian(self.f, x)  # type: ignore[arg-type]
        if model.Q is not None:
            self.Q = reader.read(model.Q, (x, u, p, q, dt), (n, n))
        else:
            self.Q = np.full((n, n), reader.constant(0.0), object)
            for k, noise in enumerate(model.noises):
                for j in model.acts_on(noise.name):
                    self.Q[j, j] = self.Q[j, j] + q[k] * dt
        self.h: dict[int, np.ndarray] = {}
        self.H: dict[int, np.ndarray] = {}
        for k in np.flatnonzero(tuning.used).tolist():
            sensor = model.sensors[k]
            rows = len(sensor.rows)
            self.h[k] = reader.read(sensor.h, (x, u, p), (rows,))
            own = sensor.H is not None and not is_derived(sensor.H)
            self.H[k] = reader.read(sensor.H, (x, u, p), (rows, n)) if own else reader.jacobian(self.h[k], x)  # type: ignore[arg-type]

    def statements(self, **arrays: Any) -> Statements:
        """Return the statements that assign the entries of arrays."""
        return Statements(
            [
                ("".join([name, *(f"[{k}]" for k in place)]), array[place])
                for name, array in arrays.items()
                for place in np.ndindex(array.shape)
            ]
        )

    @property
    def size(self) -> int:
        """Number of operations."""
        parts = [self.statements(F=self.F, Q=self.Q, f=self.f)]
        parts += [self.statements(h=self.h[k], H=self.H[k]) for k in self.h]
        return sum(len(item.operations) for item in parts)


class Kalman:
    """Text of a filter with a covariance."""

    template = "kalman.c"
    covariance = True
    step_lines: tuple[str, ...] = (
        "real F[N][N], Q[N][N], f[N];",
        "transition(filter->x, u, dt, F, Q, f);",
        "spread(filter->P, F, Q);",
    )

    def __init__(
        self, prefix: str, model: StateSpaceModel, tuning: Tuning, options: Options, formulas: Formulas
    ) -> None:
        self.prefix, self.model, self.tuning, self.options, self.formulas = prefix, model, tuning, options, formulas
        self.rows = max(len(model.sensors[k].rows) for k in formulas.h)
        self.numbers = model.nx + model.nx**2 * self.covariance
        spread = {"F": formulas.F, "Q": formulas.Q} if self.covariance else {}
        slopes = {k: {"H": H} if self.covariance else {} for k, H in formulas.H.items()}
        self.moving = formulas.statements(**spread, f=formulas.f)
        self.updates = {k: formulas.statements(h=h, **slopes[k]) for k, h in formulas.h.items()}

    def header(self, title: str) -> str:
        """Return NAME.h."""
        name, upper, model = self.prefix, self.prefix.upper(), self.model
        sizes = {"STATES": model.nx, "INPUTS": model.nu, "ROWS": self.rows}
        places = {f"X_{_identifier(item).upper()}": k for k, item in enumerate(model.state_names)}
        places |= {f"U_{_identifier(item).upper()}": k for k, item in enumerate(model.input_names)}
        answers = {"USED": 0, "GATED": 1, "MISSING": 2, "FAILED": 3}
        enums = [
            f"enum {{ {', '.join(f'{upper}_{key} = {value}' for key, value in group.items())} }};"
            for group in (sizes, places, answers)
        ]
        lines = [
            f"/* {title} */", f"#ifndef {upper}_H", f"#define {upper}_H", "",
            "#ifndef REAL", "#define REAL double /* or float */", "#endif", "",
            *enums[:2], "/* Answers of an update; the state is changed by the first only. */", enums[2], "",
            "typedef struct {", f"    REAL x[{model.nx}]; /* {_units(model.states)} */",
            *([f"    REAL P[{model.nx}][{model.nx}]; /* covariance */"] if self.covariance else []),
            f"}} {name}_filter;", "",
            "/* Set the prior. */", f"void {name}_start({name}_filter *filter);", "",
            f"/* Predict dt seconds on, with these inputs: {_units(model.inputs) or 'none'}. */",
            f"void {name}_predict({name}_filter *filter, const REAL *u, REAL dt);", "",
            "/* Correct by a measurement y; NAN is a missing row. r: variances of the rows in place of the tuned",
            "   ones (0: as tuned), or a null pointer. nis gets the normalised innovation squared, dof its degrees of",
            "   freedom. */",
        ]  # fmt: skip
        for k in self.updates:
            lines += [f"/* {_units(model.sensors[k].rows)} */", f"{self._signature(k)};"]
        return "\n".join([*lines, *self.remarks(), "", "#endif", ""])

    def remarks(self) -> list[str]:
        """Return the last lines of the header."""
        return []

    def _signature(self, sensor: int) -> str:
        given = "const REAL *u, const REAL *y, const REAL *r, REAL *nis, int *dof"
        return f"int {self._update_name(sensor)}({self.prefix}_filter *filter, {given})"

    def _update_name(self, sensor: int) -> str:
        return f"{self.prefix}_update_{_identifier(self.model.sensor_names[sensor])}"

    def source(self) -> str:
        """Return NAME.c."""
        model, name = self.model, self.prefix
        head = ["#include <math.h>", "#include <tgmath.h>", "", "typedef REAL real;"]
        head += ["#define R(number) ((real)(number))", f"#define N {model.nx}", f"#define M {self.rows}", ""]
        constants = [*_constants("p", self.tuning.p, model.parameters)]
        constants += _constants("q", self.tuning.q, model.noises) if self.covariance else []
        start = [f"filter->x[{k}] = {number(float(value))};" for k, value in enumerate(model.prior_mean)]
        if self.covariance:
            start += [f"filter->P[{i}][{j}] = {number(float(v))};" for (i, j), v in np.ndenumerate(model.prior_cov)]
        steps = ["if (!(dt > 0)) return;", "step(filter, u, dt);"]
        if np.isfinite(model.max_step):
            # As steps_of in estimators/compiled/context.py.
            count = f"const int steps = (int)ceil(dt / {number(float(model.max_step))} - R({SLACK}));"
            steps = [steps[0], count, "for (int k = 0; k < (steps > 1 ? steps : 1); k++)"]
            steps += ["    step(filter, u, dt / (real)(steps > 1 ? steps : 1));"]
        out = [f'#include "{name}.h"', "", *head, *constants, "", *_template(self.template), ""]
        out += _function(f"void {name}_start({name}_filter *filter)", start)
        given = "real F[N][N], real Q[N][N], " if self.covariance else ""
        transition = f"static void transition(const real *x, const real *u, real dt, {given}real *f)"
        out += _function(transition, [*self._unused(self.moving, "u", "dt"), *self.moving.lines])
        out += _function(f"static void step({name}_filter *filter, const real *u, real dt)", self.step())
        out += _function(f"void {name}_predict({name}_filter *filter, const REAL *u, REAL dt)", steps)
        for k in self.updates:
            out += _function(self._signature(k), self.update(k, model.sensors[k]))
        return "\n".join(out)

    def _unused(self, statements: Statements, *names: str) -> list[str]:
        """Return statements that name what the formulas do not, as compilers warn of it."""
        text = "\n".join(statements.lines)
        names = (*names, "p") if self.tuning.p.size else names
        return [f"(void){name};" for name in names if not re.search(rf"\b{name}\b", text)]

    def _wrapped(self) -> Iterator[str]:
        """Yield the lines that bring angles back to ±π."""
        for k in np.flatnonzero(self.model.circular):
            yield f"filter->x[{k}] = wrap(filter->x[{k}]);"

    def step(self) -> list[str]:
        """Return the lines of a step."""
        return [*self.step_lines, "for (int i = 0; i < N; i++) filter->x[i] = f[i];", *self._wrapped()]

    def update(self, k: int, sensor: Sensor) -> list[str]:
        """Return the lines of an update."""
        return [
            "const real *x = filter->x;",
            *self.tables(k, sensor),
            *self._unused(self.updates[k], "u"),
            *self.updates[k].lines,
            f"const int verdict = correct(filter->x, {self.gain_of(len(sensor.rows))}, circular, limit, y, nis, dof);",
            *self._wrapped(),
            "return verdict;",
        ]

    def gain_of(self, rows: int) -> str:
        """Return the arguments of `correct` from which it has the gain."""
        return f"filter->P, {self.model.nx - self.model.considered}, {rows}, h, H, noise, r"

    def tables(self, k: int, sensor: Sensor) -> list[str]:
        """Return the variables of an update and the constants of a sensor: noise, rows that are angles, gate."""
        rows = len(sensor.rows)
        limits = np.full(rows + 1, np.inf)
        if self.tuning.gate is not None:
            limits[1:] = chi_square_quantile(self.tuning.gate, np.arange(1, rows + 1))
        return [
            f"real h[{rows}]{f', H[{rows}][N]' * self.covariance};",
            _table(f"noise[{rows * rows}]", self.noise(k, sensor).ravel()),
            f"static const int circular[{rows}] = {{{', '.join(str(int(row.circular)) for row in sensor.rows)}}};",
            _table(f"limit[{rows + 1}]", limits),
        ]

    def noise(self, k: int, sensor: Sensor) -> np.ndarray:
        """Return R (rows, rows)."""
        first = self.model.row_start[k]
        return covariance_of(sensor.correlation, self.tuning.r[first : first + len(sensor.rows)])

    def test(self) -> str:
        """Return NAME_test.c."""
        name, model = self.prefix, self.model
        inputs = ", ".join(repr(float(value)) for value in model.default_inputs) or "0"
        calls = [f"if (sensor == {k}) return {self._update_name(k)}(filter, u, y, r, nis, dof);" for k in self.updates]
        update = "static int update(FILTER *filter, int sensor, const REAL *y, const REAL *r, REAL *nis, int *dof)"
        std = "sqrt((double)(filter)->P[k][k])" if self.covariance else "-1.0"
        head = [
            f'#include "{name}.h"', "", *(f"#include <{item}.h>" for item in ("math", "stdio", "stdlib")), "",
            f"#define FILTER {name}_filter", f"#define START {name}_start", f"#define PREDICT {name}_predict",
            f'#define VECTORS "{name}_vectors.csv"', f"#define STD(filter, k) {std}",
            f"enum {{ INPUTS = {model.nu}, ROWS = {self.rows}, SHOWN = {len(model.shown)} }};",
            f"static REAL u[{max(1, model.nu)}] = {{{inputs}}};", "",
        ]  # fmt: skip
        return "\n".join([*head, *_function(update, [*calls, "return -1;"]), *_template("test.c"), ""])

    def cycles(self) -> tuple[int, int]:
        """Return the cycles of a step and of the longest update, estimated."""
        n, m = self.model.nx, self.rows
        update = max(_cycles(item.operations) for item in self.updates.values())
        # F P Fᵀ, gain and Joseph form; or K ν and the NIS alone.
        more = (4 * n**3, 10 * n * n * m + 4 * n * m * m + 20 * m) if self.covariance else (0, 3 * n * m + 2 * m * m)
        return _cycles(self.moving.operations) + more[0], update + more[1]


class Steady(Kalman):
    """Text of a filter with a constant gain."""

    template = "steady.c"
    covariance = False
    step_lines = ("real f[N];", "transition(filter->x, u, dt, f);")

    def __init__(
        self, prefix: str, model: StateSpaceModel, tuning: Tuning, options: Options, formulas: Formulas
    ) -> None:
        super().__init__(prefix, model, tuning, options, formulas)
        n, m = model.nx, self.rows
        found = kf_steady.tune(options, model, tuning)[OWN + 2 :]
        K, after, before = np.split(found, [n * m, n * m + n * n])
        self.gain, self.after, self.before = K.reshape(n, m), after.reshape(n, n), before.reshape(n, n)

    def remarks(self) -> list[str]:
        """Return the standard deviations, which are constant."""
        stds = ", ".join(f"{value:.6g}" for value in np.sqrt(np.diag(self.after)))
        return ["", f"/* Standard deviations after a measurement, once the prior is forgotten: {stds}. */"]

    def tables(self, k: int, sensor: Sensor) -> list[str]:
        """Return them with the gain."""
        return [*super().tables(k, sensor), _table(f"gain[{self.gain.size}]", self.gain.ravel()), "(void)r;"]

    def gain_of(self, rows: int) -> str:
        """Return the arguments of `correct` from which it has the gain."""
        return f"{rows}, h, gain, noise"

    def noise(self, k: int, sensor: Sensor) -> np.ndarray:
        """Return S (rows, rows), the covariance of the innovation."""
        u, h = self.model.default_inputs, plain(sensor.h)
        H = kf_steady.columns(lambda x, out: h(x, u, self.tuning.p, out), self.model.nx, len(sensor.rows))
        return H @ self.before @ H.T + super().noise(k, sensor)


def _vectors(
    estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, most: int
) -> tuple[list[list[float]], str]:
    """Return measurements and inputs with the estimate of the fold after each, and why they end before the log does.

    Columns: the sensor (see also INPUTS_KIND), seconds since the last row, readings or inputs, variances of the
    readings (0: as tuned), verdict, NIS (NaN if it is not compared), means, standard deviations.
    """
    fold = folded(estimator, model, tuning, log)
    track, every = fold.track, log.events
    decided = min((item.row for item in fold.decisions), default=fold.n)
    ny = max(len(model.sensors[k].rows) for k in np.flatnonzero(tuning.used))
    clock = None if log.start == BEFORE else int(log.start)
    rows: list[list[float]] = []
    for i in range(fold.n):
        kind, t = int(every.kind[i]), int(every.t[i])
        if kind in (TICK, TRUTH, MARK):
            clock = t if clock is None else clock  # a query begins time, and changes nothing else
            continue
        if kind not in (READING, INPUT):
            return rows, SHORTEST_ENDS[0]
        if i >= decided:
            return rows, SHORTEST_ENDS[1]
        if len(rows) == most:
            return rows, f"--events {most:,}"
        elapsed = 0.0 if clock is None else max(0.0, (t - clock) * 1e-9)
        clock = t if clock is None else max(clock, t)
        value, variance = np.full(max(ny, model.nu), np.nan), np.zeros(ny)
        sensor, verdict, nis = INPUTS_KIND, -1, np.nan
        if kind == INPUT:
            value[: model.nu] = every.value[i, : model.nu]
        elif not tuning.used[every.channel[i]]:
            sensor = QUERY_KIND
        else:
            sensor = int(every.channel[i])
            own = len(model.sensors[sensor].rows)
            value[:own] = np.where(track.screened[i, :own] != 0, np.nan, every.value[i, :own])
            given = every.value[i, model.width : model.width + own]
            variance[: given.size] = np.where(np.isfinite(given), given, 0.0)
            verdict = VERDICTS.get(int(track.verdict[i]), 3) if np.isfinite(value[:own]).any() else VERDICTS[MISSING]
            # The covariance of a steady filter in C is that after the prior is forgotten.
            nis = track.nis[i] if verdict in (0, 1) and estimator != STEADY_STATE else np.nan
        cells = [sensor, elapsed, *value, *variance, verdict, nis, *track.mean[i], *track.std[i]]
        rows.append([float(cell) for cell in cells])
    return rows, ""


def _template(name: str) -> list[str]:
    return (Path(__file__).parent / name).read_text().splitlines()


def _function(head: str, lines: Sequence[str]) -> list[str]:
    return [head, "{", *(f"    {line}" for line in lines), "}", ""]


def _table(place: str, values: np.ndarray) -> str:
    return f"static const real {place} = {{{', '.join(number(float(value)) for value in values)}}};"


def _constants(symbol: str, values: np.ndarray, items: Sequence[Any]) -> Iterator[str]:
    """Yield a table of constants with their names."""
    if values.size:
        yield f"static const real {symbol}[{values.size}] = {{"
        for value, item in zip(values, items, strict=True):
            yield f"    {number(float(value))}, /* {item.name}, {item.unit or '1'} */"
        yield "};"


def _units(items: Sequence[Any]) -> str:
    return "; ".join(f"{item.name}, {item.unit or '1'}" for item in items)


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name)


def _cycles(operations: Sequence[str]) -> int:
    simple = {"+", "-", "*", "?", *COMPARISONS}
    counts = Counter(operations)
    return sum(n * (1 if item in simple else CYCLES.get(item, FUNCTION_CYCLES)) for item, n in counts.items())
