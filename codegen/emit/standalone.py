"""Standalone modules: one file with a generated module and the numerics of `codegen.runtime` that the module uses.

The used statements of the runtime's files are copied unchanged, except for imports of the package. A name that two
files define is renamed in the later file. The result imports numpy, numba and the standard library.
"""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib import resources

from codegen.emit.rendering import signed
from codegen.runtime.kkt.shape import Shape

RUNTIME = "codegen.runtime"
_LINKING = '''"""Functions that only compiled functions call are compiled as all others."""


def link_inner_functions(functions):
    """Do nothing: what the package does here, to compile faster, takes parts of numba that are not public."""
'''
_SYSTEM = '''"""The linear system of this problem, the numbers of whose shape are constants."""

from functools import lru_cache

from codegen.runtime.addresses import SYSTEM, entry_of
from codegen.runtime.kkt.system import solve_system
from codegen.runtime.kernels import packed_operations


@lru_cache(maxsize=1)
def compiled_system(shape):
    """Return the compiled function, which has the address; all grids of this problem have one `shape`."""

    def system(
        is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    ):  # fmt: skip
        """Factor the KKT matrix if it `is_new`, and solve for the step if it `is_wanted`; see `solve_system`."""
        return solve_system(
            is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
            is_wanted,
        )  # fmt: skip

    with packed_operations():
        return entry_of(SYSTEM, system)
'''
_KEPT_CODE = '''"""Machine code that numba keeps beside this file, and makes anew when the file has changed."""

from collections import Counter
from typing import Any, NamedTuple

from numba import njit


class Statistics(NamedTuple):
    """The folder of the machine code of a function, and the numbers of reads and compilations by signature."""

    cache_path: str | None
    cache_hits: Counter[Any]
    cache_misses: Counter[Any]


def statistics_of(function, compiled):
    """Return the statistics of a function and of what `cfunc` has made of it, or None if it was not compiled."""
    read, made = Counter(), Counter()
    if hasattr(compiled, "cache_hits"):
        (read if compiled.cache_hits else made)[str(compiled.native_name)] += 1
    return Statistics(njit(cache=True)(function).stats.cache_path, read, made)


def start_of(function):
    """Return the start of the names of files in which numba keeps machine code of a function: none is of interest."""
    return ""


def fresh_folder(file, identity):
    """Do nothing: all that becomes part of functions in this file is in this file."""


def add_checksums(folder, start):
    """Do nothing: machine code of this file is kept as numba keeps it."""
'''
_NO_STAGES = '''"""There are no stages to be eliminated."""

from numba import njit

HAS_STAGES = False
eliminate_stages = reduce_right = recover_stages = None


@njit(error_model="numpy")
def stage_views(tables, reals, integers, bodies, body, steps):
    """Return nothing: there are no stages."""
    return None, None


def stage_sizes(shape, copied, bodies, steps):
    """Return the lengths of no storage."""
    return 0, 0
'''
_HEADER = """#
# Standalone: the problem comes last, behind the numerics that it uses. The file imports numpy, numba and the standard
# library, and runs where codegen is not installed. A first call compiles all of it, which takes about a minute, and
# keeps the machine code in __pycache__; `nlp` needs scipy for sparse matrices.
"""


