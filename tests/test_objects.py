"""The same problem from a file and as an object: the same module, the same cache, in any process; compiled problems."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typed_use
from conftest import PROBLEMS
from written_objects import object_of

import codegen
from codegen.emit.naming import chosen
from codegen.solving.compiler import generate

CASES = {
    "a simulation": ("pendulum", {}, {}),
    "a simulation of a Lagrangian": ("pendulum", {"form": "lagrangian"}, {"scheme": "trapezoidal"}),
    "an optimum": ("orbital_transfer", {}, {}),
    "a Hamiltonian, with sensitivities": ("orbital_transfer", {}, {"method": "hamiltonian", "sensitivities": True}),
    "bodies": ("hovercraft", {}, {}),
    "phases": ("bouncing_ball", {}, {}),
    "delays": ("published/delayed_feedback", {}, {}),
    "measurements": ("published/gas_oil", {}, {}),
    "tables": ("published/time_to_climb", {}, {}),
    "bounds and a free duration": ("brachistochrone", {}, {}),
    "particles": ("image_registration", {}, {}),
    "particles that are simulated": ("lennard_jones", {}, {}),
    "several different bodies": ("convoy", {}, {}),
    "conditions at inner times": ("drone_gates", {}, {}),
    "a holonomic constraint": ("four_bar", {}, {}),
    "contact forces": ("shove", {}, {}),
    "rolling constraints": ("snakeboard", {}, {}),
    "a simulation with rolling constraints": ("rolling_disc", {}, {"scheme": "trapezoidal"}),
    "a simulation with holonomic constraints": ("double_pendulum_cartesian", {}, {"scheme": "trapezoidal"}),
    "a Lagrangian linear in the velocities": ("point_vortices", {"vortices": "two"}, {}),
}

BUILT = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from written_objects import object_of
from codegen.solving.compiler import build
made = build(object_of(Path(sys.argv[2])), scheme="stormer-verlet")
print(made.path, made.cached)
"""


def without_origin(text: str) -> str:
    """A module but for where it comes from: source, command and digest in its head, and the digest of the whole."""
    head, mark, rest = text.partition('\n"""')
    lines = [
        line
        for line in head.splitlines()
        if not line.startswith(("# Generated", "# Made", "# Inputs", "# Text", "# Reads"))
    ]
    rest = re.sub("inputs='[0-9a-f]{64}'", "", rest, count=1)
    return "\n".join(lines) + mark + rest


@pytest.mark.parametrize("case", CASES)
def test_modules_of_a_file_and_of_an_object_are_the_same_byte_by_byte(case):
    problem, arguments, options = CASES[case]
    file, choices = PROBLEMS / f"{problem}.py", chosen(**options)
    from_file, from_object = generate(file, arguments, choices), generate(object_of(file, **arguments), {}, choices)
    assert from_file != from_object
    assert without_origin(from_file) == without_origin(from_object)
    assert f"from {file.stem}, an object; do not edit" in from_object.splitlines()[0]


def test_the_cache_finds_an_object_again_in_processes_of_other_hash_seeds(tmp_path):
    found = []
    for seed in ("1", "2", "3"):
        words = [sys.executable, "-c", BUILT, str(Path(__file__).parent), str(PROBLEMS / "pendulum.py")]
        environment = {**os.environ, "PYTHONHASHSEED": seed, "CODEGEN_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(words, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout.split())
    (path, first), *others = found
    assert first == "False"
    assert others == [[path, "True"]] * 2
    assert Path(path).name == "pendulum_stormer_verlet.py"


PUSHED = '''"""Push a unit mass by one metre in one second, from rest to rest."""

from codegen import Control, control, states


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={{x: v, v: u}}, cost=u**2, duration=1, start={{x: 0, v: 0}}, end={{x: {distance}, v: 0}}, steps=10
    )
'''


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A compiled problem whose file has been edited since, its file, and the exact cost of the compiled problem."""
    file = tmp_path_factory.mktemp("edited") / "pushed.py"
    file.write_text(PUSHED.format(distance=1))
    solver = codegen.compile(file)
    file.write_text(PUSHED.format(distance=2))
    return solver, file, 12.0 / (1.0 - 1.0 / 100)  # with N controls that are constant on intervals: 12 / (1 - 1/N^2)


def test_a_compiled_problem_is_solved_as_it_was_compiled(pushed):
    """An edit of the file changes what is built from the file, and not the compiled problem."""
    solver, file, cost = pushed
    assert [solver.solve().cost for _ in range(2)] == pytest.approx([cost, cost], rel=1e-12)
    assert codegen.solve(file).cost == pytest.approx(4.0 * cost, rel=1e-12)


def test_sweeps_batches_and_controllers_take_a_problem_as_it_was_compiled(pushed):
    """The effort is inverse to the third power of the duration."""
    solver, _, cost = pushed
    durations = np.array([1.0, 2.0])
    assert codegen.solve_many(solver, {"duration": durations}).cost == pytest.approx(cost / durations**3, rel=1e-9)
    assert solver.sweep({"duration": durations}).cost.values == pytest.approx(cost / durations**3, rel=1e-9)
    assert solver.controller().step({"x": 0.0, "v": 0.0}) == pytest.approx(solver.solve().u[0], rel=1e-9)


def test_a_compiled_problem_can_be_pickled(pushed):
    solver, _, cost = pushed
    solver.solve()
    assert pickle.loads(pickle.dumps(solver)).solve().cost == pytest.approx(cost, rel=1e-12)


def test_a_compiled_problem_whose_module_was_removed_is_built_again(tmp_path):
    solver = codegen.compile(typed_use.double_integrator(), out=tmp_path)
    cost = solver.solve().cost
    solver.build.path.unlink()
    assert solver.solve().cost == cost
    assert solver.build.path.exists()
