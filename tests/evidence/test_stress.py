"""Stress cases: no kind of wrong ending passes the verdict, no worker outlives its time, no module lies unnoticed."""

import csv
import math
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from conftest import PROBLEMS
from idle_worker import SOLVED as GOOD
from idle_worker import serve
from stress_cases import PLAIN, every_case
from typer.testing import CliRunner

from codegen.cli import main
from codegen.evidence.stress import page, pool
from codegen.evidence.stress.cases import DEFECTS, OUTCOMES, VIOLATIONS, classify
from codegen.evidence.stress.families import FAMILIES, QUICK, quick_cases
from codegen.evidence.stress.measure import REFERENCES
from codegen.evidence.stress.motions import SYMPLECTIC_EULER, VERLET, promised
from codegen.evidence.stress.problems import PROBLEMS as OWN_PROBLEMS
from codegen.solving.drivers import TASKS

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
    used = {case.setup.problem for case in every_case()}
    assert used == set(OWN_PROBLEMS)
    assert {name for name, _ in QUICK} <= used
    assert 0 < len(quick_cases()) < len(every_case())


def test_every_task_has_its_limit_of_violations():
    assert set(VIOLATIONS) == set(TASKS)


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
    assert classify(case, replace(GOOD, drift=math.nan, has_energy=False)).passed


# ---- Worker processes ----


def test_hangs_and_crashes_cost_one_case_each():
    names = ("first", "sleeps", "second", "dies", "third")
    cases = [replace(PLAIN, name=name, seconds=0.3 if name == "sleeps" else 60.0) for name in names]
    seen = []
    measured = pool.run(cases, 1, lambda case, measurement: seen.append(case.name), serve)
    rows = [classify(case, measurement) for case, measurement in zip(cases, measured, strict=True)]
    assert [row.outcome for row in rows] == ["accurate", "hang", "accurate", "untyped error", "accurate"]
    assert seen == list(names)


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
