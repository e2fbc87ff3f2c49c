"""Problems as mathematics: names as textbooks have them, every part of a problem, no row that says nothing."""

from __future__ import annotations

import re

import pytest
import typed_use
from sympy import Eq, sin
from written_objects import FILES, object_of

import codegen
from codegen import Control, Phases, Waypoint, control, coordinate, free_parameter, parameters, state, states
from codegen.identifiers import in_latex
from codegen.show.notebook import displayed, latex

NAMES = {
    "m": "m",
    "x_1": "x_{1}",
    "theta1": r"\theta_{1}",
    "theta_1": r"\theta_{1}",
    "phi": r"\varphi",
    "Omega": r"\Omega",
    "θ": r"\theta",
    "Σ2": r"\Sigma_{2}",
    "rod": r"\mathrm{rod}",
    "fuel_1": r"\mathrm{fuel}_{1}",
    "u_max": r"u_{\mathrm{max}}",
    "m_dry_2": r"m_{\mathrm{dry},2}",
    "q1_2": "q_{1,2}",
    "C_D0": r"C_{\mathrm{D0}}",
    "Alpha": r"\mathrm{Alpha}",  # LaTeX has no such letter
    "ETA": r"\mathrm{ETA}",
    "_": r"\mathrm{\_}",
    "_x": "x",
}


@pytest.mark.parametrize(("name", "written"), NAMES.items())
def test_names_are_letters_with_indices_or_words(name, written):
    assert in_latex(name) == written


def problem(**others):
    theta, dtheta = coordinate("theta1")
    mass, rod, g = parameters(mass=1, rod=2, g=9.81)
    u = control("u")
    return Control(
        lagrangian=mass * rod**2 * dtheta**2 / 2,
        force={theta: u - g * mass * rod * sin(theta)},
        cost=u**2,
        start={theta: 0, dtheta: 0},
        **others,
    )


def test_units_stand_in_a_last_row_with_the_values_of_parameters():
    x, v = states("x v", unit="m m/s")
    u, (m, c) = control("u", unit="N"), parameters(m=(2, "kg"), c=(0.5, "1"))
    text = latex(Control(dynamics={x: v, v: c * u / m}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1}))
    assert r"\text{units}\quad &x\;[\text{m}],\quad v\;[\text{m/s}],\quad u\;[\text{N}],\quad m = 2\,\text{kg}" in text
    assert r"&c = 0.5\,\text{1}" in text
    assert "units" not in latex(problem(duration=2))


def test_words_stand_apart_in_products():
    text = latex(problem(duration=2))
    assert r"\frac{\mathrm{mass} \, \mathrm{rod}^{2} \, \dot{\theta_{1}}^{2}}{2}" in text
    assert r"f_{\theta_{1}} &= u - g \, \mathrm{mass} \, \mathrm{rod} \, \sin{\left(\theta_{1} \right)}" in text
    assert r"\dot{\theta_{1}}(0) &= 0" in text
    assert r"\," not in typed_use.double_integrator()._repr_latex_()  # letters need no space


def test_time_ends_at_the_duration():
    assert "T &= 2" in latex(problem(duration=2))
    free = latex(problem(duration=free_parameter("T", 1)))
    assert "T &=" not in free
    assert r"&0 \le T\quad\text{(free)}" in free
    period = latex(problem(duration=free_parameter("period", 1, lower=0.5, upper=3)))
    assert r"\int_{0}^{\mathrm{period}}" in period
    assert r"&0.5 \le \mathrm{period} \le 3\quad\text{(free)}" in period


def test_another_quantity_may_be_called_as_the_end_of_time():
    T, u = state("T"), control("u")
    text = latex(Control(dynamics={T: u}, cost=u**2, duration=3, start={T: 20}, end={T: 30}))
    for row in (r"\dot{T} &= u", r"t_\mathrm{f} &= 3", "T(0) &= 20", r"T(t_\mathrm{f}) &= 30"):
        assert row in text


