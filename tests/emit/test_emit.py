"""Rendering and writing: deterministic, complete, atomic."""

import ast
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import fields
from functools import cache
from pathlib import Path

import jinja2
import pytest
from golden import GALLERY, KEPT, built, committed, differences, digests, fresh, names, text_of
from jinja2 import meta

from codegen import identifiers
from codegen.emit import rendering
from codegen.emit.lower.module import ControlModule, Origin, SimulateModule
from codegen.emit.lower.particles import ParticlesModule
from codegen.errors import FileError
from codegen.runtime.record import Task
from codegen.solving.compiler import build
from codegen.solving.loading import load
from codegen.solving.results.output import record_in

ROOT = Path(__file__).parents[2]
PROBLEM = ROOT / "problems" / "linear_pendulum.py"
SETTERS = ast.Subscript | ast.Attribute
SPARE = {"interval_times", "__all__"}
"""Middles of intervals stand beside the times of nodes, whether or not a guess depends on them."""


@pytest.mark.parametrize("problem", sorted({problem for problem, _, _ in GALLERY}))
def test_committed_modules_are_what_the_generator_makes(problem):
    """What `python tests/golden.py` compares, one problem at a time, each made once for all tests of a run."""
    assert differences(built([problem]), [problem]) == []


def given_names(text: str) -> list[str]:
    """The names that a module gives at its top, those aside that are made of what they were, as in x = *x, y."""
    found = []
    for statement in ast.parse(text).body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            found.append(statement.name)
        elif isinstance(statement, ast.Assign):
            stored = [n.id for t in statement.targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            read = {n.id for n in ast.walk(statement.value) if isinstance(n, ast.Name)}
            found += [name for name in stored if name not in read and not isinstance(statement.targets[0], SETTERS)]
    return found


@pytest.mark.parametrize("problem", sorted({problem for problem, _, _ in GALLERY}))
def test_each_name_is_given_once(problem):
    """Texts of many files become one module, in which the last of two constants of one name would hold for both."""
    for name, text in built([problem]).items():
        twice = [one for one, number in Counter(given_names(text)).items() if number > 1]
        assert not twice, f"{name}: {twice}"


def test_what_the_cache_holds_is_what_is_generated_anew():
    problems = ["orbital_transfer", "pendulum"]
    assert built(problems) == fresh(problems)


def test_no_module_is_missing_or_left_over():
    assert set(committed()) == {f"{name}.py" for name in KEPT}
    assert set(committed()) | set(digests()) == names()
    assert not set(committed()) & set(digests())


def test_the_hash_seed_does_not_matter():
    """The other comparisons run under a seed that differs from run to run; here is one that does not."""
    problems = ["hovercraft", "goddard_rocket", "pendulum", "image_registration"]
    code = (
        "import sys; sys.path.insert(0, 'tests'); import golden;"
        f"lines = golden.differences(golden.fresh({problems}), {problems});"
        "sys.exit('\\n'.join(lines) or 0)"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "20240229"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@cache
def asked_from_outside() -> frozenset[str]:
    """Names that the package or its templates ask a module for: attributes, and texts such as those of `getattr`."""
    found = set()
    for path in (ROOT / "codegen").rglob("*.py"):
        if "runtime" not in path.relative_to(ROOT).parts:
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                found |= {getattr(node, "attr", ""), str(getattr(node, "value", ""))}
    return frozenset(found)


@pytest.fixture(scope="module", params=sorted(names()))
def name(request):
    """The file of a module of the gallery; tests of one follow each other."""
    return request.param


@pytest.fixture(scope="module")
def tree(name):
    """What it says, read once."""
    return ast.parse(text_of(name))


def test_generated_modules_hold_nothing_that_nobody_uses(tree):
    """Every function and constant is used in the module or asked for by the package, or is part of its interface."""
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    made = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    for node in tree.body:
        if isinstance(node, ast.Assign):
            made |= {part.id for target in node.targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    assert made - used - asked_from_outside() <= SPARE


def test_generated_modules_import_only_the_standard_library_numpy_numba_and_the_runtime(tree):
    roots = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = str(node.module)
            roots.add("runtime" if module.startswith("codegen.runtime.") else module.split(".")[0])
    assert roots <= {*sys.stdlib_module_names, "numpy", "numba", "runtime"}


def test_generated_modules_define_every_name_once_and_use_every_function(tree):
    defined = [node.name for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    assert len(defined) == len(set(defined))
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    public = {
        "solve",
        "cost_gradient",
        "constraints",
        "jacobian",
        "hessian",
        "stationarity",
        "cost",
        "step",
        "residual",
        "first_momenta",
        "first_unknowns",
        "all_equations",
        "all_equations_jacobian",
        "path_cost",
        "path_residual",
        "energy",
    }
    unused = [d for d in defined if d not in used and d not in public]
    assert len(unused) <= 3, unused  # callbacks that only other optimisers call


def test_names_that_generated_functions_use_are_marked(name, tree):
    """A parameter of the same name as a local or a function that its own module calls would shadow it."""
    metadata = record_in(text_of(name))
    own = {*metadata.parameters, *getattr(metadata, "own", ()), "t"}
    moving = (*metadata.coordinates, *metadata.rates)
    for function in [node for node in tree.body if isinstance(node, ast.FunctionDef)]:
        if not own & {argument.arg for argument in function.args.kwonlyargs}:
            continue
        names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
        names |= {argument.arg for argument in (*function.args.args, *function.args.kwonlyargs)}
        # Points that move one by one have locals of their own kind, which no symbol is called.
        task = "particles" if metadata.of_particles and metadata.task == Task.SIMULATE else metadata.task
        lacking = {n for n in names - own if identifiers.marked(n, task, moving, moving=False) == n}
        assert not lacking, function.name


def test_docstrings_of_generated_functions_fit_a_page(name, tree):
    """That of the module itself holds formulas of the problem, which may be long."""
    lines_of_text = text_of(name).splitlines()
    for node in [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]:
        first = node.body[0]
        if ast.get_docstring(node) and not node.name.startswith("coupling_"):
            lines = lines_of_text[first.lineno - 1 : first.end_lineno]
            assert max(map(len, lines)) <= 120, node.name


def test_headers_say_where_the_command_works(name):
    """It names the file without a folder, so that any machine makes the same text."""
    first, second = text_of(name).splitlines()[:2]
    source = first.split(" from ")[1].removesuffix("; do not edit.")
    assert second.startswith(f"# Made again, in the folder of {source}, by: codegen build {source}")


def test_the_stride_counts_everything_that_an_interval_has(interpreted):
    """Three states and their multipliers, and the thrust."""
    module = interpreted("goddard_rocket")
    sizes = [module.initial_guess(module.make_grid(steps)).size for steps in (10, 11, 13)]
    assert [size - sizes[0] for size in sizes] == [0, 7, 21]
    assert module.STRIDE == 7


def test_a_duration_that_overrides_parameters_is_documented():
    assert "`duration`, if given, overrides" in text_of("cart_pole.py")
    assert "overrides" not in text_of("goddard_rocket.py")  # its duration is an unknown


def test_templates_ask_only_for_what_modules_supply():
    environment = jinja2.Environment(loader=jinja2.PackageLoader("codegen.emit"))
    for name in environment.list_templates(extensions=["j2"]):
        source = environment.loader.get_source(environment, name)[0]
        tree = environment.parse(source)
        assert "{% if" not in source, f"{name} decides something"
        assert "{% set" not in source, f"{name} computes something"
        assert meta.find_undeclared_variables(tree)


@pytest.mark.parametrize(
    ("template", "kind"),
    [
        ("control.py.j2", ControlModule), ("simulate.py.j2", SimulateModule),
        ("connect.py.j2", ParticlesModule), ("particles.py.j2", ParticlesModule),
    ],
)  # fmt: skip
def test_templates_name_nothing_that_is_not_supplied(template, kind):
    environment, wanted, left = jinja2.Environment(loader=jinja2.PackageLoader("codegen.emit")), set(), [template]
    while left:
        tree = environment.parse(environment.loader.get_source(environment, left.pop())[0])
        wanted |= meta.find_undeclared_variables(tree)
        left += meta.find_referenced_templates(tree)
    made = {"numba_imports", "imports", "record_type", "record_lines", "identity", "loops", "public"}
    supplied = {field.name for owner in (kind, Origin) for field in fields(owner)}
    inherited = {"kernel", "visit"}  # by an include, from a loop
    assert wanted - inherited <= supplied | made


def test_writing_the_same_text_touches_nothing(tmp_path):
    path = tmp_path / "module.py"
    assert rendering.write(path, "a = 1\n")
    before = path.stat().st_mtime_ns
    assert not rendering.write(path, "a = 1\n")
    assert path.stat().st_mtime_ns == before
    assert [p.name for p in tmp_path.iterdir()] == ["module.py"]


def test_a_failing_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "module.py"
    path.write_text("old")

    def broken(*_arguments):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(FileError, match="no space left"):
        rendering.write(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["module.py"]


@pytest.mark.parametrize("delay", [0.3, 1.0])
def test_a_killed_build_leaves_the_old_module(tmp_path, delay):
    out = tmp_path / "generated"
    out.mkdir()
    old = out / "linear_pendulum.py"
    old.write_text("old = True\n")
    code = f"import codegen, time; codegen.build({str(PROBLEM)!r}, out={str(out)!r}); time.sleep(9)"
    environment = {**os.environ, "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    # The write is made slow by a text that arrives only after the kill: the process dies while it derives.
    process = subprocess.Popen([sys.executable, "-c", code], env=environment)
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.wait()
    text = old.read_text()
    assert text == "old = True\n" or text.startswith("# Generated by codegen")
    compile(text, "module", "exec")


def test_two_builds_at_once_never_mix(tmp_path):
    code = f"from codegen.solving.compiler import build; build({str(PROBLEM)!r}, out={str(tmp_path / 'out')!r})"
    environment = {**os.environ, "CODEGEN_CACHE_DIR": str(tmp_path / "cache")}
    processes = [subprocess.Popen([sys.executable, "-c", code], env=environment) for _ in range(2)]
    assert [process.wait() for process in processes] == [0, 0]
    assert (tmp_path / "out" / "linear_pendulum.py").read_text() == text_of("linear_pendulum.py")
    assert len(list((tmp_path / "out").iterdir())) == 1


def test_a_cache_hit_needs_no_sympy(tmp_path, monkeypatch):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path))
    first = build(PROBLEM)
    assert not first.cached
    code = (
        "import sys; from codegen.solving.compiler import build;"
        f"b = build({str(PROBLEM)!r}); print(b.cached, 'sympy' in sys.modules, b.path)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False", str(first.path)]


def test_the_cache_sees_changes_of_problem_arguments_and_choices(tmp_path, monkeypatch):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path / "cache"))
    path = tmp_path / "swing.py"
    path.write_text(PROBLEM.read_text())
    assert not build(path).cached
    assert build(path).cached
    assert not build(path, scheme="trapezoidal").cached
    assert not build(path, controls="nodal").cached
    path.write_text(path.read_text().replace("steps=50", "steps=60"))
    assert not build(path).cached


@pytest.mark.parametrize(
    ("problem", "expected"),
    [("bouncing_ball", [1, 2]), ("published/reorientation", [0]), ("published/gas_oil", []), ("crane", [])],
)
def test_free_durations_are_marked_among_the_linking_variables(problem, expected):
    """Two phases after the multiplier of a condition; one duration; free parameters of another kind; none."""
    module = load(build(ROOT / "problems" / f"{problem}.py").path)
    assert module.problem.structure.durations.tolist() == expected
