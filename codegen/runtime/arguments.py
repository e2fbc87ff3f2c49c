"""Arguments of kernels that follow from others: how many particles there are, and how many columns an array has."""

from collections.abc import Iterable
from typing import Any


def with_counts(names: Iterable[str], values: Iterable[Any]) -> list[Any]:
    """Return the values of all arguments of a kernel, those that are called `count` and `columns` included.

    `count` is the last dimension but one of the array before it, `columns` the last dimension.
    """
    waiting, found = list(values), list[Any]()
    for name in names:
        if name in ("count", "columns"):
            found.append(found[-1].shape[-2 if name == "count" else -1])
        else:
            found.append(waiting.pop(0))
    return found
