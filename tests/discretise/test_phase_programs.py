"""Programs of several phases: what the intervals of each have and lack, and what happens at a switch."""

from __future__ import annotations

import pytest
import sympy

from codegen import Control, Phases, control, controls, coordinate, coordinates, free_parameter, parameters, states
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.guesses import with_guesses
from codegen.discretise.transcribe import transcribe
from codegen.emit.differentiation import control_derivatives
from codegen.errors import ArgumentError
from codegen.runtime.record import phrase


def program_of(problem: Phases, **choices: str):
    return transcribe(normalise(problem), **choices)


def names(unknowns) -> list[str]:
    return [unknown.name for unknown in unknowns]


def two(first: dict, second: dict, jumps: tuple = ()) -> Phases:
    """A point that is driven from rest to rest, in two phases of unit length."""
    x, v = states("x v")
    u, w = controls("u w")
    given = {"dynamics": lambda *_: {x: v, v: u}, "cost": lambda *_: u**2, "duration": lambda *_: 1}
    parts = []
    for own in (first, second):
        parts.append(Control(**{key: value(x, v, u, w) for key, value in (given | own).items()}))
    return Phases(*parts, jumps=[jump(x, v) for jump in jumps])


REST = {"start": lambda x, v, *_: {x: 0, v: 0}}, {"end": lambda x, v, *_: {x: 1, v: 0}}


def test_phases_that_only_continue_have_no_interval_of_their_own_at_the_switch():
    program = program_of(two(*REST))
    assert [phase.switch for phase in program.phases] == [None, None]
    assert names(program.node) == ["x", "v"]
    assert names(program.interval) == ["mu_x", "mu_v"]
    assert program.linking.unknowns == ()
    assert not program.has_inequalities


def test_time_runs_through_and_h_is_a_fraction_of_each_duration():
    x = states("x")[0]
    u, T = control("u"), free_parameter("T", 1, lower=0.1)
    (d,) = parameters(d=3)
    phases = Phases(
        Control(dynamics={x: u}, cost=u**2, duration=T, start={x: 0}),
        Control(dynamics={x: u}, cost=u**2, duration=d, end={x: 1}),
    )
    first, second = program_of(phases).phases
    assert (str(first.regular.cost), str(second.regular.cost)) == ("T*h*u_k**2", "d*h*u_k**2")


def test_what_a_phase_lacks_vanishes_by_its_square():
    first, second = REST
    program = program_of(
        two(
            first | {"dynamics": lambda x, v, u, w: {x: v + w, v: u}, "cost": lambda x, v, u, w: u**2 + w**2},
            second | {"path": lambda x, v, u, w: [u + v <= 3, u - 2 * v <= 4]},
        )
    )
    inside = [*names(program.interval), *names(program.controls), *names(program.slacks)]
    assert inside == ["mu_x", "mu_v", "y_1", "y_2", "u", "w", "s_1", "s_2"]
    lacking = [{inside[i] for i in phase.regular.lacking} for phase in program.phases]
    assert lacking == [{"y_1", "y_2", "s_1", "s_2"}, {"w"}]
    for phase, absent in zip(program.phases, lacking, strict=True):
        for name in absent:
            symbol = sympy.Symbol(f"{name}_k", real=True)
            assert sympy.diff(phase.regular.element, symbol) == symbol
    assert [program.interval[i].name for i in program.slack_multipliers] == ["y_1", "y_2"]
    assert phrase(program.interval[2].meaning).startswith("multiplier of u + v <= 3")


def test_all_hessians_have_one_pattern():
    first, second = REST
    program = program_of(two(first, second | {"dynamics": lambda x, v, u, w: {x: v**2, v: u - x**3}}))
    derivatives = control_derivatives(program)
    patterns = {tuple((row, column) for row, column, _ in share.hessian) for share in derivatives.elements}
    assert len(derivatives.elements) == 2
    assert len(patterns) == 1


