"""The yardstick itself: the dense assembly reproduces costs that other programs found."""

import numpy as np
import pytest
from conftest import PROBLEMS
from dense_assembly import DenseProblem

from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.transcribe import transcribe


def test_dense_assembly_reproduces_the_linear_pendulum():
    dense = DenseProblem(transcribe(load_problem(PROBLEMS / "linear_pendulum.py")), 10)
    z = dense.newton(dense.initial())
    assert dense.cost(z) == pytest.approx(4.546929903, rel=1e-9)
    assert dense.program_cost(z) == pytest.approx(dense.cost(z), rel=1e-12)


def test_gradient_and_hessian_are_those_of_the_lagrangian():
    dense = DenseProblem(transcribe(load_problem(PROBLEMS / "orbital_transfer.py"), method="hamiltonian"), 2)
    rng = np.random.default_rng(1)
    z = dense.initial() + 0.1 * rng.standard_normal(dense.expand.shape[1])
    step = 1e-5 * rng.standard_normal(len(z))
    slope = (dense.lagrangian(z + step) - dense.lagrangian(z - step)) / 2
    assert dense.gradient(z) @ step == pytest.approx(slope, rel=1e-6)
    turn = (dense.gradient(z + step) - dense.gradient(z - step)) / 2
    assert dense.hessian(z) @ step == pytest.approx(turn, rel=1e-5, abs=1e-9)
