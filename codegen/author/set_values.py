"""Values of `--set` arguments: from text to the types that the parameters of problem() are annotated with."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from codegen.errors import ArgumentError, clause


def converted(path: Path, text: str, parameter: inspect.Parameter) -> Any:
    """The value of an argument of problem() in the type that it is annotated with, or that its default has.

    Raises ArgumentError, which names the problem file at `path`, when the text does not fit, or when there is no
    reading such a type from text.
    """
    annotation = parameter.annotation
    if annotation is parameter.empty:
        annotation = type(parameter.default)
    readers = _readers(annotation)
    if not readers or annotation is NoneType:
        raise ArgumentError(
            clause(f"{path}: --set {parameter.name}: its type cannot be read from text"),
            f"annotate {parameter.name} in problem() with int, float, bool, str, Path or Literal",
        )
    for _, reader in readers:
        try:
            return reader(text)
        except ValueError:
            continue
    raise ArgumentError(
        clause(f"{path}: --set {parameter.name}={text} does not fit"),
        clause(f"give {' or '.join(description for description, _ in readers)}"),
    )


def _readers(annotation: Any) -> list[tuple[str, Callable[[str], Any]]]:
    """What a type accepts, in words, and the function that reads it (ValueError when the text does not fit)."""
    origin, choices = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _readers(choices[0])
    if origin is Literal:
        values = {str(choice): choice for choice in choices}
        return [(" or ".join(values), lambda text: _chosen(values, text))]
    if origin in (Union, UnionType):
        # None first: every other type of text would take the word for a value.
        parts = [_readers(choice) for choice in sorted(choices, key=lambda choice: choice is not NoneType)]
        return [reader for part in parts for reader in part] if all(parts) else []
    plain: dict[Any, tuple[str, Callable[[str], Any]]] = {
        int: ("a whole number", _integer),
        float: ("a finite number", _finite),
        bool: ("true or false", lambda text: _chosen(_TRUTH, text.strip().lower())),
        str: ("text", str),
        Path: ("a path", _path),
        NoneType: ("none", lambda text: _chosen({"none": None}, text.strip().lower())),
    }
    return [plain[annotation]] if isinstance(annotation, type) and annotation in plain else []


_TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def _chosen(values: Mapping[str, Any], text: str) -> Any:
    if text not in values:
        raise ValueError(text)
    return values[text]


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = Decimal(text)
    except InvalidOperation:
        raise ValueError(text) from None
    # The bound comes first: the integer 1e999999999 would not fit into memory.
    if not number.is_finite() or number.adjusted() > 18 or number != number.to_integral_value():
        raise ValueError(text)
    return int(number)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _path(text: str) -> Path:
    if not text.strip():
        raise ValueError(text)
    return Path(text)
