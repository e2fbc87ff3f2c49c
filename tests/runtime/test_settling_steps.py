"""Steps that a filter sees nothing of, at rounding level, and that lead closer to an optimum all the same."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from codegen.runtime.optimise import line_search
from codegen.runtime.optimise.line_search import converges_unseen

SEARCH = SimpleNamespace(grid=SimpleNamespace(is_multiplier=np.array([False, True])))


def iterate(error: float) -> SimpleNamespace:
    return SimpleNamespace(point=SimpleNamespace(error=error, unknowns=np.ones(2)))


@pytest.mark.parametrize(
    ("moved", "closer", "only_rounding", "accepted"),
    [
        (0.0, True, False, True),  # multipliers alone move
        (1e-9, True, True, True),  # as in a fit to exact data, whose barrier leaves unknowns so far from their values
        (1e-9, True, False, False),
        (1e-9, False, True, False),  # nothing is won, and a search could go on for ever
    ],
)
def test_what_is_taken_though_the_filter_refuses_it(monkeypatch, moved, closer, only_rounding, accepted):
    monkeypatch.setattr(line_search, "INEQUALITIES", 0)
    monkeypatch.setattr(line_search, "is_at_rounding_level", lambda grid, point: only_rounding)
    step = SimpleNamespace(primal=np.array([moved, 1.0]))
    found = converges_unseen(SEARCH, iterate(2.5e-9), step, iterate(1e-15 if closer else 2.4e-9))
    assert found is accepted
