"""What is compiled before a module is there, and how numba is made quicker: the results stay numba's own."""

import os
import subprocess
import sys
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import pytest
from numba.core import ir
from numba.core.compiler import Flags, run_frontend
from numba.core.postproc import PostProcessor

from codegen.loading import load
from codegen.machine_code import ahead
from codegen.machine_code.processes import compilers
from codegen.machine_code.shortcuts import _replaced, quick_numba

GENERATED = Path(__file__).parents[2] / "generated"

COMPILE = """
import sys
from numba import njit
from codegen.machine_code import ahead, compilation
from codegen.machine_code.linking import link_inner_functions
from codegen.loading import load
njit(lambda x: x)(0.0)
link_inner_functions()
waiting = iter([False] * int(sys.argv[2]) + [True])
ahead.compile_ahead(lambda: next(waiting))
module = load(sys.argv[1])
compilation.compile_for_callers(module)
functions = [f for f in vars(module).values() if hasattr(f, "overloads")]
ahead.take_over(functions)
print(*[f.py_func.__name__ for f in functions if f.overloads])
if int(sys.argv[2]):
    compilation.compile_all(module)
else:
    compilation.parts(module)[0]()
(code,) = module.factor.inspect_asm().values()
print(hash(tuple(line.split()[0] for line in code.splitlines() if line.startswith("\\t") and "\\t." not in line)))
"""

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


