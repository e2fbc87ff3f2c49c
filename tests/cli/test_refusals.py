"""Problem files and command lines that are refused in one line, and leave nothing behind."""

from __future__ import annotations

import subprocess
import sys

import pytest
from command_lines import ORBIT, PENDULUM, assert_refused, contents, run
from conftest import PROBLEMS
from malformed import MALFORMED

from codegen.solving.machine_code import processes


class TestMalformedProblems:
    @pytest.mark.parametrize("case", MALFORMED, ids=lambda case: case.id)
    @pytest.mark.parametrize("command", ["build", "solve"])
    def test_refused_in_one_line(self, folder, monkeypatch, command, case):
        monkeypatch.setattr(processes, "shares", lambda: ())  # which are ended without having been told anything
        self.assert_refused_without_a_trace(folder, monkeypatch, command, case)

    def test_processes_that_would_compile_are_ended(self, folder, monkeypatch):
        started = []

        class Recorded(subprocess.Popen):
            def __init__(self, *arguments, **options):
                super().__init__(*arguments, **options)
                started.append(self)

        monkeypatch.setattr(subprocess, "Popen", Recorded)
        self.assert_refused_without_a_trace(folder, monkeypatch, "build", MALFORMED[0])
        assert started
        assert all(process.returncode not in (None, 0) for process in started)

    def assert_refused_without_a_trace(self, folder, monkeypatch, command, case):
        # A cache of its own, below the folder whose contents are compared.
        monkeypatch.setenv("CODEGEN_CACHE_DIR", str(folder / "cache"))
        case.write(folder)
        before = contents(folder)
        assert_refused(run(command, "broken.py"), "broken.py")
        assert contents(folder) == before

    def test_an_older_module_is_left_alone(self, folder):
        (folder / "generated").mkdir()
        (folder / "generated" / "broken.py").write_text("precious")
        (folder / "broken.py").write_text(MALFORMED[0].text)
        assert_refused(run("build", "broken.py"))
        assert (folder / "generated" / "broken.py").read_text() == "precious"

    def test_in_a_process_of_its_own(self, folder):
        case = next(case for case in MALFORMED if case.id == "raises-lines")
        (folder / "broken.py").write_text(case.text)
        done = subprocess.run(
            [sys.executable, "-m", "codegen", "solve", "broken.py", "--json"], capture_output=True, text=True
        )
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert "one two three" in done.stderr


