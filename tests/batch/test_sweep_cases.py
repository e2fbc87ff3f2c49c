"""Cases of sweeps: grids, tables and samples, the order in which they are solved, and their chunks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from codegen.batch.cases import SAMPLINGS, axis_of, grid, rows_of, samples, table
from codegen.batch.layout import MOST, Chunks, blocks_of, nearest_chain, serpentine
from codegen.batch.request import Quantity, require_fitting
from codegen.errors import ArgumentError, NumericsError


class TestGrids:
    def test_ranges_and_lists(self):
        assert axis_of("r1=5.5:6.5:3")[1].tolist() == [5.5, 6.0, 6.5]
        assert axis_of("m = 90, 100")[1].tolist() == [90.0, 100.0]
        assert axis_of("form=hamiltonian,lagrangian")[1].tolist() == ["hamiltonian", "lagrangian"]
        assert axis_of("m=3:9:1")[1].tolist() == [3.0]

    @pytest.mark.parametrize(
        ("item", "fragment"),
        [
            ("r1", "NAME="), ("=3", "NAME="), ("r1=", "NAME="), ("r1=1:2", "no range"), ("r1=1:2:3:4", "no range"),
            ("r1=1:2:0", "0 values"), ("r1=1:2:x", "no range"), ("r1=1:2:-3", "no range"), ("r1=a:2:3", "'a'"),
            ("r1=1:inf:3", "'inf'"), ("r1=1,,2", "empty"), ("r1=1:2:99999999999", "values"),
        ],
    )  # fmt: skip
    def test_what_is_no_axis(self, item, fragment):
        with pytest.raises(ArgumentError, match=fragment.replace("(", r"\(")):
            axis_of(item)

    def test_all_combinations_with_the_last_fastest(self):
        cases = grid({"a": [1, 2], "b": [10, 20, 30]})
        assert (cases.dims, cases.shape, cases.number, cases.is_grid) == (("a", "b"), (2, 3), 6, True)
        rows = rows_of(cases.chosen(np.arange(6)))
        assert [(row["a"], row["b"]) for row in rows] == [(a, b) for a in (1, 2) for b in (10, 20, 30)]

    def test_zipped_quantities_share_a_dimension(self):
        cases = grid({"a": [1, 2], "b": [10, 20, 30], "c": [5, 6]}, [("a", "c")])
        assert (cases.dims, cases.shape) == (("a", "b"), (2, 3))
        assert {(row["a"], row["c"]) for row in rows_of(cases.chosen(np.arange(6)))} == {(1, 5), (2, 6)}

    @pytest.mark.parametrize(
        ("zipped", "fragment"),
        [
            (["a"], "nothing to pair"),
            (["a", "a"], "nothing to pair"),
            (["a", "z"], "not varied"),
            (["a", "b"], "has 3"),
        ],
    )
    def test_what_cannot_be_zipped(self, zipped, fragment):
        with pytest.raises(ArgumentError, match=fragment):
            grid({"a": [1, 2], "b": [10, 20, 30]}, [zipped])

    def test_zipped_twice(self):
        axes = {name: [1, 2] for name in "abc"}
        for zipped in ([("a", "b"), ("a", "c")], [("a", "b"), ("b", "c")], [("a", "b"), ("c", "a")]):
            with pytest.raises(ArgumentError, match="twice"):
                grid(axes, zipped)

    @pytest.mark.parametrize("values", [[], [[1, 2]], [1, float("nan")], [None], {"x": 1}, "text"[:0]])
    def test_what_are_no_values(self, values):
        with pytest.raises(ArgumentError, match="a has"):
            grid({"a": values} if values != "" else {"a": np.array([])})

    def test_more_cases_than_fit(self):
        with pytest.raises(NumericsError, match="at most"):
            grid({"a": np.arange(100000.0), "b": np.arange(100000.0)})

    def test_points_are_in_parts_of_ranges(self):
        points = grid({"a": [1.0, 3.0, 2.0], "b": ["x", "y"]}).points(np.arange(6))
        np.testing.assert_array_equal(points, [[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0], [0.5, 1]])


class TestTables:
    def test_a_case_for_each_row(self, tmp_path):
        (tmp_path / "cases.csv").write_text("r1, m\n5.5, 90\n\n6,100\n")
        cases = table(tmp_path / "cases.csv")
        assert (cases.dims, cases.shape, cases.is_grid) == (("case",), (2,), False)
        assert rows_of(cases.chosen(np.arange(2))) == [{"r1": 5.5, "m": 90.0}, {"r1": 6.0, "m": 100.0}]

    @pytest.mark.parametrize(
        ("text", "fragment"),
        [
            ("", "missing"), ("r1,m\n", "holds no cases"), ("r1,r1\n1,2\n", "twice"), ("r1,\n1,2\n", ":1:"),
            ("r1,m\n1,2\n3\n", ":3: 1 value for 2 names"), ("r1,m\n1,2,3\n", ":2:"), ("r1,m\n1,\n", ":2:"),
            ("r1\nnan\n", ":2: r1 is not finite"),
        ],
    )  # fmt: skip
    def test_what_is_no_table(self, tmp_path, text, fragment):
        (tmp_path / "cases.csv").write_text(text)
        with pytest.raises(ArgumentError, match=fragment):
            table(tmp_path / "cases.csv")

    def test_files_that_cannot_be_read(self, tmp_path):
        (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
        for name in ("nothing.csv", "binary.csv", ""):
            with pytest.raises(ArgumentError, match="cannot be read"):
                table(tmp_path / name)

    def test_numerals_are_no_numbers(self):
        with pytest.raises(ArgumentError, match="m takes numbers, not '1'"):
            require_fitting([Quantity("m", "parameter", "m")], grid({"m": ["1", "2"]}))

    def test_columns_in_memory(self):
        assert rows_of(table({"a": np.array([1.0, 2.0])}).chosen(np.arange(2))) == [{"a": 1.0}, {"a": 2.0}]
        for given, fragment in (
            ({"a": [1], "b": [1, 2]}, "different lengths"),
            ({}, "no columns"),
            (3.5, "give a file"),
        ):
            with pytest.raises(ArgumentError, match=fragment):
                table(given)


class TestSamples:
    @pytest.mark.parametrize("method", SAMPLINGS)
    def test_they_follow_their_distributions_and_are_the_same_again(self, method):
        given = {"m": "normal(100, 5)", "r": "uniform(4.9, 5.1)", "k": "lognorm(0.5, scale=2)"}
        cases = samples(given, 1000, method, 7)
        own = {"m": stats.norm(100, 5), "r": stats.uniform(4.9, 0.2), "k": stats.lognorm(0.5, scale=2)}
        for name, distribution in own.items():
            assert stats.kstest(cases.columns[name], distribution.cdf).pvalue > 1e-3
        again, other = samples(given, 1000, method, 7), samples(given, 1000, method, 8)
        for name in given:
            np.testing.assert_array_equal(cases.columns[name], again.columns[name])
            assert (cases.columns[name] != other.columns[name]).all()

    def test_a_latin_hypercube_has_a_point_in_every_part(self):
        values = samples({"a": "uniform(0, 1)"}, 50, "latin", 3).columns["a"]
        assert sorted((np.asarray(values) * 50).astype(int)) == list(range(50))

    def test_distributions_of_scipy(self):
        frozen = samples({"a": stats.norm(1, 2)}, 5, "random", 0).columns["a"]
        np.testing.assert_array_equal(frozen, samples({"a": "norm(1, 2)"}, 5, "random", 0).columns["a"])

    @pytest.mark.parametrize(
        ("given", "fragment"),
        [
            ("normle(1, 2)", "did you mean"), ("normal", "is no distribution"), ("normal(1, x)", "is no distribution"),
            ("normal(1, -2)", "no finite values"), ("normal(1)", "m=normal"), ("uniform(0, inf)", "is no|no finite"),
            ("beta()", "m=beta"), ("__import__('os')", "is no distribution"), ("norm(loc=1, width=2)", "width"),
        ],
    )  # fmt: skip
    def test_what_is_no_distribution(self, given, fragment):
        with pytest.raises(ArgumentError, match=fragment):
            samples({"m": given}, 10, "random", 0)

    @pytest.mark.parametrize(
        ("number", "method", "seed"), [(0, "random", 0), (10, "halton", 0), (10, "random", -1), (True, "random", 0)]
    )
    def test_what_are_no_samples(self, number, method, seed):
        with pytest.raises(ArgumentError):
            samples({"m": "normal(0, 1)"}, number, method, seed)


class TestOrder:
    @pytest.mark.parametrize("shape", [(5,), (3, 4), (2, 3, 4), (1, 1), (3, 1, 2)])
    def test_a_serpentine_visits_all_and_moves_by_one(self, shape):
        order = serpentine(shape)
        assert sorted(order) == list(range(int(np.prod(shape))))
        places = np.array(np.unravel_index(order, shape)).T
        assert (np.abs(np.diff(places, axis=0)).sum(axis=1) == 1).all()

    def test_a_chain_visits_all_and_the_nearest_next(self):
        points = np.random.default_rng(1).random((60, 2))
        order = nearest_chain(points)
        assert order[0] == 0
        assert sorted(order) == list(range(60))
        for k in range(59):
            distances = np.linalg.norm(points[order[k + 1 :]] - points[order[k]], axis=1)
            assert distances[0] == distances.min()

    def test_a_chain_of_one(self):
        assert nearest_chain(np.zeros((1, 2))).tolist() == [0]


class TestChunks:
    @pytest.mark.parametrize("shape", [(7,), (5, 4), (3, 4, 5), (1, 1)])
    @pytest.mark.parametrize("size", [1, 3, 4, 7, 1000])
    def test_every_case_is_in_one_chunk(self, shape, size):
        chunks = blocks_of(shape, size, (True,) * len(shape))
        seen = np.zeros(shape, int)
        for number in range(chunks.number):
            seen[chunks.region(number)] += 1
            cases = chunks.cases(number)
            assert len(cases) == np.prod(chunks.extent(number)) <= size
            np.testing.assert_array_equal(np.arange(seen.size).reshape(shape)[chunks.region(number)].ravel(), cases)
        assert (seen == 1).all()

    def test_whole_rows_first_and_dimensions_that_are_cut(self):
        assert blocks_of((10, 4, 5), 45, (True, True, True)).block == (2, 4, 5)
        assert blocks_of((10, 4, 5), 45, (True, False, True)).block == (9, 1, 5)
        assert blocks_of((10_000,), 10**9, (True,)).block == (MOST,)
        assert Chunks((10,), (4,)).counts == (3,)
