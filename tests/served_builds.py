"""A server of processes that compile modules, forked from one that has loaded numba and compiled a kernel already.

Without it, each build starts a process that spends its first two seconds on that. `python served_builds.py` reads
requests from the socket that is its standard input: an environment and a folder, with three files.
"""

import atexit
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
from functools import lru_cache

ONE_SYSTEM = "CODEGEN_TEST_ONE_SYSTEM"
"""The environment variable that is set if problems of every shape use one linear system, which is compiled already."""


def numba_settings() -> dict[str, str]:
    """Return the environment variables by which a process of the server would differ, because it has loaded numba."""
    return {name: value for name, value in os.environ.items() if name.startswith("NUMBA_")}


class Served:
    """A process of the server, with those attributes of `subprocess.Popen` that builds use."""

    def __init__(self) -> None:
        path, self.stdin = _pipe("wb")
        lines, self.stdout = _pipe("rb")
        status, self.status = _pipe("rb")
        state = json.dumps([dict(os.environ), os.getcwd()]).encode()
        socket.send_fds(_server(), [len(state).to_bytes(8, "big")], [path, lines, status])
        _server().sendall(state)
        self.pid = int.from_bytes(_server().recv(8), "big")
        assert self.pid, "the server has ended"
        for file in (path, lines, status):
            os.close(file)

    def poll(self) -> int | None:
        return self.wait() if self.status.closed or select.select([self.status], [], [], 0)[0] else None

    def wait(self) -> int:
        """Return the exit status, which is written at the end: nothing is, where the process was killed."""
        if not self.status.closed:
            self.returncode = 0 if self.status.read() == b"0" else 1
            self.status.close()
        return self.returncode

    def kill(self) -> None:
        """Do nothing: builds have killed the group of the process before they call this."""


def _pipe(mode):
    """Return the file number for the other process, and the file of this one, of a new pipe."""
    ends = os.pipe()
    own = ends[1 if mode == "wb" else 0]
    return ends[0 if mode == "wb" else 1], os.fdopen(own, mode)


@lru_cache(maxsize=1)
def _server() -> socket.socket:
    """Start the server, which ends when this process does."""
    own, other = socket.socketpair()
    folder = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])}
    server = subprocess.Popen([sys.executable, __file__], stdin=other, env=environment, cwd=folder)
    other.close()

    def end() -> None:
        own.close()
        server.wait()

    atexit.register(end)
    return own


def serve() -> None:
    """Fork a process for each request, until the socket is closed."""
    from codegen.solving.machine_code import compilation

    gc.disable()
    compilation.warm_up()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the processes
    requests = socket.socket(fileno=0)
    while True:
        length, files, _, _ = socket.recv_fds(requests, 8, 3)
        if not length:
            return
        state = requests.recv(int.from_bytes(length, "big"), socket.MSG_WAITALL)
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            requests.detach()
            _compile(compilation, *files, *json.loads(state))
        os.setpgid(pid, pid)
        for file in files:
            os.close(file)
        requests.sendall(pid.to_bytes(8, "big"))


def _compile(compilation, path, lines, status, environment, folder):
    """Compile the module whose path comes through a pipe, as `compilation` does it as a program."""
    os.dup2(path, 0)
    os.dup2(lines, 1)
    os.close(path)
    os.close(lines)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.stdin, sys.stdout = os.fdopen(0), os.fdopen(1, "w")
    compilation.warm_up = lambda: None
    if ONE_SYSTEM in environment:
        parts_of = compilation.parts_of
        compilation.parts_of = lambda module: [part for part in parts_of(module) if part.serves != "shape"]
    try:
        if compilation.main("both") == 0:
            os.write(status, b"0")
    except Exception as error:
        compilation.failed(error)
    os._exit(0)


if __name__ == "__main__":
    serve()
