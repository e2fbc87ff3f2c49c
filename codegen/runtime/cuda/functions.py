"""Device functions: the compiled functions of this package and of a generated module, translated for a GPU.

A device function has the source of a function that numba compiles for the processor, so that both do the same. Some
expressions have another form on a device. The translation is made on the syntax tree:

- A pointer is an array. `array.ctypes.data` is the array itself, and `carray` and `ahead` return views of it. The
  numbers of one problem are not neighbours in memory, as those of neighbouring threads are; a view keeps this distance.
- A new array, whose shape is constant in the module, is in the local memory of a thread.
- Functions of numpy for one number are those of the module math.
- A loop over an array of the module is a loop over its indices.
- Integer powers are products.
- A call by the address in a field, `call(scheme.jacobian, ...)`, is a call of the device function of that name.
- An argument that is the same in all calls, such as the Shape of a linear system, is a constant. Branches that it rules
  out are left out.

Large functions are not inlined: otherwise the compiler needs minutes in place of seconds.

With numba's simulator (the environment variable NUMBA_ENABLE_CUDASIM) device functions are Python functions with the
same translation.
"""

import ast
import inspect
import math
import textwrap
from types import CodeType

import numpy as np
from numba import config, cuda, types

IS_SIMULATED = bool(getattr(config, "ENABLE_CUDASIM", False))
LOCAL_ARRAY = "np_.empty" if IS_SIMULATED else "cuda_.local.array"
SMALL_POWER = 4  # larger powers are calls
LARGE = 12  # statements of a function that is not inlined

if IS_SIMULATED:

    def view(array, shape):
        """Return a view of an array with another shape, whose numbers have the distance of those in the last axis."""
        step, strides = array.strides[-1], []
        for size in reversed(shape):
            strides.insert(0, step)
            step *= int(size)
        return np.lib.stride_tricks.as_strided(array, shape, strides)

    def flat(array):
        """Return a view of an array with one index, whose numbers have the distance of those in the last axis."""
        return view(array, (array.size,))

    def ahead(array, count):
        """Return the array without its first `count` numbers."""
        return array[count:]

    def apart():
        """Do nothing: there is nothing to inline."""

else:
    from llvmlite import ir
    from numba.core import cgutils
    from numba.cuda.extending import intrinsic

    @intrinsic
    def view(typingctx, array, shape):
        """Return a view of an array with another shape, whose numbers have the distance of those in the last axis."""
        kind = types.Array(array.dtype, len(shape.types), "A")

        def generate(context, builder, signature, values):
            whole = context.make_array(signature.args[0])(context, builder, values[0])
            sizes = [
                context.cast(builder, value, of, types.intp)
                for value, of in zip(cgutils.unpack_tuple(builder, values[1]), signature.args[1].types, strict=True)
            ]
            step, strides = cgutils.unpack_tuple(builder, whole.strides)[-1], []
            for size in reversed(sizes):
                strides.insert(0, step)
                step = builder.mul(step, size)
            return _array(context, builder, kind, whole, whole.data, sizes, strides)

        return kind(array, shape), generate

    @intrinsic
    def flat(typingctx, array):
        """Return a view of an array with one index, whose numbers have the distance of those in the last axis."""
        kind = types.Array(array.dtype, 1, "A")

        def generate(context, builder, signature, values):
            whole = context.make_array(signature.args[0])(context, builder, values[0])
            step = cgutils.unpack_tuple(builder, whole.strides)[-1]
            return _array(context, builder, kind, whole, whole.data, [whole.nitems], [step])

        return kind(array), generate

    @intrinsic
    def ahead(typingctx, array, count):
        """Return the array without its first `count` numbers."""
        kind = types.Array(array.dtype, 1, "A")

        def generate(context, builder, signature, values):
            whole = context.make_array(signature.args[0])(context, builder, values[0])
            (step,), (size,) = (cgutils.unpack_tuple(builder, part) for part in (whole.strides, whole.shape))
            number = context.cast(builder, values[1], signature.args[1], types.intp)
            bytes_at = builder.bitcast(whole.data, ir.IntType(8).as_pointer())
            data = builder.bitcast(builder.gep(bytes_at, [builder.mul(step, number)]), whole.data.type)
            return _array(context, builder, kind, whole, data, [builder.sub(size, number)], [step])

        return kind(array, count), generate

    @intrinsic
    def apart(typingctx):
        """Mark the function that calls this one: it is not inlined."""

        def generate(context, builder, signature, values):
            builder.function.attributes.add("noinline")
            return context.get_dummy_value()

        return types.void(), generate

    def _array(context, builder, kind, whole, data, shape, strides):
        """Return the LLVM value of an array of the numba type `kind` with the item size of `whole`."""
        made = context.make_array(kind)(context, builder)
        context.populate_array(made, data=data, shape=shape, strides=strides, itemsize=whole.itemsize, meminfo=None)
        return made._getvalue()


