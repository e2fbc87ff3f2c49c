"""What `codegen build` compiles: every function that `solve` calls, for the very types that it calls it with."""

import types
from pathlib import Path

import numpy as np
import pytest
import sympy
from golden import ROOT, text_of
from numba import typeof
from sympy import exp, log

from codegen import loading
from codegen.compiler import build
from codegen.lower.printer import stabilised
from codegen.machine_code.compilation import compile_all
from codegen.machine_code.parts import small_case
from codegen.registration.solver import arguments_of, problem_file
from codegen.tasks import task_of


def recorded(text: str, name: str) -> tuple[types.ModuleType, set[tuple[str, tuple[str, ...]]]]:
    """The module of a text, uncompiled, and the calls of functions that are compiled for Python, as they come in."""
    calls: set[tuple[str, tuple[str, ...]]] = set()
    depth = 0

    def njit(**options):
        def decorated(function):
            def called(*arguments):
                nonlocal depth
                if not depth:
                    calls.add((function.__name__, tuple(str(typeof(argument)) for argument in arguments)))
                depth += 1
                try:
                    with np.errstate(all="ignore"):
                        return function(*arguments)
                finally:
                    depth -= 1

            return called

        return decorated

    module = types.ModuleType(name)
    text = text.replace("from numba import config, njit", "from numba import config")
    module.__dict__["njit"] = njit
    exec(compile(text, f"<{name}>", "exec"), module.__dict__)
    return module, calls


@pytest.mark.parametrize(
    "name",
    [
        "hovercraft", "linear_pendulum", "bryson_denham", "double_integrator", "pendulum", "two_stage_rocket",
        "outer_solar_system_stormer_verlet",
    ],
)  # fmt: skip
def test_all_that_solve_calls_is_compiled_beforehand(name):
    module, calls = recorded(text_of(f"{name}.py"), name)
    compile_all(module)
    before = set(calls)
    calls.clear()
    module.solve(steps=4)
    assert calls
    assert calls <= before


@pytest.mark.parametrize("name", ["hovercraft", "linear_pendulum", "bryson_denham", "two_stage_rocket"])
def test_all_that_sensitivities_call_is_compiled_beforehand(name):
    text = build(ROOT / "problems" / f"{name}.py", sensitivities=True).path.read_text(encoding="utf-8")
    module, calls = recorded(text, name)
    compile_all(module)
    before = set(calls)
    grid, unknowns = module.make_grid(4), module.solve(steps=4).unknowns
    calls.clear()
    module.unpacked_rates(grid, unknowns, module.sensitivities(grid, unknowns), 0)
    assert {function for function, _ in calls} >= {"change_along", "add_steps"}
    assert calls <= before


@pytest.mark.parametrize("steps", [2, 4])
def test_all_that_a_registration_of_many_landmarks_calls_is_compiled_beforehand(steps):
    text = build(problem_file(), arguments_of(2), scheme="rk4").path.read_text(encoding="utf-8")
    module, calls = recorded(text, "image_registration")
    compile_all(module)
    before = set(calls)
    calls.clear()
    case = small_case(module, steps)
    solution = module.solve_case(case)
    stages = module.stages_of(case, np.stack([solution.q, solution.p], axis=1))
    for ends in ((0.0, 1.5), (1.5, 0.0)):
        for derivative in (False, True):
            module.carry(case, stages, case.start, *ends, derivative=derivative)
    module.Linearised(case, stages, None).product(np.ones(case.start.size))
    assert {function for function, _ in calls} >= {"broyden_steps", "carry_points", "tangents", "fill_curvature"}
    assert calls <= before


def test_products_with_second_derivatives_that_are_stored_do_not_compile_the_others(solver):
    case = small_case(solver)
    directions = np.eye(2 * case.start.size)
    solver.Linearised(case, np.zeros((2 * solver.POINTS, 2, *case.start.shape)), None).tangents(directions)
    files = (Path(solver.__file__).parent / "__pycache__").glob("*.nbi")
    kept = [file.name.split(".")[1].split("-")[0] for file in files]
    assert "symmetric_product" in kept
    assert "hessian_products" not in kept


def test_only_differences_of_exponentials_are_rewritten():
    x, y, z = sympy.symbols("x y z", real=True)
    expm1 = stabilised(exp(x) - 1)
    assert expm1.func.__name__ == "expm1"
    assert stabilised(y * exp(x) - y) == y * expm1
    assert stabilised(z + y * (exp(x) - 1)) == z + y * expm1
    assert stabilised(y * exp(x) + z) == y * exp(x) + z
    assert stabilised(log(1 + x)).func.__name__ == "log1p"


@pytest.mark.parametrize("choices", [{}, {"passive": "True"}], ids=["points alone", "points that are carried along"])
def test_what_a_registration_compiles_is_known_with_and_without_points_that_are_carried_along(choices, uncompiled):
    module = loading.load(build(ROOT / "problems" / "image_registration.py", choices).path)
    calls = task_of(module).parts(module)
    assert len(calls) >= 2
    assert all(map(callable, calls))
