"""Sources of problems: problem files and objects of Python, with a common interface.

A source has the name of the problem, the text that identifies the problem in the build cache, and the problem object.
sympy is not imported before an object is described or a file is run, so that a cache hit is recognised quickly.

A problem file is run again for every derivation. Errors in the user's code name the file and the line. Arguments of
`problem(...)` are converted from the texts of `--set` to the annotated types.
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
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin

from codegen.errors import ArgumentError, CodegenError, ProblemFileError, clause
from codegen.problem import AuthorObject, perhaps
from codegen.problem.points import beside

if TYPE_CHECKING:
    from codegen.problem.symbols import Quantity

Written: TypeAlias = "tuple[str, Any, list[Quantity]]"
"""The title of a problem, the object that `problem()` returned, and the quantities that were declared."""
UNNAMED = "problem"
"""The default name of a problem object."""


@dataclass(frozen=True)
class ProblemFile:
    """A problem file, which its text identifies in the build cache; line endings do not matter."""

    path: Path

    @property
    def name(self) -> str:
        """The name of the problem and its modules."""
        return self.path.stem

    @property
    def location(self) -> str:
        """The path of the file, with which messages begin."""
        return str(self.path)

    @property
    def folder(self) -> Path:
        """The folder to which the paths of files that the problem reads are relative."""
        return self.path.parent

    @property
    def text(self) -> str:
        """The text of the file; raises ProblemFileError if the file cannot be read."""
        return source_text(self.path)

    @property
    def arguments(self) -> tuple[str, ...]:
        """The names of the arguments of problem(), read without running the file; empty if it cannot be parsed."""
        return tuple(argument.arg for argument, _ in _arguments(self.path))

    @property
    def point_arguments(self) -> set[str]:
        """The names of the arguments that are files of points, which have the annotation `Points`."""
        annotated = ((argument.arg, argument.annotation) for argument, _ in _arguments(self.path))
        return {name for name, kind in annotated if isinstance(kind, ast.Name) and kind.id == "Points"}

    def written(self, arguments: Mapping[str, str]) -> Written:
        """Run the file; return the title, the problem object and the declared symbols; see `written_problem`."""
        return written_problem(self.path, arguments)


@dataclass(frozen=True)
class ProblemObject:
    """A problem object that was created in Python, for example in a notebook.

    `text` describes the content of the object, and identifies the problem in the build cache. The text does not depend
    on the process, on the hash seed, or on declarations that the problem does not use.
    """

    name: str
    title: str
    text: str = field(repr=False)
    problem: Any = field(repr=False, compare=False)
    folder: Path = field(default=Path(), repr=False, compare=False)

    @property
    def location(self) -> str:
        """The name of the problem, with which messages begin."""
        return self.name

    @property
    def arguments(self) -> tuple[str, ...]:
        """An empty tuple: an object has no arguments, because no function problem() can be called."""
        return ()

    @property
    def point_arguments(self) -> set[str]:
        """An empty set: an object has no arguments."""
        return set()

    def written(self, arguments: Mapping[str, str]) -> Written:
        """Return the title, the problem object and its declared symbols; raise ArgumentError if `arguments` has any."""
        from codegen.problem.description import quantities_in

        for name in arguments:
            finding = f"{self.name}: no argument {clause(name)}, since the problem is an object"
            remedy = "give a value of a parameter by parameters={...}, or write a problem file with problem(...)"
            raise ArgumentError(finding, remedy)
        return self.title, self.problem, [symbol for symbol in quantities_in(self.problem) if symbol.own]


Source: TypeAlias = ProblemFile | ProblemObject


def source_of(problem: object, name: str | None = None, title: str | None = None) -> Source:
    """Return the source for the path of a problem file, or for a Control, Simulate, Phases or Connect.

    `name` and `title` are the name and the title of an object. Raise ArgumentError for a name that is no identifier,
    for a name or title together with a file, and for objects that are no problem. Raise ExpressionError for an unusable
    part of an object.
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
    """Return the SHA-256, in hexadecimal, of the text of a problem, its arguments, and the `extra` strings.

    The order of the arguments has no effect. Files that a problem file imports or reads are not included. Raise
    ProblemFileError for an unreadable file.
    """
    pairs = [part for name in sorted(arguments) for part in (name, arguments[name])]
    digest = hashlib.sha256()
    for part in (source_of(problem).text, str(len(arguments)), *pairs, *extra):
        data = part.encode(errors="surrogateescape")
        # The length before each part distinguishes ("ab", "c") from ("a", "bc").
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Settings(Mapping[str, str]):
    """The arguments of problem() as text.

    The mapping `shaping` has the arguments on which the generated module depends. `points` is the file of points, which
    is read when the problem is solved; None means the file that the problem names.
    """

    shaping: Mapping[str, str]
    points: str | None = None

    def __getitem__(self, name: str) -> str:
        return self.shaping[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.shaping)

    def __len__(self) -> int:
        return len(self.shaping)


