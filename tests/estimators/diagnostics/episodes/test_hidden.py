"""What lasts of a sensor hides no later cause that asks for more: that one has an episode of its own."""

import numpy as np
import pytest

from estimators.diagnostics.episodes import found_in, judged_rows
from estimators.log import Log
from estimators.tuning import Tuning
from tests.support import folded

from .test_find import LIMITED, POLICY

N, BEGIN, END = 1500, 700, 1000
"""Readings of the gauge, one a second, and those that are changed."""


def found(change, tuning, n=N):
    """Episodes of the gauge, by key; `change` (readings, noise) -> readings from BEGIN to END."""
    rng = np.random.default_rng(5)
    level = np.cumsum(0.05 * rng.standard_normal(N))
    y = level + 0.2 * rng.standard_normal(N)
    y[BEGIN:END] = change(y[BEGIN:END])
    log, t = Log.of(LIMITED), np.arange(1.0, n + 1.0)
    log.add("gauge", t, y[:n])
    log.add("chain", t, level[:n, None] + rng.standard_normal((n, 8)))
    fold = folded("kf", LIMITED, log, tuning, policy=POLICY)
    items = found_in(judged_rows(fold))
    return {item.key[0]: item.episode for item in items if item.episode.subject == "gauge"}, len(items)


WIDE = Tuning.of(LIMITED).set("R.gauge", 1.0)
"""A gauge that is believed to be five times as noisy as it is, from the first reading to the last."""

GATED_WIDE = WIDE.set("gate", 0.9999).set("gate.reopen", None)

CAUSES = {
    "screened": (WIDE, lambda y: y + 500.0),
    "refused": (GATED_WIDE, lambda y: y + 50.0),
    "stuck": (WIDE, lambda y: np.full_like(y, y[0])),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_what_asks_for_more_has_an_episode_of_its_own(cause):
    """Afterwards, and while it lasts."""
    tuning, change = CAUSES[cause]
    for n, end in ((N, END), (BEGIN + 120, None)):
        told, _ = found(change, tuning, n)
        assert {key: each.cause for key, each in told.items()} == {"sensor": "wide", "lost": cause}
        assert (told["lost"].start, told["lost"].end) == pytest.approx((BEGIN + 1.0, end), abs=1e-6)
        assert told["sensor"].start < 60.0 and told["sensor"].end is None and "again" not in told["sensor"].text


def test_what_is_of_one_cause_is_one_episode():
    """The refusals with which it begins, and what the other tests say of the same readings."""
    told, _ = found(CAUSES["refused"][1], Tuning.of(LIMITED).set("gate", 0.9999).set("gate.reopen", None))
    assert [episode.cause for episode in told.values()] == ["refused"]


def test_one_that_is_stuck_and_then_elsewhere_has_two():
    """Equal for 150 readings, then beyond its range for 150."""

    def change(y):
        return np.where(np.arange(y.size) < 150, y[0], y + 500.0)

    told, _ = found(change, Tuning.of(LIMITED))
    assert (told["sensor"].cause, told["lost"].cause) == ("stuck", "screened")
    assert told["lost"].start == pytest.approx(BEGIN + 151.0, abs=0.5)
