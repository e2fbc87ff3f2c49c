"""A cluster of dask: the same numbers as in one process, and every case once, whatever becomes of its parts."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from command_lines import ORBIT, PENDULUM, assert_refused, run
from dask_parts import address_in, cluster, kill, process, until
from test_sweep import assert_same

import codegen
from codegen.batch.work import Work
from codegen.errors import ArgumentError, ClusterError, ExtraError
from codegen.files import journal_of, refused

distributed = pytest.importorskip("distributed")

AXES = {"r1": np.linspace(5.8, 6.2, 1500)}
WORDS = ("sweep", ORBIT, "--vary", "r1=5.8:6.2:1500", "--steps", "40", "--chunk", "20", "--out", "s.zarr")


def finished() -> int:
    """How many chunks are in the journal."""
    journal = journal_of(Path("s.zarr"))
    return journal.read_text().count("\n") - 1 if journal.exists() else 0


def begun(address: str, *words: str) -> subprocess.Popen[str]:
    """A sweep on a cluster that has finished some chunks."""
    command = [sys.executable, "-m", "codegen", *WORDS, "--cluster", address, *words]
    made = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    goes_on()
    assert made.poll() is None
    return made


def goes_on() -> None:
    """Wait until some more chunks are finished."""
    before = finished()
    until(lambda: finished() > before + 4)


class TestByHand:
    def test_a_worker_a_client_and_a_scheduler_are_killed(self, folder, orbital_transfer):
        with cluster() as (address, scheduler, workers):
            sweep = begun(address)
            kill(workers[0])  # the other one does the rest, and what was lost
            goes_on()
            sweep.kill()
            sweep.communicate()
            assert 4 < finished() < 75
            sweep = begun(address, "--resume")
            goes_on()
            kill(scheduler)
            _, error = sweep.communicate(timeout=60)
            assert sweep.returncode == 2
            assert error.startswith("codegen: error: the scheduler of the cluster was lost")
            assert error.count("\n") == 1
        assert 8 < finished() < 75
        with cluster() as (address, _, _):
            done = run(*WORDS, "--cluster", address, "--resume", "--json")
        assert done.exit_code == 0
        assert json.loads(done.stdout)["solved"] == 1500
        _, *lines = map(json.loads, journal_of(Path("s.zarr")).read_text().splitlines())
        assert sorted(line["chunk"] for line in lines) == list(range(75))
        assert_same(xarray.open_zarr("s.zarr", chunks=None), codegen.sweep(ORBIT, AXES, steps=40, chunk=20, workers=1))

    def test_another_processor_compiles_for_itself_and_says_so(self, folder, pendulum):
        """A worker that makes machine code for any processor stands for one that has another."""
        other = {"NUMBA_CPU_NAME": "generic", "CODEGEN_CACHE_DIR": str(folder / "cache")}
        axes = {"duration": np.linspace(1.0, 2.0, 6)}
        with cluster(**other) as (address, _, _), distributed.Client(address) as client:
            words = ("--vary", "duration=1:2:6", "--steps", 20, "--chunk", 2, "--out", "p.zarr", "--cluster", address)
            first = run("sweep", PENDULUM, *words)
            assert first.exit_code == 0
            assert first.stderr.count("\n") == 1
            assert "compiled pendulum" in first.stderr
            assert "for generic with numba" in first.stderr
            assert "; the sweep was begun on" in first.stderr
            modules = list((folder / "cache" / "workers").glob("*-generic-*/*/*.py"))
            assert len(modules) == 1  # by two workers
            data = codegen.sweep(PENDULUM, axes, steps=20, chunk=2, cluster=client)
            assert client.status == "running"  # it is not ours to close
        np.testing.assert_allclose(data.q, codegen.sweep(PENDULUM, axes, steps=20, workers=1).q, rtol=1e-12, atol=1e-12)


def test_an_interrupt_by_a_terminal_is_one_line(folder, orbital_transfer):
    """It goes to all processes of the terminal, of which workers are some."""
    command = [sys.executable, "-m", "codegen", *WORDS, "--cluster", "local", "--workers", "2"]
    made = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    goes_on()
    os.killpg(made.pid, signal.SIGINT)
    _, error = made.communicate(timeout=60)
    assert made.returncode == 130
    assert error.count("\n") == 1


def test_what_a_worker_may_not_write_is_one_line(folder, orbital_transfer, monkeypatch):
    words = ("--steps", 30, "--chunk", 10, "--out", "s.zarr", "--workers", 1, "--cluster", "local")
    parcel_of = Work.parcel
    full = {"mark": Full().mark()}
    monkeypatch.setattr(Work, "parcel", lambda self: replace(parcel_of(self), work=replace(self, sink=Full()), **full))
    assert_refused(run("sweep", ORBIT, "--vary", "r1=5.9:6:40", *words), "s.zarr cannot be written", "make room")


@dataclass(frozen=True)
class Full:
    """A store on a full disk."""

    def mark(self):
        return (1,)

    def write(self, region, rows):
        raise refused(OSError(errno.ENOSPC, "No space left on device"), Path("s.zarr"))


def test_a_store_that_workers_do_not_see_is_written_by_the_client(folder, orbital_transfer, monkeypatch):
    monkeypatch.setattr("codegen.batch.store.Store.mark", lambda self: (os.getpid(),))
    axes = {"r1": AXES["r1"][:40]}
    data = codegen.sweep(ORBIT, axes, steps=30, chunk=7, cluster="local", workers=2, out="s.zarr")
    assert_same(data, codegen.sweep(ORBIT, axes, steps=30, chunk=7, workers=1))


class TestRefusals:
    @pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9", "http://127.0.0.1:8786", "127.0.0.1", " "])
    def test_an_address_where_nothing_answers(self, folder, address, monkeypatch):
        monkeypatch.setattr("codegen.batch.executors.dask.PATIENCE", 0.5)
        done = run("sweep", ORBIT, "--vary", "r1=5:6:3", "--out", "s.zarr", "--cluster", address)
        assert_refused(done, "--cluster", "such as tcp://")
        assert not list(folder.iterdir())

    def test_workers_belong_to_the_cluster(self, folder):
        words = ("--vary", "r1=5:6:3", "--out", "s.zarr", "--workers", "2", "--cluster", "tcp://127.0.0.1:9")
        assert_refused(run("sweep", ORBIT, *words), "--workers")

    def test_what_is_no_cluster(self):
        with pytest.raises(ArgumentError, match=r"distributed\.Client"):
            codegen.sweep(ORBIT, {"r1": [6.0]}, cluster=3)

    def test_a_module_in_no_file(self, interpreted, monkeypatch):
        with pytest.raises(ArgumentError, match="in no file"):
            codegen.sweep(interpreted("linear_pendulum"), {"duration": [1.0]}, steps=5, cluster="local")

    def test_a_scheduler_without_workers(self, folder, monkeypatch, orbital_transfer):
        monkeypatch.setattr("codegen.batch.executors.dask.PATIENCE", 2.0)
        with (
            process("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", "s.json"),
            pytest.raises(ClusterError, match="no workers"),
        ):
            codegen.sweep(ORBIT, {"r1": [6.0]}, steps=20, cluster=address_in(Path("s.json")))

    def test_without_dask_one_line_names_the_command(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "distributed", None)
        with pytest.raises(ExtraError, match="pip install dask distributed"):
            codegen.sweep(ORBIT, {"r1": [6.0]}, cluster="local")
