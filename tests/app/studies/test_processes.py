"""Processes beside each other: what they return, and that none is left of work that is given up."""

import multiprocessing
import os
import signal
import time

import pytest

from app.studies.processes import beside, jobs_of
from estimators.errors import ConfigError


def begin() -> None:
    """What a process does first."""


def double(number: int) -> int:
    return 2 * number


def sleep(_: int) -> None:
    time.sleep(600)


def handled(_: int) -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_every_call_is_answered_in_its_place() -> None:
    with beside(double, [(1,), (2,), (3,)], 2, begin) as futures:
        assert [future.result() for future in futures] == [2, 4, 6]


def test_what_is_given_up_ends() -> None:
    """Without a wait for work that has begun: the ten minutes would be over before the test."""
    with pytest.raises(KeyboardInterrupt), beside(sleep, [(1,), (2,), (3,)], 2, begin) as futures:
        children = multiprocessing.active_children()
        while not futures[0].running():
            time.sleep(0.01)
        raise KeyboardInterrupt
    deadline = time.monotonic() + 120
    while not all(_gone(child.pid) for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _gone(pid: int) -> bool:
    """By the system: which thread of the pool has heard of it does not matter."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_ctrl_c_is_for_the_parent_alone() -> None:
    with beside(handled, [(1,)], 1, begin) as futures:
        assert futures[0].result()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_no_process_is_no_number_of_processes() -> None:
    assert jobs_of(3, 2) == 2 and jobs_of(None, 1) == 1
    with pytest.raises(ConfigError, match="--jobs 0: must be 1 or more"):
        jobs_of(0, 2)
