"""One thread of linear algebra, and no warnings, while a driver runs.

The file imports nothing of scipy, which the generated solver does not need and which is slow to import.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from threading import Lock

import numpy as np
from threadpoolctl import ThreadpoolController


@contextmanager
def _quiet_process() -> Iterator[None]:
    """Use one BLAS thread and suppress warnings during a with block; both settings apply to the whole process."""
    with _blas().limit(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@cache
def _blas() -> ThreadpoolController:
    """Return the controller of libraries with threads; it is cached because its construction is slow."""
    return ThreadpoolController()


class _Shared:
    """A context manager that several threads share: the first thread enters the context, and the last thread leaves it.

    `make` returns the context.
    """

    def __init__(self, make: Callable[[], AbstractContextManager[None]]) -> None:
        self.make, self.lock, self.inside = make, Lock(), 0

    def __enter__(self) -> None:
        with self.lock:
            if not self.inside:
                self.context = self.make()
                self.context.__enter__()
            self.inside += 1

    def __exit__(self, *error: object) -> None:
        with self.lock:
            self.inside -= 1
            if not self.inside:
                self.context.__exit__(None, None, None)


_QUIET = _Shared(_quiet_process)


@contextmanager
def quiet_single_thread() -> Iterator[None]:
    """Use one BLAS thread and suppress warnings during a with block.

    With small matrices several threads would only wait for each other. A singular matrix or an overflow needs no
    warning, because the status and the residuals show it.
    """
    with _QUIET, np.errstate(all="ignore"):
        yield
