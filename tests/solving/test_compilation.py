"""What is compiled before a solve: every function that it calls, for the very types that it calls it with."""

import json
import os
import subprocess
import sys

import pytest
import sympy
from golden import ROOT
from sympy import exp, log

from codegen.emit.lower.printer import stabilised
from codegen.solving import loading
from codegen.solving.compiler import build
from codegen.solving.machine_code.compilation import parts_of

COUNT = """
import sys
from codegen.cli import main
from codegen.solving.loading import load, machine_code_counts
before = set(sys.modules)
try:
    main(sys.argv[1:])
except SystemExit as ended:
    assert not ended.code
module = next(module for name, module in sys.modules.items() if "@" in name)
print(*machine_code_counts(module), file=sys.stderr)
"""


@pytest.mark.parametrize(
    "words",
    [
        "pendulum.py", "outer_solar_system.py --scheme stormer-verlet", "linear_pendulum.py",
        "bryson_denham.py --sensitivities", "hovercraft.py", "two_stage_rocket.py", "image_registration.py",
    ],
)  # fmt: skip
def test_all_that_a_solve_calls_is_compiled_beforehand(words, cache_folder):
    """In the second process numba compiles nothing; in the first one, other processes have compiled."""
    file, *options = words.split()
    command = [sys.executable, "-c", COUNT, "solve", str(ROOT / "problems" / file), *options, "--json"]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
        compiled, read = map(int, done.stderr.split()[-2:])
        assert json.loads(done.stdout)["status"] == "solved"
        assert compiled == 0
        assert read > 0


def test_only_differences_of_exponentials_are_rewritten():
    x, y, z = sympy.symbols("x y z", real=True)
    expm1 = stabilised(exp(x) - 1)
    assert expm1.func.__name__ == "expm1"
    assert stabilised(y * exp(x) - y) == y * expm1
    assert stabilised(z + y * (exp(x) - 1)) == z + y * expm1
    assert stabilised(y * exp(x) + z) == y * exp(x) + z
    assert stabilised(log(1 + x)).func.__name__ == "log1p"


@pytest.mark.parametrize("choices", [{}, {"passive": "True"}], ids=["points alone", "points that are carried along"])
def test_functions_that_carry_points_are_compiled_where_there_are_any(choices):
    module = loading.load(build(ROOT / "problems" / "image_registration.py", choices).path)
    names = [part.function.__name__ for part in parts_of(module)]
    assert "broyden_steps" in names
    assert ("carry_points" in names) == bool(choices)
