"""What is said of free parameters that were fitted: beside scipy's covariances, and exact Hessians in closed form."""

from __future__ import annotations

import json

import numpy as np
import pytest
from measured_decay import DECAY, TIMES, VALUES, decay, interpreted, write_decay
from scipy.optimize import curve_fit

import codegen


def exact_hessian(k: float, x_0: float, sigma: float = 1.0) -> np.ndarray:
    """The Hessian by (k, x_0) of the sum of squares, in closed form."""
    e = np.exp(-k * TIMES)
    slopes = np.stack([-TIMES * x_0 * e, e])
    curved = np.array([[TIMES**2 * x_0 * e, -TIMES * e], [-TIMES * e, 0 * e]])
    errors = x_0 * e - VALUES
    return 2.0 * (slopes @ slopes.T + curved @ errors) / sigma**2


@pytest.mark.parametrize(
    ("scheme", "error"),
    [
        ("midpoint", 5e-3),
        ("trapezoidal", 2e-3),
        ("hermite-simpson", 2e-7),
        pytest.param("gauss-6", 1e-9, marks=pytest.mark.slow),
    ],
)
def test_decay_is_fitted_as_by_scipy(folder, scheme, error):
    module = interpreted(write_decay(folder), scheme=scheme)
    result = codegen.solve(module)
    assert result.status == "solved", result.message
    best, covariance = curve_fit(decay, TIMES, VALUES, [1, 1], xtol=1e-14, ftol=1e-14)
    found = result.estimates
    assert found.names == ("k", "x_0")
    assert found.values == pytest.approx(best, rel=error)
    assert result.cost == pytest.approx(((decay(TIMES, *best) - VALUES) ** 2).sum(), rel=10 * error)
    # scipy linearises the motion in its parameters.
    assert found.gauss_newton_errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=max(10 * error, 1e-6))
    assert found.standard_errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.05)
    squares = ((decay(TIMES, *best) - VALUES) ** 2).sum()
    exact = 2.0 * squares / (TIMES.size - 2) * np.linalg.inv(exact_hessian(*best))
    assert found.standard_errors == pytest.approx(np.sqrt(np.diag(exact)), rel=10 * error)
    correlation = exact[0, 1] / np.sqrt(exact[0, 0] * exact[1, 1])
    assert found.correlations == pytest.approx(np.array([[1, correlation], [correlation, 1]]), abs=10 * error)
    assert found.deviation == pytest.approx(np.sqrt(squares / (TIMES.size - 2)), rel=10 * error)
    # The motion follows the parameters.
    slopes = np.stack([-result.t * best[1] * np.exp(-best[0] * result.t), np.exp(-best[0] * result.t)])
    motion = found.unknown_errors[: 31 * module.problem.structure.stride : module.problem.structure.stride]
    assert motion == pytest.approx(np.sqrt(np.einsum("it,ij,jt->t", slopes, exact, slopes)), rel=30 * error)
    # Student's distribution with nine degrees of freedom: 2.262157 in every table.
    half = 2.262157 * found.standard_errors
    assert found.intervals == pytest.approx(np.column_stack([found.values - half, found.values + half]), rel=1e-6)


def test_given_deviations_are_not_estimated(folder):
    path = write_decay(folder, ", sigma=0.05")
    result = codegen.solve(interpreted(path, scheme="gauss-4"))
    best, _ = curve_fit(decay, TIMES, VALUES, [1, 1], xtol=1e-14, ftol=1e-14)
    exact = 2.0 * np.linalg.inv(exact_hessian(*best, sigma=0.05))
    assert result.estimates.values == pytest.approx(best, rel=1e-6)
    assert result.estimates.standard_errors == pytest.approx(np.sqrt(np.diag(exact)), rel=1e-5)
    half = 1.959964 * result.estimates.standard_errors
    assert result.estimates.intervals[:, 1] == pytest.approx(result.estimates.values + half, rel=1e-6)


def test_deviations_from_a_column_are_weights(folder):
    sigma = 0.02 + 0.01 * TIMES
    path = write_decay(folder, ', sigma={x: "s"}', t=TIMES, z=VALUES, s=sigma)
    result = codegen.solve(interpreted(path, scheme="gauss-4"))
    best, covariance = curve_fit(decay, TIMES, VALUES, [1, 1], sigma, True, xtol=1e-14, ftol=1e-14)
    assert result.estimates.values == pytest.approx(best, rel=1e-6)
    assert result.estimates.gauss_newton_errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-5)
    assert result.estimates.standard_errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.05)


