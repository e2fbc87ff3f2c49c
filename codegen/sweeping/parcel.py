"""Work as it is sent to other machines: with the texts of its modules, which are compiled there, once on each.

Machine code belongs to a processor and to a version of numba, and is never sent.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from codegen import loading
from codegen.cache import cache_folder
from codegen.errors import ArgumentError
from codegen.files import refused, write_text
from codegen.machine_code import ahead_of_time
from codegen.sweeping.work import Work


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
    from llvmlite import binding  # type: ignore[import-untyped]

    settings: Any = numba.config
    processor = settings.CPU_NAME or binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    if processor == "generic":  # what numba then takes
        features = ""
    digest = hashlib.sha256(str(features).encode()).hexdigest()[:8]
    return Target(str(processor), digest, numba.__version__, platform.python_version())


@dataclass(frozen=True, eq=False)
class Parcel:
    """Work without its cases, the texts of its modules by their variants, and where it comes from."""

    work: Work
    texts: dict[tuple[str, ...], str]
    origin: Target
    mark: tuple[int, ...]

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """The work, ready to solve here, and what is to be said of this machine.

        Where it does not see the store of the work it has none: rows are to be sent back.
        """
        here, notes, variants = target(), [], dict(self.work.variants)
        for key, text in self.texts.items():
            variant = variants[key]
            assert variant.path is not None, "what has a text has a name"
            path = variant.path if self._is_here(variant.path, text, here) else _place(variant.path.name, text, here)
            if _compiled(path, text, self.work.driver):
                reason = "" if here == self.origin else f"; the sweep was begun on {self.origin}"
                notes.append(f"{platform.node()}: compiled {path.stem} for {here}{reason}")
            variants[key] = replace(variant, path=path)
        sink = self.work.sink
        sees = sink is not None and bool(self.mark) and sink.mark() == self.mark
        return replace(self.work, variants=variants, sink=sink if sees else None).loaded(), tuple(notes)

    def _is_here(self, path: Path, text: str, here: Target) -> bool:
        """Whether the module is there in the same place, and its machine code, if there is some, fits."""
        try:
            return here == self.origin and path.read_text(encoding="utf-8") == text
        except (OSError, UnicodeDecodeError):
            return False


def parcel_of(work: Work) -> Parcel:
    """What is to be sent; ArgumentError where a module is in no file."""
    if work.module is not None:
        raise ArgumentError("a module that is in no file cannot be sent to a cluster", "build it, and give its path")
    texts = {
        key: variant.path.read_text(encoding="utf-8")
        for key, variant in work.variants.items()
        if variant.path is not None and variant.shapes is not None
    }
    return Parcel(work.without_cases(), texts, target(), () if work.sink is None else work.sink.mark())


def _place(name: str, text: str, here: Target) -> Path:
    """Where this machine keeps a module; several may share a disk."""
    machine = f"{platform.node()}-{here.processor}-{here.features}-numba-{here.numba}-python-{here.python}"
    return cache_folder() / "workers" / machine / hashlib.sha256(text.encode()).hexdigest()[:20] / name


def _compiled(path: Path, text: str, driver: str) -> bool:
    """Have a module where it belongs, with its machine code; whether it was this process that had to compile it."""
    with _alone(hashlib.sha256(str(path).encode()).hexdigest()[:20]):
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)
        if driver != "newton":
            return False
        seconds, _ = ahead_of_time.require(path, loading.load(path), False, lambda what: nullcontext())
        return seconds > 0.0


@contextmanager
def _alone(name: str) -> Iterator[None]:
    """One process of this machine after the other, where the system can tell them to wait."""
    folder = cache_folder() / "workers"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"{name}.lock").open("a") as file:
            with suppress(ImportError, OSError):  # without it all compile, and find the same
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        remedy = f"let CODEGEN_CACHE_DIR name a folder that may be written to on {platform.node()}"
        raise refused(error, folder, remedy) from error
