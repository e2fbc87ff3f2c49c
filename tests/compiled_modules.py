"""Generated modules with machine code, for tests that solve at size."""

import os
import subprocess
import sys
from pathlib import Path

from codegen.loading import GeneratedModule, load


def compiled(path: Path) -> GeneratedModule:
    """A module with machine code of all that `solve` calls, made as `codegen build` makes it, which is quicker."""
    command = [sys.executable, "-m", "codegen.machine_code.compilation", "all"]
    subprocess.run(command, input=os.fsencode(path.absolute()), check=True, capture_output=True)
    return load(path)
