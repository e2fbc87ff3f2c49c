"""Where a problem comes from, a file or an object of Python: the one place in which both become the same.

All that follows asks a source: what the problem is called, what text identifies it in the build cache, and what its
author has written. Nothing here needs sympy until an object is described or a file is run.

Reading a problem file: its text, `--set` arguments, and what its `problem(...)` returns, or what is wrong with it.

Importing this module and reading a text need no sympy, so that a build which is up to date can be recognised before
anything slow is imported.

What all that a problem file may return has in common, told without sympy, and how a notebook shows it.

What an argument of a problem that there is not may have been meant for.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import CodeType, ModuleType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeAlias, Union, cast, get_args, get_origin

from codegen.deferred import Deferred
from codegen.errors import ArgumentError, CodegenError, ProblemFileError, clause
from codegen.problem.points import beside

_LATEX = Deferred("show.notebook_mathematics", "displayed")


class AuthorObject:
    """A Control, Simulate, Phases or Connect."""

    def _repr_latex_(self) -> str:
        return str(_LATEX(self))


SYNONYMS = {
    "cost": ("minimize", "minimise", "objective", "running_cost", "lagrange"),
    "terminal_cost": ("final_cost", "end_cost", "mayer"),
    "maximise": ("maximize",),
    "terminal_maximise": ("terminal_maximize", "final_maximise"),
    "start": ("initial", "initial_state", "x0"),
    "end": ("final", "final_state", "terminal", "goal"),
    "duration": ("T", "tf", "final_time", "time", "horizon"),
    "steps": ("N", "nodes", "intervals"),
    "path": ("constraints", "inequalities"),
}
"""What other programs call arguments of problems."""


def perhaps(name: str, known: Iterable[str]) -> str:
    """The arguments that a name may have been meant for, in words, or nothing where none is like it."""
    own = list(known)
    meant = [argument for argument, others in SYNONYMS.items() if argument in own and name in others]
    similar = meant or difflib.get_close_matches(name, own)
    return f"perhaps it is {' or '.join(similar)}" if similar else ""


def converted(path: Path, text: str, parameter: inspect.Parameter) -> Any:
    """The value of an argument of problem() in the type that it is annotated with, or that its default has.

    Raises ArgumentError, which names the problem file at `path`, when the text does not fit, or when there is no
    reading such a type from text.
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
    """The values of a type in words, and the function that reads one; it raises ValueError for any other text."""
    origin, choices = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _readers(choices[0])
    if origin is Literal:
        values = {str(choice): choice for choice in choices}
        return [(" or ".join(values), lambda text: _chosen(values, text))]
    if origin in (Union, UnionType):
        # None first: every other type of text would take the word for a value.
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
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = Decimal(text)
    except InvalidOperation:
        raise ValueError(text) from None
    # The bound comes first: the integer 1e999999999 would not fit into memory.
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


def parse_arguments(items: Sequence[str], path: Path | None = None) -> dict[str, str]:
    """Split the `name=value` strings of `--set`; a value may hold further equality signs, or be empty.

    Raises ArgumentError for an item without an equality sign or without a name, whose remedy quotes an argument of the
    problem file at `path`, and for a name given twice.
    """
    arguments: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition("=")
        name = name.strip()
        if not equals or not name:
            raise ArgumentError(f"--set {item!r} is not of the form name=value", _example(path, item.strip()))
        if name in arguments:
            raise ArgumentError(f"--set gives {clause(name)} twice", "give it once")
        arguments[name] = value
    return arguments


def _example(path: Path | None, name: str) -> str:
    """How to set the argument of that name, or else the first one, of the problem in a file, to its own value."""
    arguments = [] if path is None else _arguments(path)
    if not arguments:
        return "write --set name=value with an argument of problem()"
    chosen, default = next((pair for pair in arguments if pair[0].arg == name), arguments[0])
    value = "value" if default is None else ast.unparse(default).strip("'")
    return f"write for example --set {chosen.arg}={value}"


def argument_names(path: Path) -> tuple[str, ...]:
    """The names of the arguments of problem(), from the text of the file alone; none where it cannot be read so."""
    return tuple(argument.arg for argument, _ in _arguments(path))


def point_arguments(path: Path) -> set[str]:
    """The names of those that are files of points, which are known by their annotation, `Points`."""
    return {
        argument.arg
        for argument, _ in _arguments(path)
        if isinstance(argument.annotation, ast.Name) and argument.annotation.id == "Points"
    }