def bundle(text: str) -> str:
    """Return the text of a standalone module, made from the text of an ordinary one."""
    if "\nQUANTITIES = " in text:
        # Sensitivities need the linear system with stages, and a standalone module has one linear system.
        text = re.sub(r"^    shooting=Shooting\(.*\),\n", "", text, flags=re.MULTILINE)
    module = File("", text)
    files: dict[str, File] = {}

    def file_of(name: str) -> File:
        if name not in files:
            files[name] = File(name, _numerics(name, text))
        return files[name]

    wanted, waiting = set[tuple[str, str]](), [r.target for b in module.blocks for r in b.references]
    waiting += [target for target in module.bound.values() if not target.external and target.file]
    while waiting:
        target = waiting.pop()
        if target.external or not target.file or (target.file, target.name) in wanted:
            continue
        file = file_of(target.file)
        assert file.bound.get(target.name) == target, f"{target.file} does not define {target.name}"
        for block in file.blocks:
            if target.name in block.names:
                wanted |= {(target.file, name) for name in block.names}
                waiting += [reference.target for reference in block.references]
    order: list[str] = []

    def add(name: str, above: tuple[str, ...]) -> None:
        if name in order or name in above:
            return
        references = [reference for block in files[name].kept(wanted) for reference in block.references]
        used = {r.target.file for r in references if not r.target.external and r.target.file}
        for other in sorted(used - {name}):
            add(other, (*above, name))
        order.append(name)

    for name in sorted({file for file, _ in wanted}):
        add(name, ())
    names = _new_names(module, order, wanted, files)
    parts = []
    for name in order:
        file, before = files[name], None
        title = f"# ---- {name.removeprefix(RUNTIME + '.').replace('.', '/')}.py ----"
        summary = textwrap.wrap(file.summary, 118, initial_indent="# ", subsequent_indent="# ")
        parts.append("\n".join([title, "#", *summary]))
        for block in file.kept(wanted):
            # No empty lines separate adjacent assignments.
            pair = [file.statement(b) for b in (before, block) if b is not None]
            is_close = len(pair) == 2 and all(isinstance(node, (ast.Assign, ast.AnnAssign)) for node in pair)
            parts.append(("" if is_close else "\n" if before is None else "\n\n") + _rewritten(file, block, names))
            before = block
        parts.append("\n")
    numerics, imports = "\n".join(parts).rstrip(), _imports([module, *(files[name] for name in order)], wanted)
    statements = [node for node in module.tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    header = "\n".join(module.lines[: statements[0].lineno - 1]).rstrip()
    comments, quotes, docstring = header.partition('\n"""')
    comments = re.sub(r"(by: codegen build .*)", r"\1 --standalone", comments, count=1)
    last = max(node.end_lineno or 0 for node in statements)
    rest = Block(last + 1, len(module.lines), (), [r for block in module.blocks for r in block.references])
    problem = _rewritten(module, rest, names).strip("\n")
    header = f"{comments}\n{_HEADER.rstrip()}{quotes}{docstring}\n\n{imports}\n\n"
    whole = f"{header}{numerics}\n\n\n# ---- The problem ----\n\n{problem}\n"
    whole = re.sub(r"`codegen\.runtime\.[\w.]*?(\w+)`", r"`\1`", whole)
    return signed(re.sub(r"\n{4,}", "\n\n\n", whole))


@dataclass(frozen=True)
class Target:
    """The object that a name refers to: a definition in a file, a whole file (empty `name`), or an external import."""

    file: str
    name: str = ""
    external: str = ""
    """The import statement, or the name in it, of an object from another package; else empty."""


@dataclass(frozen=True)
class Reference:
    """An occurrence of a name in a file, by line and columns (in bytes), and the object that the name refers to."""

    line: int
    start: int
    end: int
    target: Target


@dataclass
class Block:
    """A top-level statement that defines `names`: lines `first` (with comments above) to `last` (with a docstring)."""

    first: int
    last: int
    names: tuple[str, ...]
    references: list[Reference] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)
    """Numbers of lines that are left out: imports of the package inside functions."""


