"""Damaged files, in a process of their own so that its memory is theirs: typed errors only, little memory."""

import json
import os
import subprocess
import sys
from pathlib import Path


def test_damaged_files_give_typed_errors_and_take_little_memory():
    program = Path(__file__).with_name("damaged_files.py")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", program], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    record = json.loads(done.stdout)
    assert record["untyped"] == []
    assert record["landmarks"] == 600
    assert record["refused"] > 500
    assert record["read"] > 20  # damage that does not matter is read
    assert record["grown"] < 60_000_000
    assert "Traceback" not in done.stderr  # libtiff says in its own way what it thinks of a file
