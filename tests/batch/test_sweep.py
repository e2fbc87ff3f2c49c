"""Sweeps as they are called: beside single solves, the same with any number of workers, gone on with after any end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray
from command_lines import ORBIT, PENDULUM, assert_refused, run
from conftest import PROBLEMS

import codegen
from codegen import Event, Simulate, coordinate, parameters
from codegen.batch.case import LOST, MEANINGS, NOT_BUILT, UNUSABLE
from codegen.batch.executors import local
from codegen.cli.options import on_statuses
from codegen.files import journal_of

PARTS = ("t", "q", "u", "cost", "residual", "iterations", "status", "message")
"""What two sweeps have alike, to the last bit: all but seconds."""


def assert_same(one, other):
    for name in PARTS:
        np.testing.assert_array_equal(one[name].values, other[name].values, name)


@pytest.fixture(autouse=True)
def _compiled(orbital_transfer):
    """Machine code is there."""


class TestNumbers:
    def test_a_case_is_what_solve_finds_of_the_same_numbers(self, orbital_transfer):
        data = codegen.sweep(ORBIT, {"r1": [5.8, 6.0], "m": [90.0, 100.0]}, steps=60, warm_starts=False, workers=1)
        one = codegen.solve(ORBIT, steps=60)
        case = data.sel(r1=6.0, m=100.0)
        assert (case.status, case.message) == (one.status, one.message)
        assert (case.cost, case.residual, case.iterations) == (one.cost, one.residual, one.iterations)
        for name in ("t", "q", "u"):
            np.testing.assert_array_equal(case[name], getattr(one, name))
        other = orbital_transfer.solve(60, r1=5.8, m=90.0)
        np.testing.assert_array_equal(data.sel(r1=5.8, m=90.0).q, other.q)

    def test_warm_starts_find_the_same_in_fewer_iterations(self):
        axes = {"r1": np.linspace(5.8, 6.2, 9), "GM": np.linspace(0.39, 0.41, 3)}
        cold, warm = (codegen.sweep(ORBIT, axes, steps=50, warm_starts=w, workers=1) for w in (False, True))
        np.testing.assert_allclose(warm.cost, cold.cost, rtol=1e-9)
        assert warm.iterations.sum() < 0.8 * cold.iterations.sum()

    def test_a_simulation_is_what_solve_finds(self, pendulum):
        data = codegen.sweep(PENDULUM, {"duration": [30.0, 60.0]}, keep=("t", "q", "p", "energy"), every=4, workers=1)
        one = codegen.solve(PENDULUM, every=4)
        assert data.sizes["node"] == one.t.size
        for name in ("t", "q", "p", "energy"):
            np.testing.assert_array_equal(data.sel(duration=60.0)[name], getattr(one, name))
        assert data.cost.isnull().all()

    def test_prescribed_values_and_zipped_quantities(self, orbital_transfer):
        axes = {"start.r": [4.9, 5.0], "end.r": [5.9, 6.0]}
        data = codegen.sweep(ORBIT, axes, zipped=[("start.r", "end.r")], steps=40, workers=1)
        assert dict(data.cost.sizes) == {"start.r": 2}
        np.testing.assert_array_equal(data["end.r"], [5.9, 6.0])
        np.testing.assert_array_equal(data.q[:, [0, -1], 0], [[4.9, 5.9], [5.0, 6.0]])

    def test_steps_that_vary_are_padded(self):
        data = codegen.sweep(ORBIT, {"steps": [20, 40], "r1": [5.9, 6.0]}, workers=1)
        assert (data.sizes["node"], data.sizes["interval"]) == (41, 40)
        assert data.q.sel(steps=20)[:, 21:].isnull().all()
        assert data.u.sel(steps=20)[:, 20:].isnull().all()
        assert not data.q.sel(steps=20)[:, :21].isnull().any()
        one = codegen.solve(ORBIT, steps=40)
        np.testing.assert_allclose(data.sel(steps=40, r1=6.0).q, one.q, rtol=1e-8, atol=1e-8)

    def test_each_value_of_an_argument_has_a_module(self, pendulum, explicit_pendulum):
        axes = {"form": ["hamiltonian", "lagrangian"], "duration": [1.0, 2.0]}
        data = codegen.sweep(PENDULUM, axes, scheme="stormer-verlet", keep=("q",), steps=20, workers=1)
        for form in axes["form"]:
            one = codegen.solve(PENDULUM, steps=20, arguments={"form": form}, scheme="stormer-verlet")
            module = codegen.load(codegen.build(PENDULUM, {"form": form}, scheme="stormer-verlet").path)
            np.testing.assert_array_equal(data.q.sel(form=form, duration=2.0), module.solve(20, duration=2.0).q)
            assert one.solved

    def test_modules_have_steps_of_their_own(self, folder, uncompiled):
        (folder / "fall.py").write_text(
            '"""Fall."""\n\nfrom codegen import Simulate, coordinate\n\n\n'
            "def problem(twice: int = 1) -> Simulate:\n    q, dq = coordinate('q')\n"
            "    return Simulate(lagrangian=dq**2 / 2 - q, start={q: 0, dq: 1}, duration=twice, steps=10 * twice)\n"
        )
        data = codegen.sweep("fall.py", {"twice": [1, 2]}, workers=1)
        assert data.sizes["node"] == 21
        assert data.t.sel(twice=1)[11:].isnull().all()
        np.testing.assert_allclose(data.t[:, 10], 1.0)
        assert "steps" not in data.attrs

    def test_a_parameter_that_is_called_like_a_variable_gets_an_underscore(self, folder, uncompiled):
        (folder / "fall.py").write_text(
            '"""Fall."""\n\nfrom codegen import Simulate, coordinate, parameters\n\n\n'
            "def problem() -> Simulate:\n    (q, dq), (cost, g) = coordinate('q'), parameters(cost=1, g=1)\n"
            "    return Simulate(lagrangian=cost * dq**2 / 2 - g * q, start={q: 0, dq: 1}, duration=1, steps=5)\n"
        )
        data = codegen.sweep("fall.py", {"cost": [1, 2], "g": [1, 2]}, workers=1, out="s.zarr")
        assert dict(data.status.sizes) == {"cost_": 2, "g": 2}
        np.testing.assert_array_equal(data.q[0, 0], data.q[1, 1])

    def test_samples_are_reproducible(self):
        given = {
            "samples": {"m": "normal(100, 5)", "r0": "uniform(4.9, 5.1)"},
            "cases": 40,
            "sampling": "sobol",
            "seed": 7,
        }
        one, other = (codegen.sweep(ORBIT, steps=20, workers=1, **given) for _ in range(2))
        assert_same(one, other)
        assert one.sizes["case"] == 40
        assert "r0" in one.coords
        assert (one.r0 > 4.9).all()
        assert (one.r0 < 5.1).all()

    def test_what_the_data_set_says(self):
        data = codegen.sweep(ORBIT, {"r1": [6.0]}, steps=20, workers=1, keep=("q", "p", "u", "multipliers"))
        assert list(data.coordinate.values) == ["r", "phi"]
        assert list(data.momentum.values) == ["p_r", "p_phi"]
        assert list(data.control.values) == ["u"]
        assert list(data.multiplier.values) == ["lambda_r", "lambda_phi"]
        assert "t" not in data
        assert (data.steps, data.scheme, data.driver) == (20, "midpoint", "newton")
        assert data.problem_text == Path(ORBIT).read_text()
        assert f"codegen {codegen.__version__}" in data.versions

    def test_a_module_in_place_of_a_file(self, orbital_transfer):
        data = codegen.sweep(orbital_transfer, {"r1": [6.0]}, steps=20, workers=1)
        assert_same(data, codegen.sweep(ORBIT, {"r1": [6.0]}, steps=20, workers=1))

    def test_another_driver(self):
        data = codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=10, driver="slsqp", workers=1)
        assert (data.status == "solved").all()
        np.testing.assert_allclose(data.cost[1], codegen.solve(ORBIT, steps=10).cost, rtol=1e-6)


class TestFailures:
    def test_a_case_that_fails_is_a_row_and_stops_no_other(self):
        data = codegen.sweep(ORBIT, {"r1": [5.9, -6.0, 6.0], "GM": [0.40038, 0.0]}, steps=30, workers=1)
        expected = [["solved", UNUSABLE], [UNUSABLE, UNUSABLE], ["solved", UNUSABLE]]
        np.testing.assert_array_equal(data.status, expected)
        failed = data.status != "solved"
        assert (data.message.values[failed.values] != "").all()
        assert data.cost.isnull().equals(failed.drop_vars([]))
        assert data.q.isnull().all(("node", "coordinate")).equals(failed)

    def test_an_iteration_limit_is_a_row(self):
        data = codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=30, workers=1, max_iterations=1, warm_starts=False)
        assert (data.status == "iteration limit").all()
        assert (data.iterations == 1).all()
        assert data.q.isnull().all()

    def test_a_module_that_cannot_be_derived_is_rows(self, folder, uncompiled):
        text = Path(PENDULUM).read_text()
        assert "def problem(" in text
        (folder / "halved.py").write_text(
            '"""Fall, or not."""\n\nfrom codegen import Simulate, coordinate\n\n\n'
            "def problem(power: int = 2) -> Simulate:\n    (q, dq) = coordinate('q')\n"
            "    return Simulate(lagrangian=dq**power / 2 - q, start={q: 0, dq: 1}, duration=1, steps=10)\n"
        )
        data = codegen.sweep("halved.py", {"power": [1, 2]}, workers=1)
        np.testing.assert_array_equal(data.status, [NOT_BUILT, "solved"])

    def test_statuses_have_meanings(self):
        assert {UNUSABLE, NOT_BUILT, LOST, "solved"} <= set(MEANINGS)

    def test_the_command_says_how_many_failed(self, folder):
        done = run("sweep", ORBIT, "--vary", "r1=5.9,-6,6", "--steps", 20, "--out", "s.zarr", "--json", "--workers", 1)
        assert done.exit_code == 1
        record = json.loads(done.stdout)
        assert {**record, "seconds": 0} == {
            "cases": 3, "solved": 2, "failed": {UNUSABLE: 1}, "seconds": 0, "out": "s.zarr"
        }  # fmt: skip
        told = "codegen: 1 of 3 cases failed; see status and message in s.zarr"
        assert done.stderr == f"{told}{on_statuses(UNUSABLE)}\n"
        table = run("sweep", ORBIT, "--vary", "r1=5.9,-6,6", "--steps", 20, "--out", "s.nc", "--workers", 1)
        assert UNUSABLE in table.stdout
        assert "math domain error (r1 = -6)" in table.stdout


class TestWorkers:
    def test_the_same_to_the_last_bit_with_one_worker_and_two(self, folder):
        axes = {"r1": np.linspace(5.8, 6.2, 20), "m": [90.0, 100.0, 110.0]}
        for workers in (1, 2):
            codegen.sweep(ORBIT, axes, steps=30, chunk=7, workers=workers, out=f"{workers}.zarr")
        one, two = (xarray.open_zarr(f"{workers}.zarr", chunks=None) for workers in (1, 2))
        assert_same(one, two)
        assert (one.status == "solved").all()
        memory = codegen.sweep(ORBIT, axes, steps=30, chunk=7, workers=2)
        assert_same(one, memory)

    def test_workers_that_are_no_forks_find_the_same(self, monkeypatch):
        axes = {"r1": np.linspace(5.8, 6.2, 20)}
        one = codegen.sweep(ORBIT, axes, steps=30, chunk=5, workers=1)
        monkeypatch.setattr(local, "START", "spawn")
        assert_same(one, codegen.sweep(ORBIT, axes, steps=30, chunk=5, workers=2))

    def test_a_module_in_no_file_is_shared_by_forks(self, interpreted):
        module = interpreted("linear_pendulum")
        data = codegen.sweep(module, {"duration": [0.9, 1.0]}, steps=5, chunk=1, workers=2)
        assert (data.status == "solved").all()

    def test_chunks_are_counted_and_not_measured(self, folder):
        shapes = []
        for number in range(2):
            codegen.sweep(
                ORBIT, {"r1": np.linspace(5.8, 6.2, 2500)}, steps=100, workers=2, out=f"{number}.zarr", keep=()
            )
            shapes.append(json.loads(journal_of(Path(f"{number}.zarr")).read_text().splitlines()[0])["chunk"])
        assert shapes[0] == shapes[1]
        assert 100 < shapes[0][0] < 2500

    def test_netcdf(self, folder):
        data = codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=20, workers=1, out="s.nc")
        with xarray.open_dataset("s.nc") as read:
            assert_same(read, data)
        with pytest.raises(codegen.CodegenError, match="is there already"):
            codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=20, workers=1, out="s.nc")


COMMAND = (
    *(sys.executable, "-m", "codegen", "sweep", ORBIT, "--vary", "r1=5.8:6.2:1500", "--steps", "100", "--chunk", "20"),
    *("--workers", "2", "--out", "s.zarr"),
)


def begun() -> subprocess.Popen[str]:
    """A sweep of which some chunks are finished."""
    process = subprocess.Popen(
        COMMAND, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # What shells start in the background ignores interrupts, and so would the sweep.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    journal, deadline = journal_of(Path("s.zarr")), time.monotonic() + 120
    while time.monotonic() < deadline and not (journal.exists() and journal.read_text().count("\n") > 6):
        time.sleep(0.005)
    return process


def interrupted(number_of_signal: int) -> subprocess.CompletedProcess[str]:
    """A sweep that is sent a signal when some of its chunks are finished."""
    process = begun()
    process.send_signal(number_of_signal)
    out, err = process.communicate()
    return subprocess.CompletedProcess(COMMAND, process.returncode, out, err)


class TestGoingOn:
    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
    def test_after_any_end_every_case_is_there_once(self, folder, number):
        ended = interrupted(number)
        left = journal_of(Path("s.zarr")).read_text().count("\n") - 1
        assert 0 < left < 75
        if number == signal.SIGINT:
            told = f"codegen: interrupted; {20 * left} of 1500 cases are in s.zarr; --resume does the rest\n"
            assert (ended.returncode, ended.stderr) == (130, told)
        done = subprocess.run([*COMMAND, "--resume", "--json"], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        record = json.loads(done.stdout)
        assert (record["solved"], record["before"]) == (1500, 20 * left)
        _, *lines = map(json.loads, journal_of(Path("s.zarr")).read_text().splitlines())
        assert sorted(line["chunk"] for line in lines) == list(range(75))
        data = xarray.open_zarr("s.zarr", chunks=None)
        whole = codegen.sweep(ORBIT, {"r1": np.linspace(5.8, 6.2, 1500)}, steps=100, chunk=20, workers=2)
        assert_same(data, whole)

    def test_two_processes_do_not_fill_one_store(self, folder):
        one = begun()
        os.kill(one.pid, signal.SIGSTOP)  # so that it has not ended by then
        try:
            assert_refused(run(*COMMAND[3:], "--resume"), "--out s.zarr: another process is at work on it")
        finally:
            os.kill(one.pid, signal.SIGCONT)
        one.communicate()
        assert one.returncode == 0
        assert run(*COMMAND[3:], "--resume").exit_code == 0

    def test_only_missing_chunks_are_solved(self, folder):
        axes = {"r1": np.linspace(5.8, 6.2, 20)}
        first = codegen.sweep(ORBIT, axes, steps=20, chunk=5, workers=1, out="s.zarr").load()
        journal = journal_of(Path("s.zarr"))
        lines = journal.read_text().splitlines(keepends=True)
        journal.write_text("".join(lines[:3]) + lines[3][:17])  # cut off by a kill
        again = codegen.sweep(ORBIT, axes, steps=20, workers=2, out="s.zarr", resume=True).load()
        assert_same(first, again)
        np.testing.assert_array_equal(first.seconds[:10], again.seconds[:10])
        assert (first.seconds[10:].values != again.seconds[10:].values).any()
        found = [json.loads(line)["chunk"] for line in journal.read_text().splitlines()[1:]]
        assert sorted(found) == [0, 1, 2, 3]

    def test_a_store_of_another_sweep_is_refused(self, folder):
        axes = {"r1": [5.9, 6.0]}
        codegen.sweep(ORBIT, axes, steps=20, workers=1, out="s.zarr")
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        others = ({"vary": {"r1": [5.9, 6.1]}}, {"vary": axes, "steps": 30}, {"vary": axes, "tolerance": 1e-9},
                  {"vary": axes, "keep": ("q",)}, {"vary": axes, "warm_starts": True})  # fmt: skip
        for other in others:
            with pytest.raises(codegen.CodegenError, match="another sweep"):
                codegen.sweep(ORBIT, **{"steps": 20, **other}, workers=1, out="s.zarr", resume=True)
        with pytest.raises(codegen.CodegenError, match="is there already"):
            codegen.sweep(ORBIT, axes, steps=20, workers=1, out="s.zarr")
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before

    def test_resuming_what_was_not_begun_begins_it(self, folder):
        data = codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=20, workers=1, out="s.zarr", resume=True)
        assert (data.status == "solved").all()

    def test_a_folder_that_is_no_store(self, folder):
        (folder / "s.zarr").mkdir()
        with pytest.raises(codegen.CodegenError, match="is no store of a sweep"):
            codegen.sweep(ORBIT, {"r1": [5.9]}, steps=20, workers=1, out="s.zarr", resume=True)


def test_segments_are_put_together_as_solve_does(uncompiled):
    delayed = PROBLEMS / "delayed_oscillator.py"
    data = codegen.sweep(delayed, {"k": [1.0, 1.1]}, workers=1, keep=("t", "q", "u", "multipliers"))
    one = codegen.solve(delayed)
    for name in ("t", "q", "u"):
        np.testing.assert_array_equal(data.isel(k=0)[name], getattr(one, name))


def test_a_sweep_has_the_counts_and_first_times_of_events():
    """A ball from the height 1: impacts at t_0 and t_0 (1 + 2 e); a motion that a stop ends has fewer nodes."""
    y, v = coordinate("y")
    g, e = parameters(g=9.81, e=0.7)
    motion = {"lagrangian": v**2 / 2 - g * y, "start": {y: 1, v: 0}, "duration": 1.5, "steps": 100}
    low = Event(y - 0.3, then="record", direction=-1)
    bouncing = Simulate(**motion, unilateral={"floor": y >= 0}, restitution=e, events={"low": low})
    data = codegen.sweep(bouncing, {"e": [0.2, 0.9, 1.0]}, workers=1)
    assert data.event.values.tolist() == ["low", "floor impact", "floor rest", "floor opening"]
    assert data.event_counts.sel(event="low").values.tolist() == [1, 2, 2]
    assert data.event_counts.sel(event="floor rest").values.tolist() == [1, 0, 0]
    fall, times = np.sqrt(2 / 9.81), data.event_times.sel(event="floor impact").values
    assert data.event_counts.sel(event="floor impact").values[1:].tolist() == [2, 2]
    assert times[:, 0] == pytest.approx(fall * np.ones(3), abs=1e-13)
    assert times[:, 1] == pytest.approx(fall * (1 + 2 * np.array([0.2, 0.9, 1.0])), abs=1e-13)
    assert np.isnan(times[1:, 2:]).all()
    assert np.isfinite(times[0]).all()  # the first ten of an infinite number
    stopped = codegen.sweep(Simulate(**motion, events={"down": y}), {"g": [5.0, 9.81]}, workers=1)
    assert stopped.event_times.values[:, 0, 0] == pytest.approx(np.sqrt(2 / np.array([5, 9.81])), abs=1e-13)
    assert stopped.t.max("node").values == pytest.approx(stopped.event_times.values[:, 0, 0])
