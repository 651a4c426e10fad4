"""Rasters that are written: whole, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from full_disk import files_of_at_most

from triline.nodes.errors import UserError
from triline.nodes.formats.geotiff import Heights, Raster, tiled_orthoimage, write_heights, write_tile

CELLS = np.random.default_rng(1).integers(1, 255, (1, 512, 512)).astype(np.uint8)
RASTER = Raster("EPSG:32632", 5e5, 5.3e6, 0.5, 512, 512, 1, "uint8", 0)


def orthoimage(path, compress):
    with tiled_orthoimage(path, RASTER, compress) as target:
        target.write(0, 0, CELLS)


WRITERS = {
    "tile": lambda path: write_tile(path, RASTER, CELLS),
    "cloud-optimised": lambda path: orthoimage(path, "deflate"),
    "plain": lambda path: orthoimage(path, "plain"),
    "heights": lambda path: write_heights(path, Heights("EPSG:32632", CELLS[0] / 7.0, 5e5, 5.3e6, 1.0, -1.0)),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("lacks", [1, 5_000, 20_000, 60_000])
def test_a_raster_that_has_no_room_is_told_and_has_no_name(tmp_path, kind, lacks):
    """What GDAL could not write any more when it closed a file was missing in it without a word."""
    whole, cut = tmp_path / "whole.tif", tmp_path / "cut.tif"
    WRITERS[kind](whole)
    with rasterio.open(whole) as source:
        assert source.read(1).any()
    with files_of_at_most(whole.stat().st_size - lacks), pytest.raises(UserError, match=r"cut\.tif: cannot be written"):
        WRITERS[kind](cut)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.tif"]
    WRITERS[kind](cut)
    assert cut.read_bytes() == whole.read_bytes()
