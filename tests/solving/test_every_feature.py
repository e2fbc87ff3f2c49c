"""Machine code of what gives modules code of its own, all in one problem, finds what the interpreter finds.

Several bodies with conditions between them, a shared unknown, bounds, a path condition, special functions, a table,
measurements, time, and sensitivities. Machine code of it takes no longer to make than that of any two problems which
have some of these.
"""

from __future__ import annotations

import numpy as np
import pytest
from compiled_modules import compiled
from interpreted import without_compilation
from measured_decay import write

from codegen.solving.compiler import build

PAIR = '''"""Two carts in a potential of special functions move to places that depend on each other, gently."""
from sympy import erf, gamma, loggamma, sec, sinc
from codegen import Control, Measurements, Table, body_number, control, coordinate, free_parameter, parameter, time


def problem() -> Control:
    x, dx = coordinate("x")
    u, t, body = control("u"), time(), body_number()
    strength, depth = free_parameter("strength", 1, lower=0), parameter("depth", 1)
    wind = Table("wind.csv", "t", "f", name="wind")
    return Control(
        lagrangian=dx**2 / 2 - depth * sinc(x) - loggamma(x + 2) - gamma(x + 3) / 9,
        force={x: u * sec(x / 3) + strength * wind(t)}, cost=u**2 + erf(x), duration=1.9, bodies=2,
        start={x: body / 10, dx: 0}, end={dx: 0},
        end_conditions=[x.of(0) + x.of(1) - 1.7, x.of(1) - x.of(0) - 0.3], bounds={u: (-4, 1.5)}, path=[dx <= 0.7],
        observations=[Measurements(f"{name}.csv", values={x: "z"}) for name in ("first", "second")],
        guess={x: erf(2 * t) * sinc(t / 9) + body / 10}, steps=10,
    )
'''


def test_machine_code_finds_what_the_interpreter_finds(folder):
    (folder / "pair.py").write_text(PAIR)
    write(folder, "wind.csv", t=np.linspace(0.0, 4.0, 9), f=0.1 * np.sin(np.linspace(0.0, 4.0, 9)))
    for name, places in (("first", [0.2, 0.5]), ("second", [0.4, 0.7])):
        write(folder, f"{name}.csv", t=np.array([0.5, 1.1]), z=np.array(places))
    path = build(folder / "pair.py", sensitivities=True).path
    found, rates = solved_with_rates(compiled(path))
    with np.errstate(all="ignore"):
        expected, expected_rates = solved_with_rates(without_compilation(path.read_text(encoding="utf-8")))
    assert (found.status, found.iterations) == ("solved", expected.iterations)
    assert found.residual < 1e-10
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)
    np.testing.assert_allclose(found.q, expected.q, atol=1e-9)
    np.testing.assert_allclose(found.u, expected.u, atol=1e-8)
    np.testing.assert_allclose(rates.cost, expected_rates.cost, rtol=1e-6, atol=1e-7)
    assert rates.failure == expected_rates.failure == ""
    assert found.u.max() == pytest.approx(1.5, abs=1e-6)  # the bound is met
    np.testing.assert_allclose(found.q[-1], [0.7, 1.0], atol=1e-10)


def solved_with_rates(module):
    """A solution, and derivatives of it."""
    solution = module.solve()
    return solution, module.sensitivities(module.make_grid(), solution.unknowns)
