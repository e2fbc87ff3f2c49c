"""`codegen solve` solves once, and what it says of its time is that of the solve."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time

import pytest
from command_lines import ORBIT, PENDULUM

COUNTED = """
import sys
from codegen.solving.drivers import DRIVERS, Driver

calls, original = [], Driver.function
def counting(self, task):
    function = original(self, task)
    def counted(module, run):
        calls.append(run.steps)
        return function(module, run)
    return counted
Driver.function = counting
from codegen.cli import main
try:
    main(sys.argv[1:], prog_name="codegen")
finally:
    print(*calls, file=sys.stderr)
"""


def counted(cache, *words):
    """The JSON object of a solve in a process of its own, and of how many steps its runs of a driver were."""
    environment = {**os.environ, "CODEGEN_CACHE_DIR": str(cache)}
    words = [sys.executable, "-c", COUNTED, "solve", *map(str, words), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=True)
    *_, runs = done.stderr.splitlines()  # notes on the solution come first
    return json.loads(done.stdout), runs.split()


def test_a_solve_runs_once_cold_and_warm(tmp_path):
    """With an empty cache, and again in another process, which reads the machine code; other steps show the error."""
    for _ in ("cold", "warm"):
        record, runs = counted(tmp_path, PENDULUM, "--steps", 9)
        assert (record["status"], runs) == ("solved", ["9", "3"])


def test_as_many_runs_as_are_asked_for(cache_folder, orbital_transfer):
    assert counted(cache_folder, ORBIT, "--steps", 9, "--repeat", 3)[1] == ["9"] * 3


@pytest.mark.parametrize("driver", ["slsqp", "trust-constr", "fsolve"])
def test_other_drivers_run_once(cache_folder, orbital_transfer, driver):
    assert counted(cache_folder, ORBIT, "--steps", 5, "--driver", driver)[1] == ["5"]


def test_what_is_compiled_during_a_run_is_no_part_of_its_time(pendulum, monkeypatch):
    """A driver that compiles a function of its own first, in hundreds of times what its solve takes."""
    from numba import njit

    from codegen.solving import api
    from codegen.solving.drivers import newton

    api.solve(pendulum, steps=5)
    original, compiling = newton.simulate, math.nan

    def slow(module, run):
        nonlocal compiling
        begin = time.perf_counter()
        njit(lambda x: x * 2.0 + len(str(x > 1.0)))(1.5)
        compiling = time.perf_counter() - begin
        return original(module, run)

    monkeypatch.setattr(newton, "simulate", slow)
    result = api.solve(pendulum, steps=5)
    assert result.seconds_code > 0.5 * compiling
    assert result.seconds_solve < 0.5 * compiling


def test_long_solves_are_not_run_twice(pendulum, monkeypatch):
    """In this process, too, whatever has been called before."""
    from codegen.solving import api
    from codegen.solving.drivers import newton

    original, calls = newton.simulate, []
    monkeypatch.setattr(newton, "simulate", lambda module, run: calls.append(run.steps) or original(module, run))
    api.solve(pendulum, steps=10)
    assert calls == [10, 5]  # the error is estimated from half as many steps
