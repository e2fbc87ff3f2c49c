"""What rendering needs: a generated module as strings, tuples and numbers, nothing symbolic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from codegen.emit.lower.kernels import Kernel, Line
from codegen.runtime.record import Record

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel


@dataclass(frozen=True)
class Argument:
    """A keyword argument of the generated functions, with its default as code."""

    name: str
    default: str


def arguments_of(model: Model | PairwiseModel) -> tuple[Argument, ...]:
    """The parameters of a model with their defaults."""
    return tuple(Argument(p.name, repr(value)) for p, value in zip(model.parameters, model.defaults, strict=True))


def record_fields(model: Model | PairwiseModel) -> dict[str, Any]:
    """What records of all tasks say of a model."""
    return {
        "problem": model.name, "title": model.title, "inputs": "", "steps": model.steps, "unused": model.unused,
        "parameters": {p.name: value for p, value in zip(model.parameters, model.defaults, strict=True)},
    }  # fmt: skip


@dataclass(frozen=True)
class Origin:
    """Where a generated module comes from: source, the place and command that make it again, hash, versions.

    `reads` has a line for each further file that it was made from.
    """

    source: str
    command: str
    inputs: str
    versions: tuple[str, ...]
    reads: tuple[str, ...] = ()
    place: str = "in the folder of the problem"


@dataclass(frozen=True)
class Module:
    """A generated module before rendering; `template` names the file that lays it out.

    `metadata` is the record of the module, whose `inputs` are those of the `Origin`. `constants` are sizes, index
    arrays and names; `sizes` are those on which it depends what loops say.
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
    """A function that calls one of several kernels: the first whose condition holds, else the last one."""

    name: str
    summary: str
    arguments: tuple[str, ...]
    branches: tuple[tuple[str, str], ...]
    otherwise: str


@dataclass(frozen=True)
class SensitivityText:
    """Functions of a module that makes sensitivities; code, and what it reads.

    `rates` are assignments to derivatives by the quantities; those of `following` hold unless the quantity with the
    name is given by itself. `pins`, `bounds` (one group, if any move) and `durations` are directional derivatives;
    `momenta` reads those of momenta. `fields` are those of the record `DataDerivatives` with their code.
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
class ControlModule(Module):
    """A module that solves an optimal-control problem.

    `structure` and `features` are fields of the records `Structure` and `ControlProblem` with their code.
    `boundary_values` is code in the arguments and in `boundary_inputs`. `data_arguments` are those that take other
    numbers for tables and measurements, where there are any, each with what is said of it; `grid_code` makes a grid
    with them. Guesses, pinned values and bounds are assignments to views of the unknowns; their `..._inputs` read what
    they depend on. `node_times` is code of the times at nodes. The duration is the argument `duration_arguments` with
    its default, or code of the unknowns where it is free; `grid_duration` is what the grid divides into steps. Where
    there are inner times, `inner_times` has one group of them, and `inner_values` is what stands among the parameters
    for them. `bound_lines` has one group where there are inequalities, and `coupling_kinds` one, of kernels, where
    bodies are coupled. Where there are several phases, `phase_durations` has one group (inputs, code for each phase),
    `choices` select kernels, `of_each_phase` says whose steps are given, and `fractions` of what intervals last.
    `sensitivities` are there on request. `positions`, `momenta`, `controls` and `multipliers` are code that reads the
    solution.
    """

    structure: tuple[tuple[str, str], ...]
    features: tuple[tuple[str, str], ...]
    boundary_values: tuple[Line, ...]
    boundary_inputs: tuple[Line, ...]
    inner_times: tuple[str, ...]
    inner_values: tuple[Line, ...]
    boundary_example: str
    data_arguments: tuple[tuple[str, str], ...]
    grid_code: str
    duration_arguments: tuple[str, ...]
    default_durations: tuple[str, ...]
    grid_duration: str
    duration_inputs: tuple[Line, ...]
    duration: str
    guess_inputs: tuple[Line, ...]
    guess_lines: tuple[Line, ...]
    shared_guess_inputs: tuple[Line, ...]
    common_guess: tuple[Line, ...]
    own_guess: tuple[Line, ...]
    guess_result: str
    pin_inputs: tuple[Line, ...]
    pinned_values: tuple[Line, ...]
    bound_inputs: tuple[Line, ...]
    bound_views: tuple[Line, ...]
    bound_lines: tuple[tuple[Line, ...], ...]
    coupling_kinds: tuple[tuple[str, ...], ...]
    node_times: str
    phase_durations: tuple[tuple[tuple[Line, ...], tuple[str, ...]], ...]
    choices: tuple[Choice, ...]
    of_each_phase: str
    fractions: str
    positions: str
    momenta: str
    controls: str
    multipliers: str
    control_sites: str
    sensitivities: tuple[SensitivityText, ...] = ()


@dataclass(frozen=True)
class SimulateModule(Module):
    """A module that solves an initial value problem.

    `public` are names for users, and `record` the fields of the StepProblem with their code. Where all steps are made
    by one loop, `explicit_sizes` holds the numbers of a state, of stages, of the parts of a step and of the lengths of
    each, as code.
    `duration` and `start_values` are code in the arguments; `table_arguments` has the name of the argument that takes
    other numbers for tables, where there are any; `start` is the initial state (q, p) as code that reads
    the arguments and the targets of `start_values`, whose comments are the names of the prescribed quantities.
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
    coordinates: int
