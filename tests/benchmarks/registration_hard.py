"""Hard cases of registration: many landmarks, turns, swaps and permutations, solved without a fold or refused.

A part of registration.py, which runs it. Folds are looked for by differences of places.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from planar_maps import CONSOLE, determinants_by_differences

sys.path.insert(0, str(Path(__file__).parents[1] / "registration"))
from noisy_landmarks import SIDE as NOISY_SIDE
from noisy_landmarks import noisy_pairs

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration import register
from codegen.registration.certificate import certify
from codegen.registration.grid import coarse_grid
from codegen.registration.pairs import LandmarkPairs


def folded_by_differences(found: Any, side: int, count: int = 257) -> tuple[int, float]:
    """Points of a grid at which the map turns an image over, and the least factor by which it enlarges areas.

    The factor is that of differences of places 0.002 pixels apart, which know nothing of derivatives. After the whole
    image, a twentieth of it about the least factor is looked at as finely again.
    """
    step = side / (count - 1)
    grid = coarse_grid((side, side), count)
    everywhere = determinants_by_differences(found.map_points, grid)
    middle = grid[np.argmin(everywhere)]
    near = determinants_by_differences(found.map_points, middle + step * count / 40 * (2.0 * grid / side - 1.0))
    return int((~(everywhere > 0.0)).sum() + (~(near > 0.0)).sum()), float(min(everywhere.min(), near.min()))


def turned(pairs: LandmarkPairs, degrees: float, side: int) -> LandmarkPairs:
    """The pairs with the fixed image turned about its middle."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    middle = (side - 1) / 2
    return LandmarkPairs(pairs.moving, (pairs.fixed - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + middle)


def hard_cases() -> Iterator[tuple[str, LandmarkPairs, dict[str, Any]]]:
    """What is asked of a registration by users who do not know that it is difficult, on 512 x 512 pixels."""
    for count in (500, 1000, 2000):
        yield f"{count} landmarks", noisy_pairs(count, 0.0, 1), {}
    for count in (500, 2000):
        yield f"{count} landmarks, errors of 1 px, sigma 1", noisy_pairs(count, 1.0, 1), {"sigma": 1.0}
    yield "2000 landmarks, errors of 1 px, sigma auto", noisy_pairs(2000, 1.0, 1), {"sigma": "auto"}
    for degrees in (30, 90, 150, 180):
        pairs = turned(noisy_pairs(40, 0.0, 2), degrees, NOISY_SIDE)
        yield f"40 landmarks, turned by {degrees}", pairs, {}
        yield f"40 landmarks, turned by {degrees}, not aligned", pairs, {"align": "none"}
    generator = np.random.default_rng(3)
    for count in (10, 20, 40):
        pairs = noisy_pairs(count, 0.0, 3)
        order = np.arange(count)
        order[:2] = 1, 0
        yield f"{count} landmarks, 1 and 2 changed", LandmarkPairs(pairs.moving, pairs.fixed[order]), {}
        permuted = LandmarkPairs(pairs.moving, pairs.fixed[generator.permutation(count)])
        yield f"{count} landmarks, permuted", permuted, {}
        yield f"{count} landmarks, permuted, sigma 20", permuted, {"sigma": 20.0}


def hard(count: int, repeat: int) -> None:
    """Many landmarks, turns and permutations: solved without a fold, or refused."""
    del count, repeat
    shape = (NOISY_SIDE, NOISY_SIDE)
    register(noisy_pairs(20, 0.0, 1), shape)
    for name, pairs, options in hard_cases():
        begin = perf_counter()
        try:
            found = register(pairs, shape, **options)
        except (RegistrationError, LandmarkError) as error:
            CONSOLE.print(f"{name}: {perf_counter() - begin:.1f} s, refused: {error}")
            continue
        seconds = [perf_counter() - begin]
        certificate = certify(found)
        seconds.append(perf_counter() - begin - seconds[0])
        points, least = folded_by_differences(found, NOISY_SIDE, 257 if len(pairs) < 500 else 65)
        deviation = np.sqrt((found.residuals**2).mean() / 2.0)
        way = "proved" if certificate.proved else "pixels"
        CONSOLE.print(
            f"{name}: {seconds[0]:.1f} s, certificate {seconds[1]:.1f} s ({way}, {certificate.folded} folded), "
            f"{found.steps} steps, {found.alignment.kind}, residual {deviation:.2g} px; "
            f"by differences {points} points folded, least {least:.4f}"
        )
