"""`codegen.solve` as its users call it: with files and modules, again and again, in threads, and with wrong names."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS

import codegen
from codegen.errors import ArgumentError, CodegenError, NumericsError, ProblemFileError
from codegen.problem.points import PointSet
from codegen.solving.api import outcome_of
from codegen.solving.drivers import TASKS
from codegen.solving.request import Request
from codegen.solving.results import output

EFFORT = PROBLEMS / "double_integrator_effort.py"
LANDMARKS = PROBLEMS / "image_registration.py"


def exact(steps: int) -> float:
    """The least effort on N intervals in closed form."""
    return 12 * steps**2 / (steps**2 - 1)


@pytest.fixture
def path() -> Path:
    """A module's file."""
    return codegen.build(EFFORT).path


class TestProblems:
    def test_a_problem_file_a_module_s_file_and_a_loaded_module(self, path):
        for problem in (EFFORT, str(EFFORT), path, str(path), codegen.load(path)):
            result = codegen.solve(problem, steps=10)
            assert (result.status, result.problem, result.steps) == ("solved", EFFORT.stem, 10)
            assert result.cost == pytest.approx(exact(10), rel=1e-10)
            assert result.q.shape == (11, 1)
            assert result.u.shape == (10, 1)

    def test_in_a_loop_and_from_solution_to_solution(self):
        start = None
        for steps in (5, 10, 20):
            found = [codegen.solve(EFFORT, steps=steps, warm=start) for _ in range(2)]
            assert found[0].cost == found[1].cost == pytest.approx(exact(steps), rel=1e-10)
            start = found[0].unknowns

    def test_defaults_are_the_problem_s_own(self, path):
        assert codegen.solve(path).steps == codegen.load(path).metadata.steps

    def test_choices_of_a_build(self, uncompiled):
        result = codegen.solve(EFFORT, steps=4, scheme="gauss-4", method="hamiltonian")
        assert (result.scheme, result.method, result.status) == ("gauss-4", "hamiltonian", "solved")

    def test_another_driver_and_finer_grids(self, path):
        result = codegen.solve(path, "trust-constr", steps=5, doublings=1)
        assert result.driver == "trust-constr"
        assert [level.cost for level in result.levels] == pytest.approx([exact(5), exact(10)], rel=1e-6)

    def test_out(self, tmp_path, uncompiled):
        codegen.solve(EFFORT, steps=4, out=tmp_path)
        assert [file.name for file in tmp_path.glob("*.py")] == ["double_integrator_effort.py"]

    def test_a_saved_start(self, path, tmp_path):
        outcome = outcome_of(Request(path, steps=5))
        output.save(outcome.result, outcome.record, tmp_path / "start.npz")
        for start in (tmp_path / "start.npz", str(tmp_path / "start.npz")):
            assert codegen.solve(path, steps=10, warm=start).cost == pytest.approx(exact(10), rel=1e-10)

    def test_the_command_prints_the_same(self, path):
        words = [sys.executable, "-m", "codegen", "solve", str(EFFORT), "--steps", "10", "--json"]
        printed = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
        record = outcome_of(Request(EFFORT, steps=10)).record
        for timed in (printed, record):
            assert all(second >= 0.0 for second in timed.pop("seconds").values())
        assert printed == record


