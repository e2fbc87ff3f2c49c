"""What motions do inside intervals: conditions on states, and constraints, that hold at nodes alone."""

import numpy as np
import pytest
from interpreted import of_problem

from codegen import Control, Phases, control, controls, coordinates, solve, states
from codegen.solving.results import output
from codegen.solving.results.between_nodes import GROSS, excursions, sampled_conditions


def outside(path, **how) -> Control:
    """A point that moves in the plane at least effort."""
    x, y = states("x y")
    u, w = controls("u w")
    return Control(
        dynamics={x: u, y: w},
        cost=u**2 + w**2,
        duration=1,
        start={x: -1, y: 0},
        end={x: 1, y: 0},
        path=path(x, y),
        **how,
    )


def pendulum() -> Control:
    """A pendulum swung up in Cartesian coordinates, its rod a holonomic constraint, with the least torque in 2 s."""
    (x, y), (dx, dy) = coordinates("x y")
    u = control("u")
    return Control(
        lagrangian=(dx**2 + dy**2) / 2 - 9.81 * y,
        constraint=[x**2 + y**2 - 1],
        force={x: -y * u, y: x * u},
        cost=u**2,
        duration=2,
        start={x: 0, y: -1, dx: 0, dy: 0},
        end={x: 0, y: 1, dx: 0, dy: 0},
    )


def with_nodes(module, points) -> np.ndarray:
    """Unknowns on as many nodes as there are points, whose first states are the points."""
    grid = module.make_grid(len(points) - 1)
    unknowns = module.initial_guess(grid)
    nodes, _ = module.views(grid, unknowns)
    nodes[0, :, :2] = points
    return unknowns


def found(module, points):
    return excursions(module, with_nodes(module, points), len(points) - 1, None)


@pytest.fixture(scope="module")
def disc():
    return of_problem(outside(lambda x, y: [x**2 + y**2 >= 1]))


@pytest.mark.parametrize("steps", [3, 5, 20, 100])
def test_chords_of_a_circle_are_as_deep_as_they_are(disc, steps):
    """In the middle of a chord over the angle a, 1 - x^2 - y^2 is sin^2(a/2), and its terms have cos^2(a/2)."""
    angles = np.linspace(np.pi, 0.0, steps + 1)
    (worst,) = found(disc, np.column_stack([np.cos(angles), np.sin(angles)]))
    depth = np.sin(np.pi / steps / 2) ** 2
    assert worst.condition == "x**2 + y**2 >= 1"
    assert worst.violation == pytest.approx(depth, rel=1e-9)
    assert worst.relative == pytest.approx(depth / (depth + 2 * (1 - depth)), rel=1e-5)
    assert worst.is_gross == (steps < 6)


def test_what_is_violated_at_nodes_is_no_matter_of_the_grid(disc):
    (worst,) = found(disc, [(-1.0, 0.0), (-0.99, 0.0), (-0.98, 0.0), (1.0, 0.0)])
    assert worst.violation == pytest.approx(0.98**2)  # 1 in the centre, and the rest at the node


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal", "implicit-euler", "gauss-4", "hermite-simpson"])
def test_a_wall_between_two_nodes(scheme):
    """The middle of the wall is at x = 0, whatever interpolates between nodes on both sides of it."""
    module = of_problem(outside(lambda x, y: [(x / 0.01) ** 2 + y**2 >= 1]), scheme=scheme)
    (worst,) = found(module, [(x, 0.0) for x in (-1.0, -0.8, -0.5, -0.01, 0.01, 0.5, 0.8, 1.0)])
    assert worst.violation == pytest.approx(1.0, abs=1e-12)
    assert worst.relative == pytest.approx(1.0, abs=1e-4)
    assert worst.time == pytest.approx(0.5)
    assert "at t = 0.5, 100 % of the size of its terms" in worst.note
    assert found(module, [(-1.0, 0.0), (-1.0, 2.0), (1.0, 2.0), (1.0, 0.0)]) == []


@pytest.mark.parametrize("thickness", [0.1, 0.01, 0.002])
@pytest.mark.parametrize("left", [-0.3, -0.5, -0.7])
def test_a_wall_between_two_samples(thickness, left):
    """As thin as a thousandth of the motion: where the samples beside it bend is where it is."""
    module = of_problem(outside(lambda x, y: [(2 * x / thickness) ** 2 + y**2 >= 1]))
    (worst,) = found(module, [(-1.0, 0.0), (left, 0.0), (thickness / 2, 0.0), (1.0, 0.0)])
    assert worst.violation == pytest.approx(1.0, abs=1e-5)
    assert worst.relative == pytest.approx(1.0, abs=1e-3)


