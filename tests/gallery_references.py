"""Reference values of the gallery: optima of the discrete programs, and what is known of the continuous problems.

`optima` were computed by CasADi 3.8.2 and IPOPT, to a tolerance of 1e-12 and without relaxed bounds, from a second
description of each problem (`benchmarks/gallery_optima.py` does it again, `benchmarks/peers/casadi_phases.py` where
there are phases, each of N intervals). They belong to the very programs that the
generated solvers solve, so these are to agree to about nine digits.

`value` is a published number or a closed form for the continuous problem, with its `source`; `error` bounds its
distance from the optimum with the most intervals, by the order of the scheme and the digits of the source. `limit` is
where the optima go as N grows: the closed form, or the optimum by Gauss-Legendre collocation of order 6 with 80
intervals (`benchmarks/peers/casadi_collocation.py`), to the digits on which 40 and 80 intervals agree.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

GAUSS = "optimum by Gauss-Legendre collocation of order 6, CasADi and IPOPT"


@dataclass(frozen=True)
class Reference:
    """What is known of one problem with given arguments; `optima` maps N to the least discrete cost."""

    problem: str
    optima: Mapping[int, float]
    value: float
    error: float
    source: str
    arguments: Mapping[str, str] = field(default_factory=dict)
    limit: float | None = None
    scheme: str | None = None


REFERENCES = (
    Reference(
        "double_integrator",
        {20: 2.0, 50: 2.0, 100: 2.0},
        value=2.0,
        error=1e-9,
        source="closed form, 2 sqrt(distance/limit); exact for even N",
        limit=2.0,
    ),
    Reference(
        "double_integrator_effort",
        {20: 4800 / 399, 50: 30000 / 2499, 100: 120000 / 9999},
        value=12.0,
        error=0.0013,
        source="closed form, 12 x_f^2/T^3; discrete optimum 12 N^2/(N^2 - 1)",
        limit=12.0,
    ),
    Reference(
        "bryson_denham",
        {30: 4.01005025126, 60: 4.00250312891, 120: 4.00062519537},
        value=4.0,
        error=7e-4,
        source="closed form, 4/(9 wall): Bryson and Ho (1975), section 3.11",
        limit=4.0,
    ),
    Reference(
        "brachistochrone",
        {20: 1.80218123619, 50: 1.80169553571, 100: 1.80162622274},
        value=1.801603122453,
        error=3e-5,
        source="closed form, a cycloid; dymos's examples have 1.8016",
        limit=1.801603122453,
    ),
    Reference(
        "cart_pole",
        {20: 63.4074239206, 50: 59.5370549465, 100: 58.9898744402, 200: 58.8532099744},
        value=58.8839489745,
        error=0.08,
        source="dymos, test_cartpole_opt.py: 40 segments, no force at the end, compared there to 1e-3",
        limit=58.80767,
    ),
    Reference(
        "cart_pole_balance",
        {20: 0.132563972099, 40: 0.133140267601, 80: 0.135240053331},
        value=0.1359377669,
        error=0.001,
        source=GAUSS,
        limit=0.1359377669,
    ),
    Reference(
        "pendulum_swing_up",
        {20: 15.447613163, 50: 10.1050275598, 100: 9.50872107898, 200: 9.36248004886},
        value=9.31395,
        error=0.06,
        source=f"{GAUSS} (opty's example ends in another local optimum, 15.64)",
        limit=9.31395,
    ),
    Reference(
        "drone_gates",
        {20: 7.50620955534, 60: 7.47410343944, 120: 7.47105705162, 240: 7.47029778311},
        value=7.470048,
        error=3e-4,
        source="CasADi and IPOPT on 240 and 480 intervals, extrapolated by order 2 (benchmarks/waypoints.py)",
    ),
    Reference(
        "acrobot",
        {20: 42.0002949243, 60: 35.0413684659, 100: 34.9830916762},
        value=34.9189,
        error=0.08,
        source=GAUSS,
        limit=34.9189,
    ),
    Reference(
        "quadrotor",
        {20: 15.0091611905, 50: 14.839638729, 100: 14.8159060005},
        value=14.80802141,
        error=0.01,
        source=GAUSS,
        limit=14.80802141,
    ),
    Reference(
        "two_link_arm",
        {20: 2.98981482238, 50: 2.98306179562, 100: 2.98253033631},
        value=2.988662,
        error=0.007,
        source="PSOPT, doc/SQP_ALL_EXAMPLES.csv, twolinkarm with IPOPT on 40 nodes",
        limit=2.98229,
    ),
    Reference(
        "crane",
        {45: 0.00512509805168, 90: 0.00514400831449},
        value=5.1513e-3,
        error=9e-6,
        source="PSOPT, doc/SQP_ALL_EXAMPLES.csv, crane with IPOPT on up to 80 nodes",
        limit=5.15034e-3,
    ),
    Reference(
        "van_der_pol",
        {20: 2.87293042537, 50: 2.86799894478, 100: 2.86743998754},
        value=2.867259538,
        error=2.5e-4,
        source='PROPT user\'s guide (2009), "Van der Pol oscillator", 60 collocation points',
        limit=2.86726,
    ),
    Reference(
        "hypersensitive",
        {20: 1.67309542159, 50: 1.67309425696, 100: 1.67309404992},
        value=1.6730939784121932,
        error=1e-7,
        source="closed form, in the problem's docstring; dymos, test_hyper_sensitive.py",
        limit=1.6730939784121932,
    ),
    Reference(
        "hypersensitive",
        {10000: 1.67309703886},
        value=1.6730970388562798,
        error=1e-9,
        source="closed form, in the problem's docstring",
        arguments={"duration": "10000"},
        limit=1.6730970388562798,
    ),
    Reference(
        "goddard_rocket",
        {20: -1.01291520922, 50: -1.01285015625, 100: -1.01284023182},
        value=-1.01283,
        error=1.5e-5,
        source="COPS 3.0 (2004), Goddard rocket, 400 intervals",
        limit=-1.0128369,
    ),
    Reference(
        "robot_arm",
        {20: 9.1348393565, 50: 9.14198850036, 100: 9.14084514872},
        value=9.14138,
        error=0.001,
        source="COPS 3.0 (2004), robot arm, 200 intervals; dymos, test_robot_arm.py, compared there to 1e-3",
        limit=9.1409,
    ),
    Reference(
        "quadrotor_path",
        {15: 0.550829531962, 30: 0.546272031804, 60: 0.549049938804},
        value=0.549375967,
        error=0.0006,
        source=f"{GAUSS}, 30 intervals",
        limit=0.5494,
    ),
    Reference(
        "low_thrust",
        {20: -1.52375030305, 50: -1.52502694151, 100: -1.52521531595},
        value=-1.5252777,
        error=8e-5,
        source=f"{GAUSS}; sqp-craft-solver's test of the same data has 1.52449 by 40 trapezoidal intervals",
        limit=-1.5252777,
    ),
    Reference(
        "spherical_pendulum",
        {20: 29.481399603, 50: 29.4313690851, 100: 29.4242943647},
        value=29.421940,
        error=0.003,
        source=f"{GAUSS}, of the unconstrained form",
        limit=29.421940,
    ),
    Reference(
        "spherical_pendulum",
        {20: 30.2400074329, 50: 29.5579742104, 100: 29.4561727069},
        value=29.421940,
        error=0.045,
        source=GAUSS,
        arguments={"form": "angles"},
        limit=29.421940,
    ),
    Reference(
        "convoy",
        {20: 476.205843443, 40: 475.297485538, 80: 475.044950545},
        value=474.97,
        error=0.1,
        source=GAUSS,
        limit=474.97,
    ),
    Reference(
        "four_bar",
        {20: 286.133229647, 50: 291.018804831, 100: 291.520044946},
        value=291.68484,
        error=0.2,
        source=f"{GAUSS}, with the crank's angle as the only coordinate",
        limit=291.68484,
    ),
    Reference(
        "pushed_block",
        {n: 12 * n**2 / (n**2 - 1) + 2.943**2 for n in (15, 30, 60)},
        value=12 + 2.943**2,
        error=0.06,
        source="closed form, 12 m^2 d^2/T^3 + (mu m g)^2 T; discrete optimum with 12 N^2/(N^2 - 1)",
        limit=12 + 2.943**2,
    ),
    Reference(
        "snakeboard",
        {40: 0.079076194923, 80: 0.0778035644047, 160: 0.0774883470721},
        value=0.0773835,
        error=2e-4,
        source="optimum by multiple shooting with RK4, CasADi and IPOPT (tests/benchmarks/rolling.py)",
        limit=0.0773835,
    ),
    Reference(
        "betts_10_7",
        {100: 6.56038563029, 200: 6.68095299246, 400: 6.71315673735},
        value=6.724113810,
        error=0.012,
        source="closed form for long times, in the problem's docstring; Betts (2010) has 6.7241 for T = 10000",
        arguments={"duration": "20"},
        limit=6.724113810,
    ),
    Reference(
        "betts_10_7",
        {10000: 4.94224774947},
        value=6.7241,
        error=1.8,
        source="Betts, Practical Methods for Optimal Control (2010), example 10.7, as quoted by opty's gallery",
        limit=6.724113810,
    ),
    Reference(
        "cart_pendulum",
        {20: 154.388989370},
        value=154.3889763,
        error=2e-5,
        source="bioptim's test with IPOPT's relaxed bounds, as there",
        scheme="trapezoidal",
    ),
    Reference(
        "cart_pendulum",
        {20: 148.081328671},
        value=148.081302762,
        error=4e-5,
        source="bioptim's second test with IPOPT's relaxed bounds, as there",
        arguments={"form": "holonomic"},
        scheme="trapezoidal",
    ),
    Reference(
        "hovercraft",
        {20: 1053.5188277, 50: 1037.45971744},
        value=1034.4,
        error=3.2,
        source="extrapolation by an independent program",
    ),
    Reference(
        "hovercraft",
        {20: 1821.35336406, 50: 1792.46045226, 200: 1787.31173442},
        value=1787.0,
        error=0.35,
        source="extrapolation by an independent program",
        arguments={"craft": "5"},
    ),
    Reference(
        "two_stage_rocket",
        {5: -566.256812134, 10: -568.079852789, 20: -568.541156976},
        value=-568.6954317577531,
        error=0.16,
        source="closed form, in the problem's docstring",
        limit=-568.6954317577531,
    ),
    Reference(
        "bouncing_ball",
        {5: 17.453985641, 10: 17.3164460201, 20: 17.2823987444},
        value=17.27107933,
        error=0.012,
        source="closed form, least over five numbers, in the problem's docstring",
        limit=17.27107933,
    ),
)

BIOPTIM: dict[str, tuple[tuple[float, ...], dict[int, float]]] = {
    "plain": (
        (-0.325653795765479, 0.514317755981177),
        {0: 9.952650040830257, 10: 1.326124391015805, 19: -24.871395482788490},
    ),
    "holonomic": ((-0.5307718, 0.0, 0.7052470), {0: 10.502854, 10: 12.717297, 19: -19.131171}),
}
"""Coordinates at node 10 and controls of three intervals, N = 20, published in bioptim's
tests/shard4/test_variational_integrator_examples.py.

There the cart's bound y >= -1 is active, and IPOPT relaxes it by 1e-8, which moves the controls by up to 4e-6: compare
to 1e-5.
"""
