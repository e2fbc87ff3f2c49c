"""Solves that are stopped or watched, and grids of which some fail: what they say, and by which names."""

import json
import math

import numpy as np
import pytest
from conftest import PROBLEMS
from failing_problems import INFEASIBLE
from typer.testing import CliRunner

from codegen import terminal
from codegen.cli import main
from codegen.errors import ArgumentError
from codegen.runtime.search import descent, restoration, solution, workspace
from codegen.runtime.search import solution as iteration_log
from codegen.runtime.search.bounds import with_violations
from codegen.runtime.search.messages import row_text
from codegen.solving import api, drivers
from codegen.solving.api import LEAST_TIME, Outcome, outcome_of
from codegen.solving.request import Option, Request
from codegen.solving.results import output


class Clock:
    """A clock that goes on by a second whenever it is read."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 1.0
        return self.now


@pytest.fixture
def clock(monkeypatch):
    """The clock of searches, which goes on where a test says so."""
    found = SteadyClock()
    monkeypatch.setattr(iteration_log, "perf_counter", found)
    return found


class SteadyClock:
    """A clock that goes on only where a test says so."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize("is_watched", [False, True])
@pytest.mark.parametrize("name", ["cart_pole", "brachistochrone"])
def test_the_time_runs_out(interpreted, monkeypatch, clock, name, is_watched):
    """With and without bounds, the search stops at the first iterate after the time, and says how far it came."""
    module, seen = interpreted(name), []
    whole = api.solve(module, steps=10)
    search = descent.descend

    def of_one_second_per_iteration(*arguments):
        counts = arguments[STATE]
        before = counts[workspace.ITERATIONS]
        status = search(*arguments)
        clock.now += counts[workspace.ITERATIONS] - before
        return status

    monkeypatch.setattr(descent, "descend", of_one_second_per_iteration)
    watch = {"watch": lambda number, row: seen.append(number)} if is_watched else {}
    stopped = api.solve(module, steps=10, time_limit=2.5, **watch)
    assert whole.status == "solved"
    assert stopped.status == "time limit"
    assert stopped.iterations == 3 < whole.iterations
    assert stopped.message.startswith("time limit: equations hold to ")
    assert f"equations hold to {stopped.log[-1][1]:.1e}, " in stopped.message
    assert " so far; " in stopped.message
    assert "raise time_limit" in stopped.message
    assert [row[0] for row in stopped.log] == [row[0] for row in whole.log[:4]]
    assert seen == ([0, 1, 2, 3] if is_watched else [])


def test_with_a_time_limit_the_clock_is_looked_at_after_a_millisecond(interpreted, monkeypatch, clock):
    """The search returns after one iteration, then after as many as take a millisecond; the path stays the same."""
    module, counts = interpreted("cart_pole"), []
    whole = api.solve(module, steps=10)
    search = descent.descend

    def of_a_third_of_a_millisecond_per_iteration(*arguments):
        state = arguments[STATE]
        before = state[workspace.ITERATIONS]
        status = search(*arguments)
        counts.append(int(state[workspace.ITERATIONS] - before))
        clock.now += counts[-1] * 0.33e-3
        return status

    monkeypatch.setattr(descent, "descend", of_a_third_of_a_millisecond_per_iteration)
    timed = api.solve(module, steps=10, time_limit=1.0)
    assert counts[0] == 1
    assert set(counts[1:-1]) == {3}
    np.testing.assert_array_equal(timed.log, whole.log)
    counts.clear()
    api.solve(module, steps=10)
    assert counts == [whole.iterations]


