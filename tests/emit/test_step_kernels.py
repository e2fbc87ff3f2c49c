"""Modules that simulate: Jacobians, and what their texts hold."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interpreted import without_compilation
from simulation_systems import ROOT, SYSTEMS, H, T, model_of, module_of, pendulum, text_of

from codegen import identifiers

# ---- Jacobians ----


def jacobian_error(module: Any, system: str) -> float:
    """Largest difference between the Jacobian of a step and central differences of its residual."""
    grid, state = module.make_grid(10, duration=10 * H), np.array(SYSTEMS[system].state)
    unknowns = module.predict(grid, state, T)
    matrix = module.jacobian(grid, unknowns, state, T)
    columns = []
    for i in range(unknowns.size):
        shift = np.zeros(unknowns.size)
        shift[i] = 1e-5
        change = module.residual(grid, unknowns + shift, state, T) - module.residual(grid, unknowns - shift, state, T)
        columns.append(change / 2e-5)
    return float(np.abs(matrix - np.transpose(columns)).max())


@pytest.mark.parametrize(("method", "scheme"), [("variational", "midpoint"), ("hamiltonian", "midpoint"),
                                                ("hamiltonian", "implicit-euler")])  # fmt: skip
@pytest.mark.parametrize("system", SYSTEMS)
def test_jacobians_are_the_derivatives_of_residuals(system: str, method: str, scheme: str) -> None:
    assert jacobian_error(module_of(system, method, scheme), system) < 1e-8


def test_a_corrupted_jacobian_is_noticed() -> None:
    text = text_of(model_of("pendulum-hamiltonian"), "midpoint", "hamiltonian")
    right = "jacobian[0] = 0.25*h**2*math.cos("
    assert text.count(right) == 1
    corrupted = without_compilation(text.replace(right, right.replace("0.25", "0.26")))
    assert jacobian_error(corrupted, "pendulum-hamiltonian") > 1e-5


# ---- The text itself ----


def test_names_of_the_module_are_marked() -> None:
    for module in (module_of("coupled", "variational", "midpoint"), module_of("kepler", "hamiltonian", "midpoint")):
        kernels = [getattr(module, name) for name in module.metadata.operations]
        for function in (module.solve, module.make_grid, module.initial_state, *kernels):
            code = inspect.unwrap(getattr(function, "function", function)).__code__
            own = {*module.metadata.parameters, "dict", "isinstance"}
            local = {n for n in (*code.co_varnames, *code.co_names) if not n.endswith(("_k", "_k1")) and n not in own}
            local -= {n for n in local if n.startswith(("x", "start_")) or n in ("t", "sin", "cos", "array", "values")}
            assert all(identifiers.marked(n, "simulate", (), moving=False) != n for n in local)


def test_text_does_not_depend_on_the_hash_seed() -> None:
    program = (
        "import hashlib, sys; sys.path[:0] = ['tests', '.']\n"
        "from simulation_systems import coupled, kepler, text_of\n"
        "for case in ((coupled(), 'midpoint', 'variational'), (kepler(), 'stormer-verlet', 'hamiltonian')):\n"
        "    print(hashlib.sha256(text_of(*case).encode()).hexdigest())\n"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", program],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("0", "1", "2")
    }
    assert len(outputs) == 1


def test_module_imports_the_runtime_alone_of_the_package(tmp_path: Path) -> None:
    file = tmp_path / "alone.py"
    file.write_text(text_of(pendulum(), "midpoint", "hamiltonian"), encoding="utf-8")
    check = (
        "import sys, alone; solution = alone.solve(100)\n"
        "assert (solution.status, solution.steps) == ('solved', 100), solution.message\n"
        "assert not {'sympy', 'jinja2'} & set(sys.modules)\n"
        "assert {name.split('.')[1] for name in sys.modules if name.startswith('codegen.')} == {'runtime'}"
    )
    subprocess.run([sys.executable, "-c", check], cwd=tmp_path, check=True)
