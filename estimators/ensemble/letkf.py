"""The local ensemble transform Kalman filter: the transform of the ETKF, anew for every state, from the rows near it.

At each state the variance of a row is divided by the taper of its distance, so that far rows count less, and rows
beyond the radius not at all. States are independent of each other, and are worked on by all threads.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008, with their smooth localisation: R⁻¹ times a
factor that falls with the distance. Their inflation is of the forecast; here, as in all ensemble filters, it is of the
analysis.
"""

from __future__ import annotations

from ..compiled.context import options as numbers
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.symmetric import gram
from ..track import FAILED, USED
from .analysis import begin_analysis, find_places, work_size
from .etkf import transform_members
from .forecast import add_spread, predict
from .innovation import judge_reading, observe
from .local_transform import transform_locally
from .localisation import localised, prepare
from .ranks import account
from .rotation import ROTATION, rotate
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    RADIUS,
    block,
    describe,
    ensemble,
    moments,
    next_draw,
    points,
    settle,
    start,
    state_size,
    tune,
)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Without localisation it is the ETKF. With a radius so short that neighbours see different rows, the analysis is
    rough in space.
    """
    X = ensemble(context, state)
    a, rest = begin_analysis(context, sensor, X.shape[0], work)
    m = observe(context, sensor, u, y, state, a, innovation, innovation_std, score)
    verdict = judge_reading(context, sensor, m, a, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    given = numbers(context)
    if localised(context):
        # Of each state: a ← (I + Z ρ Zᵀ)^(-1/2) a and x̄ ← x̄ + aᵀ (I + Z ρ Zᵀ)⁻¹ Z ρ d / √(N - 1).
        find_places(m, a.rows, a.places)
        gram(a.Z, X.shape[0], m, a.U)
        transform_locally(context, sensor, X, a, given[INFLATION], int(given[CREWS]), rest)
        rotate(context, index, X, a, rest)
    elif not transform_members(context, index, m, a, X, rest):
        return FAILED
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


LETKF = Estimator(
    name="letkf",
    title="Local ensemble transform Kalman filter",
    family="ensemble",
    assumes="posterior near Gaussian; what is far apart is independent; the model says where states and sensors are",
    model_runs="members",
    fails_when="radius too long for the members (chance covariances) or too short for the physics",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    blocks=block,
    account=account,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS, ROTATION),
    tune=tune,
    prepare=prepare,
)
