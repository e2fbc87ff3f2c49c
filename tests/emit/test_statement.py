"""The docstring of a control module states the whole problem: unknowns, goal, bounds, conditions, both ends."""

import ast
import re
from pathlib import Path

import pytest
from golden import CONTROL as PROBLEMS
from golden import names, text_of

from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.transcribe import transcribe
from codegen.emit.lower.control.text import description
from codegen.solving.results.output import record_in

FOLDER = Path(__file__).parents[2] / "problems"


def stated(path, **choices):
    """The paragraphs of a docstring, each with its line breaks."""
    program = transcribe(load_problem(path, {}), **choices)
    return "\n".join(description(program, [])).split("\n\n")


def joined(paragraph):
    return " ".join(paragraph.split())


def listed(paragraph):
    return [line.strip() for line in paragraph.splitlines()]


def test_a_flight_of_free_duration_is_stated_completely():
    goal, limits, _, step, *ends, _ = stated(FOLDER / "goddard_rocket.py")
    assert joined(goal) == (
        "Find r, v, m at the nodes, thrust on the intervals and T that minimise -r at the end, where"
    )
    assert listed(limits) == ["duration = T", "r >= 1", "v >= 0", "m_f <= m <= 1", "0 <= thrust <= greatest", "T >= 0"]
    assert [line.partition(" = ")[0] for line in listed(step)] == ["0", "0", "0"]  # no cost that vanishes
    assert [joined(end) for end in ends] == ["At the start:", "r = 1, v = 0, m = 1", "At the end:", "m = m_f"]


def test_ends_of_the_variational_method_have_places_velocities_and_momenta():
    text = stated(FOLDER / "orbital_transfer.py")
    assert listed(text[5]) == [
        "0 = D2 Ld(q_{k-1}, q_k) + D1 Ld(q_k, q_{k+1}) + f+_{k-1} + f-_k",
        "p at the start = -D1 Ld(q_k, q_{k+1}) - f-_k",
        "p at the end = D2 Ld(q_{k-1}, q_k) + f+_{k-1}",
    ]
    assert listed(text[text.index("At the end:") + 1]) == [
        "r = r1, phi = 2*pi*revolutions, dr = 0, dphi = sqrt(GM/r1**3)",
        "p_r = dr*m",
        "p_phi = dphi*m*r**2",
    ]


def test_constraints_and_their_forces_are_stated():
    goal, limits, *others = stated(FOLDER / "four_bar.py")
    assert "kappa_1, kappa_2 at the nodes" in joined(goal)
    assert "l1*sin(a) + l2*sin(b) - l3*sin(c) = 0 at the nodes" in listed(limits)
    assert any("+ h G(q_k)^T kappa_k" in paragraph for paragraph in others)


def test_phases_state_bounds_switches_and_what_they_lack():
    text = stated(FOLDER / "two_stage_rocket.py")
    assert listed(text[text.index("Phase 2, of duration T_2:") + 1])[0] == "F_2/2 <= thrust <= F_2"
    assert "Phase 3, of duration T_3, without thrust:" in text
    switch = text[text.index("At switch 1, where the left node has the values before it:") + 1]
    assert listed(switch) == ["m = -fuel_1 + m_0", "m after the switch = -dry_1 + m_k"]


MIXED = '''
"""Reach a circle soon and with little effort."""

from sympy import Eq

from codegen import Control, control, coordinates, free_parameter, parameters


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    u, w, T = control("u"), control("w"), free_parameter("T", 1, lower=0.5)
    (R,) = parameters(R=2)
    return Control(
        lagrangian=(dx**2 + dy**2) / 2,
        force={x: u, y: w},
        cost=u**2 + w**2,
        terminal_cost=T + dx**2,
        duration=T,
        start={x: 0, y: 0, dx: 0, dy: 0},
        end_conditions=[Eq(x**2 + y**2, R**2)],
        path=[u + w <= 3, y >= -1],
    )
'''


@pytest.fixture
def mixed(tmp_path):
    path = tmp_path / "mixed.py"
    path.write_text(MIXED)
    return path


_EVERYWHERE = "y >= -1 at the nodes and on the intervals"


def test_costs_add_up_and_conditions_are_said_once_where_they_hold(mixed):
    goal, limits, *others = stated(mixed)
    assert joined(goal) == (
        "Find x, y at the nodes, u, w on the intervals, dx at an end and T that minimise the sum of Cd over all "
        "intervals plus T + dx**2 at the end, where"
    )
    assert listed(limits) == ["duration = T", "T >= 1/2", "u + w <= 3 on the intervals", _EVERYWHERE]
    step = next(listed(p) for p in others if "    Ld = " in p)
    assert step[-2:] == ["0 >= u_k + w_k - 3", "0 >= -y_k1 - 1"]
    assert listed(others[others.index("At the end:") + 1]) == ["p_x = dx", "x**2 + y**2 = R**2"]


def test_periodic_motions_name_what_returns(tmp_path):
    path = tmp_path / "turning.py"
    text = MIXED.replace("start={x: 0, y: 0, dx: 0, dy: 0},", "periodic={x: R, y: 0, dy: 0},")
    path.write_text(text.replace("end_conditions=[Eq(x**2 + y**2, R**2)],", "end_conditions=[Eq(dx, R)],"))
    _, limits, *others = stated(path)
    assert listed(limits)[-3:] == [
        "x at the end = x at the start + R",
        "y at the end = y at the start",
        "dy at the end = dy at the start",
    ]
    assert listed(others[others.index("At the end:") + 1])[-1] == "dx = R"


@pytest.mark.parametrize("problem", PROBLEMS)
def test_no_unknown_bound_or_given_value_of_the_gallery_is_left_out(problem):
    (name,) = [name for name in names([problem]) if "_hamiltonian" not in name]
    text = text_of(name)
    tree = ast.parse(text)
    statement = ast.get_docstring(tree)
    metadata = record_in(text)
    goal = joined(statement.split("\n\n")[1])
    for unknown in (*metadata.coordinates, *metadata.control_names, *metadata.free_parameters):
        assert re.search(rf"\b{unknown}\b", goal), unknown
    bounded = re.findall(r"^    (?:lower|upper)_(?:nodes|intervals|common)\[.*# (\w+)$", text, re.MULTILINE)
    for unknown in set(bounded) - set(metadata.meanings):
        assert re.search(rf"<= {unknown}\b|\b{unknown} [<>]= ", statement), unknown
    ends = dict(re.findall(r"At the (start|end):\n\n((?:    .*\n?)*)", statement))
    for where, quantities in (("start", metadata.start), ("end", metadata.end)):
        for quantity in quantities:
            assert re.search(rf"(?:^    |, ){quantity} = ", ends[where], re.MULTILINE), (where, quantity)


def test_bounds_are_stated_as_they_were_written_and_those_of_an_end_with_it():
    program = transcribe(load_problem(FOLDER / "cart_pendulum.py", {"form": "holonomic"}))
    text = "\n".join(description(program, [])).split("\n\n")
    assert "-6.28318530717959 <= theta <= 6.28318530717959" in listed(text[1])
    slow = ["dy <= 0.01", "dy >= -0.01", "dtheta <= 0.01", "dtheta >= -0.01"]
    for end in ("At the start:", "At the end:"):
        assert listed(text[text.index(end) + 1])[-4:] == slow
