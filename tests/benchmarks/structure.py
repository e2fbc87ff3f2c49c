"""The structure of the package in numbers, and the way of a solve through its files.

    python tests/benchmarks/structure.py                  a row for each room: files, lines, functions, `Any`
    python tests/benchmarks/structure.py --way PROBLEM    files and changes of folder of a cold and of a warm solve
    python tests/benchmarks/structure.py --draw 20        docstrings and sentences of the guide, drawn at random

Counts of lines are exclusive: a line is blank, a comment, a part of a docstring, of an import, or code. A private
function counts as used once if its name occurs twice in its file. The way of a solve is counted by a profiler: Python
functions of the package only, in an empty cache for the cold solve.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "codegen"
sys.path.insert(0, str(ROOT))
KINDS = ("code", "docstring", "import", "blank", "comment")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def kinds_of_lines(text: str, tree: ast.Module) -> Counter[str]:
    """Return the number of lines of each kind."""
    kinds = ["code"] * len(text.splitlines())
    for number, line in enumerate(text.splitlines()):
        if not line.strip():
            kinds[number] = "blank"
        elif line.lstrip().startswith("#"):
            kinds[number] = "comment"
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            string = node.body[0]
            kinds[string.lineno - 1 : string.end_lineno] = ["docstring"] * (string.end_lineno - string.lineno + 1)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            kinds[node.lineno - 1 : node.end_lineno] = ["import"] * (node.end_lineno - node.lineno + 1)
    return Counter(kinds)


def measures(path: Path) -> Counter[str]:
    """Return the numbers of one file."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    row = kinds_of_lines(text, tree)
    row["files"], row["lines"] = 1, len(text.splitlines())
    row["functions"] = sum(isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) for node in ast.walk(tree))
    row["Any"] = sum(bool(re.search(r"\bAny\b", line)) for line in text.splitlines())
    for function in tree.body:
        if isinstance(function, ast.FunctionDef) and function.name.startswith("_"):
            row["used once"] += len(re.findall(rf"\b{function.name}\b", text)) == 2
    return row


def rooms() -> dict[str, list[Path]]:
    """Return the files of each room; files directly in the package are one room."""
    found: dict[str, list[Path]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).parts
        found.setdefault(parts[0] if len(parts) > 1 else "(next to the rooms)", []).append(path)
    return found


def show_structure(console: Console) -> None:
    """Print a row for each room, and the sum."""
    headings = ("files", "lines", *KINDS, "functions", "per 1000", "used once", "Any", "longest")
    table = Table("room", *headings, title="Structure of the package", title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    total, longest = Counter[str](), 0
    for room, paths in rooms().items():
        rows = [measures(path) for path in paths]
        row = sum(rows, Counter[str]())
        most = max(each["lines"] for each in rows)
        total, longest = total + row, max(longest, most)
        table.add_row(room, *cells(row, most))
    table.add_section()
    table.add_row("all", *cells(total, longest))
    console.print(table)


def cells(row: Counter[str], longest: int) -> list[str]:
    """Return the texts of a row."""
    share = f"{1000 * row['functions'] / row['lines']:.0f}"
    counts = [str(row[key]) for key in ("files", "lines", *KINDS, "functions")]
    return [*counts, share, str(row["used once"]), str(row["Any"]), str(longest)]


def show_way(console: Console, problem: Path) -> None:
    """Print the files, the functions and the changes of folder of a cold and of a warm solve."""
    os.environ["CODEGEN_CACHE_DIR"] = tempfile.mkdtemp()
    import codegen

    table = Table("solve", "functions", "files", "changes of folder", title=f"Way of a solve of {problem.stem}")
    table.add_row("cold", *map(str, profiled(lambda: codegen.solve(problem))))
    solver = codegen.compile(problem)
    solver.solve()
    table.add_row("warm", *map(str, profiled(solver.solve)))
    console.print(table)


def profiled(run: Callable[[], object]) -> tuple[int, int, int]:
    """Run a function; return the numbers of functions and files of the package, and of changes of folder."""
    functions, files, folders = set[object](), set[str](), list[str]()

    def follow(frame, event, _argument) -> None:
        code = frame.f_code
        if event != "call" or code.co_name == "<module>" or not code.co_filename.startswith(str(PACKAGE)):
            return
        functions.add(code)
        files.add(code.co_filename)
        folder = os.path.dirname(code.co_filename)
        if not folders or folders[-1] != folder:
            folders.append(folder)

    sys.setprofile(follow)
    try:
        run()
    finally:
        sys.setprofile(None)
    return len(functions), len(files), len(folders)


def show_draw(console: Console, number: int, seed: int) -> None:
    """Print docstrings and sentences of the guide, drawn at random, for a reader who does not know the project."""
    sys.path.insert(0, str(ROOT / "docs"))
    from prose import prose_of

    drawn = random.Random(seed)
    for name, docstring in drawn.sample(list(docstrings()), number):
        console.print(f"[bold]{name}[/]", highlight=False)
        console.print(f"{docstring}\n", markup=False, highlight=False)
    pages = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs" / "guide").glob("*.md"))]
    sentences = [sentence for page in pages for sentence in prose_of(page).sentences]
    for sentence in drawn.sample(sentences, number):
        console.print(f"- {sentence}", markup=False, highlight=False)


def docstrings() -> Iterator[tuple[str, str]]:
    """Yield the file, the name and the docstring of every function and class."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, DOCUMENTED[1:]) and (text := ast.get_docstring(node)):
                names = [each.arg for each in node.args.args] if isinstance(node, ast.FunctionDef) else []
                yield f"{path.relative_to(ROOT)}: {node.name}({', '.join(names)})", text


def main() -> None:
    """Print what the options ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--way", type=Path, metavar="PROBLEM", help="count the way of a solve of a problem file")
    parser.add_argument("--draw", type=int, metavar="N", help="draw N docstrings and N sentences of the guide")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw")
    options = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 150)
    if options.way is not None:
        show_way(console, options.way)
    elif options.draw is not None:
        show_draw(console, options.draw, options.seed)
    else:
        show_structure(console)


if __name__ == "__main__":
    main()
