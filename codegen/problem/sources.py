"""Sources of problems: problem files and objects of Python, with a common interface.

A source has the name of the problem, the text that identifies the problem in the build cache, and the author's object.
No sympy is imported until an object is described or a file is run, so that a cache hit is recognised quickly.

A problem file is run anew for every derivation. Errors of the author's code name the file and the line. Arguments of
`problem(...)` are converted from the text of `--set` to the annotated types.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import importlib.util
import inspect
import keyword
import math
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import CodeType, ModuleType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin

from codegen.errors import ArgumentError, CodegenError, ProblemFileError, clause
from codegen.problem import AuthorObject, perhaps
from codegen.problem.points import beside

UNNAMED = "problem"
"""The default name of an object."""


@dataclass(frozen=True)
class ProblemFile:
    """A problem file, identified by its text; line endings do not matter."""

    path: Path

    @property
    def name(self) -> str:
        """The name of the problem and its modules."""
        return self.path.stem

    @property
    def location(self) -> str:
        """The beginning of messages."""
        return str(self.path)

    @property
    def folder(self) -> Path:
        """The folder of the files that the problem reads."""
        return self.path.parent

    @property
    def text(self) -> str:
        """The text of the file; ProblemFileError if the file cannot be read."""
        return source_text(self.path)

    @property
    def arguments(self) -> tuple[str, ...]:
        """The names of the arguments of problem(), from the text alone; empty if the text cannot be parsed."""
        return tuple(argument.arg for argument, _ in _arguments(self.path))

    @property
    def point_arguments(self) -> set[str]:
        """The names of the arguments that are files of points, by their annotation `Points`."""
        annotated = ((argument.arg, argument.annotation) for argument, _ in _arguments(self.path))
        return {name for name, kind in annotated if isinstance(kind, ast.Name) and kind.id == "Points"}

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """Return the title, the author's object and the declared symbols; see `written_problem`."""
        return written_problem(self.path, arguments)


@dataclass(frozen=True)
class ProblemObject:
    """A problem made in Python, for example in a notebook, identified by a text of its content.

    The text does not depend on the process, on the hash seed, or on other declarations.
    """

    name: str
    title: str
    text: str = field(repr=False)
    problem: Any = field(repr=False, compare=False)
    folder: Path = field(default=Path(), repr=False, compare=False)

    @property
    def location(self) -> str:
        """The beginning of messages."""
        return self.name

    @property
    def arguments(self) -> tuple[str, ...]:
        """An object has no arguments, because there is no problem() to call again."""
        return ()

    @property
    def point_arguments(self) -> set[str]:
        """An object has no arguments."""
        return set()

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """Return the title, the object and its symbols; raise ArgumentError for arguments."""
        from codegen.problem.description import quantities_in

        for name in arguments:
            finding = f"{self.name}: no argument {clause(name)}, since the problem is an object"
            remedy = "give a value of a parameter by parameters={...}, or write a problem file with problem(...)"
            raise ArgumentError(finding, remedy)
        return self.title, self.problem, [symbol for symbol in quantities_in(self.problem) if symbol.own]


Source: TypeAlias = ProblemFile | ProblemObject


def source_of(problem: Any, name: str | None = None, title: str | None = None) -> Source:
    """Return the source for the path of a problem file, or for a Control, Simulate, Phases or Connect.

    Raises ArgumentError for a name that is no identifier, for a name or title of a file, and for objects that are no
    problem. Raises ExpressionError for an unusable part of an object.
    """
    if isinstance(problem, ProblemFile | ProblemObject | Path | str):
        if name is not None or title is not None:
            raise ArgumentError("a name or title beside a file", "leave it out; a file is named by itself")
        return problem if isinstance(problem, ProblemFile | ProblemObject) else ProblemFile(Path(problem))
    if not isinstance(problem, AuthorObject):
        remedy = "give the path of a problem file, or a Control, Simulate, Phases or Connect"
        raise ArgumentError(f"a problem is no {type(problem).__name__}", remedy)
    from codegen.problem.description import described

    name = UNNAMED if name is None else name
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise ArgumentError(f"name {clause(repr(name))} cannot name a module", "give a Python identifier")
    title = name if title is None else title
    if not isinstance(title, str) or not title.strip() or not title.isprintable():
        raise ArgumentError(f"title {clause(repr(title))}", "give one line of text")
    return ProblemObject(name, title.strip(), f"{title.strip()}\n{described(problem, name)}", problem, Path.cwd())


