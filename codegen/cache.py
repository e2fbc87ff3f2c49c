"""The build cache: texts by a digest of everything that they depend on; a hit needs no sympy at all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from codegen import emit
from codegen.author.problem_file import input_digest
from codegen.naming import Choices, choice_texts, module_name, versions


def cache_folder() -> Path:
    """The build cache: $CODEGEN_CACHE_DIR, or a folder in the user's cache directory."""
    given = os.environ.get("CODEGEN_CACHE_DIR")
    if given:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "variational-codegen"


def path_of(path: Path, arguments: Mapping[str, str], choices: Choices) -> Path:
    """Where the cache keeps the module of a problem file with these arguments and choices, if it has been built."""
    digest = input_digest(path, arguments, *choice_texts(choices), *versions(), _own_digest())
    return cache_folder() / digest[:20] / f"{module_name(path, arguments, choices)}.py"


def kept_text(store: Path) -> str:
    """What the cache holds; nothing where it holds nothing, or what is not whole."""
    try:
        text = store.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return text if emit.is_whole(text) else ""


_GENERATORS = (
    "author", "model", "expressions", "schemes", "discretise", "transcribe", "derive", "lower", "emit", "verify",
    "runtime", "compiler.py", "drawing.py", "mangling.py", "naming.py",
)  # fmt: skip
"""Parts of this package on which generated texts depend; all others use them."""


@cache
def _own_digest() -> str:
    """Hash of the sources that generate, so that a changed generator never serves what an older one made."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for file in sorted([*folder.rglob("*.py"), *folder.rglob("*.j2")]):
        if file.relative_to(folder).parts[0] in _GENERATORS:
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
