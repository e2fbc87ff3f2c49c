"""Optima and motions of many cases on a GPU: one case a thread, by the functions for batches on a processor.

The index of a case or of a thread is the last one in memory, so that neighbouring threads read neighbouring numbers.
Each thread has its own work space and solves one case after the other. A case that needs more than one search is
marked; the processor then solves it.
"""

from functools import lru_cache

import numpy as np
from numba import cuda

from codegen.runtime.cuda.functions import IS_SIMULATED, Device, flat, on_device
from codegen.runtime.cuda.memory import Columns, Kept, free_memory, sent, viewed, work_space
from codegen.runtime.kkt.system import solve_system
from codegen.runtime.search import batch, descent, first_iterate, optimality
from codegen.runtime.search.batch import Space
from codegen.runtime.search.cascade import clip
from codegen.runtime.search.scaling import Room, fill_scaling_factors
from codegen.runtime.stepping import ensembles
from codegen.runtime.stepping.motion import MOST, TOLERANCE
from codegen.runtime.stepping.steps import memory_for

IN_BLOCK = 2 if IS_SIMULATED else 64
"""Threads of a block; with the simulator each is a thread of Python."""
MOST_THREADS = 1 << 17
"""Largest number of threads, some times those that a GPU runs at once."""
PART_OF_MEMORY = 0.8
"""Largest part of the free memory of a device that a batch takes."""
GRADIENT, HESSIANS, SYSTEM, WHOLE_GRADIENT, WHOLE_HESSIANS, STAGES = range(6)
"""Numbers in place of the addresses of loops and of the linear system."""


WORK_OF_SYSTEM = (1, 2, 3)
"""Places of the work space in the storage of the linear system, see `descent.descend`: factors, orders, entries."""


class Full(Exception):
    """The memory of the device does not suffice for the work space of one block of threads."""


@lru_cache(maxsize=16)
def kernel_of(problem):
    """Return the kernel that solves cases of a control problem, compiled at its first launch."""
    searched = problem.searched
    shape = searched.structure.shape
    device = Device({"shape": shape, "HAS_STAGES": shape.stages > 0})
    loops = [searched.gradient, searched.hessians]
    if problem.shooting is not None:
        loops += [problem.gradient, problem.hessians, problem.shooting.stages]
    gradient, hessians, *others = (device[loop] for loop in loops)
    system = device[solve_system]

    def call_two_loops(loop, unknowns, steps, h, nodes, parameters, width, filled):
        """Call the loop with the number `loop`."""
        if loop == GRADIENT:
            return gradient(unknowns, steps, h, nodes, parameters, width, filled)
        return hessians(unknowns, steps, h, nodes, parameters, width, filled)

    call_loop = on_device(call_two_loops)
    if others:
        call_searched, (whole_gradient, whole_hessians, stages) = call_loop, others

        def call_any_loop(loop, unknowns, steps, h, nodes, parameters, width, filled):
            """Call the loop with the number `loop`."""
            if loop == WHOLE_GRADIENT:
                return whole_gradient(unknowns, steps, h, nodes, parameters, width, filled)
            if loop == WHOLE_HESSIANS:
                return whole_hessians(unknowns, steps, h, nodes, parameters, width, filled)
            if loop == STAGES:
                return stages(unknowns, steps, h, nodes, parameters, width, filled)
            return call_searched(loop, unknowns, steps, h, nodes, parameters, width, filled)

        call_loop = on_device(call_any_loop)

    def call_system(
        address, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, order, step,
        is_wanted,
    ):  # fmt: skip
        """Call the linear system."""
        return system(
            np.int64(is_new), bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, order,
            step, np.int64(is_wanted),
        )  # fmt: skip

    device.replaced |= {"call_loop": call_loop, "call_system": on_device(call_system)}
    for name, function in {
        "call_descend": descent.descend, "call_begin_beside": first_iterate.begin_beside, "call_clip": clip,
        "call_scaling": fill_scaling_factors, "call_terms": optimality.terms,
    }.items():  # fmt: skip
        device.replaced[name] = on_device(_calling(device[function]))
    solved, verified, own_space = device[batch.is_case_solved], device[batch.is_case_verified], on_device(_own_space)

    @cuda.jit
    def solve(common, numbers, tolerance, limit, is_warm, space, found, others):
        """Solve every case whose index is that of the thread plus a multiple of the number of threads."""
        thread, (whole, residuals) = cuda.grid(1), others
        own, calls = own_space(space, thread), (0, 0, 0, 0, 0)
        for case in range(thread, numbers.h.size, cuda.gridsize(1)):
            is_found = found.is_found[case] and solved(
                case, calls, common, numbers, tolerance, limit, is_warm, own, found
            )
            if is_found:
                is_found = verified(case, common, numbers, tolerance, found, own.factors[2], whole, residuals)
            found.is_found[case] = is_found

    return solve


def _calling(function):
    """Return a function (address, arguments) that calls a device function with the arguments."""

    def calling(_, arguments):
        return function(*arguments)

    return calling