class Translation(ast.NodeTransformer):
    """The translation of a function's syntax tree, see the module.

    `names` are the global names of the function. `constants` are those of them that may be its first argument.
    """

    def __init__(self, names, constants):
        self.names, self.constants = names, constants

    def visit_FunctionDef(self, node):
        """Remove the first argument if it is a constant."""
        if node.args.args and node.args.args[0].arg in self.constants:
            del node.args.args[0]
        return self.generic_visit(node)

    def visit_If(self, node):
        """Replace a branch on constants by the statements that are executed."""
        names = {part.id for part in ast.walk(node.test) if isinstance(part, ast.Name)}
        self.generic_visit(node)
        if not names or not names <= set(self.constants):
            return node
        return (node.body if self.constant(node.test) else node.orelse) or ast.Pass()

    def constant(self, node):
        """Return the value of an expression of the module's names; raise NameError if it has others."""
        return eval(compile(ast.Expression(node), "<constant>", "eval"), dict(self.names))

    def array_of(self, node):
        """Return the array of the module that a node names, or None."""
        value = self.names.get(node.id) if isinstance(node, ast.Name) else None
        return value if isinstance(value, np.ndarray) else None

    def visit_Attribute(self, node):
        """Replace `array.ctypes.data` by the array, and a function of numpy by that of math."""
        self.generic_visit(node)
        inner = node.value
        if node.attr == "data" and isinstance(inner, ast.Attribute) and inner.attr == "ctypes":
            return inner.value
        is_numpy = isinstance(inner, ast.Name) and self.names.get(inner.id) is np
        if is_numpy and not IS_SIMULATED and callable(getattr(math, _OF_MATH.get(node.attr, node.attr), None)):
            return ast.Attribute(ast.Name("math_", ast.Load()), _OF_MATH.get(node.attr, node.attr), ast.Load())
        return node

    def visit_Call(self, node):
        """Replace a new array by one in local memory, the copy of an array of the module, and a call by address."""
        self.generic_visit(node)
        called = ast.unparse(node.func)
        if node.args and isinstance(node.args[0], ast.Name) and node.args[0].id in self.constants:
            del node.args[0]
        if called == "call" and isinstance(node.args[0], ast.Attribute):
            return ast.Call(ast.Name(f"call_{node.args[0].attr}", ast.Load()), node.args, [])
        if called in ("np.zeros", "np.empty"):
            shape = self.constant(node.args[0])
            made = ast.parse(f"{LOCAL_ARRAY}({shape!r}, float64_)", mode="eval").body
            return made if called == "np.empty" else ast.Call(ast.Name("zeroed_", ast.Load()), [made], [])
        is_copy = isinstance(node.func, ast.Attribute) and node.func.attr == "copy"
        if is_copy and self.array_of(node.func.value) is not None:
            return node.func.value
        return node

    def visit_For(self, node):
        """Replace a loop over an array of the module by a loop over its indices."""
        self.generic_visit(node)
        array = self.array_of(node.iter)
        if array is None:
            return node
        index = f"index_of_{node.target.id}"
        item = ast.parse(f"{node.target.id} = {node.iter.id}[{index}]").body
        numbers = ast.parse(f"range({array.shape[0]})", mode="eval").body
        return ast.For(ast.Name(index, ast.Store()), numbers, [*item, *node.body], node.orelse)

    def visit_BinOp(self, node):
        """Replace a small integer power by a product."""
        self.generic_visit(node)
        exponent = node.right.value if isinstance(node.right, ast.Constant) else None
        if isinstance(node.op, ast.Pow) and isinstance(exponent, int) and 2 <= exponent <= SMALL_POWER:
            return ast.Call(ast.Name(f"power{exponent}_", ast.Load()), [node.left], [])
        return node


