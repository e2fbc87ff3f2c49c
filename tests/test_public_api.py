"""The package as its users call it from Python: build, load, solve, again and again, in threads and in processes."""

from __future__ import annotations

import copy
import importlib
import pickle
import pkgutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS

import codegen

POOLS = """
import multiprocessing, sys
from concurrent.futures import ProcessPoolExecutor
import codegen

if __name__ == "__main__":
    module = codegen.load(codegen.build("pendulum.py", scheme="stormer-verlet").path)
    steps = [50, 100, 50]
    alone = [module.solve(n) for n in steps]
    context = multiprocessing.get_context(sys.argv[1])
    with ProcessPoolExecutor(2, context) as pool:
        found = list(pool.map(module.solve, steps))
    for one, other in zip(alone, found, strict=True):
        assert type(other) is type(one), type(other)
        assert one.status == other.status == "solved"
        assert (one.q == other.q).all() and one.q.shape == other.q.shape
    print("the same")
"""

UNPICKLED = "import pickle, sys; s = pickle.loads(open(sys.argv[1], 'rb').read()); print(s.status, s.q[-1, 0])"


def test_every_public_name_is_what_it_was_after_all_submodules_are_imported():
    """A submodule of the same name would take the place of a function as soon as anything imports it."""
    before = {name: getattr(codegen, name) for name in codegen.__all__}
    submodules = {entry.name for entry in pkgutil.iter_modules(codegen.__path__)}
    assert not submodules & set(codegen.__all__)
    for name in submodules - {"__main__"}:
        importlib.import_module(f"codegen.{name}")
    assert {name: getattr(codegen, name) for name in codegen.__all__} == before


def test_what_a_person_can_cause_is_caught_under_one_public_name():
    with pytest.raises(codegen.CodegenError, match="no such file"):
        codegen.build("nowhere.py")


def test_build_load_and_solve_twice_and_in_a_loop(explicit_pendulum):
    for _ in range(2):
        made = codegen.build(PROBLEMS / "pendulum.py", scheme="stormer-verlet")
        module = codegen.load(made.path)
        assert module is explicit_pendulum
        finals = {module.solve(20).q[-1, 0] for _ in range(3)}
        assert len(finals) == 1
    energies = [module.solve(20, duration=duration).energy[-1] for duration in (1.0, 2.0, 3.0)]
    assert len(set(energies)) == 3


def test_threads_load_one_module_and_find_the_same(tmp_path, explicit_pendulum):
    """Eight threads import a file that nobody imported before: none may see it half imported."""
    path = tmp_path / "pendulum.py"
    path.write_text(Path(explicit_pendulum.__file__).read_text())

    def solved(steps: int) -> tuple[object, float]:
        module = codegen.load(path)
        return module, module.solve(steps).q[-1, 0]

    steps = [10, 20, 30, 40] * 2
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(solved, steps))
    assert len({id(module) for module, _ in found}) == 1
    assert [final for _, final in found] == [explicit_pendulum.solve(n).q[-1, 0] for n in steps]


@pytest.mark.parametrize("method", ["spawn", "forkserver", "fork"])
def test_functions_and_solutions_cross_to_other_processes(tmp_path, method, explicit_pendulum):
    (tmp_path / "pendulum.py").write_text((PROBLEMS / "pendulum.py").read_text())
    (tmp_path / "main.py").write_text(POOLS)
    done = subprocess.run([sys.executable, "main.py", method], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "the same\n"


def test_solutions_and_grids_are_pickled_copied_and_read_by_another_process(tmp_path, explicit_pendulum):
    solution = explicit_pendulum.solve(20)
    again = pickle.loads(pickle.dumps(solution))
    assert type(again) is type(solution)
    np.testing.assert_array_equal(again.q, solution.q)
    np.testing.assert_array_equal(copy.deepcopy(solution).q, solution.q)
    grid = explicit_pendulum.make_grid(20)
    assert pickle.loads(pickle.dumps(grid)).steps == 20
    assert pickle.loads(pickle.dumps(grid)).problem is explicit_pendulum.problem
    assert pickle.loads(pickle.dumps(explicit_pendulum.energy)) is explicit_pendulum.energy
    (tmp_path / "solution.pickle").write_bytes(pickle.dumps(solution))
    words = [sys.executable, "-c", UNPICKLED, "solution.pickle"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["solved", str(solution.q[-1, 0])]


def test_what_a_changed_module_has_pickled(tmp_path, explicit_pendulum):
    """A motion is numbers alone, which are read whatever became of the module; a grid is of no use without it."""
    path = tmp_path / "pendulum.py"
    text = Path(explicit_pendulum.__file__).read_text()
    path.write_text(text)
    module = codegen.load(path)
    solution = module.solve(5)
    (tmp_path / "solution.pickle").write_bytes(pickle.dumps(solution))
    (tmp_path / "grid.pickle").write_bytes(pickle.dumps(module.make_grid(5)))
    path.write_text(text.replace("steps=200, parameters", "steps=300, parameters"))

    def unpickled(name):
        words = [sys.executable, "-c", UNPICKLED, name]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)

    assert unpickled("solution.pickle").stdout.split() == ["solved", str(solution.q[-1, 0])]
    assert "pendulum.py is not what it was" in unpickled("grid.pickle").stderr


def test_a_solution_of_a_control_module_that_changed_says_so(tmp_path, orbital_transfer):
    """It holds its grid, on which it is gone on with."""
    path = tmp_path / "orbital_transfer.py"
    text = Path(orbital_transfer.__file__).read_text()
    path.write_text(text)
    solution = codegen.load(path).solve(4, max_iterations=1)
    (tmp_path / "solution.pickle").write_bytes(pickle.dumps(solution))
    path.write_text(text.replace("do not edit", "do not edit this"))
    words = [sys.executable, "-c", UNPICKLED, "solution.pickle"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert "orbital_transfer.py is not what it was" in done.stderr
