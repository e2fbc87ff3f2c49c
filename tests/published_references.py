"""Reference values of the published problems in `problems/published/`, by other people's programs and closed forms.

The value is `factor` times the cost. Grade A is a closed form, or two independent public values that agree to the
digits shown; B one published or tested value, or one that is extrapolated from published grids; C a coarse grid, or
transcriptions that differ. `tolerance` is relative, and what the problem's own number of intervals must reach;
`parameters` are published values of free parameters, to `parameter_tolerance`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import pi


@dataclass(frozen=True)
class Published:
    """What is known of one problem with given arguments."""

    problem: str
    value: float
    grade: str
    tolerance: float
    source: str
    factor: float = 1.0
    arguments: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    parameter_tolerance: float = 1e-3

    @property
    def title(self) -> str:
        """The problem and its arguments."""
        return " ".join([self.problem, *(f"{key}={value}" for key, value in self.arguments.items())])

    def error(self, cost: float) -> float:
        """The relative distance of a cost from the published one."""
        return abs(self.factor * cost - self.value) / abs(self.value)


PUBLISHED = (
    Published(
        "hanging_chain", 5.0684801110, "A", 1e-6, "closed form, a catenary; PSOPT chain 5.068480; COPS 3.0 has 5.0685"
    ),
    Published(
        "linear_tangent_steering",
        0.554570879,
        "A",
        1e-6,
        "Betts, example 10.73; COPS 3.0, n = 800, 0.554571; PSOPT lts 0.5545709",
    ),
    Published(
        "moon_lander",
        1.4203126,
        "A",
        1e-5,
        "closed form of one switch; PSOPT moon 1.4204; dymos's final mass 0.3953",
        parameters={"T": 0.2392591 + 1.1575490},
    ),
    Published("interior_point", 0.9205314415, "A", 1e-6, "closed form; PSOPT interior_point 0.9205314"),
    Published("singular_arc", 10 / 3, "A", 1e-4, "closed form; PSOPT singular_di 3.333328", parameters={"T": 4.0}),
    Published(
        "time_in_dynamics",
        1.4755759,
        "A",
        1e-6,
        "closed form; CTDirect bolza_freetf 1.476",
        parameters={"T": 1.5**0.25},
    ),
    Published("hull", 0.2163461538, "A", 1e-8, "closed form; dymos hull_problem", parameters={"u": -7.5 / 26}),
    Published("isoperimetric_area", 1 / (4 * pi), "A", 1e-6, "closed form; yapss isoperimetric", factor=-1.0),
    Published("newton_nose_cone", 1.499263915, "A", 1e-6, "yapss newton, tested to 1e-7 with a free nose"),
    Published("fuller", 0.2683944, "B", 2e-4, "CTDirect, test problem fuller, by Bocop"),
    Published("catalyst_mixing", -0.0480556, "A", 1e-5, "COPS 3.0, n = 100 to 400; PSOPT catmix -0.0480532"),
    Published(
        "robbins",
        19.4318,
        "B",
        1e-4,
        "CTBenchmarks.jl, N = 500, 1000, 2000: 19.46663, 19.44019, 19.43391; Richardson 19.43182",
    ),
    Published(
        "double_oscillator", 9.11035e-4, "B", 1e-4, "CTBenchmarks.jl, N = 1000 and 2000: 9.110069e-4, 9.110279e-4"
    ),
    Published("ducted_fan", 1831.828, "B", 1e-3, "OptimalControlProblems.jl, 250 trapezoidal intervals"),
    Published("truck_with_trailers", 59.28, "C", 5e-3, "CTDirect; JuMP with 200 trapezoidal intervals 59.18"),
    Published(
        "space_shuttle_reentry",
        34.1412,
        "A",
        1e-4,
        "PSOPT 34.14120 degrees; dymos 34.1412",
        factor=-180 / pi,
        parameters={"T": 2008.59},
    ),
    Published(
        "space_shuttle_reentry",
        30.6255,
        "B",
        1e-3,
        "dymos, expected results, asserted to 1e-2",
        factor=-180 / pi,
        arguments={"heat_limit": "70"},
        parameters={"T": 2198.67},
        parameter_tolerance=1e-2,
    ),
    Published("goddard_rocket_in_feet", 18550.87186, "B", 1e-5, "yapss, three phases, tested to 1e-8", factor=-1.0),
    Published(
        "penicillin", 87.99, "B", 2e-3, "Banga et al. (2005), case study III, with 132 hours; 88.0 elsewhere", -1.0
    ),
    Published(
        "ethanol",
        20839.0,
        "C",
        2e-3,
        "Banga et al. (2005), case study IV, with 61.17 hours; quoted, not looked up",
        factor=-1.0,
    ),
    Published("bioreactor", 0.614134, "B", 1e-3, "CTDirect bioreactor_1day, by Bocop", factor=-1.0),
    Published("algae_and_bacteria", 5.45, "C", 5e-3, "CTDirect algal_bacterial", factor=-1.0),
    Published("rayleigh", 44.8044433, "A", 1e-5, "Betts, example 10.113; PSOPT rayleigh 44.776 on a coarse grid"),
    Published(
        "free_flying_robot",
        7.9102,
        "A",
        2e-4,
        "Betts, example 10.43, 7.91055654; in pycollo's tests SOS 7.910154646 and GPOPS-II 7.9101902",
    ),
    Published(
        "tumour",
        7571.6712,
        "A",
        1e-5,
        "Betts, example 10.141; in pycollo's tests GPOPS-II 7571.66986 and SOS 7571.6831",
        parameters={"T": 1.1961336},
    ),
    Published("hang_glider", 1248.03103, "B", 1e-4, "Betts, example 10.54", -1.0, parameters={"T": 98.436940}),
    Published("delayed_feedback", 2.79685770, "B", 1e-5, "Betts, example 10.90"),
    Published("alp_rider", 2030.85609, "C", 1e-4, "Betts, example 10.1"),
    Published("dynamic_soaring", 0.0635869566, "B", 1e-5, "yapss dynamic_soaring"),
    Published("reorientation", 28.63041, "B", 1e-5, "PSOPT reorientation"),
    Published("time_to_climb", 321.0, "B", 1e-2, "dymos min_time_climb, asserted to 1e-2, other interpolation"),
    Published("missile", 40.9175, "C", 1e-3, "PSOPT missile"),
    Published("geodesic", 5549.68, "B", 1e-4, "PSOPT geodesic, 5549.682 and 5549.676"),
    Published("mountain_car", 102.479, "C", 5e-3, "dymos mountain_car"),
    Published("gas_oil", 5.23659e-3, "A", 1e-5, "COPS 3.0, n = 100 to 400; PSOPT 5.22897e-3 by coarse interpolation"),
    Published("methanol", 9.02229e-3, "A", 1e-5, "COPS 3.0, n = 100 to 400"),
    Published("predator_prey", 0.0275363791, "A", 1e-5, "scipy to 1e-11, least_squares; PSOPT predator 0.02753366"),
    Published("isoperimetric", -0.375506, "B", 1e-4, "PSOPT isoperimetric"),
    Published(
        "lotka_volterra_fishing", 1.34408, "B", 1e-4, "mintoc.de's lower bound, in PSOPT lotka, which has 1.344093"
    ),
    Published("coulomb_friction", 2.1049, "C", 5e-4, "PSOPT coulomb, 2.104992 and 2.104798"),
)
