"""Processes that compile a module: how they share the work, and what is said where one of them fails."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from codegen.solving.compiler import build
from codegen.solving.machine_code.processes import compilers

GENERATED = Path(__file__).parents[2] / "generated"

USE = """
import sys
from codegen.solving.loading import load, machine_code_counts
module = load(sys.argv[1])
solution = module.solve(200)
assert "codegen.solving.drivers" not in sys.modules
print(solution.status, solution.cost, *machine_code_counts(module))
"""


def output(program: str, *arguments: object) -> list[str]:
    """What a new process prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONHASHSEED": "0"}
    ).stdout.split()


COUNT = USE.split("solution = ")[0] + "module.solve(9); print(*machine_code_counts(module))"


@pytest.mark.parametrize("shares", [("both",), ("0/2", "1/2"), ("0/1",)], ids=" ".join)
def test_all_is_compiled_however_processes_share_it(tmp_path, shares, monkeypatch):
    """One process that becomes two; two where none can fork; one on one processor."""
    monkeypatch.setattr("codegen.solving.machine_code.processes.shares", lambda: shares)
    path = tmp_path / "pendulum.py"
    path.write_bytes((GENERATED / path.name).read_bytes())
    told = []
    with compilers() as processes:
        assert processes.compile(path, lambda done, count: told.append(done / count))
    assert processes.failure == ""
    assert told[-1] == 1.0
    compiled, read = output(COUNT, path)
    assert compiled == "0" < read


def test_a_module_that_cannot_be_compiled_is_an_error_of_the_processes(tmp_path):
    path = tmp_path / "broken.py"
    path.write_text((GENERATED / "pendulum.py").read_text().replace("math.cos(x0)", "math.cosine(x0)"))
    with compilers() as processes:
        assert not processes.compile(path)
    assert processes.failure.startswith("AttributeError: module 'math' has no attribute 'cosine'")


def test_a_process_that_fails_is_named_on_stderr_and_a_first_solve_compiles(tmp_path):
    """In one line, with type and message of the error; the module has its machine code all the same."""
    (tmp_path / "pendulum.py").write_bytes((GENERATED.parent / "problems" / "pendulum.py").read_bytes())
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "is_compiling = any('codegen.solving.machine_code.compilation' in word for word in sys.orig_argv)\n"
        "if is_compiling: sys.modules['codegen.runtime.linking'] = None\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(GENERATED.parent), os.environ.get("PYTHONPATH", "")])
    surroundings = {**os.environ, "PYTHONPATH": paths, "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "codegen", "build", "pendulum.py", "--out", "out"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=surroundings)
    assert done.returncode == 0
    assert done.stdout.startswith("out/pendulum.py: written")
    assert done.stderr.count("\n") == 1
    assert "machine code could not be made ahead (ModuleNotFoundError: import of codegen.runtime.linking" in done.stderr
    compiled, read = output(COUNT, tmp_path / "out" / "pendulum.py")
    assert compiled == "0" < read


def test_processes_take_the_package_of_their_parent(tmp_path, monkeypatch):
    """Whatever lies in the current folder, as a checkout beside an installed package."""
    other = tmp_path / "codegen"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('another package')\n")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drop.py").write_text(
        '"""Drop a mass (a test)."""\n\n'
        "from codegen import Simulate, coordinate\n\n\ndef problem():\n"
        '    x, dx = coordinate("x")\n'
        "    return Simulate(lagrangian=dx**2 / 2 - x, duration=1, start={x: 0, dx: 1}, steps=5)\n"
    )
    path = build(tmp_path / "drop.py").path
    with compilers() as processes:
        assert processes.compile(path)
    assert processes.failure == ""
