"""Stress for a user's own problem: parameters far from their values, few steps, poor guesses, every scheme.

Nothing is known about the answer, so every honest outcome is as good as the other; what is looked for are wrong answers
reported as solved, NaN, hangs and errors without a remedy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from codegen.errors import CodegenError
from codegen.evidence.stress.cases import EXPECTATIONS, OUTCOMES, Case, Setup, Values
from codegen.evidence.stress.families.common import registered
from codegen.runtime.record import Form, Record
from codegen.solving.loading import is_connect, is_of_particles, load

FACTORS = (1e-12, 1e-6, 1e6, 1e12)
STEPS = (1, 2, 10)
NOISES = (0.1, 1.0)
MOST_SCHEMES = 12
SECONDS = 60.0


def cases_of(problem: Path, arguments: Mapping[str, str]) -> list[Case]:
    """The cases of a problem file by every scheme that applies to it; a kind of CodegenError if it cannot be built."""
    from codegen.solving import compiler

    default = load(compiler.build(problem, arguments).path)
    points = _points(default, problem, arguments)
    found: list[Case] = []
    plain = tuple(sorted(arguments.items()))
    for method, scheme in _schemes(default)[:MOST_SCHEMES]:
        setup = Setup(problem.absolute(), scheme, method, plain)
        try:
            module = load(compiler.build(setup.file, arguments, scheme=scheme, method=method).path)
        except CodegenError:  # the scheme does not apply to this problem, or not in this form
            continue
        found += _cases(setup, module.metadata, points)
    return found


def _schemes(module: Any) -> Sequence[tuple[str | None, str]]:
    """Methods and schemes that may apply, from the registries; those of which most is known come first."""
    from codegen.discretise.schemes import METHODS, of_method
    from codegen.discretise.schemes.base import FIRST_ORDER

    if is_of_particles(module):
        from codegen.discretise.particles import PARTICLE_SCHEMES

        return [(None, name) for name, scheme in PARTICLE_SCHEMES.items() if not scheme.adaptive]
    if module.metadata.form == Form.FIRST_ORDER:
        return [(None, scheme.name) for scheme in of_method(FIRST_ORDER) if scheme.order <= 2]
    every = [(method, name) for method, schemes in METHODS.items() for name in schemes]
    return sorted(every, key=lambda scheme: registered(scheme).order > 2)


def _points(module: Any, problem: Path, arguments: Mapping[str, str]) -> tuple[tuple[float, ...], ...]:
    if not is_connect(module):
        return ()
    from codegen.problem.points import read_points
    from codegen.problem.sources import settings_of

    given = settings_of(problem, arguments).points
    file = Path(given) if given is not None else problem.parent / module.metadata.points
    read = read_points(file, len(module.metadata.coordinates))
    return tuple((*map(float, a), *map(float, b)) for a, b in zip(read.start, read.target, strict=True))


def _cases(setup: Setup, metadata: Record, points: tuple[tuple[float, ...], ...]) -> list[Case]:
    expected, own = EXPECTATIONS[metadata.task], int(metadata.steps)

    def case(name: str, reason: str, steps: int = own, values: Values = (), noise: float = 0.0) -> Case:
        return Case(
            name, setup.file.stem, setup, "accurate", reason, steps, values, every=max(1, steps // 2000), points=points,
            noise=noise, drift=expected.drift, allowed=tuple(OUTCOMES), seconds=SECONDS,
        )  # fmt: skip

    found = [case("as it is", "the problem itself")]
    found += [case(f"{steps} steps", "hardly a grid", steps) for steps in STEPS]
    found.append(case(f"{10 * own} steps", "ten times as many", 10 * own))
    for name, value in metadata.parameters.items():
        if isinstance(value, float | int) and value:
            found += [
                case(f"{name} times {factor:.0e}", "a parameter far from its value", values=((name, factor * value),))
                for factor in FACTORS
            ]
    if expected.has_guess:
        found += [case(f"guess with noise {noise:g}", "a poor guess", noise=noise) for noise in NOISES]
    return found