class File:
    """The top-level statements of one file, and the objects to which its names are `bound`."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.lines = name, text.splitlines()
        self.tree = ast.parse(text)
        nodes = list(ast.walk(self.tree))
        self.identifiers = {n.id for n in nodes if isinstance(n, ast.Name)}
        self.identifiers |= {n.arg for n in nodes if isinstance(n, ast.arg)}
        self.summary = " ".join((ast.get_docstring(self.tree) or "").partition("\n\n")[0].split())
        self.blocks: list[Block] = []
        self.bound: dict[str, Target] = {}
        for node in self.tree.body:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                self.bound |= _bindings(node)
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                if self.blocks:  # the description of the assignment above
                    self.blocks[-1].last = node.end_lineno or 0
            else:
                decorators = getattr(node, "decorator_list", [])
                first = min([node.lineno, *(decorator.lineno for decorator in decorators)])
                while first > 1 and self.lines[first - 2].startswith("#"):
                    first -= 1
                names = [node.name] if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else []
                targets = getattr(node, "targets", [node.target] if isinstance(node, ast.AnnAssign) else [])
                names += [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
                self.blocks.append(Block(first, node.end_lineno or 0, tuple(names)))
        defined = {name for block in self.blocks for name in block.names}
        self.bound |= {name: Target(self.name, name) for name in defined}
        for block in self.blocks:
            _Names(self, block).visit_top()

    def statement(self, block: Block) -> ast.stmt:
        """Return the syntax tree of a block."""
        return next(node for node in self.tree.body if block.first <= node.lineno <= block.last)

    def kept(self, wanted: set[tuple[str, str]]) -> list[Block]:
        """Return the blocks that define at least one of the `wanted` pairs (file, name)."""
        return [block for block in self.blocks if any((self.name, name) in wanted for name in block.names)]


def _bindings(node: ast.Import | ast.ImportFrom) -> dict[str, Target]:
    """Return the names that an import statement binds, with the objects that they refer to."""
    targets = {}
    for alias in node.names:
        name, renamed = alias.asname or alias.name.partition(".")[0], f" as {alias.asname}" if alias.asname else ""
        if isinstance(node, ast.Import):
            targets[name] = Target("", name, f"import {alias.name}{renamed}")
        elif (node.module or "").startswith(RUNTIME):
            is_file = f"{node.module}.{alias.name}" in _runtime_files()
            targets[name] = Target(f"{node.module}.{alias.name}") if is_file else Target(str(node.module), alias.name)
        elif node.module != "__future__":
            targets[name] = Target(str(node.module), name, f"{alias.name}{renamed}")
    return targets


@cache
def _runtime_files() -> dict[str, str]:
    """Return the text of each file of the runtime, by module name."""
    texts = {}

    def collect(folder: resources.abc.Traversable, name: str) -> None:
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
            if entry.is_dir() and not entry.name.startswith("_"):
                collect(entry, f"{name}.{entry.name}")
            elif entry.name.endswith(".py") and entry.name != "__init__.py":
                texts[f"{name}.{entry.name[:-3]}"] = entry.read_text(encoding="utf-8")

    collect(resources.files(RUNTIME), RUNTIME)
    return texts


class _Names(ast.NodeVisitor):
    """A visitor that adds to a block its references, which are all names except arguments and local names."""

    def __init__(self, file: File, block: Block) -> None:
        self.file, self.block, self.scopes = file, block, list[set[str]]()
        self.imported: list[dict[str, Target]] = []

    def visit_top(self) -> None:
        node = self.file.statement(self.block)
        self.visit(node)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            match = re.match(r"\s*(async def|def|class)\s+", self.file.lines[node.lineno - 1])
            assert match is not None, "a definition begins its line"
            start = len(match[0].encode())
            self._add(node.lineno, start, start + len(node.name.encode()), node.name)

    def _add(self, line: int, start: int, end: int, name: str) -> None:
        target = self._target(name)
        if target is not None:
            self.block.references.append(Reference(line, start, end, target))

    def _target(self, name: str) -> Target | None:
        """Return the object that a name refers to, or None for local names and Python's built-in names."""
        if any(name in scope for scope in self.scopes):
            return None
        return next((bound[name] for bound in self.imported if name in bound), self.file.bound.get(name))

    def visit_Name(self, node: ast.Name) -> None:
        self._add(node.lineno, node.col_offset, node.end_col_offset or 0, node.id)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        target = self._target(node.value.id) if isinstance(node.value, ast.Name) else None
        if target is None or target.name:
            self.generic_visit(node)
        else:  # the attribute is a name in another file
            position = node.lineno, node.col_offset, node.end_col_offset or 0
            self.block.references.append(Reference(*position, Target(target.file, node.attr)))

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        arguments = node.args
        annotations = [a.annotation for a in ast.walk(arguments) if isinstance(a, ast.arg) and a.annotation]
        for part in (*node.decorator_list, *arguments.defaults, *filter(None, arguments.kw_defaults), *annotations):
            self.visit(part)
        if node.returns:
            self.visit(node.returns)
        self._inside({a.arg for a in ast.walk(arguments) if isinstance(a, ast.arg)} | _locals(node.body), node.body)

    def visit_Lambda(self, node: ast.Lambda) -> None:
        for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
            self.visit(default)
        self._inside({a.arg for a in ast.walk(node.args) if isinstance(a, ast.arg)}, [node.body])

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for part in (*node.decorator_list, *node.bases):
            self.visit(part)
        own = _locals(node.body)
        for statement in node.body:
            # Names that a class defines are visible in its body, but not inside its methods.
            if isinstance(statement, ast.FunctionDef):
                self.visit(statement)
            else:
                self._inside(own, [statement])

    def _visit_comprehension(self, node: ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp) -> None:
        targets = {n.id for g in node.generators for n in ast.walk(g.target) if isinstance(n, ast.Name)}
        self.visit(node.generators[0].iter)
        rest = [*(g.iter for g in node.generators[1:]), *(test for g in node.generators for test in g.ifs)]
        values = [node.key, node.value] if isinstance(node, ast.DictComp) else [node.elt]
        self._inside(targets, [*rest, *values])

    visit_ListComp = visit_SetComp = visit_DictComp = visit_GeneratorExp = _visit_comprehension

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if (node.module or "").startswith(RUNTIME):
            self.imported.append(_bindings(node))
            self.block.dropped += range(node.lineno, (node.end_lineno or 0) + 1)

    def _inside(self, names: set[str], nodes: Sequence[ast.AST]) -> None:
        self.scopes.append(names)
        for node in nodes:
            self.visit(node)
        self.scopes.pop()


