"""Sizes of what does not matter at the guess, and problems that are solved from there."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS
from interpreted import of_problem, text_of, without_compilation
from poorly_guessed import FIRST, SECOND, batch, charging, lane, reactions, thrust, yeast
from sympy import cos, exp, sin

import codegen
from codegen import Control, control, controls, coordinates, free_parameter, states, time
from codegen.problem.problem import Phases
from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import scaled_unknowns
from codegen.runtime.search.termination import sizes_of_terms
from codegen.solving import api
from codegen.solving.compiler import build
from codegen.solving.loading import time_grid

POISON = 1.093664682973  # IPOPT 3.14 on the same program


def module_of(problem: Control | Phases):
    return without_compilation(text_of(problem))


def take_off() -> Control:
    """Take an aircraft off and land it. IPOPT 3.14 takes 16 iterations by midpoint."""
    x, y, q, vx, vy, w = states("x y q vx vy w")
    u, s = controls("u s")
    rates = {
        **{x: vx, y: vy, q: w},
        **{vx: -u * sin(q) + s * cos(q) / 10, vy: u * cos(q) + s * sin(q) / 10 - 1, w: s},
    }
    return Control(
        dynamics=rates,
        cost=u**2 + s**2,
        duration=3,
        start=dict.fromkeys(rates, 0),
        end=dict.fromkeys(rates, 0) | {x: 1},
        bounds={u: (0, 3), s: (-20, 20)},
        guess={u: 1},
        steps=50,
    )


@pytest.mark.parametrize("scheme", ["rk4", "gauss-4", "hermite-simpson"])
def test_schemes_with_stages_take_no_more_iterations(scheme):
    """Equations of stages had a residual, and with it a size, of h a_ij f: 54, 174 and 52 iterations."""
    solution = without_compilation(text_of(take_off(), scheme=scheme)).solve(50)
    assert solution.status == "solved", solution.message
    assert solution.iterations <= 1.5 * 16


def factors_by_name(module, steps: int) -> dict[str, float]:
    """The scaling factors of unknowns of a node and an interval, by their names."""
    grid = time_grid(module, steps)
    scaled = scaled_grid(grid, module.initial_guess(grid))
    return dict(zip([*module.metadata.node, *module.metadata.interval], scaled.sizes, strict=False))


@pytest.mark.parametrize("controls_on", ["interval", "stages"])
@pytest.mark.parametrize("scheme", ["rk4", "gauss-4", "hermite-simpson"])
def test_stages_have_the_factors_of_their_states(scheme, controls_on):
    """And equations of stages those of the state's step: as by midpoint, whatever the number of intervals."""
    midpoint = without_compilation(text_of(spiral()))
    module = without_compilation(text_of(spiral(), scheme=scheme, controls=controls_on))
    for steps in (12, 30, 100, 300):
        expected, factors = factors_by_name(midpoint, steps), factors_by_name(module, steps)
        assert len(set(expected.values())) > 5, "the problem is chosen for them"
        assert len(factors) > len(expected)
        for name, factor in factors.items():
            assert factor == pytest.approx(expected[name.partition("_stage")[0]]), (name, steps)


@pytest.mark.parametrize("scheme", ["gauss-4", "gauss-6", "lobatto-4"])
def test_factors_of_equations_of_inner_positions_do_not_grow_with_the_number_of_intervals(scheme):
    """Their terms do: the factor was 1e6 on 768 intervals, and residuals of 4e-7 were accepted."""
    module, factors = without_compilation(text_of(PROBLEMS / "orbital_transfer.py", scheme=scheme)), []
    for steps in (96, 768, 6144):
        grid = time_grid(module, steps)
        scaled = scaled_grid(grid, module.initial_guess(grid))
        sizes = scaled.sizes if scaled.sizes.size else np.ones(grid.is_multiplier.size)
        factors.append((1.0 / (sizes * scaled.weight))[grid.is_multiplier][:6])
    np.testing.assert_allclose(factors[0], factors[1])
    np.testing.assert_allclose(factors[0], factors[2])
    assert max(factors[0]) <= 1e3


