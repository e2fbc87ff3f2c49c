"""Write the intermediate code of straight-line kernels from their text, past numba's inference of types.

What is special about a problem are kernels of hundreds of lines `x7 = x5*x6`, in which everything is a number. numba
infers the type of each and copies its representation of the function many times. Here a kernel becomes one call of an
intrinsic function, which goes through the lines once; what an operator or a function of `math` means, numba is asked.
A kernel that holds anything else, and a call with other arrays than rows of numbers, are left to numba.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
}

FUNCTIONS = frozenset(
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log log1p sqrt fabs hypot".split()
)
"""Functions of `math` whose value is a number of the same kind as their arguments."""

LARGEST_EXPONENT = 64
"""Largest whole exponent of a power that is written as a product."""


def write_directly(functions: Iterable[Any], path: Path) -> list[str]:
    """Have those functions of the module at `path` that are straight lines compiled from their text; their names."""
    by_name = {function.py_func.__name__: function for function in functions}
    found = []
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name in by_name:
            with suppress(RecursionError):  # sums of so many terms are left to numba
                if is_straight_line(node):
                    _replace(by_name[node.name], node)
                    found.append(node.name)
    return found


def is_straight_line(node: ast.FunctionDef) -> bool:
    """Whether a function assigns arithmetic of its arguments to names and entries, and returns a number or nothing."""
    known = {argument.arg for argument in node.args.args}
    for line in _lines(node):
        if isinstance(line, ast.Return):
            return line is node.body[-1] and line.value is not None and _is_arithmetic(line.value, known)
        target, value = _assignment(line)
        if target is None or not _is_arithmetic(value, known):
            return False
        if isinstance(target, ast.Name):
            known.add(target.id)
        elif target.value.id not in known:
            return False
    return True


def _assignment(line: ast.stmt) -> tuple[Any, Any]:
    """What a statement assigns to, and what; the sum of both where it adds to an entry. Nothing, if it does not."""
    if isinstance(line, ast.AugAssign) and _is_entry(line.target):
        return line.target, ast.BinOp(line.target, line.op, line.value)
    if isinstance(line, ast.Assign) and len(line.targets) == 1:
        (target,) = line.targets
        if isinstance(target, ast.Name) or _is_entry(target):
            return target, line.value
    return None, None


def _lines(node: ast.FunctionDef) -> list[ast.stmt]:
    """The statements of a function after its docstring."""
    return node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body


def _is_entry(node: ast.expr) -> bool:
    """Whether this is an entry of an array at a place that is written out."""
    return (
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and isinstance(node.slice, ast.Constant)
        and type(node.slice.value) is int
    )


def _is_arithmetic(node: ast.expr, known: set[str]) -> bool:
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    if isinstance(node, ast.Name):
        return node.id in known
    if isinstance(node, ast.UnaryOp):
        return type(node.op) in OPERATORS and _is_arithmetic(node.operand, known)
    if isinstance(node, ast.BinOp):
        if isinstance(node.op, ast.Pow):
            exponent = _exponent(node)
            is_fixed = type(exponent) is float or (type(exponent) is int and abs(exponent) <= LARGEST_EXPONENT)
            return is_fixed and _is_arithmetic(node.left, known)
        return type(node.op) in OPERATORS and all(_is_arithmetic(side, known) for side in (node.left, node.right))
    if isinstance(node, ast.Call):
        return (
            _is_function(node.func)
            and not node.keywords
            and all(_is_arithmetic(argument, known) for argument in node.args)
        )
    return _is_entry(node) and node.value.id in known  # type: ignore[attr-defined]


def _exponent(node: ast.BinOp) -> Any:
    """The exponent of a power, where it is written out; else nothing."""
    right, is_negative = node.right, isinstance(node.right, ast.UnaryOp) and isinstance(node.right.op, ast.USub)
    value: Any = getattr(right.operand if is_negative else right, "value", None)  # type: ignore[attr-defined]
    if type(value) not in (int, float):
        return None
    return -value if is_negative else value


def _is_function(node: ast.expr) -> bool:
    of_math = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math"
    return of_math and node.attr in FUNCTIONS  # type: ignore[attr-defined]


def _replace(function: Any, node: ast.FunctionDef) -> None:
    """Have a function compiled as a call of the intrinsic function that writes its lines."""
    compiler = function._compiler
    own, twin = compiler._get_implementation, _twin(function.py_func, node)

    def implementation(args: Any, kws: Any) -> Any:
        return twin if all(map(_fits, args)) else own(args, kws)

    compiler._get_implementation = implementation


def _fits(kind: Any) -> bool:
    """Whether this is the type of a number, or of a row of numbers, as the intrinsic function takes them."""
    from numba.core import types

    return kind in (types.float64, types.float64[::1])


def _twin(py_func: FunctionType, node: ast.FunctionDef) -> Any:
    """A function of the same name and arguments that calls the intrinsic function."""
    from numba.core import types
    from numba.core.typing.templates import signature
    from numba.extending import intrinsic

    names = [argument.arg for argument in node.args.args]
    returns = types.float64 if isinstance(node.body[-1], ast.Return) else types.none

    def typed(typing_context: Any, *kinds: Any) -> Any:
        def write(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            found = Writer(typing_context, context, builder, dict(zip(names, args, strict=True))).write(node)
            return context.get_dummy_value() if found is None else found

        return signature(returns, *kinds), write  # type: ignore[no-untyped-call]

    space: dict[str, Any] = {"typed": typed, "__name__": py_func.__module__}
    listed = ", ".join(names)
    exec(f"def straight_line(typing_context, {listed}): return typed(typing_context, {listed})", space)
    space["straight_line"] = intrinsic(space["straight_line"])
    exec(f"def {node.name}({listed}): return straight_line({listed})", space)
    return space[node.name]


@dataclass
class Writer:
    """Goes through the lines of a kernel; values are Python's numbers where nothing else is in them, or LLVM's."""

    typing_context: Any
    context: Any
    builder: Any
    values: dict[str, Any]

    def __post_init__(self) -> None:
        self.meanings: dict[Any, Any] = {}

    def write(self, node: ast.FunctionDef) -> Any:
        """Write all lines; the value that is returned, if there is one."""
        for line in _lines(node):
            if isinstance(line, ast.Return):
                return self.number(self.value(line.value))
            target, value = _assignment(line)
            if isinstance(target, ast.Name):
                self.values[target.id] = self.value(value)
            else:
                self.builder.store(self.number(self.value(value)), self.pointer(target))
        return None

    def value(self, node: Any) -> Any:
        """The value of an expression."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return self.values[node.id]
        if isinstance(node, ast.Subscript):
            return self.builder.load(self.pointer(node))
        if isinstance(node, ast.Call):
            function: Any = node.func
            return self.applied(getattr(math, function.attr), [self.value(argument) for argument in node.args])
        if isinstance(node, ast.UnaryOp):
            return self.applied(OPERATORS[type(node.op)], [self.value(node.operand)])
        if isinstance(node.op, ast.Pow):
            return self.power(self.number(self.value(node.left)), _exponent(node))
        return self.applied(OPERATORS[type(node.op)], [self.value(node.left), self.value(node.right)])

    def applied(self, function: Any, arguments: list[Any]) -> Any:
        """An operator, or a function of `math`, of numbers."""
        from numba.core import types

        if function in OPERATORS.values() and all(isinstance(argument, (int, float)) for argument in arguments):
            return function(*arguments)
        return self.meaning(function, (types.float64,) * len(arguments))(self.builder, [*map(self.number, arguments)])

    def power(self, base: Any, exponent: Any) -> Any:
        """A power with an exponent that is written out, by the products that numba makes of it if it is whole."""
        if isinstance(exponent, float):
            return self.applied(operator.pow, [base, exponent])
        product, square, left = self.number(1.0), base, abs(exponent)
        while left:
            if left & 1:
                product = self.applied(operator.mul, [product, square])
            left >>= 1
            square = self.applied(operator.mul, [square, square])
        return self.applied(operator.truediv, [1.0, product]) if exponent < 0 else product

    def meaning(self, function: Any, kinds: tuple[Any, ...]) -> Any:
        """What writes a function of numbers."""
        key = function, kinds
        if key not in self.meanings:
            resolved = self.typing_context.resolve_value_type(function)
            signature = resolved.get_call_type(self.typing_context, kinds, {})
            self.meanings[key] = self.context.get_function(resolved, signature)
        return self.meanings[key]

    def number(self, value: Any) -> Any:
        """LLVM's value of a number."""
        from numba.core import types

        if isinstance(value, (int, float)):
            return self.context.get_constant(types.float64, float(value))
        return value

    def pointer(self, node: Any) -> Any:
        """The address of an entry."""
        from numba.core import types

        fields: Any = self.context.data_model_manager[types.float64[::1]]
        data = self.builder.extract_value(self.values[node.value.id], fields.get_field_position("data"))
        return self.builder.gep(data, [self.context.get_constant(types.intp, node.slice.value)])
