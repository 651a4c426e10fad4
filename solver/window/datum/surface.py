"""Heights of a surface as control while the strip is flown: which of them count, and whether its shift agrees.

Heights of points that stand above the surface, on trees and houses, lose their weight; they are looked at anew as long
as the points are in the window. A surface that as a whole contradicts GNSS and control holds no height datum: its shift
is estimated freely then, and only its relief counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...adjustment.surface_control import SurfaceShift
from ...arrays import Array
from ..results import Update
from ..state.batch import Batch
from ..state.network import LiveNetwork

#: Rounds of weights, each with a solution, in one update; and change of a weight that is worth one. Tuned, for speed.
ROUNDS, CHANGED = 3, 0.02
#: Points without a height of the surface below any of them after which it is said that it has none. Tuned.
NONE_BELOW = 20


class SurfaceTests:
    """Judges the heights of a surface; see the module.

    Parameters
    ----------
    critical : of Baarda's |w|
    """

    def __init__(self, network: LiveNetwork, critical: float) -> None:
        self._network, self._critical = network, critical
        self._scale_m = 0.0
        self._shift: SurfaceShift | None = None
        self._without: int | None = 0  # points so far that have no height below them; None: some have one

    def weigh(self, fresh: Sequence[Batch], everything: bool, update: Update) -> tuple[int, Array]:
        """Weigh the heights of points, and test the shift; number of solutions computed, and by how much (m, m) the
        weight of the shift has changed.

        Parameters
        ----------
        fresh : batches that came in this update
        everything : whether to weigh all batches of the window
        """
        network, surface = self._network, self._network.surface
        control, released = surface.control, np.zeros((len(surface.numbers),) * 2)
        if control is None:
            return 0, released
        batches = [b for b in (network.batches if everything else fresh) if (b.surface_rows.weight > 0).any()]
        if self._without is not None:
            self._look_for_heights(fresh, bool(batches), update)
        solutions = 0
        for _ in range(ROUNDS if batches else 0):
            changed = self._reweigh(batches, everything)
            if solutions == 0 or changed:
                shift = surface.test(self._critical)
                if shift.free != surface.free:
                    released += surface.release(shift.free)
                    self._tell(shift, update)
                    changed = True
                elif not shift.free or self._shift is None:
                    self._shift = shift
            if not changed:
                break
            network.state.solve()
            solutions += 1
        for batch in fresh if solutions else ():
            batch.back_substitute(network.state.values(batch.columns))
        if surface.free:
            self._shift = surface.test(self._critical)
        return solutions, released

    def _reweigh(self, batches: Sequence[Batch], everything: bool) -> bool:
        """Weights of heights by the distance of their points from the surface; whether some have changed."""
        network, surface = self._network, self._network.surface
        assert surface.control is not None
        shift_m, offs = surface.shift_m, []
        for batch in batches:
            batch.back_substitute(network.state.values(batch.columns))
            offs.append(batch.surface_rows.off(batch.points_l, shift_m))
        known = [b.surface_rows.weight > 0 for b in batches]
        if everything or not self._scale_m:
            self._scale_m = surface.control.scale_m(
                np.concatenate([off[k] for off, k in zip(offs, known, strict=True)])
            )
        changed = False
        for batch, off, k in zip(batches, offs, known, strict=True):
            factor = np.where(k, surface.control.weights(np.where(k, off, 0.0), self._scale_m), 1.0)
            if np.abs(factor - batch.surface_factor).max() > CHANGED:
                batch.weigh_surface(factor)
                network.batches.eliminate(batch)
                changed = True
        return changed

    def _look_for_heights(self, fresh: Sequence[Batch], some: bool, update: Update) -> None:
        before = self._without or 0
        self._without = None if some else before + sum(int(b.on_surface.sum()) for b in fresh)
        if before < NONE_BELOW <= (self._without or 0):
            update.warnings.append("the elevation model has no height below the tie points: it does not count")

    def _tell(self, shift: SurfaceShift, update: Update) -> None:
        self._shift = shift
        if shift.free:
            update.warnings.append(f"{self._words(shift)} its relief counts, its height does not")
        else:
            update.warnings.append("the elevation model agrees with GNSS and control: its height counts again")

    @staticmethod
    def _words(shift: SurfaceShift) -> str:
        return (
            f"the elevation model is {abs(shift.shift_m):.2f} +- {shift.sigma_m:.2f} m "
            f"{'above' if shift.shift_m > 0 else 'below'} GNSS and control: its vertical datum?"
        )

    @property
    def doubt(self) -> str:
        """What the surface contradicts, in words; "" where it does not."""
        return self._words(self._shift) if self._shift is not None and self._network.surface.free else ""

    @property
    def holds(self) -> bool:
        """Whether the surface holds the height."""
        return self._shift is not None and not self._network.surface.free
