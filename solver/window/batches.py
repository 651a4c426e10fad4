"""The batches of the window, and what the state holds of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .batch import Batch
from .state import WindowState

Array = NDArray[np.floating]


class Batches:
    """All batches whose information is in the live part of the state, in the order in which they came."""

    def __init__(self, state: WindowState) -> None:
        self._state = state
        self._by_id: dict[int, Batch] = {}

    def __iter__(self) -> Iterator[Batch]:
        return iter(self._by_id.values())

    def __len__(self) -> int:
        return len(self._by_id)

    def __contains__(self, batch: Batch) -> bool:
        return id(batch) in self._by_id

    def enter(self, batch: Batch) -> None:
        """A batch comes."""
        self._by_id[id(batch)] = batch
        self._state.add(batch.columns, batch.information)

    def remove(self, batch: Batch) -> None:
        """A batch is taken apart."""
        del self._by_id[id(batch)]
        self._state.add(batch.columns, batch.information, -1)

    def leave(self, batch: Batch) -> None:
        """A batch becomes final: what it knows stays."""
        del self._by_id[id(batch)]
        self._state.fix(batch.columns, batch.information)

    def linearise(self, batch: Batch, theta: Array, reweigh: bool) -> None:
        """Linearise a batch again, see `Batch.linearise`."""
        before = batch.information
        batch.linearise(theta, reweigh)
        self._state.exchange(batch.columns, before, batch.information)
