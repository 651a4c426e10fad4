"""What is said of additional parameters in flight: whether the network sees them yet, sigma, with what they go."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from notebook import Notebook
from recording_file import write_recording
from rich.console import Console

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.cli.view import show
from triline.nodes.monitor.monitor import Monitor, screen
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.report.analysis import analyse
from triline.nodes.report.page import page
from triline.nodes.report.source import read
from triline.nodes.simulator.simulator import Simulator
from triline.solver.camera.self_calibration import boresight, tls
from triline.solver.simulation.camera_errors import drawn_parameters, simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.quality.determinability import ESTIMATED, NOT_YET
from triline.solver.window.results import WindowOptions
from triline.solver.window.window import Window

EPOCH = 1_700_000_000_000_000_000
SEED = 2
PLAN = FlightPlan(strip_s=36.0, lead_in_s=2.0, lead_out_s=1.0)
STATED = tls(PLAN.camera).scaled(0.1)


@pytest.fixture(scope="module")
def flown():
    """What a flight with a camera that is off leaves on the bus; reports with the covariance of the camera then."""
    simulation = simulate_with_camera_errors(
        PLAN, SEED, STATED, ErrorModel(attitude_rate_hz=100.0), ObservationPlan(tie_points_per_s=8.0, check=5)
    )
    navigator, adjuster = (
        Navigator(),
        Adjuster(grid_hz=5.0, self_calibration="tls18", camera_sigma=0.1, update_s=0.3, update_rays=1000),
    )
    messages, kept = [], []
    for message in Simulator(simulation).messages(EPOCH):
        messages.append(message)
        given = [message] if message.topic in Adjuster.inputs else []
        if message.topic in Navigator.inputs:
            out = list(navigator.step(message))
            messages += out
            given += [o for o in out if o.topic in Adjuster.inputs]
        for one in given:
            found = list(adjuster.step(one))
            messages += found
            for o in found:
                if o.topic == "adjustment/report" and o.body.parameters:
                    state = adjuster._window.state
                    kept.append((o.body, state.covariance(adjuster._window.network.camera_columns)))
    messages += list(navigator.finish()) + list(adjuster.finish())
    return messages, kept


def of_camera(report):
    return {p.name: p for p in report.parameters if p.name in STATED.names}


def test_status_follows_the_network_as_it_grows(flown):
    """None at the start, some later, and what is called estimated is known, and right."""
    _, kept = flown
    reports = [of_camera(report) for report, _ in kept]
    number = [sum(p.status == ESTIMATED for p in report.values()) for report in reports]
    assert all(len(report) == 18 for report in reports)
    assert number[0] == 0 and number[-1] >= 4 and len(set(number)) >= 4
    assert np.mean(number[-10:]) > np.mean(number[len(number) // 4 : len(number) // 2]) > 0
    first, last = reports[0], reports[-1]
    apriori = dict(zip(STATED.names, STATED.apriori_sigma, strict=True))
    assert all(first[n].status == NOT_YET and first[n].reason for n in apriori)
    assert all(last[n].sigma < 1.001 * first[n].sigma < 1.01 * apriori[n] for n in apriori)
    truth = dict(zip(STATED.names, drawn_parameters(SEED, STATED), strict=True))
    for name, p in last.items():
        assert p.reason or p.status == ESTIMATED
        if p.status == ESTIMATED:  # below half the a-priori sigma if those not determined were known
            assert p.sigma < 0.8 * apriori[name] and abs(p.value - truth[name]) < 4.0 * p.sigma
    open_ = [n for n, p in last.items() if p.status == NOT_YET]
    assert open_ and all(last[n].sigma > 0.0 for n in open_)


def test_the_strongest_correlation_is_that_of_the_covariance(flown):
    """Of the camera's parameters among each other, from the state itself; those of the strip may go with it more."""
    for report, covariance in flown[1][:: len(flown[1]) // 7]:
        sigma = np.sqrt(np.diag(covariance))
        among = covariance / np.outer(sigma, sigma) - np.eye(18)
        for i, name in enumerate(STATED.names):
            told = of_camera(report)[name]
            k = int(np.argmax(np.abs(among[i])))
            assert told.sigma == pytest.approx(sigma[i], rel=1e-6)
            assert abs(told.correlation) >= abs(among[i, k]) - 1e-6 and abs(told.correlation) <= 1.0
            if told.partner in STATED.names:
                assert told.correlation == pytest.approx(among[i, STATED.names.index(told.partner)], abs=1e-6)
            elif told.partner or told.correlation:
                assert told.partner in {p.name for p in report.parameters}


def test_the_monitor_says_how_many_and_which_not(flown):
    monitor = Monitor()
    seen = set()
    for message in flown[0]:
        if message.topic in ("adjustment/report", "event/log"):
            list(monitor.step(message))
            seen.add(monitor.overview.line().partition(" parameters")[0].rpartition("| ")[2])
    assert len(seen) >= 5  # it changes in flight
    view = monitor.overview
    assert f"{view.estimated} of 28 parameters estimated" in view.line()
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(screen(view, "platform"))
    text = console.export_text()
    worst = max((p for p in view.parameters if p.status != ESTIMATED), key=lambda p: abs(p.correlation))
    assert f"parameters: {view.estimated} of 28 estimated; not yet {worst.name} ({worst.correlation:+.2f}" in text
    list(monitor.step(replace(message, topic="adjustment/report", body=type(flown[1][0][0])())))
    assert len(monitor.overview.parameters) == 28  # a report without any, in a turn, forgets nothing


def test_the_report_has_status_time_and_correlation(flown, tmp_path):
    messages, kept = flown
    write_recording(tmp_path / "flight.mcap", sorted(messages, key=lambda x: x.stamp_ns))
    flight, held = read(tmp_path / "flight.mcap")
    result = analyse(flight, held)
    rows = {p["name"]: p for p in result["parameters"]}
    last = of_camera(kept[-1][0])
    for name, p in last.items():
        assert rows[name]["status"] == p.status and rows[name]["partner"] == p.partner
        assert (rows[name]["estimated_since_s"] is not None) == (p.status == ESTIMATED)
    since = [rows[n]["estimated_since_s"] for n, p in last.items() if p.status == ESTIMATED]
    assert len(set(since)) > 1 and all(0.0 < s < 45.0 for s in since)
    text = page(flight, result)
    assert "strongest correlation</th>" in text and f"{last['dc'].correlation:+.2f} {last['dc'].partner}</td>" in text


def test_what_is_not_yet_determined_is_drawn_faint(flown):
    messages, kept = flown
    notes = Notebook()
    show(sorted(messages, key=lambda x: x.stamp_ns), notes)
    last = of_camera(kept[-1][0])
    name = next(n for n, p in last.items() if p.status == ESTIMATED and n.startswith(("xp", "yp")))
    bright, faint = (notes.curves[f"plots/parameters/mm/{name}{end}"] for end in ("", "_open"))
    assert min(faint[0]) < min(bright[0]) and max(bright[0]) > max(faint[0]) - 1.0
    assert bright[1][-1] == pytest.approx(last[name].value)
    count = notes.curves["plots/parameters/determined/estimated"][1]
    assert count[0] < count[-1] == sum(p.status == ESTIMATED for p in kept[-1][0].parameters)
    assert "determined" in notes.layouts[-1].units


@pytest.mark.study
def test_boresight_lives_on_from_strip_to_strip():
    """Each strip has a shift of its own, known to 0.02 deg; the boresight is what all of them have in common."""
    squares, ratio = [], []
    for seed in range(1, 6):
        plan = FlightPlan(
            height_m=1000.0, strips=2, strip_s=14.0, turns=False, gap_s=8.0, lead_in_s=3.0, lead_out_s=2.0
        )
        stated = boresight(plan.camera).scaled(0.5)
        ties = ObservationPlan(tie_points_per_s=4.0, check=5)
        simulation = simulate_with_camera_errors(plan, seed, stated, ErrorModel(attitude_rate_hz=100.0), ties)
        sigma = {}

        def keep(now_s: float, window: Window, sigma=sigma) -> None:
            if window.strips:
                covariance = window.state.covariance(window.network.camera_columns)
                sigma[list(window.strips)[-1]] = np.sqrt(np.diag(covariance))

        found = adjust_online(
            simulation, navigate(simulation), WindowOptions(grid_hz=5.0), stated, live=False, watch=keep
        )
        assert found.window is not None
        off = found.window.state.values(found.window.network.camera_columns) - drawn_parameters(seed, stated)
        squares.append((off / sigma["S2"]) ** 2)
        ratio.append(sigma["S2"][:2] / sigma["S1"][:2])
        if seed == 1:
            assert stated.unknown_names == ("boresight_omega", "boresight_phi", "boresight_kappa")
            assert (sigma["S1"][:2] > np.radians(0.018)).all()  # a strip alone knows it no better than its shift
    assert np.mean(ratio) == pytest.approx(np.sqrt(0.5), abs=0.08)
    assert 0.3 < np.mean(squares) < 2.2
