"""Where the repository and the data beside it are, for tests in whatever folder."""

from __future__ import annotations

from pathlib import Path

import pytest

#: Root of the repository.
ROOT = Path(__file__).resolve().parents[2]
#: Real and reference data; they stand beside the repository, not in it, and may be absent.
DATA = ROOT.parent / "shared" / "data"
#: Blocks with reference solutions.
BLOCKS = DATA / "blocks"
#: Orientation recorded on an AVIRIS-NG flight.
MOTION = DATA / "avirisng" / "ang20170323t202244_eph_att"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not there")
needs_blocks = pytest.mark.skipif(not BLOCKS.is_dir(), reason="../shared/data/blocks is not there")
needs_motion = pytest.mark.skipif(
    not MOTION.exists(), reason="../shared/data is not there: no real flight to put a camera on"
)