def test_a_jump_replaces_the_left_state_of_the_first_interval():
    program = program_of(two(*REST, jumps=(lambda x, v: {v: -v / 2 + x},)))
    regular, switch = program.phases[1].regular, program.phases[1].switch
    x, v = (sympy.Symbol(f"{name}_k", real=True) for name in "xv")
    assert sympy.expand(switch.element - regular.element.xreplace({v: x - v / 2})) == 0
    assert program.phases[1].jumping == (1,)


def test_what_a_phase_says_of_its_end_holds_before_the_jump():
    first, second = REST
    said = {
        "end": lambda x, v, *_: {x: 2},
        "end_conditions": lambda x, v, *_: [v <= 3],
        "terminal_cost": lambda x, v, *_: v**2,
    }
    program = program_of(two(first | said, second, jumps=(lambda x, v: {v: -v},)))
    assert names(program.linking.unknowns) == ["nu_1", "nu_2", "s_1"]
    assert [unknown.multiplier for unknown in program.linking.unknowns] == [True, True, False]
    assert phrase(program.linking.unknowns[0].meaning) == "multiplier of x = 2 at switch 1"
    nu_1, nu_2, s_1, x, v = (sympy.Symbol(n, real=True) for n in ("nu_1", "nu_2", "s_1", "x_k", "v_k"))
    element = program.phases[1].switch.element
    assert sympy.expand(element.diff(nu_1) - (x - 2)) == 0
    assert sympy.expand(element.diff(nu_2) - (v - 3 + s_1)) == 0
    assert program.phases[1].switch.cost.coeff(v, 2) == 1
    assert program.phases[1].given == (0,)


def test_an_inequality_begins_at_the_switch_unless_it_held_before_or_its_state_jumps():
    first, second = REST
    wall = {"path": lambda x, v, *_: [x <= 2]}
    # The slack s_1 is that of later intervals, whose right nodes satisfy it.
    assert names(program_of(two(first, second | wall)).linking.unknowns) == ["nu_1", "s_2"]
    assert names(program_of(two(first | wall, second | wall)).linking.unknowns) == []
    assert names(program_of(two(first, second | wall, jumps=(lambda x, v: {x: x / 2},))).linking.unknowns) == []


def test_unknowns_of_both_ends_and_of_switches_have_different_names():
    path = {"path": lambda x, v, u, w: [u + v <= 5]}
    program = program_of(
        two(
            {"start": lambda x, v, *_: {x: 0}, "start_conditions": lambda x, v, *_: [v**2 <= 1], **path},
            {"end": lambda x, v, *_: {v: 0}, "end_conditions": lambda x, v, *_: [x**2 <= 1], **path},
        )
    )
    all_names = [
        *names(program.node),
        *names(program.interval),
        *names(program.slacks),
        *names(program.linking.unknowns),
    ]
    assert len(all_names) == len(set(all_names))
    assert len(program.only_at_ends) == 4
    for end, own in ((program.start, program.start.slacks), (program.end, program.end.slacks)):
        pinned = [index for index, _ in end.pins]
        assert len(pinned) == len(set(pinned))
        assert not set(pinned) & {index for pair in own for index in pair}


def bouncing(jump: bool, masses: tuple = (1, 1)) -> Phases:
    y, dy = coordinate("y")
    f = control("f")
    parts = [{"lagrangian": m * dy**2 / 2 - m * y, "force": {y: f}, "cost": f**2, "duration": 1} for m in masses]
    return Phases(
        Control(**parts[0], start={y: 1, dy: 0}),
        Control(**parts[1], end={y: 1, dy: 0}),
        jumps=[{dy: -dy / 2}] if jump else (),
    )


def test_momenta_that_do_not_change_need_no_unknowns():
    program = program_of(bouncing(jump=False))
    assert program.interval == ()
    assert program.phases[1].switch is None


