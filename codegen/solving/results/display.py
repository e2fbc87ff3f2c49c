"""Views of a result: columns by name, comparison, data sets and frames, figures and films, and attitudes of bodies.

The columns of an attitude are a unit quaternion q = (w, x, y, z). A simulation has the energy H(q, p) as a function of
momenta, and the momentum p = 2 q pi of the quaternion contains the angular momentum pi in the frame of the body. So the
angular velocity is dH/dpi. The energy is quadratic in the momenta, so that a central difference has no error but
rounding. An optimum has no such function. Its angular velocity during a step follows from the increment of the
attitude, and its value at a node is the mean of both steps, which has order 2 like the schemes for rotations.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from codegen.deferred import Deferred
from codegen.errors import ArgumentError, ExtraError, nearest
from codegen.runtime.record import Form, Task

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

    from codegen.problem.sources import Source
    from codegen.show.figures.picture import Film, Picture
    from codegen.solving.loading import GeneratedModule, Vector

_COLUMNS = {"q": "coordinate", "p": "momentum", "u": "control"}
"""The name of the dimension of the columns of each array in an xarray data set, the same as for sweeps."""
_TEXTS = ("problem", "title", "task", "driver", "scheme", "status", "message")
"""Fields of a result that are text attributes of its data set."""
_TIMED = ("steps_per_second",)
"""Entries of a summary that depend on the measured time of the solve, and are ignored in comparisons."""

_PICTURE, _FILM = Deferred("show.notebook", "picture"), Deferred("show.notebook", "film")
_HTML = Deferred("show.notebook", "html")
_LOAD, _WITH_VALUES = Deferred("solving.loading", "load"), Deferred("solving.request", "with_values")


class Display:
    """The base class of `Result`: access to columns, comparison, conversion to tables, figures and films."""

    def __eq__(self, other: object) -> bool:
        """Return True if all values except measured times are identical to the last bit."""
        return same(self, other) if type(other) is type(self) else NotImplemented

    __hash__ = None  # type: ignore[assignment]  # arrays can be changed

    def __getitem__(self, name: str) -> Vector:
        """Return the column of `q`, `p` or `u` with a name, for example `result["theta"]`, or an attitude.

        Parameters
        ----------
        name : str
            Name of a coordinate, state, momentum or control; name of an attitude; "omega", or "omega_<attitude>" if the
            problem has several attitudes, for the angular velocity of a rotation in the frame of the body; name of a
            vector with the components `<name>_x`, `<name>_y` and `<name>_z`, such as a unit vector.

        Returns
        -------
        ndarray, shape (M + 1,), or (control_times.size,) for a control
            Values at the nodes, or at `control_times`, in the units of the problem. The shape of an attitude is
            (M + 1, 3, 3), and that of an angular velocity or a vector (M + 1, 3).

        Raises
        ------
        ArgumentError
            If no column has the name. The message lists the names.

        Notes
        -----
        The angular velocity of a simulation belongs to the momenta at the nodes, to rounding. That of an optimum is the
        mean of the steps before and after a node, of order 2.
        """
        result = _with_columns(self)
        for key, names in result.names.items():
            if name in names:
                return cast("Vector", getattr(result, key)[:, names.index(name)])
        if name in columns_of(result):
            return matrices(result, name)
        if name in (spins := angular_velocity_names(result)):
            return angular_velocity(result, spins[name])
        if (vector := vector_of(result, name)) is not None:
            return vector
        columns = [*columns_of(result), *spins]
        columns += [column for names in result.names.values() for column in names]
        metadata = None if result.background is None else result.background.loaded(result.parameters).metadata
        if metadata is not None and metadata.form == Form.LAGRANGIAN and name in metadata.rates:
            momentum = f"p_{metadata.coordinates[metadata.rates.index(name)]}"
            if momentum in columns:
                raise ArgumentError(
                    f"the result of {result.problem} has no column {name!r}, because it has momenta in place of "
                    "velocities",
                    f"use {momentum}",
                )
        if name in result.summary:
            raise ArgumentError(f"{name} is one number, and no column", f'write summary["{name}"]')
        remedy = nearest(name, columns, f"use one of {', '.join(columns)}")
        raise ArgumentError(f"the result of {result.problem} has no column {name!r}", remedy)

    if not TYPE_CHECKING:  # with this method visible, a type checker would accept misspelt fields

        def __getattr__(self, name: str) -> Vector:
            """Return the column with a name, if no field of the result has the name."""
            if any(name in names for names in self.__dict__.get("names", {}).values()):
                return self[name]
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(name for name in self._ipython_key_completions_() if name.isidentifier())]

    def _ipython_key_completions_(self) -> list[str]:
        result = cast(Any, self)
        turned = (*columns_of(result), *angular_velocity_names(result))
        return [*(name for names in result.names.values() for name in names), *turned]

    def differences(self, other: Any) -> dict[str, float]:
        """Return the max-norm distance to another solution of the problem for each quantity.

        Parameters
        ----------
        other : Result
            A solution of the same problem, on any grid.

        Returns
        -------
        dict of str to float
            The largest absolute difference of each coordinate, momentum, control and the cost by name, in its units.
            `t` is the difference of the durations. `other` is interpolated linearly at the nodes of this solution.
            Controls are compared at the control times of this solution.

        Raises
        ------
        ArgumentError
            If `other` has other quantities, or the problem is about particles.
        """
        one = cast(Any, self)
        for name in ("task", "names"):
            if getattr(one, name) != getattr(other, name):
                finding = f"{one.problem} and {other.problem} have other quantities"
                raise ArgumentError(finding, "compare solutions of one problem")
        if one.q.ndim != 2:
            raise ArgumentError(f"{one.problem} is about particles", "compare its arrays")
        distances = {"t": abs(float(one.t[-1] - other.t[-1]))}
        for key in ("q", "p"):
            for column, name in enumerate(one.names[key]):
                interpolated = np.interp(one.t, other.t, getattr(other, key)[:, column])
                distances[name] = float(np.abs(getattr(one, key)[:, column] - interpolated).max())
        if one.u is not None and other.u is not None:
            times = one.control_times
            errors = np.abs(one.controls_at(times) - other.controls_at(times))
            distances |= dict(zip(one.names["u"], errors.max(axis=0).tolist(), strict=True))
        if one.cost is not None and other.cost is not None:
            distances["cost"] = abs(one.cost - other.cost)
        return distances

    def to_dataset(self) -> Dataset:
        """Return the solution as an xarray.Dataset.

        Returns
        -------
        xarray.Dataset
            Dimensions have the same names as in the data set of a sweep. Variables are `t` (node), `q` (node,
            coordinate), `p` (node, momentum), `u` and `multipliers` on nodes, intervals or stages, `energy` (node) of a
            simulation, `cost`, `residual` and `stationarity`. An attitude is a variable (node, space_axis, body_axis)
            with its name, and an angular velocity `omega` is (node, body_axis). Other numbers and texts are attributes.
            Values are in the units of the problem. Declared units are in `coordinate_unit`, `momentum_unit`,
            `control_unit` and in the attribute `units` of `t`, `energy` and `cost`.

        Raises
        ------
        ExtraError
            If xarray is not installed.
        ArgumentError
            If the problem concerns particles.
        """
        _require_library("xarray", "a data set")
        import xarray

        result = _with_columns(self)
        variables: dict[str, tuple[tuple[str, ...], Vector | float]] = {"t": (("node",), result.t)}
        variables |= {name: (("node", "space_axis", "body_axis"), self[name]) for name in columns_of(result)}
        variables |= {name: (("node", "body_axis"), self[name]) for name in angular_velocity_names(result)}
        for name in ("q", "p"):
            if result.names[name]:
                variables[name] = ("node", _COLUMNS[name]), getattr(result, name)
        if result.energy is not None:
            variables["energy"] = ("node",), result.energy
        intervals = result.t.size - 1
        for name, dimension in (("u", "control"), ("multipliers", "multiplier")):
            array = getattr(result, name)
            if array is None or not array.shape[1]:
                continue
            if len(array) == intervals + 1:
                variables[name] = ("node", dimension), array
            elif len(array) == intervals:
                variables[name] = ("interval", dimension), array
            else:
                stages = array.reshape(intervals, len(array) // intervals, array.shape[1])
                variables[name] = ("interval", "stage", dimension), stages
        numbers = {"cost": result.cost, "residual": result.residual, "stationarity": result.stationarity}
        variables |= {name: ((), value) for name, value in numbers.items() if value is not None}
        axes = {dim for dims, _ in variables.values() for dim in dims if dim.endswith("_axis")}
        coordinates: dict[str, object] = {dim: list("xyz") for dim in sorted(axes)}
        for name in (name for name in _COLUMNS if name in variables):
            coordinates[_COLUMNS[name]] = list(result.names[name])
            units = [result.units.get(column, "") for column in result.names[name]]
            if any(units):
                coordinates[f"{_COLUMNS[name]}_unit"] = (_COLUMNS[name], units)
        texts: dict[str, object] = {name: getattr(result, name) for name in _TEXTS}
        attributes = {**texts, "formulation": result.method, "steps": result.steps, "iterations": result.iterations}
        data = xarray.Dataset(variables, coordinates, attributes | dict(result.summary) | dict(result.parameters))
        for name in ("t", "energy", "cost"):
            if name in data and result.units.get(name):
                data[name].attrs["units"] = result.units[name]
        return data

    def to_frame(self) -> DataFrame:
        """Return the solution as a pandas.DataFrame with a row for each node.

        Returns
        -------
        pandas.DataFrame
            The index is the time `t`; columns are coordinates, momenta, controls and the energy by name. A control that
            is constant on intervals has the value of the interval that begins at the node; the last node has the value
            of the last interval. Values are in the units of the problem; `attrs["units"]` has the declared units.

        Raises
        ------
        ExtraError
            If pandas is not installed.
        ArgumentError
            If the problem concerns particles.
        """
        _require_library("pandas", "a data frame")
        import pandas

        result = _with_columns(self)
        columns = {name: result.q[:, i] for i, name in enumerate(result.names["q"])}
        columns |= {name: result.p[:, i] for i, name in enumerate(result.names["p"])}
        if result.u is not None and result.names["u"]:
            controls = result.controls_at(result.t)
            if not result.stage_abscissae and len(result.u) < result.t.size:
                controls = np.vstack([result.u, result.u[-1:]])
            columns |= {name: controls[:, i] for i, name in enumerate(result.names["u"])}
        if result.energy is not None:
            columns["energy"] = result.energy
        frame = pandas.DataFrame(columns, index=pandas.Index(result.t, name="t"))
        frame.attrs["units"] = {name: unit for name, unit in result.units.items() if name == "t" or name in columns}
        return frame

    def plot(
        self, path: Path | str | None = None, *, style: str = "page", panels: Sequence[str] | None = None
    ) -> Picture:
        """Return the figure of `codegen solve --plot`.

        Parameters
        ----------
        path : path, optional
            File to write: .png, .pdf or .svg.
        style : {"page", "paper", "talk"}
            "paper" has the width of two columns of a journal.
        panels : sequence of str, optional
            Names of the quantities and path constraints to draw, in this order, without drawing and initial guess. By
            default the figure of an optimum has a panel for each of them.

        Returns
        -------
        Picture
            A notebook displays it. `figure` is the matplotlib figure, `text` its description.

        Raises
        ------
        ArgumentError
            For another style, panel or kind of file, and for a result without its module.
        """
        picture: Picture = _PICTURE(self, style, panels)
        if path is not None:
            picture.save(path)
        return picture

    def animate(self, path: Path | str | None = None) -> Film:
        """Return the film of `codegen solve --animate`.

        Parameters
        ----------
        path : path, optional
            File to write: .gif or .mp4.

        Returns
        -------
        Film
            A notebook displays it.

        Raises
        ------
        ArgumentError
            For a problem without a drawing, and for another kind of file.
        """
        film: Film = _FILM(self)
        if path is not None:
            film.save(path)
        return film

    def _repr_html_(self) -> str:
        return str(_HTML(self))


def _require_library(library: str, purpose: str) -> None:
    """Raise ExtraError with the command of the installation if a library is missing.

    The text `purpose` states what needs the library.
    """
    if find_spec(library) is None:
        raise ExtraError(f"{purpose} needs {library}, which is not installed", f"pip install {library}")


def _with_columns(display: Display) -> Any:
    """Return the result itself; raise ArgumentError for a result of particles, whose columns have no names."""
    result = cast(Any, display)
    if result.q.ndim != 2:
        raise ArgumentError(f"{result.problem} is about particles, whose path has no columns", "take its arrays")
    return result


def same(one: Any, other: Any) -> bool:
    """Return True if two values are identical to the last bit, including nested arrays; NaN equals NaN.

    Fields that are excluded from comparison, and entries in `_TIMED`, are ignored.
    """
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        is_number = isinstance(one, np.ndarray) and one.dtype.kind in "fc"
        return bool(np.array_equal(one, other, equal_nan=is_number))
    if type(one) is not type(other):
        return False
    if is_dataclass(one) and not isinstance(one, type):
        compared = [part.name for part in fields(one) if part.compare]
        return all(same(getattr(one, name), getattr(other, name)) for name in compared)
    if isinstance(one, Mapping):
        keys = [key for key in one if key not in _TIMED]
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in keys)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other or (one != one and other != other))


@dataclass(frozen=True)
class Background:
    """The module and the problem of a result, which figures need.

    `source` is the problem file or object, and `arguments` are the arguments of its function problem(). A pickle
    contains the `path` of the module instead of the loaded `module`, which is loaded again on demand. A pickle omits a
    `source` that cannot be pickled; figures then lack the drawing of the problem.
    """

    module: GeneratedModule
    path: Path | None = None
    source: Source | None = None
    arguments: Mapping[str, str] = field(default_factory=dict)

    def loaded(self, parameters: Mapping[str, float]) -> GeneratedModule:
        """Return the module with the parameter overrides of the solve; it is loaded again for a pickled result."""
        if self.module is None:
            return cast("GeneratedModule", _WITH_VALUES(_LOAD(self.path or ""), parameters))
        return self.module

    def __getstate__(self) -> dict[str, object]:
        source = self.source
        try:
            pickle.dumps(source)
        except Exception:  # for example, user functions may have no importable name
            source = None
        return {"module": None, "path": self.path, "source": source, "arguments": dict(self.arguments)}

    def __setstate__(self, state: Mapping[str, object]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)


Array = NDArray[np.float64]
_PARTS = "wxyz"


def columns_of(result: Any) -> dict[str, list[int]]:
    """Return the numbers of the four columns of `q` of each attitude by name.

    With several bodies, the name of an attitude ends with the number of its body.
    """
    found, names = dict[str, list[int]](), result.names["q"] if result.attitudes else ()
    for attitude in result.attitudes:
        for ending in (own.removeprefix(f"{attitude}_w") for own in names if own.startswith(f"{attitude}_w")):
            parts = [f"{attitude}_{part}{ending}" for part in _PARTS]
            if set(parts) <= {*names}:
                found[attitude + ending] = [names.index(part) for part in parts]
    return found


def angular_velocity_names(result: Any) -> dict[str, str]:
    """Return the attitude of each angular velocity by name: `omega`, or `omega_<attitude>` with several attitudes."""
    attitudes = [*columns_of(result)] if result.attitudes and result.names["p"] else []
    return {"omega": attitudes[0]} if len(attitudes) == 1 else {f"omega_{name}": name for name in attitudes}


def matrices(result: Any, name: str) -> Array:
    """Return the attitude `name` at the nodes (M + 1, 3, 3): rotations from the frame of the body to that of space."""
    q = result.q[:, columns_of(result)[name]]
    w, v = q[:, 0], q[:, 1:]
    cross = np.zeros((len(q), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = v
    cross[:, [1, 2, 0], [2, 0, 1]] = -v
    squares = (q**2).sum(axis=1)[:, None, None]
    real = (w**2 - (v**2).sum(axis=1))[:, None, None] * np.eye(3)
    return np.asarray((real + 2.0 * v[:, :, None] * v[:, None, :] + 2.0 * w[:, None, None] * cross) / squares)


def angular_velocity(result: Any, name: str) -> Array:
    """Return the angular velocity of the attitude `name` at the nodes (M + 1, 3), in the frame of the body."""
    columns = columns_of(result)[name]
    return _of_energy(result, columns) if result.task == Task.SIMULATE else _of_increments(result, columns)


def vector_of(result: Any, name: str) -> Array | None:
    """Return the vector (M + 1, 3) whose components are called `name` and _x, _y and _z; None if there are none."""
    parts = [f"{name}_{part}" for part in _PARTS[1:]]
    for key, names in result.names.items():
        if {*parts} <= {*names}:
            return np.asarray(getattr(result, key)[:, [names.index(part) for part in parts]])
    return None


def _of_energy(result: Any, columns: list[int]) -> Array:
    from codegen.runtime.stepping.steps import energies  # imports numba

    if result.background is None:
        raise ArgumentError(f"{result.problem}: this solution does not know its module", "solve by codegen.solve")
    module: Any = result.background.loaded(result.parameters)
    parameters = module.make_grid(result.steps).parameters
    path, times = np.hstack([result.q, result.p]), np.ascontiguousarray(result.t)
    q, momenta = result.q[:, columns], [result.q.shape[1] + column for column in columns]
    size = max(1e-3, float(np.abs(result.p[:, columns]).max()))
    omega = np.empty((len(path), 3))
    for axis in range(3):
        unit = np.zeros(4)
        unit[1 + axis] = 1.0
        found = []
        for sign in (1.0, -1.0):
            moved = path.copy()
            moved[:, momenta] += 2.0 * sign * size * _product(q, unit[None])
            values = np.empty(len(path))
            energies(module.problem.energy.address, moved, times, parameters, values)
            found.append(values)
        omega[:, axis] = (found[0] - found[1]) / (2.0 * size)
    return omega


def _of_increments(result: Any, columns: list[int]) -> Array:
    q, h = result.q[:, columns], np.diff(result.t)[:, None]
    increment = _product(q[:-1] * [1.0, -1.0, -1.0, -1.0], q[1:])
    # A step of the midpoint rule turns by tau(h omega), and the quaternion of tau is (1, h omega/4)^2, normalised.
    steps = 4.0 * increment[:, 1:] / (np.linalg.norm(increment, axis=1)[:, None] + increment[:, :1]) / h
    if len(steps) == 1:
        return np.repeat(steps, 2, axis=0)
    ends = steps[[0, -1]] + (steps[[0, -1]] - steps[[1, -2]]) * h[[0, -1]] / (h[[0, -1]] + h[[1, -2]])
    middle = (steps[:-1] * h[1:] + steps[1:] * h[:-1]) / (h[:-1] + h[1:])
    return np.vstack([ends[:1], middle, ends[1:]])


def _product(a: Array, b: Array) -> Array:
    """Return the products of the quaternions in the rows of two arrays."""
    w, v, c, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.hstack([w * c - (v * u).sum(axis=1, keepdims=True), w * u + c * v + np.cross(v, u)])
