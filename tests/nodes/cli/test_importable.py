"""Commands that want a recording say how to make one of what they are given."""

import pytest
from test_bad_input_commands import main

POSES = "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + "".join(
    f"{1.7e9 + i},{48 + 0.001 * i},11.0,1000,0,0,0\n" for i in range(5)
)


@pytest.mark.parametrize(
    ("command", "made"),
    [
        ("info", "poses.csv"),
        ("check", "poses.csv"),
        ("process", "poses.csv"),
        ("adjust", "poses.csv"),
        ("adjust", "."),
        ("info", "."),
    ],
)
def test_importable_input_is_named_with_the_command(tmp_path, capsys, monkeypatch, command, made):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.csv").write_text(POSES)
    (tmp_path / "flight.toml").write_text('[flight]\nname = "x"\n')
    options = ["-o", "out.mcap"] if command == "process" else []
    assert main([command, made, *options]) == 1
    err = capsys.readouterr().err
    kind = "trajectory as CSV" if made == "poses.csv" else "flight folder"
    assert kind in err and f"triline import {made} -o" in err and err.count("\n") == 1
