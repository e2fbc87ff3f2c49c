"""Other values of parameters, durations and ends, beside closed forms of the same motions."""

from __future__ import annotations

import json
import math
import pickle

import pytest
from command_lines import run
from conftest import PROBLEMS
from sympy import cos, sin

import codegen
from codegen.drawing import Mass
from codegen.errors import ArgumentError, NumericsError

pytestmark = pytest.mark.usefixtures("uncompiled")


def pushed() -> codegen.Control:
    """A mass m moves by one in the time T, with the least integral of the force squared, 12 m^2 / T^3."""
    x, dx = codegen.coordinate("x", unit="m")
    f = codegen.control("f", unit="N")
    (m,) = codegen.parameters(m=(1, "kg"))
    ends = {"start": {x: 0, dx: 0}, "end": {x: 1, dx: 0}}
    return codegen.Control(lagrangian=m * dx**2 / 2, force={x: f}, cost=f**2, duration=1, steps=50, **ends)


@pytest.fixture
def push(uncompiled):
    return codegen.compile(pushed(), name="push")


def discrete_effort(mass: float, duration: float, distance: float, steps: int) -> float:
    """The optimum by the midpoint rule: 12 m^2 d^2 / T^3 times N^2 / (N^2 - 1)."""
    return 12.0 * mass**2 * distance**2 / duration**3 * steps**2 / (steps**2 - 1.0)


def test_an_optimum_with_other_values_is_that_of_the_closed_form(push):
    values = {"m": 3, "duration": 2.0, "end.x": 1.5}
    own, other = push.solve(), push.solve(parameters=values)
    assert own.cost == pytest.approx(discrete_effort(1, 1, 1, 50), rel=1e-9)
    assert other.cost == pytest.approx(discrete_effort(3, 2, 1.5, 50), rel=1e-9)
    assert (other.t[-1], other.q[-1, 0], other.parameters) == (2.0, pytest.approx(1.5), values)
    assert push.solve().cost == own.cost


def test_finer_grids_other_guesses_and_accuracy_keep_the_values(push):
    values = {"m": 3, "duration": 2.0}
    finer = push.solve(parameters=values, doublings=1)
    assert finer.levels[-1].cost == pytest.approx(discrete_effort(3, 2, 1, 100), rel=1e-9)
    assert push.solve(parameters=values, guesses=3).cost == pytest.approx(discrete_effort(3, 2, 1, 50), rel=1e-9)
    accurate = push.solve(parameters=values, accuracy=1e-6)
    assert accurate.cost == pytest.approx(12 * 9 / 8, rel=1e-5)
    rates = push.solve(parameters=values, sensitivities=True).sensitivities()
    assert rates["m"].cost == pytest.approx(2 * discrete_effort(3, 2, 1, 50) / 3, rel=1e-7)


def test_a_simulation_takes_parameters_and_a_duration():
    theta, omega = codegen.coordinate("theta", "omega")
    length, g = codegen.parameters(length=1, g=9.81)
    bob = (length * sin(theta), -length * cos(theta))
    problem = codegen.Simulate(
        lagrangian=length**2 * omega**2 / 2 - g * length * theta**2 / 2,
        start={theta: 0.1, omega: 0},
        duration=1,
        steps=2000,
        drawing=[Mass(bob, 0.1)],
    )
    motion = codegen.solve(problem, parameters={"g": 4.0, "length": 4.0, "duration": math.pi})
    assert motion.t[-1] == math.pi
    assert motion.q[-1, 0] == pytest.approx(-0.1, abs=1e-6)
    axes = motion.plot().figure.axes[0]
    assert axes.get_ylim()[0] < -4.0, "the drawing has the length that was given"


def test_a_simulation_starts_elsewhere():
    """The midpoint rule turns an oscillator by 2 atan(h w/2) in a step."""
    x, dx = codegen.coordinate("x", unit="m")
    (w,) = codegen.parameters(w=(2, "1/s"))
    system = codegen.Simulate(lagrangian=dx**2 / 2 - w**2 * x**2 / 2, start={x: 1, dx: 0}, duration=1, steps=50)
    values = {"start.x": 3, "start.dx": -1.0, "w": 1.5}
    motion = codegen.solve(system, parameters=values)
    angle = 50 * 2.0 * math.atan(1.5 / 100)
    assert motion.solved
    assert motion.q[-1, 0] == pytest.approx(3 * math.cos(angle) - math.sin(angle) / 1.5, abs=1e-11)
    assert motion.p[-1, 0] == pytest.approx(-4.5 * math.sin(angle) - math.cos(angle), abs=1e-11)
    assert motion.parameters == values
    assert "start.x = 3 m, start.dx = -1 m/s, w = 1.5 1/s" in motion._repr_html_()