def test_sizes_that_differ_do_not_hide_a_wall():
    """Nor do they make one of rounding."""
    module = of_problem(outside(lambda x, y: [x * y >= -1e-3]))
    assert found(module, [(-1.0, 0.0), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0)]) == []
    (worst,) = found(module, [(-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)])
    assert worst.violation == pytest.approx(0.25 - 1e-3)


def test_conditions_with_controls_are_not_sampled():
    x, y = states("x y")
    u, w = controls("u w")
    problem = Control(
        dynamics={x: u, y: w}, cost=u**2 + w**2, duration=1, start={x: -1, y: 0}, end={x: 1, y: 0},
        path=[u**2 + w**2 <= 9 + x, y >= x**4 - 1],
    )  # fmt: skip
    for scheme in ("midpoint", "implicit-euler", "gauss-4"):
        assert sampled_conditions(of_problem(problem, scheme=scheme)) == ("y >= x**4 - 1",)


@pytest.fixture(scope="module")
def swing():
    return of_problem(pendulum())


def test_a_jump_through_the_pivot_is_noted(swing):
    """The discrete equations hold, and cost nothing; on a finer grid the effort is 68.13."""
    result = solve(swing, steps=8)
    assert result.solved
    assert result.cost == pytest.approx(0.0, abs=1e-9)
    (note,) = (one for one in result.notes if "violates" in one)
    assert "violates x**2 + y**2 - 1 by 1 at t = " in note
    assert "more --steps, or --doublings" in note
    record = output.as_record(result, 0.0, 0.0)
    assert record["notes"] == list(result.notes)
    cells = output.as_table(record, result).columns
    assert any("x**2 + y**2 - 1" in cell for cell in cells[1].cells)


def test_a_swing_on_the_circle_is_not(swing):
    angles = np.pi * (np.linspace(0.0, 1.0, 31) - 0.5)
    result = solve(swing, warm=with_nodes(swing, np.column_stack([np.cos(angles), np.sin(angles)])), steps=30)
    assert result.solved
    assert result.cost > 10.0
    assert not any("violates" in note for note in result.notes)
    (worst,) = excursions(swing, result.unknowns, 30, None)
    assert 0.0 < worst.relative < GROSS / 2


def test_a_wall_in_the_second_of_two_phases():
    """Its first interval is left out, since states may jump at a switch."""
    x, y = states("x y")
    u, w = controls("u w")
    common = {"dynamics": {x: u, y: w}, "cost": u**2 + w**2, "duration": 1}
    module = of_problem(
        Phases(
            Control(**common, start={x: -1, y: 0}),
            Control(**common, end={x: 1, y: 0}, path=[(x / 0.01) ** 2 + y**2 >= 1]),
        )
    )
    x_of_nodes = np.array([-1.0, -0.5, 0.5, 1.0, -1.0, -0.6, -0.2, 0.2, 1.0])  # four intervals each
    grid = module.make_grid(4)
    unknowns = module.initial_guess(grid)
    module.views(grid, unknowns)[0][0, :, :2] = np.column_stack([x_of_nodes, np.zeros(9)])
    (worst,) = excursions(module, unknowns, 4, None)
    assert worst.violation == pytest.approx(1.0)
    assert worst.time == pytest.approx(1.625)


def test_times_of_a_delayed_motion_are_those_of_the_whole():
    """The motion is solved as two segments, and the wall stands in the second half."""
    x, y = states("x y")
    u, w = controls("u w")
    module = of_problem(
        Control(
            dynamics={x: u - x.delayed(0.5) / 100, y: w}, cost=u**2 + w**2, duration=1, start={x: -2, y: 0},
            end={x: 1, y: 0}, history={x: -2}, path=[(x / 0.01) ** 2 + y**2 >= 1], steps=12,
        )
    )  # fmt: skip
    result = solve(module)
    assert result.solved
    (note,) = result.notes
    assert "violates 10000.0*x**2 + y**2 >= 1 by 1 at t = 0.6" in note


@pytest.mark.parametrize("name", ["convoy", "spherical_pendulum"])
def test_the_gallery_is_far_below_the_limit(interpreted, name):
    module = interpreted(name)
    result = solve(module)
    assert result.solved
    assert sampled_conditions(module)
    assert all(one.relative < GROSS / 10 for one in excursions(module, result.unknowns, result.steps, None))
    assert result.notes == ()
