"""The page on the thesis: its figures are complete, its commands exist, its errata have proofs, its values are kept."""

from __future__ import annotations

import importlib
import json
import math
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer.main
from prose import AVOIDED, prose_of
from thesis import ENTRIES
from thesis.control import MOTIONS, exact_pendulum
from thesis.entries import Kind, Runs, every, points_file
from thesis.errata import ERRATA, Proof
from thesis.landmarks import REGISTRATIONS

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "docs" / "_extensions"))
thesis_page = importlib.import_module("thesis_page")
RECORD = json.loads(thesis_page.RECORD.read_text(encoding="utf-8"))
LONG = {"f3", "midpoint-energy", "green-constant", "source-terms", "warp-indices", "benchmark-cost"}
"""Errata whose proofs take more than half a second."""
PROOFS = [pytest.param(each, marks=pytest.mark.slow if each.name in LONG else (), id=each.name) for each in ERRATA]
SAMPLE = ("figure-1.3", "forced-equations", "nodal-pendulum", "clamped-plate", "curved-path", "euler-poincare")


def test_all_figures_and_tables_of_the_thesis_have_an_entry():
    numbers = set()
    for entry in ENTRIES.values():
        if entry.kind in (Kind.FIGURE, Kind.TABLE):
            first, last = (re.findall(r"(\w)\.(\d+)", entry.place) * 2)[:2]
            assert first[0] == last[0]
            numbers |= {(entry.kind, first[0], n) for n in range(int(first[1]), int(last[1]) + 1)}
    chapters = {"1": 3, "3": 9, "5": 18, "A": 5}
    figures = {(Kind.FIGURE, chapter, n + 1) for chapter, count in chapters.items() for n in range(count)}
    assert numbers == figures | {(Kind.TABLE, "5", 1), (Kind.TABLE, "5", 2)}


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES)
def test_every_entry_has_commands_that_exist(entry):
    from codegen.cli import main

    commands = RECORD["entries"][entry.name]["commands"]
    assert len(commands) == max(1, len(entry.commands))
    for number, command in enumerate(commands):
        program, *arguments = shlex.split(command["last"])
        if entry.commands:
            template = re.sub(r"\\{\w+\\}", r"\\S*", re.escape(entry.commands[number].replace("{folder}/", "")))
            assert re.fullmatch(template, command["last"])
            assert program == "codegen"
            parser = typer.main.get_command(main).commands[arguments[0]]
            parser.make_context(arguments[0], [own.replace("problems/", f"{ROOT}/problems/") for own in arguments[1:]])
        else:
            assert (ROOT / arguments[0]).is_file()
            assert arguments[1:] == ["--only", entry.name]


def test_names_of_entries_are_different():
    assert len(MOTIONS) + len(REGISTRATIONS) + len(ERRATA) == len(ENTRIES)


@pytest.mark.parametrize("entry", PROOFS)
def test_every_erratum_has_a_proof_that_fails_for_the_printed_statement(entry, monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    proof = entry.measure
    assert isinstance(proof, Proof)
    without_commands = Runs(replace(entry, commands=()), tmp_path)
    assert [row.holds for row in proof(without_commands)] == [True, True]
    swapped = replace(proof, printed=proof.corrected, corrected=proof.printed)
    assert [row.holds for row in swapped(without_commands)] == [False, False]


def test_the_record_has_all_entries_and_no_value_outside_its_limits():
    assert set(RECORD["entries"]) == set(ENTRIES)
    assert RECORD["machine"]["processor"]
    for name, kept in RECORD["entries"].items():
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", kept["date"])
        assert kept["rows"], name
        assert [row for row in kept["rows"] if not thesis_page.holds(row)] == [], name


def test_the_sentences_of_the_page_are_short_and_plain():
    prose = prose_of(thesis_page.page())
    assert prose.too_long() == []
    assert prose.indirect() == []
    assert not prose.containing(AVOIDED)
    assert prose.mean < 18
    assert len(prose.sentences) > 100


def test_the_page_shows_recorded_values_and_marks_those_outside_their_limits():
    page = thesis_page.page()
    assert re.findall(r"@[A-Z]+@", page) == []
    for entry in ENTRIES.values():
        assert f"### `{entry.name}`: {entry.place}\n" in page
    row = {"quantity": "cost", "there": "1", "here": 2.5, "high": 2.0}
    assert thesis_page.table_row(row) == "| cost | 1 | 2.5 | at most 2 | **no** |"
    assert thesis_page.table_row(row | {"here": 1.5}) == "| cost | 1 | 1.5 | at most 2 | yes |"


def test_the_cost_of_the_linear_pendulum_is_that_of_its_two_point_problem():
    # f = (c2 cos t - c1 sin t)/2 minimises; its Gramian gives the cost without the thesis's constants.
    t, weights = np.polynomial.legendre.leggauss(40)
    t, weights = (t + 1) * math.pi / 4, weights * math.pi / 4
    response = np.stack([np.sin(math.pi / 2 - t), np.cos(math.pi / 2 - t)])
    gap = np.array([2 * math.pi / 5, 3 * math.pi / 5])  # the target minus the free motion from 3 pi/5 at rest
    assert exact_pendulum() == pytest.approx(gap @ np.linalg.solve(response * weights @ response.T, gap), rel=1e-12)


def test_landmarks_are_those_of_the_reports():
    from codegen.evidence.report.store import few_landmarks

    for count in (3, 4, 5):
        points = few_landmarks(count)
        kept = np.loadtxt(ROOT / points_file(count), delimiter=",", skiprows=1)
        assert np.array_equal(kept, np.hstack([points.start, points.target]))


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLE)
def test_a_sample_of_entries_has_the_recorded_values(name, monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    rows = list(every(ENTRIES[name].measure(Runs(ENTRIES[name], tmp_path))))
    kept = {row["quantity"]: row for row in RECORD["entries"][name]["rows"]}
    assert set(kept) == {row.quantity for row in rows}
    for row in rows:
        assert row.holds, row
        assert row.here == pytest.approx(kept[row.quantity]["here"], rel=1e-6, abs=1e-8)
