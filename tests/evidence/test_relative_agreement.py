"""Emitted values against exact ones: what counts as rounding, and what as a difference."""

from __future__ import annotations

import mpmath
import pytest

from codegen.evidence.checks.base import Agreement
from codegen.evidence.checks.derivatives import check_couplings


def agreement(emitted, exact):
    found = Agreement()
    found.compare([str(i) for i in range(len(exact))], emitted, [mpmath.mpf(value) for value in exact])
    return found.finding("values", "exact ones")


@pytest.mark.parametrize("noise", ["0", "2e-40"])
def test_an_entry_that_vanishes_has_no_digits_to_agree(noise):
    """A kernel's terms cancel to rounding, and differences in 120 digits to their own."""
    assert agreement([1.3, 7e-12], ["1.3", noise]).passed
    assert not agreement([1.3, 7e-10], ["1.3", noise]).passed


def test_small_entries_agree_by_their_own_size():
    assert agreement([1.0, 1e-9], ["1", "1e-9"]).passed
    assert not agreement([1.0, 1e-9], ["1", "1.001e-9"]).passed


def test_nothing_but_zeros():
    assert agreement([0.0, 0.0], ["0", "0"]).passed
    assert not agreement([0.0, 1e-16], ["0", "0"]).passed


def test_interior_angles_that_are_all_prescribed(prepared):
    """Curvatures of acos by bodies that an angle does not connect are zero, and come out as rounding."""
    context = prepared("hovercraft", {"craft": "4", "conditions": "redundant"})
    findings = list(check_couplings(context, context.program))
    assert len(findings) == 3
    assert [finding.detail for finding in findings if not finding.passed] == []
