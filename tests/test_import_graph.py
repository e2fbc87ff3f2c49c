"""The direction of dependence between the parts, and what each entry point must not import."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "codegen"

# From author to renderer, then from the file on disk to its users; a part may import what stands before it.
SYMBOLIC = ["errors", "symbols", "drawing", "problem", "points", "pairwise", "expressions", "model", "redundancy",
            "legendre", "schemes", "discretise", "transcribe", "derive", "lower", "emit", "verify",
            "problem_file", "compiler"]  # fmt: skip
NUMERIC = ["errors", "drawing", "points", "loading", "drivers"]


def imported(path: Path) -> set[str]:
    """Absolute names of the codegen modules that a file imports at run time, type-checking blocks aside."""
    names = set()
    tree = ast.parse(path.read_text())
    skipped = {id(n) for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
               for n in ast.walk(node)}  # fmt: skip
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def files(part: str) -> list[Path]:
    return [PACKAGE / f"{part}.py"] if (PACKAGE / f"{part}.py").exists() else sorted((PACKAGE / part).rglob("*.py"))


@pytest.mark.parametrize("part", SYMBOLIC)
def test_symbolic_parts_import_only_what_stands_before_them(part):
    later = SYMBOLIC[SYMBOLIC.index(part) + 1 :]
    later = [name for name in later if not (part == "emit" and name == "problem_file")]
    for path in files(part):
        for name in imported(path):
            assert not any(name == f"codegen.{other}" or name.startswith(f"codegen.{other}.") for other in later), (
                f"{path.name} imports {name}"
            )


@pytest.mark.parametrize("part", ["drawing", "loading", "drivers", "runtime", "plots", "animate"])
def test_numeric_parts_never_import_sympy_or_symbolic_parts(part):
    forbidden = [f"codegen.{name}" for name in SYMBOLIC if name not in NUMERIC]
    for path in files(part):
        names = imported(path)
        assert not any(name.split(".")[0] == "sympy" for name in names), path
        assert not any(name == f or name.startswith(f + ".") for name in names for f in forbidden), (path, names)


@pytest.mark.parametrize("part", ["stress", "registration"])
def test_users_of_modules_import_no_sympy(part):
    for path in files(part):
        if path.parent.name != "problems":
            assert not any(name.split(".")[0] == "sympy" for name in imported(path)), path


def test_after_lowering_there_is_no_sympy():
    names = imported(PACKAGE / "emit.py") | imported(PACKAGE / "lower" / "module.py")
    assert not any(name.split(".")[0] == "sympy" for name in names)


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import codegen", ("sympy", "numba", "scipy", "matplotlib")),
        ("import codegen.cli", ("sympy", "numba", "scipy", "matplotlib")),
        ("import codegen.loading, codegen.drivers", ("sympy",)),
        ("import codegen.registration", ("sympy", "numba", "nibabel", "SimpleITK", "skimage")),
        ("import codegen.registration.app.server", ("sympy", "numba")),
        ("import codegen.report.study, codegen.report.page, codegen.report.gallery", ("sympy",)),
        ("from generated import orbital_transfer", ("sympy", "codegen", "matplotlib")),  # numba itself imports scipy
    ],
)
def test_imports_at_run_time_stay_small(statement, absent):
    code = f"import sys; {statement}; print([m for m in {absent!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
