"""Records of a generated module as strings, tuples and numbers: the input of rendering, with nothing symbolic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from codegen.emit.lower.kernels import Kernel, Line, table_records
from codegen.runtime.record import Form, Method, Record

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.discretise.particles import PairwiseProgram
    from codegen.discretise.program import ControlProgram, StepProgram
    from codegen.symbolic.tables import TableData


@dataclass(frozen=True)
class Argument:
    """A keyword argument of the generated functions, with its default as code."""

    name: str
    default: str


def arguments_of(model: Model | PairwiseModel) -> tuple[Argument, ...]:
    """Return the parameters of a model as arguments with their defaults."""
    return tuple(Argument(p.name, repr(value)) for p, value in zip(model.parameters, model.defaults, strict=True))


def record_fields(
    program: ControlProgram | StepProgram | PairwiseProgram, order: int, kernels: Iterable[Any], left_out: Iterable[str]
) -> dict[str, Any]:
    """Return the fields that the metadata records of all tasks have in common; `order` is that of the scheme."""
    model = program.model
    return {
        "problem": model.name, "title": model.title, "inputs": "", "steps": model.steps, "unused": model.unused,
        "parameters": {p.name: value for p, value in zip(model.parameters, model.defaults, strict=True)},
        "method": Method(program.method), "scheme": program.scheme, "order": order,
        "operations": {kernel.name: (kernel.operations_before, kernel.operations_after) for kernel in kernels},
        "left_out": tuple(left_out),
    }  # fmt: skip


def system_fields(model: Model, tables: Sequence[TableData]) -> dict[str, Any]:
    """Return the fields that the metadata records of simulations and control problems have in common."""
    return {
        "form": Form(model.form), "attitudes": model.attitudes, "units": dict(model.units),
        "coordinates": tuple(s.name for s in model.coordinates), "rates": tuple(s.name for s in model.rates),
        "tables": table_records(tables),
    }  # fmt: skip


@dataclass(frozen=True)
class Origin:
    """The origin of a generated module, for its header: the source, and the command that builds the module again.

    `place` is a phrase for the folder in which the command has to run. `inputs` is the digest of the inputs. `reads`
    has a line for each data file that the problem reads.
    """

    source: str
    command: str
    inputs: str
    versions: tuple[str, ...]
    reads: tuple[str, ...] = ()
    place: str = "in the folder of the problem"


@dataclass(frozen=True)
class Module:
    """A generated module before rendering; `template` is the name of its jinja template.

    `metadata` is the module's record, whose `inputs` come from the `Origin`. `constants` assign sizes, index arrays and
    names. `sizes` are names and values that specialise the loops. `steps` is the default number of time steps.
    """

    template: str
    name: str
    title: str
    description: tuple[str, ...]
    metadata: Record
    constants: tuple[Line, ...]
    kernels: tuple[Kernel, ...]
    sizes: tuple[tuple[str, int], ...]
    arguments: tuple[Argument, ...]
    steps: int


@dataclass(frozen=True)
class Choice:
    """A function that calls the kernel of the first branch (condition, kernel) that holds, or else `otherwise`."""

    name: str
    summary: str
    arguments: tuple[str, ...]
    branches: tuple[tuple[str, str], ...]
    otherwise: str


@dataclass(frozen=True)
class SensitivityText:
    """The code of functions in a module with sensitivities; fields `..._inputs` read the symbols in the other code.

    `rates` are derivatives of data with respect to the quantities that a user may vary. An entry of `following` is a
    quantity with derivatives that hold unless the caller replaces its value. `pins`, `bounds` (at most one group) and
    `durations` are directional derivatives of prescribed values, bounds and durations. `momenta` reads the derivatives
    of momenta. `fields` are the fields of the runtime's record `DataDerivatives` with their code.
    """

    rate_inputs: tuple[Line, ...]
    rates: tuple[Line, ...]
    following: tuple[tuple[str, tuple[Line, ...]], ...]
    pin_inputs: tuple[Line, ...]
    pins: tuple[Line, ...]
    duration_inputs: tuple[Line, ...]
    durations: str
    momenta: str
    bound_inputs: tuple[Line, ...]
    bounds: tuple[tuple[Line, ...], ...]
    coupling_kinds: tuple[tuple[str, ...], ...]
    fields: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class BoundaryText:
    """Boundary values as code that reads arguments and `inputs`, and an example of replacing a boundary value."""

    values: tuple[Line, ...]
    inputs: tuple[Line, ...]
    example: str


@dataclass(frozen=True)
class DurationText:
    """The duration as code.

    A fixed duration is one of the `arguments`, with a default; a free one is `code` that reads the unknowns. `grid` is
    the length that the grid divides into steps, and `node_times` the times at nodes. With several phases, `of_phases`
    has one group: inputs, and the duration of each phase. `each_phase` and `fractions` are words for docstrings.
    """

    arguments: tuple[str, ...]
    defaults: tuple[str, ...]
    grid: str
    inputs: tuple[Line, ...]
    code: str
    of_phases: tuple[tuple[tuple[Line, ...], tuple[str, ...]], ...]
    node_times: str
    each_phase: str
    fractions: str


@dataclass(frozen=True)
class GuessText:
    """The initial guess as assignments to array views of the unknowns; the inputs read the symbols in them.

    `lines` are for nodes and intervals, `own` for linking variables of each body, `common` for other linking variables.
    """

    inputs: tuple[Line, ...]
    lines: tuple[Line, ...]
    shared_inputs: tuple[Line, ...]
    common: tuple[Line, ...]
    own: tuple[Line, ...]
    result: str


@dataclass(frozen=True)
class PinText:
    """Prescribed end values as assignments to array views of the unknowns; `inputs` read the symbols in them."""

    inputs: tuple[Line, ...]
    values: tuple[Line, ...]


@dataclass(frozen=True)
class BoundText:
    """Bounds of unknowns as assignments to array views; `lines` has one group, but none without inequalities."""

    inputs: tuple[Line, ...] = ()
    views: tuple[Line, ...] = ()
    lines: tuple[tuple[Line, ...], ...] = ()


@dataclass(frozen=True)
class SolutionText:
    """Code that reads positions, momenta, controls and multipliers from the unknowns of a solution."""

    positions: str
    momenta: str
    controls: str
    multipliers: str


@dataclass(frozen=True)
class ControlModule(Module):
    """A module that solves an optimal-control problem.

    `structure` and `features` are fields of the records `Structure` and `ControlProblem` with their code.
    `data_arguments` are arguments that replace tables and measurements, each with a description; `grid_code` makes a
    grid with them. With conditions at inner times, `inner_times` has one group of times, and `inner_values` are the
    parameters of these conditions. If bodies are coupled, `coupling_kinds` has one group: the kernels of the conditions
    between them. With several phases, `choices` select kernels. `sensitivities` has at most one entry.
    """

    structure: tuple[tuple[str, str], ...]
    features: tuple[tuple[str, str], ...]
    boundary: BoundaryText
    inner_times: tuple[tuple[str, ...], ...]
    inner_values: tuple[Line, ...]
    data_arguments: tuple[tuple[str, str], ...]
    grid_code: str
    duration: DurationText
    guess: GuessText
    pins: PinText
    bounds: BoundText
    solution: SolutionText
    coupling_kinds: tuple[tuple[str, ...], ...]
    choices: tuple[Choice, ...]
    sensitivities: tuple[SensitivityText, ...] = ()


@dataclass(frozen=True)
class SimulateModule(Module):
    """A module that solves an initial value problem.

    `public` are the public names, and `record` the fields of the StepProblem with their code. For explicit steps in one
    loop, `explicit_sizes` is code of four numbers: states, stages, substeps of a step, and lengths of a substep.
    `duration` and `start_values` are code that reads arguments. `table_arguments` has the name of the argument that
    replaces tables, if there are tables. `start` is the initial state (q, p) as code that reads arguments and targets
    of `start_values`, whose comments are the names of the prescribed quantities.
    """

    public: tuple[str, ...]
    record: tuple[tuple[str, str], ...]
    explicit_sizes: tuple[str, ...]
    table_arguments: tuple[str, ...]
    duration: str
    start_values: tuple[Line, ...]
    start: tuple[Line, ...]
    start_example: str
    state_names: str
