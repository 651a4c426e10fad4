"""A byte order mark, as Windows editors write it, is no part of a text file's content."""

from __future__ import annotations

import codecs

import numpy as np
import pytest
from envi_files import write_image
from fuzzing import file_targets
from test_image_lines import cube_of

from triline.nodes import config
from triline.nodes.formats.detect import kind_of_path
from triline.nodes.formats.envi import read_header
from triline.nodes.formats.envi_image import is_envi_image, open_envi
from triline.nodes.formats.scene_block import is_scene_block
from triline.nodes.jobs.inputs import sources


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    return [
        target
        for target in file_targets(tmp_path_factory.mktemp("marked"))
        if target.good.isascii() and b"\0" not in target.good and b"recording" not in target.good[:9]
    ]


def test_every_text_file_is_read_with_a_mark(texts):
    """Headers of ENVI, positions of RTKLIB, settings of nodes and others were refused, or of no known kind."""
    refused = []
    for target in texts:
        target.path.write_bytes(codecs.BOM_UTF8 + target.good)
        try:
            target.read()
        except Exception as error:
            refused.append(f"{target.name}: {error}")
        finally:
            target.path.write_bytes(target.good)
    assert len(texts) > 20 and not refused


def test_a_header_with_a_mark_says_what_it_says_without(tmp_path):
    image = write_image(tmp_path / "lines.img", cube_of("u2"))
    header = image.with_suffix(".hdr")
    plain, pixels = read_header(header), open_envi(image).read(0, 5, 0)
    header.write_bytes(codecs.BOM_UTF8 + header.read_bytes().replace(b"\n", b"\r\n"))
    assert is_envi_image(image) and kind_of_path(image) == "lines"
    assert read_header(header) == plain
    np.testing.assert_array_equal(open_envi(image).read(0, 5, 0), pixels)


def test_settings_of_flights_and_scenes_with_a_mark(tmp_path):
    flight = tmp_path / "flight.toml"
    flight.write_text('\ufeff[flight]\nname = "f"\n[dem]\nfile = "heights.tif"\n', encoding="utf-8")
    assert config.raster_of_heights(flight)[0] == tmp_path / "heights.tif"
    (tmp_path / "project.toml").write_text('\ufeff[scenes]\na = "a.xml"\n', encoding="utf-8")
    assert is_scene_block(tmp_path)


def test_a_list_of_inputs_with_a_mark(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"a")
    (tmp_path / "list.txt").write_text(f"\ufeff{tmp_path / 'a.mcap'}\n", encoding="utf-8")
    assert [source.name for source in sources([f"@{tmp_path / 'list.txt'}"], tmp_path / "out")] == ["a"]
