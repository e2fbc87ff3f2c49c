"""The solver of registrations, made ready beside the server: the page can be used while it is being compiled.

Deriving and compiling it takes some 15 s of work, once on a machine. A process of its own does that, so that the
page answers meanwhile; `python -m codegen.registration.app.preparing SCHEME` is that process.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import Future
from functools import cache

from codegen.errors import CodegenError, ModuleError
from codegen.registration.solver import is_compiled, registration_module

COMPILING = "The solver is being compiled, once on this machine (up to half a minute)"
MODULE = "codegen.registration.app.preparing"
_LOCK = threading.Lock()


def prepared(scheme: str) -> Future[None]:
    """The solver of a scheme, which begins to be made ready when it is asked for the first time in this process.

    The future fails with a CodegenError where the solver cannot be derived or compiled.
    """
    with _LOCK:
        return _begun(scheme)


@cache
def _begun(scheme: str) -> Future[None]:
    future: Future[None] = Future()

    def prepare() -> None:
        try:
            if not is_compiled(scheme):
                compile_elsewhere(scheme)
            registration_module(scheme)
        except Exception as error:  # every session that waits is told
            future.set_exception(error)
        else:
            future.set_result(None)

    threading.Thread(target=prepare, name=f"registration-{scheme}", daemon=True).start()
    return future


def compile_elsewhere(scheme: str) -> None:
    """Derive and compile the solver in a process of its own; ModuleError says why that failed."""
    command = [sys.executable, "-m", MODULE, scheme]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ModuleError(f"the solver could not be compiled: {said[:300]}", "mend this and start the page again")


def main(scheme: str) -> int:
    """Derive and compile; what is wrong goes to stderr as one line."""
    try:
        registration_module(scheme)
    except CodegenError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