class TestArguments:
    @pytest.mark.parametrize("given", [{"form": "lagrangian"}, {"form": "hamiltonian"}])
    def test_of_problem(self, given, uncompiled):
        result = codegen.solve(PROBLEMS / "pendulum.py", arguments=given, scheme="stormer-verlet", steps=20)
        assert result.status == "solved"

    def test_values_and_text_make_the_same_module(self):
        made = [codegen.build(PROBLEMS / "n_link_pendulum.py", {"links": links}) for links in (2, "2")]
        assert made[0].path == made[1].path

    def test_points(self, monkeypatch, interpreted):
        """Of the problem file, of another file, and from memory."""
        monkeypatch.setattr("codegen.solving.loading.load", lambda path: interpreted("image_registration"))
        monkeypatch.setattr("codegen.solving.machine_code.processes.require", lambda *_: (0.0, []))
        start = np.array([[0.1, 0.2], [-0.3, 0.1]])
        few = PointSet(start, start + 0.01, np.zeros(2))
        assert codegen.solve(LANDMARKS, steps=2, points=few).q.shape == (3, 4)

    def test_points_from_a_file(self, monkeypatch, interpreted, tmp_path):
        monkeypatch.setattr("codegen.solving.loading.load", lambda path: interpreted("image_registration"))
        monkeypatch.setattr("codegen.solving.machine_code.processes.require", lambda *_: (0.0, []))
        (tmp_path / "few.csv").write_text("x0,y0,x1,y1\n0.1,0.2,0.12,0.2\n-0.3,0.1,-0.3,0.12\n")
        by_option = codegen.solve(LANDMARKS, steps=2, points=tmp_path / "few.csv")
        by_argument = codegen.solve(LANDMARKS, steps=2, arguments={"landmarks": tmp_path / "few.csv"})
        assert by_option.status == by_argument.status == "solved"
        np.testing.assert_array_equal(by_option.q, by_argument.q)


FALL = '''"""A fall, on which explicit schemes of second order make no error."""
from codegen import Simulate, coordinate
def problem() -> Simulate:
    q, dq = coordinate("q")
    return Simulate(lagrangian=dq**2 / 2 - q, start={q: 0, dq: 1}, duration=SECONDS, steps=10)
'''


def test_threads_build_and_solve_at_once(tmp_path, monkeypatch):
    """Two problems that nobody has built before, four times each."""
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path / "cache"))
    for seconds in (1, 3):
        (tmp_path / f"fall_{seconds}.py").write_text(FALL.replace("SECONDS", str(seconds)))
    with ThreadPoolExecutor(8) as pool:
        solved = partial(codegen.solve, scheme="stormer-verlet")
        found = list(pool.map(lambda n: solved(tmp_path / f"fall_{n}.py"), [1, 3] * 4))
    assert [result.status for result in found] == ["solved"] * 8
    assert [result.q[-1, 0] for result in found] == pytest.approx([1 - 1 / 2, 3 - 9 / 2] * 4, rel=1e-10)


def test_threads_search_at_once(path):
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda steps: codegen.solve(path, steps=steps), [10, 20] * 4))
    assert [result.status for result in found] == ["solved"] * 8
    assert [result.cost for result in found] == pytest.approx([exact(10), exact(20)] * 4, rel=1e-10)


