"""Stress cases: no kind of wrong ending passes the verdict, no worker outlives its time, no module lies unnoticed."""

import csv
import math
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import pytest
from conftest import PROBLEMS
from idle_worker import SOLVED as GOOD
from idle_worker import serve
from interpreted import as_machine_code, without_compilation
from typer.testing import CliRunner

from codegen.cli import main
from codegen.compiler import generate
from codegen.naming import Choices
from codegen.schemes import METHODS
from codegen.stress import page, pool
from codegen.stress.cases import DEFECTS, OUTCOMES, Case, Setup
from codegen.stress.classify import classify
from codegen.stress.families import FAMILIES, QUICK, all_cases, quick_cases
from codegen.stress.families.common import (
    MECHANICAL,
    SYMPLECTIC_EULER,
    VERLET,
    oscillation,
    promised,
    registered,
    setup,
)
from codegen.stress.families.common import PROBLEMS as OWN_PROBLEMS
from codegen.stress.limits import GROWTH, spectral_radius, stable_limit
from codegen.stress.linear import growth, limit, swing, turn
from codegen.stress.measure import measure
from codegen.stress.references import REFERENCES
from codegen.stress.systems import FORCES, frequency, plate_gradient

every_case = cache(all_cases)
PLAIN = Case("plain", "stiff", setup("oscillator", VERLET), "accurate", "a test", bound=1e-3)


# ---- The registry ----


def test_there_are_enough_rows_with_unique_names_and_reasons():
    names = [(case.name, case.setup, case.driver) for case in every_case()]
    assert len(every_case()) >= 120
    assert len(set(names)) == len(names)
    assert all(len(case.reason) > 5 for case in every_case())
    assert {case.family for case in every_case()} == set(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_cases_expect_honest_outcomes_and_name_what_exists(family):
    for case in FAMILIES[family]():
        assert set(case.expected) <= set(OUTCOMES), case.name
        assert not case.reference or case.reference in REFERENCES, case.name
        assert not math.isfinite(case.bound) or case.reference, f"{case.name}: a bound, but nothing to compare with"
        assert case.setup.file.is_file(), case.name


def test_problems_are_written_for_the_package_alone():
    used = {case.setup.file for case in every_case()}
    assert used == set(OWN_PROBLEMS.glob("*.py"))
    assert {name for name, _ in QUICK} <= {path.stem for path in used}
    assert 0 < len(quick_cases()) < len(every_case())


def test_promises_end_where_steps_do_not_resolve_the_motion():
    verlet, euler = VERLET, SYMPLECTIC_EULER
    assert promised(verlet, 0.01, 10.0) < promised(euler, 0.01, 10.0) < 0.5
    assert math.isnan(promised(verlet, 0.6, 1.0))
    assert math.isnan(promised(euler, 0.4, 10.0))


# ---- The verdict ----


@pytest.mark.parametrize(
    ("seen", "outcome"),
    [
        (GOOD, "accurate"),
        (replace(GOOD, hung=True), "hang"),
        (replace(GOOD, exception="ZeroDivisionError: division by zero"), "untyped error"),
        (replace(GOOD, status="wonderful"), "untyped error"),
        (replace(GOOD, status="stalled", message=""), "untyped error"),
        (replace(GOOD, finite=False), "not a number"),
        (replace(GOOD, residual=1e-6), "false solved"),
        (replace(GOOD, residual=math.nan), "false solved"),
        (replace(GOOD, textbook=1e5), "false solved"),
        (replace(GOOD, error=0.1), "false solved"),
        (replace(GOOD, error=math.nan), "false solved"),
        (replace(GOOD, error=math.inf), "false solved"),
        (replace(GOOD, error=0.1, drift=0.5), "unexpected"),
        (replace(GOOD, error=0.1, announced=0.09), "unexpected"),
        (replace(GOOD, status="stalled", message="stalled at node 3; take more steps"), "unexpected"),
        (replace(GOOD, refusal="steps is 0; give a positive integer"), "unexpected"),
    ],
)
def test_nothing_but_what_is_expected_passes(seen, outcome):
    row = classify(PLAIN, seen)
    assert row.outcome == outcome
    assert row.passed == (outcome == "accurate")
    assert outcome in {**OUTCOMES, **DEFECTS}
    assert row.text


def test_runaway_energy_is_unsuitable_with_the_measured_limit():
    case = replace(PLAIN, bound=math.nan, h_omega=3.0, expect="unsuitable")
    seen = replace(GOOD, drift=1e6, stable_below=2.0000001)
    assert classify(case, seen).text.startswith("unsuitable, stable below h omega = 2.000 (measured)")
    assert classify(case, replace(seen, drift=1e-3)).outcome == "unexpected"
    overflow = replace(seen, status="non-finite", message="non-finite in step 7: use more steps")
    assert classify(case, overflow).outcome == "unsuitable"


def test_an_energy_that_is_no_number_is_not_bounded():
    case = replace(PLAIN, bound=math.nan, expect="bounded")
    assert classify(case, GOOD).passed
    assert not classify(case, replace(GOOD, drift=math.nan)).passed


# ---- Schemes on the oscillator ----

LIMITS = {
    "explicit-euler": 0.0,
    "implicit-euler": math.inf,
    "symplectic-euler": 2.0,
    "symplectic-euler-adjoint": 2.0,
    "midpoint": math.inf,
    "stormer-verlet": 2.0,
    "position-verlet": 2.0,
    "rectangle": 2.0,
    "trapezoidal": 2.0,
    "rk4": math.sqrt(8.0),
    "gauss-4": math.inf,
    "gauss-6": math.inf,
    "hermite-simpson": math.inf,
    "lobatto-4": math.sqrt(8.0),
}
"""Largest stable h omega in closed form: from traces of a step's matrix, and for rk4 from its polynomial."""


@pytest.mark.parametrize(("method", "name"), [s for s in MECHANICAL if s[1] in LIMITS])
def test_limits_of_stability_are_those_of_closed_forms(method, name):
    found = limit(METHODS[method][name])
    assert found == pytest.approx(LIMITS[name], rel=1e-4) if math.isfinite(LIMITS[name]) else found == math.inf


@pytest.mark.parametrize(("method", "name"), MECHANICAL)
def test_nothing_grows_up_to_the_limit_and_something_beyond(method, name):
    scheme = METHODS[method][name]
    found = limit(scheme)
    below = [0.5, 1.5, 50.0] if math.isinf(found) else [0.1 * found, 0.5 * found, 0.8 * found, 0.999 * found]
    assert all(growth(scheme, x) <= 1.0 + GROWTH for x in below)
    if math.isfinite(found):
        assert growth(scheme, 1.001 * found + 0.05 * (found == 0.0)) > 1.0 + GROWTH


def angle(method, name, x):
    return turn(METHODS[method][name], x)[0]


@pytest.mark.parametrize("method", METHODS)
def test_schemes_turn_by_angles_in_closed_form(method):
    """Gauss' methods turn by twice the argument of the numerator of exp's diagonal Padé approximant."""
    x = 0.7
    assert angle(method, "midpoint", x) == pytest.approx(2.0 * math.atan(x / 2), rel=1e-15)
    assert angle(method, "gauss-4", x) == pytest.approx(2.0 * math.atan2(x / 2, 1 - x**2 / 12), rel=1e-15)
    assert angle(method, "gauss-6", x) == pytest.approx(2.0 * math.atan2(x / 2 - x**3 / 120, 1 - x**2 / 10), rel=1e-15)
    assert swing(METHODS[method]["gauss-6"], x) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("method", "name"), [SYMPLECTIC_EULER, VERLET, ("variational", "trapezoidal")])
