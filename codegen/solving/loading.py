"""Generated modules: the types of their functions for each task, and loading from a file, without sympy.

The import name of a module contains a digest of its text and its path. Hence two modules with the same file name do not
collide, and another process can import a module by its import name. This is necessary for pickles of solutions and of
functions such as `solve`. The machine code that numba stores next to the file does not depend on the import name.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, TypeGuard, cast
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ModuleError
from codegen.runtime.record import ConnectRecord, ControlRecord, SimulationRecord, Task
from codegen.solving.drivers import TASKS

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from codegen.runtime.particles.cascade import Solution
    from codegen.runtime.particles.problem import PairProblem
    from codegen.runtime.particles.shooting import Linearised
    from codegen.runtime.search.point import Point
    from codegen.runtime.search.problem import ControlProblem
    from codegen.runtime.search.sensitivities import Sensitivities
    from codegen.runtime.stepping.problem import StepProblem

Vector: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]
Entries: TypeAlias = tuple[Indices, Indices, Vector]
"""A sparse matrix as (rows, columns, values); values with the same row and column are added."""


class Grid(Protocol):
    """The grid of a solve: N = `steps` intervals of mean length h, with the values of all parameters.

    `nodes` (N + 1,) are the times of all nodes in units of h. `inner` are the numbers of the nodes at inner times.
    `parameters` (bodies, P) has a row for each body. `is_multiplier` (n,) is a mask of the unknowns that are
    multipliers. `sizes` (n,) are the scaling factors of the unknowns, and `weight` is the scaling factor of the cost;
    `sizes` is empty without scaling.
    """

    steps: int
    h: float
    nodes: Vector
    parameters: Matrix
    is_multiplier: NDArray[np.bool_]
    sizes: Vector
    weight: float
    inner: tuple[int, ...]
    _replace: Callable[..., Grid]
    problem: ControlProblem


class ControlSolution(Protocol):
    """The return value of `solve` of an optimal-control module.

    `log` has a row for each iterate; `scaled` is the grid with the scaling factors with which the search began.
    """

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float
    iterations: int
    t: Vector
    q: Matrix
    p: Matrix
    u: Matrix
    multipliers: Matrix
    unknowns: Vector
    log: Matrix
    scaled: Grid


class Unpacked(NamedTuple):
    """The trajectories that a vector of unknowns describes."""

    t: Vector
    q: Matrix
    p: Matrix
    u: Matrix
    multipliers: Matrix


class NonlinearProgram(Protocol):
    """A nonlinear program: minimise a cost subject to equations and bounds; see `codegen.runtime.search.nlp`."""

    grid: Grid
    guess: Vector
    primal: Indices
    dual: Indices
    x0: Vector
    bounds: tuple[Vector, Vector]
    constraint_bounds: tuple[Vector, Vector]
    names: tuple[str, ...]

    cost: Callable[[Vector], float]
    gradient: Callable[[Vector], Vector]
    constraints: Callable[[Vector], Vector]
    stationarity: Callable[[Vector, Vector], Vector]
    jacobian: Callable[[Vector], csr_array]
    hessian: Callable[..., csr_array]
    unknowns: Callable[..., Vector]
    evaluate: Callable[..., Point]
    unpack: Callable[..., Unpacked]


class ControlModule(Protocol):
    """The functions of a generated module for optimal control.

    `variable_bounds` exists if `metadata.inequalities` is True. `problem` is the ControlProblem, which all grids of the
    module share and from which `codegen.runtime.search` computes other quantities. `views` returns two views of a
    vector of unknowns: (bodies, nodes, unknowns of a node) and (bodies, intervals, unknowns of an interval).
    """

    __name__: str
    metadata: ControlRecord
    problem: ControlProblem

    solve: Callable[..., ControlSolution]
    make_grid: Callable[..., Grid]
    initial_guess: Callable[[Grid], Vector]
    with_pinned_values: Callable[[Grid, Vector], Vector]
    nlp: Callable[..., NonlinearProgram]
    primal_unknowns: Callable[[Grid], Indices]
    multiplier_unknowns: Callable[[Grid], Indices]
    evaluate: Callable[[Grid, Vector], Point]
    unpack: Callable[[Grid, Vector], Unpacked]
    views: Callable[[Grid, Vector], tuple[Matrix, Matrix]]
    variable_bounds: Callable[[Grid], tuple[Vector, Vector]]
    # The next two functions exist only for a problem with measurements.
    sample_values: Callable[..., None]
    sample_gradient: Callable[..., float]
    # The next attributes exist only in a module with sensitivities.
    OWN_QUANTITIES: int
    sensitivities: Callable[..., Sensitivities]
    unpacked_rates: Callable[..., tuple[Vector, Matrix, Matrix, Matrix, Matrix]]


class StepGrid(Protocol):
    """The grid of a simulation: N steps of length h, the values of the parameters, and the initial state (q, p)."""

    steps: int
    h: float
    parameters: Vector
    start: Vector


class EventArrays(Protocol):
    """The events of a motion: number and action of each event, times, and states before and after."""

    number: Vector
    action: Vector
    t: Vector
    before: Matrix
    after: Matrix


class SimulateSolution(Protocol):
    """The return value of `solve` of a simulation module; arrays have an entry for each stored step."""

    status: str
    message: str
    steps: int
    t: Vector
    q: Matrix
    p: Matrix
    energy: Vector | None
    residual: float
    iterations: int


class SimulateModule(Protocol):
    """The functions of a generated module for a simulation; a module for first-order dynamics has no `energy`."""

    __name__: str
    metadata: SimulationRecord
    problem: StepProblem

    solve: Callable[..., SimulateSolution]
    make_grid: Callable[..., StepGrid]
    energy: Callable[[Vector, float, Vector], float]
    step: Callable[[StepGrid, Vector, float], Vector]
    path_residual: Callable[[StepGrid, Matrix], float]


class ImplicitModule(SimulateModule, Protocol):
    """The functions of a generated module for a simulation by an implicit scheme.

    `residual` (grid, y, state, t) and `jacobian` belong to the equations of one step for its unknowns y. `predict`
    returns an initial guess of y, and `complete` the state after the step.
    """

    predict: Callable[[StepGrid, Vector, float], Vector]
    residual: Callable[[StepGrid, Vector, Vector, float], Vector]
    jacobian: Callable[[StepGrid, Vector, Vector, float], Matrix]
    complete: Callable[[StepGrid, Vector, Vector, float], Vector]


class Case(Protocol):
    """The points, the parameters and the time steps of a connect problem, the return value of `make_case`."""

    start: Matrix
    target: Matrix
    own: Matrix
    parameters: Vector
    sigma: Vector
    duration: float
    steps: int
    tolerance: float
    max_iterations: int


class ConnectModule(Protocol):
    """The functions of a generated module that connects points; a case is the return value of `make_case`.

    The functions of the action exist if `metadata.method` is Method.ACTION.
    """

    __name__: str
    metadata: ConnectRecord
    problem: PairProblem

    solve: Callable[..., Solution]
    solve_case: Callable[..., Solution]
    make_case: Callable[..., Case]
    first_momenta: Callable[[Case], Matrix]
    trajectory: Callable[[Case, Matrix], tuple[int, Matrix, Matrix]]
    residual: Callable[[Case, Vector], Vector]
    jacobian: Callable[[Case, Vector], Matrix]
    path_of: Callable[[Case, Vector], Matrix]
    path_cost: Callable[[Case, Matrix], float]
    path_errors: Callable[[Case, Matrix], tuple[Matrix, Vector]]
    first_unknowns: Callable[[Case], Vector]
    all_equations: Callable[[Case, Vector], Vector]
    all_equations_jacobian: Callable[[Case, Vector], Matrix]
    end_residual: Callable[[Case, Matrix, Matrix], Vector]
    preconditioner: Callable[[Case], Matrix]
    Linearised: Callable[..., Linearised]
    hamiltonian: Callable[..., float]
    hamiltonian_gradient: Callable[..., None]
    momentum_matrix: Callable[..., None]
    domain_margin: Callable[[Matrix], float]
    guessed_path: Callable[..., Matrix]
    momenta_of: Callable[..., Matrix]
    all_states: Callable[..., tuple[int, int, float]]
    action_start: Callable[[Case], Vector]
    action_path: Callable[[Case, Vector], Matrix]
    action_cost: Callable[[Case, Vector], float]
    action_cost_gradient: Callable[[Case, Vector], Vector]
    action_constraints: Callable[[Case, Vector], Vector]
    action_jacobian: Callable[[Case, Vector], Matrix]
    action_hessian: Callable[[Case, Vector, Vector], Matrix]
    BLOCKS: int
    POINTS: int


GeneratedModule: TypeAlias = ControlModule | SimulateModule | ConnectModule


def few_steps(module: GeneratedModule, steps: int) -> int:
    """Return `steps`, or a larger number of intervals if the problem has too many inner times for it."""
    return max(steps, int(module.metadata.inner_times) + 1)


def inner_places(module: ControlModule) -> tuple[float, ...]:
    """Return the inner times as fractions of the duration.

    If the inner times are free, return the positions of their nodes on an equidistant grid.
    """
    if not module.metadata.inner_times:
        return ()
    grid = module.make_grid(few_steps(module, 1))
    return tuple(float(grid.nodes[number]) / grid.steps for number in grid.inner)


def time_grid(module: ControlModule, steps: int, fractions: Vector | None = None) -> Grid:
    """Return the grid of N = `steps` intervals in each phase.

    `fractions` are the lengths of the intervals relative to the duration, (N,), or relative to each phase, (phases, N).
    None means equal intervals. Raise ValueError if they are not positive, or their sum is not one.
    """
    return module.make_grid(steps) if fractions is None else module.make_grid(steps, grid=fractions)


def is_control(module: GeneratedModule) -> TypeGuard[ControlModule]:
    """Return True for a module for optimal control."""
    return bool(module.metadata.task == Task.CONTROL)


def is_connect(module: GeneratedModule) -> TypeGuard[ConnectModule]:
    """Return True for a module that connects points."""
    return bool(module.metadata.task == Task.CONNECT)


def is_simulation(module: GeneratedModule) -> TypeGuard[SimulateModule]:
    """Return True for a module for a simulation."""
    return bool(module.metadata.task == Task.SIMULATE)


def is_of_particles(module: GeneratedModule) -> bool:
    """Return True for a module of a problem of particles, which may be a simulation or connect points."""
    return bool(module.metadata.of_particles)


def is_implicit(module: SimulateModule) -> TypeGuard[ImplicitModule]:
    """Return True if a simulation solves equations in every time step."""
    return all(callable(getattr(module, name, None)) for name in ("predict", "residual", "jacobian", "complete"))


_FIRST_LINE = "# Generated by codegen"
_REMEDY = "make it again with codegen build"


def load(path: Path | str) -> GeneratedModule:
    """Import a generated module.

    Parameters
    ----------
    path : path
        File of the module. A file is imported only once, unless its text changes.

    Returns
    -------
    module
        See ControlModule, SimulateModule and ConnectModule for its functions.

    Raises
    ------
    ModuleError
        If the file is missing, was not generated, or is damaged.
    """
    path = Path(path)
    text = _text(path)
    return cast(GeneratedModule, importlib.import_module(_name(path.resolve(), text)))


def machine_code_counts(module: GeneratedModule) -> tuple[int, int]:
    """Return the numbers of functions that numba has compiled, and has read from the disk, in this process.

    Functions of the module and of the runtime are counted.
    """
    runtime = [vars(other) for name, other in list(sys.modules.items()) if name.startswith("codegen.runtime.")]
    functions = {id(value): value for space in (vars(module), *runtime) for value in list(space.values())}
    statistics: list[Any] = [getattr(value, "stats", None) for value in functions.values()]
    counted = [entry for entry in statistics if hasattr(entry, "cache_misses")]
    return sum(entry.cache_misses.total() for entry in counted), sum(entry.cache_hits.total() for entry in counted)


def _text(path: Path) -> str:
    if path.is_dir():
        raise ModuleError(f"{path} is a directory", "give the path of a generated module")
    if not path.exists():
        raise ModuleError(f"{path}: no such file", _REMEDY)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ModuleError(f"{path} cannot be read ({error})", _REMEDY) from error
    if not text.startswith(_FIRST_LINE):
        # The file is not executed, because it may be any program.
        raise ModuleError(f"{path} was not generated by codegen", "give the path of a generated module")
    return text


def _name(path: Path, text: str) -> str:
    """Return the import name for a file and its text; `_ByName` reads the path from the name."""
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{__name__}.{path.stem}_{digest[:16]}@{quote(str(path)).replace('.', '%2E')}"


class _ByName:
    """The importer of generated modules, whose import names contain a digest of the text and the path."""

    @staticmethod
    def find_spec(name: str, _path: Sequence[str] | None = None, _: ModuleType | None = None) -> ModuleSpec | None:
        """Return the import specification of a generated module, None for other modules."""
        if not name.startswith(f"{__name__}."):
            return None
        path = Path(unquote(name.partition("@")[2]))
        return ModuleSpec(name, _ByName, origin=str(path))  # type: ignore[arg-type]

    @staticmethod
    def create_module(_spec: ModuleSpec) -> None:
        """Let Python create the module."""

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        """Execute the text of a file; raise ModuleError if the text has changed or is damaged."""
        assert module.__spec__ is not None
        path = Path(module.__spec__.origin or "")
        text = _text(path)
        if _name(path, text) != module.__name__:
            raise ModuleError(f"{path} is not what it was", "load it anew")
        module.__file__ = str(path)
        try:
            # Python's loader is not used, because its bytecode cache misses an edit within one second that does not
            # change the length of the file.
            exec(compile(text, str(path), "exec"), vars(module))
        except Exception as error:  # a damaged file may fail in any way
            if "no locator available" in str(error):
                finding = f"{path}: numba finds no folder where it could keep machine code"
                raise ModuleError(finding, "let NUMBA_CACHE_DIR name a folder that may be written to") from error
            finding = " ".join(f"{path} is damaged ({type(error).__name__}: {error})".split())
            raise ModuleError(finding, _REMEDY) from error
        task = getattr(getattr(module, "metadata", None), "task", None)
        if task not in TASKS:
            raise ModuleError(f"{path} is damaged (its metadata name no task)", _REMEDY)
        missing = [function for function in TASKS[task].functions if not callable(getattr(module, function, None))]
        if missing:
            raise ModuleError(f"{path} is damaged (it lacks {', '.join(missing)})", _REMEDY)


__path__: list[str] = []
"""An empty search path, which makes this module the package of all generated modules."""
sys.meta_path.append(cast(Any, _ByName))
