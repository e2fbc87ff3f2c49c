"""Commands as processes: interruption, broken pipes, memory, defects."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from command_lines import ORBIT, run
from conftest import PROBLEMS

# A process started in the background of a shell ignores the signal, so it is made deadly again first.
INTERRUPTION = "codegen: interrupted; no file was left half written\n"


INTERRUPTED = '''"""Interrupted."""
import os, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
os.kill(os.getpid(), signal.SIGINT)
'''


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
        words = [sys.executable, "-m", "codegen", "solve", "talkative.py", "--steps", "2000", "--json"]
        environment = {**os.environ, "CODEGEN_CACHE_DIR": str(folder / "cache")}  # what is built already is not run
        done = subprocess.run(words, capture_output=True, text=True, env=environment)
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

        monkeypatch.setattr("codegen.solving.compiler.build", fail)

    def test_one_line(self, folder, broken, monkeypatch):
        monkeypatch.delenv("CODEGEN_TRACEBACK", raising=False)
        result = run("solve", ORBIT)
        assert result.exit_code == 1
        assert result.stderr.startswith("codegen: error: unexpected RuntimeError: two lines; ")
        assert result.stderr.count("\n") == 1

    def test_traceback_on_request(self, folder, broken, monkeypatch):
        monkeypatch.setenv("CODEGEN_TRACEBACK", "1")
        assert "Traceback" in run("solve", ORBIT).stderr
