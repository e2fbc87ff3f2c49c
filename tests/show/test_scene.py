"""A drawing's numbers along a motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sympy
from conftest import PROBLEMS
from drawn_oscillator import oscillator
from scipy.spatial.transform import Rotation
from sympy import cos, pi, sin

from codegen import Control, body_number, control, coordinates, free_parameter, time
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import load_problem, normalise
from codegen.drawing import Arrow, Circle, Mass, Rod, Trail
from codegen.problem.symbols import recorded_declarations
from codegen.show.films import fine_times, scene
from codegen.solving.results.result import Result

DRAWN = (
    "acrobot brachistochrone cart_pendulum cart_pole chain chaplygin_sleigh convoy crane double_pendulum_cartesian "
    "drone_in_space dzhanibekov four_bar heavy_top hopper hovercraft linear_pendulum low_thrust n_link_pendulum "
    "newton_cradle orbital_transfer pendulum pendulum_swing_up point_vortices pushed_block quadrotor resting_ball "
    "rolling_disc shove snakeboard spherical_pendulum two_link_arm"
).split()


def motion(model: Model, t: Any, q: Any, u: Any, **summary: float) -> Any:
    """What `scene` reads of a result; columns of several bodies stand side by side."""
    given = {"t": np.array(t, float), "q": np.array(q, float), "u": np.array(u, float), "summary": summary}
    empty = dict.fromkeys(("problem", "title", "task", "method", "scheme", "driver", "status", "message"), "")
    return Result(**empty, steps=1, residual=0.0, iterations=0, p=given["q"], names={}, **given)


def test_points_in_space_are_seen_from_above_the_ground():
    """An orthographic view from the azimuth -60 and the elevation 20 degrees, as by scipy."""
    turned = Rotation.from_euler("zx", [-30, -70], degrees=True)
    for point in np.eye(3):
        seen = np.array(Trail(tuple(point)).point, dtype=float)
        np.testing.assert_allclose(seen, turned.apply(point)[:2], atol=1e-12)


def test_one_body():
    model = oscillator(lambda q, dq, u, k: [Rod((0, 0), (sin(q), -cos(q))), Arrow((q, k), (u, 0)), Mass((1, 2), k)])
    found = scene(model, motion(model, [0, 1, 2], [[0], [pi / 2], [pi]], [[5], [7]]))
    rod, arrow, mass = found.items
    np.testing.assert_array_equal(found.t, [0, 1, 2])
    np.testing.assert_allclose(rod.end[0], [[0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(rod.end[1], [[-1, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(rod.start[0], [[0, 0, 0]])
    # The control of an interval holds from its left node on; the last node has that of the last interval.
    np.testing.assert_array_equal(arrow.vector[0], [[5, 7, 7]])
    assert mass.radius.tolist() == [[3.0]]


def test_between_nodes():
    model = oscillator(lambda q, dq, u, k: [Arrow((q, 0), (u, 0))])
    found = scene(model, motion(model, [0, 1, 2], [[0], [2], [6]], [[5], [7]]), np.array([0.5, 1.75]))
    np.testing.assert_allclose(found.items[0].start[0], [[1, 5]])
    np.testing.assert_allclose(found.items[0].vector[0], [[5, 7]])


def test_controls_at_nodes_are_interpolated():
    model = oscillator(lambda q, dq, u, k: [Arrow((q, 0), (u, 0))])
    found = scene(model, motion(model, [0, 2], [[0], [2]], [[5], [7]]), np.array([0.5]))
    np.testing.assert_allclose(found.items[0].vector[0], [[5.5]])


def test_several_bodies():
    with recorded_declarations() as declared:
        (x, y), (dx, dy) = coordinates("x y")
        f, body = control("f"), body_number()
        problem = Control(
            lagrangian=(dx**2 + dy**2) / 2,
            force={x: f},
            cost=f**2,
            duration=1,
            bodies=2,
            drawing=[Trail((x, y)), Circle((body, 0), 1), Mass((0, 0), 1)],
        )
    model = normalise(problem, declared)
    # Columns: x and y of body 0, x and y of body 1.
    trail, circle, mass = scene(model, motion(model, [0, 1], [[1, 2, 3, 4], [5, 6, 7, 8]], [[0, 0]])).items
    np.testing.assert_array_equal(trail.point[0], [[1, 5], [3, 7]])
    np.testing.assert_array_equal(trail.point[1], [[2, 6], [4, 8]])
    np.testing.assert_array_equal(circle.centre[0], [[0], [1]])
    assert mass.radius.shape == (1, 1)


def test_time_and_free_parameters():
    T = free_parameter("T", 1)
    t = time()
    model = oscillator(lambda q, dq, u, k: [Trail((t, T))], duration=T)
    found = scene(model, motion(model, [0, 4], [[0], [1]], [[0]], T=4.0))
    np.testing.assert_array_equal(found.items[0].point, [[[0, 4]], [[4, 4]]])


def test_what_has_no_value_is_nan():
    model = oscillator(lambda q, dq, u, k: [Trail((sympy.sqrt(q), 1 / q))])
    x, y = scene(model, motion(model, [0, 1], [[-1], [0]], [[0]])).items[0].point
    assert np.isnan(x[0, 0])
    assert np.isinf(y[0, 1])


@pytest.mark.parametrize("name", DRAWN)
def test_gallery(name):
    """Every drawing of the gallery has finite numbers along a made-up motion."""
    model = load_problem(PROBLEMS / f"{name}.py")
    count, controls = len(model.coordinates) * model.bodies, len(model.controls) * model.bodies
    grid = np.linspace(0.0, 1.0, 5)
    q = np.array([[0.3 + 0.1 * i + 0.2 * t for i in range(count)] for t in grid])
    free = {f.symbol.name: 2.0 for f in model.free_parameters}
    found = scene(model, motion(model, grid, q, np.full((4, controls), 0.5), **free))
    assert len(found.items) == len(model.drawing) > 2
    for item in found.items:
        shapes = {array.shape for _, array in item.expressions()}
        assert len(shapes) == 1
        assert shapes < {(1, 1), (1, 5), (model.bodies, 5)} or shapes == {(model.bodies, 5)}
        assert all(np.isfinite(array).all() for _, array in item.expressions())
    assert any(array.shape[1] == 5 for item in found.items for _, array in item.expressions())


def test_fine_times_keep_the_nodes():
    t = np.array([0.0, 1.0, 3.0])
    fine = fine_times(t, least=8)
    np.testing.assert_allclose(fine, [0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3])
    np.testing.assert_array_equal(fine_times(t, least=1), t)
