"""How the gradient of the Lagrangian changes with unknowns and data, against differences: every kind of problem."""

import numpy as np
import pytest
from control_variants import VARIANTS, trial_point
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from interpreted import of_problem
from kkt_residuals import linear_residual
from random_problems import phase_problems, single_problems

from codegen.batch.request import given_to, quantities
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.point import lagrangian
from codegen.runtime.search.sensitivities import case_at, changes_along, follow_ties, kernel_times

STEPS = 3
MORE = [
    ("bouncing_ball", None, {}),
    ("drone_gates", None, {}),
    ("bryson_denham", None, {}),
    ("delayed_oscillator", None, {}),
    ("two_stage_rocket", None, {}),
]
LENGTHS = (2e-4, 1e-4)


@pytest.mark.parametrize(("name", "text", "choices"), [*VARIANTS, *MORE])
def test_changes_of_variants(interpreted, name, text, choices):
    module = interpreted(f"{name}_changes" if text else name, text, sensitivities=True, **choices)
    steps = max(STEPS, module.metadata.inner_times + 2)
    require_exact(module, steps, seed=3, scale=0.02)


@pytest.mark.parametrize("problems", [single_problems(), phase_problems()], ids=["single", "phases"])
@settings(max_examples=6, phases=[Phase.explicit, Phase.reuse, Phase.generate])  # a smaller failure takes minutes
@given(data=st.data(), seed=st.integers(0, 1000))
def test_changes_of_random_problems(problems, data, seed):
    problem, choices = data.draw(problems)
    require_exact(of_problem(problem, sensitivities=True, **choices), STEPS, seed, 0.1)


@pytest.mark.parametrize(("name", "choices"), [("van_der_pol", {}), ("hovercraft", {}), ("low_thrust", {})])
def test_newton_steps_of_a_scaled_grid(interpreted, name, choices):
    """The scaled matrix is the plain one times scaling factors, and the weight of the cost is in these."""
    module = interpreted(name, None, sensitivities=True, **choices)
    grid, generator = module.make_grid(STEPS), np.random.default_rng(1)
    s, weight = grid.structure, 1e3
    kinds = s.kinds(STEPS)
    sizes = generator.uniform(0.1, 10.0, kinds.max() + 1)[kinds]
    scaled = grid._replace(sizes=sizes, forces=weight * sizes, weight=weight)
    unknowns = trial_point(module, grid, 3, 0.02) / sizes
    diagonal = np.where(grid.is_multiplier, 0.0, 1e5)
    gradient, step = np.where(free_unknowns(grid), generator.normal(size=sizes.size), 0.0), np.empty(sizes.size)
    system = allocate_system(scaled)
    assert factor_kkt(scaled, unknowns, 1.0, diagonal, system, gradient, step) == 0
    assert linear_residual(scaled, unknowns, diagonal, gradient, step, system)[1] < 1e-6


def require_exact(module, steps, seed, scale):
    """Compare, for every quantity, changes along it and along a random motion of all unknowns."""
    grid, generator = module.make_grid(steps), np.random.default_rng(seed)
    unknowns = trial_point(module, grid, seed, scale)
    rates, duration = module.data_rates(grid, ())
    offsets, free = module.pinned_rates(grid, rates), free_unknowns(grid)
    own = np.where(free, generator.normal(scale=0.3, size=offsets.shape), 0.0)
    moves = offsets + own
    follow_ties(grid.structure, grid.steps, offsets, moves)
    times = kernel_times(grid, rates, duration)
    changes, values = changes_along(
        case_at(grid, unknowns, free.astype(float), allocate_system(grid)), moves, rates, times
    )
    now = [*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h]
    for i, quantity in enumerate(quantities(module.QUANTITIES, module, ())):
        value = now[i] if quantity.kind == "boundary" else float(np.max(now[i]))

        def at(length, i=i, quantity=quantity, value=value):
            moved = module.make_grid(steps, **given_to({quantity: value + length}))
            there = module.with_pinned_values(moved, unknowns + length * own[i])
            point = module.evaluate(moved, there)
            bounds = module.variable_bounds(moved) if module.metadata.inequalities else ()
            duration = module.duration_of(moved, there)
            return point.gradient, lagrangian(moved, point), duration, there, bounds

        coarse, fine = (difference(at, length) for length in LENGTHS)
        gradient, change, length, motion, *bounds = [(4.0 * f - c) / 3.0 for c, f in zip(coarse, fine, strict=True)]
        about = 2e-7 * max(1.0, np.abs(gradient).max())
        assert changes[i] == pytest.approx(np.where(free, gradient, 0.0), rel=2e-7, abs=about), quantity.name
        assert values[i] == pytest.approx(change, rel=2e-7, abs=about), quantity.name
        assert moves[i] == pytest.approx(motion, rel=1e-8, abs=1e-8), quantity.name
        lengths = module.duration_rates(grid, unknowns, moves, rates, duration)
        if module.metadata.phases == 1:
            assert lengths[i].sum() == pytest.approx(length, rel=1e-7, abs=1e-8), quantity.name
        if hasattr(module, "bound_rates"):
            for found, expected in zip(module.bound_rates(grid, rates[i]), bounds, strict=True):
                assert np.where(free, found, 0.0) == pytest.approx(expected, rel=1e-7, abs=1e-8), quantity.name


def difference(at, length):
    """Central differences of all that is returned; of bounds that there are not, nothing."""
    *above, bounds_above = at(length)
    *below, bounds_below = at(-length)
    found = [(np.asarray(a) - np.asarray(b)) / (2.0 * length) for a, b in zip(above, below, strict=True)]
    for a, b in zip(bounds_above, bounds_below, strict=True):
        there = np.isfinite(a)
        found.append(np.where(there, np.where(there, a, 0.0) - np.where(there, b, 0.0), 0.0) / (2.0 * length))
    return found
