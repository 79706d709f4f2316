"""What a slow generator gives, made in another thread before it is asked for."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from queue import Full, Queue
from threading import Event, Thread
from typing import Any

DEPTH = 256  # items in waiting; as many RGB-D images of 640 x 480 take 400 MB
PATIENCE = 0.1  # s between two looks at whether anybody still wants more


class ReadAhead:
    """The items of a generator, up to `DEPTH` of them ready; making them begins at once.

    Args:
        items: used, and closed, in the other thread alone.
        depth: items that may wait.
    """

    def __init__(self, items: Generator[Any, None, None], depth: int = DEPTH) -> None:
        self._items, self._ready = items, Queue(maxsize=depth)
        self._closed = Event()
        self._thread = Thread(target=self._fill, daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Any]:
        """Yield the items; what the generator raises is raised here, in its place."""
        try:
            while True:
                item, error = self._ready.get()
                if error is not None:
                    raise error
                if item is self:
                    return
                yield item
        finally:
            self.close()

    def close(self) -> None:
        """Make no more items; what was not asked for is dropped."""
        self._closed.set()
        self._thread.join()

    def _fill(self) -> None:
        try:
            for item in self._items:
                if not self._put((item, None)):
                    return
            self._put((self, None))
        except Exception as error:
            self._put((None, error))
        finally:
            self._items.close()

    def _put(self, entry: tuple[Any, Exception | None]) -> bool:
        """Hand an entry over when there is room; return whether anybody still wants it."""
        while not self._closed.is_set():
            try:
                self._ready.put(entry, timeout=PATIENCE)
            except Full:
                continue
            return True
        return False
