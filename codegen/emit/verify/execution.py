"""Execution of generated text by Python: definitions of a module unchanged, and kernels in any arithmetic.

Sympy expressions are evaluated operation by operation in any arithmetic, equal subexpressions only once. This code has
nothing in common with differentiation, with the search for common subexpressions, or with printing.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from importlib import resources
from types import CodeType, SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
import sympy
from sympy import Basic, Expr, Symbol

from codegen.emit.rendering import names_read
from codegen.errors import VerificationError
from codegen.runtime.kernels import with_counts
from codegen.symbolic.functions import STEMS, TableBase
from codegen.symbolic.graph import Assignment
from codegen.symbolic.tables import ORDERS, TableData, derivative

Operand: TypeAlias = Any
"""A number or an array: a complex array, a number of mpmath, or a number with the size of its terms (`Sized`)."""
Function: TypeAlias = Callable[..., Operand]
"""A function of operands, or a kernel that the interpreter executes."""


def defect(finding: str) -> VerificationError:
    """Return the error for text that differs from the problem."""
    return VerificationError(
        finding, "this is a defect of codegen, and nothing was written; please report it with the problem file"
    )


@dataclass(frozen=True)
class Arithmetic:
    """The operations on one type of operands: `number` from digits, `function` by its name in `math`, and so on."""

    number: Callable[[str], Operand]
    function: Callable[[str], Function]
    power: Function
    maximum: Function
    minimum: Function
    absolute: Function
    sign: Function
    where: Function
    real: Function


class Tape:
    """A list of all subexpressions of some expressions, arguments first; they may read symbols in `assignments`."""

    def __init__(self, expressions: Sequence[Expr], assignments: Sequence[Assignment] = ()) -> None:
        self.assignments = [(symbol, Tape([value])) for symbol, value in assignments]
        self.indices: dict[Basic, int] = {}
        self.parts: list[tuple[Basic, tuple[int, ...]]] = []
        roots = [sympy.sympify(e) for e in expressions]
        waiting = roots[::-1]
        while waiting:
            part = waiting[-1]
            missing = [] if part in self.indices else [a for a in part.args if a not in self.indices]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if part not in self.indices:
                self.indices[part] = len(self.parts)
                self.parts.append((part, tuple(self.indices[a] for a in part.args)))
        self.results = [self.indices[root] for root in roots]

    def evaluate(self, values: Mapping[Symbol, Operand], arithmetic: Arithmetic) -> list[Operand]:
        """Return the values of the expressions for given values of their symbols."""
        results: list[Operand] = []
        values = dict(values)
        for symbol, tape in self.assignments:
            values[symbol] = tape.evaluate(values, arithmetic)[0]
        for part, indices in self.parts:
            results.append(_value(part, [results[index] for index in indices], values, arithmetic))
        return [results[index] for index in self.results]


def _value(part: Basic, operands: list[Operand], values: Mapping[Symbol, Operand], a: Arithmetic) -> Operand:
    """Return the value of an expression `part` from the values `operands` of its arguments."""
    if part.is_Symbol:
        return values[part]
    if part.is_Rational:
        return a.number(str(part.p)) / a.number(str(part.q)) if part.q != 1 else a.number(str(part.p))
    if part.is_Number or isinstance(part, sympy.NumberSymbol):
        return a.number(str(part.evalf(130)))
    if part.is_Add:
        return reduce(operator.add, operands)
    if part.is_Mul:
        return reduce(operator.mul, operands)
    if part.is_Pow:
        exponent = part.exp
        if exponent.is_Integer:
            return a.power(operands[0], int(exponent))
        return a.function("sqrt")(operands[0]) if exponent == sympy.S.Half else a.power(*operands)
    if isinstance(part, sympy.Piecewise):
        return reduce(lambda rest, pair: a.where(pair[1], pair[0], rest), reversed(operands), a.number("nan"))
    if isinstance(part, sympy.functions.elementary.piecewise.ExprCondPair):
        return tuple(operands)
    if part.is_Boolean or part.is_Relational:
        if part.is_Relational:
            return _RELATIONS[part.rel_op](*map(a.real, operands))
        if isinstance(part, sympy.Not):
            return operands[0] == False  # noqa: E712  # arrays are negated one by one
        if isinstance(part, (sympy.And, sympy.Or)):
            return reduce(operator.and_ if isinstance(part, sympy.And) else operator.or_, operands)
        return bool(part)
    if isinstance(part, TableBase):
        return derivative(part.table, part.order, operands, a.real)
    name = type(part).__name__
    functions = {"Abs": a.absolute, "Max": a.maximum, "Min": a.minimum, "sign": a.sign}
    if name == "Heaviside":
        return (a.sign(operands[0]) + 1) / 2
    return functions[name](*operands) if name in functions else a.function(name)(*operands)


_RELATIONS: dict[str, Function] = {
    **{"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge},
    **{"==": operator.eq, "!=": operator.ne},
}


class Text:
    """The text of a module, whose definitions are executed without compilation to machine code.

    Kernels that look up `tables` evaluate the tables themselves instead of the emitted look-up functions.
    """

    def __init__(self, text: str, tables: Sequence[TableData] = ()) -> None:
        self._tables = {table.shape.lookup: table for table in tables}
        self._imports: list[ast.stmt] = []
        self._parts: dict[str, ast.stmt] = {}
        self._codes: dict[tuple[str, ...], CodeType] = {}
        self._reads: dict[str, set[str]] = {}
        for node in ast.parse(text).body:
            if isinstance(node, ast.Import):
                self._imports.append(node)
            elif isinstance(node, ast.ImportFrom):
                self._import(node)
            elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                self._parts[node.name] = node
            elif isinstance(node, ast.Assign):
                parts = (p for t in node.targets for p in (t.elts if isinstance(t, ast.Tuple) else [t]))
                named = (part for part in parts if isinstance(part, ast.Name))
                self._parts |= {part.id: node for part in named}

    def _import(self, node: ast.ImportFrom) -> None:
        """Add the definitions that kernels import from the runtime to the definitions in the text."""
        module = str(node.module)
        included = "codegen.runtime.arithmetic", "codegen.runtime.particles.", "codegen.runtime.tabulated"
        if not module.startswith(included):
            if module not in ("numba", "codegen.runtime.kernels", "codegen.runtime.formulas"):
                self._imports.append(node)
            return
        *folders, name = module.split(".")[1:]
        file = resources.files("codegen").joinpath(*folders, f"{name}.py")
        for part in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(part, ast.FunctionDef):
                self._parts.setdefault(part.name, part)
            elif isinstance(part, ast.Assign):
                targets = (t for target in part.targets for t in ast.walk(target) if isinstance(t, ast.Name))
                for target in targets:
                    self._parts.setdefault(target.id, part)

    def defines(self, name: str) -> bool:
        """Return True if the text defines a function, class or constant of this name."""
        return name in self._parts

    def interpreted(self, *names: str) -> dict[str, Operand]:
        """Execute the named definitions and all that they need, without numba's decorators; return the namespace."""
        namespace: dict[str, Operand] = {"prange": range, "__name__": "emitted", "carray": _carray}
        namespace |= dict.fromkeys(("Kernel", "Value", "Contracted"), _with_counts)
        namespace["njit"] = lambda **_: lambda function: function
        namespace["inner_kernel"] = lambda function: function
        namespace["_interpreted"] = lambda loop: lambda function: loop(function, is_interpreted=True)
        body = [*self._imports, *ast.parse("Loop = _interpreted(globals().get('Loop'))").body, *self._needed(names)]
        exec(compile(ast.Module(body=body, type_ignores=[]), "<emitted>", "exec"), namespace)
        namespace["math"] = _QuietMath()  # functions read this name when they are called
        return namespace

    def kernels(self, names: Sequence[str], arithmetic: Arithmetic) -> dict[str, Function]:
        """Return the named functions, by name, so that they and all functions that they call use an arithmetic."""
        key = tuple(names)
        if key not in self._codes:
            needed = self._needed(names, {*STEMS, *self._tables})
            functions = [node for node in needed if isinstance(node, ast.FunctionDef)]
            for function in functions:
                _Rewritten().visit(function)
            tables = [node for node in needed if _is_table(node)]
            module = ast.fix_missing_locations(ast.Module(body=[*tables, *functions], type_ignores=[]))
            self._codes[key] = compile(module, "<kernels>", "exec")

        def compared(operation: Function) -> Function:
            return lambda one, other: operation(arithmetic.real(one), arithmetic.real(other))

        comparisons: dict[str, Function] = {
            "Lt": operator.lt,
            "LtE": operator.le,
            "Gt": operator.gt,
            "GtE": operator.ge,
        }
        comparisons |= {"Eq": operator.eq, "NotEq": operator.ne}

        def family(stem: str) -> Function:
            return lambda order, x: arithmetic.function(f"{stem}_{order}")(x)

        # The names that rewritten kernels call.
        namespace: dict[str, Operand] = {
            **{stem: family(stem) for stem in STEMS},
            **{f"_{name}": compared(operation) for name, operation in comparisons.items()},
            **{"_And": operator.and_, "_Or": operator.or_, "_Not": lambda condition: condition == False},  # noqa: E712
            **{"_power": arithmetic.power, "_where": arithmetic.where, "abs": arithmetic.absolute},
            **{"max": arithmetic.maximum, "min": arithmetic.minimum, "math": _Functions(arithmetic)},
            **{"np": SimpleNamespace(**{"sign": arithmetic.sign, "array": np.array}), "range": range},
        }
        for name, table in self._tables.items():
            namespace[name] = partial(_lookup, table, arithmetic)
        exec(self._codes[key], namespace)
        return {name: namespace[name] for name in names if name in self._parts}

    def _needed(self, names: Iterable[str], replaced: Collection[str] = ()) -> list[ast.stmt]:
        """Return the named definitions and all that they read, in the order of the text, except `replaced` names."""
        waiting, needed = list(names), set[str]()
        while waiting:
            name = waiting.pop()
            if name in self._parts and name not in needed and name not in replaced:
                needed.add(name)
                if name not in self._reads:
                    self._reads[name] = names_read(self._parts[name])
                waiting += self._reads[name]
        return list(dict.fromkeys(node for name, node in self._parts.items() if name in needed))


