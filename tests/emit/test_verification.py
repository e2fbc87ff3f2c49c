"""What a build emits is verified before it is written: planted defects are found, right modules are left alone."""

import re

import numpy as np
import pytest
import sympy
from planted_defects import ORIGIN, changed
from random_scalars import random_problem
from sympy import Integer, Rational, cos, exp, sin, tanh

from codegen import Control, Simulate, control, coordinates, parameters, states, time
from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import normalise
from codegen.emit import differentiation, lower, rendering, verify
from codegen.emit.differentiation import control_sensitivities
from codegen.emit.lower.printer import scalar_code
from codegen.emit.naming import Choices
from codegen.emit.verify import comparison, kernels, shares
from codegen.errors import ExpressionError, VerificationError
from codegen.solving import compiler
from codegen.solving.compiler import generate_from_model
from codegen.symbolic import derivatives as differentiate
from codegen.symbolic.graph import written_out


def cart() -> Control:
    """A pendulum on a cart, with a terminal cost that is curved."""
    (x, a), (dx, da) = coordinates("x a")
    u, t, (m, M, g) = control("u"), time(), parameters(m=0.3, M=1.2, g=9.81)
    lagrangian = (M + m) * dx**2 / 2 + m * dx * da * cos(a) + m * da**2 / 2 + m * g * cos(a)
    return Control(
        lagrangian=lagrangian,
        force={x: u - dx / 5},
        cost=u**2 + sin(t) ** 2 * x**2 / 3,
        terminal_cost=(x - 1) ** 4 * m,
        duration=2,
        start={x: 0, a: 0, dx: 0, da: 0},
        end={a: sympy.pi, dx: 0.1, da: 0},
        guess={x: t / 2, a: sympy.pi * t / 2},
        steps=10,
    )


def swinging() -> Simulate:
    """A spring pendulum, of which a step leaves two equations to be solved."""
    (r, a), (dr, da) = coordinates("r a")
    k, g = parameters(k=40.0, g=9.81)
    lagrangian = (dr**2 + r**2 * da**2) / 2 + g * r * cos(a) - k * (r - 1) ** 2 / 2
    return Simulate(lagrangian=lagrangian, duration=1, start={r: 1.1, a: 0.4, dr: 0, da: 0}, steps=20)


def prepared(problem, **choices):
    program = transcribe.transcribe(normalise(problem), choices.get("scheme"), choices.get("method"), "interval")
    return program, rendering.render(lower.lower(program, differentiation.derivatives(program)), ORIGIN)


@pytest.fixture(scope="module")
def of_cart():
    return prepared(cart())


@pytest.fixture(scope="module")
def of_pendulum():
    return prepared(swinging())


@pytest.fixture(scope="module")
def of_explicit_pendulum():
    return prepared(swinging(), scheme="explicit-euler", method="hamiltonian")


