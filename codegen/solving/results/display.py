"""What a solution shows of itself, and as what else it can be had; figures are made by parts of higher floors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from codegen.deferred import Deferred
from codegen.errors import ArgumentError, ExtraError

if TYPE_CHECKING:
    from xarray import Dataset

    from codegen.show.figures.picture import Film, Picture


_COLUMNS = {"q": "coordinate", "p": "momentum", "u": "control"}
"""Dimensions of columns, as those of a sweep are called."""
_TEXTS = ("problem", "title", "task", "driver", "scheme", "status", "message")


def _require(library: str, what: str) -> None:
    """Refuse to go on without a library; ExtraError names the extra that brings it."""
    if find_spec(library) is None:
        raise ExtraError(f"{what} needs {library}, which is not installed", "pip install 'variational-codegen[sweep]'")


def as_dataset(result: Any) -> Dataset:
    """See `Result.to_dataset`."""
    _require("xarray", "a data set")
    import xarray

    if result.q.ndim != 2:
        raise ArgumentError(f"{result.problem} is about particles, whose path has no columns", "take its arrays")
    variables: dict[str, tuple[tuple[str, ...], Any]] = {"t": (("node",), result.t)}
    for name in ("q", "p"):
        if result.names[name]:
            variables[name] = ("node", _COLUMNS[name]), getattr(result, name)
    if result.energy is not None:
        variables["energy"] = ("node",), result.energy
    for name, dim in (("u", "control"), ("multipliers", "multiplier")):
        array = getattr(result, name)
        if array is not None and array.shape[1]:
            variables[name] = _by_rows(array, result.t.size, dim)
    numbers = {"cost": result.cost, "residual": result.residual, "stationarity": result.stationarity}
    variables |= {name: ((), value) for name, value in numbers.items() if value is not None}
    coordinates: dict[str, Any] = {}
    for name in (name for name in _COLUMNS if name in variables):
        coordinates[_COLUMNS[name]] = list(result.names[name])
        units = [result.units.get(column, "") for column in result.names[name]]
        if any(units):
            coordinates[f"{_COLUMNS[name]}_unit"] = (_COLUMNS[name], units)
    texts: dict[str, Any] = {name: getattr(result, name) for name in _TEXTS}
    attributes = {**texts, "formulation": result.method, "steps": result.steps, "iterations": result.iterations}
    data = xarray.Dataset(variables, coordinates, attributes | dict(result.summary) | dict(result.parameters))
    for name in ("t", "energy", "cost"):
        if name in data and result.units.get(name):
            data[name].attrs["units"] = result.units[name]
    return data


def _by_rows(array: Any, nodes: int, dim: str) -> tuple[tuple[str, ...], Any]:
    """Dimensions and values of an array whose rows belong to nodes, intervals, or stages of intervals."""
    if len(array) == nodes:
        return ("node", dim), array
    stages = len(array) // (nodes - 1)
    if stages == 1:
        return ("interval", dim), array
    return ("interval", "stage", dim), array.reshape(nodes - 1, stages, array.shape[1])


_TIMED = ("steps_per_second",)
"""Entries of a summary that say how long something took."""


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal to the last bit, arrays and what they stand in included; NaN equals NaN."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        is_number = isinstance(one, np.ndarray) and one.dtype.kind in "fc"
        return bool(np.array_equal(one, other, equal_nan=is_number))
    if type(one) is not type(other):
        return False
    if is_dataclass(one) and not isinstance(one, type):
        compared = [part.name for part in fields(one) if part.compare]
        return all(same(getattr(one, name), getattr(other, name)) for name in compared)
    if isinstance(one, Mapping):
        own = [key for key in one if key not in _TIMED]
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in own)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other or (one != one and other != other))


def differences(one: Any, other: Any) -> dict[str, float]:
    """How far another solution is away, as the max-norm for each quantity; see `Result.differences`."""
    for name in ("task", "names"):
        if getattr(one, name) != getattr(other, name):
            finding = f"{one.problem} and {other.problem} have other quantities"
            raise ArgumentError(finding, "compare solutions of one problem")
    if one.q.ndim != 2:
        raise ArgumentError(f"{one.problem} is about particles", "compare its arrays")
    found = {"t": abs(float(one.t[-1] - other.t[-1]))}
    for key in ("q", "p"):
        for column, name in enumerate(one.names[key]):
            beside = np.interp(one.t, other.t, getattr(other, key)[:, column])
            found[name] = float(np.abs(getattr(one, key)[:, column] - beside).max())
    if one.u is not None and other.u is not None:
        times = one.control_times
        apart = np.abs(one.controls_at(times) - other.controls_at(times))
        found |= dict(zip(one.names["u"], apart.max(axis=0).tolist(), strict=True))
    if one.cost is not None and other.cost is not None:
        found["cost"] = abs(one.cost - other.cost)
    return found


_PICTURE, _FILM = Deferred("show.notebook", "picture"), Deferred("show.notebook", "film")
_HTML = Deferred("show.notebook", "html")


@dataclass(frozen=True)
class Background:
    """Where a solution comes from, as far as its pictures need that: the module, and what its author has written.

    `module` is the loaded one, which a pickle leaves out; then it is loaded again from `path`. `source` is a problem
    file or an object with its `arguments`; a pickle leaves an object out that cannot be pickled, and the drawing in its
    pictures with it.
    """

    module: Any
    path: Path | None = None
    source: Any = None
    arguments: Mapping[str, str] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        import pickle

        source = self.source
        try:
            pickle.dumps(source)
        except Exception:  # functions of an author may have no name by which another process finds them
            source = None
        return {"module": None, "path": self.path, "source": source, "arguments": dict(self.arguments)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)


class Display:
    """What `codegen.solve` returns can do beside holding numbers."""

    def __eq__(self, other: object) -> bool:
        """Whether all is the same to the last bit, but for how long it took."""
        return same(self, other) if type(other) is type(self) else NotImplemented

    __hash__ = None  # type: ignore[assignment]  # arrays can be changed

    def differences(self, other: Any) -> dict[str, float]:
        """How far another solution of the problem is away: the max-norm by name, in the units of each quantity.

        On other grids it is interpolated at the nodes of this one, linearly; controls are compared at their own times;
        `t` is the difference of durations. Raises ArgumentError for a solution with other quantities.
        """
        return differences(cast(Any, self), other)

    def to_dataset(self) -> Dataset:
        """An xarray.Dataset with the dimensions node, interval and stage, called as those of a sweep.

        `t` (node), `q` (node, coordinate), `p` (node, momentum), `u` and `multipliers` on nodes, intervals or stages,
        `energy` (node) of a simulation, `cost` and `residual`; the rest are attributes. In the units of the problem,
        which stand, where its author gave them, in `coordinate_unit`, `momentum_unit`, `control_unit` and attributes.
        Raises ExtraError without xarray, and ArgumentError for particles.
        """
        return as_dataset(cast(Any, self))

    def to_frame(self) -> Any:
        """A pandas.DataFrame with a row for each node, indexed by its time, and a column for each quantity by name.

        A control that is constant on intervals has the value that holds from the node on, at the last node that of the
        last interval. In the units of the problem, which `attrs["units"]` names where its author gave them. Raises
        ExtraError without pandas, and ArgumentError for particles.
        """
        # See `Result.to_frame`.
        result = cast(Any, self)
        _require("pandas", "a data frame")
        import pandas

        if result.q.ndim != 2:
            raise ArgumentError(f"{result.problem} is about particles, whose path has no columns", "take its arrays")
        columns = {name: result.q[:, i] for i, name in enumerate(result.names["q"])}
        columns |= {name: result.p[:, i] for i, name in enumerate(result.names["p"])}
        if result.u is not None and result.names["u"]:
            controls = result.controls_at(result.t)
            if not result.stage_abscissae and len(result.u) < result.t.size:
                controls = np.vstack([result.u, result.u[-1:]])  # each from its node on
            columns |= {name: controls[:, i] for i, name in enumerate(result.names["u"])}
        if result.energy is not None:
            columns["energy"] = result.energy
        frame = pandas.DataFrame(columns, index=pandas.Index(result.t, name="t"))
        frame.attrs["units"] = {name: unit for name, unit in result.units.items() if name == "t" or name in columns}
        return frame

    def plot(self, path: Path | str | None = None, *, style: str = "page") -> Picture:
        """The figure of `codegen solve --plot`, which a notebook shows, written to `path` as well if that is given.

        Its `figure` is matplotlib's, and its `text` says what it shows. `style` is "page", "paper" for the width of a
        journal's two columns, or "talk". Raises ArgumentError for another style, for a file that is no .png, .pdf or
        .svg, and for a solution that does not know its module.
        """
        picture: Picture = _PICTURE(self, style)
        if path is not None:
            picture.save(path)
        return picture

    def animate(self, path: Path | str | None = None) -> Film:
        """The film of `codegen solve --animate`, which a notebook shows, written to `path` as well if that is given.

        Raises ArgumentError for a problem without a drawing, and for a file that is no .gif or .mp4.
        """
        film: Film = _FILM(self)
        if path is not None:
            film.save(path)
        return film

    def _repr_html_(self) -> str:
        return str(_HTML(self))
