"""``triline study misspecified``: the table, its limits, and what it says beside them."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from places import MOTION, needs_motion

from triline.nodes.cli import main, study_misspecified
from triline.nodes.cli.misspecified_flights import Flown, KeptFlights
from triline.nodes.cli.misspecified_nodes import EPOCH_NS, answer_of, recording_of
from triline.nodes.report.evaluation import evaluate
from triline.nodes.report.flight import collect
from triline.nodes.report.source import messages_of
from triline.nodes.simulator.simulator import Simulator
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import (
    OBSERVED,
    ROWS,
    SETTINGS,
    FlightFigures,
    Quality,
    cell_of,
    cells_of,
    fly,
    online_quality,
    still_refused,
    through_window,
)
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import navigate
from triline.solver.window.results import NO_LOOK, TAKEN_BACK, Look, Refusal

GOOD = FlightFigures(
    seed=1, seconds=1.0, online=Quality(0.2, 1.0, 0.2, (0.1, 0.1, 0.1), (0.001, 0.001, 0.001), 1.0),
    online_in_truth=Quality(0.2, 1.0), direct_m=2.0, batch=Quality(0.2, 1.0), components=Quality(0.2, 1.0),
    component_factors={}, sigma0=1.0, rejected=0.001, control_refused=[], accused=[], light="good", words="",
    good_share=1.0,
)  # fmt: skip


def test_the_command(tmp_path, capsys):
    """Two rows of one short flight: as stated beside a GNSS datum, which shows in direct georeferencing at least."""
    table, page = tmp_path / "table.csv", tmp_path / "page.html"
    words = [
        "study",
        "misspecified",
        "--page",
        str(page),
        "--seeds",
        "1",
        "--seconds",
        "12",
        "--rows",
        "gnss-datum",
        "stated",
    ]
    assert main([*words, "--settings", "rtk", "--online", "window", "--jobs", "1", "--json", "--csv", str(table)]) == 0
    document = json.loads(capsys.readouterr().out)
    stated, datum = document["cells"]
    assert (stated["row"], datum["row"]) == ("stated", "gnss-datum")  # the baseline comes first
    assert datum["true"] == "gnss-datum=0.5" and len(datum["each"]) == 1
    assert datum["direct_m"] == pytest.approx(0.5 * np.sqrt(3), rel=0.5)
    assert datum["direct_m"] > 1.5 * stated["direct_m"]  # which has the noise of the lines in it, mostly in height
    for cell in document["cells"]:
        for name in ("online_m", "batch_m", "components_m", "points_nees", "orientation_nees", "sigma0"):
            assert np.isfinite(cell[name]) and cell[name] > 0
        assert sum(cell["lights"].values()) == 1
    with table.open() as rows:
        read = list(csv.DictReader(rows))
    assert [row["row"] for row in read] == ["stated", "gnss-datum"]
    assert float(read[1]["direct_m"]) == datum["direct_m"] and read[0]["limit light"] in ("0", "1")
    text = page.read_text()
    assert text.count("<svg") == 1 and "Stated: rtk" in text and "src=" not in text and 'href="http' not in text
    for cell in document["cells"]:
        assert f"<td>{cell['online_m']:.3f}</td>" in text and f"<td>{cell['worst_seed']}</td>" in text
    assert "limits hold; 2 flights" in text


@needs_motion
def test_a_recorded_motion_with_errors_on_top(capsys):
    """A boresight of 0.05 deg is 17 m on the ground, 20 km below; the images see it."""
    words = ["study", "misspecified", "--motion", str(MOTION), "--from", "900", "--seconds", "40", "--seeds", "1"]
    assert (
        main([*words, "--rows", "boresight", "--settings", "rtk", "--online", "window", "--jobs", "1", "--json"]) == 0
    )
    cell = json.loads(capsys.readouterr().out)["cells"][0]
    assert cell["direct_m"] > 17.0 and cell["online_m"] < 5.0


def test_a_motion_is_one_strip(capsys):
    assert main(["study", "misspecified", "--motion", str(MOTION), "--strips", "3"]) == 1
    assert "--motion or --strips" in capsys.readouterr().err
    assert main(["study", "misspecified", "--from", "800"]) == 1
    assert "wanted --motion" in capsys.readouterr().err


def test_what_is_told_is_the_true_wander():
    """In a world as stated there is nothing to tell; in another one the model has its correlation time."""
    heard = []

    def online(simulation, poses):
        heard.append(simulation.errors)
        return through_window(simulation, poses)

    for row in ("wander-time", "stated"):
        fly("rtk", row, 1, strip_s=8.0, online=online, told=True)
    assert heard == [replace(SETTINGS["rtk"], wander_time_s=10.0), SETTINGS["rtk"]]


def test_the_nodes_give_what_process_gives(tmp_path):
    """The figures are those of a processed recording; the window alone is close to them as long as nothing is wrong."""
    plan = FlightPlan(strip_s=12.0, lead_in_s=2.0, lead_out_s=1.0)
    flown = simulate(plan, 1, replace(SETTINGS["rtk"], attitude_rate_hz=20.0), OBSERVED)
    out = recording_of(flown, tmp_path)
    through, expected = answer_of(collect(messages_of(out))), evaluate(out)
    found = online_quality(flown, through, np.zeros(3))
    row = expected["points"]["adjusted_whole"]
    assert through.sigma0 == pytest.approx(expected["sigma0"], rel=1e-6)
    assert len(through.points) >= row["n"]
    assert found.points_m == pytest.approx(np.linalg.norm(row["rmse_m"]), rel=0.1)  # of two rays and more
    whole = expected["orientation"]["whole"]
    assert found.position_m == pytest.approx(whole["rmse_m"], rel=0.1)
    assert found.orientation_nees == pytest.approx(whole["nees"], rel=0.15)
    alone = online_quality(flown, through_window(flown, navigate(flown)), np.zeros(3))
    assert alone.points_m == pytest.approx(found.points_m, rel=0.1)


def test_a_flight_that_meets_all_limits():
    assert all(cell_of("rtk", "clock", [GOOD], 0.2).limits.values())


@pytest.mark.parametrize(
    ("change", "limit"),
    [
        ({"online": replace(GOOD.online, points_m=0.23)}, "as batch"),
        ({"online": replace(GOOD.online, points_nees=1.7)}, "NEES points"),
        ({"online": replace(GOOD.online, orientation_nees=0.5)}, "NEES orientation"),
        ({"online": replace(GOOD.online, points_nees=2.1)}, "light"),
        ({"direct_m": 0.1}, "as direct"),
        ({"rejected": 0.03}, "rejected"),
        ({"accused": ["F"]}, "no source accused"),
        ({"control_refused": ["GCP1 X"]}, "no control refused"),
    ],
)
def test_each_limit_can_be_missed(change, limit):
    limits = cell_of("rtk", "clock", [replace(GOOD, **change)], 0.2).limits
    missed = {name for name, held in limits.items() if not held}
    assert limit in missed
    assert missed <= {limit, "NEES points"}  # which a light that is not true comes with


def test_limits_by_row():
    """Fast vibration and heavy tails are excused in part; of wrong control nobody knows, so it is never good."""
    worse = replace(GOOD, online=replace(GOOD.online, points_m=0.5), rejected=0.1)
    missed = {row: {k for k, held in cell_of("rtk", row, [worse], 0.2).limits.items() if not held} for row in ROWS}
    assert missed["clock"] == {"as batch", "as stated", "rejected"}
    assert missed["sine-fast"] == {"rejected"}
    assert missed["noise-t3"] == {"as batch", "as stated"}
    assert "light" in missed["control-datum"]
    doubled = replace(GOOD, online=replace(GOOD.online, points_m=0.39), components=Quality(0.38))
    assert cell_of("rtk", "noise", [doubled], 0.2).limits["as stated"]


def test_the_stated_row_is_the_measure_of_its_setting():
    worse = replace(GOOD, seed=2, online=replace(GOOD.online, points_m=0.35))
    found = cells_of({("rtk", "stated"): [GOOD], ("rtk", "step"): [worse], ("def", "step"): [worse]})
    cells = {c.setting: c for c in found if c.row == "step"}
    assert not cells["rtk"].limits["as stated"] and cells["def"].limits["as stated"]
    assert cells["rtk"].worst_seed == 2


def test_what_was_taken_back_is_not_refused():
    look = Look("S1", "F", 1.0, 2.0, 0.3, 0.3)
    refusals = [
        Refusal("T1", look, "snooping"), Refusal("T2", look, "snooping"), Refusal("T1", look, TAKEN_BACK),
        Refusal("GCP1", NO_LOOK, "contradicts", coordinate="X"),
    ]  # fmt: skip
    assert still_refused(refusals) == {("T2", "S1", "F", ""), ("GCP1", "", "", "X")}


@pytest.mark.parametrize("seconds", [26.0, pytest.param(np.inf, marks=pytest.mark.study)])
def test_a_boresight_is_not_taken_for_the_camera(tmp_path, monkeypatch, seconds):
    """It was in this flight, after 16 s, in the end 380 times worse than calibrated, and its points were 0.26 m off."""
    plan = FlightPlan(strip_s=60.0, turns=False, gap_s=8.0, lead_in_s=5.0, lead_out_s=3.0)
    simulation = simulate(plan, 4, SETTINGS["rtk"], OBSERVED, world=ROWS["boresight"].world)
    everything, end_ns = Simulator.messages, EPOCH_NS + seconds * 1e9
    monkeypatch.setattr(Simulator, "messages", lambda *of: (m for m in everything(*of) if m.stamp_ns < end_ns))
    answer = answer_of(collect(messages_of(recording_of(simulation, tmp_path))))
    assert not any("calibration of the camera" in event for event in answer.events)
    assert online_quality(simulation, answer, np.zeros(3)).points_m < (0.2 if seconds > 60.0 else 0.3)


SHORT = ("study", "misspecified", "--seconds", "8", "--settings", "rtk", "--online", "window", "--jobs", "1", "--json")


def figures_of(capsys, *words: str) -> tuple[dict, str]:
    """What a short study says: without its processor time, and on the terminal."""
    assert main([*SHORT, *words]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    for cell in document["cells"]:
        for one in (cell, *cell["each"]):
            del one["seconds"]
    return document, err


def test_a_study_that_was_stopped_goes_on(tmp_path, capsys, monkeypatch):
    kept = tmp_path / "flights.jsonl"
    words = ("--rows", "stated", "--flights", str(kept))
    figures_of(capsys, *words, "--seeds", "1")
    with kept.open("a") as file:
        file.write('{"flight": {"setting"')  # killed while it wrote
    resumed, _ = figures_of(capsys, *words, "--seeds", "2")
    assert len(kept.read_text().splitlines()) == 2
    monkeypatch.setattr(study_misspecified, "fly", None)  # nothing is flown again
    again, err = figures_of(capsys, *words, "--seeds", "2")
    assert again == resumed and not err
    monkeypatch.undo()
    assert figures_of(capsys, *words[:2], "--seeds", "2")[0] == resumed


def test_flights_of_other_code_or_another_plan_are_not_taken(tmp_path, capsys, monkeypatch):
    kept = tmp_path / "flights.jsonl"
    words = ("--rows", "stated", "--seeds", "1", "--flights", str(kept))
    figures_of(capsys, *words)
    _, err = figures_of(capsys, *words, "--seconds", "9")
    assert len(kept.read_text().splitlines()) == 2 and not err
    monkeypatch.setattr(study_misspecified, "code_digest", lambda: "0123456789ab")
    _, err = figures_of(capsys, *words)
    assert err == f"{kept}: 2 of 2 flights are of other code and are not taken\n"
    assert len(kept.read_text().splitlines()) == 3


def test_figures_that_are_not_known_come_back_as_such(tmp_path):
    """JSON has no NaN: a batch that gave up must not become one without errors."""
    flown = Flown("rtk", "stated", 1, "strips 1", "0123456789ab")
    figures = replace(GOOD, batch=Quality(np.nan), component_factors={"image": np.nan}, events=["a", "b"])
    KeptFlights(tmp_path / "flights.jsonl").add(flown, figures)
    found = KeptFlights(tmp_path / "flights.jsonl").get(flown)
    assert repr(found) == repr(figures)


@pytest.mark.parametrize("text", ["name,x,y\n", "{}\n", "[1]\n", '{"flight": {}, "figures": {}}\n', "no line", "\n"])
def test_a_file_of_something_else_is_left_alone(text, tmp_path, capsys):
    foreign = tmp_path / "other.csv"
    foreign.write_text(text)
    assert main([*SHORT, "--flights", str(foreign)]) == 1
    assert capsys.readouterr().err.strip().endswith(f"{foreign}: line 1: wanted a flight of triline study misspecified")
    assert foreign.read_text() == text
    assert main([*SHORT, "--flights", str(tmp_path / "no" / "folder")]) == 1
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.study
@pytest.mark.parametrize("row", ["wander", "wander-time"])
def test_no_line_is_said_to_drift_where_the_attitude_wanders_farther_or_faster_than_stated(row):
    """The forward line of these flights was, for ten seconds of the second strip."""
    assert not fly("rtk", row, 11, 3, online=study_misspecified.ONLINE["nodes"]).accused