def test_rates_that_do_not_matter_at_the_guess_are_told_by_their_scale():
    """The second rate has no effect there, and its factor is one; the closed form has 2e-5 and 1e-5."""
    module = module_of(reactions())
    grid = module.make_grid(20)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes[-2:] == pytest.approx([1e-6, 1.0])
    slow, quick = module.solve(20), module_of(reactions(1e-5)).solve(20)
    for solution in (slow, quick):
        assert solution.status == "solved", solution.message
        assert solution.unknowns[-2:] == pytest.approx([FIRST, SECOND], rel=1e-2)
    assert quick.iterations < 60


def test_rates_that_are_flat_at_the_guess():
    """While there is much food, exp(-25) of the proteins is made. The published optimum is 32.41 in all units."""
    solution = of_problem(yeast(1e6)).solve(40)
    assert solution.status == "solved", solution.message
    assert -solution.cost == pytest.approx(32.41, rel=1e-3)


def test_a_slack_of_a_condition_without_derivatives_at_the_guess():
    """Where the squares of thrusts vanish with all their derivatives."""
    module = module_of(thrust())
    solution = module.solve(30)
    assert solution.status == "solved", solution.message
    # With acceleration 5 m/s^2 over the time s, d = 5 s (30 - s), and twice the momentum is the integral.
    s = 15 - (15**2 - 600 / 5) ** 0.5
    assert solution.cost == pytest.approx(2 * 10000 * s, rel=2e-3)


def test_a_guess_outside_its_bounds_counts_as_the_bound():
    """Rates at absolute zero have no size."""
    module = module_of(batch())
    grid = module.make_grid(40)
    with np.errstate(all="ignore"):  # of the guess, as machine code does
        scaled = scaled_grid(grid, module.initial_guess(grid))
        result = api.solve(module)
    assert scaled.sizes.size == 0 or scaled.sizes.min() >= 1e-6
    assert result.status == "solved", result.message
    assert -result.cost == pytest.approx(0.610775, rel=1e-3)


def poisoned(nuclei: float, flux: float) -> Control:
    """Shut a reactor down with the least peak of xenon, in other units; the peak is above X at the start as well."""
    iodine, xenon = states("I X")
    phi, peak = control("phi"), free_parameter("peak", 0.6 * nuclei)
    i_0 = 0.061 * 14.4 / 0.10332
    x_0 = 0.064 * 14.4 / (0.07524 + 0.972)
    made, decays = 14.4 * nuclei / flux * phi, 0.10332 * iodine
    return Control(
        dynamics={
            iodine: 0.061 * made - decays,
            xenon: 0.003 * made + decays - 0.07524 * xenon - 0.972 / flux * xenon * phi,
        },
        terminal_cost=peak,
        duration=40,
        start={iodine: i_0 * nuclei, xenon: x_0 * nuclei},
        path=[xenon <= peak],
        bounds={phi: (0, flux)},
        end_conditions=[iodine <= 0.3 * i_0 * nuclei],
        steps=60,
    )


def test_unknowns_of_the_start_alone_do_not_weigh_in_the_cost():
    """In large numbers the weight was 1e-30, and 200 times the least peak was called solved."""
    ordinary = module_of(poisoned(1.0, 1.0)).solve()
    module = module_of(poisoned(1e16, 1e14))
    grid, large = module.make_grid(60), module.solve()
    scaled = scaled_grid(grid, module.initial_guess(grid))
    _, terms = sizes_of_terms(scaled, scaled_unknowns(scaled, large.unknowns))
    assert terms < 1e7, "with the ones it was 4e18, of which rounding would excuse a stationarity of 950"
    assert (ordinary.status, large.status) == ("solved", "solved")
    assert ordinary.cost == pytest.approx(POISON, rel=1e-6)
    assert large.cost == pytest.approx(1e16 * ordinary.cost, rel=1e-6)