def test_what_data_do_not_determine_is_named(folder):
    text = write_decay(folder).read_text()
    text = text.replace("-k * x", "-(k + l) * x").replace(" k, x_0 =", ' l = free_parameter("l", 0.5)\n    k, x_0 =')
    (folder / "decay.py").write_text(text)
    result = codegen.solve(interpreted(folder / "decay.py", scheme="gauss-4"))
    assert result.status == "solved", result.message
    assert result.estimates.names == ("l", "k", "x_0")
    assert result.estimates.undetermined == ("l", "k")
    assert result.notes[0].startswith("l, k are not determined by the measurements")
    best, covariance = curve_fit(decay, TIMES, VALUES, [1, 1], xtol=1e-14, ftol=1e-14)
    assert result.summary["k"] + result.summary["l"] == pytest.approx(best[0], rel=1e-6)
    assert np.isnan(result.estimates.standard_errors[:2]).all()
    # What is determined is as exact as without the superfluous parameter.
    assert result.estimates.standard_errors[2] == pytest.approx(np.sqrt(covariance[1, 1]), rel=0.05)
    assert result.estimates.freedom == 9
    (note,) = result.estimates.notes
    assert note.startswith("l, k are not determined by the measurements")


def test_a_parameter_at_its_bound_has_no_error(folder):
    write_decay(folder)
    (folder / "decay.py").write_text(DECAY.format(options="").replace("lower=0.01", "lower=0.9"))
    result = codegen.solve(interpreted(folder / "decay.py", scheme="gauss-4"))
    assert result.status == "solved", result.message
    found = result.estimates
    assert found.at_bounds == ("k",)
    assert np.isnan(found.standard_errors[0])
    e = np.exp(-0.9 * TIMES)
    assert found.values[1] == pytest.approx(VALUES @ e / (e @ e), rel=1e-6)
    assert found.standard_errors[1] == pytest.approx(found.deviation / np.sqrt(e @ e), rel=1e-5)
    assert found.freedom == 10


def test_too_few_values_are_said_to_be(folder):
    path = write_decay(folder, t=np.array([0.5, 2.0]), z=np.array([1.5, 0.5]))
    result = codegen.solve(interpreted(path, scheme="gauss-4"))
    assert result.status == "solved", result.message
    assert result.summary["k"] == pytest.approx(np.log(3.0) / 1.5, rel=1e-6)
    assert result.estimates.notes == ["no standard errors: 2 values were measured, and 2 numbers are free"]


def test_the_record_of_a_solve_has_estimates(folder):
    outcome = codegen.solve(interpreted(write_decay(folder)))
    from codegen.solving.results import output

    record = json.loads(output.as_json(output.as_record(outcome, 0.0, 0.0)))["estimates"]
    assert record["parameters"]["k"]["value"] == pytest.approx(outcome.summary["k"])
    assert len(record["parameters"]["k"]["interval"]) == 2
    assert record["correlations"][0][0] == pytest.approx(1.0)


def test_all_parameters_at_bounds_leave_nothing_to_say(folder):
    text = (
        write_decay(folder)
        .read_text()
        .replace("lower=0.01", "lower=0.95")
        .replace('("x_0", 1)', '("x_0", 1, upper=1.2)')
    )
    (folder / "decay.py").write_text(text)
    result = codegen.solve(interpreted(folder / "decay.py", scheme="gauss-4"), steps=10)
    assert result.status == "solved", result.message
    assert "x_0" in result.estimates.at_bounds
    assert np.isnan(result.estimates.standard_errors[1])


def test_an_exact_fit_has_no_errors(folder):
    path = write_decay(folder, t=TIMES, z=decay(TIMES, 0.0, 1.0))
    path.write_text(path.read_text().replace("-k * x", "-k").replace(", lower=0.01", ""))
    found = codegen.solve(interpreted(path)).estimates
    assert found.values == pytest.approx([0.0, 1.0], abs=1e-12)
    assert found.standard_errors == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.slow
def test_a_parameter_of_what_nobody_measured_is_not_determined(folder):
    text = (
        write_decay(folder)
        .read_text()
        .replace('(x,) = states("x")', 'x, y = states("x y")\n    m = free_parameter("m", 2)')
    )
    (folder / "decay.py").write_text(text.replace("x: -k * x", "x: -k * x, y: m * x").replace("x: x_0", "x: x_0, y: 0"))
    result = codegen.solve(interpreted(folder / "decay.py", scheme="gauss-4"))
    assert result.status == "solved", result.message
    assert result.estimates.undetermined == ("m",)
    best, covariance = curve_fit(decay, TIMES, VALUES, [1, 1], xtol=1e-14, ftol=1e-14)
    assert result.estimates.values[1:] == pytest.approx(best, rel=1e-6)
    assert result.estimates.standard_errors[1:] == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.05)