def input_digest(problem: Source | Path | str, arguments: Mapping[str, str], *extra: str) -> str:
    """Return the SHA-256, in hexadecimal, of a problem's text, its arguments in any order, and further strings.

    Files that a problem file imports or reads are not included. Raises ProblemFileError for an unreadable file.
    """
    pairs = [part for name in sorted(arguments) for part in (name, arguments[name])]
    digest = hashlib.sha256()
    for part in (source_of(problem).text, str(len(arguments)), *pairs, *extra):
        data = part.encode(errors="surrogateescape")
        # The length in front distinguishes ("ab", "c") from ("a", "bc").
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Settings(Mapping[str, str]):
    """The arguments that determine a module, as text, and the file of points, if any, which a solve reads."""

    shaping: Mapping[str, str]
    points: str | None = None

    def __getitem__(self, name: str) -> str:
        return self.shaping[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.shaping)

    def __len__(self) -> int:
        return len(self.shaping)


def settings_of(problem: Source | Path | str, arguments: Mapping[str, object] | None) -> Settings:
    """Return the settings for arguments of problem(), given as values or as the text of `--set`.

    Raises ProblemFileError for an unreadable file, and ArgumentError for two files of points.
    """
    if isinstance(arguments, Settings):
        return arguments
    arguments = arguments or {}
    names = source_of(problem).point_arguments
    files = [name for name in arguments if name in names]
    if len(files) > 1:
        raise ArgumentError(f"--set gives files of points as {' and '.join(files)}", "give one of them")
    others = {name: str(value) for name, value in arguments.items() if name not in names}
    return Settings(others, str(arguments[files[0]]) if files else None)


# Problem files


def written_problem(path: Path, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
    """Run a problem file; return its title, the problem and the symbols that were declared for the problem.

    The title is the first line of the docstring. The file is run anew each time. The file and modules beside it are
    not kept in sys.modules; printed text goes to stderr. Raises ProblemFileError if the file cannot be read, imported
    or called, and ArgumentError if an argument does not fit `problem`.
    """
    title, code = _compiled(path)

    from codegen.problem.symbols import Parameter, recorded_declarations

    with _fresh_module(path) as module, beside(path.parent), redirect_stdout(sys.stderr):
        with _blaming(path):
            exec(code, module.__dict__)
        function = getattr(module, "problem", None)
        if not callable(function):
            raise _unusable(
                path, "defines no function problem()", "define problem(), returning a Simulate or a Control"
            )
        if inspect.iscoroutinefunction(function):
            raise _unusable(path, "problem() is asynchronous", "write def instead of async def")
        with _blaming(path):
            signature = inspect.signature(function, eval_str=True)
        for parameter in signature.parameters.values():
            if parameter.kind not in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                raise _unusable(path, f"problem() takes {parameter}, which has no name for --set", "name each argument")
            if parameter.default is parameter.empty:
                raise _unusable(path, f"problem() requires {parameter.name}", f"give {parameter.name} a default value")
        known = list(signature.parameters)
        for name in arguments:
            if name in known:
                continue
            close = difflib.get_close_matches(name, known, n=1)
            remedy = f"problem() takes {', '.join(known)}" if known else "problem() takes no arguments"
            remedy = f"did you mean {close[0]}? {remedy}" if close else remedy
            with recorded_declarations() as declared, suppress(Exception, SystemExit):  # errors of other origin
                function()
            if any(isinstance(symbol, Parameter) and symbol.name == name for symbol in declared):
                given = f"{name}={arguments[name]}"
                remedy = f"{name} is a parameter: give solve --parameter {given}, or sweep --vary {given}; {remedy}"
            raise ArgumentError(clause(f"{path}: --set {name}: no such argument"), remedy)
        keywords = {name: converted(path, text, signature.parameters[name]) for name, text in arguments.items()}
        with _blaming(path), recorded_declarations() as declared:
            return title, function(**keywords), declared


def source_text(path: Path) -> str:
    """Return the text of a problem file; raise ProblemFileError if the file cannot be read."""
    try:
        if path.is_dir():
            raise _unusable(path, "is a directory", "give a problem file, such as pendulum.py")
        if not path.exists():
            raise _unusable(path, "no such file", "check the path of the problem file")
        if path.suffix != ".py" or not path.is_file():
            raise _unusable(path, "is not a Python file", "give a problem file, such as pendulum.py")
        return importlib.util.decode_source(path.read_bytes())
    except OSError as error:
        raise _unusable(path, f"cannot be read ({error.strerror})", "check the path and its permissions") from error
    except (ValueError, SyntaxError) as error:
        raise _unusable(path, "is not text in UTF-8", "give a problem file written in Python") from error


def _compiled(path: Path) -> tuple[str, CodeType]:
    """Return the title of a problem file and its code."""
    source = source_text(path)
    if not path.stem.isidentifier() or keyword.iskeyword(path.stem):
        raise _unusable(path, f"{path.stem!r} cannot name a module", "rename the file to a Python identifier")
    filename = str(path.absolute())
    try:
        tree = ast.parse(source, filename)
        code = compile(tree, filename, "exec", dont_inherit=True)
    except SyntaxError as error:
        location = f"{path}:{error.lineno}" if error.lineno else path
        raise _unusable(location, f"{type(error).__name__}: {error.msg}", "correct the syntax") from error
    except (ValueError, RecursionError, MemoryError, OverflowError) as error:
        raise _unusable(path, f"cannot be parsed ({error})", "give a problem file written in Python") from error
    docstring = (ast.get_docstring(tree) or "").strip()
    if not docstring:
        raise _unusable(path, "has no docstring", "state the physics and its source in a docstring at the top")
    return docstring.splitlines()[0].strip(), code


@contextmanager
def _fresh_module(path: Path) -> Iterator[ModuleType]:
    """Provide an empty module for the file, with its folder on sys.path, inside the block."""
    module = ModuleType(f"_problem_{path.stem}")
    module.__file__ = str(path.absolute())
    folder = path.resolve().parent
    before = set(sys.modules)
    writes_bytecode = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(folder))
    # Dataclasses look their module up by name.
    sys.modules[module.__name__] = module
    importlib.invalidate_caches()
    try:
        yield module
    finally:
        sys.dont_write_bytecode = writes_bytecode
        if str(folder) in sys.path:
            sys.path.remove(str(folder))
        sys.modules.pop(module.__name__, None)
        # Forget new modules and packages directly in the folder. An environment with sympy may lie deeper in it.
        new = set(sys.modules) - before
        for top in [name for name in new if "." not in name]:
            locations = [getattr(sys.modules[top], "__file__", None), *getattr(sys.modules[top], "__path__", [])]
            if any(location and Path(location).parent == folder for location in locations):
                for name in [name for name in new if name.partition(".")[0] == top]:
                    del sys.modules[name]


