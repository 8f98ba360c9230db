"""Executors: workers that are killed in mid-run, interrupts, executors that break, the progress bar."""

import concurrent.futures
import multiprocessing
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

import dielectric_jax as dj
from dielectric_jax.numerics import cores
from dielectric_jax.numerics.codes import WorkersLost
from dielectric_jax.sweeps import executors
from dielectric_jax.sweeps.executors import Progress, executor_of, run_blocks


def squared(number, folder=None, victim=None):
    """The square of a number; the first process that is given the victim kills itself in mid-run."""
    if number == victim:
        mark = pathlib.Path(folder) / "killed"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def fatal(number):
    os.kill(os.getpid(), signal.SIGKILL)


def own_cores(_):
    return cores()


def impossible(number):
    raise KeyError(number)


def tasks_of(numbers, *more):
    return [(n, lambda n=n: (n, *more)) for n in numbers]


def test_every_block_is_computed_once_in_this_process():
    found = []
    with executor_of(None) as pool:
        run_blocks(pool, squared, tasks_of(range(20)), lambda key, value: found.append((key, value)))
    assert sorted(found) == [(n, n * n) for n in range(20)]


def test_the_blocks_of_a_killed_worker_are_computed_again(tmp_path):
    found = {}
    with executor_of(2) as pool:
        run_blocks(pool, squared, tasks_of(range(30), str(tmp_path), 7), found.setdefault)
    assert (tmp_path / "killed").exists() and found == {n: n * n for n in range(30)}


def test_workers_that_always_die_are_told():
    with executor_of(1) as pool, pytest.raises(WorkersLost, match="died 4 times"):
        run_blocks(pool, fatal, tasks_of(range(3)), lambda *_: None)


def test_an_executor_of_the_user_is_used_and_its_errors_are_told():
    found = {}
    with concurrent.futures.ThreadPoolExecutor(3) as own:
        with executor_of(own) as pool:
            run_blocks(pool, squared, tasks_of(range(50)), found.setdefault)
            with pytest.raises(WorkersLost, match="KeyError: 3"):
                run_blocks(pool, impossible, tasks_of([3]), found.setdefault)
        assert own.submit(squared, 4).result() == 16  # it is left open
    assert found == {n: n * n for n in range(50)}


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no processes fork")
def test_an_executor_that_forks_is_refused(monkeypatch):
    """Forks of a process that has used JAX never answer; the message says what to use instead."""
    fork = multiprocessing.get_context("fork")
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
    for attribute in ("_mp_context", "_context"):  # Python's own executor, and loky's
        own = concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        monkeypatch.setattr(own, "_mp_context", None)
        monkeypatch.setattr(own, attribute, fork, raising=False)
        with pytest.raises(ValueError, match=r'`executor` must start .* make it with .*get_context."spawn"') as said:
            dj.sweep(scene, chamber_volume=[800.0], executor=own)
        assert str(said.value).count(". ") == 0
    for method in set(multiprocessing.get_all_start_methods()) - {"fork"}:
        with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context(method)) as own:
            with executor_of(own) as pool:
                assert pool.executor is own


def test_what_is_no_executor_is_refused():
    for wrong in (True, 0, -1, 1.5, object(), [2], "nowhere"):
        with pytest.raises(ValueError, match="`executor` must be"):
            with executor_of(wrong):
                pass


def test_workers_share_the_cores(monkeypatch):
    monkeypatch.setenv("DIELECTRIC_JAX_CORES", "6")
    found = []
    with executor_of(2) as pool:
        run_blocks(pool, own_cores, tasks_of(range(2)), lambda _, count: found.append(count))
    assert found == [3, 3] and cores() == 6
    for wrong in ("0", "many"):
        monkeypatch.setenv("DIELECTRIC_JAX_CORES", wrong)
        with pytest.raises(ValueError, match="`DIELECTRIC_JAX_CORES` must be a number of cores"):
            cores()


