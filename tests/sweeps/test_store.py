"""Stores stay valid whatever happens to their writers: kills in the middle of writes, full disks, damage, second writers.

The reference is an uninterrupted run, bit for bit; `benchmarks/acceptance/sweep_faults.py` injects many more faults.
"""

import pathlib
import signal
import subprocess
import sys
import warnings

import numpy as np
import pytest
import xarray as xr

import dielectric_jax as dj
from benchmarks.acceptance import sweep_faults
from dielectric_jax.numerics.codes import StoreError
from dielectric_jax.numerics.locks import alone

BENCHMARKS = pathlib.Path(__file__).parents[2] / "benchmarks"
SPECIFICATION = """
block = 8
[scene]
initial_volume = 2.42
[product]
chamber_volume = { from = 600.0, to = 25000.0, count = 32, spacing = "log" }
"""
SCENE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


@pytest.fixture(scope="module")
def faults():
    return sweep_faults


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, faults):
    """A specification, and the store that a run in a separate process makes of it."""
    folder = tmp_path_factory.mktemp("sweep")
    spec = folder / "spec.toml"
    spec.write_text(SPECIFICATION)
    process = faults.start(folder / "whole.zarr", spec, "--json", "-")
    out, err = process.communicate()
    assert process.returncode == 0 and '"scenes": 32' in out and err == ""
    return spec, folder / "whole.zarr"


def sweep_again(store, **options):
    """The sweep of the specification, in this process."""
    _, axes, given = dj.sweeps.read_specification(store.parent / "spec.toml")
    return dj.sweep(SCENE, *axes, **given, output=store, **options)


def copied(undisturbed, tmp_path):
    import shutil

    spec, whole = undisturbed
    shutil.copy(spec, tmp_path / "spec.toml")
    shutil.copytree(whole, tmp_path / "s.zarr")
    return tmp_path / "s.zarr"


def assert_same(faults, store, whole):
    found, known = faults.contents(store), faults.contents(whole)
    assert set(found) == set(known) and known["block_done"].all()
    assert [name for name in known if not faults.same(found[name], known[name])] == []


