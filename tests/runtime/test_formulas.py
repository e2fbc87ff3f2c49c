"""Kernels of formulas: the translation has the numbers of numba's own, to the last bit."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest
from numba import njit

from codegen.runtime import formulas

KERNELS = '''"""Kernels of formulas, and others."""

import math

from numba import njit

from codegen.runtime.formulas import inner_kernel

FACTOR, COUNT = 1.5, 3


DECORATOR
def values(unknowns, t, parameters, filled):
    """Fill the array; return a number."""
    a = unknowns[0]
    b = unknowns[1]
    x0 = -a*b + (11/27)*t - 2**3
    x1 = x0**2 + FACTOR*parameters[0]**-3 - COUNT/b**4 + 1/(1 + a**2)**1.5
    filled[0] = x0*x1 - -7*a  # the first
    filled[1] += x1**5 + +b
    filled[2] -= 0.1*t
    FUNCTIONS
    return x0 - x1/3


@njit
def called(unknowns, t, parameters, filled):
    return values(unknowns, t, parameters, filled)


@inner_kernel
def looped(filled):
    for i in range(3):
        filled[i] = i


@inner_kernel
def documented(filled):
    """Fill nothing."""
'''


def module_of(folder, name, decorator):
    path = folder / f"{name}.py"
    functions = [f"filled[{3 + i}] = math.{f}(0.3 + x0/1e3)" for i, f in enumerate(formulas.OF_ONE) if f != "acosh"]
    path.write_text(KERNELS.replace("DECORATOR", decorator).replace("FUNCTIONS", "\n    ".join(functions)))
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    formulas.translate_formulas(vars(module))
    return module


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    folder = tmp_path_factory.mktemp("formulas")
    return module_of(folder, "fast", "@inner_kernel"), module_of(folder, "slow", '@njit(error_model="numpy")')


@pytest.mark.parametrize("seed", range(5))
def test_numbers_are_those_of_numba(modules, seed):
    random, results = np.random.default_rng(seed), []
    inputs = random.uniform(-2, 2, 2), random.uniform(0, 3), random.uniform(0.5, 2, 1), random.uniform(-1, 1, 30)
    for module in modules:
        filled = inputs[-1].copy()
        results.append([module.called(*inputs[:-1], filled), *filled])
    assert np.isfinite(results[0]).all()
    assert results[0] == results[1]
    a, b = inputs[0]
    x0 = -a * b + 11 / 27 * inputs[1] - 8
    assert results[0][4] == pytest.approx(math.sin(0.3 + x0 / 1e3), rel=1e-15)


def test_division_by_zero_gives_infinity(modules):
    filled = np.zeros(30)
    modules[0].called(np.array([1.0, 0.0]), 0.0, np.array([1.0]), filled)
    assert filled[0] == math.inf


def test_only_formulas_are_translated(modules):
    fast, _ = modules
    assert hasattr(fast.values, "caller")
    assert not hasattr(fast.looped, "caller")
    assert not hasattr(fast.documented, "caller")
    assert fast.values.py_func.__doc__ == "Fill the array; return a number."


def test_a_file_with_another_text_is_not_translated(tmp_path):
    """The text of the file has changed since Python read it, as with an edit during an import."""
    path = tmp_path / "edited.py"
    text = "def double(filled):\n    filled[0] = 2.0*filled[0]\n"
    path.write_text(text.replace("2.0", "3.0"))
    space: dict = {}
    exec(compile(text, str(path), "exec"), space)
    space["double"] = formulas.inner_kernel(space["double"])
    formulas.translate_formulas(space)
    double, filled = space["double"], np.ones(1)
    assert not hasattr(double, "caller")
    njit(lambda x: double(x))(filled)
    assert filled[0] == 2.0


def test_arguments_of_other_types_are_refused(modules):
    with pytest.raises(Exception, match="expected an array of float64 or a number"):
        modules[0].called(np.zeros(2, dtype=int), 0.0, np.ones(1), np.zeros(30))
