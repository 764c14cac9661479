"""The lock goes to whoever waits, and batches of a fold take a moment each."""

import threading
from types import SimpleNamespace

import pytest

from app.engine.batches import BATCH_PERIOD_S, MAX_BATCH_EVENTS, BatchSizer, FairLock
from tests.waiting import LIMIT_S, wait_for


@pytest.mark.parametrize("cost", [0.0, 1e-6, 1e-3, 3.0])
def test_a_piece_takes_a_moment_or_is_one_event(cost):
    now, left, sizes = 0.0, 100_000, []

    def advance(limit):
        nonlocal now, left
        count = min(limit, left)
        now, left = now + count * cost, left - count
        sizes.append(count)
        return count

    batches = BatchSizer(clock=lambda: now)
    while len(sizes) < 200 and batches.advance(SimpleNamespace(advance=advance)):
        pass
    # Those that did not take an eighth of a moment are followed by four times as many: half of one at most.
    assert max(sizes) == 1 or max(sizes) * cost <= BATCH_PERIOD_S
    assert max(sizes) <= MAX_BATCH_EVENTS and (left == 0 or cost > 1e-6)
    assert sizes[0] == 1


def test_a_fold_that_became_dear_is_folded_in_smaller_pieces():
    now, cost = 0.0, 0.0

    def advance(limit):
        nonlocal now
        now += limit * cost
        return limit

    batches, fold = BatchSizer(clock=lambda: now), SimpleNamespace(advance=advance)
    while batches.size < MAX_BATCH_EVENTS:
        batches.advance(fold)
    cost = 1e-3
    batches.advance(fold)
    assert batches.size * cost <= BATCH_PERIOD_S


def test_who_waits_comes_before_who_has_just_been_there():
    turns, order = FairLock(), []

    def wait():
        with turns:
            order.append("waited")

    turns.acquire()
    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    wait_for(turns._outer.locked)
    turns.release()
    with turns:
        order.append("again")
    waiting.join(LIMIT_S)
    assert order == ["waited", "again"]


def test_whoever_waits_in_vain_leaves_the_outer_to_others():
    turns = FairLock()
    turns.acquire()
    assert not turns.acquire(timeout=0.001)
    turns.release()
    assert turns.acquire(timeout=LIMIT_S)
