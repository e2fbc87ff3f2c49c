"""Batches that are refused in one line, and leave nothing behind."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from command_lines import assert_refused, contents, run
from small_batches import batch, make

pytestmark = pytest.mark.usefixtures("solver")

LINES = {
    "workers-zero": ("in --out new --workers 0", "--workers"),
    "workers-negative": ("in --out new --workers -2", "--workers"),
    "workers-word": ("in --out new --workers many", "--workers"),
    "workers-and-cluster": ("in --out new --workers 2 --cluster tcp://127.0.0.1:9", "leave --workers out"),
    "cluster-nobody": ("in --out new --cluster tcp://127.0.0.1:9", "such as tcp://"),
    "cluster-nonsense": ("in --out new --cluster nonsense", "such as tcp://"),
    "cluster-empty": ("in --out new --cluster=", "--cluster without an address"),
    "one-image-workers": ("in/000.png --landmarks in/000.csv --out x.png --workers 2", "--workers is for many pairs"),
    "one-image-cluster": ("in/000.png --landmarks in/000.csv --out x.png --cluster local", "--cluster is for many"),
    "one-image-resume": ("in/000.png --landmarks in/000.csv --out x.png --resume", "--resume is for many pairs"),
    "resume-other-options": ("in --out old --resume --sigma 3", "summary.csv is that of another batch"),
    "resume-other-journal": ("in --out begun --resume", "tells of another batch"),
    "resume-damaged-journal": ("in --out damaged --resume", "is damaged"),
    "scheme-unknown": ("in --out new --scheme nonsense", "nonsense"),
    "scheme-adaptive": ("in --out new --scheme dop853", "dop853"),
    "sigma-word": ("in --out new --sigma much", "--sigma much"),
    "out-missing": ("in", "--out is missing"),
    "out-is-in": ("in --out in", "--out is missing, or is in itself"),
    "out-is-a-file": ("in --out x.txt", "--out: "),
    "out-read-only": ("in --out /proc/nothing", "--out: "),
    "field-read-only": ("in --out new --field /proc/nothing", "--field: "),
    "no-images": ("empty --out new", "holds 0 images"),
    "no-landmarks": ("bare --out new", "none with a landmark file"),
    "two-landmark-files": ("twice --out new", "both belong to a.png"),
    "no-table": ("nothing.csv --out new", "nothing.csv cannot be read"),
    "table-columns": ("columns.csv --out new", "the columns are a,b"),
    "table-ragged": ("ragged.csv --out new", "ragged.csv:2: not as many values"),
    "table-same-out": ("same.csv --out new", "would both be written to"),
    "table-no-place": ("place.csv", "there is no place for the result"),
    "table-and-landmarks": ("place.csv --landmarks in/000.csv --out new", "leave --landmarks out"),
    "report-index": ("index --out new --report pages", "is the page about all pairs"),
}  # fmt: skip


@pytest.fixture(scope="module")
def malformed(solver, tmp_path_factory):
    """A folder with everything that can be wrong."""
    base = tmp_path_factory.mktemp("malformed")
    source = make(base / "in", 3)
    batch(source, base / "old")
    for name, text in {"begun": '{"batch": "another"}\n', "damaged": "what is this\n"}.items():
        (base / name).mkdir()
        (base / name / "summary.csv.journal").write_text(text)
    for name, files in {
        "empty": (), "bare": ("a.png",), "twice": ("a.png", "a.csv", "a.tps"), "index": ("index.png", "index.csv"),
    }.items():  # fmt: skip
        (base / name).mkdir()
        for file in files:
            (base / name / file).write_bytes(b"" if ".tps" in file else (source / f"000{file[-4:]}").read_bytes())
    (base / "x.txt").write_text("keep me")
    (base / "columns.csv").write_text("a,b\n1,2\n")
    (base / "ragged.csv").write_text("moving,landmarks,out\nin/000.png,in/000.csv\n")
    (base / "same.csv").write_text("moving,landmarks,out\nin/000.png,in/000.csv,a.png\nin/002.png,in/002.csv,a.png\n")
    (base / "place.csv").write_text("moving,landmarks\nin/000.png,in/000.csv\n")
    return base


@pytest.mark.parametrize(("words", "fragment"), LINES.values(), ids=LINES)
def test_what_is_wrong_is_said_in_a_line_and_nothing_is_written(malformed, words, fragment, monkeypatch):
    monkeypatch.setattr("codegen.batch.executors.dask.PATIENCE", 0.5)
    monkeypatch.chdir(malformed)
    before, folders = contents(malformed), {*malformed.rglob("*")}
    assert_refused(run("warp", *words.split()), fragment)
    assert contents(malformed) == before
    assert {*malformed.rglob("*")} == folders


def test_without_dask_one_line_names_the_command(malformed, monkeypatch):
    monkeypatch.chdir(malformed)
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = run("warp", "in", "--out", "new", "--cluster", "local")
    assert_refused(done, "pip install dask distributed")
    assert not Path("new").exists()
