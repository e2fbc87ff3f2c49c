"""Compiled linear systems: one for each Shape, with its numbers as constants, and one for all shapes.

numba translates the system once on a machine into LLVM's intermediate code, in which the sizes of a Shape are
arguments. For each Shape, LLVM then makes machine code of this code, with the numbers of unknowns as constants.
Constants halve the time of a factorisation. Problems of equal Shape share the machine code. It is kept in the cache
folder.

The system for all shapes reads the numbers at run time and needs no compilation for a new Shape. This takes less time
for many small problems, such as tests.

The program `python -m codegen.runtime.kkt.specialised` prints the intermediate code. It is a program, because numba
gives no machine code to functions that are linked into their callers, and Python could no longer call them.
"""

import hashlib
import os
import re
import subprocess
import sys
from functools import lru_cache, partial
from pathlib import Path
from threading import get_ident
from types import SimpleNamespace

import llvmlite.binding as llvm
from numba import config, njit

from codegen.runtime.addresses import SYSTEM, callback
from codegen.runtime.kept_code import SEALED, fingerprint, is_sealed, sealed
from codegen.runtime.kkt.shape import SHAPE, Shape, place_of
from codegen.runtime.kkt.system import solve_system

ENTRY = "linear_system"
"""The name of the function in the machine code."""
PROGRAM = """
import runpy, sys
sys.path.insert(0, sys.argv.pop(1))
runpy.run_module("codegen.runtime.kkt.specialised", run_name="__main__")
"""


def cache_folder():
    """Return the path of the build cache: $CODEGEN_CACHE_DIR, or a folder in the user's cache directory."""
    folder = os.environ.get("CODEGEN_CACHE_DIR")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "variational-codegen"


def path_of(shape):
    """Return the path of the machine code for a Shape, or for all shapes if `shape` is None."""
    text = f"{shape and tuple(shape)} {processor()} {fingerprint()}"
    return cache_folder() / "kkt" / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.o"


def processor():
    """Return name and features of the processor: those that NUMBA_CPU_NAME prescribes, or those that LLVM finds."""
    name, features = config.CPU_NAME, config.CPU_FEATURES
    if name is None:
        return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    return name, features or ""


def kept(path, make):
    """Return the bytes of a file of the cache; if the file is missing or damaged, `make` them and write the file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    if not is_sealed(data):
        data = sealed(make())
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.{get_ident()}")
        temporary.write_bytes(data)
        temporary.replace(path)
    return data[:-SEALED]


@lru_cache(maxsize=1)
def intermediate_code():
    """Return the intermediate code of the linear system for all shapes, made by another process."""
    path = cache_folder() / "kkt" / f"{fingerprint()[:16]}.ll"
    command = [sys.executable, "-P", "-c", PROGRAM, str(Path(__file__).parents[3])]
    return kept(path, lambda: subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout).decode()


def machine():
    """Return LLVM's description of the processor and of the code that it should make."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = processor()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=3, reloc="default", codemodel="jitdefault", jit=True
    )


def machine_code(shape):
    """Return the machine code of the linear system for a Shape, or for all shapes if `shape` is None."""
    module = llvm.parse_assembly(intermediate_code())
    (read_at_run_time,) = (f for f in module.functions if "solve_any_shape" in f.name)
    with_arguments = [f for f in module.functions if shape and "solve_system" in f.name]
    if with_arguments:
        module.link_in(llvm.parse_assembly(entry_of(with_arguments[0], shape)))
    else:  # also if an untested version of numba has inlined `solve_system`
        module.link_in(llvm.parse_assembly(entry_of(read_at_run_time, ())))
    for function in module.functions:
        if function.name != ENTRY and not function.is_declaration:
            function.linkage = "internal"  # it need not exist on its own
    target, options = machine(), llvm.create_pipeline_tuning_options(speed_level=3 if shape else 1)
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = bool(shape)
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return target.emit_object(module)


def entry_of(function, sizes):
    """Return the intermediate code of a function with the SYSTEM signature that calls `function` with these sizes.

    Functions of numba write their result to a pointer, their first argument. The second one takes exceptions, of which
    the linear system raises none.
    """
    result, exception, *kinds = (str(argument.type) for argument in function.arguments)
    own = [f"{kind} %{i}" for i, kind in enumerate(kinds[len(sizes) :])]
    given = [f"{result} %result", f"{exception} null", *(f"i64 {size}" for size in sizes), *own]
    return f"""
declare i32 @"{function.name}"({", ".join([result, exception, *kinds])})
define i64 @{ENTRY}({", ".join(own)}) {{
    %result = alloca i64
    %status = call i32 @"{function.name}"({", ".join(given)})
    %value = load i64, {result} %result
    ret i64 %value
}}
"""


@lru_cache(maxsize=256)
def compiled_system(shape):
    """Return the linear system of a Shape, or for all shapes if None; its attribute `address` is that for calls."""
    if config.DISABLE_JIT:
        return callback(SYSTEM, partial(solve_system, shape) if shape else solve_any_shape)
    code = llvm.ObjectFileRef.from_data(kept(path_of(shape), partial(machine_code, shape)))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine())
    engine.add_object_file(code)
    engine.finalize_object()
    return SimpleNamespace(address=engine.get_function_address(ENTRY), engine=engine)  # the code lives in the engine


def solve_any_shape(
    is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step, is_wanted
):
    """Call `solve_system` with the Shape in the index tables."""
    p = place_of(tables, SHAPE)
    shape = Shape(
        tables[p], tables[p + 1], tables[p + 2], tables[p + 3], tables[p + 4], tables[p + 5], tables[p + 6],
        tables[p + 7], tables[p + 8], tables[p + 9], tables[p + 10], tables[p + 11], tables[p + 12], tables[p + 13],
    )  # fmt: skip
    return solve_system(
        shape, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    )  # fmt: skip


def translated():
    """Return the intermediate code of `solve_any_shape` and of all functions that it calls."""
    from codegen.runtime.linking import link_inner_functions  # for this program alone

    function = njit(error_model="numpy")(solve_any_shape)
    files = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("codegen.runtime.kkt.")]
    link_inner_functions(value for space in files for value in space.values() if hasattr(value, "py_func"))
    link_inner_functions([function])
    function.compile(SYSTEM.args)
    # numba counts references to arrays. The linear system works on the memory of its caller, where there are none.
    code = function.inspect_llvm(SYSTEM.args)
    return re.sub(r"^.*\bcall\b.*@NRT_(incref|decref)\(.*\n", "", code, flags=re.MULTILINE)


def is_made(shape):
    """Return True if the machine code of the linear system of a Shape is on the disk."""
    try:
        return is_sealed(path_of(shape).read_bytes())
    except FileNotFoundError:
        return False


if __name__ == "__main__":
    sys.stdout.write(translated())