_SCOPES = (ast.FunctionDef, ast.ClassDef, ast.Lambda, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
"""Syntax nodes that have a scope of their own."""


def _locals(body: list[ast.stmt]) -> set[str]:
    """Return the local names of a function or class body, without names local to inner scopes."""
    names, waiting = set[str](), list[ast.AST](body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.ExceptHandler) and node.name:
            names.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)) and not getattr(node, "module", "").startswith(RUNTIME):
            names |= {alias.asname or alias.name.partition(".")[0] for alias in node.names}
        if not isinstance(node, _SCOPES):
            waiting += ast.iter_child_nodes(node)
    return names


def _numerics(name: str, text: str) -> str:
    """Return the source of runtime file `name`, or its replacement in the standalone form of module `text`."""
    folder, _, stem = name.rpartition(".")
    if name == f"{RUNTIME}.linking":
        return _LINKING
    if name == f"{RUNTIME}.kept_code":
        return _KEPT_CODE
    if folder != f"{RUNTIME}.kkt":
        return _runtime_files()[name]
    if stem == "specialised":
        return _SYSTEM
    shape = _shape_of(text)
    if stem == "stages" and not shape.stages:
        return _NO_STAGES
    # Functions of the linear system read a global constant `shape` instead of an argument.
    numerics = _runtime_files()[name]
    lines, tree = numerics.splitlines(), ast.parse(numerics)
    for node in reversed(tree.body):
        if isinstance(node, ast.FunctionDef) and node.name not in ("factor_sizes", "stage_sizes"):
            part = slice(node.lineno - 1, node.end_lineno)
            lines[part] = re.sub(r"\bshape,\s+|(?<=\()shape(?=\))", "", "\n".join(lines[part])).splitlines()
        elif isinstance(node, ast.ClassDef):
            lines.insert(node.end_lineno or 0, f"\n\nshape = Shape({', '.join(map(str, shape))})")
    if stem != "shape":
        lines.insert(tree.body[0].end_lineno or 0, f"from {RUNTIME}.kkt.shape import shape")
    return "\n".join(lines) + "\n"


