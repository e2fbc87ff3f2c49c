"""Fast translation of kernels that consist of formulas, from Python's syntax tree to LLVM's intermediate code.

numba determines the type of every operation by a search among all its functions, which takes a millisecond for each. In
a kernel of formulas all values are floating-point numbers. Its statements assign to names and to entries of arrays with
constant indices. Such a kernel needs no search. It is translated here in a fifth of numba's time, into the same
operations in the same order. numba translates all other functions itself.
"""

import ast
import itertools
import linecache
import math
import operator
from types import CodeType, FunctionType

from llvmlite import ir
from numba import config, njit, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

REAL, INDEX = ir.DoubleType(), ir.IntType(64)
OPERATIONS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
OF_ONE = {
    name: getattr(math, name)
    for name in (
        "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "expm1",
        "log", "log1p", "sqrt", "fabs", "erf",
    )
}  # fmt: skip
"""Functions of the module math with one argument, by name."""
LARGEST_POWER = 64  # a larger exponent is left to numba


def inner_kernel(function):
    """Return a function that only compiled functions call, compiled by numba; see `translate_formulas`.

    Arguments are contiguous arrays of floating-point numbers, and numbers.
    """
    if config.DISABLE_JIT:
        return function
    made = njit(error_model="numpy")(function)
    made.may_be_formulas = True
    return made


def translate_formulas(space):
    """Replace kernels of formulas in the namespace of a module by kernels that are translated from their syntax trees.

    The attribute `py_func` of a new kernel is still the function of the module.
    """
    for name, value in list(space.items()):
        if getattr(value, "may_be_formulas", False):
            value.may_be_formulas = False
            if (definition := definition_of(value.py_func)) is not None:
                caller = _caller(value.py_func, definition)
                space[name] = made = njit(error_model="numpy")(caller)
                made.py_func, made.caller = value.py_func, caller


def definition_of(function):
    """Return the syntax tree of a function of formulas, or None for any other function."""
    definition = _read(function)
    if definition is None:
        return None
    if isinstance(definition.body[0], ast.Expr) and isinstance(definition.body[0].value, ast.Constant):
        definition.body.pop(0)  # the docstring
    if not definition.body:
        return None
    arguments, known = {argument.arg for argument in definition.args.args}, set[str]()
    numbers = arguments - {
        node.value.id
        for node in ast.walk(definition)
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name)
    }
    for place, statement in enumerate(definition.body):
        match statement:
            case ast.Return(value=value) if value is not None and place == len(definition.body) - 1:
                written = None
            case ast.Assign(targets=[written], value=value) | ast.AugAssign(target=written, value=value):
                pass
            case _:
                return None
        if isinstance(statement, ast.AugAssign) and type(statement.op) not in OPERATIONS:
            return None
        if not is_formula(value, arguments - numbers, numbers | known, function.__globals__):
            return None
        if isinstance(written, ast.Name) and not isinstance(statement, ast.AugAssign):
            known.add(written.id)
        elif written is not None and not is_entry(written, arguments - numbers):
            return None
    return definition


def _read(function):
    """Return the syntax tree of a function from its file, or None if the file has another text."""
    code = function.__code__
    linecache.checkcache(code.co_filename)
    head, *lines = linecache.getlines(code.co_filename)[code.co_firstlineno - 1 :] or [""]
    while not head.startswith("def ") and lines:  # decorators
        head, *lines = lines
    body = itertools.takewhile(lambda line: line.startswith((" ", "\n")), lines)
    try:
        module = ast.parse("".join(["import math\n", head, *body]))  # Python calls functions of imported modules faster
        (made,) = (c for c in compile(module, code.co_filename, "exec").co_consts if isinstance(c, CodeType))
        _, definition = module.body
    except (SyntaxError, ValueError):
        return None
    same = all(
        getattr(made, name) == getattr(code, name) for name in ("co_code", "co_consts", "co_names", "co_varnames")
    )
    return definition if same and isinstance(definition, ast.FunctionDef) else None


def is_entry(node, arrays):
    """Return True for an entry of one of the arrays with a constant index."""
    return (
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id in arrays
        and isinstance(node.slice, ast.Constant)
        and isinstance(node.slice.value, int)
    )


