"""Measurements: fits beside closed forms and scipy's, by every method, other data at run time, experiments."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from measured_decay import NOISE, TIMES, VALUES, decay, interpreted, write, write_decay
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit, least_squares

import codegen
from codegen.errors import ArgumentError, NumericsError, TableError
from codegen.solving.compiler import build


@pytest.mark.parametrize(("loss", "scipys"), [("huber", "huber"), ("soft-l1", "soft_l1")])
def test_robust_losses_are_those_of_scipy(folder, loss, scipys):
    values = VALUES.copy()
    values[5] += 1.0
    path = write_decay(folder, f', sigma=0.03, loss="{loss}"', t=TIMES, z=values)
    result = codegen.solve(interpreted(path, scheme="gauss-4"))
    assert result.status == "solved", result.message
    best = least_squares(
        lambda x: (decay(TIMES, *x) - values) / 0.03, [1, 1], loss=scipys, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert result.estimates.values == pytest.approx(best.x, rel=1e-6)
    assert result.cost == pytest.approx(2.0 * best.cost, rel=1e-6)
    plain, _ = curve_fit(decay, TIMES, VALUES, [1, 1])
    assert np.abs(result.estimates.values - plain).max() < 0.05  # where least squares would be off by 0.2
    assert np.isfinite(result.estimates.standard_errors).all()


def test_empty_cells_and_the_order_of_rows_mean_nothing(folder):
    reference = codegen.solve(interpreted(write_decay(folder)))
    gaps = np.insert(VALUES, 3, np.nan)[::-1]
    path = write_decay(folder, t=np.insert(TIMES, 3, 1.2345)[::-1], z=gaps)
    result = codegen.solve(interpreted(path))
    assert result.cost == pytest.approx(reference.cost, rel=1e-12)
    assert result.estimates.standard_errors == pytest.approx(reference.estimates.standard_errors, rel=1e-9)
    assert result.estimates.freedom == reference.estimates.freedom == 9


def test_other_measurements_need_no_build(folder):
    module = interpreted(write_decay(folder, t=np.array([1.0, 2.0]), z=np.array([5.0, 4.0])))
    reference = codegen.solve(interpreted(write_decay(folder)))
    columns = codegen.solve(module, observations={"t": TIMES, "z": VALUES})
    file = write(folder, "other.csv", z=VALUES, t=TIMES)
    for result in (columns, codegen.solve(module, observations=file)):
        assert result.cost == pytest.approx(reference.cost, rel=1e-12)
        assert result.estimates.standard_errors == pytest.approx(reference.estimates.standard_errors, rel=1e-9)
    rows = np.column_stack([TIMES, VALUES, np.ones(TIMES.size)])
    assert module.solve(observations=rows).cost == pytest.approx(reference.cost, rel=1e-12)


def test_what_does_not_replace_measurements_is_refused(folder):
    module = interpreted(write_decay(folder))
    for given, error, fragment in (
        ("none.csv", TableError, "none.csv: no such file"),
        ({"t": TIMES}, TableError, "lack 'z'"),
        ({"t": TIMES, "z": VALUES[1:]}, TableError, "has shape"),
        ({"t": TIMES, "z": VALUES * np.inf}, TableError, "give finite numbers"),
        ({"t": TIMES, "z": ["a"] * TIMES.size}, TableError, "holds what is no number"),
        ({"t": 2 * TIMES, "z": VALUES}, NumericsError, "observations are from t = 0 to 6, the motion from 0 to 3"),
        ([{"t": TIMES, "z": VALUES}] * 2, ArgumentError, "2 sets of measurements, and there are 1 bodies"),
        (3, ArgumentError, "give a file"),
    ):
        with pytest.raises(error, match=fragment):
            codegen.solve(module, observations=given)
    rows = np.column_stack([TIMES, VALUES, np.ones(TIMES.size)])
    for given, fragment in (
        (rows[:, :2], "have shape"),
        (rows[:0], "have shape"),
        (rows * [1, np.inf, 1], "finite"),
        (rows * [1, 1, 0], "positive"),
        ((rows, rows), "observations of 2 bodies, and 1 move"),
    ):
        with pytest.raises(ValueError, match=fragment):
            module.make_grid(5, observations=given)
    with pytest.raises(ArgumentError, match="the problem has no measurements"):
        codegen.solve(Path(__file__).parents[2] / "problems" / "van_der_pol.py", observations="other.csv")


def test_samples_on_intervals_of_different_lengths(folder):
    module = interpreted(write_decay(folder), scheme="gauss-4")
    equal, lengths = module.solve(40), np.linspace(0.4, 1.6, 40)
    unequal = module.solve(grid=lengths / lengths.sum())
    assert unequal.cost == pytest.approx(equal.cost, rel=1e-6)
    assert unequal.status == equal.status == "solved"


_SMOOTHED = '''"""A curve that is close to measurements, and not steep."""

from codegen import Control, Measurements, control, states


def problem() -> Control:
    (x,) = states("x")
    u = control("u")
    return Control(
        dynamics={x: u}, cost=u**2, observations=Measurements("m.csv", values={x: "z"}), duration=1, steps=20
    )
'''


def test_smoothing_is_one_linear_system(folder):
    t, z = np.array([0.0, 0.2, 0.35, 0.6, 0.95]), np.array([1.0, 0.3, 0.8, -0.5, 0.2])
    write(folder, "m.csv", t=t, z=z)
    (folder / "smoothed.py").write_text(_SMOOTHED)
    result = codegen.solve(interpreted(folder / "smoothed.py"))
    assert result.status == "solved", result.message
    assert result.iterations == 1
    # Between samples the best curve is straight: a spline of degree one.
    matrix = np.eye(t.size)
    for i, length in enumerate(np.diff(t)):
        matrix[i : i + 2, i : i + 2] += np.array([[1, -1], [-1, 1]]) / length
    x = np.linalg.solve(matrix, z)
    assert np.interp(t, result.t, result.q[:, 0]) == pytest.approx(x, abs=1e-10)
    assert result.cost == pytest.approx(((x - z) ** 2).sum() + (np.diff(x) ** 2 / np.diff(t)).sum(), rel=1e-10)
    assert result.estimates is None


_OSCILLATOR = '''"""A mass on a spring, of which the distance and the energy were measured."""

from codegen import Control, Measurements, coordinate, free_parameter, parameter


def problem() -> Control:
    q, dq = coordinate("q")
    s, m = free_parameter("s", 2), parameter("m", 1)
    return Control(
        lagrangian=m * dq**2 / 2 - s * q**2 / 2,
        observations=Measurements("m.csv", values={q: "z", m * dq + q: "w"}),
        duration=2,
        start={q: 1, dq: 0},
        steps=60,
    )
'''


@pytest.mark.parametrize(
    ("choices", "error"),
    [
        ({"method": "variational"}, 5e-3),  # of straight lines, whose velocity is of order one
        ({"method": "variational", "scheme": "gauss-4"}, 2e-4),
        ({"method": "hamiltonian"}, 2e-3),
        ({"method": "hamiltonian", "scheme": "gauss-4"}, 1e-6),
    ],
    ids=str,
)
def test_stiffness_of_a_spring_by_every_method(folder, choices, error):
    t = np.linspace(0.013, 1.99, 12)
    write(folder, "m.csv", t=t, z=np.cos(1.5 * t), w=np.cos(1.5 * t) - 1.5 * np.sin(1.5 * t))
    (folder / "spring.py").write_text(_OSCILLATOR)
    result = codegen.solve(interpreted(folder / "spring.py", **choices))
    assert result.status == "solved", result.message
    assert result.summary["s"] == pytest.approx(2.25, rel=error)


_EXPERIMENTS = '''"""Two decays that begin with different amounts and are equally fast."""

from codegen import Control, Measurements, each_body, free_parameter, states


def problem() -> Control:
    (x,) = states("x")
    k = free_parameter("k", 1)
    return Control(
        dynamics={x: -k * x},
        observations=[Measurements(f"{name}.csv", values={x: "z"}) for name in ("first", "second")],
        duration=3,
        start={x: each_body(1, 2)},
        bodies=2,
        steps=30,
    )
'''


def test_experiments_share_parameters(folder):
    t_1, t_2 = TIMES, np.array([0.4, 1.7])
    z_1, z_2 = np.exp(-0.7 * t_1) + NOISE, 2 * np.exp(-0.9 * t_2)
    write(folder, "first.csv", t=t_1, z=z_1)
    write(folder, "second.csv", t=t_2, z=z_2)
    (folder / "decays.py").write_text(_EXPERIMENTS)
    module = interpreted(folder / "decays.py", scheme="gauss-4")
    result = codegen.solve(module)
    assert result.status == "solved", result.message
    both = np.concatenate([np.zeros(t_1.size), np.ones(2)]), np.concatenate([t_1, t_2]), np.concatenate([z_1, z_2])

    def motion(where, k):
        return (1 + where[0]) * np.exp(-k * where[1])

    best, covariance = curve_fit(motion, both[:2], both[2], [1], xtol=1e-14, ftol=1e-14)
    assert result.summary["k"] == pytest.approx(best[0], rel=1e-6)
    assert result.estimates.standard_errors[0] == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.05)
    swapped = [{"t": t_2, "z": z_2 / 2}, {"t": t_1, "z": 2 * z_1}]
    other = codegen.solve(module, observations=swapped)
    best, _ = curve_fit(motion, (1 - both[0], both[1]), np.concatenate([2 * z_1, z_2 / 2]), [1])
    assert other.summary["k"] == pytest.approx(best[0], rel=1e-6)


def test_coordinates_start_where_they_were_measured(folder):
    gaps = np.where(np.arange(TIMES.size) == 4, np.nan, VALUES)
    module = interpreted(write_decay(folder, t=TIMES, z=gaps), scheme="hermite-simpson")
    grid = module.make_grid(12)
    _, q, *_ = module.unpack(grid, module.initial_guess(grid))
    known = ~np.isnan(gaps)
    at = np.unique(TIMES[known])
    expected = np.interp(np.linspace(0, 3, 13), at, [gaps[known & (t == TIMES)].mean() for t in at])
    assert q[:, 0] == pytest.approx(expected, rel=1e-12)
    guessed = write_decay(folder).read_text().replace("steps=30", "guess={x: 5}, steps=30")
    (folder / "decay.py").write_text(guessed)
    module = interpreted(folder / "decay.py")
    grid = module.make_grid(12)
    assert (module.unpack(grid, module.initial_guess(grid))[1] == 5.0).all(), "authors know better"


def test_what_is_affine_in_a_coordinate_starts_where_it_was_measured(folder):
    """The column has 2 + 3 k x; the guess of k is 1."""
    text = write_decay(folder).read_text()
    (folder / "decay.py").write_text(text.replace('{x: "z"}', '{2 + 3 * k * x: "z"}'))
    module = interpreted(folder / "decay.py")
    grid = module.make_grid(12)
    _, q, *_ = module.unpack(grid, module.initial_guess(grid))
    at = np.unique(TIMES)
    means = np.interp(np.linspace(0, 3, 13), at, [VALUES[t == TIMES].mean() for t in at])
    assert q[:, 0] == pytest.approx((means - 2) / 3, rel=1e-12)


def test_a_unit_vector_is_fitted_to_the_positions_of_a_bob(folder):
    """The positions are l n with the unknown length l; from zero, no direction of the vector would be known."""
    times, length = np.linspace(0, 4, 81), 0.9

    def field(_, state):
        place, speed = state[:3], state[3:]
        force = np.array([0, 0, -9.81 / length])
        return np.concatenate([speed, force - (force @ place + speed @ speed) * place])

    motion = solve_ivp(field, (0, 4), [0.6, 0, -0.8, 0, 1.5, 0], "DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y[:3]
    write(folder, "bob.csv", t=times, x=length * motion[0], y=length * motion[1], z=length * motion[2])
    n, dn = codegen.direction("n")
    size = codegen.free_parameter("l", 1, lower=0.1)
    values = {size * n[0]: "x", size * n[1]: "y", size * n[2]: "z"}
    problem = codegen.Control(
        lagrangian=size**2 * dn.dot(dn) / 2 - 9.81 * size * n[2],
        observations=codegen.Measurements(folder / "bob.csv", values=values),
        duration=4,
        steps=160,
    )
    result = codegen.solve(problem)
    assert result.status == "solved"
    assert result.summary["l"] == pytest.approx(length, rel=2e-3)  # the error of the scheme
    assert result["n"] == pytest.approx(result.q, abs=0)


def test_what_is_called_like_a_stage_does_not_start_like_one(folder):
    """y_1 is the multiplier of the first path condition, and not y at some stage."""
    text = write_decay(folder).read_text()
    for old, new in (("(x,)", "(y,)"), ('"x"', '"y"'), ("x:", "y:"), ("k * x", "k * y")):
        text = text.replace(old, new)
    (folder / "decay.py").write_text(text.replace("steps=30", "path=[y <= 9], scale={y: 7}, steps=30"))
    module = interpreted(folder / "decay.py", scheme="hermite-simpson")
    assert "y_1" in module.metadata.interval
    assert module.metadata.scale == {"y": 7.0}
    assert module.metadata.stages["y_stage2"] == "y"
    assert "y_1" not in module.metadata.stages
    grid = module.make_grid(12)
    assert not module.initial_guess(grid)[np.asarray(grid.is_multiplier)].any()


def test_predators_are_not_fitted_by_another_optimum():
    """From straight lines this ended at 6.67, 240 times the least."""
    path = Path(__file__).parents[2] / "problems" / "published" / "predator_prey.py"
    solution = interpreted(path, scheme="hermite-simpson").solve(200)
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(0.02753637162, rel=1e-9)  # IPOPT 3.14 on the same program
    assert solution.iterations <= 12


_LORENZ = '''"""Fit the rates of a Lorenz system."""

from codegen import Control, Measurements, free_parameter, states


def problem() -> Control:
    x, y, z = states("x y z")
    s, r, b = free_parameter("s", 8), free_parameter("r", 24), free_parameter("b", 2)
    return Control(
        dynamics={x: s * (y - x), y: x * (r - z) - y, z: x * y - b * z},
        observations=Measurements("lorenz.csv", values={x: "x", y: "y", z: "z"}),
        duration=4,
        steps=80,
    )
'''


def test_a_chaotic_motion_is_fitted(folder):
    """Rates are found to within their standard errors from guesses with which the motion would soon be another."""
    times = np.linspace(0, 4, 81)

    def rates(t, q):
        return [10 * (q[1] - q[0]), q[0] * (28 - q[2]) - q[1], q[0] * q[1] - 8 / 3 * q[2]]

    motion = solve_ivp(rates, (0, 4), [-8, 7, 27], t_eval=times, rtol=1e-10, atol=1e-10).y
    x, y, z = motion + 0.2 * np.random.default_rng(2).standard_normal(motion.shape)
    write(folder, "lorenz.csv", t=times, x=x, y=y, z=z)
    (folder / "lorenz.py").write_text(_LORENZ)
    result = codegen.solve(interpreted(folder / "lorenz.py", scheme="gauss-4"))
    assert result.status == "solved", result.message
    assert result.iterations <= 10
    errors = np.abs(result.estimates.values - [10, 28, 8 / 3]) / result.estimates.standard_errors
    assert errors.max() < 3.0


def test_published_optimum_of_gas_oil():
    path = Path(__file__).parents[2] / "problems" / "published" / "gas_oil.py"
    result = codegen.solve(interpreted(path, scheme="hermite-simpson"), steps=152)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(5.23659e-3, rel=1e-5)  # COPS 3.0


def test_accuracy_on_request(folder):
    result = codegen.solve(interpreted(write_decay(folder), scheme="gauss-4"), accuracy=1e-6)
    assert result.status == "solved", result.message
    best, _ = curve_fit(decay, TIMES, VALUES, [1, 1], xtol=1e-14, ftol=1e-14)
    assert result.cost == pytest.approx(((decay(TIMES, *best) - VALUES) ** 2).sum(), rel=3e-6)
    assert result.estimates.values == pytest.approx(best, rel=3e-6)


def test_the_command_takes_other_measurements(folder, uncompiled):
    from typer.testing import CliRunner

    from codegen.cli import main

    path = write_decay(folder, t=np.array([1.0, 2.0]), z=np.array([5.0, 4.0]))
    other = write(folder, "other.csv", t=TIMES, z=VALUES)
    shown = CliRunner().invoke(main, ["solve", str(path), "--observations", str(other), "--json"])
    assert shown.exit_code == 0, shown.output
    record = json.loads(shown.stdout)
    best, _ = curve_fit(decay, TIMES, VALUES, [1, 1])
    assert record["estimates"]["parameters"]["k"]["value"] == pytest.approx(best[0], rel=5e-3)
    picture = folder / "decay.png"
    shown = CliRunner().invoke(main, ["solve", str(path), "--observations", str(other), "--plot", str(picture)])
    assert "standard error" in shown.stdout
    assert picture.stat().st_size > 10_000
    other.write_text("t,z\n0,1\n2,x\n")
    shown = CliRunner().invoke(main, ["solve", str(path), "--observations", str(other)])
    assert shown.exit_code == 2
    assert "other.csv:3: z is 'x'" in shown.stderr


def test_tables_beside_measurements(folder):
    reference = codegen.solve(interpreted(write_decay(folder), scheme="gauss-4"))
    x = np.linspace(-1, 4, 6)
    write(folder, "rate.csv", x=x, f=x)
    text = write_decay(folder).read_text().replace("Measurements, free", "Measurements, Table, free")
    (folder / "decay.py").write_text(text.replace("-k * x", '-k * Table("rate.csv", "x", "f")(x)'))
    result = codegen.solve(interpreted(folder / "decay.py", scheme="gauss-4"))
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(reference.cost, rel=1e-10)
    assert result.estimates.standard_errors == pytest.approx(reference.estimates.standard_errors, rel=1e-8)


def test_another_driver_fits_the_same(folder):
    module = interpreted(write_decay(folder), scheme="hermite-simpson")
    reference, result = codegen.solve(module, steps=6), codegen.solve(module, "slsqp", steps=6)
    assert result.status == "solved", result.message
    assert result.estimates.values == pytest.approx(reference.estimates.values, rel=1e-4)
    assert result.estimates.standard_errors == pytest.approx(reference.estimates.standard_errors, rel=1e-3)


def test_changed_measurements_are_seen_by_the_next_build(folder):
    path = write_decay(folder)
    first = build(path).path
    write_decay(folder, t=TIMES, z=2 * VALUES)
    changed = build(path).path
    assert changed != first
    digest = hashlib.sha256((folder / "decay.csv").read_bytes()).hexdigest()
    assert f"# Reads decay.csv, sha256 {digest}\n" in changed.read_text()
