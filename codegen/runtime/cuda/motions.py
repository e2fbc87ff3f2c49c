"""Motions of many cases on a GPU: one case a thread, by the functions that follow a motion on a processor."""

from functools import lru_cache

import numpy as np
from numba import cuda

from codegen.runtime.cuda.functions import Device, flat, on_device
from codegen.runtime.cuda.memory import Columns, Kept, free_memory, sent, viewed, work_space
from codegen.runtime.cuda.optima import IN_BLOCK, shares
from codegen.runtime.stepping import ensembles
from codegen.runtime.stepping.motion import MOST, TOLERANCE
from codegen.runtime.stepping.steps import memory_for

ARGUMENTS = {
    "explicit": 5, "predict": 5, "residual": 6, "jacobian": 7, "complete": 6, "equations": 6, "used_inputs": 6,
}  # fmt: skip
"""Numbers of arguments of the kernels of a step, by the field of a Scheme with their address."""


@lru_cache(maxsize=16)
def kernel_of(problem):
    """Return the kernel that follows the motions of a problem, compiled at its first launch."""
    device = Device()
    kernels = {
        "explicit": problem.explicit, "predict": problem.predict, "jacobian": problem.jacobian,
        "residual": problem.residual if problem.is_constant else None, "complete": problem.complete,
        "equations": problem.equations, "used_inputs": problem.inputs,
    }  # fmt: skip
    for name, kernel in kernels.items():
        own = on_device(_nothing(ARGUMENTS[name])) if kernel is None else device[kernel]
        device.replaced[f"call_{name}"] = on_device(_calling(own))
    device.replaced |= {"reals_at": on_device(_itself), "integers_at": on_device(_itself), "data_of": flat}
    device.replaced["moved"] = device.replaced["ahead"]
    follow = device[ensembles.follow_case]

    @cuda.jit
    def follow_all(scheme, memory, ensemble, steps, tolerance, most, every, followed):
        """Follow every case whose index is that of the thread plus a multiple of the number of threads."""
        thread = cuda.grid(1)
        own = memory[:, thread]
        for case in range(thread, ensemble.h.size, cuda.gridsize(1)):
            if ensemble.is_usable[case]:
                follow(case, scheme, own, ensemble, steps, tolerance, most, every, followed)

    return follow_all


def _calling(function):
    """Return a function (address, arguments) that calls a device function with the arguments."""

    def calling(_, arguments):
        function(*arguments)

    return calling


def _nothing(count):
    """Return a function of `count` arguments that does nothing, in place of a kernel that a scheme lacks."""
    space = {}
    exec(f"def nothing({', '.join(f'a{i}' for i in range(count))}):\n    pass", space)
    return space["nothing"]


def _itself(array):
    """Return the array, in place of a pointer to the numbers at an address."""
    return array


def follow_ensemble(problem, ensemble, steps, every, followed, tolerance=TOLERANCE, most=MOST, is_kept=False):
    """Follow the motions of all usable cases on the device, as `ensembles.follow_ensemble` does on the processor.

    The paths in `followed` are on the device if `is_kept` is True. Raises Full if the memory of the device does not
    suffice.
    """
    kernel, k, scheme = kernel_of(problem), ensemble.h.size, problem.scheme
    memory = memory_for(scheme)
    on_case = sum(array[:1].nbytes for array in (*ensemble[:4], *followed[1 if is_kept else 0 :]))
    threads, cases = shares(memory.nbytes, on_case, k, free_memory())
    spaces = work_space(memory, threads)
    numbers = sent((np.ravel(problem.fractions).astype(float), np.append(problem.ranges, 0)))  # none is empty
    scheme = scheme._replace(fractions=numbers[0], ranges=numbers[1])
    for begin in range(0, k, cases):
        part = slice(begin, min(k, begin + cases))
        count = part.stop - begin
        own = type(ensemble)(*(Columns(array[part]) for array in ensemble[:4]), Columns(ensemble.spans))
        if is_kept:
            states = Kept(followed.path[part]), Columns.without_numbers(followed.before[part].shape)
        else:
            states = tuple(Columns(array[part]) for array in followed[:2])
        results = type(followed)(*states, *(Columns(array[part]) for array in followed[2:]))
        blocks = -(-min(threads, count) // IN_BLOCK)
        kernel[blocks, IN_BLOCK](scheme, spaces, viewed(own), steps, tolerance, most, every, viewed(results))
        for array, columns in [*zip(followed, results, strict=True)][2 if is_kept else 0 :]:
            array[part] = columns.fetched()