def is_formula(node, arrays, known, space):
    """Return True for a formula in `known` numbers, entries of `arrays`, and numbers of the module."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, (int, float)) and not isinstance(value, bool)
        case ast.Name(id=name):
            return name in known or type(space.get(name)) in (int, float)
        case ast.Subscript():
            return is_entry(node, arrays)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            return is_formula(operand, arrays, known, space)
        case ast.BinOp(left=left, op=op, right=right):
            exponent = _integer(right) if isinstance(op, ast.Pow) else None
            if type(op) not in (*OPERATIONS, ast.Pow) or (exponent is not None and abs(exponent) > LARGEST_POWER):
                return False
            return all(is_formula(operand, arrays, known, space) for operand in (left, right))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="math"), attr=name), args=[argument], keywords=[]):
            return name in OF_ONE and is_formula(argument, arrays, known, space)
        case _:
            return False


def _integer(node):
    """Return the value of an integer constant with or without a sign, or None for any other formula."""
    match node:
        case ast.Constant(value=int() as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as value)):
            return -value
        case _:
            return None


def _caller(function, definition):
    """Return a Python function with the arguments of `function` that passes them to its translation."""
    names = [argument.arg for argument in definition.args.args]
    returns = isinstance(definition.body[-1], ast.Return)
    space = function.__globals__

    def generate(context, builder, signature, values):
        known = {}
        for name, value, kind in zip(names, values, signature.args, strict=True):
            if isinstance(kind, types.Array):
                value = context.make_array(kind)(context, builder, value).data
            elif kind != types.float64:
                value = context.cast(builder, value, kind, types.float64)
            known[name] = value
        result = Translation(context, builder, known, space).run(definition.body)
        return result if returns else context.get_dummy_value()

    def typed(*kinds):
        for name, kind in zip(names, kinds, strict=True):
            if not isinstance(kind, types.Number) and (kind.dtype, kind.ndim, kind.layout) != (types.float64, 1, "C"):
                raise TypingError(f"{name} of {function.__name__} is {kind}, expected an array of float64 or a number")
        return (types.float64 if returns else types.none)(*kinds), generate

    listed = ", ".join(names)
    made = {"typed": typed}
    exec(f"def translated(typingctx, {listed}):\n    return typed({listed})", made)
    source = (
        f"def within(translation):\n    def caller({listed}):\n        return translation({listed})\n    return caller"
    )
    exec(source, made)
    caller = made["within"](intrinsic(made["translated"]))
    return FunctionType(
        caller.__code__.replace(co_name=function.__name__), space, function.__name__, None, caller.__closure__
    )


class Translation:
    """The emission of intermediate code for statements with the values of `known` names."""

    def __init__(self, context, builder, known, space):
        self.context, self.builder, self.known, self.space = context, builder, known, space

    def run(self, statements):
        """Emit all statements and return the value of the last one if it returns a value."""
        for statement in statements:
            value = self.value(statement.value)
            match statement:
                case ast.Return():
                    return value
                case ast.Assign(targets=[ast.Name(id=name)]):
                    self.known[name] = value
                case ast.Assign(targets=[entry]):
                    self.builder.store(value, self.place(entry))
                case ast.AugAssign(target=entry, op=op):
                    place = self.place(entry)
                    before = self.builder.load(place)
                    self.builder.store(getattr(self.builder, OPERATIONS[type(op)])(before, value), place)
        return None

    def place(self, entry):
        """Return the pointer to an entry of an array."""
        return self.builder.gep(self.known[entry.value.id], [ir.Constant(INDEX, entry.slice.value)])

    def value(self, node):
        """Emit a formula and return its value."""
        builder = self.builder
        match node:
            case ast.Constant(value=number):
                return ir.Constant(REAL, float(number))
            case ast.Name(id=name):
                return self.known[name] if name in self.known else ir.Constant(REAL, float(self.space[name]))
            case ast.Subscript():
                return builder.load(self.place(node))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=number)):
                return ir.Constant(REAL, -float(number))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return builder.fneg(self.value(operand))
            case ast.UnaryOp(operand=operand):
                return self.value(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                exponent = _integer(right)
                if exponent is not None:
                    return self.power(self.value(left), exponent)
                return self.called(operator.pow, self.value(left), self.value(right))
            case ast.BinOp(left=left, op=op, right=right):
                return getattr(builder, OPERATIONS[type(op)])(self.value(left), self.value(right))
            case _:  # a function of the module math, the last kind of formula
                return self.called(OF_ONE[node.func.attr], self.value(node.args[0]))

    def called(self, function, *values):
        """Emit numba's code of a function of real numbers."""
        implementation = self.context.get_function(function, types.float64(*[types.float64] * len(values)))
        return implementation(self.builder, values)

    def power(self, base, exponent):
        """Emit repeated products, in numba's order."""
        result, rest = None, abs(exponent)
        while rest:
            if rest & 1:
                result = base if result is None else self.builder.fmul(result, base)
            rest >>= 1
            if rest:
                base = self.builder.fmul(base, base)
        if result is None:
            return ir.Constant(REAL, 1.0)
        return self.builder.fdiv(ir.Constant(REAL, 1.0), result) if exponent < 0 else result
