"""What a user is told of a module that solves its problem, for every module of the gallery, and of failed solves."""

from __future__ import annotations

import golden
import pytest

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
    assert "kink in Abs(u)" in failed.notes[0]
    assert "write a + b for Abs(u)" in failed.notes[0]
    smooth = Control(dynamics={x: v, v: a - b}, cost=a + b, bounds={a: (0, 1), b: (0, 1)}, **rest)
    found = codegen.solve(smooth)
    assert found.solved
    assert found.cost == pytest.approx(3 - 5**0.5, rel=2e-3)
    assert not any("kink" in note for note in found.notes)
