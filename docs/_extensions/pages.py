"""Pages that are made before Sphinx reads: the gallery from problem files and records, commands from their parsers."""

from __future__ import annotations

import hashlib
import inspect
import json
import re
from enum import Enum
from pathlib import Path
from typing import Any

import benchmarks
import thesis_page
from references import PROBLEMS, ROOT, STORED, Known, digest, known_of, misses, problem_files
from signature import page_of, text
from speed import read_speed, speed_section
from sphinx.errors import ExtensionError
from sphinx.util import logging

logger = logging.getLogger(__name__)
DOCS = ROOT / "docs"


def write(path: Path, text: str) -> None:
    """Write a page if it has changed, since Sphinx reads by times of files."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


# The gallery.


def read_record(path: Path) -> dict[str, Any] | None:
    """What `docs/record.py` has put down for a problem, if anything; a warning where it belongs to another file."""
    record = STORED / f"{path.stem}.json"
    if not record.exists():
        return None
    read: dict[str, Any] = json.loads(record.read_text(encoding="utf-8"))
    if read["digest"] != digest(path):
        logger.warning("%s has changed since it was recorded; run: python docs/record.py", path.name)
    return read


def mathematics(path: Path) -> str:
    """The problem as its author wrote it, in LaTeX, between the signs of formulas."""
    from codegen.problem.sources import ProblemFile
    from codegen.show.notebook import displayed

    return displayed(ProblemFile(path).written({})[1])


def gallery_page(path: Path, record: dict[str, Any] | None) -> str:
    """One problem: mathematics, file, command, and, where it is recorded, the solution beside what is known of it."""
    title, rest = parts_of_docstring(path)
    place = path.relative_to(ROOT).as_posix()
    return "\n".join(
        [
            f"# {title}\n\n`{place}`\n",
            *([f"```{{code-block}} text\n:class: plain\n\n{rest}\n```\n"] if rest else []),
            f"{mathematics(path)}\n",
            f"## The file\n\n```{{literalinclude}} ../../{place}\n:language: python\n```\n",
            f"## The solution\n\n```text\ncodegen solve {place} --plot {path.stem}.png\n```\n",
            *(solution_section(path, title, record) if record else known_section(path)),
            "",
            *speed_section(path),
        ]
    )


def solution_section(path: Path, title: str, record: dict[str, Any]) -> list[str]:
    """Numbers, figure, and where they were found."""
    solution, own = record["solution"], record["machine"]
    numbers = [
        ("status", solution["status"]),
        ("discretisation", f"{solution['method']}, {solution['scheme']}, {solution['intervals']}"),
        *([("cost", f"{solution['cost']:.12g}")] if solution["cost"] is not None else []),
        ("iterations", solution["iterations"]),
        ("largest residual", f"{solution['residual']:.1e}"),
        ("time of a warm solve", f"{1e3 * solution['seconds']:.3g} ms"),
    ]
    return [
        "| quantity | value |\n|---|---|",
        *(f"| {name} | {value} |" for name, value in numbers),
        "",
        f"```{{image}} stored/{path.stem}.png",
        f":alt: {record.get('text') or words_of_figure(path, title)}",
        ":class: figure-card\n:loading: lazy\n```\n",
        *film_section(path, title, record),
        *values_section(path, record),
        f"Recorded on {record['date']} with codegen {record['version']}, Python {own['python']}, numba {own['numba']} "
        f"and numpy {own['numpy']}, on {own['processors']} cores of {own['processor']} that did other work as well; "
        "the time is the least of three solves.",
    ]


def words_of_figure(path: Path, title: str) -> str:
    """What a figure shows whose record has no words: its quantities, as the problem declares them."""
    from codegen.problem.description import quantities_in
    from codegen.problem.sources import ProblemFile
    from codegen.problem.symbols import ControlInput, Coordinate, State

    found = quantities_in(ProblemFile(path).written({})[1])
    shown = {
        "over time": [one.name for one in found if isinstance(one, (Coordinate, State))],
        "controls": [one.name for one in found if isinstance(one, ControlInput)],
    }
    parts = [f"{what} {', '.join(names)}" for what, names in shown.items() if names]
    return f"Figure of the solution of {path.stem}. {title}. Shown: {'; '.join(parts)}"


def film_section(path: Path, title: str, record: dict[str, Any]) -> list[str]:
    """The film, which can be closed, and a still picture in its place for readers who want nothing to move."""
    film = record.get("film")
    if not film:
        return []
    shown = f"{title}. Shown: {', '.join(film['shows'])}"
    return [
        "```{raw} html\n<details open><summary>Film</summary>\n```\n",
        f"```{{image}} stored/{path.stem}.gif\n:alt: Film from t = 0 to {film['until']:.4g}. {shown}\n"
        ":class: film\n:loading: lazy\n```\n",
        f"```{{image}} stored/{path.stem}.still.png\n:alt: The last frame of the film. {shown}\n"
        ":class: still\n:loading: lazy\n```\n",
        f"```text\ncodegen solve {path.relative_to(ROOT).as_posix()} --animate {path.stem}.gif\n```\n",
        "```{raw} html\n</details>\n```\n",
    ]


def known_section(path: Path) -> list[str]:
    """What is known of a problem whose solution is not on record."""
    rows = [f"| `{known.title}` | {known.value:.11g} | {known.source} |" for known in known_of(path.stem)]
    table = ["| options | known | source |", "|---|---|---|", *rows] if rows else []
    return ["The solution and its figure are not on record here yet.", "", *table]


def values_section(path: Path, record: dict[str, Any]) -> list[str]:
    """A table of computed beside known values; a value that misses fails the build."""
    known_values = known_of(path.stem)
    if not known_values:
        return ["No value from elsewhere is on record for this problem.", ""]
    cases = {case["of"]: case for case in record["cases"]}
    rows = []
    for known in known_values:
        if known.title not in cases:
            raise ExtensionError(f"{path.stem} {known.title} has no record; run: python docs/record.py {path.stem}")
        case = cases[known.title]
        if why := misses(known, case):
            raise ExtensionError(f"{path.stem}, {known.title}, {why}")
        computed = known.factor * case["cost"]
        other = "" if known.optimum is None else f"{known.optimum:.11g}"
        other += " (a higher local optimum)" if known.is_lower else ""
        rows.append(
            f"| `{known.title}` | {computed:.11g} | {other} | {known.value:.11g} | {abs(computed - known.value):.1e} "
            f"| {known.allowed:.1e} | {known.source}{remark(known)} |"
        )
    return [
        "## Beside what is known",
        "",
        "| options | this value | CasADi and IPOPT, same discrete problem | known | distance | at most | source |",
        "|---|---|---|---|---|---|---|",
        *rows,
        "",
    ]


def remark(known: Known) -> str:
    """What a reader must know of a value that does not agree."""
    if known.status != "solved":
        return f"; **not solved** with default options: {known.status}"
    return f"; **differs**: {known.differs}" if known.differs else ""


def parts_of_docstring(path: Path) -> tuple[str, str]:
    """The first line, and the rest, of a problem file's docstring, whose paragraphs become lines but for tables."""
    import ast

    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or path.stem
    first, _, rest = text.partition("\n")
    paragraphs = [each if "\n " in each else " ".join(each.split("\n")) for each in rest.strip().split("\n\n")]
    return first.rstrip("."), "\n\n".join(paragraphs)


