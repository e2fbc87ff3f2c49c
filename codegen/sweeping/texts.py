"""The modules of a sweep as they are sent to other machines: texts, which are compiled there, once on each."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from codegen import loading
from codegen.drivers import DRIVERS
from codegen.engines.machines import Target, alone, compiled_note, target, workers_folder
from codegen.files import write_text
from codegen.machine_code import ahead_of_time
from codegen.sweeping.case import Variant


@dataclass(frozen=True, eq=False)
class Texts:
    """The texts of modules by their variants, and the machine that they come from."""

    texts: dict[tuple[str, ...], str]
    origin: Target

    def placed(
        self, variants: Mapping[tuple[str, ...], Variant], driver: str
    ) -> tuple[dict[tuple[str, ...], Variant], tuple[str, ...]]:
        """The variants where this machine has their modules, compiled for it, and what is to be said of it."""
        here, notes, found = target(), [], dict(variants)
        for key, text in self.texts.items():
            variant = variants[key]
            assert variant.path is not None, "what has a text has a name"
            path = variant.path if self._is_here(variant.path, text, here) else _place(variant.path.name, text, here)
            if _compiled(path, text, driver):
                notes.append(compiled_note(path.stem, here, self.origin, "the sweep"))
            found[key] = replace(variant, path=path)
        return found, tuple(notes)

    def _is_here(self, path: Path, text: str, here: Target) -> bool:
        """Whether the module is there in the same place, and its machine code, if there is some, fits."""
        try:
            return here == self.origin and path.read_text(encoding="utf-8") == text
        except (OSError, UnicodeDecodeError):
            return False


def texts_of(variants: Mapping[tuple[str, ...], Variant]) -> Texts:
    """The texts of what is in files."""
    texts = {
        key: variant.path.read_text(encoding="utf-8")
        for key, variant in variants.items()
        if variant.path is not None and variant.shapes is not None
    }
    return Texts(texts, target())


def _place(name: str, text: str, here: Target) -> Path:
    """Where this machine keeps a module; several may share a disk."""
    machine = f"{platform.node()}-{here.processor}-{here.features}-numba-{here.numba}-python-{here.python}"
    return workers_folder() / machine / hashlib.sha256(text.encode()).hexdigest()[:20] / name


def _compiled(path: Path, text: str, driver: str) -> bool:
    """Have a module where it belongs, with its machine code; whether it was this process that had to compile it."""
    with alone(str(path)):
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)
        if not DRIVERS[driver].generated:
            return False
        seconds, _ = ahead_of_time.require(path, loading.load(path), False, lambda what: nullcontext())
        return seconds > 0.0