@pytest.mark.parametrize(("jump", "masses"), [(True, (1, 1)), (False, (3, 2)), (True, (3, 2))])
def test_momenta_match_the_velocity_on_both_sides(jump, masses):
    program = program_of(bouncing(jump, masses))
    assert names(program.interval) == ["switch_dy", "pi_y"]
    w, pi, left = (sympy.Symbol(n, real=True) for n in ("switch_dy_k", "pi_y_k", "lambda_y_k"))
    element = program.phases[1].switch.element
    # Velocities are continuous by themselves, whatever becomes of momenta.
    assert element.diff(left) == -masses[0] * w
    assert element.diff(pi, w) == masses[1] * (-sympy.Rational(1, 2) if jump else 1)


def test_momenta_are_matched_together_where_velocities_couple_them():
    (a, b, c), (da, db, dc) = coordinates("a b c")
    f = control("f")
    motion = {
        "lagrangian": (da**2 + db**2 + dc**2) / 2 + da * db / 3,
        "force": {a: f, c: f},
        "cost": f**2,
        "duration": 1,
    }
    phases = Phases(
        Control(**motion, start={a: 0, b: 0, c: 0, da: 0, db: 0, dc: 0}),
        Control(**motion, end={a: 1}),
        jumps=[{da: -da}],
    )
    assert names(program_of(phases).interval) == ["switch_da", "switch_db", "pi_a", "pi_b"]
    hamiltonian = program_of(phases, method="hamiltonian")
    assert {hamiltonian.node[index].name for index in hamiltonian.phases[1].jumping} == {"p_a", "p_b"}


def test_controls_on_nodes_are_refused():
    with pytest.raises(ArgumentError, match="controls on intervals"):
        program_of(two(*REST), controls="nodal")


def test_guesses_are_lines_between_known_values_carried_over_jumps():
    x, v = states("x v")
    u, T = control("u"), free_parameter("T", 2)
    motion = {"dynamics": {x: v, v: u}, "cost": u**2}
    model = normalise(
        Phases(
            Control(**motion, duration=T, start={x: 1, v: 3}),
            Control(**motion, duration=3, end={x: 6}),
            Control(**motion, duration=1, end={x: 8, v: 0}, guess={v: 7}),
            jumps=[{v: -v}, {}],
        )
    )
    guesses = [dict(phase.guess) for phase in with_guesses(model).phases]
    x, v = model.coordinates
    t = model.time
    assert [sympy.expand(guess[x]) for guess in guesses] == [1 + t, 1 + t, 6 + 2 * (t - 5)]
    assert (guesses[0][v], guesses[2][v]) == (3, 7)
    assert [guesses[1][v].subs(t, instant) for instant in (2, 6)] == [-3, 0]


def test_guesses_take_free_parameters_at_their_guesses():
    """An end that depends on them becomes a condition, and is where the line leads nevertheless."""

    x, v = states("x v")
    u, S, T = control("u"), free_parameter("S", 2), free_parameter("T", 3)
    motion = {"dynamics": {x: v, v: u}, "cost": u**2}
    model = normalise(
        Phases(
            Control(**motion, duration=S, start={x: 1, v: 0}),
            Control(**motion, duration=T, end={x: 4 * (S + T)}, end_conditions=[2 * v - S - 2]),
        )
    )
    x, v = model.coordinates
    t = model.time
    guesses = [dict(phase.guess) for phase in with_guesses(model).phases]
    assert [sympy.expand(guess[x] - 1 - 19 * t / 5) for guess in guesses] == [0, 0]
    assert [sympy.expand(guess[v] - 2 * t / 5) for guess in guesses] == [0, 0]


def test_a_single_phase_starts_on_the_line_to_an_end_that_is_free():
    x, v = states("x v")
    u, T = control("u"), free_parameter("T", 3)
    problem = Control(
        dynamics={x: v, v: u}, cost=u**2, duration=T, start={x: 1}, start_conditions=[v + T], end={x: 2 * T, v: 0}
    )
    program = transcribe(normalise(problem))
    assert str(program.guess.node) == "(start_x + t*(6 - start_x)/duration, -3 + t*(end_v + 3)/duration)"
