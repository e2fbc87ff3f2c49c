"""`mypy --strict` on a file that uses all of the public API, which is then run."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typed_use
from PIL import Image

import codegen
from codegen.discretise.model.from_problem import load_problem
from codegen.problem.sources import source_of

ROOT = Path(__file__).parents[1]
FILE = Path(typed_use.__file__)


def test_the_file_uses_every_public_name():
    tree = ast.parse(FILE.read_text())
    attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert set(codegen.__all__) <= attributes | names


def test_mypy_strict_passes_and_would_not_with_a_mistake(tmp_path):
    def said(file: Path) -> str:
        words = [sys.executable, "-m", "mypy", "--strict", "--config-file", "pyproject.toml", str(file)]
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False).stdout

    assert "no issues found" in said(FILE)
    (tmp_path / "mistaken.py").write_text(FILE.read_text().replace("solver.solve(steps", "solver.solved(steps"))
    assert '"Solver" has no attribute "solved"' in said(tmp_path / "mistaken.py")


@pytest.mark.parametrize(
    "made", ["double_integrator", "oscillator", "first_order", "two_bodies", "many_bodies", "two_phases"]
)
def test_its_problems_are_problems(made):
    problem = getattr(typed_use, made)()
    assert load_problem(source_of(problem, made)).name == made
    latex = problem._repr_latex_()
    assert (latex[:2], latex[-2:]) == ("$$", "$$")
    assert latex.count(r"\begin") == latex.count(r"\end")


def test_its_particles_are_a_problem(tmp_path):
    source = source_of(typed_use.particles(tmp_path / "points.csv"), "pairs")
    assert load_problem(source).points == (tmp_path / "points.csv").as_posix()
    assert source == source_of(typed_use.particles(tmp_path / "points.csv"), "pairs")


def test_its_data_are_read(tmp_path):
    (tmp_path / "drag.csv").write_text("x,drag\n0,0\n0.5,0.1\n1,0.3\n2,0.9\n")
    (tmp_path / "measured.csv").write_text("t,x\n0.1,0.05\n0.9,0.8\n")
    (tmp_path / "guess.csv").write_text("t,x,u\n0,0,1\n1,1,1\n")
    files = [tmp_path / f"{name}.csv" for name in ("drag", "measured", "guess")]
    before = source_of(typed_use.with_data(*files), "fit").text
    assert source_of(typed_use.with_data(*files), "fit").text == before
    for file in files:
        text = file.read_text()
        file.write_text(text.replace("\n", "\n-1,0,1\n", 1) if "u" in text else text.replace("0.", "0.0", 1))
        assert source_of(typed_use.with_data(*files), "fit").text != before, file.name
        file.write_text(text)


@pytest.fixture
def solver(uncompiled: None) -> codegen.Solver:
    """The double integrator."""
    return codegen.compile(typed_use.double_integrator(), name="push", title="Push a cart.")


def test_a_solver_does_all_that_a_file_does(solver):
    found = typed_use.used(solver)
    # At most 12 h^2/2 from the continuous optimum int u^2 = 12, u(0) = 6, by the discretisation.
    assert found["cost"] == pytest.approx(12.0, rel=0.01)
    assert found["largest"] == pytest.approx(6.0, rel=0.06)
    assert max(found[name] for name in ("t", "x", "u")) < 1e-9


def test_sweeps_and_controllers_begin_with_a_solver(solver):
    costs, again = typed_use.swept_and_controlled(solver)
    assert costs == again
    assert costs[1] == pytest.approx(4 * costs[0], rel=1e-9)  # the force is in proportion to the mass


def test_pictures_of_a_solution(solver, tmp_path):
    assert not typed_use.pictured(solver, tmp_path)
    assert (tmp_path / "push.svg").read_text().count("<svg") == 1
    with Image.open(tmp_path / "push.gif") as film:
        assert film.n_frames > 10


def test_solve_of_an_object_is_that_of_its_solver(solver):
    one, other = codegen.solve(solver), solver.solve()
    assert one == other
    assert one != solver.solve(steps=11)
    np.testing.assert_array_equal(one.q, other.q)
