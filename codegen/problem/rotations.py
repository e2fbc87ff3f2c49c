"""Rotations, poses and unit vectors as quantities of a problem, and the conversion of a problem to coordinates.

The attitude R of a rigid body, an element of SO(3), has a unit quaternion q = (w, x, y, z) as coordinates. R and the
angular velocity omega in the body's frame are functions of q and dq that do not depend on the length of q:

    R v = q v q* / |q|^2,    omega = 2 Im(q* dq) / |q|^2.

The holonomic constraint |q|^2 = 1 belongs to every rotation. It has two consequences for the midpoint rule, with
q = (q_k + q_k1)/2 and dq = (q_k1 - q_k)/h:

- The attitude in the middle is a rotation, and omega is exactly the increment of the attitude by the retraction

      R_k1 = R_k tau(h omega),    |h omega| = 4 tan(angle/4),

  the square of Cayley's map of h omega/2. The variational scheme is the Lie group variational integrator of this
  retraction, without a singular attitude: increments of less than a whole turn per step are all reached. A simulation
  has omega as its unknowns in place of q and of the multiplier (`discretise.rotations`).
- A rotation of space is a linear map of quaternions, so that the angular momentum in space is conserved to rounding.

The kinetic energy does not depend on the component of dq along q. The square of (q . dq), which vanishes along every
motion and at the midpoint of every step, is added to the Lagrangian, so that momenta determine velocities.

Sources: Lee, Leok and McClamroch (2007), Lie group variational integrators for the full body problem; Bou-Rabee and
Marsden (2009), Hamilton-Pontryagin integrators on Lie groups; Hairer, Lubich and Wanner (2006), VII.5.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, ImmutableMatrix, Matrix, Symbol
from sympy.matrices.matrixbase import MatrixBase

from codegen.errors import BoundaryError, ExpressionError, SymbolError
from codegen.problem.symbols import Coordinate, Quantity, State, Time, Velocity, coordinates, time
from codegen.symbolic.parts import replaced

_NEARLY = 1e-6
"""Largest deviation from orthogonality, or from length one, of numbers for an attitude that is taken for rounding."""
_STRAIGHT = 1e-3
"""Angle between the values at both ends, in radians, below which a straight line is a good guess."""
_NOW = sympy.Dummy("t", real=True)
"""The time in guesses, before the time symbol of the problem takes its place."""
_ATTITUDE = "a rotation matrix (3, 3), a unit quaternion (w, x, y, z), or an axis and an angle as in ([0, 0, 1], pi/2)"


@dataclass(frozen=True)
class Sphere:
    """Coordinates whose vector has length one: a unit quaternion (4) or a unit vector (3), with their velocities.

    A quaternion of states has no velocities.
    """

    name: str
    coordinates: tuple[Coordinate | State, ...]
    velocities: tuple[Velocity, ...]

    @property
    def constraint(self) -> Expr:
        """The expression |q|^2 - 1."""
        return squared_length(self.coordinates) - 1

    @property
    def radial_velocity(self) -> Expr:
        """The expression q . dq."""
        return sympy.Add(*(q * v for q, v in zip(self.coordinates, self.velocities, strict=True)))

    @property
    def is_attitude(self) -> bool:
        """True if the vector is the quaternion of an attitude."""
        return len(self.coordinates) == 4

    @property
    def matrix(self) -> ImmutableMatrix:
        """The attitude as a matrix (3, 3), from the frame of the body to the frame of space."""
        return rotation_matrix(self.coordinates)

    @property
    def angular_velocity(self) -> ImmutableMatrix:
        """The angular velocity (3,) in the frame of the body."""
        return ImmutableMatrix(angular_velocity(self.coordinates, self.velocities))


class _CoordinateOnSphere(Coordinate):
    """A coordinate of a `sphere`."""

    __slots__ = ("sphere",)
    sphere: Sphere


class _StateOnSphere(State):
    """A state of a `sphere`."""

    __slots__ = ("sphere",)
    sphere: Sphere


def rotation(name: str) -> tuple[ImmutableMatrix, ImmutableMatrix]:
    """Declare the attitude of a rigid body, and its angular velocity.

    Parameters
    ----------
    name : str
        An identifier. The coordinates `<name>_w`, `<name>_x`, `<name>_y` and `<name>_z` of the solution are a unit
        quaternion.

    Returns
    -------
    R : ImmutableMatrix (3, 3)
        The rotation from the frame of the body to the frame of space: `R @ v` is the vector v of the body in space.
    omega : ImmutableMatrix (3, 1)
        The angular velocity in the frame of the body.

    Notes
    -----
    Both are keys of `start` and `end`, and `R` of `guess`. `R` has a matrix, a unit quaternion (w, x, y, z), or a pair
    of an axis and an angle as its value; `omega` has three numbers. A quaternion and its negative are the same
    attitude, but a motion ends at the one that is given: an angle of 3 pi/2 is not an angle of -pi/2.
    `force={R: torque}` has the torque in the frame of the body; a torque in space is `R.T @ torque`.
    """
    sphere = _sphere(name, [f"{name}_{part}" for part in "wxyz"])
    return sphere.matrix, sphere.angular_velocity


def pose(
    name: str, *, unit: str | None = None
) -> tuple[tuple[ImmutableMatrix, ImmutableMatrix], tuple[ImmutableMatrix, ImmutableMatrix]]:
    """Declare the position and the attitude of a rigid body, and their velocities.

    Parameters
    ----------
    name : str
        An identifier. The coordinates of the solution are `<name>_1`, `<name>_2`, `<name>_3` and those of `rotation`.
    unit : str
        Unit of the position, as for `coordinate`.

    Returns
    -------
    (x, R) : tuple of ImmutableMatrix
        Position (3, 1) in the frame of space, and attitude (3, 3).
    (v, omega) : tuple of ImmutableMatrix
        Velocity (3, 1) in the frame of space, and angular velocity (3, 1) in the frame of the body.
    """
    _require_name(name)
    x, v = coordinates(f"{name}_1:4", unit=unit)
    R, omega = rotation(name)
    return (ImmutableMatrix(x), R), (ImmutableMatrix(v), omega)


def direction(name: str) -> tuple[ImmutableMatrix, ImmutableMatrix]:
    """Declare a unit vector, and its velocity.

    Parameters
    ----------
    name : str
        An identifier. The coordinates of the solution are `<name>_x`, `<name>_y` and `<name>_z`.

    Returns
    -------
    n, dn : ImmutableMatrix (3, 1)
        The vector and its velocity, which is perpendicular to it. Both are keys of `start` and `end`, and n of `guess`.
    """
    sphere = _sphere(name, [f"{name}_{part}" for part in "xyz"])
    return ImmutableMatrix(sphere.coordinates), ImmutableMatrix(sphere.velocities)


def attitude(name: str) -> ImmutableMatrix:
    """Declare the attitude of a rigid body as a state of first-order dynamics.

    Parameters
    ----------
    name : str
        An identifier. The states `<name>_w`, `<name>_x`, `<name>_y` and `<name>_z` of the solution are a quaternion.

    Returns
    -------
    R : ImmutableMatrix (3, 3)
        The rotation from the frame of the body to the frame of space. It is a key of `start`, `end` and `guess`, as
        for `rotation`, and of `dynamics`: `dynamics={R: w}` has the angular velocity w (3,) in the frame of the body,
        which may depend on states and controls.

    Notes
    -----
    The midpoint rule and Gauss schemes conserve the length of the quaternion to rounding. R does not depend on it. The
    motion ends at the quaternion of `end` or at its negative, which are the same attitude.
    """
    _require_name(name)
    states = tuple(_StateOnSphere(f"{name}_{part}") for part in "wxyz")
    sphere = Sphere(name, states, ())
    for q in states:
        q.sphere = sphere
    return sphere.matrix


def _sphere(name: str, names: Sequence[str]) -> Sphere:
    _require_name(name)
    pairs = [(_CoordinateOnSphere(each), Velocity(f"d{each}")) for each in names]
    for q, v in pairs:
        q.partner, v.partner = v, q
    qs, vs = zip(*pairs, strict=True)
    sphere = Sphere(name, qs, vs)
    for q in qs:
        q.sphere = sphere
    return sphere


def _require_name(name: str) -> None:
    if not isinstance(name, str) or not name.isidentifier():
        raise SymbolError(f"{name!r} is not an identifier", "use letters, digits and underscores")


def spheres_in(*expressions: object) -> list[Sphere]:
    """Return the rotations and unit vectors whose coordinates or velocities occur in expressions, in order."""
    found: dict[Sphere, None] = {}
    for expression in expressions:
        symbols: set[Symbol] = getattr(expression, "free_symbols", set())
        for q in sorted((s.partner if isinstance(s, Velocity) else s for s in symbols), key=str):
            if isinstance(q, (_CoordinateOnSphere, _StateOnSphere)):
                found.setdefault(q.sphere)
    return list(found)


def names_of(symbols: Iterable[Symbol]) -> list[str]:
    """Return the names of symbols as the author wrote them: components have the name of their rotation or vector."""
    names: dict[str, None] = {}
    for symbol in symbols:
        q = symbol.partner if isinstance(symbol, Velocity) else symbol
        sphere = q.sphere if isinstance(q, (_CoordinateOnSphere, _StateOnSphere)) else None
        if sphere is None:
            names.setdefault(str(symbol))
        elif q is symbol:
            names.setdefault(sphere.name)
        else:
            names.setdefault(f"the {'angular ' if sphere.is_attitude else ''}velocity of {sphere.name}")
    return list(names)


def in_matrices(expression: Expr) -> Expr:
    """Return an expression for messages, in which entries of R and omega of every rotation R are symbols.

    The symbols are called `R[0, 1]` and `omega_R[2]`. Other parts of the expression keep the components of quaternions.
    """
    for sphere in (sphere for sphere in spheres_in(expression) if sphere.is_attitude):
        squares = squared_length(sphere.coordinates)
        places = ((row, column) for row in range(3) for column in range(3))
        values = {
            entry * squares: Symbol(f"{sphere.name}[{row}, {column}]") * squares
            for entry, (row, column) in zip(sphere.matrix, places, strict=True)
        }
        for index, part in enumerate(sphere.angular_velocity if sphere.velocities else ()):
            values[part * squares] = Symbol(f"omega_{sphere.name}[{index}]") * squares
        expression = replaced(replaced(expression, values), {squares: sympy.S.One})
    return expression


def in_coordinates(problem: Any) -> dict[str, object]:
    """Return the arguments of a problem that change when matrices, which are keys, are written out in coordinates.

    The constraints of the rotations and unit vectors in the Lagrangian are added, and so is the term that makes the
    kinetic energy of a rotation regular. A problem that has the constraints already is left as it is.

    Raises
    ------
    SymbolError
        For a matrix that is no declared vector or rotation.
    BoundaryError
        For a value that is no attitude, no vector of three numbers, or an angular velocity without an attitude.
    """
    reading, changed = _Reading(), dict[str, Any]()
    for what in ("start", "end", "force", "dynamics", "guess", "bounds", "scale", "periodic", "history"):
        mapping = getattr(problem, what, None)
        if isinstance(mapping, Mapping) and any(isinstance(key, MatrixBase) for key in mapping):
            changed[what] = dict(reading.components(what, mapping))
    periodic = getattr(problem, "periodic", ())
    if isinstance(periodic, (list, tuple)) and any(isinstance(each, MatrixBase) for each in periodic):
        changed["periodic"] = [symbol for each in periodic for symbol in _symbols_of(each)]
    if arcs := reading.arcs(problem):
        changed["guess"] = {**arcs, **changed.get("guess", problem.guess)}
    if reading.conditions:
        changed["end_conditions"] = _with(problem.end_conditions, reading.conditions, "end of a rotation")
    constraints = getattr(problem, "constraint", ())
    spheres = spheres_in(problem.lagrangian)
    for sphere in spheres:
        if not sphere.velocities:
            finding = f"lagrangian contains {sphere.name}, an attitude of first-order dynamics"
            raise ExpressionError(finding, f'declare it with its angular velocity, by rotation("{sphere.name}")')
    written = constraints.values() if isinstance(constraints, Mapping) else constraints
    if isinstance(constraints, (list, tuple, Mapping)):
        missing = [sphere for sphere in spheres if sphere.constraint not in [*written]]
        if missing:
            lengths = [sphere.constraint for sphere in missing]
            changed["constraint"] = _with(constraints, lengths, "length of a quaternion")
            terms = (_radial_energy(problem.lagrangian, sphere) for sphere in missing)
            changed["lagrangian"] = sympy.Add(problem.lagrangian, *terms)
    return changed


def jumps_in_coordinates(jumps: Sequence[Mapping[object, object]]) -> Sequence[Mapping[object, object]]:
    """Return the jumps of phases with matrices, which are keys, written out in coordinates.

    Components of a vector that do not change are left out. Raise the errors of `in_coordinates`.
    """
    if not isinstance(jumps, (list, tuple)):
        return jumps
    return [
        {key: value for key, value in _Reading().components("jumps", jump) if key in jump or key != value}
        if isinstance(jump, Mapping)
        else jump
        for jump in jumps
    ]


def _with(written: object, more: Sequence[Expr], name: str) -> object:
    """Return relations with more of them: a list, or a mapping with names; other values as they are."""
    if isinstance(written, Mapping):
        return {**written, **{f"{name} {number}": each for number, each in enumerate(more, 1)}}
    return [*written, *more] if isinstance(written, (list, tuple)) else written


def _radial_energy(lagrangian: Expr, sphere: Sphere) -> Expr:
    """Return the square of q . dq times the mean inertia of a rotation at the identity; zero for a unit vector."""
    if not sphere.is_attitude:
        return sympy.S.Zero
    masses = sympy.Add(*(sympy.diff(lagrangian, v, 2) for v in sphere.velocities))
    mean = sympy.simplify(masses.subs(dict(zip(sphere.coordinates, (1, 0, 0, 0), strict=True)))) / 3
    return mean * sphere.radial_velocity**2 / 2


def _symbols_of(key: object) -> list[object]:
    """Return the coordinates or velocities of a rotation or vector, or the single symbol itself."""
    if not isinstance(key, MatrixBase):
        return [key]
    attitude, spinning = _attitude(key), _spinning(key)
    if attitude is not None:
        return [*attitude.coordinates]
    return [*spinning.velocities] if spinning is not None else [*key]


class _Reading:
    """The arguments of a problem, written out one after the other.

    `conditions` must vanish at the end. `ends` has the values of rotations and unit vectors at the "start" and the
    "end", `spins` their angular velocities or velocities, and `axes` those axes of rotation that are written there.
    """

    def __init__(self) -> None:
        self.conditions: list[Expr] = []
        self.ends: dict[str, dict[Sphere, tuple[Expr, ...]]] = {"start": {}, "end": {}}
        self.spins: dict[str, dict[Sphere, tuple[Expr, ...]]] = {"start": {}, "end": {}}
        self.axes: dict[Sphere, tuple[Expr, ...]] = {}
        self.guessed: set[Sphere] = set()

    def components(self, what: str, mapping: Mapping[object, object]) -> Iterator[tuple[object, object]]:
        """Yield symbols and values of the argument `what` in place of matrices and their values."""
        attitudes = self.ends.get(what, {})
        for key, value in mapping.items():
            sphere = _attitude(key)
            if sphere is not None and (what in self.ends or what == "jumps"):
                attitudes[sphere] = quaternion_of(value, f"{what} of {sphere.name}")
                if isinstance(value, (list, tuple)) and len(value) == 2:
                    self.axes[sphere] = tuple(value[0])
            elif sphere is None and isinstance(key, MatrixBase) and what in (*self.ends, "guess"):
                for unit in (unit for unit in spheres_in(key) if unit.coordinates == tuple(key)):
                    name = f"{what} of {unit.name}"
                    values = vector(value, name)
                    attitudes[unit] = _of_length_one(values, name, "a unit vector") if what in self.ends else values
                    self.guessed |= {unit} if what == "guess" else set()
        for key, value in mapping.items():
            if not isinstance(key, MatrixBase):
                yield key, value
                continue
            sphere, spinning = _attitude(key), _spinning(key)
            name = sphere.name if sphere else f"the angular velocity of {spinning.name}" if spinning else _short([*key])
            if what in ("bounds", "scale"):
                remedy = "bound parts by path=[... <= ...]" if what == "bounds" else "give the scale of each symbol"
                if all(isinstance(entry, Quantity) for entry in key):
                    remedy = f"give one entry for each symbol, as in {what}={{{key[0]}: ...}}"
                raise ExpressionError(f"{what} has the key {name}, which is no number", remedy)
            if (sphere and what in ("periodic", "history")) or (spinning and what not in (*self.ends, "jumps")):
                remedies = {"guess": "guess the attitude", "force": "give the torque as force={R: torque}"}
                instead = remedies.get(what, "give the coordinates, or a list [R, omega]")
                raise SymbolError(f"{what} has the key {name}", instead)
            if sphere is not None:
                yield from zip(sphere.coordinates, self._of_attitude(what, sphere, value), strict=False)
            elif spinning is not None:
                rates = vector(value, f"{what} of {name}")
                self.spins.get(what, {})[spinning] = rates
                if spinning in attitudes or what == "jumps":
                    half = product(attitudes.get(spinning, spinning.coordinates), (sympy.S.Zero, *rates))
                    yield from zip(spinning.velocities, (part / 2 for part in half), strict=True)
                elif what == "start":
                    raise BoundaryError(f"start has {name} without the attitude", f"add {spinning.name}: ... to start")
                else:
                    self.conditions += [own - wanted for own, wanted in zip(key, rates, strict=True)]
            elif all(isinstance(entry, Quantity) for entry in key):
                values = vector(value, f"{what} of {name}", len(key))
                for unit in spheres_in(key):
                    if unit.coordinates == tuple(key):
                        values = attitudes.get(unit, values)
                    elif unit.velocities == tuple(key) and what in self.ends:
                        if unit in attitudes:
                            values = _along_sphere(values, attitudes[unit], f"{what} of the velocity of {unit.name}")
                        self.spins[what][unit] = values
                yield from zip(key, values, strict=True)
            else:
                raise SymbolError(
                    f"{what} has the key {name}, which was never declared",
                    "use the matrices that rotation(...), pose(...) or direction(...) returned",
                )

    def _of_attitude(self, what: str, sphere: Sphere, value: object) -> tuple[Expr, ...]:
        """Return the components of a quaternion, its force or its derivative; none if conditions are added."""
        if what == "force":
            torque, squares = vector(value, f"the torque on {sphere.name}"), squared_length(sphere.coordinates)
            return tuple(2 * part / squares for part in product(sphere.coordinates, (sympy.S.Zero, *torque)))
        if what == "dynamics":
            rates = vector(value, f"the angular velocity of {sphere.name}")
            return tuple(part / 2 for part in product(sphere.coordinates, (sympy.S.Zero, *rates)))
        if what == "guess":
            self.guessed.add(sphere)
            return quaternion_of(value, f"guess of {sphere.name}")
        if what == "jumps":
            return quaternion_of(value, f"jumps of {sphere.name}")
        if what == "end" and not sphere.velocities:  # the length of a quaternion of states follows from its dynamics
            self.conditions += product(conjugate(self.ends["end"][sphere]), sphere.coordinates)[1:]
            return ()
        return self.ends[what][sphere]

    def arcs(self, problem: Any) -> dict[Coordinate | State, Expr]:
        """Return guesses along the sphere from the values at the start to those at the end.

        Straight lines, which other coordinates have, would pass near the centre of the sphere between nearly opposite
        values. Opposite values are joined by a turn about the axis that is written at the end. If the end has no value,
        the guess moves with the velocities on the line between those at both ends.
        """
        arcs = dict[Coordinate | State, Expr]()
        for sphere, first in self.ends["start"].items() if _is_duration(problem.duration) else ():
            last, spin, last_spin = self.ends["end"].get(sphere), *(each.get(sphere) for each in self.spins.values())
            if sphere in self.guessed:
                continue
            if last is not None:
                arcs |= _arc(sphere, first, last, _NOW / problem.duration, self.axes.get(sphere, (1, 0, 0)))
            elif spin is not None and last_spin is not None:
                arcs |= _turn(sphere, first, spin, last_spin, problem.duration)
        return _in_time(arcs, problem)


def phases_with_arcs(phases: Sequence[Any], jumps: object) -> tuple[Any, ...]:
    """Return the phases of a problem with guesses of rotations and unit vectors along the sphere.

    A guess leads from a prescribed value to the next one, which may be at the end of a later phase.
    """
    changed = list(phases)
    ends = [getattr(phase, "end", None) for phase in phases]
    if not phases or not all(isinstance(each, Mapping) for each in (getattr(phases[0], "start", None), *ends)):
        return tuple(changed)
    if not all(_is_duration(phase.duration) for phase in phases):
        return tuple(changed)
    mappings = [jump for jump in jumps if isinstance(jump, Mapping)] if isinstance(jumps, (list, tuple)) else []
    jumping = {key for jump in mappings for key in jump}
    times = [sympy.Add(*(phase.duration for phase in phases[:i])) for i in range(len(phases) + 1)]
    values = [phases[0].start, *(phase.end for phase in phases)]
    for sphere in spheres_in(*(sympy.sympify(key) for each in values for key in each if isinstance(key, Quantity))):
        qs = sphere.coordinates
        known = [(i, [each[q] for q in qs]) for i, each in enumerate(values) if {*qs} <= {*each}]
        for (i, first), (j, last) in pairwise(known):
            if jumping & {*qs}:
                continue
            for k in range(i, j):
                guess = changed[k].guess
                if isinstance(guess, Mapping) and not {*qs} & {*guess}:
                    part = (_NOW - times[i]) / (times[j] - times[i])
                    arc = _arc(sphere, first, last, part, (1, 0, 0))
                    changed[k] = replace(changed[k], guess={**_in_time(arc, phases[k]), **guess})
    return tuple(changed)


def _is_duration(value: object) -> bool:
    """Return True for a number other than zero, or an expression; the duration of a problem is checked later."""
    return _is_number(value) and value != 0


def _arc(
    sphere: Sphere, first: Sequence[Expr], last: Sequence[Expr], part: Expr, axis: Sequence[Expr]
) -> dict[Coordinate | State, Expr]:
    """Return the great circle between two points; {} for nearly equal points, and for points with parameters.

    `axis` is the axis of the turn between opposite quaternions. Opposite unit vectors are joined by any half circle.
    """
    if any(sympy.sympify(x).free_symbols for x in (*first, *last)):
        return {}
    a, b = (np.array(point, dtype=float) for point in (first, last))
    angle = math.acos(min(1.0, max(-1.0, float(a @ b))))
    if angle < _STRAIGHT:
        return {}
    if math.pi - angle < _STRAIGHT:
        last, angle = _across(sphere, a, axis), math.pi / 2
        part = 2 * part
    weights = (sympy.sin((1 - part) * angle) / math.sin(angle), sympy.sin(part * angle) / math.sin(angle))
    return {q: weights[0] * x + weights[1] * y for q, x, y in zip(sphere.coordinates, first, last, strict=True)}


def _turn(
    sphere: Sphere, first: Sequence[Expr], spin: Sequence[Expr], last_spin: Sequence[Expr], duration: Expr
) -> dict[Coordinate | State, Expr]:
    """Return the motion from a point of a sphere with velocities on the line between those at both ends.

    Return {} for a motion at rest, and for a unit vector that does not come to rest: its last velocity has a tangent
    plane that is not known.
    """
    turn = [a * _NOW + (b - a) * _NOW**2 / (2 * duration) for a, b in zip(spin, last_spin, strict=True)]
    if not any(turn) or not (sphere.is_attitude or not any(last_spin)):
        return {}
    angle = sympy.sqrt(squared_length(turn))
    if sphere.is_attitude:
        half = [part / 2 * sympy.sinc(angle / 2) for part in turn]
        return dict(zip(sphere.coordinates, product(first, (sympy.cos(angle / 2), *half)), strict=True))
    point = (sympy.cos(angle) * x + sympy.sinc(angle) * part for x, part in zip(first, turn, strict=True))
    return dict(zip(sphere.coordinates, point, strict=True))


def _across(sphere: Sphere, point: NDArray[np.float64], axis: Sequence[Expr]) -> tuple[float, ...]:
    """Return a unit vector that is perpendicular to a point of a sphere."""
    if sphere.is_attitude:
        unit = np.array(axis, dtype=float)
        return tuple(float(part) for part in product((0.0, *unit / np.linalg.norm(unit)), point.tolist()))
    along = np.eye(3)[np.abs(point).argmin()]
    across = along - (along @ point) * point
    return tuple(across / np.linalg.norm(across))


def _in_time(guess: dict[Coordinate | State, Expr], problem: object) -> dict[Coordinate | State, Expr]:
    """Return a guess in the time symbol of a problem, which is declared if the guess moves and the problem has none."""
    if not any(value.has(_NOW) for value in guess.values()):
        return guess
    written = [
        getattr(problem, name, 0) for name in ("lagrangian", "cost", "terminal_cost", "force", "dynamics", "guess")
    ]
    values = [value for each in written for value in (each.values() if isinstance(each, Mapping) else [each])]
    symbols = (s for value in values for s in getattr(value, "free_symbols", ()))
    now = next((s for s in symbols if isinstance(s, Time)), None) or time()
    return {q: value.xreplace({_NOW: now}) for q, value in guess.items()}


def _attitude(key: object) -> Sphere | None:
    """Return the rotation whose matrix is a key."""
    if isinstance(key, MatrixBase) and key.shape == (3, 3):
        return next((s for s in spheres_in(key) if s.is_attitude and s.matrix == key), None)
    return None


def _spinning(key: object) -> Sphere | None:
    """Return the rotation whose angular velocity is a key."""
    if isinstance(key, MatrixBase) and key.shape == (3, 1):
        return next((s for s in spheres_in(key) if s.is_attitude and s.angular_velocity == key), None)
    return None


def vector(value: object, what: str, length: int = 3) -> tuple[Expr, ...]:
    """Return the components of a vector; raise BoundaryError with the name `what` for other values."""
    parts = tuple(value) if isinstance(value, (list, tuple, np.ndarray, MatrixBase)) else ()
    if len(parts) != length or not all(map(_is_number, parts)):
        raise BoundaryError(f"{what} is {_short(value)}", f"give a vector of {length} real numbers or expressions")
    return tuple(map(sympy.sympify, parts))


def _is_number(value: object) -> bool:
    """Return True for a finite real number, or an expression that may be one."""
    if isinstance(value, Expr):
        return value.is_finite is not False and value.is_extended_real is not False
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and bool(np.isfinite(value))


def quaternion_of(value: object, what: str) -> tuple[Expr, ...]:
    """Return the unit quaternion of an attitude: a matrix, a quaternion, or a pair of an axis and an angle.

    Raise BoundaryError with the name `what` for a value that is no attitude.
    """
    if isinstance(value, MatrixBase) and value.shape == (3, 3):
        value = value.tolist()
    is_matrix = isinstance(value, MatrixBase) and 1 not in value.shape
    if is_matrix or not isinstance(value, (list, tuple, np.ndarray, MatrixBase)):
        raise BoundaryError(f"{what} is {_short(value)}", f"give {_ATTITUDE}")
    parts = list(value)
    if len(parts) == 2:
        axis = vector(parts[0], f"the axis in {what}")
        angle = parts[1]
        if not _is_number(angle):
            raise BoundaryError(f"the angle in {what} is {_short(angle)}", f"give {_ATTITUDE}")
        length = sympy.sqrt(sympy.Add(*(part**2 for part in axis)))
        if length == 0:
            raise BoundaryError(f"the axis in {what} has length zero", "give the direction of the axis")
        half = sympy.sympify(angle) / 2
        return (sympy.cos(half), *(sympy.sin(half) * part / length for part in axis))
    if len(parts) == 4:
        quaternion = vector(parts, what, 4)
        return _of_length_one(quaternion, f"the quaternion in {what}", "a quaternion of length one")
    if len(parts) == 3 and all(isinstance(row, (list, tuple, np.ndarray)) and len(row) == 3 for row in parts):
        from scipy.spatial.transform import Rotation as Attitude

        entries = [vector(row, f"a row of {what}") for row in parts]
        if symbols := {symbol for row in entries for entry in row for symbol in entry.free_symbols}:
            names = ", ".join(names_of(sorted(symbols, key=str)))
            raise BoundaryError(f"the matrix in {what} depends on {names}", "give an axis and an angle")
        numbers = np.array(entries, dtype=float)
        error = float(np.abs(numbers.T @ numbers - np.eye(3)).max())
        if not error <= _NEARLY:
            raise BoundaryError(
                f"{what} is no rotation: R.T @ R differs from the identity by {error:.3g}", f"give {_ATTITUDE}"
            )
        if np.linalg.det(numbers) < 0.0:
            raise BoundaryError(f"{what} is a reflection, whose determinant is -1", f"give {_ATTITUDE}")
        x, y, z, w = map(sympy.Float, Attitude.from_matrix(numbers).as_quat(canonical=True))
        return _of_length_one((w, x, y, z), what, "a quaternion of length one")
    raise BoundaryError(f"{what} is {_short(value)}", f"give {_ATTITUDE}")


def _of_length_one(parts: tuple[Expr, ...], name: str, wanted: str) -> tuple[Expr, ...]:
    length = sympy.sqrt(sympy.Add(*(part**2 for part in parts)))
    if length.is_number and abs(float(length) - 1.0) > _NEARLY:
        raise BoundaryError(f"{name} has the length {float(length):.6g}", f"give {wanted}")
    is_rounded = length.is_number and abs(float(length) - 1.0) > 4.0 * sys.float_info.epsilon
    return tuple(part / length for part in parts) if is_rounded else parts


def _along_sphere(velocity: tuple[Expr, ...], vector: Sequence[Expr], name: str) -> tuple[Expr, ...]:
    """Return the part of a velocity perpendicular to its unit vector; the other part must be rounding."""
    along = sympy.Add(*(a * b for a, b in zip(velocity, vector, strict=True)))
    if not along.is_number or not sympy.Add(*velocity).is_number:
        return velocity
    size = math.sqrt(sum(float(part) ** 2 for part in velocity))
    if abs(float(along)) > _NEARLY * size:
        raise BoundaryError(
            f"{name} has the component {float(along):.6g} along the unit vector", "give a velocity perpendicular to it"
        )
    return tuple(a - along * b for a, b in zip(velocity, vector, strict=True))


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:60]} ..."


def squared_length(vector: Sequence[Expr]) -> Expr:
    """Return |q|^2."""
    return sympy.Add(*(part**2 for part in vector))


def rotation_matrix(quaternion: Sequence[Expr]) -> ImmutableMatrix:
    """Return the rotation (3, 3) from the frame of the body to the frame of space; |q| has no effect."""
    w, x, y, z = quaternion
    rows = [
        [w**2 + x**2 - y**2 - z**2, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w**2 - x**2 + y**2 - z**2, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w**2 - x**2 - y**2 + z**2],
    ]
    return ImmutableMatrix([[entry / squared_length(quaternion) for entry in row] for row in rows])


def angular_velocity(quaternion: Sequence[Expr], velocities: Sequence[Expr]) -> list[Expr]:
    """Return the angular velocity 2 Im(q* dq) / |q|^2 (3,) in the frame of the body."""
    _, *imaginary = product(conjugate(quaternion), velocities)
    return [2 * part / squared_length(quaternion) for part in imaginary]


def product(left: Sequence[Expr], right: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the product of two quaternions (w, x, y, z)."""
    a, b = (Matrix([0, 0, 0]) + Matrix(each[1:]) for each in (left, right))
    imaginary = left[0] * b + right[0] * a + a.cross(b)
    return (left[0] * right[0] - a.dot(b), *imaginary)


def conjugate(quaternion: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return (w, -x, -y, -z)."""
    return (quaternion[0], *(-part for part in quaternion[1:]))
