"""The same problem from a file and as an object: the same module, the same cache, in any process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import PROBLEMS
from written_objects import object_of

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
