"""All problems of the gallery, by the name of their file and its arguments."""

from collections.abc import Callable
from functools import partial

from . import gallery_first_order as first_order
from . import gallery_mechanical as mechanical
from . import gallery_multibody as multibody
from .gallery_problem import GalleryProblem

GALLERY: dict[tuple[str, tuple[tuple[str, str], ...]], Callable[[], GalleryProblem]] = {
    ("double_integrator", ()): mechanical.double_integrator,
    ("double_integrator_effort", ()): mechanical.double_integrator_effort,
    ("bryson_denham", ()): mechanical.bryson_denham,
    ("brachistochrone", ()): first_order.brachistochrone,
    ("cart_pole", ()): mechanical.cart_pole,
    ("cart_pole_balance", ()): mechanical.cart_pole_balance,
    ("pendulum_swing_up", ()): mechanical.pendulum_swing_up,
    ("acrobot", ()): mechanical.acrobot,
    ("quadrotor", ()): mechanical.quadrotor,
    ("two_link_arm", ()): mechanical.two_link_arm,
    ("crane", ()): first_order.crane,
    ("van_der_pol", ()): first_order.van_der_pol,
    ("hypersensitive", ()): partial(first_order.hypersensitive, 10.0),
    ("hypersensitive", (("duration", "10000"),)): partial(first_order.hypersensitive, 10000.0),
    ("goddard_rocket", ()): first_order.goddard_rocket,
    ("robot_arm", ()): first_order.robot_arm,
    ("quadrotor_path", ()): first_order.quadrotor_path,
    ("low_thrust", ()): mechanical.low_thrust,
    ("spherical_pendulum", ()): partial(multibody.spherical_pendulum, "cartesian"),
    ("spherical_pendulum", (("form", "angles"),)): partial(multibody.spherical_pendulum, "angles"),
    ("four_bar", ()): multibody.four_bar,
    ("convoy", ()): multibody.convoy,
    ("betts_10_7", ()): partial(first_order.betts_10_7, 10000.0),
    ("betts_10_7", (("duration", "20"),)): partial(first_order.betts_10_7, 20.0),
    ("cart_pendulum", ()): partial(multibody.cart_pendulum, "plain"),
    ("cart_pendulum", (("form", "holonomic"),)): partial(multibody.cart_pendulum, "holonomic"),
    **{
        ("hovercraft", (() if craft == 3 else (("craft", str(craft)),))): partial(multibody.hovercraft, craft)
        for craft in (3, 4, 5, 20)
    },
    **{
        ("n_link_pendulum", (() if links == 2 else (("links", str(links)),))): partial(multibody.n_link_pendulum, links)
        for links in (2, 4, 6)
    },
    ("linear_pendulum", ()): partial(mechanical.from_first_gallery, "linear_pendulum"),
    ("orbital_transfer", (("revolutions", "1"),)): partial(mechanical.from_first_gallery, "orbital_transfer_1"),
    ("orbital_transfer", (("revolutions", "2"),)): partial(mechanical.from_first_gallery, "orbital_transfer_2"),
}
"""A problem file's name and its arguments, to the problem's second description."""