# Errors of authors


def _unusable(location: Path | str, finding: str, remedy: str) -> ProblemFileError:
    return ProblemFileError(clause(f"{location}: {finding}"), remedy)


def with_location(error: CodegenError, location: str) -> CodegenError:
    """Return the same error with the location of the mistake."""
    return type(error)(clause(f"{location}: {error.finding}"), clause(error.remedy))


_UNPACK = (
    "unpack what is returned, as in (x,), (v,) = coordinates('x'), or use state('x'), control('u'), parameter('m', 1) "
    "and their like"
)
_OF_SYMPY = "take functions of expressions from sympy, not from math or numpy, as in from sympy import cos, sin"
_MISTAKES = (
    ("truth value of Relational", "write two inequalities, such as x >= 0 and x <= 2, for 0 <= x <= 2, or use bounds"),
    ("'tuple'", _UNPACK),
    ("multiply sequence", _UNPACK),
    ("Cannot convert expression to float", _OF_SYMPY),
    ("ufunc", _OF_SYMPY),
    ("free_parameter() missing", 'give its initial guess, as in free_parameter("T", 3)'),
    ("'function'", "call it where it makes a symbol, as in t = time()"),
)
"""Words of a TypeError, and the remedy."""

_UNEXPECTED = re.compile(r"(\w+)(?:\.__init__)?\(\) got an unexpected keyword argument '(\w+)'")


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Convert exceptions of the author's code to errors that name the file and the line."""
    try:
        yield
    except CodegenError as error:
        raise with_location(error, _location(path, error)) from error
    except (Exception, SystemExit) as error:  # the author's code may raise any error; Ctrl-C is not its fault
        finding = f"{type(error).__name__}: {error}".rstrip(": ")
        raise _unusable(_location(path, error), finding, _remedy(error)) from error


def _location(path: Path, error: BaseException) -> str:
    """Return the file and the innermost of its lines in the traceback of an exception."""
    filename = str(path.absolute())
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == filename]
    return f"{path}:{lines[-1]}" if lines else str(path)