def test_a_simulation_in_phase_space_starts_with_other_momenta():
    """At the top of its swing a pendulum of energy E has 1 - cos q = 1 + E."""
    q, p = codegen.canonical_pair("q", "p")
    system = codegen.Simulate(hamiltonian=p**2 / 2 - cos(q), duration=60, start={q: 0, p: 1.4}, steps=6000)
    for momentum in (0.5, 1.9):
        motion = codegen.solve(system, parameters={"start.p": momentum})
        assert motion.q.max() == pytest.approx(2 * math.asin(momentum / 2), abs=1e-4)
    with pytest.raises(ArgumentError, match=r"has no parameter start\.dp; did you mean start\.p\?"):
        codegen.solve(system, parameters={"start.dp": 1})


def test_particles_start_from_an_array():
    with pytest.raises(ArgumentError, match=r"lennard_jones has no start\.x: its particles start from an array"):
        codegen.solve(PROBLEMS / "lennard_jones.py", parameters={"start.x": 1})


def test_a_solution_tells_of_them_in_tables_and_pickles(push):
    found = push.solve(parameters={"m": 2, "duration": 1})
    assert "m = 2 kg, duration = 1 s" in found._repr_html_()
    again = pickle.loads(pickle.dumps(found))
    assert again == found
    assert again.plot().text == found.plot().text
    assert found != push.solve(parameters={"m": 2.5, "duration": 1})


@pytest.mark.parametrize(
    ("values", "kind", "message"),
    [
        ({"mm": 1}, ArgumentError, "push has no parameter mm; did you mean m?"),
        ({"weight": 1}, ArgumentError, "use one of m, duration, start.x, start.dx, end.x, end.dx"),
        ({"m": "heavy"}, NumericsError, "parameter m is 'heavy'; give a finite number"),
        ({"m": math.nan}, NumericsError, "parameter m is nan"),
        ({"m": True}, NumericsError, "parameter m is True"),
        ({"m": 10**400}, NumericsError, "parameter m is 1000"),
        ({"duration": -1}, NumericsError, "push: duration is -1.0, expected a positive number"),
        ([1.0], ArgumentError, 'give names and values, such as {"m": 2.0}'),
    ],
)
def test_values_that_do_not_fit_are_refused(push, values, kind, message):
    with pytest.raises(kind) as refused:
        push.solve(parameters=values)
    assert message in str(refused.value)


def test_a_duration_that_is_none_is_refused_before_a_saved_start_is_carried_to_its_grid(push):
    with pytest.raises(NumericsError, match="duration"):
        push.solve(parameters={"duration": -1}, warm=push.solve().unknowns, accuracy=1e-4)


def test_a_parameter_as_an_option_is_told_where_it_belongs(push):
    with pytest.raises(ArgumentError, match=r"no option weight; .*a parameter of the problem is given by parameters="):
        push.solve(weight=50)


def test_the_command_has_them_as_well(tmp_path):
    file = tmp_path / "push.py"
    file.write_text(
        '"""Push."""\n\nfrom codegen import Control, control, coordinate, parameters\n\n\n'
        "def problem() -> Control:\n"
        '    x, dx = coordinate("x")\n    f, (m,) = control("f"), parameters(m=1)\n'
        "    ends = dict(start={x: 0, dx: 0}, end={x: 1, dx: 0})\n"
        "    return Control(lagrangian=m * dx**2 / 2, force={x: f}, cost=f**2, duration=1, steps=50, **ends)\n"
    )
    record = json.loads(run("solve", file, "--parameter", "m=3", "--parameter", "duration=2", "--json").stdout)
    assert record["parameters"] == {"m": 3.0, "duration": 2.0}
    assert record["cost"] == pytest.approx(discrete_effort(3, 2, 1, 50), rel=1e-9)
    assert json.loads(run("solve", file, "--parameter", "m = 3", "--json").stdout)["parameters"] == {"m": 3.0}
    assert "--parameter gives m twice" in run("solve", file, "--parameter", "m=3", "--parameter", "m=4").stderr
    assert "--parameter m=x is no number" in run("solve", file, "--parameter", "m=x").stderr
