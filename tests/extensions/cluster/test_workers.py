"""Calls on a Dask cluster: their results, and one line for each fault."""

import multiprocessing
import os
import sys
import time
from importlib.metadata import PackageNotFoundError, version

import pytest

from app.extensions.cluster import workers
from app.study.processes import results
from estimators.errors import ConfigError
from tests.app.study.test_processes import begin, double, handled
from tests.cases import cases
from tests.extensions.cluster.conftest import started
from tests.waiting import wait_for


def sleep(marker):
    open(marker, "w").close()
    time.sleep(600)


def die_once(marker):
    if not os.path.exists(marker):
        open(marker, "w").close()
        os._exit(1)
    return os.getpid()


def test_a_cluster_answers_every_call_in_one_thread_of_each_worker(scheduler):
    for given in (7, 8, 9):  # of two workers, one at least works for two of the commands
        found = dict(results(double, [(k,) for k in range(8)], cluster=scheduler, begin=begin, given=(given,)))
        assert [found[k][:2] for k in range(8)] == [(2 * k, 1) for k in range(8)]
        assert {found[k][2][-1] for k in range(8)} == {given}


def test_calls_of_a_worker_that_dies_are_made_again(scheduler, tmp_path):
    found = dict(results(die_once, [(str(tmp_path / "died"),)], cluster=scheduler))  # no other worker has what was held
    assert list(found) == [0] and found[0] != os.getpid() and (tmp_path / "died").exists()


def die(*_):
    os._exit(1)


def missing(*_):
    raise ConfigError("pump.yaml: there is no such file")


def lacks(name):
    """As `version`, with Nisus where the tests run alone."""
    if "dask_worker" in sys.argv[0]:
        raise PackageNotFoundError(name)
    return version(name)


def test_relative_paths_are_those_of_the_command(scheduler):
    assert dict(results(os.getcwd, [()], cluster=scheduler)) == {0: os.getcwd()}


def test_a_worker_without_the_files_of_the_twin_is_one_line(scheduler):
    text = "a worker of .* fails: pump.yaml: there is no such file; workers need the files of the twin at the same path"
    with pytest.raises(ConfigError, match=text):
        list(results(handled, [()], cluster=scheduler, begin=missing))


def test_a_worker_without_nisus_is_one_line(scheduler, monkeypatch):
    monkeypatch.setattr(workers, "version", lacks)
    with pytest.raises(ConfigError, match=f"the worker tcp://.* has no Nisus; install {version('nisus')} there"):
        list(results(handled, [()], cluster=scheduler))


def test_a_cluster_that_has_no_worker_left_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "WATCH_S", 0.1)
    text = "has had no worker for 0.5 s; .* start one with `dask worker tcp://"
    with started(tmp_path, 1) as (address, (_, worker)), pytest.raises(ConfigError, match=text):
        for _ in lost(address, tmp_path / "begun"):
            monkeypatch.setattr(workers, "WAIT_S", 0.5)
            worker.kill()


def test_a_scheduler_that_is_lost_is_one_line(tmp_path, capfd):
    with started(tmp_path, 1) as (address, (scheduler, _)):
        with pytest.raises(ConfigError, match=f"--cluster {address}: the connection to the scheduler is lost"):
            for _ in lost(address, tmp_path / "begun"):
                scheduler.kill()
    assert capfd.readouterr().err == ""  # nor does Dask add its own


def lost(address, marker):
    """Yield when a call of ten minutes has begun, and wait for it then."""
    with workers.dask(address, handled, ()) as cluster:
        future = cluster.submit(sleep, str(marker))
        wait_for(lambda: marker.exists() or future.done())
        yield
        future.result()


def test_a_call_that_kills_workers_is_one_line(tmp_path):
    with started(tmp_path, 1, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _):
        with pytest.raises(ConfigError, match="1 workers died in one call; is their memory enough"):
            list(results(die, [()], cluster=address))


def test_a_cluster_of_ones_own_ends_with_the_command():
    before = set(multiprocessing.active_children())
    found = dict(results(double, [(k,) for k in range(4)], cluster="local:2", begin=begin, given=(7,)))
    assert found == {k: (2 * k, 1, [7]) for k in range(4)}
    wait_for(lambda: not set(multiprocessing.active_children()) - before)


@cases(__file__, "wrong_clusters.csv")
def test_a_wrong_cluster_is_one_line(cluster, text):
    with pytest.raises(ConfigError, match=text):
        list(results(handled, [(), ()], cluster=cluster))
