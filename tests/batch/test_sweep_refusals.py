"""Sweeps that are refused in one line, and leave nothing behind."""

from __future__ import annotations

import sys

import pytest
from command_lines import ORBIT, PENDULUM, assert_refused, contents, run
from conftest import PROBLEMS

import codegen
from codegen.batch.cases import NUMBER
from codegen.errors import ArgumentError, ExtraError, NumericsError

LINES = {
    "nothing-varies": ("sweep O --out s.zarr", "nothing varies"),
    "no-out": ("sweep O --vary r1=5:6:3", "--out"),
    "out-unknown-kind": ("sweep O --vary r1=5:6:3 --out s.csv", ".zarr or .nc"),
    "out-no-folder": ("sweep O --vary r1=5:6:3 --out nowhere/s.zarr", "nowhere"),
    "out-exists": ("sweep O --vary r1=5:6:3 --out old.zarr", "is there already"),
    "out-exists-netcdf": ("sweep O --vary r1=5:6:3 --out old.nc", "is there already"),
    "resume-no-store": ("sweep O --vary r1=5:6:3 --out old.zarr --resume", "is no store"),
    "resume-netcdf": ("sweep O --vary r1=5:6:3 --out s.nc --resume", "--resume"),
    "no-range": ("sweep O --vary r1=5:6 --out s.zarr", "no range"),
    "no-number": ("sweep O --vary r1=5:x:3 --out s.zarr", "'x'"),
    "count-zero": ("sweep O --vary r1=5:6:0 --out s.zarr", "0 values"),
    "vary-twice": ("sweep O --vary r1=5:6:3 --vary r1=1,2 --out s.zarr", "twice"),
    "unknown-name": ("sweep O --vary r2=5:6:3 --out s.zarr", "did you mean"),
    "unknown-end": ("sweep O --vary start.q=5:6:3 --out s.zarr", "start.r"),
    "word-for-number": ("sweep O --vary r1=five,six --out s.zarr", "takes numbers, not 'five'"),
    "steps-not-whole": ("sweep O --vary steps=10,20.5 --out s.zarr", "positive integers"),
    "steps-negative": ("sweep O --vary steps=-10,20 --out s.zarr", "positive integers"),
    "steps-given-too": ("sweep O --vary steps=10,20 --steps 10 --out s.zarr", "given by --steps"),
    "zip-unknown": ("sweep O --vary r1=5:6:3 --zip r1,m --out s.zarr", "m is not varied"),
    "zip-lengths": ("sweep O --vary r1=5:6:3 --vary m=1,2 --zip r1,m --out s.zarr", "has 2"),
    "zip-alone": ("sweep O --zip r1,m --out s.zarr", "--zip"),
    "two-ways": ("sweep O --vary r1=5:6:3 --sample m=normal(100,5) --out s.zarr", "several ways"),
    "no-distribution": ("sweep O --sample m=normale(100,5) --out s.zarr", "did you mean"),
    "negative-deviation": ("sweep O --sample m=normal(100,-5) --out s.zarr", "no finite values"),
    "cases-of-nothing": ("sweep O --cases 100 --out s.zarr", "100 cases of what"),
    "cases-zero": ("sweep O --sample m=normal(100,5) --cases 0 --out s.zarr", "0 samples"),
    "cases-missing": ("sweep O --cases nothing.csv --out s.zarr", "nothing.csv"),
    "cases-ragged": ("sweep O --cases ragged.csv --out s.zarr", "ragged.csv:3"),
    "cases-word": ("sweep O --cases words.csv --out s.zarr", "words.csv:4: r1 takes numbers, not 'abc'"),
    "cases-not-finite": ("sweep O --cases nan.csv --out s.zarr", "nan.csv:3: m is not finite"),
    "normal-of-one": ("sweep O --sample r1=normal(1) --out s.zarr", "; write normal(mean, deviation)"),
    "lognorm-of-none": ("sweep O --sample r1=lognorm() --out s.zarr", "; write lognorm(s, loc=0, scale=1)"),
    "set-of-a-parameter": ("sweep O --set m=90 --vary r1=5,6 --out s.zarr", "--parameter m=90, or sweep --vary m=90"),
    "zip-one-value": ("sweep O --vary r1=5 --vary m=1,2 --zip r1,m --out s.zarr", "r1 has 1 value, m has 2"),
    "duration-with-delays": ("sweep D --vary duration=1,2 --out s.zarr", "has delays"),
    "duration-not-offered": ("sweep D --vary durations=1,2 --out s.zarr", "guess, start.q_1, start.dq_1, m, k"),
    "sampling-unknown": ("sweep O --sample m=normal(100,5) --sampling halton --out s.zarr", "use random, latin, sobol"),
    "method-unknown": ("sweep O --vary r1=5:6:3 --method lagrangian --out s.zarr", "lagrangian"),
    "seed-negative": ("sweep O --sample m=normal(100,5) --seed -1 --out s.zarr", "--seed"),
    "keep-unknown": ("sweep O --vary r1=5:6:3 --keep q,v --out s.zarr", "--keep v"),
    "keep-of-control": ("sweep P --vary duration=1,2 --keep u --out s.zarr", "--keep u"),
    "workers-zero": ("sweep O --vary r1=5:6:3 --workers 0 --out s.zarr", "--workers"),
    "plot-unknown-kind": ("sweep O --vary r1=5:6:3 --out s.zarr --plot s.gif", ".png or .pdf or .svg"),
    "plot-no-folder": ("sweep O --vary r1=5:6:3 --out s.zarr --plot nowhere/s.png", "nowhere"),
    "driver-unknown": ("sweep O --vary r1=5:6:3 --driver simplex --out s.zarr", "newton"),
    "option-of-other-task": ("sweep P --vary duration=1,2 --tolerance 1e-3 --out s.zarr", "--tolerance does not apply"),
    "set-and-varied": ("sweep O --set revolutions=1 --vary revolutions=1,2 --out s.zarr", "given by --set"),
    "argument-of-wrong-type": ("sweep P --vary form=newtonian --out s.zarr", "hamiltonian or lagrangian"),
    "too-many-modules": ("sweep O --vary revolutions=1:2:1001 --out s.zarr", "1001 modules"),
    "beyond-memory": ("sweep O --vary r1=5:6:3 --steps 900000000000 --out s.zarr", "GB of memory"),
    "pareto-no-plot": ("sweep O --vary r1=5:6:3 --out s.zarr --pareto cost,duration", "--pareto without --plot"),
    "pareto-one": ("sweep O --vary r1=5:6:3 --out s.zarr --plot s.png --pareto cost", "two objectives"),
    "pareto-unknown": ("sweep O --vary r1=5:6:3 --out s.zarr --plot s.png --pareto cost,time", "--pareto time"),
    "sensitivities-of-simulation": ("sweep P --vary duration=1,2 --sensitivities --out s.zarr", "has no sensitivities"),
    "keep-derivatives-of-nothing": ("sweep O --vary r1=5:6:3 --keep q,d_q --out s.zarr", "give --sensitivities"),
    "no-problem": ("sweep nothing.py --vary r1=5:6:3 --out s.zarr", "nothing.py: no such file"),
}  # fmt: skip