def _is_table(node: ast.stmt) -> bool:
    """Return True for an array of numbers, such as the indices of a loop."""
    return (
        isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "np.array"
    )


def _lookup(table: TableData, a: Arithmetic, parameters: Operand, *at: Operand) -> tuple[Operand, ...]:
    """Return a table's value and derivatives at a point, in the order of an emitted look-up."""
    return tuple(derivative(table, order, at, a.real) for order in ORDERS[len(table.shape.inputs)])


class _QuietMath:
    """The functions of `math`, which return NaN where Python raises errors; machine code raises no errors either."""

    def __getattr__(self, name: str) -> Operand:
        attribute = getattr(math, name)
        if not callable(attribute):
            return attribute

        def called(*arguments: float) -> Operand:
            try:
                return np.float64(attribute(*arguments))
            except (ValueError, OverflowError):
                return np.float64(np.nan)

        return called


def _carray(pointer: Operand, shape: Operand) -> Operand:
    """Return an array over the memory at a pointer, as numba's `carray` does; return an array unchanged."""
    if isinstance(pointer, np.ndarray):
        return pointer
    from numba import carray

    return carray(pointer, shape)


def _with_counts(function: Function) -> Function:
    """Return a kernel that takes the counts of particles and columns from its arrays instead of as arguments."""
    code = function.__code__
    names = code.co_varnames[: code.co_argcount]
    return lambda *values: function(*with_counts(names, values))