def settings_of(problem: Source | Path | str, arguments: Mapping[str, object] | None) -> Settings:
    """Return the settings for arguments of problem(), which are values or the texts of `--set`.

    Raise ProblemFileError for an unreadable file, and ArgumentError for two files of points.
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


def written_problem(path: Path, arguments: Mapping[str, str]) -> Written:
    """Run a problem file; return its title, the problem object and the symbols that were declared for the problem.

    The title is the first line of the docstring. The file is run again at each call. Afterwards sys.modules contains
    neither the file nor modules from its folder. Printed text is written to stderr. Raise ProblemFileError if the file
    cannot be read or imported or problem() cannot be called, and ArgumentError if an argument does not fit `problem`.
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
            with recorded_declarations() as declared, suppress(Exception, SystemExit):  # only declarations are needed
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
    """Return the title of a problem file and its compiled code; raise ProblemFileError for an unusable file."""
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
    """Provide an empty module for the problem file during a with block, with the folder of the file on sys.path.

    At the end modules from this folder are removed from sys.modules.
    """
    module = ModuleType(f"_problem_{path.stem}")
    module.__file__ = str(path.absolute())
    folder = path.resolve().parent
    before = set(sys.modules)
    writes_bytecode = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(folder))
    # Dataclasses need their module in sys.modules.
    sys.modules[module.__name__] = module
    importlib.invalidate_caches()
    try:
        yield module
    finally:
        sys.dont_write_bytecode = writes_bytecode
        if str(folder) in sys.path:
            sys.path.remove(str(folder))
        sys.modules.pop(module.__name__, None)
        # Remove new modules and packages that lie directly in the folder. Modules in subfolders remain, because an
        # environment with sympy may be there.
        new = set(sys.modules) - before
        for top in [name for name in new if "." not in name]:
            locations = [getattr(sys.modules[top], "__file__", None), *getattr(sys.modules[top], "__path__", [])]
            if any(location and Path(location).parent == folder for location in locations):
                for name in [name for name in new if name.partition(".")[0] == top]:
                    del sys.modules[name]


# Errors in the user's code


def _unusable(location: Path | str, finding: str, remedy: str) -> ProblemFileError:
    return ProblemFileError(clause(f"{location}: {finding}"), remedy)


def with_location(error: CodegenError, location: str) -> CodegenError:
    """Return an error of the same kind, whose message begins with the location of the mistake."""
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
    (
        "'MutableDenseMatrix'",
        "make a vector that is a key an ImmutableMatrix, as in u = ImmutableMatrix(controls('u1:4'))",
    ),
    ("'function'", "call it where it makes a symbol, as in t = time()"),
)
"""Words in the message of a TypeError, and the remedy for each."""

_UNEXPECTED = re.compile(r"(\w+)(?:\.__init__)?\(\) got an unexpected keyword argument '(\w+)'")


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Convert exceptions of the user's code in a with block to errors that name the problem file and the line."""
    try:
        yield
    except CodegenError as error:
        raise with_location(error, _location(path, error)) from error
    except (Exception, SystemExit) as error:  # the user's code may raise any error; KeyboardInterrupt is not caught
        finding = f"{type(error).__name__}: {error}".rstrip(":. ")
        raise _unusable(_location(path, error), finding, _remedy(error)) from error


def _location(path: Path, error: BaseException) -> str:
    """Return the location `file:line`, with the innermost line of the problem file in the traceback of an exception."""
    filename = str(path.absolute())
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == filename]
    return f"{path}:{lines[-1]}" if lines else str(path)


def _remedy(error: BaseException) -> str:
    """Return the remedy for an exception of Python in the user's code."""
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
    """Return the arguments of `--set`, strings of the form `name=value`, as a dictionary.

    A value may contain equality signs, or be empty. Raise ArgumentError for an item without an equality sign or a name,
    and for a repeated name. If `path` is given, the remedy has an example from this problem file: the argument with the
    name, or else the first argument, with its default value.
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
    """Return the arguments of problem() with their defaults, from the text of the file, which is not run.

    The list is empty if the text cannot be parsed.
    """
    try:
        tree = ast.parse(source_text(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # an error is raised later, when the file is run
        return []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == "problem":
            plain, named = node.args.args, node.args.kwonlyargs
            before = [None] * (len(plain) - len(node.args.defaults))
            return [*zip(plain, [*before, *node.args.defaults]), *zip(named, node.args.kw_defaults)]
    return []


def converted(path: Path, text: str, parameter: inspect.Parameter) -> object:
    """Return the value of an argument of problem(), converted from text to its annotated type or its default's type.

    Raise ArgumentError, which names the problem file `path`, if the text does not fit the type, or if values of the
    type cannot be read from text.
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


def _readers(annotation: object) -> list[tuple[str, Callable[[str], object]]]:
    """Return pairs of a description and a function for the type of an argument.

    The function converts text to a value, and raises ValueError if the text does not fit the description. The list is
    empty for a type whose values cannot be read from text.
    """
    origin, choices = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _readers(choices[0])
    if origin is Literal:
        values = {str(choice): choice for choice in choices}
        return [(" or ".join(values), lambda text: _chosen(values, text))]
    if origin in (Union, UnionType):
        # None is tried first, because str and Path would accept the word "none" as a value.
        parts = [_readers(choice) for choice in sorted(choices, key=lambda choice: choice is not NoneType)]
        return [reader for part in parts for reader in part] if all(parts) else []
    plain: dict[type, tuple[str, Callable[[str], object]]] = {
        int: ("a whole number", _integer),
        float: ("a finite number", _finite),
        bool: ("true or false", lambda text: _chosen(_TRUTH, text.strip().lower())),
        str: ("text", str),
        Path: ("a path", _path),
        NoneType: ("none", lambda text: _chosen({"none": None}, text.strip().lower())),
    }
    return [plain[annotation]] if isinstance(annotation, type) and annotation in plain else []


_TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def _chosen(values: Mapping[str, object], text: str) -> object:
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
    # The magnitude is tested before the conversion, because the integer 1e999999999 would not fit into memory.
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