DEFECTS = {
    "sign of a gradient": ("interval_gradient", r"gradient\[1\] = (.*?)(  #|\n)", r"gradient[1] = -(\1)\2"),
    "factor in a Hessian": ("interval_hessian", r"hessian\[3\] = (.*?)(  #|\n)", r"hessian[3] = 1.000001*(\1)\2"),
    "dropped entry": ("interval_hessian", r"hessian\[4\] = (.*?)(  #|\n)", r"hessian[4] = 0.0\2"),
    "wrong index": ("interval_hessian", r"hessian\[2\] = ", "hessian[3] = "),
    "term missing": ("interval_gradient", r"gradient\[5\] = .*? [+-] ", "gradient[5] = "),
    "wrong exponent": ("interval_gradient", r"\*\*2", "**3"),
    "wrong parameter": ("interval_gradient", r"parameters\[0\]", "parameters[1]"),
    "wrong unknown": ("interval_hessian", r"= unknowns\[1\]", "= unknowns[0]"),
    "sine for cosine": ("interval_hessian", r"math\.cos\(", "math.sin("),
    "wrong coefficient": ("interval_gradient", r"0\.5\*", "0.25*"),
    "cost": ("interval_gradient", r"\n    return (.*)", r"\n    return 1.0001*(\1)"),
    "gradient at an end": ("end_gradient", r"gradient\[(\d+)\] \+= (.*?)(  #|\n)", r"gradient[\1] += -(\2)\3"),
    "cost at an end": ("end_gradient", r"\n    return (.*)", r"\n    return 2*(\1)"),
    "Hessian at an end": ("end_hessian", r"hessian\[0\] = (.*?)(  #|\n)", r"hessian[0] = 1.01*(\1)\2"),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_planted_defect_is_found(of_cart, name):
    program, text = of_cart
    broken = changed(text, *DEFECTS[name])
    with pytest.raises(VerificationError, match="the emitted code gives"):
        verify.verify(program, broken)


@pytest.fixture(scope="module")
def of_sensitive_cart():
    program = transcribe.transcribe(normalise(cart()), None, None, "interval")
    module = lower.lower(program, differentiation.derivatives(program), control_sensitivities(program))
    return program, rendering.render(module, ORIGIN)


MIXED_DEFECTS = {
    "slope": ("interval_mixed", r"slopes\[0\] = (.*?)(  #|\n)", r"slopes[0] = -(\1)\2"),
    "slope by time": ("interval_mixed", r"slopes\[10\] = (.*?)(  #|\n)", r"slopes[10] = 0\2"),
    "mixed": ("interval_mixed", r"mixed\[3\] = (.*?)(  #|\n)", r"mixed[3] = 1.000001*(\1)\2"),
    "dropped entry": ("interval_mixed", r"mixed\[2\] = (.*?)(  #|\n)", r"mixed[2] = 0.0\2"),
    "wrong index": ("interval_mixed", r"mixed\[1\] = ", "mixed[2] = "),
    "slope at an end": ("end_mixed", r"slopes\[(\d+)\] = (.*?)(  #|\n)", r"slopes[\1] = 2*(\2)\3"),
    "mixed at an end": ("end_mixed", r"mixed\[0\] = (.*?)(  #|\n)", r"mixed[0] = -(\1)\2"),
    "mixed at the start": ("start_mixed", r"mixed\[0\] = (.*?)(  #|\n)", r"mixed[0] = 1 + (\1)\2"),
}


@pytest.mark.parametrize("name", MIXED_DEFECTS)
def test_planted_defect_of_sensitivities_is_found(of_sensitive_cart, name):
    program, text = of_sensitive_cart
    verify.verify(program, text)
    with pytest.raises(VerificationError, match="the emitted code gives"):
        verify.verify(program, changed(text, *MIXED_DEFECTS[name]))


def test_swapped_rows_of_the_pattern_are_found(of_cart):
    program, text = of_cart
    rows = re.search(r"^HESSIAN_ROWS = .*$", text, re.MULTILINE)
    numbers = [int(n) for n in re.findall(r"\d+", rows.group().split("[")[1].split("]")[0])]
    i = next(i for i, n in enumerate(numbers) if n != numbers[0])
    numbers[0], numbers[i] = numbers[i], numbers[0]
    line = re.sub(r"\[.*?\]", str(numbers), rows.group(), count=1)
    with pytest.raises(VerificationError, match="second derivative"):
        verify.verify(program, text.replace(rows.group(), line))


STEP_DEFECTS = {
    "residual": ("step_residual", r"residual\[1\] = (.*)", r"residual[1] = -(\1)"),
    "residual beside the Jacobian": ("step_jacobian", r"residual\[0\] = (.*)", r"residual[0] = 2*(\1)"),
    "Jacobian": ("step_jacobian", r"jacobian\[1\] = (.*?)(  #|\n)", r"jacobian[1] = 1.001*(\1)\2"),
    "state after the step": ("complete_step", r"interval\[0\] = (.*?)(  #|\n)", r"interval[0] = 1.001*(\1)\2"),
    "equations": ("step_equations", r"residual\[2\] = (.*?)(  #|\n)", r"residual[2] = 1.001*(\1)\2"),
    "energy": ("energy", r"return (.*)", r"return 1.001*(\1)"),
}


@pytest.mark.parametrize("name", STEP_DEFECTS)
def test_planted_defect_of_a_step_is_found(of_pendulum, name):
    program, text = of_pendulum
    with pytest.raises(VerificationError, match="the emitted code gives"):
        verify.verify(program, changed(text, *STEP_DEFECTS[name]))


def test_planted_defect_of_an_explicit_step_is_found(of_explicit_pendulum):
    program, text = of_explicit_pendulum
    with pytest.raises(VerificationError, match="of a step"):
        verify.verify(
            program, changed(text, "explicit_step", r"interval\[3\] = (.*?)(  #|\n)", r"interval[3] = -(\1)\2")
        )


@pytest.fixture
def compared(monkeypatch):
    """What has been compared since: for every kind of entries their names, and the values that agree at some points."""
    seen: list[tuple[list[str], np.ndarray]] = []

    def judge(names, evaluate, opinion):
        comparison.judge(names, evaluate, opinion)
        emitted, exact = evaluate(np.clongdouble)
        agree = np.isfinite(exact) & (abs(emitted - exact) <= 1e-9 * abs(exact))
        seen.append((list(names), agree & (exact != 0)))

    monkeypatch.setattr(shares, "judge", judge)
    monkeypatch.setattr(kernels, "judge", judge)
    return seen


def test_what_is_emitted_passes(of_cart, of_pendulum, of_explicit_pendulum, compared):
    """And not because nothing was looked at: entries of every kind that are other than zero agree."""
    kinds = {
        of_cart: ("the cost of an interval", "the derivative of an interval", "the second derivative of the end"),
        of_pendulum: ("the equation p_a_k1", "of a step", "the energy"),
        of_explicit_pendulum: ("of a step", "the energy"),
    }
    for (program, text), expected in kinds.items():
        compared.clear()
        verify.verify(program, text)
        names = [name for names, agree in compared for name in np.array(names)[agree.any(axis=0)]]
        for kind in expected:
            assert any(kind in name for name in names), names


FLAT = {
    "reaction": (lambda x: Rational(72) * 10**9 * exp(-8750 / x), 350),
    "logistic": (lambda x: 1 / (1 + exp(-50 * (x - 8))), 8),
    "gaussian": (lambda x: exp(-((x - 20) ** 2)), 20),
    "steep": (lambda x: tanh(200 * (x - 5)), 5),
    "tiny": (lambda x: x**2 / Integer(10) ** 42, 10**10),
}


@pytest.mark.parametrize("name", FLAT)
def test_entries_lost_because_they_are_small_elsewhere_are_found(name, monkeypatch):
    """With a test for zero by size, entries go missing where the motion is, and no module is written."""
    term, far = FLAT[name]
    x, v = states("x v")
    u = control("u")
    model = normalise(
        Control(
            dynamics={x: v, v: u + term(x) * v},
            cost=u**2,
            duration=1,
            start={x: far, v: 0},
            end={x: far + 0.1, v: 0},
            steps=8,
        )
    )
    monkeypatch.setattr(differentiation, "LONG", 0)
    generate_from_model(model, Choices(), ORIGIN)
    monkeypatch.setattr(differentiate, "vanishing", lambda graph, roots: {r for r in roots if size(graph, r) < 1e-40})
    with pytest.raises(VerificationError, match="for the second derivative"):
        generate_from_model(model, Choices(), ORIGIN)


def size(graph, root) -> float:
    """The size of a value where all symbols are 0.7."""
    (value,) = written_out(graph, [root])
    return abs(value.evalf(60, subs=dict.fromkeys(value.free_symbols, 0.7)))


def test_nothing_is_written_where_a_derivative_is_wrong(tmp_path, monkeypatch):
    file = tmp_path / "falling.py"
    file.write_text(
        '"Falling through air."\n'
        "from codegen import Control, control, states\n"
        "def problem():\n"
        "    x, v = states('x v')\n"
        "    u = control('u')\n"
        "    return Control(dynamics={x: v, v: u - v**2}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1})\n"
    )
    original = rendering.render

    def broken(module, origin):
        return changed(original(module, origin), "interval_hessian", r"hessian\[0\] = ", "hessian[0] = 3 + ")

    monkeypatch.setattr(rendering, "render", broken)
    with pytest.raises(VerificationError, match="the emitted code gives"):
        compiler.build(file, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def of_ring():
    """Beads on a ring with springs between neighbours, of which one is stiffer than the others."""
    q, v = coordinates(" ".join(f"q{i}" for i in range(60)))
    stiff, k = parameters(stiff=2.0, k=1.0)
    stretches = zip(q, (*q[1:], q[0]), strict=True)
    springs = sum((stiff if i == 20 else k) * (1 - cos(b - a)) for i, (a, b) in enumerate(stretches))
    return prepared(
        Simulate(
            lagrangian=sum(w**2 for w in v) / 2 - springs,
            duration=1,
            start={x: i / 100 for i, x in enumerate(q)} | dict.fromkeys(v, 0),
            steps=20,
        )
    )


@pytest.mark.parametrize(
    ("function", "pattern", "replacement"),
    [
        ("step_jacobian", r"for i in range\((\d+)\)", lambda match: f"for i in range({int(match[1]) - 1})"),
        ("step_jacobian", r"(state\[.*i \+ )(\d+)\]", lambda match: f"{match[1]}{int(match[2]) - 1}]"),
        ("step_equations", r"(residual\[.*i, 0\].*?\] = )", lambda match: f"{match[1]}1e-3 + "),
    ],
    ids="repetition index value".split(),
)
def test_defects_in_loops_over_alike_rows_are_found(of_ring, function, pattern, replacement):
    program, text = of_ring
    verify.verify(program, text)
    with pytest.raises(VerificationError, match="the emitted code gives"):
        verify.verify(program, changed(text, function, pattern, replacement))


def test_where_no_condition_of_a_piecewise_function_holds_there_is_no_number():
    x, v = states("x v")
    u, t = control("u"), time()
    pushed = sympy.Piecewise((t, t < 0.5), (1 - t, t < 1))
    problem = Control(
        dynamics={x: v, v: u + pushed * x**2}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1}, steps=4
    )
    text = generate_from_model(normalise(problem), Choices(), ORIGIN)
    assert "else math.nan)" in text
    assert "else None)" not in text


@pytest.mark.parametrize(
    "number", [Integer(10) ** 400, Rational(1, 10**400), sympy.Float("1e-400"), -sympy.Float("1e330")]
)
def test_constants_that_double_precision_cannot_hold_are_refused(number):
    with pytest.raises(ExpressionError, match="which double precision cannot hold"):
        scalar_code(number * sympy.Symbol("x"))


@pytest.mark.parametrize("seed", [0, 1, 3])  # deriving that of 2 takes ten seconds
def test_random_problems_with_flat_terms_and_constants_of_all_sizes(seed, compared):
    """`tests/benchmarks/random_derivatives.py` runs a thousand of them."""
    problem, choices = random_problem(seed)
    generate_from_model(normalise(problem), choices, ORIGIN)
    of_interval = [agree for names, agree in compared if names and "second derivative of an interval" in names[0]]
    assert of_interval
    for agree in of_interval:
        assert agree.any(axis=1).sum() >= 5  # so many points had values
        assert agree.any(axis=0).sum() >= 1
