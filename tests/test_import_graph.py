"""The direction of dependence between the parts, and what each entry point must not import."""

import ast
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterable
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import pytest

from codegen.solving.compiler import GENERATORS

PACKAGE = Path(__file__).parents[1] / "codegen"

FLOORS = (
    ("__init__", "deferred", "identifiers", "runtime"),
    ("errors", "machine"),
    ("drawing", "files", "symbolic"),
    ("problem", "terminal"),
    ("discretise",),
    ("emit",),
    ("solving",),
    ("show",),
    ("batch",),
    ("mpc",),
    ("evidence",),
    ("registration",),
    ("solver",),
    ("cli",),
    ("__main__",),
)
"""Folders of the package, and files next to them. A folder imports from lower floors only."""

NUMERIC = (
    "symbolic/tables",
    "drawing",
    "solving/loading",
    "solving/machine_code",
    "solving/results",
    "solving/drivers",
    "show/figures",
    "runtime",
)
"""Parts that run without sympy."""

SYMBOLIC = (
    *(f"symbolic.{name}" for name in ("checks", "derivatives", "graph", "functions")),
    *(f"symbolic.{name}" for name in ("terms", "zeros")),
    "discretise",
    "emit",
    "solving.compiler",
)
"""Modules that import sympy, or that lead to it."""

BY_STRING = {
    ("__init__", "batch"): "public names, imported when they are asked for first",
    ("__init__", "errors"): "public names",
    ("__init__", "mpc"): "public names",
    ("__init__", "problem"): "public names",
    ("__init__", "solver"): "public names",
    ("__init__", "solving"): "public names",
    ("identifiers", "emit"): "reads the names in the templates; nothing is imported",
    ("problem", "show"): "the display of a problem in a notebook",
    ("solving", "show"): "the display of a solution, with figures",
}
"""Strings that name modules of higher floors, with the reason for each."""

COMPUTED = {
    "__init__": "the table of public names, whose strings are read here",
    "deferred": "the module of a Deferred, whose strings are read here",
    "solving": "a generated module; the results of each task",
    "registration": "libraries that read and write images, which are extras",
    "runtime": "the generated module of a problem that was pickled",
}
"""Parts that import by names which are no literals, and these modules."""


def imported(path: Path, with_types: bool = False) -> frozenset[str]:
    """Absolute names of the codegen modules that a file imports at run time, or for annotations as well."""
    at_run_time, for_types = imports(path)
    return at_run_time | for_types if with_types else at_run_time


@cache
def imports(path: Path) -> tuple[frozenset[str], frozenset[str]]:
    """What a file imports at run time, and what where types are checked."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    guarded = [node for node in nodes if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)]
    skipped = {node for guard in guarded for node in ast.walk(guard)}
    return names_in(node for node in nodes if node not in skipped), names_in(skipped)


def names_in(nodes: Iterable[ast.AST]) -> frozenset[str]:
    """The names that some statements import."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def literals(path: Path) -> tuple[list[str], list[str]]:
    """The strings of a file that may name modules, `*` for what is filled in; and the calls whose names are computed.

    Such are a whole string `codegen.part.file`, and the first arguments of Deferred and import_module.
    """
    nodes = list(ast.walk(ast.parse(path.read_text())))
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    names, computed = [text for text in texts if re.fullmatch(r"codegen(\.\w+)+", text)], []
    for node in nodes:
        called = ast.unparse(node.func).split(".")[-1] if isinstance(node, ast.Call) else ""
        if called in ("Deferred", "import_module", "__import__"):
            name = pattern(node.args[0])
            if name in ("", "codegen.*"):
                computed.append(ast.unparse(node))
            else:
                names.append(f"codegen.{name}" if called == "Deferred" else name)
    return names, computed


