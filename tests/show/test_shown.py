"""What problems, solvers, solutions and checks show of themselves in a notebook, and as what else they can be had."""

from __future__ import annotations

import base64
import importlib.util
import io
import pickle
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import typed_use
from conftest import PROBLEMS
from PIL import Image
from written_objects import FILES, object_of

import codegen
from codegen.errors import ArgumentError, ExtraError
from codegen.evidence.checks.base import Finding, Findings
from codegen.show.equations import as_markdown
from codegen.show.notebook import displayed
from codegen.solving.results.result import Result

UNPICKLED = """
import pickle, sys
one = pickle.loads(open(sys.argv[1], "rb").read())
one.plot("again.png")
one.animate("again.gif")
print(one.status, one.q[-1, 0], one == pickle.loads(open(sys.argv[1], "rb").read()))
"""


class Tags(HTMLParser):
    """Counts tags, which have to be closed, and collects texts and attributes."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(html)
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture
def solver(uncompiled: None) -> codegen.Solver:
    return codegen.compile(typed_use.double_integrator(), name="push", title="Push a cart.")


@pytest.fixture
def solution(solver: codegen.Solver) -> Result:
    return solver.solve()


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_problem_of_the_gallery_is_mathematics(file):
    text = displayed(object_of(file).problem)
    assert text.count("{") == text.count("}")
    assert text.count(r"\left") == text.count(r"\right")
    assert text.count(r"\begin{aligned}") == text.count(r"\end{aligned}") >= 1
    assert "class" not in text  # no repr of Python


def test_mathematics_has_cost_motion_and_ends():
    text = typed_use.double_integrator()._repr_latex_()
    for part in (
        r"\int_{0}^{T} \left(u^{2}\right) dt",
        r"L &= \frac{m \dot{x}^{2}}{2}",
        "f_{x} &= u",
        r"\dot{x}(T) &= 0",
    ):
        assert part in text


def test_an_unfinished_problem_shows_itself_all_the_same():
    assert "object" in codegen.Control(cost=object(), duration="later")._repr_latex_()


def test_derived_equations_are_markdown():
    rows = "C &= u \\\\\nT &= 1"
    latex = (
        f"\\section*{{A 50\\% push}}\n\n\\paragraph{{Cost.}}\n\\begin{{align*}}\n{rows}\n\\end{{align*}}\nat: $x$\\\\"
    )
    found = as_markdown(latex)
    assert found.startswith(f"### A 50% push\n\n#### Cost.\n\n$$\n\\begin{{aligned}}\n{rows}\n\\end{{aligned}}\n$$")
    assert found.endswith("at: $x$  ")


def test_a_solution_is_a_table_with_its_figure(solution):
    tags = Tags(solution._repr_html_())
    assert tags.texts[0] == "Push a cart."
    assert "solved: " in " ".join(tags.texts)
    (image,) = [given for tag, given in tags.found if tag == "img"]
    assert str(image["alt"]).startswith("Push a cart. variational, midpoint, ")
    assert f"; u from {solution.u.min():.3g} to {solution.u.max():.3g}" in str(image["alt"])
    data = str(image["src"]).removeprefix("data:image/png;base64,")
    assert Image.open(io.BytesIO(base64.b64decode(data))).size[0] > 400


def test_a_solution_without_its_module_is_a_table(solution):
    alone = replace(solution, background=None)
    assert "<img" not in alone._repr_html_()
    with pytest.raises(ArgumentError, match="push: this solution does not know its module; solve by"):
        alone.plot()


def test_what_an_author_writes_is_no_markup(solution):
    html = replace(solution, title="<script>alert(1)</script>", message="1 < 2 & 3", background=None)._repr_html_()
    assert "<script>" not in html
    assert "1 < 2 & 3" in " ".join(Tags(html).texts)


def test_findings_are_a_table_in_words():
    found = Findings(
        [Finding("one", "a<b", True, "fine"), Finding("two", "it", False, "no"), Finding("three", "x", True, "", False)]
    )
    tags = Tags(found._repr_html_())
    assert "1 check passed, 1 failed, 1 do not apply" in tags.texts
    assert {"passed", "FAILED", "does not apply", "a<b"} <= set(tags.texts)
    assert not found.passed
    assert [finding.check for finding in found.failed] == ["two"]


def test_a_solver_shows_what_it_is(solver):
    tags = Tags(solver._repr_html_())
    assert {"push (control)", "variational, midpoint, 10 steps", str(solver.build.path)} <= set(tags.texts)
    assert r"\int_{0}^{T}" in " ".join(tags.texts)
    assert repr(solver) == f"Solver('push', '{solver.build.path}')"


def test_a_film_is_inline_and_a_file(solution, tmp_path):
    film = solution.animate()
    (image,) = [given for tag, given in Tags(film._repr_html_()).found if tag == "img"]
    data = base64.b64decode(str(image["src"]).removeprefix("data:image/gif;base64,"))
    assert data == film.data
    assert image["alt"] == "Film: Push a cart."
    assert repr(film) == "Film(title='Push a cart.')"
    film.save(tmp_path / "push.gif")
    assert (tmp_path / "push.gif").read_bytes() == data
    with pytest.raises(ArgumentError, match="unknown kind of film; let it end in"):
        film.save("push.avi")
    with pytest.raises(ArgumentError, match="unknown kind of picture; let it end in"):
        solution.plot("push.gif")


def test_no_film_without_a_drawing(solution):
    bare = replace(solution, background=replace(solution.background, source=None))
    assert bare.plot()._repr_png_()[:4] == b"\x89PNG"
    with pytest.raises(ArgumentError, match="push says nothing about how to draw it; add drawing="):
        bare.animate()


def test_a_data_set_holds_what_the_solution_does(solution):
    data = solution.to_dataset()
    assert dict(data.sizes) == {
        "node": 11,
        "interval": 10,
        "coordinate": 1,
        "momentum": 1,
        "control": 1,
        "multiplier": 1,
    }
    np.testing.assert_array_equal(data["q"].sel(coordinate="x"), solution.q[:, 0])
    np.testing.assert_array_equal(data["u"].sel(control="u"), solution.u[:, 0])
    assert data.attrs["status"] == "solved"
    assert float(data["cost"]) == solution.cost
    # Momentum and control of the discrete equations: p_k+1 - p_k = h u_k.
    np.testing.assert_allclose(np.diff(data["p"][:, 0]), 0.1 * data["u"][:, 0], atol=1e-12)


def test_stages_have_a_dimension(solution):
    stages = replace(solution, u=np.zeros((20, 1)), stage_abscissae=(0.2, 0.8))
    assert stages.to_dataset()["u"].dims == ("interval", "stage", "control")
    assert stages.to_frame()["u"].tolist() == [0.0] * 11


def test_a_frame_has_a_row_for_each_node(solution):
    frame = solution.to_frame()
    assert list(frame.columns) == ["x", "p_x", "u"]
    assert frame.index.name == "t"
    assert frame["u"].tolist() == [*solution.u[:, 0], solution.u[-1, 0]]


@pytest.mark.parametrize(("method", "library"), [("to_dataset", "xarray"), ("to_frame", "pandas")])
def test_a_missing_library_is_named_with_its_extra(monkeypatch, solution, method, library):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        "codegen.solving.results.display.find_spec", lambda name: None if name == library else real(name)
    )
    with pytest.raises(ExtraError, match=rf"needs {library}, which is not installed; pip install {library}"):
        getattr(solution, method)()


def test_a_simulation_has_energies(explicit_pendulum):
    solution = codegen.solve(explicit_pendulum, steps=20)
    assert solution.to_dataset()["energy"].dims == ("node",)
    assert "energy" in solution.to_frame()
    assert "<img" in solution._repr_html_()
    with pytest.raises(ArgumentError, match="have other quantities; compare solutions of one problem"):
        solution.differences(replace(solution, task="control"))


def test_solutions_are_equal_to_the_last_bit_or_not(solver, solution):
    again = solver.solve()
    assert again == solution
    assert again.seconds_solve != solution.seconds_solve or again is not solution
    moved = solution.q.copy()
    moved[3, 0] = np.nextafter(moved[3, 0], 1.0)
    assert replace(solution, q=moved) != solution
    assert solution != "a solution"
    with pytest.raises(TypeError, match="unhashable"):
        hash(solution)


def test_differences_between_grids_are_those_of_the_discretisation(solver, solution):
    found = solution.differences(solver.solve(steps=20))
    assert found["t"] == 0.0
    # u = 6 - 12 t at the middles of intervals, up to O(h^2); where a finer one jumps it is half an interval away.
    assert 0.0 < found["x"] < 0.01
    assert 0.0 < found["u"] < 12 * 0.05 + 0.1


def test_a_solution_is_pickled_and_drawn_in_another_process(solution, tmp_path):
    (tmp_path / "one.pickle").write_bytes(pickle.dumps(solution))
    words = [sys.executable, "-c", UNPICKLED, "one.pickle"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["solved", str(solution.q[-1, 0]), "True"]
    with Image.open(tmp_path / "again.gif") as film:
        assert film.n_frames > 10
    assert (tmp_path / "again.png").stat().st_size > 10_000


def test_a_solution_of_what_cannot_be_pickled_is_pickled_without_it(solution):
    class Local:
        pass

    odd = replace(solution, background=replace(solution.background, source=Local()))
    again = pickle.loads(pickle.dumps(odd))
    assert again == odd
    assert again.background.source is None
    assert again.plot()._repr_png_()


def test_a_solver_of_a_file_does_the_same(explicit_pendulum):
    file = PROBLEMS / "pendulum.py"
    solver = codegen.compile(file, scheme="stormer-verlet")
    assert solver.module is explicit_pendulum
    assert solver.name == "pendulum"
    one = solver.solve(steps=20)
    assert one == codegen.solve(file, scheme="stormer-verlet", steps=20)
    assert "pendulum (simulate)" in solver._repr_html_()
    with pytest.raises(ArgumentError, match="--scheme is a choice of a build, and the problem is compiled already"):
        solver.solve(scheme="midpoint")
    with pytest.raises(ArgumentError, match="a name or title beside a file"):
        codegen.compile(file, name="other")


def test_a_solver_can_be_pickled(solver, solution):
    assert pickle.loads(pickle.dumps(solver)).solve() == solution
