"""Files that GDAL is asked to open."""

from __future__ import annotations

import pytest
from rasterio.errors import RasterioIOError

from triline.nodes.formats.raster_open import is_raster, open_raster


def test_a_document_that_names_its_image_in_another_encoding_is_no_raster(tmp_path):
    """rasterio cannot say what GDAL says of it: the message quotes the name."""
    path = tmp_path / "DIM.XML"
    path.write_bytes(
        b'<Dimap_Document><Metadata_Id><METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT></Metadata_Id>'
        b"<Raster_Dimensions><NCOLS>9</NCOLS><NROWS>9</NROWS><NBANDS>1</NBANDS></Raster_Dimensions><Data_Access>"
        b'<Data_File><DATA_FILE_PATH href="M\xfcnchen.tif"/></Data_File></Data_Access></Dimap_Document>'
    )
    with pytest.raises(RasterioIOError, match="names a file in bytes that are no UTF-8"):
        open_raster(path)
    assert not is_raster(path)
