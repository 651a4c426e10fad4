"""The study that holds matched ties against simulated ones: what it says of its own scatter."""

import numpy as np
import pytest

from triline.nodes.cli import main
from triline.nodes.cli.study_ties import COMPONENTS, by_flights, lines, luck, ratios

FLIGHTS = 12


def flights(rng, again, factor=1.0, kind="plain"):
    """Flights whose mean squared errors scatter as those of strips with a few independent errors each."""

    def squares():
        return rng.chisquare(6, len(COMPONENTS)) / 6

    return [
        {
            "kind": kind, "seed": i, "ties": 450, "normalised": 0.95, "sigma0": 0.88, "simulated_sigma0": [0.9] * again,
            "matched": (factor**2 * squares()).tolist(), "simulated": [squares().tolist() for _ in range(again)],
        }
        for i in range(FLIGHTS)
    ]  # fmt: skip


@pytest.mark.parametrize("again", [2, 5])
def test_luck_is_how_far_ratios_of_equals_scatter(again):
    rng = np.random.default_rng(4)
    blocks = [flights(rng, again) for _ in range(60)]
    logarithms = np.log([ratios(rows, rng)[0] for rows in blocks])
    said = np.sqrt(np.mean([luck(rows, rng) ** 2 for rows in blocks], axis=0))
    np.testing.assert_allclose(said[:-1].mean(), logarithms[:, :-1].std(), rtol=0.1)
    np.testing.assert_allclose(said[-1], logarithms[:, -1].std(), rtol=0.3)


def test_each_flight_counts_alike_and_the_standard_error_is_that_of_the_mean():
    rng = np.random.default_rng(9)
    found = np.array([by_flights(flights(rng, 4, factor=1.2)) for _ in range(80)])
    # of chi squares with 6 degrees of freedom against a mean of 4 of them, the logarithm has a mean of its own
    assert found[:, 0].mean() == pytest.approx(1.2 * 0.94, abs=0.02)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.2)


def test_one_drawing_says_nothing_of_luck():
    assert np.isnan(luck(flights(np.random.default_rng(1), 1), np.random.default_rng(2))).all()


def test_verdict_tells_equals_from_worse():
    rng = np.random.default_rng(8)
    text = lines([*flights(rng, 3), *flights(rng, 3, factor=1.5, kind="rough")])
    verdicts = [line.strip() for line in text if "matched over simulated" in line]
    assert verdicts[0].startswith("met:") and verdicts[1].startswith("NOT MET:")
    assert all("simulated over simulated 1 +- 0.0" in verdict for verdict in verdicts)


def test_a_flight_without_a_matched_tie_is_refused(capsys):
    """NumPy warned of the mean of an empty slice, and the ratios were not numbers."""
    assert main(["study", "ties", "--seeds", "2", "--again", "1", "--seconds", "6", "--pixels", "60"]) == 1
    assert "a flight in which no tie point is matched, wanted more --pixels or --seconds" in capsys.readouterr().err