def gallery(stamp: str) -> None:
    """A page for each problem, and their list."""
    cards: dict[str, list[str]] = {"": [], "published": []}
    for path in problem_files():
        record = read_record(path)
        page = DOCS / "gallery" / f"{path.stem}.md"
        figures = [case for case in read_speed().values() if case["problem"] == path.stem]
        mark = hashlib.sha256((stamp + digest(path) + json.dumps([record, figures])).encode()).hexdigest()[:16]
        comment = f"% made by docs/_extensions/pages.py: {mark}"
        if not page.exists() or page.read_text(encoding="utf-8").partition("\n")[0] != comment:
            write(page, f"{comment}\n{gallery_page(path, record)}")
        title, _ = parts_of_docstring(path)
        cards[path.parent.name if path.parent != PROBLEMS else ""].append(card(path.stem, title, record is not None))
    pages = [path.stem for path in problem_files()]
    for stale in (DOCS / "gallery").glob("*.md"):
        if stale.stem not in {"index", *pages}:
            stale.unlink()
    front = (DOCS / "gallery" / "index.in").read_text(encoding="utf-8")
    write(
        DOCS / "gallery" / "index.md",
        front.replace("@OWN@", "\n".join(cards[""])).replace("@PUBLISHED@", "\n".join(cards["published"]))
        + "\n```{toctree}\n:hidden:\n\n" + "\n".join(f"{name} <{name}>" for name in pages) + "\n```\n",
    )  # fmt: skip