def spiral() -> Control:
    """Leave the earth's orbit for that of Mars in SI units; the direction of a thrust of zero has no effect."""
    r, th, vr, vt, m = states("r th vr vt m")
    f, a = controls("f a")
    mu, c, r_0, r_1 = 1.32712e20, 29420, 1.496e11, 2.28e11
    radial, along = f * sin(2 * a) / m, f * cos(2 * a) / m
    return Control(
        dynamics={r: vr, th: vt / r, vr: vt**2 / r - mu / r**2 + radial, vt: -vr * vt / r + along, m: -f / c},
        terminal_maximise=m,
        duration=500 * 86400,
        start={r: r_0, th: 0, vr: 0, vt: (mu / r_0) ** 0.5, m: 1000},
        end={r: r_1, vr: 0, vt: (mu / r_1) ** 0.5},
        bounds={f: (0, 0.3)},
        steps=30,
    )


@pytest.mark.parametrize("choices", [{}, {"scheme": "gauss-4", "controls": "stages"}])
def test_an_angle_is_one_radian_at_most(choices):
    """Balancing gravity took it for hundreds."""
    module = without_compilation(text_of(spiral(), **choices))
    grid = module.make_grid(30)
    scaled = scaled_grid(grid, module.initial_guess(grid))
    angles = [i for i, name in enumerate((*module.metadata.node, *module.metadata.interval)) if name[0] == "a"]
    assert angles
    assert scaled.sizes[angles] == pytest.approx(1.0)
    assert module.metadata.angles["a"] == 0.5


def test_a_guess_out_of_bounds_does_not_tell_sizes():
    """Drag at a tenth of the radius below the ground is e^50 of that above; so measured, rockets left for infinity."""
    module = without_compilation(build(PROBLEMS / "goddard_rocket.py").path.read_text())
    grid = module.make_grid(20)
    guess = module.initial_guess(grid)
    noise = np.random.default_rng(0).standard_normal(guess.size)
    free = free_unknowns(grid) & ~np.asarray(grid.is_multiplier)
    guess[free] += 0.1 * noise[free] * (np.abs(guess[free]) + 0.1)
    own, noisy = (scaled_grid(grid, unknowns) for unknowns in (module.initial_guess(grid), guess))
    assert own.sizes.size == noisy.sizes.size == 0
    solution = module.solve(20, guess=guess)
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(module.solve(20).cost, rel=1e-8)


def test_a_bound_beside_the_guess_does_not_tell_sizes_either():
    """A thousandth, the least mass of bacteria, became the size of a mass of one, and the end was called inaccurate."""
    module = without_compilation(build(PROBLEMS / "published" / "bioreactor.py").path.read_text())
    grid = module.make_grid(20)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes.size == 0


def climb() -> Control:
    """Climb by 100 km in a thin atmosphere, in metres; at one time the guess is 300 km below the ground."""
    x, v = states("x v")
    u, w = controls("u w")
    t = time()
    return Control(
        dynamics={x: v, v: u + 1e-3 * w - 9.81 - 1e-3 * exp(-x / 7200) * v},
        cost=u**2 + w**2,
        duration=100,
        start={x: 1e5, v: 0},
        end={x: 2e5, v: 0},
        bounds={u: (-300, 300), w: (-30, 30)},
        guess={x: 1e5 - 4e5 * exp(-(((t - 50) / 2) ** 2)), v: 1000, u: 10},
        steps=40,
    )


def test_a_sample_where_derivatives_leave_all_measure_does_not_count():
    """Else equations are divided by 1e18, and controls that seem to do nothing are as large."""
    module = without_compilation(text_of(climb()), "climb")
    grid = time_grid(module, 40)
    sizes = dict(
        zip(
            [*module.metadata.node, *module.metadata.interval],
            scaled_grid(grid, module.initial_guess(grid)).sizes,
            strict=False,
        )
    )
    assert 1e-2 <= sizes["w"] <= 1e2
    assert 1e-6 <= sizes["mu_v"] <= 1e6
    assert module.solve().status == "solved"