_OF_MATH = {
    "abs": "fabs", "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "arcsinh": "asinh",
    "arccosh": "acosh", "arctanh": "atanh", "power": "pow",
}  # fmt: skip


def zeroed(array):
    """Return an array after its numbers are set to zero."""
    if array.ndim == 1:
        for i in range(array.size):
            array[i] = 0.0
    else:
        for i in range(array.shape[0]):
            zeroed_row(array[i])
    return array


def zeroed_row(row):
    """Set the numbers of a row to zero."""
    for i in range(row.size):
        row[i] = 0.0


def power2(x):
    """Return the square."""
    return x * x


def power3(x):
    """Return the cube."""
    return x * x * x


def power4(x):
    """Return the fourth power."""
    return (x * x) * (x * x)


def on_device(function, **options):
    """Return the device function of a Python function; with the simulator, the function itself."""
    return function if IS_SIMULATED else cuda.jit(device=True, **options)(function)


class Device:
    """The device functions of one problem.

    `replaced` maps names to device functions that take the place of functions with these names, such as calls by
    address. `constants` maps names of first arguments to their values. `device[function]` is the device function of a
    compiled function.
    """

    def __init__(self, constants=None):
        self.constants = constants or {}
        row = on_device(zeroed_row)
        clear = on_device(_with_names(zeroed, {"zeroed_row": row}))
        self.helpers = {
            "math_": math, "apart_": apart, "zeroed_": clear, "cuda_": cuda,
            "float64_": np.float64 if IS_SIMULATED else types.float64, "np_": np,
            **{f"{power.__name__}_": on_device(power) for power in (power2, power3, power4)},
        }  # fmt: skip
        self.replaced = {"carray": view, "ahead": ahead}
        self.made = {}

    def __getitem__(self, function):
        """Return the device function of a compiled function, and translate it if it is new."""
        python = python_of(function)
        if python not in self.made:
            self.made[python] = self._translated(function, python)
        return self.made[python]

    def _translated(self, function, python):
        """Return the device function of a compiled function, with the device functions that it calls."""
        names = {**inspect.getclosurevars(python).nonlocals, **python.__globals__, **self.constants}
        tree = ast.parse(textwrap.dedent(inspect.getsource(python)))
        ast.increment_lineno(tree, python.__code__.co_firstlineno - 1)
        (definition,) = tree.body
        definition.decorator_list = []
        options = getattr(function, "targetoptions", {})
        if not options.get("forceinline") and sum(1 for _ in ast.walk(definition) if isinstance(_, ast.stmt)) > LARGE:
            definition.body.insert(1, ast.Expr(ast.Call(ast.Name("apart_", ast.Load()), [], [])))
        tree = ast.fix_missing_locations(Translation(names, self.constants).visit(tree))
        space = {**names, **self.helpers}
        exec(compile(tree, inspect.getfile(python), "exec"), space)
        made = space[python.__name__]
        for name in set(_names_in(made.__code__)):
            if name in self.replaced:
                space[name] = self.replaced[name]
            elif name in names and is_compiled(names[name]):
                space[name] = self[names[name]]
        return on_device(made)


def python_of(function):
    """Return the Python function of a compiled function, a kernel or a loop."""
    return getattr(function, "py_func", None) or getattr(function, "function", None) or function


def is_compiled(value):
    """Return True for a function that numba compiles, a kernel or a loop."""
    return hasattr(value, "py_func") or (hasattr(value, "function") and hasattr(value, "is_interpreted"))


def _names_in(code):
    """Yield the global names of a function's code and of the functions inside it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_in(constant)


def _with_names(function, names):
    """Return a copy of a Python function with other global names."""
    space = {**function.__globals__, **names}
    return type(function)(function.__code__, space, function.__name__, function.__defaults__)