STATE = 8
"""Which argument of the compiled search has its integers."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["circles-that-do-not-meet", "thrust-too-small"])
def test_the_time_runs_out_in_a_restoration(interpreted, monkeypatch, clock, name):
    """Both solvers lower the violation of equations without a solution, and stop at the first step after the time."""
    (failing,) = (case for case in INFEASIBLE if case.id == name)
    module, steps = interpreted(name.replace("-", "_"), failing.text), []
    whole = api.solve(module)
    original = restoration.sum_of_squares

    def of_the_restoration(grid, point):
        clock.now += 1e6
        steps.append(point)
        return original(grid, point)

    monkeypatch.setattr(restoration, "sum_of_squares", of_the_restoration)
    stopped = api.solve(module, time_limit=1e5)
    assert (whole.status, stopped.status) == ("infeasible", "time limit")
    assert 1 <= len(steps) <= 4


def test_all_guesses_and_grids_share_the_time(interpreted, monkeypatch):
    module, limits = interpreted("cart_pole"), []

    class Recording(iteration_log.Log):
        def __init__(self, limit, watch):
            limits.append(limit)
            super().__init__(limit, watch)

    monkeypatch.setattr(solution, "Log", Recording)
    monkeypatch.setattr("codegen.solving.api.time.perf_counter", Clock())  # every solve takes one second
    result = api.solve(module, steps=10, time_limit=1.5, guesses=2, doublings=1)
    assert result.levels[0].status == "solved"
    assert limits[0] == 1.5
    assert limits[-1] == LEAST_TIME
    assert result.status == "time limit"
    assert sorted(limits, reverse=True) == limits


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan])
def test_times_that_are_none(interpreted, limit):
    with pytest.raises(ArgumentError, match=r"--time-limit .*positive number of seconds"):
        api.solve(interpreted("cart_pole"), steps=5, time_limit=limit)
    with pytest.raises(ValueError, match="time_limit"):
        interpreted("cart_pole").solve(5, time_limit=limit)


def test_tasks_and_drivers_without_a_time_limit(interpreted):
    with pytest.raises(ArgumentError, match=r"driver slsqp takes no --time-limit .* newton, ipopt"):
        api.solve(interpreted("cart_pole"), "slsqp", steps=5, time_limit=1.0)
    with pytest.raises(ArgumentError, match="does not apply to a simulate problem"):
        api.solve(interpreted("pendulum"), time_limit=1.0)


@pytest.mark.parametrize(("limit", "status"), [({"time_limit": 1e-6}, "time limit"),
                                               ({"max_iterations": 2}, "iteration limit")])  # fmt: skip
def test_ipopt_says_which_limit_it_met(interpreted, limit, status):
    pytest.importorskip("cyipopt")
    result = api.solve(interpreted("cart_pole"), "ipopt", steps=10, **limit)
    assert result.status == status
    assert f"raise {next(iter(limit))}, or try driver newton" in result.message


def test_iterates_are_shown_as_they_come(interpreted):
    seen = []
    result = api.solve(interpreted("cart_pole"), steps=10, watch=lambda number, row: seen.append((number, row[0])))
    assert [number for number, _ in seen] == list(range(result.iterations + 1))
    assert seen[-1][1] == pytest.approx(result.cost)


def test_what_has_no_iterates_to_be_shown_is_refused(interpreted):
    """By the table of drivers, before anything is solved; so is a limit of iterations that a module does not have."""
    with pytest.raises(ArgumentError, match="--watch does not apply to a simulate problem, only to optimisation;"):
        api.solve(interpreted("pendulum"), steps=2, watch=print)
    with pytest.raises(ArgumentError, match=r"driver slsqp takes no --watch for a control problem; .* newton"):
        api.solve(interpreted("cart_pole"), "slsqp", steps=2, watch=print)
    with pytest.raises(ArgumentError, match="--max-iterations of particles"):
        api.solve(interpreted("lennard_jones"), steps=2, max_iterations=3)


def test_a_long_solve_tells_of_itself_on_a_terminal_only(monkeypatch):
    with terminal.following() as watch:
        assert watch is None
    shown = []

    class Line:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def update(self, text):
            shown.append(text)

    monkeypatch.setattr(terminal, "working", lambda what: Line())
    monkeypatch.setattr(terminal.time, "monotonic", iter([0.0, 0.5, 1.5, 1.55, 2.0]).__next__)
    with terminal.following() as watch:
        for number in range(4):
            watch(number, (3.0 + number, 1e-3, 2e-4, 0.0, 1.0))
    assert shown == [
        "Solving: iteration 1, cost 4, equations 1.0e-03, stationarity 2.0e-04 (2 s) ...",
        "Solving: iteration 3, cost 6, equations 1.0e-03, stationarity 2.0e-04 (2 s) ...",
    ]


def solved(monkeypatch, interpreted, *words):
    """What `codegen solve` prints with a module that is run by the interpreter."""
    monkeypatch.setattr("codegen.solving.loading.load", lambda path: interpreted("cart_pole"))
    monkeypatch.setattr("codegen.solving.machine_code.processes.require", lambda *_: (0.0, []))
    found = CliRunner().invoke(main, ["solve", str(PROBLEMS / "cart_pole.py"), "--steps", "10", "--json", *words])
    return json.loads(found.stdout), found.stderr


@pytest.mark.parametrize(
    ("words", "status"), [("--max-iterations 2", "iteration limit"), ("--time-limit 1e-9", "time limit")]
)
def test_messages_name_the_option_that_was_given(monkeypatch, interpreted, words, status):
    record, said = solved(monkeypatch, interpreted, *words.split())
    option = words.split()[0]
    assert record["status"] == status
    for text in (record["message"], said):
        assert f"raise {option}" in text
        assert option.strip("-").replace("-", "_") not in text


def test_results_name_arguments_where_functions_are_called(interpreted):
    result = api.solve(interpreted("cart_pole"), steps=10, max_iterations=2, doublings=1)
    assert all("raise max_iterations" in text for text in (result.message, result.levels[0].message))
    named = Outcome(None, result, 0.0, 0.0, []).for_command_line.result
    assert all("raise --max-iterations" in text for text in (named.message, named.levels[0].message))


def test_options_that_may_help_have_the_form_of_the_caller(interpreted):
    outcome = outcome_of(Request(interpreted("cart_pole"), steps=10, max_iterations=2))
    assert outcome.untried == (Option("guesses", 10), Option("scaling", "none"))
    assert outcome.result.notes == ()
    assert outcome.for_python.notes == ("what may help, in this order: guesses=10, scaling='none'",)
    assert outcome.for_command_line.result.notes == ("what may help, in this order: --guesses 10, --scaling none",)
    assert (Option("scheme").in_python, Option("scheme").on_command_line) == ("another scheme", "another --scheme")
    others = {"guesses": 2, "scaling": "none"}
    assert outcome_of(Request(interpreted("cart_pole"), steps=10, max_iterations=2, **others)).untried == ()


@pytest.mark.parametrize("driver", ["newton", "slsqp"])
def test_no_driver_is_advised_to_try_itself(interpreted, monkeypatch, driver):
    monkeypatch.setattr("codegen.solving.results.control._rounding_level", lambda *_: 0.0)
    module = interpreted("cart_pole")
    function = drivers.find(driver).function("control")

    def liar(module, request):
        attempt = function(module, request)
        changed = attempt.unknowns.copy()
        changed[module.primal_unknowns(module.make_grid(request.steps))] += 1e-3
        return type(attempt)(**{**vars(attempt), "unknowns": changed, "status": "solved"})

    monkeypatch.setattr(f"codegen.solving.drivers.{driver}.control", liar)
    result = api.solve(module, driver, steps=6)
    assert result.status == "inaccurate"
    assert ("driver newton" in result.message) == (driver != "newton")


class TestGrids:
    def test_every_grid_is_told_of(self, interpreted):
        result = api.solve(interpreted("double_integrator_effort"), steps=10, doublings=2)
        assert [level.steps for level in result.levels] == [10, 20, 40]
        for level in result.levels:  # the discrete optimum in closed form
            assert level.cost == pytest.approx(12 * level.steps**2 / (level.steps**2 - 1), rel=1e-10)
        record = output.as_record(result, 0.0, 0.0)
        assert [level["steps"] for level in record["levels"]] == [10, 20, 40]
        assert record["levels"][-1]["cost"] == record["cost"]
        assert "levels" not in output.as_record(api.solve(interpreted("cart_pole"), steps=5), 0.0, 0.0)

    def test_a_coarse_grid_that_fails_ends_nothing(self, interpreted):
        """One interval has no node between the ends, where the double integrator has two conditions too many."""
        module = interpreted("double_integrator_effort")
        result = api.solve(module, steps=1, doublings=3)
        assert [level.status == "solved" for level in result.levels] == [False, True, True, True]
        assert result.status == "solved"
        assert result.cost == pytest.approx(12 * 64 / 63, rel=1e-10)
        first, second, third = (12 * n**2 / (n**2 - 1) for n in (2, 4, 8))
        order = math.log2((first - second) / (second - third))
        assert result.summary["observed_order"] == pytest.approx(order, rel=1e-6)

    def test_estimates_come_from_grids_that_were_solved(self, interpreted):
        result = api.solve(interpreted("double_integrator_effort"), steps=1, doublings=1)
        assert [level.status == "solved" for level in result.levels] == [False, True]
        assert "cost_extrapolated" not in result.summary


SLACKED = '''"""A mass on a way with two conditions that its controls decide."""
from codegen import Control, control, states
def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0},
                   path=[v + u <= 5, v - 2*x*u <= 3], steps=4)
'''


def test_an_inequality_is_off_by_what_it_exceeds(interpreted):
    """A slack far from its equation makes the row of a condition that holds huge; it is not what is wrong."""
    module = interpreted("slacked", SLACKED)
    grid = module.make_grid(4)
    unknowns = module.initial_guess(grid)
    nodes, intervals = module.views(grid, unknowns)
    nodes[0, :, :2], intervals[0, :, module.problem.structure.slacks - module.problem.structure.node] = 0.0, 0.0
    controls = intervals[0, :, list(module.metadata.interval).index("u")]
    controls[2] = 7.0
    intervals[0, 1, module.problem.structure.slacks - module.problem.structure.node] = 3e12
    point = module.evaluate(grid, unknowns)
    assert np.abs(point.gradient[grid.is_multiplier]).max() >= 2e12
    violated = with_violations(grid, point)
    index = np.argmax(np.where(grid.is_multiplier, np.abs(violated.gradient), 0.0))
    assert row_text(grid, violated, index).startswith("u + v <= 5")
    assert "interval 2" in row_text(grid, violated, index)
    assert violated.gradient[index] == 2.0
    controls[2] = 0.0
    holds = module.evaluate(grid, unknowns)
    assert with_violations(grid, holds) is holds  # nothing else is wrong: the row stays