def _arguments(path: Path) -> list[tuple[ast.arg, ast.expr | None]]:
    """The arguments of problem() with their defaults, from the text of the file alone."""
    try:
        tree = ast.parse(source_text(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # what is wrong is said where the file is run
        return []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == "problem":
            plain, named = node.args.args, node.args.kwonlyargs
            before = [None] * (len(plain) - len(node.args.defaults))
            return [*zip(plain, [*before, *node.args.defaults]), *zip(named, node.args.kw_defaults)]
    return []


def written_problem(path: Path, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
    """What a problem file's `problem(...)` returns: its title, the problem, and the symbols that were declared for it.

    The title is the first line of the docstring. The file is run anew each time; neither it nor modules beside it stay
    imported, and what it prints goes to stderr. Raises ProblemFileError when the file cannot be read, imported or
    called, and ArgumentError when an argument does not fit `problem`.
    """
    title, code = _compiled(path)

    from codegen.problem.symbols import recorded_declarations

    with _fresh_module(path) as module, beside(path.parent), redirect_stdout(sys.stderr):
        with _blaming(path):
            exec(code, module.__dict__)
        function = _problem_function(path, module)
        # The `--set` arguments, converted to the types that the parameters of problem() are annotated with.
        with _blaming(path):
            signature = inspect.signature(function, eval_str=True)
        for parameter in signature.parameters.values():
            if parameter.kind not in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                raise _unusable(path, f"problem() takes {parameter}, which has no name for --set", "name each argument")
            if parameter.default is parameter.empty:
                raise _unusable(path, f"problem() requires {parameter.name}", f"give {parameter.name} a default value")
        known = list(signature.parameters)
        for name in arguments:
            if name not in known:
                close = difflib.get_close_matches(name, known, n=1)
                remedy = f"problem() takes {', '.join(known)}" if known else "problem() takes no arguments"
                remedy = f"did you mean {close[0]}? {remedy}" if close else remedy
                if _is_parameter(function, name):
                    given = f"{name}={arguments[name]}"
                    remedy = f"{name} is a parameter: give solve --parameter {given}, or sweep --vary {given}; {remedy}"
                raise ArgumentError(clause(f"{path}: --set {name}: no such argument"), remedy)
        keywords = {name: converted(path, text, signature.parameters[name]) for name, text in arguments.items()}
        with _blaming(path), recorded_declarations() as declared:
            return title, function(**keywords), declared


# Messages


def _unusable(location: Path | str, finding: str, remedy: str) -> ProblemFileError:
    return ProblemFileError(clause(f"{location}: {finding}"), remedy)


def with_location(error: CodegenError, location: str) -> CodegenError:
    """The same error, which says where the mistake is."""
    return type(error)(clause(f"{location}: {error.finding}"), clause(error.remedy))


_UNPACK = (
    "unpack what is returned, as in (x,), (v,) = coordinates('x'), or use state('x'), control('u'), parameter('m', 1) "
    "and their like"
)
_OF_SYMPY = "take functions of expressions from sympy, not from math or numpy"
_MISTAKES = (
    ("truth value of Relational", "write two inequalities, such as x >= 0 and x <= 2, for 0 <= x <= 2, or use bounds"),
    ("'tuple'", _UNPACK),
    ("multiply sequence", _UNPACK),
    ("Cannot convert expression to float", _OF_SYMPY),
    ("ufunc", _OF_SYMPY),
    ("'function'", "call it where it makes a symbol, as in t = time()"),
)
"""Words of a TypeError, and what its author should have written."""

_UNEXPECTED = re.compile(r"(\w+)(?:\.__init__)?\(\) got an unexpected keyword argument '(\w+)'")


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Turn whatever the author's code raises into an error that names the file and the line."""
    try:
        yield
    except CodegenError as error:
        raise with_location(error, _location(path, error)) from error
    except (Exception, SystemExit) as error:  # the author's code may raise anything; only Ctrl-C is not its fault
        finding = f"{type(error).__name__}: {error}".rstrip(": ")
        raise _unusable(_location(path, error), finding, _remedy(error)) from error


def _remedy(error: BaseException) -> str:
    """What to do about an error that Python raises in an author's code, where the mistake is a common one."""
    if isinstance(error, ImportError):
        return "install what is missing, or correct the import"
    if isinstance(error, SystemExit):
        return "let problem() return instead of exiting"
    if isinstance(error, TypeError):
        if found := _UNEXPECTED.search(str(error)):
            return _similar_arguments(*found.groups())
        return next((remedy for words, remedy in _MISTAKES if words in str(error)), "correct the file")
    return "correct the file"


def _similar_arguments(function: str, name: str) -> str:
    """What an argument of a problem, or of a declaration, that there is not may have been meant for."""
    import codegen

    named = getattr(codegen, function, None)
    known = inspect.signature(named).parameters if callable(named) else {}
    return perhaps(name, known) or "correct the file"


def _location(path: Path, error: BaseException) -> str:
    """The file and the innermost of its lines that an exception passed through."""
    filename = str(path.absolute())
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == filename]
    return f"{path}:{lines[-1]}" if lines else str(path)


# The file


def source_text(path: Path) -> str:
    """The text of a problem file; ProblemFileError when it cannot be read."""
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
    """The title of a problem file and its code."""
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
    """An empty module for the file, and its folder on sys.path, for as long as the context lasts."""
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
        _forget_modules(set(sys.modules) - before, folder)


def _forget_modules(names: set[str], folder: Path) -> None:
    """Forget newly imported modules and packages that lie directly in a folder, with their submodules.

    Only what lies directly there, since an environment with sympy itself may lie deeper in the author's folder.
    """
    for top in [name for name in names if "." not in name]:
        module = sys.modules[top]
        locations = [getattr(module, "__file__", None), *getattr(module, "__path__", [])]
        if any(location and Path(location).parent == folder for location in locations):
            for name in [name for name in names if name.partition(".")[0] == top]:
                del sys.modules[name]


# The arguments of problem()


def _problem_function(path: Path, module: ModuleType) -> Callable[..., Any]:
    function = getattr(module, "problem", None)
    if not callable(function):
        raise _unusable(path, "defines no function problem()", "define problem(), returning a Simulate or a Control")
    if inspect.iscoroutinefunction(function):
        raise _unusable(path, "problem() is asynchronous", "write def instead of async def")
    return cast(Callable[..., Any], function)


def _is_parameter(function: Callable[..., Any], name: str) -> bool:
    """Whether the problem as it is without arguments declares a parameter of that name."""
    from codegen.problem.symbols import Parameter, recorded_declarations

    with recorded_declarations() as declared, suppress(Exception, SystemExit):  # what is wrong is said without --set
        function()
    return any(isinstance(symbol, Parameter) and symbol.name == name for symbol in declared)


UNNAMED = "problem"
"""What an object is called that nobody gave a name."""


@dataclass(frozen=True)
class ProblemFile:
    """A problem file, which its text identifies; line endings do not matter."""

    path: Path

    @property
    def name(self) -> str:
        """What modules are named after."""
        return self.path.stem

    @property
    def location(self) -> str:
        """What messages call it."""
        return str(self.path)

    @property
    def folder(self) -> Path:
        """Where the files lie that it reads."""
        return self.path.parent

    @property
    def text(self) -> str:
        """What identifies it; ProblemFileError when the file cannot be read."""
        return source_text(self.path)

    @property
    def arguments(self) -> tuple[str, ...]:
        """What `--set` may set."""
        return argument_names(self.path)

    @property
    def point_arguments(self) -> set[str]:
        """Those of them that are files of points."""
        return point_arguments(self.path)

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """The title, the author's object and the declared symbols; see `problem_file.written_problem`."""
        return written_problem(self.path, arguments)


@dataclass(frozen=True)
class ProblemObject:
    """A problem that was made in Python, in a notebook for example; all that it says, as text, identifies it.

    That text does not depend on the process, on the hash seed, or on what else was declared.
    """

    name: str
    title: str
    text: str = field(repr=False)
    problem: Any = field(repr=False, compare=False)
    folder: Path = field(default=Path(), repr=False, compare=False)

    @property
    def location(self) -> str:
        """What messages call it."""
        return self.name

    @property
    def arguments(self) -> tuple[str, ...]:
        """What `--set` may set: nothing, since there is no problem() to be called again."""
        return ()

    @property
    def point_arguments(self) -> set[str]:
        """As there are none, none of them is a file of points."""
        return set()

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """The title, the object and the symbols in it; ArgumentError for arguments, of which there are none."""
        from codegen.problem.description import quantities_in

        for name in arguments:
            finding = f"{self.name}: no argument {clause(name)}, since the problem is an object"
            remedy = "give a value of a parameter by parameters={...}, or write a problem file with problem(...)"
            raise ArgumentError(finding, remedy)
        return self.title, self.problem, [symbol for symbol in quantities_in(self.problem) if symbol.own]


Source: TypeAlias = ProblemFile | ProblemObject


def source_of(problem: Any, name: str | None = None, title: str | None = None) -> Source:
    """The source of a problem: of the path of its file, or of a Control, Simulate, Phases or Connect, with its name.

    Raises ArgumentError for a name that is no identifier, for a name or title of a file, which has its own, and for
    what is no problem; ExpressionError for a part of an object that no problem may have.
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
    """The SHA-256, in hexadecimal, of a problem's text, its arguments in any order, and further strings.

    Files that a problem file imports or reads are not seen. Raises ProblemFileError when the file cannot be read.
    """
    pairs = [part for name in sorted(arguments) for part in (name, arguments[name])]
    digest = hashlib.sha256()
    for part in (source_of(problem).text, str(len(arguments)), *pairs, *extra):
        data = part.encode(errors="surrogateescape")
        # The length in front keeps ("ab", "c") and ("a", "bc") apart.
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Settings(Mapping[str, str]):
    """The arguments that shape a module, as text, and beside them the file of points, if any, which a solve reads."""

    shaping: Mapping[str, str]
    points: str | None = None

    def __getitem__(self, name: str) -> str:
        return self.shaping[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.shaping)

    def __len__(self) -> int:
        return len(self.shaping)


def settings_of(problem: Source | Path | str, arguments: Mapping[str, object] | None) -> Settings:
    """What arguments of problem() say, as values or as the text that `--set` takes; settings are what they are.

    Raises ProblemFileError when the problem file cannot be read, and ArgumentError when two files of points are given.
    """
    if isinstance(arguments, Settings):
        return arguments
    arguments = arguments or {}
    names = source_of(problem).point_arguments
    given = [name for name in arguments if name in names]
    if len(given) > 1:
        raise ArgumentError(f"--set gives files of points as {' and '.join(given)}", "give one of them")
    others = {name: str(value) for name, value in arguments.items() if name not in names}
    return Settings(others, str(arguments[given[0]]) if given else None)
