"""Fly a quadrotor along a figure of eight, as a controller does that solves this problem at every sampling time.

The state is the place, the velocity and the attitude (roll, pitch and yaw, x-y-z Euler angles); the inputs are the
thrust for each kg and the rates of the body, which a loop inside the vehicle follows. Over the next 1.5 s place and
velocity are to be those of a path, at the present time `now` and after it; once around takes `period`. Source of the
model: Falanga, Foehn, Lu and Scaramuzza, PAMPC: Perception-aware model predictive control for quadrotors, IROS 2018,
where attitudes are quaternions.

With `plant=True` it is the vehicle alone, for `codegen.close_loop`: inputs and wind are numbers, and time is a sampling
time.
"""

from sympy import cos, pi, sin, tan

from codegen import Control, controls, parameters, states, time


def problem(plant: bool = False) -> Control:
    x, y, z, vx, vy, vz, roll, pitch, yaw = states("x y z vx vy vz roll pitch yaw")
    thrust, p, q, r = parameters(thrust=9.81, p=0, q=0, r=0) if plant else controls("thrust p q r")
    g, T, now, period, width, height = parameters(g=9.81, T=1.5, now=0, period=8, width=3, height=1.5)
    wind_x, wind_y, least, greatest, rate = parameters(wind_x=0, wind_y=0, least=2, greatest=20, rate=3)

    system = {
        "dynamics": {
            x: vx,
            y: vy,
            z: vz,
            vx: thrust * (cos(yaw) * sin(pitch) * cos(roll) + sin(yaw) * sin(roll)) + wind_x,
            vy: thrust * (sin(yaw) * sin(pitch) * cos(roll) - cos(yaw) * sin(roll)) + wind_y,
            vz: thrust * cos(pitch) * cos(roll) - g,
            roll: p + tan(pitch) * (q * sin(roll) + r * cos(roll)),
            pitch: q * cos(roll) - r * sin(roll),
            yaw: (q * sin(roll) + r * cos(roll)) / cos(pitch),
        },
        "start": {x: 0, y: 0, z: height, vx: 0, vy: 0, vz: 0, roll: 0, pitch: 0, yaw: 0},
    }
    if plant:
        return Control(**system, duration=T / 30, steps=5)
    phase = 2 * pi * (now + time()) / period
    path = width * sin(phase), width / 2 * sin(2 * phase), height + 0.3 * sin(phase)
    place, velocity = (x, y, z), (vx, vy, vz)
    away = sum((own - wanted) ** 2 for own, wanted in zip(place, path))
    slip = sum((own - wanted.diff(time())) ** 2 for own, wanted in zip(velocity, path))
    track = away + 0.1 * slip + 0.1 * yaw**2
    return Control(
        **system,
        cost=track + 0.001 * (thrust - g) ** 2 + 0.01 * (p**2 + q**2 + r**2),
        terminal_cost=track.subs(time(), T),
        duration=T,
        bounds={thrust: (least, greatest), p: (-rate, rate), q: (-rate, rate), r: (-rate, rate)},
        guess={**dict(zip(place, path)), thrust: g},
        steps=30,
    )
