"""Background jobs: order, repetition, cancellation, staleness and failure, run by hand; and the pool's threads."""

import os
import sys
import threading

import pytest

from app.engine.jobs import (
    CANCELLED,
    CANCELLING,
    DONE,
    FAILED,
    LOWEST_PRIORITY,
    MAX_JOBS,
    RUNNING,
    Job,
    JobCancelled,
    Jobs,
    PacedExecutor,
)
from app.engine.notices import Notices
from estimators.errors import ConfigError
from tests.support import Clock
from tests.waiting import LIMIT_S, wait_for


@pytest.fixture
def notices():
    return Notices(lambda: 0)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def jobs(notices, clock):
    return Jobs(notices, clock=clock)


def test_jobs_run_in_the_order_of_their_requests(jobs):
    made = [jobs.run(name, lambda job: job.name) for name in "abc"]
    assert [job.state for job in made] == [RUNNING] * 3
    assert jobs.step() and made[0].over and not made[1].over
    while jobs.step():
        pass
    assert [(job.state, job.result) for job in made] == [(DONE, name) for name in "abc"]
    assert all(job.elapsed >= 0.0 for job in made)


def test_a_repeated_job_runs_when_it_is_due_and_may_choose_when(jobs, clock):
    calls, rests = [], iter([None, 5.0, None])
    job = jobs.run("again", lambda job: (calls.append(clock.now), next(rests))[1], every=1.0)
    for clock.now in (0.0, 0.5, 1.0, 3.0, 6.0, 7.0):
        while jobs.step():
            if len(calls) == 3:
                job.cancel()
    assert calls == [0.0, 1.0, 6.0] and job.state == CANCELLED and job.over


def test_a_cancelled_job_ends_at_its_next_check(jobs):
    def work(job):
        job.cancel()
        assert job.state == CANCELLING and not job.wanted
        job.check()
        raise AssertionError("not reached")

    job = jobs.run("cancelled", work)
    assert jobs.step() and (job.state, job.result, job.reason) == (CANCELLED, None, "")


def test_a_job_whose_result_is_out_of_date_ends(jobs):
    tuning = [1]
    job = jobs.run("stale", lambda job: (tuning.append(2), job.rest(0.0)), stale=lambda: len(tuning) > 1)
    assert jobs.step() and job.state == CANCELLED
    never = jobs.run("stale before it began", lambda job: 1, stale=lambda: True)
    assert jobs.step() and never.state == CANCELLED


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ConfigError("no such key"), "no such key"),
        (ArithmeticError("no such luck"), "ArithmeticError: no such luck"),
        (SystemExit(3), "SystemExit: 3"),
    ],
)
def test_a_failure_is_a_notice_or_told_to_its_owner_and_a_repeated_job_goes_on(jobs, notices, clock, error, reason):
    def fail(job):
        raise error

    told = []
    one, own = jobs.run("sweep", fail), jobs.run("fit", fail, failed=told.append)
    again = jobs.run("levels", fail, every=1.0, failed=told.append)
    while jobs.step():
        pass
    assert (one.state, one.reason, own.state, again.state) == (FAILED, reason, FAILED, RUNNING)
    assert [line.text for line in notices.since(0)] == [f"sweep: {reason}"] and told == [reason] * 2
    clock.now = 1.0
    assert jobs.step() and told == [reason] * 3


def test_nobody_sees_a_job_over_before_its_final_state_and_result():
    class Observed(Job):
        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if hasattr(self, "ended_by"):
                seen.append((self.over, self.state, self.result))

    seen = []
    job = Observed("observed", lambda job: "found")
    job.ended_by = None
    job.run()
    assert seen[-1] == (True, DONE, "found")
    assert all(over == (state == DONE) and result in (None, "found") for over, state, result in seen)
    assert all(result == "found" for over, _, result in seen if over)


def test_a_job_that_ends_while_it_is_cancelled_keeps_its_final_state():
    class Racing(Job):
        @property
        def over(self):
            found = super().over
            if not ending.ident:
                ending.start()
                ending.join(0.1)
            return found

    job = Racing("racing", lambda job: 1)
    ending = threading.Thread(target=job.run)
    job.cancel()
    ending.join(LIMIT_S)
    assert job.state in (CANCELLED, DONE)
    job.cancel()
    assert job.state in (CANCELLED, DONE)


def test_jobs_that_do_not_return_are_left_behind(notices):
    jobs = Jobs(notices, "refold", threads=1, niceness=0)
    leave, begun = threading.Event(), threading.Event()
    stuck = jobs.run("stuck", lambda job: (begun.set(), leave.wait(LIMIT_S)))
    after = jobs.run("after", lambda job: threading.current_thread().name)
    jobs.start()
    assert begun.wait(LIMIT_S) and not after.over
    jobs.abandon()
    wait_for(lambda: after.over)
    assert after.result == "refold 0" and not stuck.over
    leave.set()
    wait_for(lambda: stuck.over)
    jobs.stop()


def test_a_paced_executor_maps_in_order_and_ends_with_its_job():
    job = Job("levels")
    found = PacedExecutor(job).map(lambda a, b: a + b, [1, 2, 3], [10, 20, 30])
    assert next(found) == 11 and next(found) == 22
    job.cancel()
    with pytest.raises(JobCancelled):
        next(found)


def test_threads_are_few_of_low_priority_and_end(notices):
    jobs = Jobs(notices)
    go_on, niceness = threading.Event(), []

    def work(job):
        linux = sys.platform == "linux"
        niceness.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) if linux else LOWEST_PRIORITY)
        go_on.wait(LIMIT_S)
        return job.name

    made = [jobs.run(str(k), work) for k in range(MAX_JOBS + 3)]
    jobs.start()
    wait_for(lambda: len(niceness) >= MAX_JOBS)
    threads = [*jobs._threads]
    go_on.set()
    wait_for(lambda: all(job.over for job in made))
    assert [job.result for job in made] == [str(k) for k in range(MAX_JOBS + 3)]
    assert len(threads) == MAX_JOBS and jobs._threads == threads and set(niceness) == {LOWEST_PRIORITY}
    begun = threading.Event()
    waits = jobs.run("waits", lambda job: (begun.set(), job.rest(60.0)))
    assert begun.wait(LIMIT_S)
    jobs.stop()
    assert waits.state == CANCELLED and not any(thread.is_alive() for thread in threads)
