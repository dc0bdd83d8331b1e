"""Sweeps on dask workers, some killed; and in this process, which is killed."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from distributed import CancelledError, LocalCluster
from distributed.comm.core import CommClosedError

from heli_jax import models, sweep
from heli_jax.errors import InputError
from heli_jax.sweeps import Range, Reduce, cluster, sobol

ROOT = Path(__file__).parents[2]
ROLL = models.roll_on_stand


def pids(client):
    return sorted(client.run(os.getpid).values())


# dask closes a killed worker's pipes late, and Python's garbage collector then warns.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
def test_a_worker_that_dies_costs_nothing(bench30, record):
    pytest.importorskip("distributed")
    from heli_jax.sweeps.cluster import connected

    design = sobol({"Ixx": Range(0.02, 0.05), "a": Range(4.0, 6.0)}, 600)
    reduce = {"rms": Reduce("rms", "roll"), "fit": Reduce("fit", "roll"), "mode": Reduce("modes")}
    options = {"chunk": 32, "lanes": 16}
    alone = sweep(ROLL, bench30, record, design, reduce, **options)
    local = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with local, connected(local.scheduler_address) as client:
        killed = []

        def kill(done, _):
            if done > 100 and not killed:
                killed.append(pids(client)[0])
                os.kill(killed[0], signal.SIGKILL)

        found = sweep(
            ROLL, bench30, record, design, reduce, client=client, progress=kill, **options
        )
        assert killed
        assert killed[0] not in pids(client)
    for name in alone.variables:
        assert alone[name].values.tobytes() == found[name].values.tobytes()
    assert np.all(found["status"] == 0)


def test_no_scheduler_ends_in_words(monkeypatch):
    pytest.importorskip("distributed")
    from heli_jax.sweeps import cluster

    monkeypatch.setattr(cluster, "_CONNECT_S", 1)
    with (
        pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:9: no scheduler answers"),
        cluster.connected("tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (CancelledError("x"), "lost the scheduler or its workers"),
        (CommClosedError("x"), "--resume continues"),
        (ModuleNotFoundError("No module named 'mine'"), "No module named 'mine' on the scheduler"),
        (RuntimeError("Error during deserialization of the task graph"), "PYTHONPATH"),
    ],
)
def test_what_dask_says_ends_in_one_sentence(error, words):
    with pytest.raises(InputError, match=words) as e, cluster._dask_errors():
        raise error
    assert "\n" not in str(e.value)
    with pytest.raises(RuntimeError, match="another"), cluster._dask_errors():
        raise RuntimeError("another")