def test_a_module_takes_over_what_was_compiled_ahead(tmp_path):
    """Its machine code has the same instructions as without, and is whole on the disk."""
    path = tmp_path / "linear_pendulum.py"
    path.write_bytes((GENERATED / path.name).read_bytes())
    (instructions,) = output(COMPILE, path, 0)
    (tmp_path / "__pycache__").rename(tmp_path / "without")
    *names, same = output(COMPILE, path, 1)
    assert set(names) == {"eliminate_rows", "eliminate_one", "eliminate_pair", "subtract_row"}
    assert same == instructions
    status, cost, compiled, read = output(USE, path)
    assert (status, compiled) == ("solved", "0")
    assert int(read) >= 5
    assert float(cost) == pytest.approx(4.530801094, rel=1e-9)


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
        "if 'codegen.machine_code.compilation' in sys.orig_argv: sys.modules['codegen.machine_code.ahead'] = None\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(GENERATED.parent), os.environ.get("PYTHONPATH", "")])
    surroundings = {**os.environ, "PYTHONPATH": paths, "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "codegen", "build", "pendulum.py", "--out", "out"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=surroundings)
    assert done.returncode == 0
    assert done.stdout.startswith("out/pendulum.py: written")
    assert done.stderr.count("\n") == 1
    assert (
        "machine code could not be made ahead (ModuleNotFoundError: import of codegen.machine_code.ahead" in done.stderr
    )
    program = USE.split("solution = ")[0] + "module.solve(9); print(*machine_code_counts(module))"
    compiled, read = output(program, tmp_path / "out" / "pendulum.py")
    assert compiled == "0" < read


@pytest.mark.parametrize("name", ["hovercraft", "orbital_transfer", "two_stage_rocket"])
@pytest.mark.parametrize(("file", "function"), [row[:2] for row in ahead.FUNCTIONS])
def test_modules_have_the_functions_that_are_compiled_ahead(name, file, function):
    """Otherwise the work would be lost. Where nothing is eliminated inside an interval, nothing is inverted."""
    module, runtime = load(GENERATED / f"{name}.py"), import_module(f"codegen.runtime.{file}")
    if file == "inverse" and name == "two_stage_rocket":
        assert not hasattr(module, function)
    else:
        assert ahead._are_same(getattr(module, function), getattr(runtime, function))


def test_functions_that_read_other_values_are_not_the_same():
    module, runtime = load(GENERATED / "hovercraft.py"), import_module("codegen.runtime.kkt.symmetric")
    assert not ahead._are_same(module.solve_forward, runtime.solve_backward)
    assert not ahead._are_same(module.subtract_row, runtime.subtract_products)
    before, runtime.BALANCE = runtime.BALANCE, 0.5
    try:
        assert not ahead._are_same(module.eliminate_rows, runtime.eliminate_rows)
    finally:
        runtime.BALANCE = before


@pytest.mark.parametrize("function", ["interval_hessian", "eliminate_body", "substitute", "eliminate_rows"])
def test_variables_are_listed_as_numba_lists_them(function):
    """The method of numba's that looks through everything is left as it is."""
    code = run_frontend(getattr(load(GENERATED / "hovercraft.py"), function).py_func)
    statements = [statement for block in code.blocks.values() for statement in block.body]
    values = [s.value for s in statements if isinstance(s, ir.Assign) and isinstance(s.value, ir.Expr)]
    with quick_numba():
        assert ir.Stmt.list_vars.__module__ == ir.Expr.list_vars.__module__ == "codegen.machine_code.shortcuts"
        assert [s.list_vars() for s in statements] == [s._rec_list_vars(s.__dict__) for s in statements]
        assert [v.list_vars() for v in values] == [v._rec_list_vars(v._kws) for v in values]


QUICKLY = """
import sys
from contextlib import nullcontext
from codegen.machine_code import shortcuts
from codegen.machine_code.compilation import parts
from codegen.machine_code.shortcuts import quick_numba
from codegen.loading import load
shortcuts.short_entries = lambda own: own  # LLVM makes the same of it, but not always in the same order
module = load(sys.argv[1])
with quick_numba() if sys.argv[2] == "quick" else nullcontext():
    parts(module)[0]()
    parts(module)[1]()
for function in (module.factor, module.substitute):
    (code,) = function.inspect_asm().values()
    print(hash(tuple(line.split()[0] for line in code.splitlines() if line.startswith("\\t") and "\\t." not in line)))
    print(function.stats.cache_path is not None, len(function.overloads), sum(function.stats.cache_misses.values()))
"""


def test_shorter_ways_lead_to_the_same_machine_code(tmp_path):
    path = tmp_path / "linear_pendulum.py"
    path.write_bytes((GENERATED / path.name).read_bytes())
    plain = output(QUICKLY, path, "plain")
    (tmp_path / "__pycache__").rename(tmp_path / "plain")
    assert output(QUICKLY, path, "quick") == plain
    files = [sorted(f.name for f in folder.glob("*.nb?")) for folder in (tmp_path / "plain", tmp_path / "__pycache__")]
    assert files[0] == files[1] != []


def test_lives_are_found_out_when_they_are_asked_for():
    """In the end, every variable is given up where numba's own method gives it up."""
    function = load(GENERATED / "hovercraft.py").solve_backward.py_func
    given_up = []
    for context in (nullcontext(), quick_numba()):
        with context:
            code = run_frontend(function)
            PostProcessor(code).run(emit_dels=True)
            lives = code.variable_lifetime
            assert lives.livemap.keys() == code.blocks.keys()
            given_up.append([str(statement) for block in code.blocks.values() for statement in block.body])
    assert given_up[0] == given_up[1]
    assert any(line.startswith("del ") for line in given_up[0])


def test_options_are_all_listed():
    flags = Flags()
    flags.nrt, flags.fastmath = True, True
    plain = flags.values()
    with quick_numba():
        assert list(flags.values().items()) == list(plain.items())
        assert flags != Flags()
        assert flags == flags.copy()


def test_a_method_of_other_arguments_is_left_alone():
    class Numba:
        def method(self, one):
            return one

    for name, parameters in (("method", ["self"]), ("method", None), ("other", ["self", "one"])):
        before = dict(vars(Numba))
        with _replaced(Numba, name, parameters, lambda own: None):
            assert dict(vars(Numba)) == before
    with _replaced(Numba, "method", ["self", "one"], lambda own: lambda self, one: own(self, one) + 1):
        assert Numba().method(1) == 2
    assert Numba().method(1) == 1