def test_explicit_schemes_turn_by_an_arcsine(method, name):
    """From rest at 1, q_k = cos((k + s) theta)/cos(s theta), with s = 1/2 for symplectic Euler and 0 for the others."""
    theta, lean = turn(METHODS[method][name], 0.7)
    assert theta == pytest.approx(2.0 * math.asin(0.35), rel=1e-15)
    assert lean == pytest.approx(-math.tan(theta / 2.0) if name == "symplectic-euler" else 0.0, abs=1e-15)


def test_there_is_no_angle_beyond_the_limit():
    assert math.isnan(angle("hamiltonian", "yoshida-4", 1.6))


@pytest.mark.parametrize("x", [0.1, 1.0, 1.9])
def test_energies_of_explicit_schemes_swing_as_what_they_keep_says(x):
    """p^2 + w^2 q^2 - h w^2 q p of symplectic Euler, p^2 + w^2 q^2 (1 - (h w)^2/4) of Störmer-Verlet."""
    half = x / 2.0
    assert swing(registered(SYMPLECTIC_EULER), x) == pytest.approx(half / (1.0 - half), rel=1e-12)
    assert swing(registered(VERLET), x) == pytest.approx(half**2, rel=1e-12)


@pytest.mark.parametrize("name", ["yoshida-4", "blanes-moan-6"])
def test_generated_steps_are_as_stable_as_the_tables_say(name):
    module = as_machine_code(generate(OWN_PROBLEMS / "oscillator.py", {}, Choices(name, "hamiltonian")))
    case = next(c for c in every_case() if c.setup.scheme == name and c.reference == "stable_step")
    assert stable_limit(module, case) == pytest.approx(limit(registered(("hamiltonian", name))), rel=1e-3)
    for x in (0.4, 1.4):
        assert spectral_radius(module, "oscillator", x) == pytest.approx(
            growth(registered(("hamiltonian", name)), x), rel=1e-6
        )