DASK = """
import os, pathlib, signal, sys, threading, time
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np
import dielectric_jax as dj
from dielectric_jax.numerics.locks import alone
if __name__ == "__main__":
    import dask.distributed as dd
    folder = pathlib.Path(sys.argv[1])
    dj.numerics.enable_compilation_cache()
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
    chambers = np.geomspace(600, 25000, 48)
    with dd.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, dd.Client(cluster) as client:
        killed = []
        def kill():
            import zarr
            while not (folder / "s.zarr" / "block_done" / "c").exists():
                time.sleep(0.02)
            victim = next(iter(client.run(os.getpid).values()))
            os.kill(victim, signal.SIGKILL)
            killed.append(victim)
        thread = threading.Thread(target=kill)
        thread.start()
        data = dj.sweep(scene, chamber_volume=chambers, block=2, output=folder / "s.zarr", executor=cluster.scheduler_address)
        thread.join()
        alive = client.run(os.getpid).values()
    here = dj.sweep(scene, chamber_volume=chambers, block=2)
    for name in here.data_vars:
        assert here[name].values.tobytes() == data[name].values.tobytes(), name
    print("killed", len(killed), "again", killed[0] not in alive, "blocks", data.attrs["blocks_done"])
"""


def test_a_worker_of_dask_is_killed_in_mid_run(tmp_path):
    """The numbers are bit for bit those of one process."""
    script = tmp_path / "run.py"
    script.write_text(DASK)
    done = subprocess.run([sys.executable, script, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "killed 1 again True blocks 24\n"


def test_an_interrupt_leaves_a_store_to_resume(tmp_path):
    spec = tmp_path / "spec.toml"
    spec.write_text(
        "block = 2\n[scene]\ninitial_volume = 2.42\n[product]\n"
        "chamber_volume = {from = 600, to = 25000, count = 2000, spacing = 'log'}\n"
    )
    store = tmp_path / "s.zarr"
    command = [
        sys.executable,
        "-m",
        "dielectric_jax.apps.cli",
        "sweep",
        str(spec),
        "--output",
        str(store),
        "--workers",
        "1",
    ]
    # a test run in the background ignores interrupts, and its children would with it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    signal.signal(signal.SIGINT, before)
    while not (store / "block_done" / "c").exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # like a terminal, also to the workers
    said = process.communicate()[1]
    assert process.returncode == 130
    assert said.splitlines()[0].endswith("keeps what is finished, --resume continues.") and "Traceback" not in said
    import dielectric_jax as dj

    assert 0 < dj.sweeps.open_sweep(store).attrs["blocks_done"] < 1000


def test_the_bar_counts_and_is_quiet_where_nobody_watches(capfd):
    with Progress(10, 2) as bar:
        bar.add(4, 1)
    assert capfd.readouterr().err == ""
    with Progress(10, 2, show=True) as bar:
        bar.add(4, 1)
        bar.add(4, 2)
    said = capfd.readouterr().err
    assert "10.0/10.0" in said and "without_answer=3" in said and "scene/s" in said


def test_the_bar_is_shown_in_a_notebook_and_not_for_its_packages(capfd):
    pytest.importorskip("ipykernel")
    with Progress(10, 0) as bar:
        bar.add(4, 0)
    assert capfd.readouterr().err == ""
    code = "from dielectric_jax.sweeps.executors import Progress\nwith Progress(10, 0) as bar:\n    bar.add(4, 0)\n    assert bar._bar is not None"
    import nbclient
    import nbformat

    cells = [nbformat.v4.new_code_cell(code)]
    nbclient.NotebookClient(nbformat.v4.new_notebook(cells=cells), timeout=120, kernel_name="python3").execute()


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r'pip install "dielectric-jax\[distributed\]"'):
        with executor_of("tcp://127.0.0.1:1"):
            pass
    assert executors.MOST_DEATHS == 3