def pattern(node: ast.expr) -> str:
    """A string as it is written, with `*` where something is filled in; nothing where it is no string."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "*" for part in node.values)
    return ""


@cache
def named() -> dict[str, set[str]]:
    """The modules that each module of the package names by strings."""
    edges: dict[str, set[str]] = {}
    for name, path in paths().items():
        patterns = literals(path)[0]
        edges[name] = {other for other in paths() if any(fnmatchcase(other, p) for p in patterns)} - {name}
    return edges


@cache
def paths() -> dict[str, Path]:
    """The files of the package by the names of their modules."""
    found = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in found.items()}


def files(part: str) -> list[Path]:
    return [PACKAGE / f"{part}.py"] if (PACKAGE / f"{part}.py").exists() else sorted((PACKAGE / part).rglob("*.py"))


def part_of(name: str) -> str:
    """The folder, or the file beside the folders, in which a module of the package stands."""
    return [*name.split("."), "__init__"][1]


@cache
def graph(with_types: bool = False) -> dict[str, set[str]]:
    """The modules that each module of the package imports."""
    edges = {}
    for name, path in paths().items():
        seen = {n for n in imported(path, with_types) if n in paths()} - {name}
        # `from package import module` names both; what is meant is the module.
        edges[name] = {n for n in seen if not any(other.startswith(f"{n}.") for other in seen)}
    return edges


def test_no_circle_of_files():
    order = tuple(graphlib.TopologicalSorter(graph()).static_order())  # or CycleError, which names the files
    assert set(order) == set(graph())
    assert order.index("codegen.errors") < order.index("codegen.solving.compiler") < order.index("codegen.cli.solve")


def test_no_circle_of_files_by_their_annotations():
    """The package itself, whose names are imported when they are asked for, aside."""
    edges = {name: others - {"codegen"} for name, others in graph(with_types=True).items()}
    assert set(graphlib.TopologicalSorter(edges).static_order()) == set(graph()) | {"codegen"}


def test_every_part_has_its_floor():
    assert {part_of(name) for name in graph()} == {part for floor in FLOORS for part in floor}


@pytest.mark.parametrize("floor", range(len(FLOORS)))
def test_no_arrow_runs_back(floor):
    below = {part for lower in FLOORS[:floor] for part in lower}
    for name, others in graph().items():
        if part_of(name) in FLOORS[floor]:
            back = {other for other in others if part_of(other) not in {part_of(name), *below}}
            assert not back, f"{name} imports {', '.join(sorted(back))}"


def test_strings_name_modules_of_lower_floors_but_for_some():
    """Imports by strings, with which a part could use one of a higher floor unseen."""
    floor = {part: number for number, parts in enumerate(FLOORS) for part in parts}
    arrows = {(part_of(name), part_of(other)) for name, others in named().items() for other in others}
    back = {(part, other) for part, other in arrows if part != other and floor[other] >= floor[part]}
    assert back == set(BY_STRING)


def test_names_of_modules_are_literals_but_for_some():
    assert {part_of(name) for name, path in paths().items() if literals(path)[1]} == set(COMPUTED)


@pytest.mark.parametrize("part", NUMERIC)
def test_numeric_parts_never_import_sympy_or_symbolic_parts(part):
    forbidden = [f"codegen.{name}" for name in SYMBOLIC]
    for path in files(part):
        names = imported(path)
        assert not any(name.split(".")[0] == "sympy" for name in names), path
        assert not any(name == f or name.startswith(f + ".") for name in names for f in forbidden), (path, names)


@pytest.mark.parametrize("part", ["evidence/stress", "registration"])
def test_users_of_modules_import_no_sympy(part):
    for path in files(part):
        if path.stem != "problems":
            assert not any(name.split(".")[0] == "sympy" for name in imported(path)), path


def test_after_lowering_there_is_no_sympy():
    names = imported(PACKAGE / "emit/rendering.py") | imported(PACKAGE / "emit/lower/module.py")
    assert not any(name.split(".")[0] == "sympy" for name in names)


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import codegen", ("sympy", "numba", "scipy", "matplotlib")),
        ("import codegen.cli", ("sympy", "numba", "scipy", "matplotlib")),
        ("import codegen.solving.loading, codegen.solving.drivers", ("sympy",)),
        ("import codegen.solving.api", ("sympy", "scipy.interpolate")),
        ("import codegen.registration", ("sympy", "numba", "nibabel", "SimpleITK", "skimage")),
        pytest.param("import codegen.registration.app.server", ("sympy", "numba"), marks=pytest.mark.slow),
        pytest.param(
            "from codegen.evidence.report import gallery, landmark_study, page",
            ("sympy",),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_imports_at_run_time_stay_small(statement, absent):
    code = f"import sys; {statement}; print([m for m in {absent!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_generated_modules_import_the_runtime_alone():
    code = "import sys; from generated import orbital_transfer; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stderr
    modules = done.stdout.split()
    assert not {"sympy", "jinja2", "matplotlib"} & set(modules)  # numba itself imports scipy
    parts = {name.split(".")[1] for name in modules if name.startswith("codegen.")}
    assert parts == {"runtime"}


WITHOUT_EFFECT = {"deferred", "errors", "files"}
"""Parts that the stages of a build import although no text follows from them: messages and files."""


def test_the_key_of_the_cache_hashes_all_that_the_stages_import():
    """A changed generator must never serve the text of an older one."""
    hashed = {name.removesuffix(".py") for name in GENERATORS}
    assert all((PACKAGE / name).exists() for name in GENERATORS)
    stages = {name for name in graph() if name.split(".")[1:2] and part_of(name) in hashed}
    imported_parts = {part_of(other) for name in stages for other in graph()[name]} - {"__init__"}
    assert imported_parts - hashed == WITHOUT_EFFECT