def _own_space(space, thread):
    """Return the work space of one thread."""
    system, room = space.system, space.room
    own_system = (
        system[0], system[1][:, thread], system[2][:, thread], system[3][:, thread], system[4], system[5], system[6],
        system[7], system[8], system[9], system[10],
    )  # fmt: skip
    return Space(
        own_system, space.reals[:, thread], space.integers[:, thread], space.vectors[:, :, thread],
        space.barriers[:, :, thread], space.pairs[:, :, thread], space.refinement[:, :, thread],
        space.log[:, :, thread], space.entries[:, thread], space.factors[:, :, thread],
        Room(
            room.of_unknowns[:, :, thread], room.of_kinds[:, :, thread], room.tables[:, :, :, thread],
            room.sums[:, :, :, thread],
        ),
        space.own[:, :, thread], space.entry_factors[:, :, thread], space.bound_indices[:, thread],
        space.bounds[:, :, thread],
    )  # fmt: skip


def solve_cases(grid, common, numbers, tolerance, limit, is_warm, space, found, whole, residuals):
    """Solve all cases on the device, and fill `found`, `whole` and `residuals`.

    The arguments are those of `batch.solve_cases` and `batch.verify_cases`; `grid` has stages. Raises Full if the
    memory of the device does not suffice.
    """
    problem, k = grid.problem, numbers.h.size
    is_whole = problem.shooting is None
    kernel, common = kernel_of(problem), sent(numbered(common, is_whole))
    threads, cases = shares(*bytes_of(space, numbers, found, is_whole), k, free_memory())
    spaces = spaces_of(space, threads)
    for begin in range(0, k, cases):
        part = slice(begin, min(k, begin + cases))
        count = part.stop - begin
        own = type(numbers)(*(Columns(array[part]) for array in numbers))
        results = type(found)(*(Columns(array[part]) for array in found))
        others = results.unknowns if is_whole else Columns(whole[part]), Columns(residuals[part])
        blocks = -(-min(threads, count) // IN_BLOCK)
        kernel[blocks, IN_BLOCK](
            common, viewed(own), tolerance, limit, is_warm, spaces, viewed(results), viewed(others)
        )
        for array, columns in zip((*found, whole, residuals), (*results, *others), strict=True):
            array[part] = columns.fetched()


def spaces_of(space, threads):
    """Return the Space with work space for each thread, and with the index tables on the device."""
    system = list(sent(space.system))
    for i in WORK_OF_SYSTEM:
        system[i] = work_space(space.system[i], threads)
    return work_space(space._replace(system=()), threads)._replace(system=tuple(system))


def numbered(common, is_whole):
    """Return the common data of a batch with numbers in place of the addresses of loops."""
    loops = (GRADIENT, HESSIANS, 0) if is_whole else (WHOLE_GRADIENT, WHOLE_HESSIANS, STAGES)
    return common._replace(problem=(GRADIENT, HESSIANS, SYSTEM), with_stages=loops)


def bytes_of(space, numbers, found, is_whole):
    """Return the bytes of memory that a thread and a case need."""
    of_case = sum(array[:1].nbytes for array in (*numbers, *found)) + (0 if is_whole else found.sizes[:1].nbytes) + 8
    return sum(array.nbytes for array in arrays_in(space)), of_case


def shares(of_thread, of_case, number, free):
    """Return how many threads and how many of `number` cases fit into `free` bytes; raises Full for less than a block.

    A thread and a case need `of_thread` and `of_case` bytes. Threads have the memory for at least two cases each.
    """
    fitting = int(PART_OF_MEMORY * free / (of_thread + 2 * of_case))
    threads = max(1, min(MOST_THREADS // IN_BLOCK, -(-number // IN_BLOCK), fitting // IN_BLOCK)) * IN_BLOCK
    if threads * (of_thread + of_case) > free:
        needed = threads * (of_thread + of_case)
        raise Full(f"{threads} cases at once need {needed / 1e6:.3g} MB, {free / 1e6:.3g} MB are free")
    return threads, max(threads, int((PART_OF_MEMORY * free - threads * of_thread) / of_case))


def arrays_in(value):
    """Yield all arrays in a tuple of tuples."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays_in(item)


ARGUMENTS = {
    "explicit": 5, "predict": 5, "residual": 6, "jacobian": 7, "complete": 6, "equations": 6, "used_inputs": 6,
}  # fmt: skip
"""Numbers of arguments of the kernels of a step, by the field of a Scheme with their address."""


@lru_cache(maxsize=16)
def motion_kernel_of(problem):
    """Return the kernel that follows the motions of a problem, compiled at its first launch."""
    device = Device()
    kernels = {
        "explicit": problem.explicit, "predict": problem.predict, "jacobian": problem.jacobian,
        "residual": problem.residual if problem.is_constant else None, "complete": problem.complete,
        "equations": problem.equations, "used_inputs": problem.inputs,
    }  # fmt: skip
    for name, kernel in kernels.items():
        own = on_device(_nothing(ARGUMENTS[name])) if kernel is None else device[kernel]
        device.replaced[f"call_{name}"] = on_device(_performing(own))
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


def _performing(function):
    """Return a function (address, arguments) that calls a device function without a result."""

    def performing(_, arguments):
        function(*arguments)

    return performing


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
    kernel, k, scheme = motion_kernel_of(problem), ensemble.h.size, problem.scheme
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