def test_forces_do_not_take_the_names_of_controls():
    x, dx = coordinate("x")
    f = control("f_x")
    text = latex(Control(lagrangian=dx**2 / 2, force={x: f}, cost=f**2, duration=1, start={x: 0, dx: 0}))
    assert "Q_{x} &= f_{x}" in text


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_row_says_that_something_is_itself(file):
    for row in re.split(r" \\\\ |\\end\{aligned\}", latex(object_of(file).problem)):
        left, sign, right = row.partition(" &= ")
        assert not sign or left != right, row


def test_every_part_of_a_problem_is_a_row():
    x, v = states("x v")
    u = control("u")
    V = free_parameter("V", 1)
    text = latex(
        Control(
            dynamics={x: v, v: u - x.delayed(0.5)},
            cost=u**2,
            terminal_cost=V,
            duration=2,
            history={x: 1},
            start={v: 0},
            start_conditions=[Eq(v, V)],
            end_conditions=[x - 1],
            path={"speed": v**2 <= 4},
            integral=[u**2 <= 10],
            at={1: [x >= 0]},
            waypoints=[[Eq(x, 2)], Waypoint([x - 3], window=(None, 1.5))],
            periodic={v: 0, x: 5},
            bounds={u: (None, 3), V: (0, 2)},
            bodies=2,
        )
    )
    for row in (
        r"\text{minimise}\quad &\int_{0}^{T} \left(u^{2}\right) dt + V",
        r"\dot{v} &= u - x\left(t - \frac{1}{2}\right)",
        r"&\text{for each of } 2 \text{ bodies}",
        r"x(t) &= 1\quad\text{for } t \le 0",
        "v(T) &= v(0)",
        "x(T) &= x(0) + 5",
        r"&v = V\quad\text{at } t = 0",
        r"&x - 1 = 0\quad\text{at } t = T",
        r"&v^{2} \leq 4\quad\text{at every time}",
        r"&u^{2} \leq 10\quad\text{for the integral over } [0, T]",
        r"&x \geq 0\quad\text{at } t = 1",
        r"&x = 2\quad\text{at } t = t_{1}",
        r"&x - 3 = 0\quad\text{at } t = t_{2}",
        r"&t_{2} \le 1.5",
        "&0 < t_{1} < t_{2} < T",
        r"&0 \le V \le 2\quad\text{(free)}",
        r"&u \le 3",
    ):
        assert row in re.split(r" \\\\ |\\(?:begin|end)\{aligned\}", text), row


def test_measurements_are_what_is_minimised():
    (file,) = (file for file in FILES if file.stem == "gas_oil")
    sums = r"\sum_i \left(a(t_i) - z_{1,i}\right)^2 + \sum_i \left(b(t_i) - z_{2,i}\right)^2"
    assert latex(object_of(file).problem).startswith(rf"\begin{{aligned}}\text{{minimise}}\quad &{sums} \\")


def test_time_goes_on_from_phase_to_phase():
    x, v = states("x v")
    u = control("u")
    S = free_parameter("S", 1)
    first = Control(dynamics={x: v, v: u}, duration=1, start={x: 0, v: 0})
    second = Control(dynamics={x: v, v: -u}, cost=u**2, duration=S, end={x: 1})
    text = displayed(Phases(first, second, jumps=[{v: -v / 2}]))
    first_part, second_part, jumps = text.split(r"\\[1ex]")[:3]
    assert "minimise" not in first_part
    assert "t_{1} &= 1" in first_part
    for row in (r"\int_{t_{1}}^{t_{2}}", "t_{2} &= t_{1} + S", "x(t_{2}) &= 1", r"&0 \le S\quad\text{(free)}"):
        assert row in second_part
    assert r"&v \mapsto - \frac{v}{2}\quad\text{at } t = t_{1}" in jumps


def test_what_is_sought_without_a_cost_is_a_motion():
    x = codegen.state("x")
    text = latex(Control(dynamics={x: -x}, duration=1, start={x: 1}))
    assert r"&\text{find a motion}" in text
    assert "minimise" not in text
