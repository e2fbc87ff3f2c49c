"""Machine code that a first solve does not have to wait for, and that is not older than the runtime."""

import json
import os
import pickle
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from codegen.runtime import kept_code
from codegen.solving.compiler import build
from codegen.solving.loading import load, machine_code_counts
from codegen.solving.machine_code import processes
from codegen.solving.machine_code.compilation import has_machine_code

PROBLEM = Path(__file__).parents[2] / "problems" / "pendulum.py"


def test_a_module_without_machine_code_is_compiled_once(tmp_path):
    made = build(PROBLEM, out=tmp_path)
    module = load(made.path)
    assert not has_machine_code(module)
    before = machine_code_counts(module)
    assert processes.require(made.path, module, made.written, nullcontext)[0] > 0.0
    assert has_machine_code(module)
    module.solve(2)
    compiled, read = machine_code_counts(module)
    assert compiled == before[0]
    assert read > before[1]
    assert processes.require(made.path, module, False, nullcontext) == (0.0, [])


def test_it_is_said_what_is_compiled_and_how_much_of_it_is_done(tmp_path):
    """The kernels of a module alone, where functions of the runtime have machine code; else that this is once."""
    said = []

    class Line:
        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def update(self, text):
            said.append(text)

    def working(what):
        said.append(what)
        return Line()

    made = build(PROBLEM, out=tmp_path / "first")
    processes.require(made.path, load(made.path), made.written, nullcontext)
    made = build(PROBLEM, out=tmp_path / "second")
    processes.require(made.path, load(made.path), made.written, working)
    count = len(said) - 1
    assert said == ["Compiling", *(f"Compiling: {done + 1} of {count} parts ..." for done in range(count))]
    assert count > 2


@pytest.fixture
def script(tmp_path):
    return f"""
import sys
from contextlib import nullcontext
from codegen.solving.machine_code import processes
from codegen.solving.compiler import build
from codegen.solving.loading import load

made = build({str(PROBLEM)!r}, out={str(tmp_path / "modules")!r})
module = load(made.path)
said = []
def working(what):
    said.append(what)
    return nullcontext()
print(*[processes.require(made.path, module, is_new, working)[0] > 0.0 for is_new in (True, False)])
print(*said, sep="; ")
"""


def run(script, **environment):
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ | environment
    )
    return done.stdout.splitlines()


def test_machine_code_is_found_where_numba_was_told_to_keep_it(tmp_path, script):
    """All of it: that of the runtime is made there once more, which is said."""
    answers, said = run(script, NUMBA_CACHE_DIR=str(tmp_path / "elsewhere"))
    assert answers == "True False"
    assert said == "Compiling the solver, once on this machine"
    assert not list((tmp_path / "modules").rglob("*.nbi"))
    assert run(script, NUMBA_CACHE_DIR=str(tmp_path / "elsewhere"))[1] == "Compiling"


def test_where_numba_is_switched_off_nothing_is_compiled(script):
    assert run(script, NUMBA_DISABLE_JIT="1") == ["False False", ""]


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    """A folder in place of the runtime's, with one file; what is known of files is forgotten before and after."""
    forget = kept_code.fingerprint.cache_clear, kept_code.fresh_folder.cache_clear
    (tmp_path / "runtime").mkdir()
    (tmp_path / "runtime" / "numerics.py").write_text("x = 1\n")
    monkeypatch.setattr(kept_code, "RUNTIME", tmp_path / "runtime")
    yield lambda: [clear() for clear in forget]
    for clear in forget:
        clear()


def test_no_machine_code_is_left_that_was_made_with_another_runtime(tmp_path, runtime):
    """numba would not see that another file than that of a function has changed."""
    file = tmp_path / "module.py"
    file.write_text("x = 1\n")
    index = tmp_path / "__pycache__" / "module.function-1.py311.nbi"

    def is_left_after_another_look():
        runtime()
        kept_code.fresh_folder(str(file))
        return index.exists()

    is_left_after_another_look()
    index.write_bytes(2 * pickle.dumps("machine code"))
    assert is_left_after_another_look()
    (tmp_path / "runtime" / "numerics.py").write_text("x = 2\n")
    assert not is_left_after_another_look()
    index.write_bytes(2 * pickle.dumps("machine code"))
    assert is_left_after_another_look()
    os.utime(tmp_path / "runtime" / "numerics.py", (0, 0))  # an older file in place of a newer one
    assert not is_left_after_another_look()


def test_folders_that_cannot_be_written_to_are_no_reason_to_fail(tmp_path, runtime, monkeypatch):
    file = tmp_path / "module.py"
    file.write_text("x = 1\n")
    runtime()
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / kept_code.STAMP).mkdir()  # no file can be written in its place
    assert kept_code.fresh_folder(str(file)) == str(tmp_path / "__pycache__")


def test_machine_code_that_was_cut_off_is_made_anew(tmp_path):
    """In every file of a module, and of an index; it is said where it was."""
    made = build(PROBLEM, out=tmp_path)
    processes.require(made.path, load(made.path), made.written, nullcontext)
    program = f"""
import codegen
print(codegen.solve({str(made.path)!r}).status)
"""
    files = [next((tmp_path / "__pycache__").glob(f"*.energy-*{suffix}")) for suffix in (".nbi", ".nbc")]
    for file in files:
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
        assert done.stdout == "solved\n"
        assert f"damaged machine code is made anew ({file})" in done.stderr
        assert len(file.read_bytes()) > len(whole) // 2


@pytest.mark.parametrize("bounds", ["", "bounds={u: (-9, 9)},"])
def test_a_solve_where_numba_is_switched_off_compiles_nothing_and_is_exact(tmp_path, bounds):
    """The least effort by the midpoint rule on N steps is 12 / (1 - 1 / N**2), with bounds that are not active too."""
    (tmp_path / "push.py").write_text(f'''"""Push a mass from rest to rest."""
from codegen import Control, control, states

def problem():
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={{x: v, v: u}}, cost=u**2, duration=1, start={{x: 0, v: 0}}, end={{x: 1, v: 0}}, {bounds}
    )
''')
    command = [sys.executable, "-m", "codegen", "solve", "push.py", "--steps", "4", "--json"]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=True)
    solution = json.loads(done.stdout)
    assert solution["status"] == "solved"
    assert solution["cost"] == pytest.approx(12.8, rel=1e-9)
    assert not [file for suffix in ("nbi", "nbc") for file in tmp_path.rglob(f"*.{suffix}")]
