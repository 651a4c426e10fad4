"""What cannot be written is refused before the work begins, under the name that was asked for."""

from __future__ import annotations

import pytest

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.new_file import new_file
from triline.nodes.formats.table import write_table


@pytest.mark.parametrize(
    ("study", "work", "option"),
    [
        ("rectification", "compare", "--csv"),
        ("sensitivity", "study", "--map-csv"),
        ("misspecified", "_flights", "--page"),
        ("regularisation", "conditions", "--plot"),
    ],
)
def test_a_study_without_a_folder_for_its_table_does_not_begin(study, work, option, monkeypatch, capsys):
    """It computed first, for hours where it has many flights."""

    def begun(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(f"triline.nodes.cli.study_{study}.{work}", begun)
    assert main(["study", study, option, "nowhere/file.png"]) == 1
    assert capsys.readouterr().err == "triline study: nowhere/file.png: no folder nowhere\n"


@pytest.mark.parametrize(("study", "work"), [("rectification", "compare"), ("regularisation", "conditions")])
def test_a_plot_of_another_kind_is_refused_before_the_work(study, work, tmp_path, monkeypatch, capsys):
    """It was a fault in triline, after the work."""

    def begun(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(f"triline.nodes.cli.study_{study}.{work}", begun)
    plot = tmp_path / "plot.txt"
    assert main(["study", study, "--plot", str(plot)]) == 1
    assert capsys.readouterr().err == f"triline study: --plot {plot}: wanted a name that ends in .png, .svg or .pdf\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("-o x.jpg", "x.jpg: a GeoTIFF is written, wanted a name that ends in .tif or .tiff"),
        (
            "-o x.vrt",
            "x.vrt: a GeoTIFF is written, wanted a name that ends in .tif or .tiff; --mosaic writes virtual rasters",
        ),
        ("-o x.tif --sigma s.PNG", "s.PNG: a GeoTIFF is written, wanted a name that ends in .tif or .tiff"),
        ("--sensor x.RPB -o x.jp2", "x.jp2: a GeoTIFF is written, wanted a name that ends in .tif or .tiff"),
        ("--sensor x.RPB -o x --mask m.img", "m.img: a GeoTIFF is written, wanted a name that ends in .tif or .tiff"),
        (
            "--mosaic -o x.png",
            "x.png: a GeoTIFF or a virtual raster is written, wanted a name that ends in .tif, .tiff or .vrt",
        ),
        ("--mosaic -o x --seam-lines s.tif", "s.tif: GeoJSON is written, wanted a name that ends in .geojson or .json"),
        ("--mosaic -o x.vrt --stac s.xml", "s.xml: JSON is written, wanted a name that ends in .json or .geojson"),
        # what is good: it is the input that is not there
        ("-o x.TIFF", "in.mcap: no such file"),
        ("-o x", "in.mcap: no such file"),
        ("-o x.v2", "in.mcap: no such file"),
        ("--mosaic -o x.vrt --sigma s.vrt", "in.mcap: no such file"),
    ],
)  # fmt: skip
def test_rectify_refuses_a_name_that_says_another_format(words, said, tmp_path, monkeypatch, capsys):
    """It wrote a GeoTIFF under the name of a picture."""
    monkeypatch.chdir(tmp_path)
    assert main(["rectify", "in.mcap", *words.split()]) == 1
    assert capsys.readouterr().err == f"triline rectify: {said}\n"


def test_a_writer_that_fails_names_the_file_and_not_its_part(tmp_path):
    """`triline view --rrd x.rrd` spoke of `.x.rrd.part` in a folder without permission."""
    with pytest.raises(UserError) as refused, new_file(tmp_path / "runs.csv") as part:
        part.symlink_to(tmp_path)
        write_table(part, {"a": [1]}, {})
    assert str(refused.value).startswith(f"{tmp_path / 'runs.csv'}: ")
