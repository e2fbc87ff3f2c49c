"""A damaged kernel or pattern is found, and the finding names the entry."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from codegen.evidence import checks

ABOUT_EXPRESSIONS = {
    "discrete equations",
    "integrals",
    "discrete Noether",
    "consistency",
    "symplecticity",
    "area preservation",
    "midpoint equivalence",
}
"""Checks that do not run the module."""


def failures(name, context):
    return [finding for finding in checks.apply(name, context) if not finding.passed]


def line_with(context, comment: str, function: str) -> str:
    """The assignment in a function that carries a comment."""
    match = re.search(rf"^    [^=\n]+= .*  # {re.escape(comment)}$", text_from(context, function), re.MULTILINE)
    assert match
    return match[0]


def text_from(context, function: str) -> str:
    """The text of the module from a function on."""
    text = Path(context.module.__file__).read_text(encoding="utf-8")
    return text[text.index(f"def {function}(") :]


def negated(line: str) -> str:
    target, operator, code = re.fullmatch(r"(    [^=]+?) (\+?=) (.*?)  #.*", line).groups()
    return f"{target} {operator} -({code})"


@pytest.mark.parametrize("problem", ["linear_pendulum", "orbital_transfer"])
def test_sign_in_the_hessian(prepared, damaged, problem):
    context = prepared(problem)
    entry = "d2l/dq_k1 dlambda_q_k" if problem == "linear_pendulum" else "d2l/dphi_k1 dr_k"
    line = line_with(context, entry, "interval_hessian")
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == "interval_hessian"
    assert entry in failure.detail


def test_sign_in_the_gradient(prepared, damaged):
    context = prepared("linear_pendulum")
    line = line_with(context, "dl/dlambda_q_k", "interval_gradient")
    found = failures("derivatives", damaged(context, line, negated(line)))
    # Differences and complex steps find it independently.
    assert [failure.subject for failure in found] == ["interval_gradient"] * 2
    assert all("dl/dlambda_q_k " in failure.detail for failure in found)


def test_slight_error_in_the_gradient(prepared, damaged):
    context = prepared("linear_pendulum")
    line = line_with(context, "dl/df_k", "interval_gradient")
    found = failures("derivatives", damaged(context, line, line.replace("  #", "*(1 + 1e-9)  #")))
    assert found
    assert all("dl/df_k " in failure.detail for failure in found)


def test_cost(prepared, damaged):
    context = prepared("linear_pendulum")
    line = re.search(r"    return .*", text_from(context, "interval_gradient"))[0]
    (failure,) = failures("derivatives", damaged(context, line, line + "*1.01"))
    assert "Cd differs" in failure.detail


@pytest.mark.parametrize("end", ["start", "end"])
def test_end_momentum(prepared, damaged, end):
    context = prepared("linear_pendulum")
    suffix = "k" if end == "start" else "k1"
    line = line_with(context, f"by lambda_q_{suffix}", f"{end}_gradient")
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == f"{end}_gradient"
    assert f"by lambda_q_{suffix}" in failure.detail


def test_permuted_pattern(prepared, damaged):
    context = prepared("linear_pendulum")
    columns = [int(c) for c in context.module.HESSIAN_COLUMNS]
    rows = [int(r) for r in context.module.HESSIAN_ROWS]
    index = next(i for i in range(1, len(rows)) if rows[i] == rows[i - 1] and columns[i] - columns[i - 1] > 1)
    permuted = [*columns]
    permuted[index - 1] += 1  # the entry moves to a neighbouring column
    damage = damaged(context, f"HESSIAN_COLUMNS = np.array({columns}", f"HESSIAN_COLUMNS = np.array({permuted}")
    missing, needless = failures("sparsity", damage)
    assert "not emitted: d2l/d" in missing.detail
    assert "identically zero: d2l/d" in needless.detail
    assert failures("derivatives", damage)


def test_swapped_columns_of_equal_rows(prepared, damaged):
    context = prepared("orbital_transfer")
    columns = [int(c) for c in context.module.HESSIAN_COLUMNS]
    swapped = [*columns[:-2], columns[-1], columns[-2]]
    damage = damaged(context, f"HESSIAN_COLUMNS = np.array({columns}", f"HESSIAN_COLUMNS = np.array({swapped}")
    (failure,) = failures("derivatives", damage)
    assert "d2l/dlambda_phi_k1 d" in failure.detail


def test_jacobian_of_a_step(prepared, damaged):
    context = prepared("pendulum")
    line = line_with(context, "by p_k1", "step_jacobian")
    found = failures("derivatives", damaged(context, line, negated(line)))
    assert "step_jacobian" in [failure.subject for failure in found]
    assert "d residual 0/dp_k1" in next(f for f in found if f.subject == "step_jacobian").detail


@pytest.mark.parametrize("entry", ["dl/dx2_k", "dl/dmu_x1_k"])
def test_gradient_without_stages(prepared, damaged, entry):
    context = prepared("van_der_pol", {}, scheme="rk4")
    line = line_with(context, entry, "interval_shooting")
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == "interval_shooting"
    assert entry in failure.detail


def test_stage_of_an_explicit_scheme(prepared, damaged):
    context = prepared("van_der_pol", {}, scheme="rk4")
    line = re.search(r"    x2_stage3 = .*", text_from(context, "interval_shooting"))[0]
    (failure,) = failures("derivatives", damaged(context, line, line + " + 1e-6"))
    assert failure.subject == "interval_shooting"


def test_elimination(prepared, damaged):
    context = prepared("pendulum")
    damage = damaged(context, "interval[0] = q_k1", "interval[0] = q_k1 + 1e-6")
    assert "one step" in [failure.subject for failure in failures("derivatives", damage)]


def test_energy(prepared, damaged):
    context = prepared("pendulum", {}, scheme="symplectic-euler")
    line = re.search(r"    return .*", text_from(context, "energy"))[0]
    (failure,) = failures("derivatives", damaged(context, line, line + " + 1"))
    assert failure.subject == "energy"


def test_module_that_cannot_run_is_a_finding(prepared, damaged):
    context = prepared("pendulum")
    damage = damaged(context, "def energy(state, t, parameters):", "def energy(state, t):")
    (failure,) = failures("layout", damage)
    assert "kernel energy fails (TypeError" in failure.detail


def test_pattern_that_is_too_short(prepared, damaged):
    # Compiled, the kernel would write beyond the end of an array.
    context = prepared("linear_pendulum")
    texts = []
    for name in ("HESSIAN_ROWS", "HESSIAN_COLUMNS"):
        entries = [int(i) for i in getattr(context.module, name)]
        texts += [f"{name} = np.array({entries}", f"{name} = np.array({entries[:-1]}"]
    damage = damaged(context, *texts)
    (failure,) = failures("layout", damage)
    assert "kernel interval_hessian fails (IndexError" in failure.detail
    for name in set(checks.CHECKS) - {"layout", *ABOUT_EXPRESSIONS}:
        (failure,) = failures(name, damage)
        assert "not run" in failure.detail


def test_entry_that_is_never_written(prepared, damaged):
    context = prepared("linear_pendulum")
    line = line_with(context, "dl/df_k", "interval_gradient")
    (failure,) = failures("layout", damaged(context, line, "    pass"))
    assert "kernel interval_gradient leaves gradient[2] without a value" in failure.detail


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("START_PINNED = np.array([0]", "START_PINNED = np.array([1]"),
        ("IS_MULTIPLIER = np.array([False, True, False])", "IS_MULTIPLIER = np.array([True, True, False])"),
        ("ELEMENT = 5", "ELEMENT = 6"),
    ],
)
def test_tables(prepared, damaged, old, new):
    (failure,) = failures("layout", damaged(prepared("linear_pendulum"), old, new))
    assert f"{old.partition(' ')[0]} is" in failure.detail


@pytest.mark.slow
def test_what_follows_from_parameters(prepared, damaged):
    """Boundary values that follow parameters otherwise than the problem says: no other check looks at that."""
    context = prepared("orbital_transfer", sensitivities=True)
    number = context.module.QUANTITIES.index("GM")
    found = re.search(rf"(rates\[{number}, :, \d+\] = )([^ #\n]+)", text_from(context, "data_rates"))
    damage = damaged(context, found[0], f"{found[1]}1.00001*({found[2]})")
    assert all(finding.applies for finding in checks.apply("sensitivities", context))
    (failure,) = failures("sensitivities", damage)
    assert failure.subject.startswith("parameters, which others follow")
    assert [name for name in checks.CHECKS if name != "sensitivities" and failures(name, damage)] == []
