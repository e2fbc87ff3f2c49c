"""Processes that compile a module: how they share the work, and what is said where one of them fails."""

import os
import subprocess
import sys
from pathlib import Path

from codegen.machine_code.processes import compilers

GENERATED = Path(__file__).parents[2] / "generated"

USE = """
import sys
from codegen.loading import load, machine_code_counts
module = load(sys.argv[1])
solution = module.solve(200)
assert "codegen.drivers" not in sys.modules
print(solution.status, solution.cost, *machine_code_counts(module))
"""


def output(program: str, *arguments: object) -> list[str]:
    """What a new process prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONHASHSEED": "0"}
    ).stdout.split()


def test_one_process_becomes_two_and_tells_how_both_ended(tmp_path):
    path = tmp_path / "pendulum.py"
    path.write_bytes((GENERATED / path.name).read_bytes())
    with compilers() as processes:
        assert processes.compile(path)
    assert processes.failure == ""
    program = USE.split("solution = ")[0] + "module.solve(9); print(*machine_code_counts(module))"
    compiled, read = output(program, path)
    assert compiled == "0" < read
    (tmp_path / "broken.py").write_text(path.read_text().replace("def path_residual(", "def path_residual(missing, "))
    with compilers() as processes:
        assert not processes.compile(tmp_path / "broken.py")
    assert processes.failure.startswith("TypeError: path_residual() missing 1 required positional argument")


def test_a_process_that_fails_is_named_on_stderr_and_a_first_solve_compiles(tmp_path):
    """In one line, with type and message of the error; the module has its machine code all the same."""
    (tmp_path / "pendulum.py").write_bytes((GENERATED.parent / "problems" / "pendulum.py").read_bytes())
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "if 'codegen.machine_code.compilation' in sys.orig_argv: sys.modules['codegen.machine_code.linking'] = None\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(GENERATED.parent), os.environ.get("PYTHONPATH", "")])
    surroundings = {**os.environ, "PYTHONPATH": paths, "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "codegen", "build", "pendulum.py", "--out", "out"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=surroundings)
    assert done.returncode == 0
    assert done.stdout.startswith("out/pendulum.py: written")
    assert done.stderr.count("\n") == 1
    assert (
        "machine code could not be made ahead (ModuleNotFoundError: import of codegen.machine_code.linking"
        in done.stderr
    )
    program = USE.split("solution = ")[0] + "module.solve(9); print(*machine_code_counts(module))"
    compiled, read = output(program, tmp_path / "out" / "pendulum.py")
    assert compiled == "0" < read
