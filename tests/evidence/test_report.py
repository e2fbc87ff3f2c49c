"""The study of landmark registration: what is stored, that nothing is measured twice, what the page says, refusals."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import PROBLEMS

from codegen.cli import main
from codegen.evidence.report import landmark_cases, landmark_study, page
from codegen.evidence.report import store as settings
from codegen.evidence.report.store import Case, Store
from codegen.solving.results.motions import intersecting_paths


@pytest.fixture
def problem(tmp_path):
    """The problem file beside two landmarks instead of forty, for uncompiled modules."""
    path = tmp_path / "image_registration.py"
    shutil.copy(PROBLEMS / path.name, path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "trilobite40.csv").write_text("x0,y0,x1,y1\n0.1,0.2,0.15,0.2\n-0.3,0.1,-0.3,0.16\n")
    return path


@pytest.fixture
def uncompiled(monkeypatch, interpreted):
    def made(path, scheme, method, arguments):
        return interpreted("image_registration", arguments=dict(arguments), scheme=scheme, method=method)

    monkeypatch.setattr(settings, "_module", made)


def test_a_case_is_measured_once_and_a_damaged_line_again(tmp_path):
    made = []
    case = Case("part", "one", lambda: made.append(1) or {"x": np.float64(0.5), "y": np.array([1.0, np.nan])})
    file = tmp_path / "m.jsonl"
    assert Store(file).measured(case)
    store = Store(file)
    assert not store.measured(case)
    assert store.get("part", "one") == {"x": 0.5, "y": [1.0, None]}
    assert list(csv.reader(store.table().splitlines()))[1:] == [
        ["part", "one", "x", "0.5"], ["part", "one", "y[0]", "1.0"], ["part", "one", "y[1]", ""],
    ]  # fmt: skip
    file.write_text(file.read_text()[:-20])
    assert Store(file).measured(case)
    assert len(made) == 2


@pytest.mark.parametrize("count", [3, 4, 5])
def test_random_landmarks_are_those_that_are_documented(count):
    points = settings.few_landmarks(count)
    first, second = (np.hypot(*x.T) for x in (points.start, points.target))
    assert (first < 0.9).all()
    assert (second < 0.9).all()
    grown = second - first
    assert (((grown >= 0) & (grown < 0.1)) | ((grown >= -0.4) & (grown < -0.3))).all()
    turned = np.angle((points.target @ [1, 1j]) / (points.start @ [1, 1j]))
    assert ((turned >= 0) & (turned < 0.1 * np.pi)).all()
    assert not intersecting_paths(points.start, points.target)


def test_nodal_momenta_have_the_null_space_of_alternating_ones():
    matrix = landmark_cases.unknowns("nodes", 2, 4)
    assert matrix.shape[1] - np.linalg.matrix_rank(matrix) == 2
    alternating = np.concatenate([np.zeros(6), np.repeat((-1.0) ** np.arange(5), 2)])
    np.testing.assert_array_equal(matrix @ alternating, 0.0)


def test_cell_areas_of_a_shear_and_of_a_fold():
    places = landmark_cases.grid()
    spacing = places[1, 0, 0] - places[0, 0, 0]
    sheared = places + 0.3 * places[..., 1:] * np.array([1.0, 0.0])
    np.testing.assert_allclose(landmark_cases.cell_areas(sheared), spacing**2)
    np.testing.assert_allclose(landmark_cases.cell_areas(places * [-1.0, 1.0]), -(spacing**2))


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (1234.5, "1234"), (0.01234, "0.0123"), (2.24e-14, "2.24·10⁻¹⁴"), (None, "–")]
)
def test_numbers_in_sentences(value, text):
    assert page.number(value) == text


INVENTED = {
    ("references", "nc 3"): {"cost": 0.5, "path": [[[0.1, 0.2]], [[0.2, 0.2]]], "drift": 1e-12},
    ("references", "nc 40"): {"cost": 1.25, "path": [[[0.1, 0.2]], [[0.2, 0.2]]], "drift": 1e-12},
    ("table 5.2", "midpoint; nc 40"): {"cost": 1.251, "seconds": 0.1, "status": "solved"},
    ("table 5.2", "explicit-euler; nc 40"): {"cost": 1.253, "seconds": 0.01, "status": "solved"},
    ("tolerances", "lsoda 1.0e-02"): {"cost": 1.26, "seconds": 0.2, "status": "solved", "tolerance": 1e-2},
    ("sweeps", "explicit-euler; stepping, fsolve; nc 3; N 4"): {
        "status": "stalled", "cost": 0.6, "residual": 1e-5, "seconds": 0.01, "iterations": 9,
    },
}  # fmt: skip


def test_the_study_keeps_what_is_known_and_measures_the_rest(tmp_path, problem, uncompiled, monkeypatch):
    """What the file holds is invented; the weak solution is measured, on uncompiled modules, and only once."""
    chosen, out = replace(settings.quick_settings(problem), steps=(4,)), tmp_path / "out"
    out.mkdir()
    store = Store(out / "quick.jsonl")
    for (part, name), values in INVENTED.items():
        store.measured(Case(part, name, lambda values=values: values))
    monkeypatch.setattr(landmark_study, "PARTS", [part for part in landmark_study.PARTS if part[0] == "weak solution"])
    text = landmark_study.run(chosen, out).read_text()
    assert "1.250000000000" in text
    assert "exceeds the thesis" in text  # 1e-2 is more than 4e-6
    assert "93990" in text  # the thesis's 9399 s divided by 0.1 s
    assert (
        "Solves that failed: 1, first stepping, fsolve, nc = 3, N = 4; they stopped with residuals from 1.0·10⁻⁵"
        in text
    )
    assert text.count("<svg") == 9
    for reference in ("<script", "<link", "src="):
        assert reference not in text
    values = Store(out / "quick.jsonl").get("weak solution", "nc 3")
    assert values["largest defect"] < 1e-6 < values["largest rate"]
    with (out / "measurements.csv").open() as file:
        rows = {(row["case"], row["quantity"]): row["value"] for row in csv.DictReader(file)}
    assert float(rows["nc 3", "largest defect"]) == values["largest defect"]
    assert json.loads((out / "environment.json").read_text())["seeds"]["few landmarks"] == "numpy default_rng(nc)"
    before = (out / "quick.jsonl").read_bytes()
    landmark_study.run(chosen, out)
    assert (out / "quick.jsonl").read_bytes() == before


def test_sentences_claim_what_was_measured(tmp_path):
    """A defect that does not vanish is said not to."""
    for size, claim in ((1e-9, "vanishes up to"), (0.1, "does NOT vanish")):
        store = Store(tmp_path / f"{size}.jsonl")
        store.measured(Case("weak solution", "nc 3", lambda size=size: {"largest defect": size, "largest rate": 1.0}))
        assert claim in landmark_study._ansatz(store).texts[0]


def test_a_problem_that_is_absent_has_no_report(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["report", str(PROBLEMS / "absent.py"), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert "no such file" in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
