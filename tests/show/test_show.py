"""The derived equations as text and as LaTeX."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

import pytest
from sympy import cos, diag, eye, sin

import codegen
from codegen import Simulate, rotation
from codegen.discretise import schemes
from codegen.errors import ArgumentError, SchemeError
from codegen.problem.sources import source_of
from codegen.show.equations import equations

PROBLEMS = Path(__file__).parents[2] / "problems"
CASES = [
    ("pendulum", {}, {}),
    ("pendulum", {"form": "lagrangian"}, {}),
    ("linear_pendulum", {}, {"controls": "nodal"}),
    ("orbital_transfer", {}, {}),
    ("goddard_rocket", {}, {}),
    ("two_stage_rocket", {}, {}),
    ("bouncing_ball", {}, {"method": "hamiltonian"}),
    *(
        ("orbital_transfer", {}, {"method": method, "scheme": name})
        for method, names in schemes.METHODS.items()
        for name, scheme in names.items()
        if scheme.order <= 2
    ),
    ("linear_pendulum", {}, {"scheme": "gauss-4"}),
    ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "gauss-4"}),
    ("linear_pendulum", {}, {"scheme": "lobatto-4"}),
    ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "yoshida-4"}),
    ("pendulum", {}, {"scheme": "kahan-li-8"}),
]


def shown(problem, arguments=None, **choices):
    return equations(PROBLEMS / f"{problem}.py", arguments or {}, **choices)


@pytest.mark.parametrize(("problem", "arguments", "choices"), CASES)
def test_text_is_at_most_100_columns_wide(problem, arguments, choices):
    for line in shown(problem, arguments, **choices).splitlines():
        assert sum(not unicodedata.combining(character) for character in line) <= 100
        assert line == line.rstrip()


@pytest.mark.parametrize(("problem", "arguments", "choices"), CASES)
def test_latex_is_balanced(problem, arguments, choices):
    text = shown(problem, arguments, latex=True, **choices)
    assert text.isascii()
    assert text.count(r"\begin{align*}") == text.count(r"\end{align*}") > 3
    depth = 0
    for character in re.sub(r"\\[{}]", "", text):
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth >= 0
    assert depth == 0
    assert len(re.findall(r"(?<!\\)\$", text)) % 2 == 0
    for block in re.findall(r"\\begin\{align\*\}(.*?)\\end\{align\*\}", text, re.DOTALL):
        rows = block.strip().split("\\\\\n")
        assert all(row.count("&") == 1 for row in rows)
        # \left and \right may not be separated by a line break.
        assert all(row.count(r"\left") == row.count(r"\right") for row in rows)
    assert r"\mathrm{}" not in text
    assert "_{}" not in text


def test_discrete_equation_of_the_linear_pendulum():
    text = shown("linear_pendulum", latex=True)
    row = next(line for line in text.splitlines() if line.startswith("0 &=") and "k-1" in line)
    # q_{k+1} - 2 q_k + q_{k-1} = h^2 (f - q averaged): signs as in D2 Ld + D1 Ld + f+ + f- = 0, erratum 4.
    for term in (
        r"\frac{f_{k} h}{2}",
        r"\frac{f_{k-1} h}{2}",
        r"- \frac{h q_{k}}{2}",
        r"\frac{2 q_{k}}{h}",
        r"- \frac{q_{k+1}}{h}",
    ):
        assert term in row


def test_boundary_conditions_and_dots():
    text = shown("orbital_transfer")
    assert "φ(T) = 2⋅π⋅revolutions" in text
    assert "p_r(0) = 0" in text
    assert "φ̈" in text
    assert "λ_φₖ" in text
    assert "rₖ₊₁" in text
    assert "φₖ₋₁" in text


def test_hamiltonian_step_has_stages():
    text = shown("orbital_transfer", method="hamiltonian", scheme="stormer-verlet")
    assert "One step" in text
    assert "r⁽¹⁾ₖ" in text


def test_first_order_dynamics_and_step():
    text = shown("goddard_rocket", latex=True)
    assert r"\dot{m} &= - \frac{\mathrm{thrust}}{c}" in text
    assert r"m_{k+1} &= - \frac{\mathrm{thrust}_{k} h}{c} + m_{k}" in text


def test_phases_and_switches():
    text = shown("bouncing_ball", latex=True)
    assert text.count("Euler-Lagrange equations.}") == 4
    assert "Switch from phase 1 to phase 2" in text
    for row in (r"y^{-} &= 0", r"\dot{x}^{+} &= \dot{x}^{-} f", r"\dot{y}^{+} &= - \dot{y}^{-} e"):
        assert row in text
    assert "m⁺ = -dry₁ + m⁻" in shown("two_stage_rocket")


@pytest.mark.parametrize(
    ("problem", "rows"),
    [
        ("goddard_rocket", ("C_T = -r(T)", "Free parameters, at their first guess", "0 ≤ T", "0 ≤ thrust ≤ greatest")),
        ("bryson_denham", ("x ≤ wall",)),
        ("low_thrust", ("At every time, not positive", "C_T = -r(T)")),
        ("spherical_pendulum", ("Holonomic constraints", "0 = ")),
        ("two_stage_rocket", ("Terminal cost", "Bounds in phase 2")),
        ("published/bioreactor", ("Periodic ends", "y(T) = y(0)", "0 ≤ u ≤ 1")),
        ("published/isoperimetric_area", ("the cost is minus what is to be greatest", "At every time\n")),
    ],
)
def test_all_that_a_problem_says_is_shown(problem, rows):
    text, latex = shown(problem), shown(problem, latex=True)
    for row in rows:
        assert row in text
    assert r" \leq " in latex or "≤" not in text


def test_initial_state_of_a_simulation():
    text = shown("pendulum")
    assert "p(0) = 7/5" in text
    assert "solved for numerically in each step: pₖ₊₁" in text
    assert "the step is explicit" in shown("pendulum", scheme="symplectic-euler")


def test_unknown_choices_are_refused():
    with pytest.raises(SchemeError):
        shown("pendulum", scheme="middle")
    with pytest.raises(ArgumentError):
        shown("pendulum", controls="nodal")


def test_squares_of_sine_and_cosine_add_up_to_one():
    q, v = codegen.coordinate("q")
    lagrangian = (v * sin(q)) ** 2 / 2 + (v * cos(q)) ** 2 / 2
    text = equations(source_of(codegen.Simulate(lagrangian=lagrangian, duration=1, start={q: 0, v: 1})))
    assert "cos" in text.split("Discrete Lagrangian")[0]
    assert "cos" not in text.split("Discrete Lagrangian")[1]


def test_rotations_are_shown_as_an_author_writes_them():
    """The heavy top: Euler's equations with the moments of the weight, without a quaternion."""
    R, omega = rotation("R")
    problem = Simulate(
        lagrangian=omega.dot(diag(1, 2, 3) * omega) / 2 - 5 * R[2, 2], start={R: eye(3), omega: (1, 0, 0)}, duration=1
    )
    text = unicodedata.normalize("NFD", equations(source_of(problem)))
    written = text.partition("Holonomic constraints")[0]
    assert "R_w⋅" not in written
    assert "L = -5⋅R₃₃ +" in written
    rows = [line.strip() for line in written.splitlines()]
    # J omega' + omega x J omega = R^T (0, 0, -5) moved by e_z: the moments are (-5 R32, 5 R31, 0).
    for balance in (
        "0 = -5⋅R₃₂ + ω_y⋅ω_z + ω\u0307_x",
        "0 = 5⋅R₃₁ - 2⋅ω_x⋅ω_z + 2⋅ω\u0307_y",
        "0 = ω_x⋅ω_y + 3⋅ω\u0307_z",
    ):
        assert balance in rows
    assert "|h ω| = 4 tan(angle/4)" in text


@pytest.mark.parametrize("latex", [False, True])
def test_measured_numbers_are_decimals_and_short_fractions_remain(latex):
    """Of 0.000203497084305382 seven digits are shown, and 3/8 stays a fraction."""
    x, dx = codegen.coordinate("x")
    mass, stiffness = 0.000203497084305382, 0.375
    problem = Simulate(lagrangian=mass * dx**2 / 2 - stiffness * x**2 / 2, duration=1, start={x: 1, dx: 0}, steps=10)
    text = equations(source_of(problem), {}, latex=latex)
    assert re.search(r"0\.000203497|2\.03497\d* \\cdot 10\^\{-4\}|0\.0001017485", text)
    assert "101748542152691" not in text
    assert not re.search(r"\d{12}", text)
    assert re.search(r"\{3 x\}\{8\}|\b8\b", text)
