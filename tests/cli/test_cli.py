"""The command line's contract: what is printed where, what is written, and with which status it exits."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import PROBLEMS
from malformed import MALFORMED
from typer.testing import CliRunner

from codegen import checks, drivers, schemes, solving
from codegen.checks.base import does_not_apply
from codegen.cli import main
from codegen.solutions import output
from codegen.solutions.result import STATUSES
from codegen.transcribe.connect import CONNECT_METHODS

ORBIT, PENDULUM = str(PROBLEMS / "orbital_transfer.py"), str(PROBLEMS / "pendulum.py")

KEYS = "problem task method scheme driver steps status message cost residual iterations seconds summary".split()


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def contents(folder):
    """Every file below a folder with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_refused(result, *fragments):
    """Exit status 2, one line on stderr, nothing on stdout."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("codegen: error: ")
    assert result.stderr.count("\n") == 1
    assert result.stderr.endswith("\n")
    assert "Traceback" not in result.stderr
    for fragment in fragments:
        assert fragment in result.stderr


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestMalformedProblems:
    @pytest.mark.parametrize("case", MALFORMED, ids=lambda case: case.id)
    @pytest.mark.parametrize("command", ["build", "solve"])
    def test_refused_in_one_line(self, folder, monkeypatch, command, case):
        # A cache of its own, below the folder whose contents are compared.
        monkeypatch.setenv("CODEGEN_CACHE_DIR", str(folder / "cache"))
        (folder / "broken.py").write_text(case.text)
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
    "no-command": ("", "no command"),
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
    "controls-unknown": ("solve O --controls both", "both"),
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


class TestJson:
    @pytest.fixture
    def solved(self, folder):
        def solve(*words):
            result = run("solve", *words, "--json")
            assert result.stdout.count("\n") == 1
            return result, json.loads(result.stdout, parse_constant=pytest.fail)

        return solve

    def test_control(self, solved):
        result, record = solved(ORBIT, "--steps", 50)
        assert (result.exit_code, result.stderr) == (0, "")
        assert list(record) == KEYS
        assert record["cost"] == pytest.approx(0.0487567009, abs=1e-9)
        assert record["residual"] < 1e-9
        expected = {"problem": "orbital_transfer", "task": "control", "method": "variational", "scheme": "midpoint"}
        expected |= {"driver": "newton", "steps": 50, "status": "solved"}
        assert {key: record[key] for key in expected} == expected
        assert list(record["seconds"]) == ["build", "load", "solve"]
        assert all(value > 0.0 for value in record["seconds"].values())
        assert set(record["summary"]) == {"duration", "final_state_miss", "largest_control", "stationarity"}

    def test_simulation(self, solved):
        result, record = solved(PENDULUM, "--every", 50)
        assert result.exit_code == 0
        assert list(record) == KEYS
        assert record["cost"] is None
        assert (record["task"], record["method"], record["steps"]) == ("simulate", "hamiltonian", 200)
        assert {"final_q", "final_p", "energy_drift", "steps_per_second"} <= set(record["summary"])

    @pytest.mark.parametrize("driver", ["slsqp", "trust-constr", "fsolve"])
    def test_other_drivers(self, solved, driver):
        result, record = solved(ORBIT, "--steps", 20, "--driver", driver)
        assert (result.exit_code, record["driver"], record["status"]) == (0, driver, "solved")

    def test_failure_is_status_1_and_still_one_object(self, solved):
        result, record = solved(ORBIT, "--steps", 1)
        assert result.exit_code == 1
        assert list(record) == KEYS
        assert record["status"] != "solved"
        assert record["status"] in STATUSES
        assert result.stderr.startswith(f"codegen: {record['message']}")
        assert result.stderr.count("\n") == 1

    def test_log_goes_to_stderr(self, solved):
        result, record = solved(ORBIT, "--steps", 20, "--log")
        assert "stationarity" in result.stderr
        assert len(result.stderr.strip().splitlines()) >= record["iterations"]


def test_infinite_and_missing_numbers_become_null(orbital_transfer):
    result = solving.solve(orbital_transfer, steps=5)
    changes = {"cost": float("nan"), "residual": float("inf"), "summary": {"miss": float("-inf")}}
    broken = output.as_record(replace(result, **changes), 1.0, float("nan"))
    record = json.loads(output.as_json(broken), parse_constant=pytest.fail)
    assert (record["cost"], record["residual"], record["summary"]) == (None, None, {"miss": None})
    assert record["seconds"]["load"] is None


class TestFiles:
    def test_summary_table(self, folder):
        result = run("solve", ORBIT, "--steps", 50, "--log")
        assert result.exit_code == 0
        for words in (
            "0.04875670091",
            "variational, midpoint, 50 steps",
            "solved",
            "Transfer a satellite",
            "Iterations",
        ):
            assert words in result.stdout
        assert list(folder.iterdir()) == []

    def test_saved_arrays(self, folder):
        assert run("solve", ORBIT, "--steps", 20, "--save", "orbit.npz").exit_code == 0
        with np.load("orbit.npz", allow_pickle=False) as archive:
            assert archive["q"].shape == (21, 2)
            assert archive["u"].shape == (20, 1)
            assert archive["q"][-1] == pytest.approx([6.0, 2 * np.pi])
            assert list(archive["q_names"]) == ["r", "phi"]
            assert json.loads(str(archive["result"]))["status"] == "solved"
        assert [path.name for path in folder.iterdir()] == ["orbit.npz"]

    @pytest.mark.parametrize("problem", [ORBIT, PENDULUM])
    @pytest.mark.parametrize(("name", "signature"), [("a.png", b"\x89PNG"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")])
    def test_picture(self, folder, problem, name, signature):
        assert run("solve", problem, "--steps", 100, "--plot", name).exit_code == 0
        assert (folder / name).read_bytes().startswith(signature)
        assert [path.name for path in folder.iterdir()] == [name]

    def test_failed_writing_leaves_the_old_file(self, folder, monkeypatch):
        (folder / "orbit.npz").write_bytes(b"old")

        def full(file, **arrays):
            file.write(b"half")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(np, "savez_compressed", full)
        result = run("solve", ORBIT, "--steps", 20, "--save", "orbit.npz")
        assert_refused(result, "orbit.npz", "No space left")
        assert contents(folder) == {folder / "orbit.npz": b"old"}

    def test_failure_is_drawn_and_saved_too(self, folder):
        assert run("solve", ORBIT, "--steps", 1, "--save", "a.npz", "--plot", "a.png").exit_code == 1
        assert {path.name for path in folder.iterdir()} == {"a.npz", "a.png"}


class TestBuild:
    def test_writes_once(self, folder):
        first = run("build", PENDULUM, "--no-compile")
        assert first.exit_code == 0
        assert first.stdout.startswith(os.path.join("generated", "pendulum.py") + ": written")
        module = folder / "generated" / "pendulum.py"
        stamp = module.stat().st_mtime_ns
        assert "up to date" in run("build", PENDULUM, "--no-compile").stdout
        assert module.stat().st_mtime_ns == stamp
        assert [path.name for path in (folder / "generated").iterdir()] == ["pendulum.py"]

    def test_choices_are_in_the_name(self, folder):
        run("build", PENDULUM, "--scheme", "stormer-verlet", "--out", "deep/er", "--no-compile")
        assert [path.name for path in (folder / "deep" / "er").iterdir()] == ["pendulum_stormer_verlet.py"]

    def test_compiles(self, folder):
        assert run("build", PENDULUM, "--scheme", "stormer-verlet").exit_code == 0
        assert list((folder / "generated" / "__pycache__").glob("*.nbc"))


class TestCheckAndShow:
    """The commands' own contract, with the evidence made up."""

    @pytest.fixture
    def findings(self, monkeypatch):
        made_up = []
        monkeypatch.setattr(checks, "run", lambda path, arguments, **choices: made_up, raising=False)

        def add(passed):
            made_up.append(checks.Finding("rank [of] ends", "start", passed, "rank 4 of 4"))

        return add

    def test_all_passed(self, folder, findings):
        findings(True)
        result = run("check", PENDULUM)
        assert result.exit_code == 0
        assert "rank [of] ends" in result.stdout
        assert "passed" in result.stdout

    def test_one_failed(self, folder, findings):
        findings(True)
        findings(False)
        result = run("check", PENDULUM)
        assert result.exit_code == 1
        assert "FAILED" in result.stdout
        assert result.stderr == "codegen: 1 of 2 checks failed, first rank [of] ends\n"

    def test_what_does_not_apply_has_not_passed(self, folder, findings, monkeypatch):
        monkeypatch.setattr(checks, "run", lambda *_, **__: [does_not_apply("optimum", "it has bounds")])
        result = run("check", PENDULUM)
        assert result.exit_code == 0
        assert "0 passed, 0 failed, 1 do not apply" in result.stdout
        assert result.stdout.count("passed") == 1
        assert result.stdout.count("apply") == 2

    @pytest.mark.parametrize("command", ["check", "show"])
    def test_malformed_file(self, folder, command):
        (folder / "broken.py").write_text("")
        assert_refused(run(command, "broken.py"), "broken.py")

    def test_show(self, folder):
        plain, latex = run("show", PENDULUM), run("show", PENDULUM, "--latex")
        assert (plain.exit_code, latex.exit_code) == (0, 0)
        assert "cos(q)" in plain.stdout
        assert r"\cos" in latex.stdout
        assert list(folder.iterdir()) == []


