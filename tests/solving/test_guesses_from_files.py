"""Guesses that a table or a trajectory in a file gives."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import without_compilation

from codegen.solving.compiler import build

_GUESSED = '''"""An oscillator that starts from a file."""

from codegen import Control, Table, Trajectory, control, states


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={{x: v, v: u - x}},
        cost=u**2,
        duration=3,
        start={{x: 1, v: 0}},
        end={{x: 0, v: 0}},
        guess={guess},
        steps=6,
    )
'''


@pytest.mark.parametrize(
    ("guess", "inside"),
    [
        ('Trajectory("start.csv")', lambda t: np.interp(t, [0, 1, 2.2], [0.5, -0.1, 0.3])),
        ('Trajectory("start.csv", kind="steps")', lambda t: np.select([t < 1, t < 2.2], [0.5, -0.1], 0.3)),
        (
            '{u: Table("start.csv", "t", "u", kind="linear", outside="clamp")}',
            lambda t: np.interp(t, [0, 1, 2.2], [0.5, -0.1, 0.3]),
        ),
    ],
)
def test_guesses_from_files(folder, guess, inside):
    (folder / "start.csv").write_text("# by another program\nt,u,x\n0,0.5,1\n1,-0.1,0.25\n2.2,0.3,0\n")
    (folder / "started.py").write_text(_GUESSED.format(guess=guess))
    module = without_compilation(build(folder / "started.py").path.read_text())
    grid = module.make_grid(6)
    nodes, intervals = module.views(grid, module.initial_guess(grid))
    middles = 0.25 + 0.5 * np.arange(6)
    assert intervals[0, :, -1] == pytest.approx(inside(middles))
    if "Trajectory" in guess and "steps" not in guess:
        times = 0.5 * np.arange(7)
        assert nodes[0, :, 0] == pytest.approx(np.interp(times, [0, 1, 2.2], [1, 0.25, 0]))
    assert module.solve().status == "solved"
