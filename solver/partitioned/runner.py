"""Who works on partitions, and where these lie: what an adjustment wants of both."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class Store(Protocol):
    """Objects by name, which every worker reads and writes. What is written again under a name is the same again."""

    def save(self, name: str, value: Any) -> None: ...
    def load(self, name: str) -> Any: ...
    def remove(self, name: str) -> None:
        """Remove an object, if it is there."""
        ...


class Tree:
    """Adds up results in pairs of neighbours, pairs of pairs and so on, whatever the order in which they come.

    At most about the logarithm of their number are held where they come in order.
    """

    def __init__(self, count: int, merge: Callable[[Any, Any], Any]):
        self._merge = merge
        self._width = [count]
        while self._width[-1] > 1:
            self._width.append((self._width[-1] + 1) // 2)
        self._waiting: dict[tuple[int, int], Any] = {}

    def add(self, place: int, value: Any) -> None:
        """The result of one partition."""
        level = 0
        while level < len(self._width) - 1:
            other = place ^ 1
            if other < self._width[level]:
                if (level, other) not in self._waiting:
                    break
                partner = self._waiting.pop((level, other))
                value = self._merge(partner, value) if other < place else self._merge(value, partner)
            place, level = place // 2, level + 1
        self._waiting[level, place] = value

    def total(self) -> Any:
        """What all results are together."""
        ((place, value),) = self._waiting.items()
        assert place == (len(self._width) - 1, 0)
        return value


class Runner(ABC):
    """Works on partitions: here, in processes, or on a cluster.

    A task is ``task(store, key, *arguments)``. It may run twice, where a worker dies: it reads objects of the store
    and writes others, never the ones it reads.

    Parameters
    ----------
    store : where partitions lie
    """

    def __init__(self, store: Store):
        self.store = store

    @abstractmethod
    def results(
        self, task: Callable[..., T], keys: Sequence[int], arguments: Callable[[int], tuple[Any, ...]]
    ) -> Iterator[tuple[int, T]]:
        """Places of the keys and their results, as they come."""

    def run(
        self,
        task: Callable[..., T],
        keys: Sequence[int],
        arguments: Callable[[int], tuple[Any, ...]],
        merge: Callable[[T, T], T],
    ) -> T:
        """Results of all partitions merged in a tree whose shape depends on their number alone."""
        tree = Tree(len(keys), merge)
        for place, result in self.results(task, keys, arguments):
            tree.add(place, result)
        return tree.total()

    def each(
        self, task: Callable[..., T], keys: Sequence[int], arguments: Callable[[int], tuple[Any, ...]]
    ) -> Iterator[T]:
        """Results of the partitions, one after the other in the order of the keys."""
        waiting: dict[int, T] = {}
        following = 0
        for place, result in self.results(task, keys, arguments):
            waiting[place] = result
            while following in waiting:
                yield waiting.pop(following)
                following += 1


class Here(Runner):
    """Everything in this process, one partition after the other."""

    def results(
        self, task: Callable[..., T], keys: Sequence[int], arguments: Callable[[int], tuple[Any, ...]]
    ) -> Iterator[tuple[int, T]]:
        for place, key in enumerate(keys):
            yield place, task(self.store, key, *arguments(key))
