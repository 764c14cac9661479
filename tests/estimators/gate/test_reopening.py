"""Two stories about a sensor that stays refused, and the bits that are the same in whatever pieces they are told."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from estimators.diagnostics.episodes import episodes
from estimators.fold import Fold
from estimators.gate.isolation import MIN_VARIANCE_SHARE, ReopeningEvidence, cost, decided, widening
from estimators.gate.rejection_runs import MIN_RUN, RUN_PROBABILITY, rule_of
from estimators.log import MAINTENANCE, READING, RESET, Events, Log
from estimators.track import GATED, USED
from estimators.tuning import Tuning
from tests.models import first_state, level_model
from tests.support import SECOND, arrive, as_log, assert_same
from tests.support import folded as advanced

from .two_sensors import JUMP, MODEL, TUNING, series

FILTERS = ["kf", "sr-kf", "pf", "enkf", "filterpy-kf"]


def folded(name, events, tuning=TUNING, **rest):
    return advanced(name, MODEL, as_log(events), tuning, **rest)


def outcomes(growing):
    return [decision.outcome for decision in growing.decisions]


@pytest.mark.parametrize("name", FILTERS)
def test_a_sensor_that_jumps_is_isolated(name):
    """The other sensor contradicts it with its first reading, half a second later."""
    growing = folded(name, series(1, a=5.0))
    isolated = growing.decisions[1]
    assert outcomes(growing)[:2] == ["doubted", "isolated"] and set(outcomes(growing)[2:]) <= {"isolated"}
    assert isolated.sensor == "a" and JUMP < isolated.time < JUMP + 1.0
    assert isolated.witnesses == 1 and isolated.evidence < -np.log(1000.0)
    assert abs(growing.track.mean[-1, 0]) < 1.0
    after = (growing.events.channel == 0) & (growing.events.t >= JUMP * SECOND)
    assert not np.any(growing.track.verdict[after] == USED)


@pytest.mark.parametrize("name", FILTERS)
def test_an_asset_that_jumps_is_followed(name):
    growing = folded(name, series(1, a=5.0, b=5.0))
    assert outcomes(growing) == ["doubted", "reopened"]
    reopened = growing.decisions[1]
    assert JUMP < reopened.time < JUMP + 1.0 and reopened.evidence > np.log(1000.0)
    late = growing.events.t > (JUMP + 1.0) * SECOND
    assert not np.any(growing.track.verdict[late] == GATED)
    # The level's own walk: 0.01 m in a root second, over 60 s.
    assert abs(growing.track.mean[-1, 0] - 5.0) < 4 * 0.01 * np.sqrt(60.0) + 0.1


@pytest.mark.parametrize("name", FILTERS)
def test_where_nothing_tells_the_asset_is_believed_after_a_time(name):
    growing = folded(name, series(1, a=5.0, with_b=False))
    assert outcomes(growing) == ["doubted", "believed"]
    believed = growing.decisions[1]
    assert JUMP + 30.0 <= believed.time <= JUMP + 30.0 + 0.15 and believed.witnesses == 0
    assert "no evidence for 30 s" in believed.text
    at = believed.row - growing.log.first
    assert growing.track.verdict[at] == GATED and np.all(growing.track.verdict[at + 1 :] != GATED)
    sooner = folded(name, series(1, a=5.0, with_b=False), TUNING.set("gate.reopen", 5.0))
    assert sooner.decisions[1].time == pytest.approx(JUMP + 5.0, abs=0.15)
    never = folded(name, series(1, a=5.0, with_b=False), TUNING.set("gate.reopen", None))
    assert not never.decisions and np.sum(never.track.verdict == GATED) == 400


def test_a_jump_after_maintenance_is_the_twins():
    """The asset has been changed, so the sensor is believed as soon as chance no longer explains its rejections."""
    events = series(1, a=5.0, with_b=False)
    t = round((JUMP - 0.05) * SECOND)
    growing = folded("kf", Events.concat([events, Events.one(t, t, MAINTENANCE, 0, (), 1)], 1))
    assert outcomes(growing)[-1] == "believed" and growing.decisions[-1].time < JUMP + 1.0
    said = "maintenance has changed the asset, so the twin is wrong rather than the sensor"
    assert growing.decisions[-1].text.endswith(said)
    track = advanced("kf", MODEL, growing.log, TUNING.set("gate.reopen", None))
    assert any(episode.cause == "refused" and episode.text.endswith(said) for episode in episodes(track))


def test_a_sensor_gone_wild_is_isolated_by_its_own_readings():
    """Noise a hundred times what it was: whatever is believed, the next reading contradicts it."""
    growing = folded("kf", series(2, noise_a=10.0, with_b=False))
    assert "isolated" in outcomes(growing) and "believed" not in outcomes(growing)
    assert "contradict one another" in next(d.text for d in growing.decisions if d.outcome == "isolated")
    assert abs(growing.track.mean[-1, 0]) < 1.0


def test_a_sensor_that_agrees_again_is_said_to():
    growing = folded("kf", series(1, a=5.0, until=30.0))
    assert outcomes(growing) == ["doubted", "isolated", "agrees"]
    # Ten readings in a row that pass, at 10 Hz.
    assert growing.decisions[-1].time == pytest.approx(30.9, abs=0.15)


def test_questions_after_an_isolation_are_ever_further_apart():
    growing = folded("kf", series(1, a=5.0, seconds=300.0))
    times = [decision.time for decision in growing.decisions if decision.outcome == "isolated"]
    assert len(times) == 4 and np.allclose(np.diff(times), [30.0, 60.0, 120.0], atol=0.3)


def test_a_twin_begun_elsewhere_believes_its_first_readings():
    """Nothing confirmed the start, so a sensor that was refused from its first reading is believed at once."""
    prior = np.array([300.0]), np.array([[0.01]])
    growing = folded("kf", series(1, with_b=False), prior=prior)
    first = growing.decisions[0]
    assert outcomes(growing) == ["believed"] and first.refused == 3 and first.time < 0.5
    assert "from its first" in first.text
    assert abs(growing.track.mean[-1, 0]) < 1.0


def test_undamaged_readings_raise_no_doubt():
    for seed in range(5):
        assert not folded("kf", series(seed, seconds=200.0)).decisions


STORIES = [dict(a=5.0), dict(a=5.0, b=5.0), dict(a=5.0, with_b=False), dict(a=1.0, b=0.6, noise_a=0.5)]


@pytest.mark.parametrize(
    ("name", "story", "kind"),
    [
        *((name, story, "soft" if (k + story) % 2 else "hard")
          for (k, name), story in product(enumerate(["kf", "pf", "enkf"]), range(len(STORIES)))),
        ("filterpy-kf", 0, "soft"),
    ],
)  # fmt: skip
def test_pieces_and_order_of_arrival_do_not_matter(name, story, kind):
    events = series(story, **STORIES[story])
    reset = Events.one(int(25.05 * SECOND), 0, RESET, 0, np.nan, MODEL.width)
    if story == 0:
        events = as_log(Events.concat([events, reset], MODEL.width)).events
    tuning = TUNING.set("gate.kind", kind)
    whole = folded(name, events, tuning)
    assert whole.decisions
    rng = np.random.default_rng(story)
    order = np.argsort(np.arange(len(events)) + rng.exponential(20.0, len(events)))
    order = np.concatenate(([0], order[order != 0]))
    log = Log(MODEL.width, capacity=1)
    growing = Fold(name, MODEL, tuning, log)
    assert arrive(growing, [events.select(part) for part in np.array_split(order, 150)], rng) > 10
    assert_same(growing.track, whole.track)
    assert [tuple(d) for d in growing.decisions] == [tuple(d) for d in whole.decisions]


def test_a_fold_from_a_base_decides_as_the_whole_one():
    """That a sensor had agreed before is part of the base: else it would be believed at its first refusals."""
    events = series(1, a=5.0, with_b=False)
    whole = folded("kf", events)
    at, base = whole.base_at(200)
    assert at == 192
    tail = as_log(events.select(slice(at, None)))
    tail.first = at
    rest = advanced("kf", MODEL, tail, TUNING, base=base)
    assert np.array_equal(rest.track.mean, whole.track.mean[at:])
    assert [d.outcome for d in rest.decisions] == ["doubted", "believed"]


def test_most_refusals_in_a_row_that_chance_explains():
    for gate in (0.5, 0.95, 0.999):
        most = rule_of(gate, "hard", True).most
        assert (1.0 - gate) ** most <= RUN_PROBABILITY < (1.0 - gate) ** (most - 1)
    assert rule_of(0.999999, "hard", True).most == MIN_RUN
    assert rule_of(0.95, "hard", False).most == 0 and rule_of(None, "soft", True) == (0, 0)


def test_cost_of_a_reading_is_the_least_that_inflated_noise_makes_of_it():
    """Beyond the gate c minimises, over factors w ≥ 1 with NIS/w ≤ g, NIS/w + m log w: found here by search."""
    limit = 13.0
    for m in (1, 3):
        for nis in (20.0, 500.0):
            w = np.linspace(nis / limit, 50.0 * nis, 400_000)
            least = np.min(nis / w + m * np.log(w))
            at_gate = limit + m * np.log(nis / limit)
            assert cost(np.array([nis]), np.array([m]), np.array([limit]))[0] == pytest.approx(at_gate, rel=1e-12)
            assert least <= at_gate
    assert cost(np.array([5.0]), np.array([2]), np.array([limit]))[0] == 5.0


def test_widened_states_reach_what_was_refused():
    """S = α H Σ Hᵀ alone explains ν to one deviation in every row; what hardly moves a reading stays as it was."""
    prior = np.array([4.0, 1.0, 100.0])
    H = np.array([[1.0, 0.01, 0.0], [0.0, 0.0, 2.0]])
    assert H[0, 1] ** 2 * prior[1] < MIN_VARIANCE_SHARE * 4.0
    nu = np.array([10.0, np.nan])
    added = widening(np.full(3, 1e-3), prior, H, nu)
    assert added == pytest.approx([100.0, 0.0, 2500.0])
    assert np.all(nu[:1] ** 2 <= (np.square(H) @ added)[:1] * (1 + 1e-12))
    assert widening(np.full(3, 1e-3), np.zeros(3), H[:1], np.array([1.0])) == pytest.approx([1.0, 0.0, 0.0])
    assert not widening(np.zeros(3), np.zeros(3), H, nu).any()


def test_what_follows_from_the_evidence():
    assert decided(ReopeningEvidence(8.0, 3, 0.0), False, False) == "reopened"
    assert decided(ReopeningEvidence(8.0, 3, -16.0), True, True) == "isolated"
    assert decided(ReopeningEvidence(6.0, 3, 0.0), False, False) == "doubted"
    assert decided(ReopeningEvidence(-6.0, 3, 0.0), False, True) == "believed"
    assert decided(ReopeningEvidence(-6.0, 3, 0.0), True, False) == "believed"


def test_what_could_have_been_confirmed_and_was_not_stays_rejected():
    assert decided(ReopeningEvidence(-6.0, 3, 0.0, 50.0), False, True) == "isolated"
    assert decided(ReopeningEvidence(-6.0, 3, 0.0, 50.0), True, False) == "doubted"
    assert decided(ReopeningEvidence(2.0, 3, 0.0, 50.0), False, True) == "believed"


def _from_west(x, u, p, out):
    out[0] = x[0] + 10.0


def _from_east(x, u, p, out):
    out[0] = 30.0 - x[0]


RAIL = level_model(dict.fromkeys(("west", "east", "fix"), 0.01), 1e-4, state="x", name="rail", linear=True)
LANDMARKS = replace(
    RAIL,
    sensors=tuple(replace(s, h=h) for s, h in zip(RAIL.sensors, (_from_west, _from_east, first_state), strict=True)),
)
"""A position between two landmarks."""


def ranges(exchanged=False, jump=0.0):
    """Ranges to both landmarks and fixes, each twice a second for two minutes; from `JUMP` on wrong or elsewhere."""
    rng, log, t = np.random.default_rng(3), Log.of(LANDMARKS), np.arange(0.0, 120.0, 0.5)
    x = jump * (t >= JUMP)
    west, east = (level + 0.1 * rng.standard_normal(t.size) for level in (x + 10.0, 30.0 - x))
    after = exchanged & (t >= JUMP)
    log.add("west", t, np.where(after, east, west))
    log.add("east", t + 0.1, np.where(after, west, east))
    log.add("fix", t + 0.2, x + 0.1 * rng.standard_normal(t.size))
    return advanced("kf", LANDMARKS, log, Tuning.of(LANDMARKS).set("gate", 0.9999))


def test_swapped_landmarks_are_named_and_never_accepted():
    growing = ranges(exchanged=True)
    assert {decision.outcome for decision in growing.decisions} == {"doubted", "isolated"}
    texts = {decision.sensor: decision.text for decision in growing.decisions if decision.outcome == "isolated"}
    assert texts["west"].endswith("west and east would fit if they were swapped") and "east and west" in texts["east"]
    # The fixes alone: 0.01 m² at 2 Hz against a walk of 1e-4 m²/s.
    assert abs(growing.track.mean[-1, 0]) < 4 * np.sqrt(np.sqrt(0.01 / 2 * 1e-4))


def test_an_estimate_that_most_sensors_contradict_is_the_suspect():
    growing = ranges(jump=5.0)
    assert outcomes(growing)[-1] == "reopened" and growing.decisions[-1].time < JUMP + 3.0
    late = growing.events.t > (JUMP + 3.0) * SECOND
    assert np.all(growing.track.verdict[late] == USED) and abs(growing.track.mean[-1, 0] - 5.0) < 0.2


def test_a_story_that_begins_after_another_starts_from_what_that_one_left():
    """Widening leaves the mean, so the first innovation of the second story is that of the first."""
    growing = folded("kf", series(1, a=5.0, with_b=False), TUNING.set("gate.reopen", 1.0))
    believed = next(d.row for d in growing.decisions if d.outcome == "believed")
    start = believed + 1
    while growing.log.kind[start] != READING:
        start += 1
    story = growing.second_story(start, start + 1, 0)
    assert story.track.innovation[0, 0] == pytest.approx(growing.track.innovation[start, 0], abs=1e-12)