# What the command line gets wrong: the words, and what the message must name.
COMMAND_LINES = {
    "unknown-command": ("bild P", "'build'"),
    "unknown-option": ("--fast", "--fast"),
    "no-problem": ("solve", "PROBLEM.py"),
    "two-problems": ("solve P O", "pendulum.py|orbital"),
    "missing-file": ("solve nothing.py", "nothing.py: no such file"),
    "missing-file-build": ("build nothing.py", "nothing.py: no such file"),
    "directory": ("solve .", "directory"),
    "not-python": ("solve notes.txt", "notes.txt"),
    "unknown-scheme": ("solve P --scheme midpont", "did you mean midpoint"),
    "unknown-scheme-build": ("build O --scheme rk4", "'rk4'"),
    "scheme-of-other-method": ("solve O --scheme implicit-euler", "--method hamiltonian"),
    "scheme-of-other-method-2": ("solve P --method variational --scheme symplectic-euler", "--method hamiltonian"),
    "alpha-out-of-range": ("solve P --scheme alpha-2", "between 0 and 1"),
    "unknown-method": ("solve O --method lagrangian", "lagrangian"),
    "unknown-driver": ("solve O --driver simplex", "newton"),
    "misspelt-driver": ("solve O --driver trust-const", "did you mean trust-constr"),
    "driver-of-control": ("solve P --driver slsqp", "newton, fsolve"),
    "driver-of-control-2": ("solve P --driver trust-constr", "newton, fsolve"),
    "driver-on-explicit": ("solve P --scheme stormer-verlet --driver fsolve", "explicit"),
    "driver-dense": ("solve O --driver slsqp --steps 5000", "dense"),
    "set-without-value": ("solve O --set revolutions", "name=value; write for example --set revolutions=1"),
    "set-without-value-2": ("show P --set 3", "name=value; write for example --set form=hamiltonian"),
    "set-without-value-of-no-file": ("solve nothing.py --set revolutions", "nothing.py: no such file"),
    "method-of-other-system": ("show V --method variational", "gives a first-order system; use one-step"),
    "set-without-name": ("solve O --set =2", "name=value"),
    "set-unknown": ("solve O --set revolution=2", "did you mean revolutions"),
    "set-twice": ("solve O --set revolutions=1 --set revolutions=2", "twice"),
    "set-wrong-type": ("solve O --set revolutions=two", "revolutions=two"),
    "set-not-finite": ("solve O --set revolutions=inf", "finite"),
    "set-negative-duration": ("solve O --set revolutions=-1", "duration is -"),
    "set-wrong-choice": ("solve P --set form=newtonian", "hamiltonian or lagrangian"),
    "steps-zero": ("solve P --steps 0", "'0'"),
    "steps-negative": ("solve P --steps -1", "'-1'"),
    "steps-text": ("solve P --steps x", "'x'"),
    "steps-float": ("solve P --steps 1e3", "'1e3'"),
    "steps-empty": ("solve P --steps=", "''"),
    "steps-missing": ("solve P --steps", "--steps"),
    "steps-huge": ("solve P --steps 100000000000000000000", "positive integer"),
    "steps-beyond-memory": ("solve P --steps 900000000000", "GB of memory"),
    "steps-beyond-memory-2": ("solve O --steps 900000000000", "GB of memory"),
    "repeat-zero": ("solve P --repeat 0", "--repeat"),
    "every-zero": ("solve P --every 0", "--every"),
    "every-of-control": ("solve O --every 2", "--every"),
    "log-of-simulation": ("solve P --log", "--log"),
    "log-of-other-driver": ("solve O --driver slsqp --log", "--log"),
    "tolerance-zero": ("solve O --tolerance 0", "between 0 and 1"),
    "tolerance-of-simulation": ("solve P --tolerance 1e-3", "--tolerance does not apply to a simulate problem"),
    "tolerance-of-other-driver": ("solve O --driver slsqp --tolerance 1e-3", "slsqp takes no --tolerance"),
    "iterations-zero": ("solve O --max-iterations 0", "'0'"),
    "iterations-of-other-driver": ("solve O --driver fsolve --max-iterations 9", "newton, slsqp, trust-constr, ipopt"),
    "iterations-of-other-driver-2": ("solve P --driver fsolve --max-iterations 9", "for a simulate problem"),
    "warm-missing": ("solve O --warm nothing.npz", "--warm nothing.npz: no such file"),
    "warm-directory": ("solve O --warm folder.png", "directory"),
    "warm-no-archive": ("solve O --warm notes.txt", "--warm notes.txt is no .npz file"),
    "table-without-file": ("solve O --table thrust", "is not of the form NAME=FILE"),
    "table-without-name": ("solve O --table =notes.txt", "is not of the form NAME=FILE"),
    "table-twice": ("solve O --table f=a.csv --table f=b.csv", "twice"),
    "table-of-no-table": ("solve O --table thrust=notes.txt", "the problem has no table thrust; leave it out"),
    "controls-unknown": ("solve O --controls both", "'--controls': 'both' is not one of 'interval', "),
    "style-unknown": ("solve P --plot a.png --style x", "'--style': 'x' is not one of 'page', 'paper', 'talk';"),
    "controls-of-simulation": ("solve P --controls nodal", "controls"),
    "plot-unknown-kind": ("solve P --plot picture.bmp", ".png or .pdf or .svg"),
    "plot-no-kind": ("solve P --plot picture", "picture"),
    "plot-no-folder": ("solve P --plot nowhere/picture.png", "nowhere"),
    "plot-directory": ("solve P --plot folder.png", "directory"),
    "animate-unknown-kind": ("solve P --animate film.avi", ".gif or .mp4"),
    "animate-no-folder": ("solve P --animate nowhere/film.gif", "nowhere"),
    "animate-as-plot": ("solve P --plot film.gif", ".png or .pdf or .svg"),
    "save-unknown-kind": ("solve P --save arrays.npy", ".npz"),
    "save-no-folder": ("solve P --save nowhere/arrays.npz", "nowhere"),
    "save-below-file": ("solve P --save notes.txt/arrays.npz", "not a folder"),
    "save-unwritable": ("solve P --save /proc/arrays.npz", "/proc"),
    "out-is-file": ("build P --out notes.txt", "not a folder"),
    "out-below-file": ("build P --out notes.txt/deep/deeper", "not a folder"),
    "out-unwritable": ("build P --out /proc/generated", "/proc"),
    "out-of-solve-is-file": ("solve P --out notes.txt", "not a folder"),
    "build-takes-no-steps": ("build P --steps 3", "--steps"),
}  # fmt: skip


@pytest.mark.parametrize(("words", "fragment"), COMMAND_LINES.values(), ids=COMMAND_LINES)
def test_malformed_command_lines(folder, words, fragment):
    (folder / "notes.txt").write_text("keep me")
    (folder / "folder.png").mkdir()
    before = contents(folder)
    files = {"P": PENDULUM, "O": ORBIT, "V": PROBLEMS / "van_der_pol.py"}
    result = run(*[files.get(word, word) for word in words.split()])
    assert_refused(result)
    assert any(part in result.stderr for part in fragment.split("|")), result.stderr
    assert contents(folder) == before
    assert {path.name for path in folder.iterdir()} == {"notes.txt", "folder.png"}
