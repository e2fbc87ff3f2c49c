"""What rendering needs: a generated module as strings, tuples and numbers, nothing symbolic."""

from __future__ import annotations

from dataclasses import dataclass

from codegen.lower.kernels import Kernel, Line


@dataclass(frozen=True)
class Argument:
    """A keyword argument of the generated functions, with its default as code and its meaning."""

    name: str
    default: str
    meaning: str = ""


@dataclass(frozen=True)
class Origin:
    """Where a generated module comes from: source file, the command that makes it again, hash, versions."""

    source: str
    command: str
    inputs: str
    versions: tuple[str, ...]


@dataclass(frozen=True)
class Module:
    """A generated module before rendering; `template` names the file that lays it out.

    `constants` are sizes, index arrays and names; `runtime` lists the files of `codegen/runtime` to include.
    """

    template: str
    name: str
    title: str
    description: tuple[str, ...]
    left_out: tuple[str, ...]
    metadata: tuple[tuple[str, str], ...]
    constants: tuple[Line, ...]
    kernels: tuple[Kernel, ...]
    runtime: tuple[str, ...]
    arguments: tuple[Argument, ...]
    steps: int


@dataclass(frozen=True)
class ControlModule(Module):
    """A module that solves an optimal-control problem.

    `duration` and `boundary_values` are code in the arguments; `guess_inputs` and `pin_inputs` read what guesses and
    pinned values depend on from the vector of parameters, boundary values included. `start_values` and `end_values`
    give the pinned unknowns of an end (target: local index), `node_guess` and `interval_guess` arrays over time (at
    nodes; at `interval_times`, if there are any). `positions`, `momenta`, `controls` and `multipliers` are code that
    reads the solution.
    """

    duration: str
    boundary_values: tuple[Line, ...]
    guess_inputs: tuple[Line, ...]
    pin_inputs: tuple[Line, ...]
    start_values: tuple[Line, ...]
    end_values: tuple[Line, ...]
    node_guess: tuple[Line, ...]
    interval_guess: tuple[Line, ...]
    interval_times: tuple[str, ...]
    positions: str
    momenta: str
    controls: str
    multipliers: str
    control_place: str
    boundary_example: str


@dataclass(frozen=True)
class SimulateModule(Module):
    """A module that solves an initial value problem.

    `duration` and `start_values` are code in the arguments; `start` is the initial state (q, p) as code that reads
    the arguments and the targets of `start_values`, whose comments are the names of the prescribed quantities.
    """

    duration: str
    start_values: tuple[Line, ...]
    start: tuple[Line, ...]
    start_example: str
    state_names: str
    coordinates: int
