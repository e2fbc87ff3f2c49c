"""What people write beside the mathematics: unused symbols, names of conditions, greatest values, guesses."""

from __future__ import annotations

import interpreted
import numpy as np
import pytest
import sympy
from typer.testing import CliRunner

from codegen import (
    Control,
    Pairwise,
    Phases,
    Simulate,
    control,
    errors,
    free_parameter,
    parameters,
    particle,
    particles,
    state,
    states,
    time,
    together,
)
from codegen.cli import main
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.pairwise import normalise_pairwise
from codegen.runtime.search.messages import unknown_name

FILE = '''"""Push a mass and keep its reserve (a test)."""
from codegen import *


def problem(unused: bool = True):
    x, v = states("x v")
    u = control("u")
    if unused:
        k, m = parameters(k=1.0, m=2.0)
    return Control(dynamics={x: v, v: u}, maximise=3 - u**2, duration=1, steps=4, start={x: 0, v: 0}, end={x: 1, v: 0})
'''


def pushed(mark="", **given):
    """The mass on a line: x'' = u, from rest to rest in unit time. Least integral of u^2 is 12 in continuous time."""
    x, v, u = state(f"x{mark}"), state(f"v{mark}"), control(f"u{mark}")
    given = {name: value(x, v, u) if callable(value) else value for name, value in given.items()}
    return Control(dynamics={x: v, v: u}, duration=1, steps=8, start={x: 0, v: 0}, end={x: 1, v: 0}, **given)


def test_the_greatest_value_is_minus_the_least_cost():
    least = interpreted.of_problem(pushed(cost=lambda x, v, u: u**2)).solve()
    module = interpreted.of_problem(pushed(maximise=lambda x, v, u: 3 - u**2, terminal_maximise=5))
    greatest = module.solve()
    assert greatest.status == "solved"
    assert -greatest.cost == pytest.approx(8 - least.cost, rel=1e-13)
    np.testing.assert_allclose(greatest.u, least.u, rtol=1e-12)
    assert module.metadata.maximised
    assert not interpreted.of_problem(pushed(cost=lambda x, v, u: u**2)).metadata.maximised


@pytest.mark.parametrize("other", ["cost", "terminal_cost"])
def test_greatest_and_least_at_once_are_refused(other):
    with pytest.raises(errors.ExpressionError, match=f"maximise and {other} in one problem"):
        normalise(pushed(maximise=lambda x, v, u: -(u**2), **{other: lambda x, v, u: x**2}))


def test_phases_and_bodies_maximise_alike():
    x, v, u = state("x"), state("v"), control("u")

    def phase(**given):
        return Control(dynamics={x: v, v: u}, duration=1, steps=4, **given)

    first = phase(maximise=-(u**2), start={x: 0, v: 0})
    module = interpreted.of_problem(Phases(first, phase(maximise=-(u**2), end={x: 1, v: 0})))
    twin = interpreted.of_problem(Phases(phase(cost=u**2, start={x: 0, v: 0}), phase(cost=u**2, end={x: 1, v: 0})))
    assert module.solve().cost == pytest.approx(twin.solve().cost, rel=1e-12)
    with pytest.raises(errors.ExpressionError, match="one phase has a cost, another one maximises"):
        normalise(Phases(first, phase(cost=u**2, end={x: 1, v: 0})))
    one, other = pushed(maximise=lambda x, v, u: -(u**2)), pushed("2", maximise=lambda x, v, u: -2 * u**2)
    both = interpreted.of_problem(together(one, other))
    single = interpreted.of_problem(pushed(cost=lambda x, v, u: u**2)).solve().cost
    assert both.solve().cost == pytest.approx(3 * single, rel=1e-12)
    assert both.metadata.maximised


def test_conditions_have_names_in_metadata_and_messages():
    module = interpreted.of_problem(
        pushed(
            cost=lambda x, v, u: u**2,
            path=lambda x, v, u: {"speed limit": v**2 + x * v**4 <= 0.01, "lift": u + x <= 100},
        )
    )
    solution = module.solve(4)
    assert solution.status == "infeasible"
    assert "speed limit" in solution.message
    assert "v**2" not in solution.message
    grid = module.make_grid(4)
    first = len(module.metadata.node)
    names = [unknown_name(grid, solution.unknowns, first + i) for i in range(len(module.metadata.interval))]
    slacks = [name for name in names if name.startswith("the slack of ")]
    assert {name.split(" at ")[0] for name in slacks} == {"the slack of speed limit", "the slack of lift"}
    assert all(name.endswith(" of interval 0 (t = 0)") for name in slacks)
    assert not any(name.startswith("s_") for name in names)


