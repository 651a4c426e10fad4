"""`triline study control`: what it chooses, that its rows are those of `triline adjust`, what fails, bad input."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace as Names

import numpy as np
import pytest
from block_writer import write_block
from command_line import answer
from matplotlib.backends.backend_svg import FigureCanvasSVG

from triline.nodes.batch.simulated_scenes import SceneSimulation, write_simulated_scenes
from triline.nodes.cli import control_runs, main, study_control
from triline.nodes.cli.control_runs import Configuration, SceneBlock, Settings, pool_of, with_control
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.scene_block import read_scene_block
from triline.nodes.report.style import styled
from triline.solver.adjustment.block_data import Apriori, BlockData, ImagePoints, KnownPoints
from triline.solver.adjustment.confidence_set import confidence_set
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import LocalFrame
from triline.solver.models.ppm import PpmOptions
from triline.solver.simulation.network import parallel_and_cross, scatter_points, simulate_network

CONTROL_M = 0.02
#: Errors of the trajectory, of order 2 in two segments, that the nine unknowns of DGR cannot follow.
STATED = {
    "offset_sigma_m": (0.3, 0.3, 0.3), "shift_sigma_deg": (0.01, 0.01, 0.02), "drift_sigma_deg": (0.01, 0.01, 0.02),
    "first_sigma_m": (0.3, 0.3, 0.3), "first_sigma_deg": (0.02, 0.02, 0.02),
    "second_sigma_m": (0.3, 0.3, 0.3), "second_sigma_deg": (0.02, 0.02, 0.02),
}  # fmt: skip
CURVED = PpmOptions.from_settings(STATED | {"segments": 2})


@pytest.fixture(scope="module")
def air(tmp_path_factory):
    """Three strips of the ADS40 over 40 points, 26 of them known to 2 cm; the trajectory errs in pieces."""
    camera, rng = preset("ads40"), np.random.default_rng(4)
    ground = scatter_points(40, (-1400, 1400, -1100, 1100), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)
    lines = parallel_and_cross(camera, 2000.0, 2, 1, 3000.0)
    network = simulate_network(camera, lines, ground, {}, range(26), CURVED, rng, pose_rate_hz=20.0).network
    rays, known = network.rays, network.check
    time = np.concatenate([s.time_of(rays.line[rays.strip == k]) for k, s in enumerate(network.strips)])
    order = np.concatenate([np.flatnonzero(rays.strip == k) for k in range(len(network.strips))])
    image = ImagePoints(
        rays.point[order], rays.strip[order], rays.ccd[order], rays.line[order], rays.sample[order],
        np.full(len(order), 0.3), time,
    )  # fmt: skip
    given = KnownPoints(
        tuple(network.point_ids[p] for p in known.point),
        known.xyz_l + rng.normal(0.0, CONTROL_M, known.xyz_l.shape),
        np.tile(CONTROL_M**2 * np.eye(3), (len(known), 1, 1)),
        ("control",) * len(known),
    )
    frame = LocalFrame(0.0, 0.0, 0.0)
    block = BlockData(
        "curved", frame, camera, network.strips, network.point_ids, given, image, Apriori(0.3, STATED)
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("control") / "air"
    write_block(folder, block)
    return folder


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("control") / "pair"
    arguments = ["--satellite", "spot5-hrs", "--points", "40", "--control", "9", "--check", "15", "--seed", "3"]
    assert main(["simulate", "-q", "-o", str(folder), *arguments]) == 0
    return folder


def study(capsys, folder, *words):
    return answer(capsys, "study", "control", folder, "--jobs", 1, *words)


def as_adjusted(capsys, folder, found, row):
    """What `triline adjust` says of the same control and options."""
    copy = folder.with_name("again")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    control = set(found["control"][str(row["control"])])
    with open(folder / "ground_points.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for point in rows:
        point["role"] = "control" if point["point"] in control else "check"
    with open(copy / "ground_points.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return answer(capsys, "adjust", copy, *row["options"].split())


def same(row, result):
    assert row["n_check"] == result["check"]["n"] and row["redundancy"] == result["redundancy"]
    for mine, theirs in ((row["sigma0"], result["sigma0"]), (row["rmse_m"], result["check"]["rmse_m"]),
                         (row["sigma_m"], result["check"]["sigma_m"])):  # fmt: skip
        np.testing.assert_allclose(mine, theirs, rtol=1e-6)


def test_the_model_that_follows_the_errors_is_found(air, tmp_path, capsys):
    table, plot = tmp_path / "c.csv", tmp_path / "c.svg"
    words = ["--control", "0", "4", "9", "--model", "dgr", "ppm", "--segments", "2", "--selfcal", "none"]
    found = study(capsys, air, *words, "--csv", str(table), "--plot", str(plot))
    rows = found["rows"]
    assert len(rows) == 3 * 3 and len(found["common_check"]) == 26 - 9
    # control is spread out and nested, the rest are check points
    assert [len(found["control"][n]) for n in "049"] == [0, 4, 9]
    assert set(found["control"]["4"]) < set(found["control"]["9"])
    assert [row["n_check"] for row in rows[::3]] == [26, 22, 17]
    by = {(row["control"], row["model"], row["order"]): row for row in rows}
    best = rows[found["best"]]
    assert (best["model"], best["segments"], best["control"]) == ("ppm", 2, 9)
    assert by[9, "dgr", None]["told_apart"] and not by[9, "dgr", None]["sigma0_passed"]
    assert by[9, "ppm", 2]["as_good"] and by[9, "ppm", 2]["n_unknowns"] == 3 * 2 * 18
    assert 0.6 < by[9, "ppm", 2]["rmse_3d_common_m"] / by[9, "ppm", 2]["expected_3d_common_m"] < 1.5
    assert all(by[0, model, order]["told_apart"] for model, order in (("dgr", None), ("ppm", 1), ("ppm", 2)))
    assert any("9 control points, PPM 2 segments" in line for line in found["verdict"])
    # rows are what `triline adjust` gives, and the table is the same in all forms
    for row in (by[9, "ppm", 2], by[4, "dgr", None]):
        same(row, as_adjusted(capsys, air, found, row))
    with open(table, newline="") as file:
        written = list(csv.DictReader(file))
    assert [float(w["rmse_Z_m"]) for w in written] == pytest.approx([r["rmse_m"][2] for r in rows], rel=1e-4)
    assert "<svg" in plot.read_text()


def test_many_processes_print_what_one_does(pair, capsys):
    words = ["study", "control", str(pair), "-q", "--control", "4", "9", "--model", "dgr", "--selfcal", "none", "lens"]
    printed = []
    for jobs in ("1", "2"):
        assert main([*words, "--jobs", jobs]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] and printed[0].count("DGR") >= 4 and "best: " in printed[0]


def test_where_no_processes_can_be_had_one_does_all(pair, monkeypatch, capsys):
    def none(*args, **kwargs):
        raise NotImplementedError("no semaphores here")

    monkeypatch.setattr(control_runs, "WorkerPool", none)
    words = ["study", "control", str(pair), "-q", "--control", "4", "9", "--model", "dgr", "--selfcal", "none"]
    assert main([*words, "--jobs", "2"]) == 0
    assert "best: " in capsys.readouterr().out


def test_runs_that_fail_are_told(air, tmp_path, capsys):
    table, plot = tmp_path / "c.csv", tmp_path / "c.png"
    words = ["--control", "9", "--model", "dgr", "ppm", "--segments", "900", "--selfcal", "none"]
    page = tmp_path / "c.html"
    found = study(capsys, air, *words, "--csv", str(table), "--plot", str(plot), "--page", str(page))
    failed = [row for row in found["rows"] if row["segments"] == 900]
    assert len(found["rows"]) == 3 and len(failed) == 2
    for row in failed:
        assert row["note"].startswith("failed: --segments 900: more than the image points carry")
        assert row["rmse_m"] == [None] * 3 and row["sigma0"] is None and not row["as_good"]
    assert "2 of 3 runs failed or could not be compared; the table says why" in found["verdict"]
    with open(table, newline="") as file:
        assert sum("failed: " in row["note"] for row in csv.DictReader(file)) == 2
    assert plot.read_bytes().startswith(b"\x89PNG")
    text = page.read_text()
    assert text.count("failed: --segments 900") == 2 and "<svg" in text and found["verdict"][0] in text
    assert main(["study", "control", str(air), "-q", *words, "--jobs", "1"]) == 0
    assert capsys.readouterr().out.count("failed: --segments 900") == 2


def test_second_steps_and_a_wrong_check_point(air, tmp_path, capsys):
    block = shutil.copytree(air, tmp_path / "block")
    with open(block / "project.toml", "a") as file:
        file.write("[trajectory.then]\nmerge = false\nfixes = 5\n")
    data = read_block(block)
    base = ["--control", "9", "--selfcal", "none", "--model"]
    found = study(capsys, block, *base, "dgr", "--then", "none", "lim", "--fixes", "6")
    one, two = found["rows"]
    assert (two["then"], two["fixes"], two["n_unknowns"]) == ("lim", 6, 3 * 6 * 6)
    assert one["told_apart"] and two["options"] == "--model dgr --then lim --fixes 6"
    same(two, as_adjusted(capsys, block, found, two))
    wrong = found["common_check"][3]
    xyz = data.ground.xyz_l.copy()
    xyz[data.ground.id.index(wrong)] += (0.0, 0.0, 5.0)
    write_block(block, replace(data, ground=replace(data.ground, xyz_l=xyz)))
    again = study(capsys, block, *base, "ppm", "--segments", "2", "--order", "2")
    assert list(again["suspicious_check"]) == [wrong] and again["suspicious_check"][wrong] > 10.0


def test_few_check_points_tell_nothing(air, capsys):
    found = study(capsys, air, "--control", "9", "23", "--model", "dgr", "ppm", "--segments", "2", "--selfcal", "none")
    assert len(found["common_check"]) == 3 and not found["check_points_enough"]
    assert not any(row["told_apart"] for row in found["rows"])
    assert any("common check points: 3, too few" in line and "41 %" in line for line in found["verdict"])
    assert any("by predicted sigmas alone: 23 control points" in line for line in found["verdict"])


def test_scenes(pair, capsys):
    found = study(capsys, pair, "--control", "0", "4", "9", "--model", "dgr", "--selfcal", "none", "lens", "--snoop")
    assert found["axes"] == ["east", "north", "up"] and len(found["points"]["always"]) == 15
    assert [row["n_check"] for row in found["rows"]] == [24, 24, 20, 20, 15, 15]
    row = found["rows"][4]
    assert row["n_unknowns"] == 18 and row["rmse_3d_common_m"] < 0.2 * found["rows"][0]["rmse_3d_common_m"]
    row["options"] += " --snoop"
    same(row, as_adjusted(capsys, pair, found, row))
    # all known points may be control where a sigma is given
    found = study(capsys, pair, "--control", "12", "--control-sigma", "0.5", "--model", "dgr", "--selfcal", "none")
    assert found["rows"][0]["n_check"] == 12 and len(found["points"]["possible"]) == 24


def test_scenes_without_a_rigorous_model(pair, tmp_path, capsys):
    out, block = tmp_path / "result", tmp_path / "rpc"
    assert main(["adjust", str(pair), "-q", "-o", str(out)]) == 0
    block.mkdir()
    for ccd in "FB":
        shutil.copy(out / "rpc" / f"scene_{ccd}.RPB", block)
    shutil.copy(pair / "ground_points.csv", block)
    text = (pair / "image_points.csv").read_text()
    (block / "image_points.csv").write_text(text.replace(",scene,F,", ",F,,").replace(",scene,B,", ",B,,"))
    (block / "project.toml").write_text("".join(f'[scenes.{n}]\nmetadata = "scene_{n}.RPB"\n' for n in "FB"))
    capsys.readouterr()
    found = study(capsys, block, "--control", "4", "9")
    assert [row["configuration"] for row in found["rows"]] == 2 * ["RPC shift", "RPC affine"]
    assert [row["n_unknowns"] for row in found["rows"]] == 2 * [4, 12]
    assert main(["study", "control", str(block), "--model", "dgr"]) == 1
    assert "--model: no image of rpc has a rigorous model" in capsys.readouterr().err


BAD = {
    "no check points left": (["--control", "26"], "--control 26: wanted 0 to 25 for curved; of its 26 known points"),
    "less than none": (["--control", "-1"], "--control -1: wanted 0 to 25"),
    "order of dgr": (["--model", "dgr", "--order", "1"], "--order is for the model ppm; asked for is dgr"),
    "sets": (["--sets", "scene"], "--sets goes with a block of satellite scenes"),
    "correction": (["--correction", "shift"], "--correction goes with a block of satellite scenes"),
    "segments": (["--segments", "0"], "--segments 0, wanted 1 at least"),
    "sigma": (["--control-sigma", "-1"], "--control-sigma -1, wanted more than 0"),
    "picture": (["--plot", "c.txt"], "--plot c.txt: wanted a name that ends in .png"),
    "folder of the table": (["--csv", "nowhere/c.csv"], "nowhere/c.csv: no folder nowhere"),
    "nothing runs": (["--model", "ppm", "--segments", "900", "--order", "2", "--selfcal", "none"],
                     "none of 3 runs could be adjusted; --segments 900"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_line(name, air, tmp_path, monkeypatch, capsys):
    words, wanted = BAD[name]
    monkeypatch.chdir(tmp_path)
    assert main(["study", "control", str(air), "-q", "--jobs", "1", *words]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("triline study: ") and wanted in error, error


def test_blocks_that_cannot_be_checked(air, pair, tmp_path, capsys):
    with pytest.raises(SystemExit) as refused:
        main(["study", "control", str(air), "--model", "spline"])
    assert refused.value.code == 2 and "invalid choice: 'spline'" in capsys.readouterr().err
    assert main(["study", "control", str(pair), "--model", "wander"]) == 1
    assert "--model wander: does not go with satellite scenes, wanted dgr, ppm, lim" in capsys.readouterr().err
    bare = shutil.copytree(air, tmp_path / "bare")
    header = (air / "ground_points.csv").read_text().splitlines()[0]
    (bare / "ground_points.csv").write_text(header + "\n")
    assert main(["study", "control", str(bare)]) == 1
    assert capsys.readouterr().err == (
        "triline study: curved: no known points, so that nothing can be checked; wanted some in ground_points.csv\n"
    )
    # known points without a sigma: checks without control, and no control where it is asked for
    rows = (pair / "ground_points.csv").read_text().replace(",0.5,0.5,0.5,control", ",,,,check")
    bare = shutil.copytree(pair, tmp_path / "unsure")
    (bare / "ground_points.csv").write_text(rows)
    found = study(capsys, bare, "--model", "dgr", "--selfcal", "none")
    assert [row["control"] for row in found["rows"]] == [0]
    assert main(["study", "control", str(bare), "--control", "4"]) == 1
    assert "wanted 0 to 0 for simulated spot5-hrs; 24 of its 24 known points state no sigma" in capsys.readouterr().err


def only(folder, copy, **wanted):
    """The block with the image points of one strip or CCD line alone."""
    shutil.copytree(folder, copy)
    with open(folder / "image_points.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    kept = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    assert 0 < len(kept) < len(rows)
    with open(copy / "image_points.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(kept)
    return copy


@pytest.mark.parametrize("kind", ["a scene alone", "a strip of one CCD line"])
def test_points_of_one_image_point_are_compared_in_plan(kind, pair, air, tmp_path, capsys):
    """A block of one scene was refused: no point has two image points."""
    if kind == "a scene alone":
        folder, words = only(pair, tmp_path / "one", ccd="F"), ["--control", "4", "9"]
    else:
        folder, words = only(air, tmp_path / "one", strip="C1", ccd="N"), ["--control", "4", "--selfcal", "none"]
    picture, page = tmp_path / "c.svg", tmp_path / "c.html"
    words += ["--model", "dgr", "--plot", str(picture), "--page", str(page)]
    found = study(capsys, folder, *words)
    assert found["compared"] == "in plan" and found["points"]["possible"]
    best = found["rows"][found["best"]]
    assert best["rmse_m"][2] is None and best["sigma_m"][2] is None
    assert 0.4 < best["rmse_3d_common_m"] / best["expected_3d_common_m"] < 1.6
    for row in found["rows"]:
        single = as_adjusted(capsys, folder, found, row)["check_single"]
        assert row["n_check"] == single["n"] > 5
        np.testing.assert_allclose(row["rmse_m"][:2], single["rmse_m"][:2], rtol=1e-6)
        np.testing.assert_allclose(row["sigma_m"][:2], single["sigma_m"][:2], rtol=1e-6)
        if row["n_check"] == len(found["common_check"]):
            expected = np.hypot(*single["expected_m"][:2])
            assert row["expected_3d_common_m"] == pytest.approx(expected, rel=1e-6)
    assert "in plan" in page.read_text() and "<svg" in picture.read_text()
    assert main(["study", "control", str(folder), "--jobs", "1", "--control", "4", "--model", "dgr"]) == 0
    assert "compared in plan, at their given heights" in capsys.readouterr().out


@pytest.mark.study
def test_how_often_check_points_tell_the_wrong_way(tmp_path):
    """More control, and the model of the true errors, are better; check points of one block say so or say nothing."""
    models = {"dgr": Configuration("dgr"), "ppm": Configuration("ppm", segments=2, order=2)}
    told = {"9 before 4": 0, "4 before 9": 0, "dgr before ppm": 0, "ppm before dgr": 0}
    for seed in range(100, 160):
        folder = tmp_path / str(seed)
        write_simulated_scenes(folder, SceneSimulation("spot5-hrs", points=50, control=9, check=25, seed=seed))
        block = SceneBlock(read_scene_block(folder))
        pool = pool_of(block)
        ids, length = [block.ground.id[k] for k in pool.always], {}
        for number in (4, 9):
            part, _ = with_control(block, pool, number)
            for name, configuration in models.items():
                found = part.run(configuration, Settings())
                mine = [found.check.index(id) for id in ids]
                length[number, name] = np.linalg.norm(found.difference_m[mine], axis=1)
        for one, other, names in (
            ((9, "dgr"), (4, "dgr"), ("9 before 4", "4 before 9")),
            ((9, "dgr"), (9, "ppm"), ("dgr before ppm", "ppm before dgr")),
        ):
            kept = confidence_set([length[one], length[other]])
            if not kept.all():
                told[names[0] if kept[0] else names[1]] += 1
    print(told)
    assert told["4 before 9"] <= 4 and told["ppm before dgr"] <= 4
    assert told["9 before 4"] >= 15 and told["dgr before ppm"] >= 12


@pytest.mark.parametrize("largest_m", [0.024, 0.06, 0.3, 40.0])
def test_metres_below_the_picture_can_be_read(largest_m):
    run = Names(configuration=Names(label="PPM 4 segments order 1, tls18"), control=4)
    rows = [Names(run=run, rmse_m=np.full(3, size), sigma_m=np.full(3, 1.1 * size)) for size in (0.018, largest_m)]
    given = Names(block=Names(axes=("X", "Y", "Z")), pool=Names(single=False), control={4: ()}, rows=rows, best=None)
    with styled():
        figure = study_control._figure(given)
        FigureCanvasSVG(figure)
        figure.draw_without_rendering()
        for axes in figure.axes:
            low, high = axes.get_xlim()
            labels = zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
            shown = [label for at, label in labels if low <= at <= high]
            shown += [label for label in axes.get_xticklabels(minor=True) if label.get_text()]
            boxes = sorted((label.get_window_extent() for label in shown), key=lambda box: box.x0)
            assert len(boxes) >= 2 and all(a.x1 < b.x0 for a, b in pairwise(boxes))
            assert not any("e" in label.get_text() for label in shown)