# ---- Worker processes ----


def test_hangs_and_crashes_cost_one_case_each():
    names = ("first", "sleeps", "second", "dies", "third")
    cases = [replace(PLAIN, name=name, seconds=0.3 if name == "sleeps" else 60.0) for name in names]
    seen = []
    measured = pool.run(cases, 1, lambda case, measurement: seen.append(case.name), serve)
    rows = [classify(case, measurement) for case, measurement in zip(cases, measured, strict=True)]
    assert [row.outcome for row in rows] == ["accurate", "hang", "accurate", "untyped error", "accurate"]
    assert seen == list(names)


# ---- Modules that lie ----


@pytest.fixture(scope="module")
def verlet():
    """The text of the oscillator's Störmer-Verlet module."""
    case = next(c for c in every_case() if c.setup == PLAIN.setup and c.name.endswith("h omega = 0.01"))
    case = replace(case, steps=100, values=(("omega", 100.0), ("duration", 0.01)), limit=False)
    return generate(OWN_PROBLEMS / "oscillator.py", {}, Choices("stormer-verlet", "hamiltonian")), case


def test_an_honest_module_is_accurate_and_its_limit_is_two(verlet):
    text, case = verlet
    module = as_machine_code(text)
    seen = measure(module, replace(case, limit=True))
    assert classify(case, seen).outcome == "accurate", classify(case, seen).text
    assert seen.textbook < 10.0
    assert seen.stable_below == pytest.approx(2.0, rel=1e-5)
    assert spectral_radius(module, "oscillator", 2.1) == pytest.approx(_growth(2.1), rel=1e-6)


def _growth(x):
    """Largest modulus of the roots of z^2 - (2 - x^2) z + 1, Störmer-Verlet's characteristic polynomial."""
    half_trace = abs(1.0 - x * x / 2.0)
    return half_trace + math.sqrt(half_trace**2 - 1.0)


def test_a_consistent_lie_of_all_kernels_is_found_by_the_textbook(verlet):
    text, case = verlet
    assert text.count("omega**2") >= 4
    lying = as_machine_code(text.replace("omega**2", "(1.0000001*omega**2)"))
    row = classify(case, measure(lying, case))
    assert row.outcome == "false solved"
    assert "textbook" in row.text
    unasked = measure(lying, replace(case, textbook=False))
    assert classify(case, unasked).outcome == "accurate", "the error alone does not show so small a lie"


def test_a_large_lie_is_found_by_the_closed_form(verlet):
    text, case = verlet
    lying = as_machine_code(text.replace("omega**2", "(1.5*omega**2)"))
    row = classify(case, measure(lying, replace(case, textbook=False)))
    assert row.outcome == "false solved"


def test_a_lie_of_the_steps_alone_is_no_success(verlet):
    text, case = verlet
    begin = text.index("def explicit_step(")
    end = text.index("def ", begin + 1)
    lying = text[:begin] + text[begin:end].replace("omega**2", "(1.5*omega**2)") + text[end:]
    assert lying != text
    row = classify(case, measure(as_machine_code(lying), case))
    assert not row.passed


def test_numbers_that_are_none_are_refused_by_name(verlet):
    text, case = verlet
    module = as_machine_code(text)
    from codegen.errors import NumericsError

    with pytest.raises(NumericsError, match="finite"):
        measure(module, replace(case, values=(("omega", math.nan),)))


def test_a_prescribed_value_beyond_its_bound_is_refused():
    module = without_compilation(generate(OWN_PROBLEMS / "walled_cart.py", {}, Choices()))
    walled = [replace(case, steps=6) for case in every_case() if case.setup.file.stem == "walled_cart"]
    behind = next(case for case in walled if case.name == "cart, wall behind the start")
    seen = measure(module, behind)
    assert seen.status == "infeasible"
    assert "x is prescribed as 0 at the start, beyond its bounds -inf to -0.1" in seen.message
    open_way = replace(behind, values=(("wall", 1.0),))
    assert measure(module, open_way).status == "solved"


# ---- References ----


