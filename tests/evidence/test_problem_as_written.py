"""Modules are compared with the problem that their author wrote, by a path of its own."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from failed_checks import failures
from mutated_package import TEXTS

from codegen.evidence import checks
from codegen.evidence.checks import author, authored, limits

NAME = "problem as written"


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Problem files with most conditions that an author may state."""
    folder = tmp_path_factory.mktemp("texts")
    for name, text in TEXTS.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    return {name: folder / f"{name}.py" for name in TEXTS}


NUMBERS = {"duration", "values at the start", "values at the end"}
MOTION = {"equations of motion", "reported motion", "cost"}
ENDS = {"velocities at the ends"}


@pytest.mark.parametrize(
    ("problem", "arguments", "choices", "subjects"),
    [
        ("orbital_transfer", {}, {}, {"parameters", *NUMBERS, *MOTION, *ENDS}),
        ("orbital_transfer", {}, {"method": "hamiltonian"}, {"parameters", *NUMBERS, *MOTION}),
        ("linear_pendulum", {}, {"scheme": "gauss-6"}, {*NUMBERS, *MOTION, *ENDS}),
        ("double_integrator", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION, *ENDS}),
        ("goddard_rocket", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION}),
        ("van_der_pol", {}, {"scheme": "rk4"}, {"parameters", "bounds", "duration", "values at the start", *MOTION}),
        ("low_thrust", {}, {}, {"parameters", *NUMBERS, *MOTION, *ENDS, "path conditions", "conditions"}),
        ("four_bar", {}, {}, {"parameters", *NUMBERS, *MOTION, *ENDS, "path conditions"}),
        ("hovercraft", {}, {}, {"parameters", *NUMBERS, *MOTION, *ENDS, "conditions"}),
        ("bouncing_ball", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION, *ENDS, "conditions"}),
        ("two_stage_rocket", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION, "conditions"}),
        ("drone_gates", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION, "path conditions", "conditions"}),
        ("pendulum", {}, {}, {"duration", "values at the start", "equations of motion", "energy"}),
        (
            "cart_pole_balance", {"plant": "True"}, {"scheme": "gauss-4"},
            {"parameters", "duration", "values at the start", "equations of motion", "energy"},
        ),
        ("features", {}, {}, {"parameters", "bounds", *NUMBERS, *MOTION, *ENDS, "path conditions", "conditions"}),
        (
            "features", {}, {"method": "hamiltonian"},
            {"parameters", "bounds", *NUMBERS, *MOTION, *ENDS, "path conditions", "conditions"},
        ),
        (
            "earnings", {}, {"scheme": "gauss-4"},
            {"parameters", "bounds", "duration", "values at the start", *MOTION, "conditions"},
        ),
        ("orbit", {}, {}, {"parameters", "bounds", "duration", *MOTION, "conditions"}),
    ],
)  # fmt: skip
def test_modules_agree_with_their_authors(prepared, texts, problem, arguments, choices, subjects):
    findings = checks.apply(NAME, prepared(texts.get(problem, problem), arguments, **choices))
    assert [finding.subject for finding in findings if finding.outcome != "passed"] == []
    assert {finding.subject for finding in findings} == subjects


def test_the_cost_of_measurements_between_nodes(prepared, tmp_path):
    """The interpolation has an error that is no smooth function of the number of intervals."""
    times = 0.0123, 0.0306, 0.0492, 0.078, 0.1068, 0.1503, 0.2262, 0.3642
    rows = "\n".join(f"{t},{100 - 300 * t}" for t in times)
    (tmp_path / "decay.csv").write_text(f"t,z\n{rows}\n")
    (tmp_path / "decay.py").write_text(
        '''"""A decay."""\nfrom codegen import Control, Measurements, free_parameter, state\n\n\ndef problem():
    x, k = state("x"), free_parameter("k", 10)
    observations = Measurements("decay.csv", values={x: "z"})
    return Control(dynamics={x: -k * x}, observations=observations, duration=0.3642, start={x: 100})\n'''
    )
    findings = checks.apply(NAME, prepared(tmp_path / "decay.py"))
    assert [finding.subject for finding in findings if finding.outcome != "passed"] == []
    assert "cost" in {finding.subject for finding in findings}


