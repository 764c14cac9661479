"""Are the corrections of a state too large over its own memory, and is one that was proved wrong corrected yet?

An error of the model that lasts is taken up by small corrections of one sign, each inside its band, which the tests of
single innovations cannot tell from chance (`detectors.py`); the estimate stays wrong by the corrections to come.
Under the model each correction x⁺ - x⁻ of an optimal filter has covariance P⁻ - P⁺ and is uncorrelated with those
before. Carried to the end of a time by the tangent F of the model,

    d ← F d + (x⁺ - x⁻),   D ← F D Fᵀ + (P⁻ - P⁺),   Φ ← F Φ,

d is, to first order, the estimate less the forecast without the measurements of that time, and D its covariance: for a
state j, z = d_j / √D_jj is N(0, 1), and ρ = P_jj / (P_jj + D_jj) is the share of the forecast's variance that the
measurements left. Where ρ is between `LOW` and `HIGH`, the time is the memory of the state. Two times that follow each
other are one: (Φ₂ Φ₁, Φ₂ d₁ + d₂, Φ₂ D₁ Φ₂ᵀ + D₂). So the times of level k are pairs of those of level k - 1, and the
test of a level, a CUSUM of z² as of another variance, runs over pairs that overlap by half. It needs neither a grid of
times nor a horizon to choose, and a measurement costs the same however long the memory is.

Sources: Bar-Shalom, Li & Kirubarajan (2001), 5.2.6 (innovations are white; K S Kᵀ = P⁻ - P⁺); Basseville & Nikiforov
(1993), chapter 2 (CUSUM).
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states, estimated, shown_states
from ..compiled.jacobians import scratch_size, state_jacobian
from ..estimator import Estimator
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, inlined, part, plain
from ..numerics.linalg import congruence, copy, copy_vector, multiply, wrap
from ..numerics.workspace import declare_layout, size_of, view
from .detectors import IMPOSSIBLE, IMPOSSIBLE_AT, MEMORY_AT, MEMORY_FLAGS, memory_flag
from .references import HALF_WIDTH

FIRST, LEVELS = 16, 16  # Measurements of a time of the first level, and the levels: half a million measurements
MAX_STATES = 32  # States of a model whose memory is followed
LOW, HIGH = 0.2, 0.9  # ρ of the times that are a state's memory
VARIANCE = 2.5  # Of z, that the tests look for
MAX_Z = 6.0  # |z| is clipped here: a single correction is no proof
MAX_SENSORS = 52  # Sensors whose first measurement is known from another's; a float64 holds their bits
FIRST_SIGMA = 5.0  # |e| of the first measurement of a sensor that contradicts the prior
BEYOND = np.log(100.0)  # log Λ from which a state is in alarm, until it is half of that; twice that is its highest

COVARIANCE, FACTOR = 1, 2  # What follows the mean in the state of a filter

Time, time_of = declare_layout("Time", "n", Phi="n, n", D="n, n", d="n")
Level, level_of = declare_layout("Level", "n", time_of, last="Time(at, n)", W="n", rho="n", excess="n", kept="2")
Memory, memory_of = declare_layout(
    "Memory",
    "n",
    time_of,
    scratch_size,
    count="2",  # measurements of the present time; bits of the states in alarm
    factor="n",  # of those, by shown state
    first="3",  # bits of sensors heard; bits of states whose prior is wrong, and of impossible ones
    prior="Time(at, n)",  # since a contradicted prior; d: its error
    possible="Time(at, n)",  # since an estimate was impossible; d: less the forecast from its limit
    now="Time(at, n)",
    joined="Time(at, n)",
    x="n",
    P="n, n",
    F="n, n",
    products="2 * n, n",
    jacobian="scratch_size(n, n)",
)


@inlined
def level_words(n):
    """Return the float64s of a level."""
    return 2 * n * n + 4 * n + 2


def memory_context(estimator: Estimator, model: StateSpaceModel, followed: int) -> dict[str, int]:
    """Return the memory's entries of a filter's context.

    `memory` is how the filter's state keeps its spread, `COVARIANCE` or `FACTOR`, or 0 if no memory is `followed`; bits
    of shown states are set in `graded` if their memory is judged, and in `unwatched` if it leaves the twin's health.
    """
    possible = model.nx <= MAX_STATES and not model.black_box and estimator.family == "Gaussian"
    kind = FACTOR if estimator.name.startswith("sr-") else COVARIANCE
    shown = model.shown_states[:MEMORY_FLAGS]
    return {
        "memory": kind if followed and possible else 0,
        "graded": sum(1 << k for k, state in enumerate(shown) if not state.appended),
        "unwatched": sum(memory_flag(k) for k, state in enumerate(shown) if not state.watched),
    }


def fresh_memory(model: StateSpaceModel) -> np.ndarray:
    """Return the memory before the first event."""
    n = model.nx
    memory = np.zeros(size_of(memory_of, n) + LEVELS * size_of(level_of, n))
    np.fill_diagonal(view(plain(memory_of)(0, n).now.Phi, memory), 1.0)
    return memory


@inlined
def _clear(time):
    """No correction, in no time."""
    time.d[:] = 0.0
    time.D[:] = 0.0
    time.Phi[:] = 0.0
    for i in range(time.d.size):
        time.Phi[i, i] = 1.0


@inlined
def _copy(time, other):
    copy(time.D, other.D)
    copy(time.Phi, other.Phi)
    copy_vector(time.d, other.d)


@part
def _carry(F, rows, time, products):
    """Φ ← F Φ, d ← F d, D ← F D Fᵀ, where F is the identity beyond its first `rows`."""
    n = F.shape[0]
    congruence(F, rows, time.D, products)
    multiply(F, rows, time.Phi, products)
    copy(products[:rows], time.Phi)
    moved = products[n]
    for i in range(rows):
        moved[i] = 0.0
        for k in range(n):
            moved[i] += F[i, k] * time.d[k]
    copy_vector(moved[:rows], time.d)


@part
def forget_memory(at, n):
    """Begin again: after a reset, or where a number is not finite."""
    own = memory_of(at, n)
    own.count[0] = own.count[1] = 0.0
    own.first[:] = 0.0
    _clear(own.now)
    for k in range(LEVELS):
        level = level_of(own.end + 8 * k * level_words(n), n)
        level.kept[:] = 0.0
        level.W[:] = 0.0
        level.rho[:] = 0.0
        level.excess[:] = 0.0


@part
def carry_memory(context, at, x, u, dt):
    """Note a prediction of dt seconds from x."""
    own = memory_of(at, context.nx)
    state_jacobian(context, x, u, dt, own.F, own.jacobian)
    _carry(own.F, estimated(context), own.now, own.products)
    if own.first[1] > 0.0:
        _carry(own.F, estimated(context), own.prior, own.products)
    if own.first[2] > 0.0:
        _carry(own.F, estimated(context), own.possible, own.products)


@inlined
def _spread(kind, n, state, P):
    """P (n, n) ← the covariance in the state of a filter."""
    for i in range(n):
        for j in range(i + 1):
            if kind == FACTOR:
                s = 0.0
                for k in range(n):
                    s += state[n + k * n + i] * state[n + k * n + j]
                P[i, j] = P[j, i] = s
            else:
                P[i, j] = P[j, i] = state[n + i * n + j]


@part
def before_update(context, at, state):
    """Keep the prediction."""
    own = memory_of(at, context.nx)
    copy_vector(state[: context.nx], own.x)
    _spread(context.memory, context.nx, state, own.P)


@part
def after_update(context, at, state, sensor, innovation, std):
    """Add a correction, and judge the times that end with it; ν and √diag S (ny,) tell whether the prior was wrong."""
    n = context.nx
    own, circular = memory_of(at, n), circular_states(context)
    copy(own.P, own.F)
    _spread(context.memory, n, state, own.P)
    for i in range(n):
        moved = state[i] - own.x[i]
        own.x[i] = wrap(moved) if circular[i] != 0 else moved
    _hear(own, 1 << min(sensor, MAX_SENSORS), innovation, std)
    for i in range(n):
        for j in range(n):
            own.F[i, j] -= own.P[i, j]
    _correct(own.now, own.x, own.F)
    if own.first[2] > 0.0:
        _correct(own.possible, own.x, own.F)
    if own.first[1] > 0.0:
        own.x[:] = 0.0
        _correct(own.prior, own.x, own.F)
    _weigh_proofs(context, own, state)
    own.count[0] += 1.0
    if own.count[0] >= FIRST:
        _end_time(context, at, own)


@inlined
def _correct(time, moved, taken):
    """Add a correction, and the variance that it has taken."""
    for i in range(moved.size):
        time.d[i] += moved[i]
        for j in range(moved.size):
            time.D[i, j] += taken[i, j]


@inlined
def _hear(own, bit, innovation, std):
    """Note whether the first measurement of a sensor that is used contradicts the prior of the states that it moves.

    Others are correlated with it by less than 1 / `MAX_Z`, so that e of its deviations are none of theirs.
    """
    if int(own.first[0]) & bit == 0 and own.x.any():
        own.first[0] += bit
        e = 0.0
        for k in range(innovation.size):
            e = max(e, abs(innovation[k]) / std[k])
        if e > FIRST_SIGMA:
            if own.first[1] == 0.0:
                _clear(own.prior)
                own.first[1] = 1.0
            for i in range(own.x.size):
                sigma = np.copysign(np.sqrt(own.F[i, i]), own.x[i])
                if MAX_Z * own.x[i] / sigma > e:
                    own.prior.d[i] = min(e, MAX_Z) * sigma


@inlined
def _weigh_proofs(context, own, state):
    """Find the states that have been proved wrong, and are not corrected yet.

    A contradicted prior was wrong by d, min(e, `MAX_Z`) of its deviations, and measurements have left the share
    ρ = P / (P + D) of d: ρ |d| > √P.

    An impossible estimate may come back because the model moves it, which is no correction. If the true state was at
    the limit, it has moved as the model predicts. d is the estimate less that forecast, and as D begins with the row
    and column of the state in -P, P + D is the variance of the forecast. The bands of both do not meet:
    |d| > 1.96 (√P + √(P + D)).
    """
    shown, prior, bits, before = shown_states(context), own.prior, 0, int(own.first[2])
    ranges, found = floats(context.ranges, 6 * shown.size), 0
    for s in range(min(shown.size, MEMORY_FLAGS)):
        j = shown[s]
        P = own.P[j, j]
        if own.first[1] > 0.0 and context.graded >> s & 1 != 0 and prior.d[j] ** 2 * P > (P + prior.D[j, j]) ** 2:
            bits |= 1 << s
        beyond = min(state[j] - ranges[6 * s + 4], 0.0) + max(state[j] - ranges[6 * s + 5], 0.0)
        left = own.possible.d[j] if before >> s & 1 != 0 else 0.0
        if abs(beyond) > HALF_WIDTH * np.sqrt(P) and abs(beyond) > abs(left):
            if before | found == 0:
                own.possible.d[:] = 0.0
            left = own.possible.d[j] = beyond
            own.possible.D[:] = 0.0
            for k in range(own.x.size):
                own.possible.D[j, k] = own.possible.D[k, j] = -own.P[j, k]
        if abs(left) > HALF_WIDTH * (np.sqrt(P) + np.sqrt(max(P + own.possible.D[j, j], 0.0))):
            found |= 1 << s
    own.first[1], own.first[2] = bits, found


@inlined
def memory_flags(context, at, factor):
    """Return the bits of `Track.flags` of the states in alarm, and set the `Track.factor` of each."""
    own = memory_of(at, context.nx)
    bits = int(own.count[1])
    for s in range(min(factor.size, MEMORY_FLAGS)):
        if bits >> s & 1 != 0:
            factor[s] = own.factor[s]
    bits = (bits | int(own.first[1])) << MEMORY_AT | int(own.first[2]) << IMPOSSIBLE_AT
    return bits | IMPOSSIBLE if own.first[2] > 0.0 else bits


@part
def _end_time(context, at, own):
    """End a time of the first level, and of each level that it completes."""
    n = context.nx
    own.count[0] = 0.0
    for k in range(LEVELS):
        level = level_of(own.end + 8 * k * level_words(n), n)
        completes = level.kept[1] != 0.0
        if level.kept[0] != 0.0:
            _copy(level.last, own.joined)
            _carry(own.now.Phi, estimated(context), own.joined, own.products)
            for i in range(n):
                own.joined.d[i] += own.now.d[i]
                for j in range(n):
                    own.joined.D[i, j] += own.now.D[i, j]
            if not _weigh(own.joined, own.P, estimated(context), level):
                forget_memory(at, n)
                return
        _copy(own.now, level.last)
        level.kept[0] = 1.0
        level.kept[1] = 0.0 if completes else 1.0
        if not completes:
            break
        _copy(own.joined, own.now)
    _clear(own.now)
    own.count[1] = float(_in_alarm(context, own, int(own.count[1])))


@inlined
def _weigh(time, P, estimated, level):
    """Add log Λ of a time to the tests of its level; False if a number is not finite.

    A considered parameter δ stays in the error, Cov(d, δ) = D_δ, so corrections that it causes follow each other: to
    the variance of d comes -2 D_δ P_δ / P_δδ, for independent δ and times longer than the memory; for shorter ones
    it is an approximation. Only what widens the variance is added.
    """
    for j in range(level.W.size):
        D = time.D[j, j]
        rho = P[j, j] / (P[j, j] + D)
        if not (np.isfinite(rho) and np.isfinite(time.d[j])):
            return False
        level.rho[j] = rho
        # A correction of a prior that hardly counts tells nothing of the model.
        if LOW < rho < HIGH:
            shared = 0.0
            for k in range(estimated, level.W.size):
                shared += time.D[j, k] * P[k, j] / P[k, k]
            z = min(abs(time.d[j]) / np.sqrt(D + 2.0 * max(0.0, -shared)), MAX_Z)
            # Half of each time is in the one before, too.
            gained = 0.25 * (1.0 - 1.0 / VARIANCE) * z * z - 0.25 * np.log(VARIANCE)
            level.W[j] = min(max(level.W[j] + gained, 0.0), 2.0 * BEYOND)
            level.excess[j] += 0.25 * (z * z - 1.0 - level.excess[j])
    return True


@inlined
def _in_alarm(context, own, before):
    """Return the bits of the shown states whose corrections are too large over their memory, and set their factors."""
    bits, shown = 0, shown_states(context)
    for s in range(min(shown.size, MEMORY_FLAGS)):
        j, beyond = shown[s], 0.5 * BEYOND if before >> s & 1 else BEYOND
        most = excess = 0.0
        for k in range(LEVELS):
            level = level_of(own.end + 8 * k * level_words(context.nx), context.nx)
            # ρ is 0 until two times of the level have ended.
            if LOW < level.rho[j] < HIGH and level.W[j] >= 0.5 * BEYOND:
                most = max(most, level.W[j])
                excess = max(excess, level.excess[j])
        if context.graded >> s & 1 != 0 and most >= beyond:
            bits |= 1 << s
            own.factor[s] = np.sqrt(1.0 + excess)
    return bits
