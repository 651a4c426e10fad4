"""``triline simulate --true``: what is not stated, as it is given, recorded and shown."""

import json

import pytest

from triline.nodes import registry
from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.world_settings import KEYS, world_from, world_terms
from triline.schemas import codec
from triline.solver.simulation.misstated import AS_STATED, Sine, Step

SHORT = ["--seconds", "8", "--lead-in", "1", "--attitude-rate", "20", "--ties", "2", "--seed", "5"]
TERMS = [
    "wander-factor=2", "wander-time-factor=0.333", "random-walk=0.03", "step=0.3", "step=0.1,0,0.2@12",
    "sine=0.02@0.1", "sine=0.01,0,0@3", "sine=0.01@3@25-45.5", "boresight=0.05,0,0.1", "lever-arm=0.2",
    "focal-length=20", "distortion=3", "clock=0.005",
    "tie-noise=t3", "tie-noise-factor=2", "gnss-datum=0.5", "control-datum=0,0,-0.5",
]  # fmt: skip


def test_every_key_is_read_and_written_back():
    world = world_from(TERMS)
    assert world_terms(world) == TERMS
    assert {term.partition("=")[0] for term in TERMS} == set(KEYS)
    assert world.steps == (Step((0.3, 0.3, 0.3)), Step((0.1, 0.0, 0.2), 12.0))
    assert world.sines[0] == Sine((0.02, 0.02, 0.02), 0.1)
    assert world.sines[2] == Sine((0.01, 0.01, 0.01), 3.0, 25.0, 45.5)
    assert world_from(["clock=5ms", "focal-length=0.02mm", "step=1@3s", "sine=1@2Hz"]) == world_from(
        ["clock=0.005", "focal-length=20um", "step=1 1 1@3", "sine=1@2"]
    )
    assert world_from([]) == AS_STATED and world_terms(AS_STATED) == []


@pytest.mark.parametrize(
    ("term", "said"),
    [
        ("foo=1", "true 'foo=1': wanted KEY=VALUE with KEY one of wander-factor"),
        ("clock", "true 'clock': wanted KEY=VALUE"),
        ("clock=soon", "true 'clock=soon': wanted clock=VALUE with VALUE s, or ms"),
        ("clock=5", "at most 1 s, got 5"),
        ("step=", "wanted step=VALUE with VALUE m of the GNSS"),
        ("step=0.3@", "wanted step=VALUE"),
        ("sine=0.02", "wanted sine=VALUE with VALUE deg@Hz"),
        ("sine=0.02@0", "frequency of a sine must be positive"),
        ("sine=0.02@3@45", "wanted sine=VALUE with VALUE deg@Hz"),
        ("sine=0.02@3@45-25", "a sine from 45 to 25 s, wanted a later end"),
        ("boresight=1,2", "one or roll,pitch,heading"),
        ("focal-length=nan", "wanted focal-length=VALUE with VALUE um"),
        ("tie-noise=t5", "t3 or normal"),
        ("wander-factor=-1", "must not be negative, got -1"),
    ],
)
def test_bad_terms_get_one_line(term, said, capsys, tmp_path):
    with pytest.raises(UserError) as error:
        world_from([term])
    assert said in str(error.value) and "\n" not in str(error.value)
    assert main(["simulate", "-o", str(tmp_path / "f.mcap"), *SHORT, "--true", term]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "f.mcap").exists()


def test_a_key_twice_is_refused():
    with pytest.raises(UserError, match="true clock: given twice"):
        world_from(["clock=1ms", "clock=2ms"])


def test_the_recording_tells_it_where_no_estimating_node_reads(tmp_path, capsys):
    paths = {name: tmp_path / f"{name}.mcap" for name in ("stated", "again", "other")}
    worlds = {
        "stated": [],
        "again": ["--true", "wander-factor=1"],
        "other": ["--true", "step=0.3", "--true", "clock=5ms"],
    }
    for name, path in paths.items():
        assert main(["simulate", "-q", "-o", str(path), *SHORT, *worlds[name]]) == 0
    assert paths["stated"].read_bytes() == paths["again"].read_bytes()

    capsys.readouterr()
    assert main(["info", str(paths["other"]), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["world"] == "step=0.3 clock=0.005"
    assert main(["info", str(paths["other"])]) == 0
    assert "true world, not stated: step=0.3 clock=0.005\n" in capsys.readouterr().out
    assert main(["info", str(paths["stated"])]) == 0
    assert "true world" not in capsys.readouterr().out
    assert not any(name.startswith("truth/") for n in registry.ESTIMATING for name in registry.node_class(n).inputs)

    # nothing that is stated says anything of it
    said = {name: stated_in(path) for name, path in paths.items()}
    assert said["other"] == said["stated"]


def stated_in(path):
    """Configuration and control of a recording, and covariances of its sensors, as bytes."""
    found = []
    for message in RecordingReader(path).sorted_messages():
        if message.topic.startswith("configuration/") or message.topic == "observation/control":
            found.append(codec.encode(message.body))
        elif message.topic == "sensor/gnss":
            found.append(tuple(message.body.position_covariance))
        elif message.topic == "sensor/attitude":
            found.append(tuple(message.body.covariance))
    return found


def test_image_lines_are_those_of_the_true_camera():
    settings = {"sensor": "ads40-small", "pixels": 200, "seconds": 8.0, "lead_in": 1.0, "images": True}
    flight = simulated_flight({**settings, "true": ["focal-length=50"]})
    stated = flight.simulation.flight.camera.focal_length_mm
    assert flight.imager.flight.camera.focal_length_mm == pytest.approx(stated + 0.05)
    assert simulated_flight(settings).imager.flight.camera.focal_length_mm == pytest.approx(stated)
    with pytest.raises(UserError, match="with images it wants ties as well"):
        simulated_flight({**settings, "true": ["tie-noise=t3"]})
    assert simulated_flight({**settings, "ties": 1.0, "true": ["tie-noise=t3"]}).simulation.world.heavy_tails


def test_a_configuration_file_may_name_one_or_several():
    short = {"seconds": 8.0, "lead_in": 1.0, "ties": 1.0}
    one, two = (simulated_flight({**short, "true": t}).simulation.world for t in ("clock=1ms", ["clock=1ms", "step=1"]))
    assert one.clock_s == two.clock_s == pytest.approx(0.001) and two.steps
    with pytest.raises(UserError, match="wanted KEY=VALUE"):
        simulated_flight({**short, "true": 5})
