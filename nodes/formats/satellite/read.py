"""Finds out what satellite metadata a file or folder holds, and reads it."""

from __future__ import annotations

from pathlib import Path

from ...errors import UserError
from ..keys import is_there
from ..raster_open import is_raster
from .csm_isd import read_isd
from .dimap1 import read_dimap1
from .dimap2 import read_dimap2
from .folder import is_scene_folder, read_scene_folder
from .rpc_files import has_dimap_rpc, read_dimap_rpc, read_maxar_rpc, read_rpb, read_rpc_tags, read_rpc_text
from .scene import SatelliteScene
from .xml_file import Element, read_xml, text_start

#: What is read: name -> words.
KINDS = {
    "dimap2": "DIMAP 2 (Pleiades, Pleiades Neo, SPOT-6/7)",
    "dimap1": "DIMAP 1 (SPOT-1 to SPOT-5)",
    "isd": "community sensor model ISD (JSON)",
    "folder": "folder of a scene (ephemeris.csv, attitude.csv, line_times.csv, camera.json)",
    "rpc": "RPC (DIMAP, .RPB, XML of WorldView, _RPC.TXT, .geom, tags of an image)",
}
#: What is read as XML.
XML_KINDS = (KINDS["dimap2"], KINDS["dimap1"], "RPC of DIMAP", "XML of WorldView (isd)")
#: Ends of names of images, whose tags may have polynomials.
IMAGES = (".tif", ".tiff", ".jp2", ".ntf", ".nitf", ".img", ".vrt")


def read_scene(path: Path) -> SatelliteScene:
    """The scene in satellite metadata of any kind.

    Raises
    ------
    UserError : one line about what is wrong, where, and what was wanted
    """
    if not is_there(path):
        raise UserError(f"{path}: no such file or folder")
    if path.is_dir():
        if not is_scene_folder(path):
            raise UserError(f"{path}: no satellite scene, wanted a {KINDS['folder']}")
        return read_scene_folder(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: empty, wanted one of: {'; '.join(KINDS.values())}")
    suffix = path.suffix.lower()
    with open(path, "rb") as file:
        head = text_start(file.read(512))
    if suffix in IMAGES:  # a virtual raster is XML, too
        return SatelliteScene("rpc", None, read_rpc_tags(path))
    if head.startswith("<"):
        return _read_xml_scene(read_xml(path))
    if suffix == ".rpb":
        return SatelliteScene("rpc", None, read_rpb(path))
    if suffix == ".geom" or path.name.upper().endswith("_RPC.TXT") or "LINE_OFF" in head.upper():
        return SatelliteScene("rpc", None, read_rpc_text(path))
    if suffix in (".json", ".isd") or head.startswith("{"):
        return read_isd(path)
    if is_raster(path):
        return SatelliteScene("rpc", None, read_rpc_tags(path))
    raise UserError(f"{path}: of no known kind, wanted one of: {'; '.join(KINDS.values())}")


def _read_xml_scene(root: Element) -> SatelliteScene:
    if root.tag.lower() == "isd":
        return SatelliteScene("rpc", None, read_maxar_rpc(root))
    if "dimap" not in root.tag.lower():
        raise UserError(f"{root.path}: XML with the root {root.tag}, wanted one of: {'; '.join(XML_KINDS)}")
    if root.find("Metadata_Id/METADATA_FORMAT") is not None:
        return read_dimap1(root)
    rigorous = root.find("Geometric_Data/Refined_Model", "Geometric_Data/Sensor_Model_Characteristics") is not None
    if not rigorous and has_dimap_rpc(root):
        return SatelliteScene("rpc", None, read_dimap_rpc(root))
    return read_dimap2(root)