def test_a_cost_of_hundreds_does_not_throw_the_first_steps_onto_bounds():
    """An unscaled cost sent the duration to its lower bound by its slope: 43 iterations."""
    solution = of_problem(lane()).solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(147.848102916, rel=1e-9)
    assert solution.iterations <= 25


def test_a_duration_has_its_size_where_the_guess_is_at_rest():
    """A scaling factor that balanced rounding errors was 1e18 s: 56 iterations on 100 intervals."""
    module = of_problem(charging())
    grid = time_grid(module, 20)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes[-1] == 100.0
    solution = module.solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(579.3235674463, rel=1e-9)
    assert solution.iterations <= 30


def climb_of_orbits() -> Control:
    """Spiral from one circular orbit to a larger one in the least time; the thrust has a limit in all directions."""
    (r, phi), (dr, dphi) = coordinates("r phi")
    u, w = controls("u w")
    T = free_parameter("T", 40, lower=1)
    return Control(
        lagrangian=(dr**2 + r**2 * dphi**2) / 2 + 1 / r,
        force={r: 0.01 * u, phi: 0.01 * w * r},
        path=[u**2 + w**2 <= 1],
        terminal_cost=T,
        duration=T,
        start={r: 1, phi: 0, dr: 0, dphi: 1},
        end={r: 4, dr: 0, dphi: 0.125},
        steps=400,
    )


def test_an_inequality_in_squares_limits_controls():
    """Balancing gravity took both controls for a thousand: 416 iterations. IPOPT 3.14 takes 45 and finds 55.5434."""
    module = module_of(climb_of_orbits())
    grid = time_grid(module, 400)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes.size == 0
    solution = codegen.solve(climb_of_orbits())
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(55.5434, rel=2e-4)
    assert solution.iterations <= 100


def test_an_angle_between_two_orbits_moves_with_their_velocities():
    """The rate is linear from 1 to 1/8 in a time of 40, and its integral is 22.5."""
    module = module_of(climb_of_orbits())
    grid = time_grid(module, 400)
    nodes, _ = views(grid, module.initial_guess(grid))
    angle = nodes[0, :, module.metadata.node.index("phi")]
    np.testing.assert_allclose(angle[[0, 200, 400]], [0.0, 15.625, 22.5], atol=1e-12)


@pytest.mark.parametrize("thrust", [1e-8, 1.0, 1e5, 1e8])
def test_an_inequality_in_squares_in_other_units(thrust):
    """Move a unit mass over a unit distance, from rest to rest, in the time 2/sqrt(thrust).

    In newtons and with 1e5 of them, 5.9 times the least time was called inaccurate: the slack had the factor one.
    """
    x, y, v, w = states("x y v w")
    a, b = controls("a b")
    T = free_parameter("T", 1 / thrust**0.5)
    problem = Control(
        dynamics={x: v, y: w, v: a, w: b},
        path=[a**2 + b**2 <= thrust**2],
        terminal_cost=T,
        duration=T,
        start={x: 0, y: 0, v: 0, w: 0},
        end={x: 0.6, y: 0.8, v: 0, w: 0},
        steps=20,
    )
    module = of_problem(problem)
    grid = time_grid(module, 20)
    scaled = scaled_grid(grid, module.initial_guess(grid))
    names = [*module.metadata.node, *module.metadata.interval]
    factors = dict(zip(names, scaled.sizes, strict=False)) if scaled.sizes.size else dict.fromkeys(names, 1.0)
    assert 1e-3 <= factors["a"] / thrust <= 30
    assert 1e-3 <= factors["s_1"] / thrust**2 <= 30
    solution = module.solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(2 / thrust**0.5, rel=1e-6)
    assert solution.iterations <= 50
