"""Generated modules with machine code, for tests that solve at size."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

from codegen.solving.compiler import cache_folder
from codegen.solving.loading import GeneratedModule, load
from codegen.solving.machine_code.compilation import has_machine_code


def compiled(path: Path) -> GeneratedModule:
    """A module with machine code of all that `solve` calls, made as `codegen build` makes it, which is quicker.

    Of several processes that want the same one, the first compiles it, and the others wait.
    """
    module = load(path)
    cache_folder().mkdir(parents=True, exist_ok=True)
    with (cache_folder() / f"{path.stem}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not has_machine_code(module):
            command = [sys.executable, "-m", "codegen.solving.machine_code.compilation", "0/1"]
            subprocess.run(command, input=os.fsencode(path.absolute()), check=True, capture_output=True)
    return module