# A process started in the background of a shell ignores the signal, so it is made deadly again first.
INTERRUPTION = "codegen: interrupted; no file was left half written\n"
INTERRUPTED = '''"""Interrupted."""
import os, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
os.kill(os.getpid(), signal.SIGINT)
'''


def test_help_names_every_driver_and_method():
    text = "".join(run("solve", "--help").stdout.split())  # names are broken at their hyphens
    names = [*drivers.DRIVERS, *schemes.METHODS, schemes.FIRST_ORDER, *CONNECT_METHODS]
    assert len(names) == 12
    assert [name for name in names if name not in text] == []


class TestProcess:
    """What only a process of its own can show."""

    def python(self, *lines, **options):
        return subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, **options)

    @pytest.mark.parametrize(
        "words", [["--help"], ["solve", "--help"], ["--version"], ["solve", "x.py", "--steps", "0"]]
    )
    def test_help_imports_nothing_slow(self, words):
        done = self.python(
            "import sys",
            "from codegen.cli import main",
            "try:",
            f"    main({words!r})",
            "except SystemExit: pass",
            "slow = 'numpy scipy numba sympy matplotlib jinja2 rich threadpoolctl'.split()",
            "print([name for name in slow if name in sys.modules])",
        )
        assert done.stdout.splitlines()[-1] == "[]"

    def test_console_command(self, folder):
        done = subprocess.run(["codegen", "--version"], capture_output=True, text=True)
        assert (done.returncode, done.stdout.split()[0], done.stderr) == (0, "codegen", "")

    def test_whole_run(self, folder):
        words = [sys.executable, "-m", "codegen", "solve", ORBIT, "--steps", "20", "--json", "--plot", "a.svg"]
        done = subprocess.run(words, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["status"] == "solved"

    def test_what_a_problem_file_prints_is_kept_off_stdout(self, folder):
        text = (PROBLEMS / "pendulum.py").read_text().replace("    if form", "    print('hello')\n    if form")
        (folder / "talkative.py").write_text(text)
        words = [sys.executable, "-m", "codegen", "solve", "talkative.py", "--scheme", "stormer-verlet", "--json"]
        done = subprocess.run(words, capture_output=True, text=True)
        assert json.loads(done.stdout)["status"] == "solved"
        assert done.stderr == "hello\n"

    def test_interrupt(self, folder):
        (folder / "slow.py").write_text(INTERRUPTED)
        done = subprocess.run([sys.executable, "-m", "codegen", "solve", "slow.py"], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (130, INTERRUPTION)

    def test_interrupt_while_importing(self, folder):
        done = self.python(
            "import runpy, sys",
            "class Interrupting:",
            "    def find_spec(self, name, *_):",
            "        if name == 'typer': raise KeyboardInterrupt",
            "sys.meta_path.insert(0, Interrupting())",
            "runpy.run_module('codegen', run_name='__main__')",
        )
        assert (done.returncode, done.stdout, done.stderr) == (130, "", INTERRUPTION)


class TestDefects:
    """What nobody foresaw is one line too, and shows its traceback only when it is asked for."""

    @pytest.fixture
    def broken(self, monkeypatch):
        def fail(*arguments, **choices):
            raise RuntimeError("two\nlines")

        monkeypatch.setattr("codegen.compiler.build", fail)

    def test_one_line(self, folder, broken, monkeypatch):
        monkeypatch.delenv("CODEGEN_TRACEBACK", raising=False)
        result = run("solve", ORBIT)
        assert result.exit_code == 1
        assert result.stderr.startswith("codegen: error: unexpected RuntimeError: two lines; ")
        assert result.stderr.count("\n") == 1

    def test_traceback_on_request(self, folder, broken, monkeypatch):
        monkeypatch.setenv("CODEGEN_TRACEBACK", "1")
        assert "Traceback" in run("solve", ORBIT).stderr