@pytest.mark.parametrize("problem", FORCES)
def test_forces_written_by_hand_are_those_of_the_problem_file(problem):
    """Against the gradient of the generated energy, by complex-free central differences."""
    import numpy as np

    module = as_machine_code(generate(OWN_PROBLEMS / f"{problem}.py", {}, Choices("explicit-euler", "hamiltonian")))
    grid = module.make_grid(1)
    random = np.random.default_rng(3)
    q, p = 1.0 + 0.1 * random.standard_normal((2, len(grid.start) // 2))
    values = dict(module.metadata["parameters"])
    for i in range(len(q)):
        step = np.zeros(2 * len(q))
        step[i] = 1e-5
        state = np.concatenate([q, p])
        high, low = (module.energy(state + s * step, 0.0, grid.parameters) for s in (1.0, -1.0))
        assert FORCES[problem](values, q)[i] == pytest.approx(-(high - low) / 2e-5, rel=1e-6, abs=1e-6)


def test_the_plates_gradient_is_that_of_its_hamiltonian():
    import numpy as np

    q = np.array([[0.1, 0.2], [-0.3, 0.1], [0.0, -0.6]])
    p = np.array([[1.0, -0.5], [0.3, 0.2], [-0.7, 0.4]])

    def energy(q, p):
        total = 0.0
        for x, u in zip(q, p, strict=True):
            for y, v in zip(q, p, strict=True):
                ab, s = (1 - x @ x) * (1 - y @ y), (x - y) @ (x - y)
                total += (u @ v) * (ab / 2 - (s / 2 * np.log1p(ab / s) if s else 0.0)) / 2
        return total

    by_place, by_momentum = plate_gradient(q, p)
    for i, k in np.ndindex(3, 2):
        step = np.zeros((3, 2))
        step[i, k] = 1e-6
        assert by_place[i, k] == pytest.approx((energy(q + step, p) - energy(q - step, p)) / 2e-6, abs=1e-8)
        assert by_momentum[i, k] == pytest.approx((energy(q, p + step) - energy(q, p - step)) / 2e-6, abs=1e-8)


def test_frequencies_and_swings_of_energy():
    assert frequency("spring_pendulum", {"k": 1e4}) == 100.0
    assert oscillation(VERLET, 1.9) == pytest.approx(1.1 * 0.95**2, rel=1e-5)


# ---- What is left behind ----


class Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.rows, self.outside = 0, []

    def handle_starttag(self, tag, attributes):
        self.rows += tag == "tr"
        self.outside += [v for k, v in attributes if k in ("src", "href") and not v.startswith("#")]


def test_table_file_and_page_hold_every_row(tmp_path):
    rows = [
        classify(PLAIN, GOOD),
        classify(replace(PLAIN, name="a <b> case", expect="refused"), replace(GOOD, hung=True)),
    ]
    page.write_csv(rows, tmp_path / "stress.csv")
    page.write_page(rows, 1.0, tmp_path / "stress.html")
    with (tmp_path / "stress.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [row["outcome"] for row in read] == ["accurate", "hang"]
    assert float(read[0]["error"]) == GOOD.error
    text = (tmp_path / "stress.html").read_text()
    parsed = Links()
    parsed.feed(text)
    assert parsed.rows == 6  # two headings, and both rows in the overview and in the table
    assert parsed.outside == []
    assert "a &lt;b&gt; case" in text
    assert "1 rows failed" in text
    assert page.table(rows).row_count == 2


@pytest.mark.parametrize("words", [[], ["--all", str(PROBLEMS / "pendulum.py")], ["--quick", "nothing.py"]])
def test_the_command_wants_one_thing(words, tmp_path):
    result = CliRunner().invoke(main, ["stress", *words, "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "give one of them" in result.stderr


def test_generic_cases_vary_one_parameter_at_a_time():
    from codegen.stress.generic import FACTORS, STEPS, _cases

    metadata = {"task": "control", "steps": 50, "parameters": {"m": 2.0, "zero": 0.0}}
    cases = _cases(Setup(OWN_PROBLEMS / "arm.py"), metadata, ())
    varied = [case.values for case in cases if case.values]
    assert varied == [(("m", 2.0 * factor),) for factor in FACTORS]
    assert {case.steps for case in cases} == {50, 500, *STEPS}
    assert {case.noise for case in cases} == {0.0, 0.1, 1.0}


def test_every_scheme_has_its_limit_on_the_oscillator_case():
    wanted = {case.setup.label for case in every_case() if case.reference == "stable_step"}
    assert len(wanted) == len(MECHANICAL)
    assert callable(stable_limit)