def test_lengths_of_micrometres(prepared, tmp_path):
    """Boundary values of zero are moved by small parts of the other values, so that no motion passes the pole."""
    (tmp_path / "switch.py").write_text(
        '''"""Pull a plate to half of the gap."""\nfrom codegen import Control, control, coordinate\n\n\ndef problem():
    (x, v), u = coordinate("x", "v"), control("u")
    return Control(
        lagrangian=1e-9 * v**2 / 2 - x**2,
        force={x: 4.4e-20 * u**2 / (2e-6 - x) ** 2 - 5e-6 * v},
        cost=u**2,
        duration=2e-4,
        start={x: 0, v: 0},
        end={x: 0.8e-6, v: 0},
        guess={u: 5},
    )\n'''
    )
    findings = checks.apply(NAME, prepared(tmp_path / "switch.py"))
    assert [finding.subject for finding in findings if finding.outcome != "passed"] == []
    assert "velocities at the ends" in {finding.subject for finding in findings}


@pytest.mark.parametrize(
    ("problem", "old", "new", "subject", "text"),
    [
        ("orbital_transfer", '"end phi": 2*math', '"end phi": 2.02*math', "values at the end", r"phi is \d\.\d+ as"),
        ("orbital_transfer", "m=100.0, GM=0.40038", "m=100.0, GM=0.4", "parameters", "GM is 0.40038 as written"),
        ("orbital_transfer", "duration = math.pi*", "duration = 2*math.pi*", "duration", "T is"),
        ("orbital_transfer", "return h*u_k**2", "return 0.5*h*u_k**2", "cost", "cost is"),
        ("orbital_transfer", "+= m*start_dr", "+= m*start_dr + 1e-3", "velocities at the ends", "p_r at the start is"),
        ("orbital_transfer", "x12 = h*u_k", "x12 = -h*u_k", "equations of motion", "phi is"),
        ("double_integrator", "= -limit  # f", "= -2*limit  # f", "bounds", r"lower bound of f is -[\d.]+ as"),
        ("double_integrator", "    return T\n", "    return 1.01*T\n", "duration", "T is"),
        ("pendulum", '"p": 1.4', '"p": 1.41', "values at the start", "p is 1.4 as written, 1.41 in the module"),
        ("pendulum", "return 0.5*p_k**2 - ", "return 0.5*p_k**2 + ", "energy", "H is"),
        ("low_thrust", "w2_k**2 - 1  #", "w2_k**2 + 1  #", "path conditions", r"w1\*\*2 \+ w2\*\*2 <= 1 is"),
    ],
)  # fmt: skip
def test_differences_are_named(prepared, damaged, problem, old, new, subject, text):
    failure, *_ = failures(NAME, damaged(prepared(problem), old, new))
    assert failure.subject == subject
    assert re.search(text, failure.detail), failure.detail


def test_values_in_the_text(prepared, damaged):
    failure, *_ = failures(NAME, damaged(prepared("linear_pendulum"), "0.5*math.pi", "0.25*math.pi"))
    numbers = [float(x) for x in re.findall(r"is (\S+) as written, (\S+) in", failure.detail)[0]]
    assert numbers == pytest.approx([math.pi / 2, math.pi / 4])


def test_delays_are_not_measured(prepared):
    *_, finding = checks.apply(NAME, prepared("delayed_oscillator"))
    assert (finding.subject, finding.outcome) == ("all but the parameters", "not measured")
    assert "delays divide the motion into segments" in finding.detail


@pytest.mark.fast
def test_nothing_is_shared_with_the_derivation():
    """The reading of the model, the discretisation, the emission and derivatives of expressions are what is checked."""
    forbidden = ("codegen.discretise", "codegen.emit", "codegen.symbolic.derivatives", "codegen.solving.compiler")
    imported = {name for module in (author, authored, limits) for name in _imports(Path(module.__file__))}
    assert "codegen.problem" in imported
    assert [name for name in imported if name.startswith(forbidden)] == []


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            yield str(node.module)


@pytest.mark.fast
def test_limits_of_known_sequences():
    """(1 + h)^(1/h) tends to e, with all powers of h in its error; a logarithm has no such expansion."""
    limit, error = limits.extrapolated([(1 + h) ** (1 / h) for h in (1 / 16, 1 / 32, 1 / 64, 1 / 128, 1 / 256)])
    assert abs(limit - math.e) < error < 1e-5
    assert limits.limit_of("log", 0.0, [1 / math.log(n) for n in (16, 32, 64, 128, 256)], 1.0).is_unsure


@pytest.mark.fast
def test_weights_and_quadrature():
    """The weight vanishes at both ends; its slope integrates to zero, and integration by parts holds."""
    leg = limits.Leg(0, 0.5, 2.0, 0, "")
    t, weights = limits.quadrature(leg.begin, leg.length)
    w, slope = limits.weight(t, leg)
    assert weights @ t**3 == pytest.approx((2.5**4 - 0.5**4) / 4, rel=1e-14)
    assert weights @ slope == pytest.approx(0.0, abs=1e-13)
    assert weights @ (slope * t**2) == pytest.approx(-weights @ (w * 2 * t), rel=1e-12)
