"""What a worker's machine is to machine code, and how the processes of one machine wait for each other."""

from __future__ import annotations

import errno
import hashlib
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from codegen.cache import cache_folder
from codegen.errors import CodegenError
from codegen.files import refused


@dataclass(frozen=True)
class Target:
    """What machine code is made for: the processor, what it can do as a digest, and the versions."""

    processor: str
    features: str
    numba: str
    python: str

    def __str__(self) -> str:
        return f"{self.processor} with numba {self.numba}"


def target() -> Target:
    """That of this machine."""
    import numba
    from llvmlite import binding

    settings: Any = numba.config
    processor = settings.CPU_NAME or binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    if processor == "generic":  # what numba then takes
        features = ""
    digest = hashlib.sha256(str(features).encode()).hexdigest()[:8]
    return Target(str(processor), digest, numba.__version__, platform.python_version())


def compiled_note(module: str, here: Target, origin: Target, work: str) -> str:
    """What is said where a worker had to compile a module; `work` is what was begun on another machine."""
    reason = "" if here == origin else f"; {work} was begun on {origin}"
    return f"{platform.node()}: compiled {module} for {here}{reason}"


def workers_folder() -> Path:
    """Where this machine keeps what its workers share."""
    return cache_folder() / "workers"


@contextmanager
def alone(name: str) -> Iterator[None]:
    """One process of this machine after the other, where the system can tell them to wait."""
    folder = workers_folder()
    try:
        with _lock_file(folder, name) as file:
            with suppress(ImportError, OSError):  # without it all compile, and find the same
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        remedy = f"let CODEGEN_CACHE_DIR name a folder that may be written to on {platform.node()}"
        raise refused(error, folder, remedy) from error


@contextmanager
def only_one(name: str, taken: CodegenError) -> Iterator[None]:
    """One process of this machine, and for others an error; whatever ends a process, its lock ends with it."""
    try:
        file = _lock_file(workers_folder(), name)
    except OSError:  # where nothing can be written to the cache, nobody can be told
        yield
        return
    with file:
        if _is_locked(file):
            raise taken
        yield


def _lock_file(folder: Path, name: str) -> TextIO:
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock").open("a")


def _is_locked(file: TextIO) -> bool:
    """Whether another process has the file; else this one has it now, and its forks do not inherit it."""
    with suppress(ImportError):
        import fcntl

        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:  # others than these come from disks without locks
            return error.errno in (errno.EACCES, errno.EAGAIN)
    return False