def card(name: str, title: str, has_figure: bool) -> str:
    """A figure with a link and a title, or these alone."""
    if not has_figure:
        return f":::{{container}} card\n[{name}]({name}.md): {title}\n:::"
    alternative = f"Figure of the solution of {name}. {title}".replace('"', "'")
    return (
        f':::{{figure}} stored/{name}.png\n:alt: "{alternative}"\n:loading: lazy\n:figclass: card\n\n'
        f"[{name}]({name}.md): {title}\n:::"
    )


# Commands.


def commands() -> str:
    """All commands with their options, as their parsers have them."""
    import typer

    from codegen.cli import main

    group: Any = typer.main.get_command(main)
    lines = [
        "# Command line",
        "",
        "Made from the parsers of the program itself; `codegen COMMAND --help` says the same. What the commands are "
        "for is told in [Commands](../guide/commands.md).",
        "",
    ]
    for name, command in group.commands.items():
        lines += [f"## codegen {name}", "", inspect.cleandoc(command.help or ""), "", *options_of(command)]
    return "\n".join(lines)


def options_of(command: Any) -> list[str]:
    """A definition list of a command's arguments and options."""
    lines = []
    for own in command.params:
        if getattr(own, "hidden", False) or "--help" in own.opts:
            continue
        is_flag = getattr(own, "is_flag", False)
        is_argument = own.param_type_name == "argument"
        metavar = own.metavar or own.name.upper() if is_argument else own.metavar or choices(own)
        names = [metavar] if is_argument else [*own.opts, *own.secondary_opts]
        term = ", ".join(f"`{each}`" for each in names) + ("" if is_flag or is_argument else f" `{metavar}`")
        default = own.default
        is_said = isinstance(default, (str, int, float)) and not isinstance(default, bool) and default != ""
        tail = f" Unless said: `{getattr(default, 'value', default)}`." if is_said else ""
        lines += [term, f": {(own.help or '').strip() or 'See above.'}{tail}", ""]
    return lines


def choices(own: Any) -> str:
    """What an option takes: the members of its kind, or a value."""
    return "|".join(str(each.value) for each in type(own.default)) if isinstance(own.default, Enum) else "VALUE"


# The objects of the reference.


_RESULT = "solving.results.result:Result"


def object_pages() -> dict[str, str]:
    """Return a page for each section of `reference/python.md`, by the name of the object, and the index of all."""
    whole = (DOCS / "reference" / "python.md").read_text(encoding="utf-8")
    sections = re.split(r"^### (.+)\n", re.sub(r"^## .*\n", "", whole, flags=re.MULTILINE), flags=re.MULTILINE)[1:]
    pages, rows = {}, []
    for title, section in zip(sections[::2], sections[1::2], strict=True):
        name = {"Results": "Result"}.get(title, title)
        body = section.replace("```{code-cell} ipython3", "```python").replace("#### ", "## ")
        body = re.sub(r"^(```\{signature\} .+)$", r"\1\n:full:", body, flags=re.MULTILINE)
        body = body.replace("](../", "](../../").replace("](#", "](../python.md#")
        pages[page_of(name)] = f"# {name}\n{body}\n[Run the example](../python.md#{title.lower()})\n"
        docstring = text(_RESULT if name == "Result" else name)
        rows.append(f"| [`{name}`]({page_of(name)}.md) | {docstring.partition(chr(10))[0]} |")
    names = "\n".join(sorted(pages, key=str.lower))
    table = "\n".join(["| name | |", "|---|---|", *sorted(rows, key=str.lower)])
    pages["index"] = f"# Objects\n\n{table}\n\n```{{toctree}}\n:hidden:\n\n{names}\n```\n"
    return pages


def make(app: Any) -> None:
    """Write all pages that are made."""
    makers = [
        *Path(__file__).parent.glob("*.py"),
        *(ROOT / "codegen/show").glob("notebook_*.py"),
        ROOT / "codegen/identifiers.py",
    ]
    gallery(hashlib.sha256(b"".join(path.read_bytes() for path in sorted(makers))).hexdigest())
    write(DOCS / "reference" / "commands.md", commands())
    for name, page in object_pages().items():
        write(DOCS / "reference" / "objects" / f"{name}.md", page)
    write(DOCS / "benchmarks.md", benchmarks.page())
    write(DOCS / "thesis.md", thesis_page.page())


def setup(app: Any) -> dict[str, bool]:
    """Make pages before any is read."""
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
