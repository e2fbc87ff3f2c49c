"""The command line's contract: what is printed where, what is written, and with which status it exits."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from command_lines import ORBIT, PENDULUM, assert_refused, contents, run

from codegen.discretise import schemes
from codegen.discretise.particles import CONNECT_METHODS
from codegen.evidence import checks
from codegen.evidence.checks.base import does_not_apply, not_measured
from codegen.solving import api, drivers
from codegen.solving.results import output
from codegen.solving.results.result import STATUSES

WALLED = '''"""Through a wall that is thinner than a step."""
from codegen import Control, controls, states
def problem() -> Control:
    x, y = states("x y")
    u, w = controls("u w")
    return Control(dynamics={x: u, y: w}, cost=u**2 + w**2, duration=1, start={x: -1, y: 0}, end={x: 1, y: 0},
                   path=[(100 * x) ** 2 + y**2 >= 1], steps=9)
'''
KEYS = "problem task method scheme driver steps status message cost residual iterations seconds summary".split()


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
        own = {"duration", "final_state_miss", "largest_control", "stationarity", "state_error", "cost_error"}
        assert set(record["summary"]) == own
        # With the limit 0.0487491 of N = 50, 100, 200, the cost is off by 1.6e-4 of itself.
        assert record["summary"]["cost_error"] == pytest.approx(1.6e-4, rel=0.3)

    def test_what_a_motion_does_between_nodes_is_a_note_on_stderr_and_in_the_record(self, solved, folder, uncompiled):
        (folder / "walled.py").write_text(WALLED)
        result, record = solved("walled.py")
        assert record["status"] == "solved"
        (note,) = record["notes"]
        assert note.startswith("between nodes the motion violates")
        assert f"codegen: note: {note}" in result.stderr.splitlines()

    def test_a_forgotten_end_is_a_note(self, solved, folder, uncompiled):
        (folder / "endless.py").write_text(WALLED.replace(", end={x: 1, y: 0}", ""))
        _, record = solved("endless.py")
        assert (record["status"], record["cost"]) == ("solved", pytest.approx(0.0, abs=1e-12))
        assert "is an end missing?" in record["notes"][0]

    def test_a_failed_search_names_what_may_help(self, solved, folder, uncompiled):
        (folder / "walled.py").write_text(WALLED)
        options = ("--max-iterations", 1)
        assert solved("walled.py", *options)[1]["notes"] == [
            "what may help, in this order: --guesses 10, another --scheme, --scaling none"
        ]
        options = (*options, "--guesses", 2, "--scaling", "none", "--scheme", "trapezoidal")
        assert "notes" not in solved("walled.py", *options)[1]

    def test_simulation(self, solved):
        result, record = solved(PENDULUM, "--every", 50)
        assert result.exit_code == 0
        assert list(record) == [*KEYS, "notes"]  # a coarse grid: the error of the discretisation is large
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
        assert list(record) == [*KEYS, "notes"]
        assert record["status"] != "solved"
        assert record["status"] in STATUSES
        assert result.stderr.startswith(f"codegen: {record['message']}")
        assert result.stderr.endswith(f'; the guide explains {record["status"]}: see "Statuses and errors"\n')
        assert result.stderr.count("\n") == 1

    def test_log_goes_to_stderr(self, solved):
        result, record = solved(ORBIT, "--steps", 20, "--log")
        assert "stationarity" in result.stderr
        assert len(result.stderr.strip().splitlines()) >= record["iterations"]


def test_infinite_and_missing_numbers_become_null(orbital_transfer):
    result = api.solve(orbital_transfer, steps=5)
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
        assert result.stdout == "0 checks passed, 0 failed, 1 do not apply\nnot applicable: optimum\n"

    def test_what_does_not_apply_is_one_line(self, folder, findings, monkeypatch):
        found = [
            checks.Finding("layout", "sizes", True, "every kernel fills its arrays, and no more " * 3),
            *(does_not_apply(name, "a long reason") for name in ("tables", "switches", "tables")),
            not_measured("optimum", "all else", "there is no solution"),
        ]
        monkeypatch.setattr(checks, "run", lambda *_, **__: found)
        monkeypatch.setenv("COLUMNS", "80")
        lines = run("check", PENDULUM).stdout.splitlines()
        assert lines[0] == "1 check passed, 0 failed, 3 do not apply, 1 not measured"
        assert lines[-1] == "not applicable: tables, switches"
        assert "a long reason" not in "".join(lines)
        assert max(map(len, lines)) == 80
        # The detail has more than half of the width.
        assert min(line.index("every kernel") for line in lines if "every kernel" in line) <= 40
        assert any(
            line.split() == ["not", "optimum:", "all", "else", "there", "is", "no", "solution"] for line in lines
        )

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


def test_help_names_every_driver_and_method():
    text = "".join(run("solve", "--help").stdout.split())  # names are broken at their hyphens
    names = [*drivers.DRIVERS, *schemes.METHODS, schemes.FIRST_ORDER, *CONNECT_METHODS]
    assert len(names) == 12
    assert [name for name in names if name not in text] == []