@pytest.mark.parametrize(("words", "fragment"), LINES.values(), ids=LINES)
def test_malformed_command_lines(folder, words, fragment):
    (folder / "old.zarr").mkdir()
    (folder / "old.nc").write_text("keep me")
    (folder / "ragged.csv").write_text("r1,m\n5,100\n6\n")
    (folder / "words.csv").write_text("r1,m\n5,100\n\nabc,90\n")
    (folder / "nan.csv").write_text("r1,m\n5,100\n6,nan\n")
    before = contents(folder)
    files = {"P": PENDULUM, "O": ORBIT, "D": PROBLEMS / "delayed_oscillator.py"}
    assert_refused(run(*[files.get(word, word) for word in words.split()]), fragment)
    assert contents(folder) == before
    assert {path.name for path in folder.iterdir()} == {"old.zarr", "old.nc", "ragged.csv", "words.csv", "nan.csv"}


@pytest.mark.parametrize("library", ["xarray", "zarr"])
def test_without_the_libraries_one_line_names_the_command(folder, monkeypatch, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ExtraError, match="pip install xarray zarr"):
        codegen.sweep(ORBIT, {"r1": [6.0]})
    assert_refused(run("sweep", ORBIT, "--vary", "r1=5:6:3", "--out", "s.zarr"), f"needs {library}")


@pytest.mark.parametrize(
    ("given", "kind", "fragment"),
    [
        ({"vary": {"r1": [6.0]}, "step": 3}, ArgumentError, "did you mean steps"),
        ({"vary": {"r1": []}}, ArgumentError, "no values"),
        ({"vary": [6.0]}, ArgumentError, "names and values"),
        ({"vary": {"r1": [6.0]}, "workers": 0}, NumericsError, "workers"),
        ({"vary": {"r1": [6.0]}, "chunk": 1.5}, NumericsError, "chunk"),
        ({"vary": {"r1": [6.0]}, "keep": "q"}, ArgumentError, "keep"),
        ({"vary": {"r1": [6.0]}, "out": 3}, ArgumentError, "--out 3 is no path"),
        ({"vary": {"r1": [6.0]}, "resume": True}, ArgumentError, "without --out"),
        ({"samples": {"m": "normal(1, 2)"}, "cases": {"m": [1.0]}}, ArgumentError, "several ways"),
        ({"vary": {"r1": [6.0]}, "guesses": 3}, ArgumentError, "no option guesses"),
    ],
)  # fmt: skip
def test_malformed_calls(given, kind, fragment):
    with pytest.raises(kind, match=fragment):
        codegen.sweep(ORBIT, **given)


def test_calls_without_a_problem():
    with pytest.raises(ArgumentError, match="give a problem"):
        codegen.sweep()


def test_help_says_how_many_samples_there_are():
    assert f"[default: {NUMBER} samples]" in " ".join(run("sweep", "--help").stdout.split())
