"""Landmarks of a known warp with known errors."""

import numpy as np

from codegen.registration.pairs import LandmarkPairs

SIDE = 512


def known_warp(seed, amplitude=20.0, width=90.0, bumps=6):
    """A sum of Gaussian displacements over an image of SIDE x SIDE pixels, as a function of points."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform(0.15, 0.85, (bumps, 2)) * SIDE
    shifts = generator.normal(size=(bumps, 2)) * amplitude

    def function(points):
        squares = ((points[:, None] - centres) ** 2).sum(-1)
        return points + np.exp(-squares / (2 * width**2)) @ shifts

    return function


def noisy_pairs(count, noise, seed):
    """So many landmarks, whose fixed coordinates have errors of a standard deviation in pixels."""
    generator = np.random.default_rng(1000 + seed)
    moving = generator.uniform(0.05, 0.95, (count, 2)) * SIDE
    return LandmarkPairs(moving, known_warp(seed)(moving) + generator.normal(size=(count, 2)) * noise)


def misplaced(pairs, count, seed):
    """The same with so many landmarks moved by 15 to 80 pixels in any direction, and the numbers of those."""
    generator = np.random.default_rng(seed)
    chosen = generator.choice(len(pairs), count, replace=False)
    angles, lengths = generator.uniform(0, 2 * np.pi, count), generator.uniform(15.0, 80.0, count)
    fixed = pairs.fixed.copy()
    fixed[chosen] += lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return LandmarkPairs(pairs.moving, fixed), set(chosen.tolist())
