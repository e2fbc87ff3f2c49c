"""Kernels whose intermediate code is written from their text compute, to the last bit, what numba makes of them."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from codegen.loading import load
from codegen.machine_code.straight_lines import is_straight_line, write_directly

GENERATED = Path(__file__).parents[2] / "generated"
KERNELS = ("interval_gradient", "interval_hessian", "start_gradient", "end_gradient")


def compiled(py_func, directly: Path | None = None):
    function = njit(error_model="numpy")(py_func)
    if directly is not None:
        assert write_directly([function], directly) == [py_func.__name__]
    return function


@pytest.mark.parametrize("name", ["hovercraft", "orbital_transfer", "goddard_rocket", "betts_10_7"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels_are_the_same_to_the_last_bit(name, kernel):
    path = GENERATED / f"{name}.py"
    module = load(path)
    grid, random = module.make_grid(4), np.random.default_rng(5)
    unknowns, parameters = random.uniform(0.5, 1.5, module.ELEMENT + module.SHARED), grid.parameters[0]
    times = (0.3, 0.25) if kernel.startswith("interval") else (0.3,)
    py_func, results = getattr(module, kernel).py_func, []
    for directly in (None, path):
        found = np.full(module.HESSIAN_ROWS.size + unknowns.size, 0.5)
        cost = compiled(py_func, directly)(unknowns, *times, parameters, found)
        results.append([cost, *found])
    assert np.array_equal(*results)
    assert np.isfinite(results[0][1:]).all()


TEXT = '''
import math

def lines(x, h, values):
    """What all of it is called."""
    a = x[0]**2 - 3*x[1]**-3 + h**1.5
    b = -a/h + math.sin(a)*math.hypot(a, 2) - x[1]**0
    a = 2**3*b/7
    values[0] += a*b
    values[1] = 1
    return 2
'''


def module_of(text: str, tmp_path: Path):
    path = tmp_path / "lines.py"
    path.write_text(text)
    space: dict = {"__name__": "lines", "math": math}
    exec(compile(text, str(path), "exec"), space)
    return path, space["lines"]


def test_all_that_a_line_may_hold(tmp_path):
    path, lines = module_of(TEXT, tmp_path)
    results = []
    for function in (lines, compiled(lines), compiled(lines, path)):
        x, values = np.array([1.25, 0.75]), np.array([0.5, 0.25])
        results.append([function(x, 0.1, values), *values])
    assert results[1] == results[2] == pytest.approx(results[0], rel=1e-14)


def test_other_arrays_are_left_to_numba(tmp_path):
    path, lines = module_of(TEXT, tmp_path)
    function = compiled(lines, path)
    near, far = np.zeros(2), np.zeros(4)
    function(np.array([1.25, 0.75]), 0.1, near)
    function(np.array([1.25, 7.0, 0.75, 7.0])[::2], 0.1, far[::2])
    assert far[::2].tolist() == near.tolist()
    assert [len(kinds) for kinds in function.signatures] == [3, 3]


def test_long_sums_are_left_to_numba_when_they_are_too_long(tmp_path):
    for count, names in ((300, ["lines"]), (900, [])):
        path, lines = module_of(f"def lines(x):\n    return {' + '.join(['x'] * count)}\n", tmp_path)
        function = njit(lines)
        assert write_directly([function], path) == names
        assert function(0.5) == count / 2


@pytest.mark.parametrize(
    "line",
    [
        "y = 1 if x > 0 else 2",
        "y = z",
        "y = x**h",
        "y = x**65",
        "y = x[h]",
        "y = x[-1]",
        "z[0] = y",
        "y = x[0, 1]",
        "y = x // 2",
        "y = abs(x)",
        "y = math.floor(x)",
        "y = math.exp(x=1)",
        "y = x[0] = 1",
        "y, z = 1, 2",
        "y += 1",
        "y = True",
        "y = +x",
        "return",
        "return y\n    y = 2",
        "for i in range(3):\n        y = i",
        "x.size = 3",
    ],
)
def test_whatever_else_there_is_stays_with_numba(line):
    (node,) = ast.parse(f"def lines(x, h):\n    y = 1\n    {line}\n").body
    assert isinstance(node, ast.FunctionDef)
    assert not is_straight_line(node)


def test_kernels_of_all_problems_are_straight_lines():
    """But for those of several phases, which choose between the phases' own."""
    for path in sorted(GENERATED.glob("*.py")):
        for node in ast.parse(path.read_bytes()).body:
            if isinstance(node, ast.FunctionDef) and node.name in KERNELS and "phase" not in ast.unparse(node):
                assert is_straight_line(node), f"{path.stem}: {node.name}"
