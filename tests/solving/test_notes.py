"""What a user is told of a module that solves its problem, for every module of the gallery, and of failed solves."""

from __future__ import annotations

import golden
import pytest
import sympy

import codegen
from codegen import Control, controls, states
from codegen.solving.results.output import notes, record_in


@pytest.mark.parametrize("name", sorted(golden.names()))
def test_notes_of_every_module_can_be_told(name):
    """As `codegen build` prints them: of phases one ended in a TypeError, for want of such a test."""
    for note in notes(record_in(golden.text_of(name))):
        assert isinstance(note, str)
        assert note


def test_a_failed_solve_from_python_tells_of_kinks():
    """Least fuel by |u| has its optimum 3 - sqrt(5) at the kink; with two controls in place of |u| it is found."""
    x, v = states("x v")
    u, a, b = controls("u a b")
    rest = {"duration": 3, "start": {x: 0, v: 0}, "end": {x: 1, v: 0}, "steps": 50}
    kinked = Control(dynamics={x: v, v: u}, cost=abs(u), bounds={u: (-1, 1)}, **rest)
    failed = codegen.solve(kinked, max_iterations=300)
    assert not failed.solved
    assert failed.notes[0].startswith("Abs(u) has a kink")
    assert "a + b for Abs(u)" in failed.notes[0]
    smooth = Control(dynamics={x: v, v: a - b}, cost=a + b, bounds={a: (0, 1), b: (0, 1)}, **rest)
    found = codegen.solve(smooth)
    assert found.solved
    assert found.cost == pytest.approx(3 - 5**0.5, rel=2e-3)
    assert not any("kink" in note for note in found.notes)


def test_a_kink_of_a_control_in_the_equations_of_motion(uncompiled):
    energy, power = codegen.state("E"), codegen.control("P")
    losses = {energy: sympy.Max(0, power) - sympy.Min(0, energy) + sympy.Min(0, power) / 2}
    battery = codegen.Control(dynamics=losses, cost=power**2, duration=1, start={energy: 2}, end={energy: 3})
    (note,) = [note for note in codegen.solve(battery, steps=4, max_iterations=1).notes if "kink" in note]
    assert note.startswith("Max(0, P), Min(0, P) has a kink")
