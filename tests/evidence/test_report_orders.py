"""Orders of optima by mesh sequences and fits, limits of costs, and the statistics of an energy's drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from interpreted import without_compilation

from codegen.emit.naming import Choices
from codegen.evidence.report.building import Variant
from codegen.evidence.report.comparison import fitted_order, verdict
from codegen.evidence.report.optima import (
    all_grids,
    fitted_limit,
    limit_of,
    measured,
    sequence,
    switching,
)
from codegen.evidence.report.simulations import drift_values, symplecticity_defect, trend_in_words, trend_of
from codegen.evidence.report.store import Case, Store, section_of
from codegen.solving import api
from codegen.solving.compiler import generate

EFFORT = '''"""Move a unit mass by one unit of length in one unit of time, with least effort."""

from codegen import Control, control, coordinate


def problem() -> Control:
    x, v = coordinate("x")
    f = control("f")
    return Control(
        lagrangian=v**2 / 2, force={x: f}, cost=f**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0}, steps=20,
        bounds=BOUNDS,
    )
'''
OSCILLATOR = '''"""Let a unit mass swing on a spring."""

from codegen import Simulate, canonical_pair


def problem() -> Simulate:
    q, p = canonical_pair("q", "p")
    return Simulate(hamiltonian=p**2 / 2 + q**2 / 2, duration=2, start={q: 1, p: 0}, steps=20)
'''


def module_of(folder: Path, text: str, scheme: str, method: str):
    path = folder / "problem.py"
    path.write_text(text)
    return without_compilation(generate(path, {}, Choices(scheme, method)))


def test_limits_of_smooth_sequences():
    """12 N^2/(N^2 - 1), the least effort with N intervals, and a sequence with all powers of h."""
    steps = [12 * 2**k for k in range(6)]
    even = limit_of([12.0 * n**2 / (n**2 - 1.0) for n in steps], 2)
    assert abs(even.value - 12.0) < 1e-12
    assert even.error < 1e-11
    odd = limit_of([7.0 * np.exp(3.0 / n) for n in steps], 1)
    assert abs(odd.value - 7.0) <= odd.error < 1e-6


PHASES = [np.sin(5.0 * n * np.sqrt(2.0)) for n in range(10_000)]
"""Where in its interval a control switches: anywhere."""


@pytest.mark.parametrize("order", [1, 2])
def test_errors_that_vary_with_the_grid_have_a_fitted_order(order):
    steps = [round(20 * 2 ** (k / 6)) for k in range(36)]
    costs = [3.0 + (2.0 + PHASES[n]) * n**-order for n in steps]
    limit = fitted_limit(steps, costs, order)
    assert abs(limit.value - 3.0) < limit.error < costs[-1] - 3.0
    found = fitted_order(steps, [cost - 3.0 for cost in costs], 0.0)
    assert found is not None
    assert found.uncertainty is not None
    assert abs(found.value - order) < 1.5 * found.uncertainty < 0.3
    assert verdict(found, order) == ""
    assert verdict(found, order + 1) == "below the expected order"
    assert fitted_order(steps[:5], costs[:5]) is None


def test_a_mesh_sequence_has_the_optima_of_its_grids(tmp_path):
    module = module_of(tmp_path, EFFORT.replace("BOUNDS", "{}"), "midpoint", "variational")
    values = sequence(module, 5, 60.0)
    assert values["switching"] == []
    assert values["steps"] == [5 * 2**k for k in range(len(values["steps"]))]
    for n, cost in zip(*all_grids(values), strict=True):
        assert cost == pytest.approx(12.0 * n**2 / (n**2 - 1.0), rel=1e-11)
    store, problem, variant = Store(tmp_path / "s.jsonl"), Path("effort.py"), Variant(Path("effort.py"), "m", "s", 2)
    store.measured(Case(section_of(problem, "mesh sequences"), variant.label, lambda: values))
    found = measured(store, problem, variant)
    assert found.order is not None
    assert found.order.value == pytest.approx(2.0, abs=0.02)
    assert (found.verdict, found.remark) == ("", "")
    store.measured(Case(section_of(problem, "reference"), "cost", lambda: {"cost": 15.0, "error": 1e-9}))
    elsewhere = measured(store, problem, variant)
    assert elsewhere.remark == "another local optimum, whose cost tends to 12"
    assert elsewhere.order == found.order


@pytest.mark.parametrize(("bound", "names"), [(5, ["f"]), (7, [])])
def test_bounds_that_become_active_are_seen(tmp_path, bound, names):
    """Without bounds the force is 6 - 12 t."""
    module = module_of(tmp_path, EFFORT.replace("BOUNDS", f"{{f: (-{bound}, {bound})}}"), "midpoint", "variational")
    result = api.solve(module, steps=20)
    assert result.solved
    assert switching(module, result) == names


def test_trends_are_told_from_swings_and_noise():
    t = np.linspace(0.0, 1000.0, 2001)
    swing = np.sin(1.7 * t) + 0.1 * np.random.default_rng(1).standard_normal(t.size)
    assert abs(trend_of(t, swing).t) < 3.0
    risen = trend_of(t, swing + 0.2 * t / 1000.0)
    assert abs(risen.rise - 0.2) < 3.0 * risen.error
    assert risen.t > 3.0


def test_drifts_of_a_spring(tmp_path):
    """A step of explicit Euler has S'JS - J = h^2 J, and multiplies the energy by 1 + h^2."""
    euler = module_of(tmp_path, OSCILLATOR, "explicit-euler", "hamiltonian")
    state = np.array([0.3, -0.7])
    assert symplecticity_defect(euler, 0.1, state) == pytest.approx(0.01, abs=1e-12)
    values = drift_values(euler, 100)
    assert values["oscillation"] == pytest.approx(0.5 * (1.01**100 - 1.0))
    assert trend_in_words(values) != "none"
    symplectic = module_of(tmp_path, OSCILLATOR, "symplectic-euler", "hamiltonian")
    assert symplecticity_defect(symplectic, 0.1, state) < 1e-12
    assert trend_in_words(drift_values(symplectic, 20_000)) == "none"
