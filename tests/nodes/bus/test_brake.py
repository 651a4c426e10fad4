"""Elastic time: how far behind a node may be before a flight waits for it."""

from __future__ import annotations

import threading

from bus_rig import free_port, wait_for

from triline.nodes.bus.brake import Brake
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message
from triline.schemas import messages as m


def test_a_flight_waits_for_who_has_two_seconds_of_work_at_whatever_rate():
    port, stop = free_port(), threading.Event()
    with Bus(port=port, source="player") as bus, Bus(port=port, source="adjuster") as node:
        at_rate = {rate: Brake(bus, "adjuster", stop, rate) for rate in (0.5, 1.0, 10.0)}
        wait_for(bus.peers, 20, "the link")
        node.announce("adjuster")
        wait_for(lambda: "adjuster" in bus.alive(), 20, "the node")

        def holds(lag_s: float) -> list[float]:
            """At which rates the flight waits once the node has said how far behind it is."""
            node.publish(Message("status/adjuster", 0, m.NodeStatus(node="adjuster", state="running", lag_s=lag_s)))
            for rate, brake in at_rate.items():
                told = lag_s / max(rate, 1.0)
                wait_for(lambda brake=brake, told=told: brake._lag_s.get("adjuster") == told, 20, "the status")
            return [rate for rate, brake in at_rate.items() if brake.wait() > 0]

        assert holds(1.0) == []
        assert holds(3.0) == [0.5, 1.0]
        assert holds(19.0) == [0.5, 1.0]
        assert holds(21.0) == [0.5, 1.0, 10.0]
        assert holds(15.0) == [0.5, 1.0, 10.0]  # until it is clearly less
        assert holds(13.0) == [0.5, 1.0]
        assert holds(1.0) == []
        assert at_rate[10.0].held_s > 0