REFUSED = {
    "driver": (EFFORT, {"driver": "newtn"}, ArgumentError, "did you mean newton"),
    "no-driver": (EFFORT, {"driver": 3}, ArgumentError, "no driver 3; use one of newton"),
    "two-drivers": (EFFORT, {"driver": ["newton", "fmin"]}, ArgumentError, "no driver .*; use one of newton"),
    "folder": (PROBLEMS, {}, ProblemFileError, "is a directory"),
    "option": (EFFORT, {"step": 10}, ArgumentError, "no option step; did you mean steps"),
    "other-option": (EFFORT, {"xyz": 10}, ArgumentError, "no option xyz; use one of problem, driver, arguments"),
    "scheme": (EFFORT, {"scheme": "midpont"}, CodegenError, "did you mean midpoint"),
    "method": (EFFORT, {"method": "lagrangian"}, ArgumentError, "'lagrangian' does not exist"),
    "controls": (EFFORT, {"controls": "both"}, ArgumentError, "use interval, stages, linear or nodal"),
    "argument": (PROBLEMS / "hovercraft.py", {"arguments": {"crafts": 3}}, ArgumentError, "did you mean craft"),
    "arguments": (EFFORT, {"arguments": ["craft=3"]}, ArgumentError, "give names and values"),
    "value": (PROBLEMS / "hovercraft.py", {"arguments": {"craft": [3]}}, ArgumentError, "give a whole number"),
    "scaling": (EFFORT, {"scaling": "some"}, ArgumentError, "--scaling some; use one of auto, none"),
    "steps": (EFFORT, {"steps": 2.5}, NumericsError, "steps is 2.5; give a positive integer"),
    "doublings": (EFFORT, {"doublings": -1}, NumericsError, "doublings is -1; give a whole number"),
    "tolerance": (EFFORT, {"tolerance": "1e-3"}, ArgumentError, "--tolerance 1e-3; give a number between 0 and 1"),
    "time": (EFFORT, {"time_limit": -1.0}, ArgumentError, "--time-limit -1.0; give a positive number"),
    "two-starts": (EFFORT, {"guesses": 2, "warm": np.zeros(3)}, ArgumentError, "leave one of them out"),
    "start": (EFFORT, {"warm": "nothing.npz"}, ArgumentError, "nothing.npz: no such file"),
    "matrix": (EFFORT, {"warm": np.zeros((3, 3))}, ArgumentError, "warm=: no vector of finite numbers; give a result"),
    "words": (EFFORT, {"warm": {"start": 1}}, ArgumentError, "warm=: no vector of finite numbers; give a result"),
    "number-of-scheme": (EFFORT, {"scheme": 4}, ArgumentError, "--scheme 4 is no name; give one"),
    "rows": (LANDMARKS, {"points": np.zeros((3, 4))}, ArgumentError, "--points ndarray; give a file, or a PointSet"),
    "log": (EFFORT, {"driver": "slsqp", "log": True}, ArgumentError, "slsqp takes no --log .* or use newton"),
    "problem": ("nothing.py", {}, ProblemFileError, "nothing.py: no such file"),
    "no-problem": (3, {}, ArgumentError, "begins with a problem, not with this int; give the path"),
}


@pytest.mark.parametrize(("problem", "options", "kind", "message"), REFUSED.values(), ids=REFUSED)
def test_errors_name_the_option_and_the_remedy(problem, options, kind, message):
    with pytest.raises(kind, match=message):
        codegen.solve(problem, **options)


@pytest.mark.parametrize("option", ["scheme", "method", "controls", "arguments", "out"])
def test_a_module_is_built_already(pendulum, option):
    value = {"a": 1} if option == "arguments" else "nodal"
    for module in (pendulum, pendulum.__file__):
        with pytest.raises(ArgumentError, match=r"is a choice of a build, .* or give the problem file"):
            codegen.solve(module, **{option: value})


OF_OTHERS = {
    "pendulum": {
        "warm": np.zeros(3),
        "doublings": 1,
        "guesses": 2,
        "points": "few.csv",
        "tolerance": 1e-3,
        "log": True,
    },
    "cart_pole": {"every": 2, "points": "few.csv"},
    "image_registration": {"every": 2, "doublings": 1, "scaling": "none", "max_iterations": 3},
}


@pytest.mark.parametrize(("name", "option"), [(n, o) for n, options in OF_OTHERS.items() for o in options])
def test_options_of_other_tasks_are_refused(interpreted, name, option):
    with pytest.raises(ArgumentError, match=f"--{option.replace('_', '-')} does not apply to a .* only to .*leave it"):
        codegen.solve(interpreted(name), **{option: OF_OTHERS[name][option]})


def test_every_option_is_documented_and_has_its_place():
    """The list of arguments that a user sees is that of the request, and no table names an option that is none."""
    names = [f.name for f in fields(Request)]
    assert list(inspect.signature(codegen.solve).parameters) == names
    described = re.findall(r"^(\w.*) : .+\n    \S", inspect.getdoc(codegen.solve), re.MULTILINE)
    assert sorted(name for line in described for name in line.split(", ")) == sorted(names)
    assert {option for task in TASKS.values() for option in task.options} <= set(names)
