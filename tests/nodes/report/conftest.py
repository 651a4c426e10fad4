"""What tests of the report share."""

import pytest


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made and not written as SVG, most of the time of a page: for tests of what stands beside them."""
    monkeypatch.setattr("triline.nodes.report.page.drawing", lambda figure: None if figure is None else "<svg></svg>")
