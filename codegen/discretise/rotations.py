"""One step of a simulation with rotations: a Lie group variational integrator with three unknowns for each attitude.

The attitude of a body is a unit quaternion q, and w is its angular velocity in the frame of the body during the step:

    q_k1 = q_k c,    c = (1 - |b|^2, 2 b) / (1 + |b|^2),    b = h w/4.

The retraction is the square of Cayley's map, |h w| = 4 tan(angle/4). The discrete Lagrangian is the quadrature of
L(x, v, q, w) at the points of the scheme, where x moves along a straight line with the velocity v, and the attitude is
q_k at the left node, q_k (1, b) in the middle, and q_k1 at the right node. Its forced discrete Euler-Lagrange equations
in the frame of the body, with mu = dL/dw and with the torque M of forces and of the potential, are

    pi_k  = (1 - |b|^2) mu + 2 b x mu + 2 b (b . mu) - h/2 (M + b x M),
    pi_k1 = (1 - |b|^2) mu - 2 b x mu + 2 b (b . mu) + h/2 (M - b x M)

for the midpoint rule. The state has the momentum p = 2 q pi of the quaternion, which is perpendicular to q. Further
holonomic constraints, and rolling constraints, have impulses at both nodes, as in `simulation`. The equations have
neither a singular attitude nor a multiplier for the length of q.

Sources: Lee, Leok and McClamroch (2007), Lie group variational integrators for the full body problem in orbital
mechanics; Bou-Rabee and Marsden (2009), Hamilton-Pontryagin integrators on Lie groups; Schaub and Junkins (1996),
Stereographic orientation parameters for attitude dynamics, for the derivative of b.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import sympy
from sympy import Add, Expr, Matrix, S, Symbol

from codegen.discretise.conditions import holonomic
from codegen.discretise.interval import STEP, at_nodes
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.relations import text
from codegen.discretise.program import Names, symbols
from codegen.discretise.schemes.base import Scheme
from codegen.problem.rotations import angular_velocity, conjugate, product, squared_length
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.parts import replaced

Equation = tuple[str, Expr]


@dataclass(frozen=True)
class StepEquations:
    """The equations of a step for the `unknowns`, in the same order, and their initial guesses.

    `written` are the equations in textbook form, with their names, for the `stages` and the right node.
    """

    equations: tuple[Expr, ...]
    unknowns: tuple[Symbol, ...]
    guesses: dict[Symbol, Expr]
    written: tuple[Equation, ...]
    stages: tuple[Symbol, ...]


class _Attitude:
    """The attitude of one body in a step: quaternions at both nodes, w, b and c."""

    def __init__(self, coordinates: tuple[Symbol, ...], names: Names) -> None:
        self.coordinates = coordinates
        self.left, self.right = at_nodes(coordinates, "_k"), at_nodes(coordinates, "_k1")
        stems = [names.named("omega", q) for q in coordinates[1:]]
        self.rates = symbols(stems, "_k")
        self.rates_right = symbols(stems, "_k1")
        self.b = Matrix([STEP * w / 4 for w in self.rates])
        self.square = Add(*(STEP**2 * w**2 / 16 for w in self.rates))
        self.turn: list[Expr] = [part / (1 + self.square) for part in (1 - self.square, *(2 * self.b))]

    def at(self, c: Expr) -> dict[Expr, Expr]:
        """Return the substitution for the quaternion, and for its squared length, at the fraction c of the step."""
        factors: dict[Expr, Sequence[Expr]] = {
            S.Zero: (S.One, *(S.Zero,) * 3),
            S.Half: (S.One, *self.b),
            S.One: self.turn,
        }
        quaternion = product(self.left, factors[c])
        length = 1 + self.square if c == S.Half else S.One
        return {squared_length(self.coordinates): length, **dict(zip(self.coordinates, quaternion, strict=True))}

    def momenta(self, mu: Matrix, sign: int) -> Matrix:
        """Return the part of pi_k (sign 1) or pi_k1 (sign -1) that belongs to mu = dL/dw."""
        return (1 - self.square) * mu + 2 * sign * self.b.cross(mu) + 2 * self.b.dot(mu) * self.b

    def torque(self, moment: Matrix, c: Expr, sign: int) -> Matrix:
        """Return the moment at the fraction c in the frame of the body at the left node (sign 1) or the right (-1)."""
        return (moment + sign * self.b.cross(moment)) / 2 if c == S.Half else moment * (c if sign < 0 else 1 - c)

    def body_momentum(self, momenta: Sequence[Expr]) -> Matrix:
        """Return pi_k of the momenta p_k of the quaternion."""
        return half_imaginary(self.left, momenta)


def half_imaginary(left: Sequence[Expr], right: Sequence[Expr]) -> Matrix:
    """Return half the imaginary part of the product q* f: the moment of a force f on a quaternion."""
    return Matrix(product(conjugate(left), right)[1:]) / 2


def in_body_rates(model: Model, function: Expr, rates: Mapping[tuple[Symbol, ...], Sequence[Symbol]]) -> Expr:
    """Return a function of x, v, q and the angular velocities `rates` of all attitudes, without the velocities of q."""
    velocity = dict(zip(model.coordinates, model.rates, strict=True))
    for quaternion, omega in rates.items():
        moving = [velocity[q] for q in quaternion]
        length = squared_length(quaternion)
        # An author writes L in omega = numerator/|q|^2, and the numerator is a sum that sympy leaves as it is.
        numerators = [part * length for part in angular_velocity(quaternion, moving)]
        function = replaced(function, {n: w * length for n, w in zip(numerators, omega, strict=True)})
        function = replaced(function, {Add(*(q * v for q, v in zip(quaternion, moving, strict=True))): S.Zero})
        turning = product(quaternion, (S.Zero, *omega))
        function = replaced(function, {v: part / 2 for v, part in zip(moving, turning, strict=True)})
    return function


def in_body_frames(model: Model) -> Model:
    """Return a Lagrangian model whose rates are the velocities of positions and the angular velocities of attitudes.

    The imaginary parts of a quaternion are the coordinates in the places of the angular velocity; the real part is a
    parameter. The rates are no time derivatives of these coordinates, but the Legendre transform is that of a body:
    momenta are those of positions, and the angular momenta in the frames of the bodies.
    """
    turning = {q for quaternion in model.rotations for q in quaternion}
    pairs = [(x, v) for x, v in zip(model.coordinates, model.rates, strict=True) if x not in turning]
    names, rates = Names(model), dict[tuple[Symbol, ...], tuple[Symbol, ...]]()
    for quaternion in model.rotations:
        rates[quaternion] = tuple(Symbol(names.named("omega", q), real=True) for q in quaternion[1:])
        pairs += zip(quaternion[1:], rates[quaternion], strict=True)
    free = (None,) * len(pairs)
    return replace(
        model,
        coordinates=tuple(x for x, _ in pairs),
        rates=tuple(v for _, v in pairs),
        parameters=(*model.parameters, *(quaternion[0] for quaternion in model.rotations)),
        defaults=(*model.defaults, *(1.0 for _ in model.rotations)),
        function=in_body_rates(model, model.function, rates),
        force=(S.Zero,) * len(pairs),
        start=Boundary(free, free),
        end=None,
        holonomic=(),
        rolling=(),
        rotations=(),
    )


def in_quaternions(model: Model, momenta: Sequence[Symbol]) -> dict[Symbol, Expr]:
    """Return the momenta of `in_body_frames` in terms of the momenta of the model, in the order of its coordinates."""
    own = dict(zip(model.coordinates, momenta, strict=True))
    return {
        own[q]: part
        for quaternion in model.rotations
        for q, part in zip(
            quaternion[1:], half_imaginary(quaternion, [own[q] for q in quaternion]), strict=True
        )
    }  # fmt: skip


def velocities_of(model: Model, body_rates: Sequence[Expr], momenta: Sequence[Symbol]) -> list[Expr]:
    """Return the velocities of all coordinates of a model for rates in the order of `in_body_frames`.

    The momentum of a quaternion along itself, which is zero along every motion, belongs to the velocity along itself.
    """
    turning = {q for quaternion in model.rotations for q in quaternion}
    places = [x for x in model.coordinates if x not in turning]
    velocity: dict[Symbol, Expr] = dict(zip(places, body_rates, strict=False))
    own = dict(zip(model.coordinates, momenta, strict=True))
    for i, quaternion in enumerate(model.rotations):
        omega = body_rates[len(places) + 3 * i : len(places) + 3 * i + 3]
        # The inertia of a change of the length of a quaternion, at the identity and without other velocities.
        real = dict(zip(model.coordinates, model.rates, strict=True))[quaternion[0]]
        identity: dict[Expr, Expr] = dict(zip(quaternion, (S.One, S.Zero, S.Zero, S.Zero), strict=True))
        along = Add(*(q * own[q] for q in quaternion)) / sympy.diff(model.function, real, 2).xreplace(identity)
        for q, part in zip(quaternion, product(quaternion, (S.Zero, *omega)), strict=True):
            velocity[q] = part / 2 + along * q
    return [velocity[q] for q in model.coordinates]


def step_with_rotations(
    model: Model, scheme: Scheme, left: Sequence[Symbol], right: Sequence[Symbol], left_rates: Sequence[Expr]
) -> StepEquations:
    """Return the equations of one step of a model with `rotations`, in position-momentum form.

    `left` and `right` are the symbols (q, p) of both nodes, and `left_rates` the rates of `in_body_frames` at the left
    node. Raises SchemeError for a scheme with inner points.
    """
    rule = scheme.discrete_lagrangian()
    holonomic.require_no_inner_points(model, rule.nodes[1:-1], scheme.name)
    names, count = Names(model), len(model.coordinates)
    at_left, at_right = (dict(zip(model.coordinates, side, strict=False)) for side in (left, right))
    p_left, p_right = (dict(zip(model.coordinates, side[count:], strict=True)) for side in (left, right))
    bodies = [_Attitude(quaternion, names) for quaternion in model.rotations]
    turning = {q for body in bodies for q in body.coordinates}
    straight = [i for i, q in enumerate(model.coordinates) if q not in turning]
    places, speeds = [model.coordinates[i] for i in straight], [model.rates[i] for i in straight]
    v = at_nodes(speeds, "_k")
    body_rates = {body.coordinates: body.rates for body in bodies}
    function = in_body_rates(model, model.function, body_rates)
    force = {
        q: in_body_rates(model, f, body_rates) for q, f in zip(model.coordinates, model.force, strict=True)
    }  # fmt: skip
    mu = [Matrix([0, 0, 0]) for _ in bodies]
    push = [S.Zero for _ in places]
    moments = {sign: [Matrix([0, 0, 0]) for _ in bodies] for sign in (1, -1)}
    kicks = {sign: [S.Zero for _ in places] for sign in (1, -1)}
    points = []
    for point in rule.points:
        c = sympy.nsimplify(point.abscissa)
        here: dict[Expr, Expr] = {x: at_left[x] + c * STEP * y for x, y in zip(places, v, strict=True)}
        here |= dict(zip(speeds, v, strict=True)) | {model.time: model.time + c * STEP}
        lengths = dict[Expr, Expr]()
        for body in bodies:
            turned = body.at(c)
            length = squared_length(body.coordinates)
            lengths[length] = turned.pop(length)
            here |= turned
        points.append((c, point.weight, partial(_at_point, lengths, here)))
    slips = [in_body_rates(model, each, body_rates) for each in model.rolling]
    means = [Add(*(weight * value(slip) for _, weight, value in points)) for slip in slips]
    joints = _Joints(model, bodies, places, speeds, function, names, at_right, p_right, slips, means)
    for c, weight, value in points:
        for i, body in enumerate(bodies):
            mu[i] += weight * Matrix([value(slope) for slope in gradient(function, body.rates)])
            # The length of q counts as constant, because a change of it does no work.
            dummy = Symbol("length")
            length = squared_length(body.coordinates)
            slopes = gradient(function.xreplace({length: dummy}), body.coordinates)
            pulls = [s.xreplace({dummy: length}) + force[q] for s, q in zip(slopes, body.coordinates, strict=True)]
            moment = weight * STEP * Matrix([value(part) for part in half_imaginary(body.coordinates, pulls)])
            for sign, total in moments.items():
                total[i] += body.torque(moment, c, sign)
        for j, (x, speed) in enumerate(zip(places, speeds, strict=True)):
            push[j] += weight * value(sympy.diff(function, speed))
            pull = weight * STEP * value(sympy.diff(function, x) + force[x])
            kicks[1][j] += (1 - c) * pull
            kicks[-1][j] += c * pull
    equations, written = list[Expr](), list[Equation]()
    unknowns = [*v, *(w for body in bodies for w in body.rates)]
    for j, x in enumerate(places):
        equation = p_left[x] + joints.left_impulse(x) - push[j] + kicks[1][j]
        equations.append(equation)
        written.append((f"left momentum of {x}", joints.in_forces(equation)))
    for i, body in enumerate(bodies):
        own = body.body_momentum([p_left[q] for q in body.coordinates])
        rows = own + joints.left_moment(body) - body.momenta(mu[i], 1) + moments[1][i]
        equations += list(rows)
        written += [(f"left momentum of {w}", joints.in_forces(e)) for w, e in zip(body.rates, rows, strict=True)]
    arrivals = list[tuple[Symbol, Expr]]()
    for x, y in zip(places, v, strict=True):
        arrivals.append((at_right[x], at_left[x] + STEP * y))
    exact = [*arrivals]
    for body in bodies:
        reached = product(body.left, body.turn)
        exact += zip(body.right, reached, strict=True)
        # One step of Newton's method for the length one, so that rounding errors do not add up.
        length = (3 - squared_length(reached)) / 2
        arrivals += [(q, length * part) for q, part in zip(body.right, reached, strict=True)]
    equations += [q - value for q, value in arrivals]
    written += [(f"step of {q}", q - value) for q, value in exact]
    unknowns += [q for q, _ in arrivals]
    for j, x in enumerate(places):
        equation = p_right[x] - joints.right_impulse(x) - push[j] - kicks[-1][j]
        equations.append(equation)
        written.append((f"right momentum of {x}", joints.in_forces(equation)))
        unknowns.append(p_right[x])
    for i, body in enumerate(bodies):
        own = body.momenta(mu[i], -1) + moments[-1][i] + joints.right_moment(body)
        momentum = product(body.right, (S.Zero, *own))
        for q, part in zip(body.coordinates, momentum, strict=True):
            equations.append(p_right[q] - 2 * part)
            written.append((f"right momentum of {q}", joints.in_forces(equations[-1])))
            unknowns.append(p_right[q])
    spins = [w for body in bodies for w in body.rates]
    guesses: dict[Symbol, Expr] = dict(zip((*v, *spins), left_rates, strict=True))
    guesses |= {q1: at_left[q] for q, q1 in at_right.items()} | {p_right[q]: p_left[q] for q in model.coordinates}
    guesses |= joints.guesses(left_rates)
    return StepEquations(
        equations=(*equations, *joints.solved),
        unknowns=(*unknowns, *joints.unknowns),
        guesses=guesses,
        written=(*written, *joints.written),
        stages=(*v, *spins, *joints.stages),
    )


def _at_point(lengths: Mapping[Expr, Expr], here: Mapping[Expr, Expr], expression: Expr) -> Expr:
    return replaced(replaced(expression, lengths), here)


class _Joints:
    """The constraints besides the lengths of quaternions, with impulses h/2 kappa at both nodes.

    Holonomic constraints come first, then the rolling constraints `slips`, in the rates of bodies, with their `means`
    on the step.

    `solved` are equations for the `unknowns`, in the same order: impulses at the left node, velocities and angular
    velocities at the right node, impulses there, and the forces kappa. `written` are those for the `stages`.
    """

    def __init__(
        self,
        model: Model,
        bodies: Sequence[_Attitude],
        places: Sequence[Symbol],
        speeds: Sequence[Symbol],
        function: Expr,
        names: Names,
        at_right: Mapping[Symbol, Symbol],
        p_right: Mapping[Symbol, Symbol],
        slips: Sequence[Expr],
        means: Sequence[Expr],
    ) -> None:
        lengths = [squared_length(body.coordinates) - 1 for body in bodies]
        held = [c for c in model.holonomic if c not in lengths]
        self.constraints = [*held, *slips]
        self.model, self.places, self.slips = model, places, slips
        self.speeds = dict(zip(places, speeds, strict=True))
        kappa = [names.numbered("kappa") for _ in self.constraints]
        numbered = [names.numbered("impulse") for _ in self.constraints]
        self._kappa = {mark: symbols(kappa, mark) for mark in ("_k", "_k1")}
        self._impulse = {mark: symbols(numbered, mark) for mark in ("_k", "_k1")}
        self.force_of = {
            k: 2 * i / STEP
            for mark in ("_k", "_k1")
            for k, i in zip(self._kappa[mark], self._impulse[mark], strict=True)
        }
        self._speeds = at_nodes(speeds, "_k1") if self.constraints else ()
        self._spins = tuple(w for body in bodies for w in body.rates_right) if self.constraints else ()
        self.unknowns, self.stages = tuple[Symbol, ...](), tuple[Symbol, ...]()
        self.solved, self.written = list[Expr](), list[Equation]()
        if not self.constraints:
            return
        here: dict[Expr, Expr] = {**at_right, **dict(zip(speeds, self._speeds, strict=True))}
        here[model.time] = model.time + STEP
        for body in bodies:
            here |= dict(zip(body.rates, body.rates_right, strict=True))
        positions = [*(c.xreplace(here) / STEP for c in held), *means]
        rates = []
        for c in held:
            moving = [sympy.diff(c, x) * speed for x, speed in zip(places, speeds, strict=True)]
            moving += [self._slope(c, body).dot(Matrix(body.rates)) for body in bodies]
            rates.append(Add(sympy.diff(c, model.time), *moving).xreplace(here))
        rates += [slip.xreplace(here) for slip in slips]
        titles = [*(f"constraint {text(c)}" for c in held), *(f"mean of {text(c)}" for c in model.rolling)]
        leaving = [*(f"rate of constraint {text(c)}" for c in held), *map(text, model.rolling)]
        transforms = [
            (y, p_right[x] - sympy.diff(function, speed).xreplace(here))
            for x, speed, y in zip(places, speeds, self._speeds, strict=True)
        ]
        for body in bodies:
            own = half_imaginary(body.right, [p_right[q] for q in body.coordinates])
            slopes = [sympy.diff(function, w).xreplace(here) for w in body.rates]
            transforms += zip(body.rates_right, [p - s for p, s in zip(own, slopes, strict=True)], strict=True)
        self.stages = (*self._kappa["_k"], *self._speeds, *self._spins, *self._kappa["_k1"])
        self.unknowns = (*self._impulse["_k"], *self._speeds, *self._spins, *self._impulse["_k1"], *self.force_of)
        self.written = [
            *zip(titles, positions, strict=True),
            *((f"{y} of momenta", value) for y, value in transforms),
            *zip(leaving, rates, strict=True),
        ]
        self.solved = [
            *positions,
            *(value for _, value in transforms),
            *rates,
            *(k - value for k, value in self.force_of.items()),
        ]

    def _slope(self, constraint: Expr, body: _Attitude) -> Matrix:
        """Return the derivative of a constraint along rotations of a body in its frame, or the coefficients of w."""
        if constraint in self.slips:
            return Matrix(gradient(constraint, body.rates))
        return half_imaginary(body.coordinates, gradient(constraint, body.coordinates))

    def _along(self, x: Symbol, constraint: Expr) -> Expr:
        """Return the derivative of a constraint by a coordinate, or the coefficient of its velocity."""
        return sympy.diff(constraint, self.speeds[x] if constraint in self.slips else x)

    def in_forces(self, expression: Expr) -> Expr:
        """Return an expression of impulses in terms of the forces kappa."""
        pairs = ((self._impulse[mark], self._kappa[mark]) for mark in ("_k", "_k1"))
        forces = {i: STEP * k / 2 for left, right in pairs for i, k in zip(left, right, strict=True)}
        return replaced(expression, forces)

    def _at(self, mark: str) -> dict[Expr, Expr]:
        node = at_nodes(self.model.coordinates, mark)
        time = self.model.time + (STEP if mark == "_k1" else S.Zero)
        return {**dict(zip(self.model.coordinates, node, strict=True)), self.model.time: time}

    def _force(self, slope: Callable[[Expr], Expr], mark: str) -> list[Expr]:
        pairs = zip(self._impulse[mark], self.constraints, strict=True)
        return [impulse * slope(c) for impulse, c in pairs]

    def left_impulse(self, x: Symbol) -> Expr:
        """Return the impulse on a coordinate x at the left node."""
        return Add(*self._force(partial(self._along, x), "_k")).xreplace(self._at("_k"))

    def right_impulse(self, x: Symbol) -> Expr:
        """Return the impulse on a coordinate x at the right node."""
        return Add(*self._force(partial(self._along, x), "_k1")).xreplace(self._at("_k1"))

    def left_moment(self, body: _Attitude) -> Matrix:
        """Return the angular impulse on a body at the left node, in its frame."""
        return sum(self._force(lambda c: self._slope(c, body), "_k"), Matrix([0, 0, 0])).xreplace(self._at("_k"))

    def right_moment(self, body: _Attitude) -> Matrix:
        """Return the angular impulse on a body at the right node, in its frame."""
        return sum(self._force(lambda c: self._slope(c, body), "_k1"), Matrix([0, 0, 0])).xreplace(self._at("_k1"))

    def guesses(self, left_rates: Sequence[Expr]) -> dict[Symbol, Expr]:
        """Return the guesses of the unknowns: no impulses, and the rates of the left node."""
        values: dict[Symbol, Expr] = dict.fromkeys(self.unknowns, S.Zero)
        return values | dict(zip((*self._speeds, *self._spins), left_rates, strict=False))
