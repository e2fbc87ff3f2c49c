"""Items of a drawing as artists: where they are, when they are shown, and what is left out."""

from __future__ import annotations

import matplotlib
import numpy as np
from invented_results import picture
from matplotlib.figure import Figure

from codegen.drawing import Arrow, Box, Ground, Mass, Scene, Trail
from codegen.show.figures import shapes


class TestShapes:
    def test_extent(self):
        one = np.ones((1, 1))
        left, right, bottom, top = shapes.extent([Scene(np.zeros(1), (Mass((2 * one, 3 * one), one),))])
        assert left < 1.0 < 3.0 < right
        assert bottom < 2.0 < 4.0 < top
        box = Box((0 * one, 0 * one), 4 * one, 2 * one, np.pi / 2 * one)
        left, right, bottom, top = shapes.extent([Scene(np.zeros(1), (box,))])
        np.testing.assert_allclose([right, top], [1.2, 2.2])
        assert (left, bottom) == (-right, -top)

    def test_extent_of_nothing_finite(self):
        nothing = np.full((1, 2), np.nan)
        assert shapes.extent([Scene(np.zeros(2), (Trail((nothing, nothing)),))]) == (-1.0, 1.0, -1.0, 1.0)

    def test_instants(self):
        scene, room = picture(2), (-2.0, 2.0, -2.0, 2.0)
        still = list(shapes.instant(scene, 3, room, moving=False))
        assert len(still) == 4  # ground is a line and a band
        moving = list(shapes.instant(scene, 3, room, moving=True))
        assert len(moving) == 2 * 5
        trail = moving[0]
        np.testing.assert_allclose(trail.get_xdata(), scene.t[:4])

    def test_no_artist_where_there_is_no_number(self):
        x = np.array([[0.0, np.nan]])
        scene = Scene(np.arange(2.0), (Mass((x, x), 1 + 0 * x), Arrow((x, x), (1 + 0 * x, x))))
        assert len(list(shapes.instant(scene, 0, (0, 1, 0, 1), moving=True))) == 2
        assert list(shapes.instant(scene, 1, (0, 1, 0, 1), moving=True)) == []

    def test_ground_is_hatched_to_the_right(self):
        one = np.ones((1, 1))
        scene = Scene(np.zeros(1), (Ground((-one, 0 * one), (one, 0 * one)),))
        band, line = shapes.instant(scene, 0, (-1, 1, -1, 1), moving=False)
        assert band.get_hatch()
        assert band.get_xy()[:, 1].min() < 0.0 == band.get_xy()[:, 1].max()
        np.testing.assert_array_equal(line.get_ydata(), [0, 0])

    def test_several_bodies_leave_only_arrows_on_their_way(self):
        axes = Figure().add_subplot()
        scene = picture(3)
        shapes.course(axes, scene, shapes.extent([scene]))
        arrows = [patch for patch in axes.patches if isinstance(patch, matplotlib.patches.FancyArrowPatch)]
        assert len(arrows) == 3 * shapes.MANY_SHOTS
        assert len([p for p in axes.patches if isinstance(p, matplotlib.patches.Circle) and p.get_fill()]) == 0