def test_killed_in_the_middle_of_writes_nothing_is_lost(undisturbed, tmp_path, faults):
    """Killed while the store is made and while blocks are written; two workers finish what one process began."""
    spec, whole = undisturbed
    store = tmp_path / "s.zarr"
    names = len(faults.contents(whole))
    before = None
    kept = []
    for at in (20, 5 * names // 2, names + 3):
        process = faults.start(store, spec, "--resume", at=at)
        assert (process.communicate() and process.returncode) == -signal.SIGKILL
        found = faults.contents(store)
        faults.CHUNK = (8,)
        assert faults.lost(found, faults.contents(whole), before) == []
        before = found.get("block_done")
        kept.append(0 if before is None else int(before.sum()))
    assert kept[0] == 0 and 0 < kept[2] < 4
    process = faults.start(store, spec, "--resume", "--workers", "2")
    assert process.communicate() and process.returncode == 0
    assert_same(faults, store, whole)
    assert not list(store.rglob("*.partial"))


def test_a_full_disk_leaves_a_store_to_resume(undisturbed, tmp_path, faults, monkeypatch):
    import zarr.storage._local as local

    whole = undisturbed[1]
    store = copied(undisturbed, tmp_path)
    put, counts = local._put, iter(range(10**9))

    def full(path, *args, **options):
        if next(counts) == 30:
            raise OSError(28, "No space left on device")
        return put(path, *args, **options)

    import zarr

    done = zarr.open_group(str(store), mode="r+", use_consolidated=False)["block_done"]
    done[:] = False
    done[1] = True
    with monkeypatch.context() as patch:
        patch.setattr(local, "_put", full)
        with pytest.raises(StoreError, match="No space left on device; what is finished is kept"):
            sweep_again(store, resume=True)
    assert bool(done[1]) and not np.asarray(done[:]).all()
    sweep_again(store, resume=True)
    assert_same(faults, store, whole)


def test_damage_is_noticed_and_mended(undisturbed, tmp_path, faults, capfd):
    """A truncated chunk, one with a wrong bit, and one that is missing."""
    whole = undisturbed[1]
    store = copied(undisturbed, tmp_path)
    torn, wrong, gone = (store / f"snap_voltage/c/{i}/0" for i in (0, 2, 3))
    torn.write_bytes(torn.read_bytes()[:-9])
    data = bytearray(wrong.read_bytes())
    data[len(data) // 2] ^= 1
    wrong.write_bytes(bytes(data))
    gone.unlink()
    sweep_again(store, resume=True)
    said = capfd.readouterr().err
    assert [n for n in range(4) if f"Block {n} of" in said] == [0, 2, 3]
    assert_same(faults, store, whole)


def test_a_second_writer_is_refused(undisturbed, tmp_path):
    store = copied(undisturbed, tmp_path)
    other = "import sys; from dielectric_jax.numerics.locks import alone\nwith alone(sys.argv[1]): print(1, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", other, str(store)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "1\n"
        with pytest.raises(StoreError, match="is being written by another process"):
            sweep_again(store, resume=True)
        process.kill()
    with alone(store, wait=False):  # the lock of a killed process is free
        pass
    # reading needs no lock
    assert dj.sweeps.open_sweep(store).attrs["blocks_done"] == 4


def test_another_sweep_or_version_is_refused(undisturbed, tmp_path):
    import json

    import zarr

    store = copied(undisturbed, tmp_path)
    with pytest.raises(StoreError, match="is there already"):
        sweep_again(store)
    with pytest.raises(StoreError, match=r"holds `chamber_volume` 600\.0, which the axes do not"):
        dj.sweep(SCENE, chamber_volume=[1.0], output=store, resume=True)
    with pytest.raises(StoreError, match="another sweep: `axes`"):
        dj.sweep(SCENE, dj.sweeps.zipped(chamber_volume=[1.0]), output=store, resume=True)
    _, axes, _ = dj.sweeps.read_specification(tmp_path / "spec.toml")
    with pytest.raises(StoreError, match="another sweep: `scene`"):
        dj.sweep(SCENE.replace(initial_volume=2.0), *axes, output=store, resume=True)
    with pytest.raises(StoreError, match="another sweep: `engine`"):
        dj.sweep(SCENE, *axes, engine="continuation", output=store, resume=True)
    group = zarr.open_group(str(store), mode="r+", use_consolidated=False)
    group.attrs["versions"] = json.dumps(json.loads(group.attrs["versions"]) | {"jax": "0.1"})
    with pytest.raises(StoreError, match=r"other versions \(jax 0.1 is now"):
        sweep_again(store, resume=True)
    data = sweep_again(store, resume=True, accept_versions=True)
    assert data.attrs["history"].count("sweep with dielectric_jax") == 2


def test_longer_axes_keep_what_is_stored(undisturbed, tmp_path, monkeypatch):
    """Values before, between and behind those stored, a damaged block, and a kill between the two renames."""
    from dielectric_jax.sweeps import sweeps

    store = copied(undisturbed, tmp_path)
    (store / "snap_voltage/c/1/0").unlink()
    before = dj.sweeps.open_sweep(undisturbed[1]).load()
    old = before.chamber_volume.values
    more = [555.0, 1600.0, 30000.0]
    volumes = np.array([*more[:2], *old[::-1], more[2]])
    computed, compute = [], sweeps.compute_block

    def counted(job, columns):
        computed.extend(columns["chamber_volume"])
        return compute(job, columns)

    monkeypatch.setattr(sweeps, "compute_block", counted)
    _, _, given = dj.sweeps.read_specification(tmp_path / "spec.toml")
    found = dj.sweep(SCENE, chamber_volume=volumes, **given, output=store, resume=True).load()
    assert sorted(computed) == sorted([*more, *old[8:16]])  # the damaged block is not trusted
    xr.testing.assert_equal(found.sel(chamber_volume=old), before)
    xr.testing.assert_equal(found.sel(chamber_volume=more), dj.sweep(SCENE, chamber_volume=more))
    store.rename(tmp_path / ".s.zarr.before_extension")
    computed.clear()
    again = dj.sweep(SCENE, chamber_volume=volumes, **given, output=store, resume=True)
    assert not computed
    xr.testing.assert_equal(again, found)


def test_what_an_interrupted_extension_knows_is_not_trusted_if_it_is_damaged(tmp_path, monkeypatch):
    """Stopped before the first new scene is written; then a chunk of the old ones is lost. A folder of the user's stays."""
    from dielectric_jax.sweeps import sweeps

    store, mine = tmp_path / "s.zarr", tmp_path / "s.zarr.old"
    mine.mkdir()
    short, long = [400.0, 1600.0, 3200.0], [400.0, 800.0, 1600.0, 3200.0 * (1 + 1e-16)]
    whole = dj.sweep(SCENE, chamber_volume=short, initial_volume=[2.2, 2.42], output=store).load()
    computed, compute = [], sweeps.compute_block

    def stopped(job, columns):
        raise KeyboardInterrupt

    def counted(job, columns):
        computed.extend(columns["chamber_volume"])
        return compute(job, columns)

    for damaged in (False, True):
        monkeypatch.setattr(sweeps, "compute_block", stopped)
        again = [*long, 5000.0 + damaged]
        with pytest.raises(KeyboardInterrupt):
            dj.sweep(SCENE, chamber_volume=again, initial_volume=[2.2, 2.42], output=store, resume=True)
        if damaged:
            (store / "snap_voltage/c/0/0/0").unlink()
        monkeypatch.setattr(sweeps, "compute_block", counted)
        computed.clear()
        long = again
        found = dj.sweep(SCENE, chamber_volume=long, initial_volume=[2.2, 2.42], output=store, resume=True).load()
        assert len(computed) == (12 if damaged else 4)
        xr.testing.assert_equal(found.sel(chamber_volume=short), whole)
    assert mine.exists()
    with pytest.raises(StoreError, match="in another order: initial_volume, chamber_volume"):
        dj.sweep(SCENE, initial_volume=[2.2, 2.42], chamber_volume=long, output=store, resume=True)


def test_no_store_is_refused_in_words(tmp_path):
    with pytest.raises(ValueError, match="`path` must hold the store of a sweep"):
        dj.sweeps.open_sweep(tmp_path)
    (tmp_path / "file").write_text("no store")
    with pytest.raises(ValueError, match="`path` must hold the store of a sweep"):
        dj.sweeps.open_sweep(tmp_path / "file")


def test_the_store_opens_without_this_package(undisturbed):
    """In a process that never imports it, by xarray alone; the numbers are those of the references."""
    code = (
        "import sys, xarray; d = xarray.open_zarr(sys.argv[1], chunks=None); one = d.sel(chamber_volume=600.0)\n"
        "flags = dict(zip(d.regime.flag_values, d.regime.flag_meanings.split()))\n"
        "print(d.sizes['chamber_volume'], flags[int(one.regime)], d.snap_voltage.long_name, bool(d.block_done.all()))\n"
        "assert 'dielectric_jax' not in sys.modules and 'jax' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(undisturbed[1])], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("32 returns voltage of the state at the fold") and done.stdout.endswith("True\n")


def test_what_is_read_is_what_memory_would_hold(undisturbed, tmp_path):
    """Also of an unfinished store, whose other scenes are not computed."""
    _, axes, given = dj.sweeps.read_specification(undisturbed[0])
    memory = dj.sweep(SCENE, *axes, **given)
    stored = dj.sweeps.open_sweep(undisturbed[1])
    for name in memory.variables:
        xr.testing.assert_identical(memory[name], stored[name].load())
    import zarr

    store = copied(undisturbed, tmp_path)
    group = zarr.open_group(str(store), mode="r+", use_consolidated=False)
    group["block_done"][2] = False
    for name, array in group.arrays():
        if array.shape[:1] == (32,) and name not in memory.coords:
            array[16:24] = array.fill_value
    data = dj.sweeps.open_sweep(store)
    assert data.attrs["blocks_done"] == 3
    assert (data.outcome[16:24] == -1).all() and data.breakdown_voltage[16:24].isnull().all()
    assert (data.outcome[:16] >= 0).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert dj.sweeps.open_sweep(store, chunks={}).breakdown_voltage.chunks is not None