def _remedy(error: BaseException) -> str:
    """Return the remedy for an exception of Python in an author's code."""
    if isinstance(error, ImportError):
        return "install what is missing, or correct the import"
    if isinstance(error, SystemExit):
        return "let problem() return instead of exiting"
    if isinstance(error, TypeError):
        if match := _UNEXPECTED.search(str(error)):
            import codegen

            function = getattr(codegen, match[1], None)
            known = inspect.signature(function).parameters if callable(function) else {}
            return perhaps(match[2], known) or "correct the file"
        return next((remedy for words, remedy in _MISTAKES if words in str(error)), "correct the file")
    return "correct the file"


# Arguments of problem()


def parse_arguments(items: Sequence[str], path: Path | None = None) -> dict[str, str]:
    """Split the `name=value` strings of `--set`; a value may contain equality signs, or be empty.

    Raises ArgumentError for an item without an equality sign or a name, and for a repeated name. The remedy has an
    example, the argument of that name or the first one in the problem file at `path` with its default.
    """
    arguments: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition("=")
        name = name.strip()
        if not equals or not name:
            remedy = "write --set name=value with an argument of problem()"
            if declared := [] if path is None else _arguments(path):
                chosen, default = next((pair for pair in declared if pair[0].arg == item.strip()), declared[0])
                text = "value" if default is None else ast.unparse(default).strip("'")
                remedy = f"write for example --set {chosen.arg}={text}"
            raise ArgumentError(f"--set {item!r} is not of the form name=value", remedy)
        if name in arguments:
            raise ArgumentError(f"--set gives {clause(name)} twice", "give it once")
        arguments[name] = value
    return arguments


def _arguments(path: Path) -> list[tuple[ast.arg, ast.expr | None]]:
    """Return the arguments of problem() with their defaults, from the text of the file alone."""
    try:
        tree = ast.parse(source_text(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # reported where the file is run
        return []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == "problem":
            plain, named = node.args.args, node.args.kwonlyargs
            before = [None] * (len(plain) - len(node.args.defaults))
            return [*zip(plain, [*before, *node.args.defaults]), *zip(named, node.args.kw_defaults)]
    return []


def converted(path: Path, text: str, parameter: inspect.Parameter) -> Any:
    """Return the value of an argument of problem() in its annotated type, or in the type of its default.

    Raises ArgumentError, which names the problem file at `path`, if the text does not fit, or the type cannot be read.
    """
    annotation = parameter.annotation
    if annotation is parameter.empty:
        annotation = type(parameter.default)
    readers = _readers(annotation)
    if not readers or annotation is NoneType:
        raise ArgumentError(
            clause(f"{path}: --set {parameter.name}: its type cannot be read from text"),
            f"annotate {parameter.name} in problem() with int, float, bool, str, Path or Literal",
        )
    for _, reader in readers:
        try:
            return reader(text)
        except ValueError:
            continue
    raise ArgumentError(
        clause(f"{path}: --set {parameter.name}={text} does not fit"),
        clause(f"give {' or '.join(description for description, _ in readers)}"),
    )


def _readers(annotation: Any) -> list[tuple[str, Callable[[str], Any]]]:
    """Return descriptions of the values of a type, and functions that read them; they raise ValueError for others."""
    origin, choices = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _readers(choices[0])
    if origin is Literal:
        values = {str(choice): choice for choice in choices}
        return [(" or ".join(values), lambda text: _chosen(values, text))]
    if origin in (Union, UnionType):
        # None comes first: every other type of text would accept the word as a value.
        parts = [_readers(choice) for choice in sorted(choices, key=lambda choice: choice is not NoneType)]
        return [reader for part in parts for reader in part] if all(parts) else []
    plain: dict[Any, tuple[str, Callable[[str], Any]]] = {
        int: ("a whole number", _integer),
        float: ("a finite number", _finite),
        bool: ("true or false", lambda text: _chosen(_TRUTH, text.strip().lower())),
        str: ("text", str),
        Path: ("a path", _path),
        NoneType: ("none", lambda text: _chosen({"none": None}, text.strip().lower())),
    }
    return [plain[annotation]] if isinstance(annotation, type) and annotation in plain else []


_TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def _chosen(values: Mapping[str, Any], text: str) -> Any:
    if text not in values:
        raise ValueError(text)
    return values[text]


def _integer(text: str) -> int:
    with suppress(ValueError):
        return int(text)
    try:
        number = Decimal(text)
    except InvalidOperation:
        raise ValueError(text) from None
    # The limit comes first: the integer 1e999999999 would not fit into memory.
    if not number.is_finite() or number.adjusted() > 18 or number != number.to_integral_value():
        raise ValueError(text)
    return int(number)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _path(text: str) -> Path:
    if not text.strip():
        raise ValueError(text)
    return Path(text)
