"""Machine code that a first solve does not have to wait for."""

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

from codegen.compiler import build
from codegen.loading import has_machine_code, load, machine_code_counts
from codegen.machine_code import ahead_of_time

PROBLEM = Path(__file__).parents[2] / "problems" / "pendulum.py"


def test_a_module_without_machine_code_is_compiled_once(tmp_path):
    made = build(PROBLEM, out=tmp_path)
    module = load(made.path)
    assert not has_machine_code(made.path, module)
    assert ahead_of_time.require(made.path, module, made.written, nullcontext)[0] > 0.0
    assert has_machine_code(made.path, module)
    module.solve(2)
    compiled, read = machine_code_counts(module)
    assert (compiled, read > 0) == (0, True)
    assert ahead_of_time.require(made.path, module, False, nullcontext) == (0.0, [])


def test_machine_code_is_found_where_numba_was_told_to_keep_it(tmp_path):
    script = f"""
from contextlib import nullcontext
from codegen.machine_code import ahead_of_time
from codegen.compiler import build
from codegen.loading import load

made = build({str(PROBLEM)!r}, out={str(tmp_path / "modules")!r})
module = load(made.path)
print(*[ahead_of_time.require(made.path, module, is_new, nullcontext)[0] > 0.0 for is_new in (True, False)])
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "elsewhere")}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["True", "False"]
    assert not list((tmp_path / "modules").rglob("*.nbi"))