@lru_cache(maxsize=1)
def _shape_of(text: str) -> Shape:
    """Return the shape of a module's linear system; this executes the module, but compiles no kernel."""
    values: dict[str, object] = {"__name__": "standalone"}
    exec(compile(text, "<module>", "exec"), values)
    shape: Shape = values["problem"].searched.structure.shape  # type: ignore[attr-defined]
    return shape


def _new_names(
    module: File, order: list[str], wanted: set[tuple[str, str]], files: Mapping[str, File]
) -> dict[tuple[str, str], str]:
    """Return the new name of each definition (file, name): the old name, unless an earlier file defines the same."""
    names = {(t.file, t.name): name for name, t in module.bound.items() if t.file and not t.external and t.name}
    taken, identifiers = set(module.bound), set[str]()
    for file in (module, *(files[name] for name in order)):
        taken |= {name for name, target in file.bound.items() if target.external}
        identifiers |= file.identifiers
    for name in order:
        for old in (n for block in files[name].blocks for n in block.names if (name, n) in wanted):
            if (name, old) in names:
                continue
            new, stem = old, name.rpartition(".")[2]
            if new in taken:
                new = f"_{stem}{old}" if old.startswith("_") else f"{stem}_{old}"
                assert new not in taken | identifiers, (
                    f"{new} means something else already, in place of {old} of {name}"
                )
            names[name, old] = new
            taken.add(new)
    return names


def _rewritten(file: File, block: Block, names: Mapping[tuple[str, str], str]) -> str:
    """Return the text of a block with new names, by (file, name), and without imports of the package in functions."""
    lines = {number: file.lines[number - 1].encode() for number in range(block.first, block.last + 1)}
    for reference in sorted(set(block.references), key=lambda r: (r.line, r.start), reverse=True):
        new = names.get((reference.target.file, reference.target.name))
        if reference.target.external or new is None:
            continue
        line = lines[reference.line]
        old = line[reference.start : reference.end].decode()
        if old == new:
            continue
        assert old.rpartition(".")[2] == reference.target.name, f"{file.name}:{reference.line}: {old} is misplaced"
        lines[reference.line] = line[: reference.start] + new.encode() + line[reference.end :]
    return "\n".join(text.decode() for number, text in lines.items() if number not in block.dropped)


def _imports(files: list[File], wanted: set[tuple[str, str]]) -> str:
    """Return the import statements for names of other packages that the files use, the standard library first."""
    plain, of_packages = set[str](), dict[str, set[str]]()
    bound: dict[str, Target] = {}
    for file in files:
        for block in file.kept(wanted) if file.name else file.blocks:
            for target in (reference.target for reference in block.references):
                if not target.external:
                    continue
                other = bound.setdefault(target.name, target)
                assert other == target, f"{target.name} is imported from two packages"
                if target.file:
                    of_packages.setdefault(target.file, set()).add(target.external)
                else:
                    plain.add(target.external)
    lines = {f"from {package} import {', '.join(sorted(names))}": package for package, names in of_packages.items()}
    lines |= {line: line.split()[1] for line in plain}
    order = sorted(lines, key=lambda line: (line.startswith("from"), line))
    standard = [line for line in order if lines[line].partition(".")[0] in sys.stdlib_module_names]
    return "\n".join([*standard, "", *(line for line in order if line not in standard)])
