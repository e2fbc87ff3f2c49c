"""The registry of checks, which give evidence that the derivation and the generated code of a problem are correct."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

from codegen.discretise import schemes
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.degenerate import for_method
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.delays import in_names_of_the_whole
from codegen.discretise.model.from_problem import load_problem
from codegen.emit import naming, rendering
from codegen.emit.deadline import CHECK, Overdue, interrupted_after
from codegen.emit.naming import Choices
from codegen.evidence.checks import (
    assembly,
    authored,
    derivatives,
    discrete_equations,
    layout,
    null_spaces,
    one_step,
    particles,
    solution,
)
from codegen.evidence.checks.base import Check, Context, Finding, Findings, NoPointError, does_not_apply, not_measured
from codegen.problem.points import recorded_files
from codegen.problem.sources import Source, settings_of, source_of
from codegen.solving import compiler
from codegen.solving.loading import is_of_particles, load

Finder: TypeAlias = Callable[[Context], Iterable[Finding]]

__all__ = ["CHECKS", "Check", "Context", "Finding", "Findings", "apply", "context_of", "run"]


def _of_equations(name: str, findings: Finder, without: str = "") -> Check:
    """Return a check that reads the expressions of each phase; `without` names what first-order systems lack for it."""
    return Check(
        name, findings, False, True, {"first-order": f"a first-order system has no {without}"} if without else {}
    )


def _of_control(name: str, findings: Finder, reason: str, **options: Any) -> Check:
    """Return a check of control problems alone; `reason` is the end of a sentence that begins with "a simulation"."""
    return Check(name, findings, without={"simulate": f"a simulation {reason}"}, **options)


_ROWS = (
    Check("layout", layout.check_layout, runs_the_module=False),
    Check(authored.NAME, authored.check_authored),
    Check("derivatives", derivatives.check_derivatives),
    Check("sparsity", derivatives.check_sparsity, without={"simulate": "a step of a simulation has a dense Jacobian"}),
    _of_control("given values", assembly.check_given_values, "gives no values but those of its start"),
    _of_control("assembly", assembly.check_assembly, "solves step after step"),
    Check("tables", derivatives.check_tables),
    _of_control("measurements", derivatives.check_measurements, "fits nothing"),
    _of_equations("discrete equations", discrete_equations.check_discrete_equations),
    _of_equations("integrals", discrete_equations.check_integrals),
    Check("momentum matching", discrete_equations.check_momentum_matching),
    _of_equations("discrete Noether", one_step.check_noether, without="momenta"),
    Check("consistency", one_step.check_consistency, runs_the_module=False),
    _of_equations("symplecticity", one_step.check_symplecticity),
    _of_equations("area preservation", one_step.check_area_preservation, without="phase plane of q and p"),
    _of_equations("midpoint equivalence", one_step.check_midpoint_equivalence, without="discrete Lagrangian"),
    _of_control("boundary rank", null_spaces.check_boundary_rank, "has no boundary value problem"),
    _of_control("null controls", null_spaces.check_null_controls, "has no controls to be found", of_each_phase=True),
    _of_control("path between nodes", null_spaces.check_path_modes, "has no path conditions"),
    Check("holonomic drift", solution.check_holonomic_drift, of_solution="all constraints"),
    Check("rolling constraints", solution.check_rolling, of_solution="all constraints"),
    _of_control(
        "contact", solution.check_contact, "has impacts in place of contact forces", of_solution="all contacts"
    ),
    _of_control(
        "inner times", solution.check_inner_times, "has no conditions on the way", of_solution="all conditions"
    ),
    Check("switches", discrete_equations.check_switches),
    _of_control("delays", solution.check_delays, "has no values of the past"),
    _of_control("second-order condition", solution.check_second_order, "minimises nothing"),
    _of_control("optimum", solution.check_optimum, "minimises nothing"),
    _of_control("sensitivities", solution.check_sensitivities, "minimises nothing"),
)

CHECKS: dict[str, Check] = {check.name: check for check in _ROWS}
"""All checks by name, in the order of a report. The tests of the project also run every check of this table."""


def run(
    problem: Source | Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    sensitivities: bool = False,
    module: Path | None = None,
    steps: int | None = None,
    time_limit: float = CHECK,
) -> Findings:
    """Run all checks that apply to a problem.

    Parameters
    ----------
    problem : Source, Path or str
        A problem object or a problem file.
    arguments : Mapping[str, str], optional
        Arguments of the function `problem` of the file, as texts.
    scheme, method, controls : str, optional
        The discretisation, as in `codegen.compile`.
    sensitivities : bool
        True to check the module with sensitivities.
    module : Path, optional
        A generated file, which is checked unchanged. By default the module is built in the cache.
    steps : int, optional
        The number of intervals of the checked solutions. By default the number in the problem.
    time_limit : float
        Seconds of processor time for all checks. Each check may take half of the remaining time. An interrupted
        check yields a finding that states this reason.

    Returns
    -------
    Findings
        The findings of all checks in the order of the registry.

    Raises
    ------
    CodegenError
        If the problem, a choice or the file is unusable.
    """
    end = time.process_time() + time_limit
    source = source_of(problem)
    settings = settings_of(source, arguments)
    choices = naming.chosen(scheme, method, controls, sensitivities=sensitivities)
    if module is None:
        module = compiler.build(
            source, settings, scheme=scheme, method=method, controls=controls, sensitivities=sensitivities
        ).path
    if is_of_particles(load(module)):
        return Findings(particles.particle_findings(source, settings, choices, module))
    context, text = _prepared(source, settings, choices, module)
    inputs = naming.origin_of(source, settings, choices).inputs
    context = replace(context, steps=steps)
    findings = list(layout.compare(module, context.module, inputs, text))
    for name in CHECKS:
        findings += apply(name, context, (end - time.process_time()) / 2)
    return Findings(replace(f, subject=in_names_of_the_whole(context.model, f.subject)) for f in findings)


def context_of(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, module: Path) -> Context:
    """Return the input of all checks: the problem, its new derivation, and the generated module on disk."""
    return _prepared(source_of(problem), arguments, choices, module)[0]


def apply(name: str, context: Context, seconds: float = math.inf) -> list[Finding]:
    """Return the findings of one check, limited to `seconds` of processor time. An exception becomes a finding.

    A module whose layout does not fit is not run, because compiled code would write outside its arrays.
    """
    findings: list[Finding] = []
    try:
        with interrupted_after(seconds):
            findings += _findings(name, context)
    except Overdue:
        reason = f"the problem is too large for it, which was not done after {seconds:.0f} s of processor time"
        findings.append(not_measured(name, "all else" if findings else "the whole problem", reason))
    except NoPointError as error:
        findings.append(not_measured(name, "all else" if findings else "the whole problem", str(error)))
    except Exception as error:  # a damaged module may fail in any way
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return [Finding(name, "the check itself", False, f"could not be completed ({text[:300]})")]
    return findings


def _findings(name: str, context: Context) -> Iterator[Finding]:
    check = CHECKS[name]
    if check.runs_the_module and not all(finding.passed for finding in layout.check_layout(context)):
        yield Finding(name, "the check itself", False, "not run, because the layout of the module does not fit")
        return
    for kind in (context.model.task, context.model.form):
        if kind in check.without:
            yield does_not_apply(name, check.without[kind])
            return

    def evidence(part: Context) -> Iterable[Finding]:
        kinds = [kind for kind in CONDITIONS if kind.check == name]
        if kinds and not any(kind.of_model(part.model) for kind in kinds):
            return [does_not_apply(name, f"there are no {kinds[0].words}")]
        if check.of_solution and part.solution.status != "solved":
            return [not_measured(name, check.of_solution, part.solution.message)]
        return check.findings(part)

    parts = discrete_equations.phase_contexts(context) if check.of_each_phase else []
    if len(parts) < 2:
        yield from evidence(context)
        return
    of_phases = [(phase, finding) for phase, part in parts for finding in evidence(part)]
    if not any(finding.applies for _, finding in of_phases):
        yield of_phases[0][1]
        return
    yield from (replace(finding, subject=f"{phase}{finding.subject}") for phase, finding in of_phases)


def _prepared(source: Source, arguments: Mapping[str, str], choices: Choices, module: Path) -> tuple[Context, str]:
    """Return the input of all checks, and the newly generated text of the module. Each stage of the build runs once."""
    from codegen.discretise import transcribe
    from codegen.emit import differentiation, lower
    from codegen.emit.differentiation import control_sensitivities

    with recorded_files() as files:
        model = load_problem(source, arguments)
    assert isinstance(model, Model), "particles have checks of their own"
    program = transcribe.transcribe(model, choices.scheme, choices.method, choices.controls)
    model = for_method(model, program.method)
    by_data = control_sensitivities(program) if choices.sensitivities else None
    fresh = lower.lower(program, differentiation.derivatives(program), by_data)
    text = rendering.render(fresh, naming.origin_of(source, arguments, choices, files))
    loaded = load(module)
    assert isinstance(loaded, ModuleType)
    written = source.written(arguments)[1]
    return Context(choices, model, program, schemes.find(program.scheme, program.method), loaded, written), text