class _Functions:
    """A replacement for module `math` in executed kernels, with the functions of an arithmetic."""

    def __init__(self, arithmetic: Arithmetic) -> None:
        self._arithmetic = arithmetic

    def __getattr__(self, name: str) -> Operand:
        if name in _NUMBERS:
            return self._arithmetic.number(_NUMBERS[name])
        return self._arithmetic.sign if name == "sign" else self._arithmetic.function(name)


class _Rewritten(ast.NodeTransformer):
    """A rewriter of powers, choices and comparisons as calls, because Python's operators do not suit arrays."""

    def visit(self, node: ast.AST) -> ast.AST:
        self.generic_visit(node)
        match node:
            case ast.FunctionDef():
                node.decorator_list = []
            case ast.BinOp(op=ast.Pow()):
                return _call("_power", node.left, node.right)
            case ast.IfExp():
                return _call("_where", node.test, node.body, node.orelse)
            case ast.Compare():
                return _call(f"_{type(node.ops[0]).__name__}", node.left, node.comparators[0])
            case ast.BoolOp():
                return reduce(partial(_call, f"_{type(node.op).__name__}"), node.values)
            case ast.UnaryOp(op=ast.Not()):
                return _call("_Not", node.operand)
        return node


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(func=ast.Name(id=name, ctx=ast.Load()), args=list(arguments), keywords=[])


_NUMBERS = {
    "pi": "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211706798",
    "e": "2.71828182845904523536028747135266249775724709369995957496696762772407663035354759457138217852516642743",
    "nan": "nan",
    "inf": "inf",
}


_POINTS = 6
_TOLERANCE = 1e-9


def verify_tables(tables: Sequence[TableData], first: int, text: Text) -> None:
    """Raise VerificationError if an emitted look-up differs from its table; tables start at parameter `first`."""
    if not tables:
        return
    module = text.interpreted("TABLES", *(table.shape.lookup for table in tables))
    numbers = np.concatenate([np.full(first, np.nan), *module["TABLES"].values()])
    for table in tables:
        generator = np.random.default_rng(11)
        for _ in range(_POINTS):
            # Points inside the table's range, and up to a tenth of its width outside.
            point = [float(axis[0] + generator.uniform(-0.1, 1.1) * np.ptp(axis)) for axis in table.axes]
            values = module[table.shape.lookup](numbers, *point)
            for order, value in zip(ORDERS[len(table.shape.sizes)], values, strict=True):
                right = float(derivative(table, order, point, lambda x: x))
                size = float(np.abs(table.heights).max()) * max(1.0, *(float(np.ptp(axis)) for axis in table.axes))
                for axis, o in zip(table.axes, order, strict=True):
                    size /= float(np.diff(axis).min(initial=1.0)) ** o
                if not abs(value - right) <= _TOLERANCE * size:
                    raise defect(
                        f"the emitted code gives {value:.8g} for derivative {order} of table {table.shape.name}, where "
                        f"{right:.8g} is right"
                    )