def test_conditions_of_ends_have_names():
    x, v, u = state("x"), state("v"), control("u")
    problem = Control(
        dynamics={x: v, v: u}, cost=u**2, duration=1, steps=4, start={x: 0, v: 0},
        end_conditions={"on the circle": x**2 + v**2 - 1}, path=[("push", u <= 9)],
    )  # fmt: skip
    model = normalise(problem)
    assert [str(c) for c in (*model.end_conditions, *model.path)] == ["on the circle", "push"]
    assert interpreted.of_problem(problem).solve().status == "solved"


@pytest.mark.parametrize("name", [3, "", " ", "a\nb", None])
def test_what_is_no_name_of_a_condition_is_refused(name):
    with pytest.raises(errors.ExpressionError, match="path has the name"):
        normalise(pushed(cost=lambda x, v, u: u**2, path=lambda x, v, u: {name: u <= 9}))


def test_long_conditions_are_shortened():
    def long(x, v, u):
        return [sum(sympy.Rational(k, 7) * x**k * v for k in range(30)) + u**2 <= -1]

    solution = interpreted.of_problem(pushed(cost=lambda x, v, u: u**2, path=long)).solve(2)
    assert solution.status != "solved"
    assert " ... at 1/2 of interval" in solution.message
    assert len(solution.message) < 700
    with pytest.raises(errors.ExpressionError) as refused:
        normalise(pushed(cost=lambda x, v, u: u**2, path=lambda x, v, u: long(x, v, u) * 2))
    assert len(str(refused.value)) < 120


def test_guesses_use_the_first_guess_of_free_parameters():
    x, v, u, t = state("x"), state("v"), control("u"), time()
    (goal,) = parameters(goal=2.0)
    span = free_parameter("T", 1.5 * goal, 0.1, 10)

    def problem(guess):
        return Control(
            dynamics={x: v, v: u}, cost=u**2 + 1, duration=span, steps=4, start={x: 0, v: 0}, end={x: goal, v: 0},
            guess=guess,
        )  # fmt: skip

    with_free = interpreted.of_problem(problem({x: goal * t / span, u: span - t}))
    plain = interpreted.of_problem(problem({x: goal * t / (1.5 * goal), u: 1.5 * goal - t}))
    grid = with_free.make_grid(4)
    np.testing.assert_allclose(with_free.initial_guess(grid), plain.initial_guess(grid), rtol=1e-15)


def test_unused_symbols_are_a_note_on_stderr(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "push.py").write_text(FILE)
    done = CliRunner().invoke(main, ["build", "push.py", "--no-compile"])
    assert done.exit_code == 0, done.output
    assert "codegen: note: k, m are declared but never used" in done.stderr
    again = CliRunner().invoke(main, ["build", "push.py", "--no-compile"])
    assert "derivation cached" in again.stdout
    assert "never used" in again.stderr
    quiet = CliRunner().invoke(main, ["build", "push.py", "--no-compile", "--set", "unused=false"])
    assert quiet.exit_code == 0
    assert "note" not in quiet.stderr


def test_singular_and_plural_declare_the_same_kind():
    x, (y, z) = state("x"), states("y z")
    assert type(x) is type(y) is type(z)
    assert (x.name, y.name, z.name) == ("x", "y", "z")


def test_one_particle_and_a_function_of_two():
    def made(system, one):
        problem = Simulate(hamiltonian=system, duration=1, start={one.q[0]: [0, 1], one.p[0]: [0, 0]}, steps=4)
        return normalise_pairwise(problem, (), "springs", "Springs")

    i, j = particles("x", "p")
    both = made(Pairwise((i, j), self_term=i.p[0] ** 2 / 2, pair_term=(i.q[0] - j.q[0]) ** 2), i)
    one = particle("x", "p")
    alone = made(Pairwise(one, self_term=one.p[0] ** 2 / 2, pair_term=lambda a, b: (a.q[0] - b.q[0]) ** 2), one)
    assert both == alone
