"""rbl-gym network and reproduce network2009, run in this process."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.estimators.networks import consensus
from rbl_gym.networks.graphs import cycle_matrix
from rbl_gym.networks.sensing import proj
from rbl_gym.studies import network
from rbl_gym.studies.papers import network2009, network_growth
from tests.helpers import ROOT, assert_table_holds

G2O = ROOT.parent / "shared" / "data" / "g2o_planar"


@pytest.fixture
def ring(tmp_path):
    """A square walked around twice, with a little noise."""
    rng = np.random.default_rng(0)
    lines = []
    for k in range(7):
        turn = np.pi / 2 + 0.01 * rng.standard_normal()
        lines.append(f"EDGE_SE2 {k} {k + 1} 1 0 {turn:.6f} 1 0 0 1 0 1")
    lines += ["EDGE_SE2 0 4 0 0 0.02 1 0 0 1 0 1", "EDGE_SE2 5 1 0 0 -0.01 1 0 0 1 0 1"]
    path = tmp_path / "ring.g2o"
    path.write_text("\n".join(lines))
    return path


def test_a_network_is_solved_certified_and_drawn(ring, tmp_path, capsys):
    picture = tmp_path / "new" / "ring.png"
    assert main(["network", str(ring), "--plot", str(picture)]) == 0
    text = capsys.readouterr().out
    assert "8 nodes, 9 edges, 2 loops" in text
    assert "certified: no other orientations cost less" in text
    assert picture.stat().st_size > 10_000
    assert main(["network", str(ring), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["certified"] is True
    assert result["cost_rad2"] < result["tree_cost_rad2"]
    assert result["chordal_cost"] == pytest.approx(result["cost_rad2"], rel=1e-3)


def test_a_network_of_bearings_without_places(tmp_path, capsys):
    rows = [(0, 1, 0.5, -2.0), (1, 2, 1.0, 2.0), (0, 2, -0.5, 3.0)]
    path = tmp_path / "edges.csv"
    path.write_text("i,j,a,b\n" + "\n".join(",".join(map(str, row)) for row in rows))
    picture = tmp_path / "x.png"
    assert main(["network", str(path), "--json", "--plot", str(picture)]) == 0
    result = json.loads(capsys.readouterr().out)
    y = [float(proj(a - b + np.pi)) for _, _, a, b in rows]
    around = float(proj(y[0] + y[1] - y[2]))
    assert result["cost_rad2"] == pytest.approx(around**2 / 3)
    assert picture.stat().st_size > 10_000


def solved(path, capsys, *options):
    assert main(["network", str(path), "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_loop_closure_of_little_weight_bends_nothing(tmp_path, capsys):
    # Around the ring 4 x 0.5 rad; the closure says -1, with a deviation of 100 rad.
    path = tmp_path / "a.g2o"
    chain = "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0.5 90 0 0 90 0 400\n" for k in range(7, 11))
    path.write_text(chain + "EDGE_SE2 7 11 1 1 -1 1e-4 0 0 1e-4 0 1e-4\n")
    result = solved(path, capsys)
    off = np.degrees(proj(-1 - 2.0))
    worst, *good = result["worst_edges"]
    assert (worst["i"], worst["j"], worst["weight"]) == (7, 11, 1e-4)
    assert worst["residual_deg"] == pytest.approx(off, rel=1e-5)
    # Least squares share the loop's error out by variances: 1e-4 / 400 of it for each.
    for edge in good:
        assert edge["residual_deg"] == pytest.approx(-off * 1e-4 / 400, rel=1e-4)
    assert result["cost"] == pytest.approx(1e-4 * np.radians(off) ** 2, rel=1e-5)
    assert result["weights"] == "information of theta"
    unit = solved(path, capsys, "--weights", "unit")
    assert unit["weights"] == "equal for all edges, as asked for"
    for edge in unit["worst_edges"]:
        assert abs(edge["residual_deg"]) == pytest.approx(abs(off) / 5)


def test_weights_bend_the_picture_neither(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text(
        "EDGE_SE2 0 1 1 0 0 90 0 0 90 0 400\nEDGE_SE2 1 2 1 0 0 90 0 0 90 0 400\n"
        "EDGE_SE2 0 2 9 7 0 1e-6 0 0 1e-6 0 400\n"
    )
    places = network.solve_network(str(path)).positions
    assert places is not None
    np.testing.assert_allclose(places, [[0, 0], [1, 0], [2, 0]], atol=1e-6)


def test_edges_without_information_where_none_is_needed(tmp_path, capsys):
    path = tmp_path / "a.g2o"
    loop = [
        f"EDGE_SE2 {i} {j} 1 0 {y} 1 0 0 1 0 {w}"
        for i, j, y, w in ((1, 2, 0.1, 4), (2, 3, 0.1, 4), (1, 3, 0.5, 2))
    ]
    # The edge to node 9 is on no cycle.
    path.write_text("\n".join([*loop, "EDGE_SE2 3 9 1 0 0.7"]))
    result = solved(path, capsys)
    assert result["cost"] == pytest.approx(0.3**2 / (1 / 4 + 1 / 4 + 1 / 2))
    path.write_text("\n".join([loop[0], "EDGE_SE2 2 3 1 0 0.1", loop[2]]))
    assert main(["network", str(path)]) == 2
    assert f"{path}: every edge on a cycle must have information" in (
        error := capsys.readouterr().err
    )
    assert "edge 2 3" in error
    assert solved(path, capsys, "--weights", "unit")["cost"] == pytest.approx(0.3**2 / 3)
    path.write_text("\n".join(line.rsplit(maxsplit=6)[0] for line in loop))
    result = solved(path, capsys)
    assert result["cost"] == pytest.approx(0.3**2 / 3)
    assert result["weights"] == "equal for all edges, as the file has no information"


def test_edges_with_no_information_of_theta_are_left_out(tmp_path, capsys):
    path = tmp_path / "a.g2o"
    path.write_text("EDGE_SE2 5 6 1 0 0.1 1 0 0 1 0 9\nEDGE_SE2 6 5 1 0 1 1 0 0 1 0 0\n")
    result = solved(path, capsys)
    assert result["edges_without_weight"] == 1
    assert result["worst_edges"][0]["residual_deg"] == pytest.approx(np.degrees(1.1))
    assert main(["network", str(path)]) == 0
    assert "1 edges without information of theta are left out" in capsys.readouterr().out
    # So little beside the others that rounding would drown it.
    path.write_text("EDGE_SE2 5 6 1 0 0.1 1 0 0 1 0 9\nEDGE_SE2 6 5 1 0 1 1 0 0 1 0 1e-15\n")
    assert solved(path, capsys)["edges_without_weight"] == 1
    path.write_text("EDGE_SE2 5 6 1 0 0.1 1 0 0 1 0 9\nEDGE_SE2 6 88 1 0 1 1 0 0 1 0 0\n")
    assert main(["network", str(path)]) == 2
    assert "2 components: {5, 6}, {88}" in (error := capsys.readouterr().err)
    assert "with information of theta (I33)" in error


def test_skipped_lines_and_large_keys_are_named(tmp_path, capsys):
    path = tmp_path / "a.g2o"
    key = ord("x") * 2**56
    path.write_text(
        f"EDGE_SE2 {key} {key + 1} 1 0 0.1 1 0 0 1 0 1\n"
        f"EDGE_SE2_XY {key} 3 1 0 1 0 1\n"
        "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1\n"
    )
    result = solved(path, capsys)
    assert result["skipped_lines"] == {"EDGE_SE2_XY": 1, "EDGE_SE3:QUAT": 1}
    assert (result["worst_edges"][0]["i"], result["worst_edges"][0]["j"]) == (key, key + 1)
    assert main(["network", str(path)]) == 0
    assert "skipped, no planar poses: 1 EDGE_SE2_XY, 1 EDGE_SE3:QUAT" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "i,j,dtheta\n70,71,0.5\n400,401,0.5\n",
            "edges.csv: edges must connect all 4 nodes, got 2 components: {70, 71}, {400, 401}",
        ),
        ("i,j,dtheta\n0,1,0.5\n2,3,0.5\n", "2 components: {0, 1}, {2, 3}"),
        ("i,j,dtheta\n0,1,nan\n", "line 2, column 'dtheta': must be a finite number"),
    ],
)
def test_what_is_wrong_is_said(text, message, tmp_path, capsys):
    path = tmp_path / "edges.csv"
    path.write_text(text)
    assert main(["network", str(path)]) == 2
    assert message in capsys.readouterr().err
    assert main(["network", str(tmp_path / "none.g2o")]) == 2
    assert "No such file" in capsys.readouterr().err


@pytest.mark.skipif(not G2O.is_dir(), reason="pose graphs are not beside the checkout")
def test_manhattan(capsys):
    path = G2O / "manhattan_edges.csv"
    assert solved(path, capsys)["certified"]
    result = solved(path, capsys, "--weights", "unit")
    assert result["certified"]
    assert result["chordal_cost"] == pytest.approx(1.0205618, rel=1e-7)
    assert result["cost_rad2"] == pytest.approx(1.02062, rel=1e-5)


@pytest.fixture
def small(monkeypatch):
    """Fewer networks, so that it takes a second or two."""
    monkeypatch.setattr(network2009, "_NETWORKS", 1)
    monkeypatch.setattr(network2009, "RULES", ("theorem", "best"))
    monkeypatch.setattr(network_growth, "WORST_SIZES", (6, 8, 11, 16))
    monkeypatch.setattr(network_growth, "TRIANGULATION_SIZES", (10, 20, 40, 80))


def test_reproduce_network2009(small, tmp_path, capsys):
    picture, table, figures = (tmp_path / f"x.{kind}" for kind in ("png", "csv", "json"))
    arguments = ["reproduce", "network2009", "--trials", "5", "--plot", str(picture)]
    assert main([*arguments, "--csv", str(table), "--json", str(figures)]) == 0
    assert "bound" in capsys.readouterr().out
    assert picture.stat().st_size > 20_000
    result = json.loads(figures.read_text())
    assert_table_holds(table, result, least=200)
    assert [row["loops"] for row in result["accuracy"]] == list(network2009.LOOPS)
    for rules in result["convergence"].values():
        for row in rules.values():
            assert row["largest_difference"] < 1e-3
    # Theorem 19 holds for the cycles of a tree; elsewhere not always.
    assert {row["printed_holds"] for row in result["convergence"]["bfs"].values()} == {1.0}
    assert result["convergence"]["minimum"]["theorem"]["printed_holds"] < 1
    for row in result["asynchronous"]:
        assert row["largest_error_rad"] < 1e-11
    # Figs 5 and 6: 45 edges, 36 loops that close.
    run = result["run"]
    assert np.shape(run["edge_angles"]) == (network2009._SHOWN_STEPS + 1, 45)
    assert np.shape(run["loop_errors"]) == (network2009._SHOWN_STEPS + 1, 36)
    assert np.abs(run["loop_errors"][-1]).max() < 1e-3 * np.abs(run["loop_errors"][0]).max()
    assert run["rms_estimated"] < run["rms_measured"]


def test_network2009_takes_points_footprints_and_a_variance(small, tmp_path, capsys):
    points, figures = tmp_path / "points.csv", tmp_path / "x.json"
    points.write_text("x,y\n0,0\n10,0\n10,10\n0,10\n5,4\n")
    picture = ["--plot", str(tmp_path / "x.png"), "--json", str(figures)]
    arguments = ["reproduce", "network2009", "--trials", "20", "--positions", str(points), *picture]
    assert main([*arguments, "--footprint", "11", "20", "--variance", "0.02"]) == 0
    result = json.loads(figures.read_text())
    assert [(row["footprint"], row["edges"]) for row in result["accuracy"]] == [(11, 8), (20, 10)]
    assert result["variance"] == pytest.approx([0.02, 0.02])
    for row in result["accuracy"]:  # 4 standard deviations of 20 trials of m edges
        tolerance = 4 * np.sqrt(2 / (20 * row["edges"]))
        assert row["mse"]["measured"] == pytest.approx(0.04, rel=tolerance)
    # Sides, half diagonals and diagonals of the square: none of the radii is a distance.
    places = network2009.read_points(str(points))
    assert network2009._default_footprints(places) == pytest.approx(
        [8.905, 12.071, 14.425], abs=1e-3
    )
    assert main([*arguments, "--footprint", "5"]) == 2
    assert "footprint must connect all 5 points, got 5" in capsys.readouterr().err
    points.write_text("x,y\n0,0\n1,a\n")
    assert main(arguments) == 2
    assert "line 3: must be two numbers x,y, got '1,a'" in capsys.readouterr().err
    points.write_text("x,y\n0,0\n1,2\n")
    assert main(arguments) == 2
    assert "must have three points or more, got 2" in capsys.readouterr().err
    points.write_text("0,0\n1,1\n2,0\n")
    assert main(arguments) == 2
    assert "must have the header x,y" in capsys.readouterr().err
    assert main(["reproduce", "doa2019", "--variance", "0.1"]) == 2
    assert "doa2019 has no option --variance" in capsys.readouterr().err


def test_kappa_grows_as_section_iv_e_says():
    """O(1 / n^3) for cycles of n edges in complete graphs, O(1 / n) for triangulations."""
    growth = network_growth.kappa_growth(np.random.default_rng(0))
    assert growth["worst"]["slope"]["trace"] == pytest.approx(-3, abs=0.15)
    assert growth["triangulation"]["slope"]["trace"] == pytest.approx(-1, abs=0.1)
    for row in growth["triangulation"]["rows"]:
        assert row["edges"] <= 3 * row["nodes"] - 6  # Theorem 7
        assert row["loops"] == row["edges"] - row["nodes"] + 1  # Theorem 5
        assert row["lambda_max"] < 6  # a triangle shares at most three edges
        assert row["kappa"]["theorem"] > 2 / 7


def test_the_limit_of_all_trials_at_once_is_the_iterations():
    rng = np.random.default_rng(2)
    edges = network2009._seen(network2009.PLACES, 0.6)
    C = cycle_matrix(edges, 10)
    y = proj(rng.normal(0, 0.4, (5, len(edges))))
    together = network2009.limit(C.toarray(), y)
    for one, psi in zip(y, together, strict=True):
        run = consensus.cycle_iteration(edges, one, 10, C)
        np.testing.assert_allclose(psi, run.psi, atol=1e-8)


def test_the_same_seed_gives_the_same_figures(small, monkeypatch):
    monkeypatch.setattr(network2009, "BASES", network2009.BASES[:1])
    monkeypatch.setattr(network2009, "LOOPS", network2009.LOOPS[:1])
    results = [network2009.network_experiment(2, seed) for seed in (3, 3, 4)]
    assert results[0] == results[1] != results[2]
