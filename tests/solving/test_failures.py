"""Problems that cannot be solved end with the right word, exit status 1, and a message that names row and remedy."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numba
import numpy as np
import pytest
from failing_problems import DEPENDENT_END, FAILING, HEAD, RANK_DEFICIENT, STEEP, Failing, mass, plane, row
from interpreted import of_problem, silent_math, without_compilation
from made_records import control_record
from sympy import Eq, exp
from typer.testing import CliRunner

from codegen import Control, control, controls, states, time
from codegen.cli import main
from codegen.emit.naming import Choices
from codegen.errors import BoundaryError
from codegen.runtime.search.bounds import prescribed_beyond
from codegen.runtime.search.solve import has_run_away
from codegen.solving import api
from codegen.solving.compiler import generate
from codegen.solving.loading import time_grid
from codegen.solving.results.output import notes
from codegen.solving.results.result import STATUSES


def module_of(folder: Path, text: str):
    path = folder / "failing.py"
    path.write_text(text)
    return without_compilation(generate(path, {}, Choices()), "failing")


@pytest.mark.parametrize("case", FAILING, ids=lambda case: case.id)
def test_word_exit_status_and_message(tmp_path, uncompiled, case: Failing):
    path = tmp_path / "failing.py"
    path.write_text(case.text)
    result = CliRunner().invoke(main, ["solve", str(path), "--json"])
    assert result.exit_code == 1, result.output
    assert "Traceback" not in result.output
    record = json.loads(result.stdout)
    assert record["status"] == case.status, record["message"]
    assert record["status"] in STATUSES
    assert record["message"].startswith(f"{case.status}: ")
    for fragment in case.fragments:
        assert fragment in record["message"]
    *noted, said = result.stderr.splitlines()
    assert said.startswith(f"codegen: {case.status}: ")
    assert all(line.startswith("codegen: note: ") for line in noted)


def test_remedies_can_be_followed_on_the_command_line(tmp_path, uncompiled):
    """More iterations than a hundred, as by default, and a looser tolerance than that of the generated solver."""
    path = tmp_path / "steep.py"
    path.write_text(STEEP.text)

    def solved(*words):
        record = json.loads(CliRunner().invoke(main, ["solve", str(path), "--json", *words]).stdout)
        if record["status"] != "solved":
            assert all(fragment in record["message"] for fragment in STEEP.fragments)
        return record["status"], record["iterations"]

    assert solved("--max-iterations", "100") == (STEEP.status, 100)
    status, iterations = solved()
    assert status == "solved"
    assert 100 < iterations < 1000
    status, loose = solved("--tolerance", "1e-2")
    assert status == "solved"
    assert loose < iterations


def notes_of(path: Path, *words: str) -> list[str]:
    """What `codegen solve` says on stderr of a problem that it solves."""
    result = CliRunner().invoke(main, ["solve", str(path), "--json", *words])
    assert json.loads(result.stdout)["status"] == "solved"
    return result.stderr.splitlines()


def test_conditions_that_are_left_out_are_told(tmp_path, uncompiled):
    """Distances of three bodies on a line, of which two give the third."""
    path = tmp_path / "three.py"
    distances = ["x.of(1) - x.of(0) - 1", "x.of(2) - x.of(1) - 1", "x.of(2) - x.of(0) - 2"]
    path.write_text(Failing("", row(f"[{', '.join(distances)}]"), "", ()).text)
    (note,) = notes_of(path)
    assert note.startswith("codegen: note: 1 of 3 conditions between bodies follows from the others and was left out")
    assert "number 3 (-x_0 + x_2 - 2 = 0)" in note
    path.write_text(Failing("", row(f"[{', '.join(distances[:2])}]"), "", ()).text)
    assert notes_of(path) == []


def test_long_conditions_are_shortened():
    name = "acos((x_0 - x_1)*(x_1 - x_2)/sqrt((x_0 - x_1)**2*(x_1 - x_2)**2)) - pi/2 = 0"
    metadata = control_record(coupling_conditions=4, redundant_conditions=((3, name), (4, "x_0 = 0")))
    (note,) = notes(metadata)
    assert note.startswith("2 of 4 conditions between bodies follow from the others and were left out")
    assert note.endswith("number 3 (acos((x_0 - x_1)*(x_1 - x_2)/sqrt((x_0 - ...), number 4 (x_0 = 0)")


@pytest.mark.parametrize(("scheme", "is_averaged"), [("midpoint", True), ("rectangle", False)])
def test_nodal_controls_that_cost_nothing_are_told(tmp_path, uncompiled, scheme, is_averaged):
    path = tmp_path / "plane.py"
    path.write_text(Failing("", plane(cost="f**2 + 2*g**2 + x**2"), "", ()).text)
    assert notes_of(path, "--scheme", scheme) == []
    found = notes_of(path, "--scheme", scheme, "--controls", "nodal")
    assert len(found) == is_averaged
    assert all("their alternation costs nothing (f, g)" in note and "codegen check" in note for note in found)


def test_there_are_enough_of_every_kind():
    assert len(FAILING) == len({case.id for case in FAILING}) >= 14
    assert {case.status for case in FAILING} == set(STATUSES) - {
        "solved", "stalled", "inaccurate", "singular", "newton failed", "not connected", "saddle point",
        "iteration limit", "time limit", "outside a table", "accuracy not reached", "contact failed",
        "events accumulate",
    }  # fmt: skip


def test_machine_code_gives_the_same_numbers():
    """Uncompiled modules stand for compiled ones only if nothing raises in either."""

    @numba.njit(error_model="numpy")
    def compiled(x):
        return math.log(-x), math.sqrt(-x), math.exp(1000 * x), 1.0 / (x - 1.0), math.sin(x) / (x - 1.0) ** 2

    x, like = np.float64(1.0), silent_math
    with np.errstate(all="ignore"):
        interpreted = like.log(-x), like.sqrt(-x), like.exp(1000 * x), 1.0 / (x - 1.0), like.sin(x) / (x - 1.0) ** 2
    np.testing.assert_array_equal(compiled(1.0), interpreted)


@pytest.mark.parametrize("driver", ["slsqp", "trust-constr", "fsolve"])
def test_other_drivers_name_the_row_too(tmp_path, driver):
    """Two circles that do not meet."""
    (case,) = (case for case in FAILING if case.id == "circles-that-do-not-meet")
    result = api.solve(module_of(tmp_path, case.text), driver)
    assert result.status in set(STATUSES) - {"solved"}
    assert "= 1 at the end is off by" in result.message


@pytest.mark.parametrize(
    ("case", "plain"),
    [(RANK_DEFICIENT[0], plane(end_conditions="[Eq(x, 2)]")), (DEPENDENT_END, mass(end="{x: 1, v: 1}"))],
    ids=lambda value: getattr(value, "id", ""),
)
def test_equations_hold_where_they_depend_on_each_other(tmp_path, case: Failing, plain: str):
    """The point that is returned is feasible, and its cost is that of the sound problem beside it."""
    result = api.solve(module_of(tmp_path, case.text))
    assert result.residual <= 1e-9
    if result.status != "solved":
        assert result.status == case.status
        assert all(fragment in result.message for fragment in case.fragments)
    solved = api.solve(module_of(tmp_path, Failing("", plain, "", ()).text))
    assert solved.status == "solved"
    assert result.cost == pytest.approx(solved.cost, rel=1e-6)


def test_coupling_without_slope_is_refused(tmp_path):
    """Left out as redundant, it would be violated by what is then called solved."""
    path = tmp_path / "meeting.py"
    path.write_text(Failing("", row("[(x.of(0) - x.of(1))**2, x.of(2) - 3]"), "", ()).text)
    with pytest.raises(BoundaryError, match="no slope where it holds"):
        generate(path, {}, Choices())


def test_minimum_where_the_hessian_is_singular_is_no_saddle_point(tmp_path):
    """A control that only acts together with another, so that the Hessian had to be shifted."""
    text = mass('w = control("w")', dynamics="{x: v, v: sin(u + w)}", cost="(u + w)**2", end="{x: 0.1, v: 0}")
    result = api.solve(module_of(tmp_path, Failing("", text, "", ()).text))
    assert result.status == "solved"
    alone = mass(dynamics="{x: v, v: sin(u)}", end="{x: 0.1, v: 0}")
    assert result.cost == pytest.approx(api.solve(module_of(tmp_path, Failing("", alone, "", ()).text)).cost)


def test_long_duration_that_is_best_is_no_runaway(tmp_path):
    """Least u^2 + time for a long way: T^4 = 36 (2e6)^2 in closed form, far beyond the guess."""
    text = mass('T = free_parameter("T", 1, lower=0.01)', terminal_cost="T", duration="T", end="{x: 2e6, v: 0}")
    result = api.solve(module_of(tmp_path, Failing("", text, "", ()).text))
    assert result.status == "solved", result.message
    factor = 6**2 / (6**2 - 1)  # of the discrete optimum, N^2/(N^2 - 1)
    assert result.summary["duration"] == pytest.approx((36 * factor * 4e12) ** 0.25, rel=1e-8)


def test_a_value_that_conditions_at_the_end_determine_is_known_no_better_than_they_hold():
    """x is to end on its bound: where the search fails on its way there, the value is not to blame."""
    x, y = states("x y")
    u, w = controls("u w")
    module = of_problem(
        Control(
            dynamics={x: u, y: w},
            cost=u**2 + w**2,
            duration=1,
            start={x: 0, y: 0},
            end={y: 1},
            end_conditions=[Eq(x - y, 0)],
            bounds={x: (-2, 1)},
        )
    )
    grid = module.make_grid(10)
    on_the_way = module.initial_guess(grid)
    nodes, _ = module.views(grid, on_the_way)
    nodes[0, -1, 0] = 1.001
    assert prescribed_beyond(grid, on_the_way) == ""
    beyond = module.solve(10, end={"y": 1.5})
    assert beyond.status == "infeasible"
    assert "x is prescribed as 1.5 at the end, beyond its bounds -2 to 1" in beyond.message


@pytest.mark.parametrize(("values", "place"), [({"start": {"x": 3.0}}, "start"), ({"end": {"x": -3.0}}, "end")])
def test_values_beyond_their_bounds_are_named(interpreted, values, place):
    """A number that comes only when the module is called, by the module itself and without a driver."""
    solution = interpreted("cart_pole").solve(5, **values)
    value = values[place]["x"]
    assert solution.status == "infeasible"
    assert f"x is prescribed as {value:g} at the {place}, beyond its bounds -2 to 2" in solution.message


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ({"end_conditions": "[v <= a, v >= 0.6]"}, "v at node 6 (t = 1) is to be at least 0.6 and at most 0.5"),
        ({"bounds": "{u: (1 - a, 20*a - 15)}"}, "u on interval 0 (t = 0) is to be at least 0.5 and at most -5"),
    ],
)
def test_bounds_that_contradict_each_other_are_named(tmp_path, limits, text):
    """By numbers that come only when the module is called; with others there is a solution."""
    written = mass("from codegen import parameters\n(a,) = parameters(a=3)", end="{x: 1}", **limits)
    module = module_of(tmp_path, Failing("", written, "", ()).text)
    assert module.solve(6).status == "solved"
    solution = module.solve(6, a=0.5)
    assert solution.status == "infeasible"
    assert text in solution.message


IMPOSSIBLE = {
    # From rest, with an acceleration of one at most, a mass moves by half of the squared time at most.
    "push": mass(dynamics="{x: v, v: u - v**3/9}", end="{x: 1}", duration="1.3", bounds="{u: (-1, 1)}"),
    "push held by a path": mass(
        dynamics="{x: v, v: sin(u)}", end="{x: 1}", duration="1.3", path="[v + x >= -1]", guess="{u: 1/2}"
    ),
    # A disc that is to be avoided, within a strip that leaves no way past it, and steps too short to leap over it.
    "obstacle": plane(
        path="[x**2 + y**2 >= 1]", start="{x: -2, y: 0, dx: 0, dy: 0}", end="{x: 2, dx: 0, dy: 0}",
        bounds="{y: (-Rational(1, 2), Rational(1, 2)), f: (-6, 6), g: (-6, 6)}", steps="24", duration="2",
    ),
    # A weight on a floor that the force cannot lift.
    "height": (
        'q, dq = coordinate("q")\nu = control("u")\nreturn Control(lagrangian=dq**2/2 - 10*q - q**4, force={q: u},'
        " cost=u**2, duration=2, start={q: 0, dq: 0}, end={q: 1}, bounds={u: (-8, 8), q: (0, 2)}, steps=16)"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_is_infeasible_and_not_stalled(tmp_path, name):
    """Each is impossible by the argument beside it; what is reported is the least violation nearby."""
    module = module_of(tmp_path, HEAD + "".join(f"    {line}\n" for line in IMPOSSIBLE[name].splitlines()))
    with np.errstate(all="ignore"):
        solution = module.solve()
    assert solution.status == "infeasible", solution.message
    assert "nothing nearby satisfies the equations" in solution.message
    assert solution.residual > 1e-4


def test_rounding_of_unknowns_that_ran_away_is_no_solution(tmp_path):
    """Far out residuals of 1e-7 are rounding: Howell's halo orbit was called solved at 4e8 times its size."""
    module = module_of(tmp_path, HEAD + "".join(f"    {line}\n" for line in IMPOSSIBLE["push"].splitlines()))
    grid = time_grid(module, 6)
    guess = module.initial_guess(grid)
    assert not has_run_away(grid, guess, guess + 1.0)
    assert has_run_away(grid, guess, guess + 1e9)


def test_residuals_whose_squares_overflow_end_in_a_status():
    """The residual on the last interval is exp(487.5) / 20 = 2.6e210; its square ended in an OverflowError."""
    x, y = states("x y")
    u = control("u")
    problem = Control(
        dynamics={x: u, y: exp(x)},
        cost=u**2,
        duration=1,
        start={x: 0, y: 0},
        end={y: 2},
        guess={x: 500 * time()},
        bounds={u: (-1000, 1000)},
        steps=20,
    )
    result = api.solve(of_problem(problem))
    assert result.status == "stalled"
    assert f"{math.exp(487.5) / 20:.1e}" in result.message
