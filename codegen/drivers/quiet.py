"""One thread of linear algebra and no warnings while a driver runs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from threading import Lock

import numpy as np
from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    """Libraries with threads of their own; looking for them takes longer than many a solve."""
    return ThreadpoolController()


@contextmanager
def _of_the_process() -> Iterator[None]:
    """One BLAS thread, and no warnings: settings of the whole process."""
    with _libraries().limit(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class _Shared:
    """A context that several threads may be in at once: the first enters it, and the last leaves it."""

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


_QUIET = _Shared(_of_the_process)


@contextmanager
def quiet_single_thread() -> Iterator[None]:
    """One BLAS thread, because more only wait for each other on small matrices, and no warnings.

    What would be warned of, a singular matrix or an overflow, shows in the status and in the residuals.
    """
    with _QUIET, np.errstate(all="ignore"):
        yield
