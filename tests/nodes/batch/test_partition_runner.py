"""Partitions in files: processes and Dask workers that die cost time, and change nothing."""

import os
import signal
import time

import pytest

from triline.nodes.batch.partition_runner import DaskRunner, FolderStore, ProcessRunner
from triline.nodes.errors import UserError


def square(store, key, offset):
    return (store.load(f"number-{key}") + offset) ** 2


def dies_once(store, key, offset):
    """Kills its own process the first time that a partition is worked on."""
    if key == 3:
        mark = store.folder / f"died-{key}"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return square(store, key, offset)


def dies(store, key):
    os.kill(os.getpid(), signal.SIGKILL)


def fails(store, key):
    raise ValueError(f"partition {key} has nothing")


def joined(a, b):
    return f"({a} {b})"


def words(store, key, offset):
    time.sleep(0.01 * (key % 3))
    return str(square(store, key, offset))


@pytest.fixture
def store(tmp_path):
    made = FolderStore(tmp_path / "partitions")
    for key in range(7):
        made.save(f"number-{key}", key)
    return made


def test_processes_that_die_change_nothing(store):
    runner = ProcessRunner(store, 2)
    assert list(runner.each(dies_once, range(7), lambda key: (1,))) == [(key + 1) ** 2 for key in range(7)]
    # the sum has one shape, whoever is ready first
    assert runner.run(words, range(7), lambda key: (0,), joined) == "(((0 1) (4 9)) ((16 25) 36))"
    assert (store.folder / "died-3").exists()
    assert all(mb > 10 for mb in runner.peak_mb.values())
    with pytest.raises(ValueError, match="partition 0 has nothing"):
        list(runner.each(fails, [0], lambda key: ()))
    with pytest.raises(UserError, match="partition 5: the process"):
        list(runner.each(dies, [5], lambda key: ()))
    runner.close()


def test_files_are_whole_and_for_their_owner(store):
    store.save("number-0", list(range(1000)))
    assert store.load("number-0")[-1] == 999
    assert not [file for file in store.folder.iterdir() if file.suffix != ".pickle"]
    assert store.folder.stat().st_mode & 0o077 == 0
    store.remove("number-0")
    store.remove("number-0")
    with pytest.raises(FileNotFoundError):
        store.load("number-0")


def test_a_dask_cluster_loses_workers_and_gives_the_same(store, tmp_path):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None, silence_logs=50
    )
    try:
        runner = DaskRunner(store, cluster.scheduler_address)
        assert list(runner.each(dies_once, range(7), lambda key: (1,))) == [(key + 1) ** 2 for key in range(7)]
        assert runner.run(words, range(7), lambda key: (0,), joined) == "(((0 1) (4 9)) ((16 25) 36))"
        runner.close()
    finally:
        cluster.close()


def test_a_cluster_that_is_not_there_is_one_line(store):
    pytest.importorskip("distributed")
    with pytest.raises(UserError, match=r"--scheduler tcp://127.0.0.1:9: nobody answers there"):
        DaskRunner(store, "tcp://127.0.0.1:9", timeout_s=1.0)
