"""The wait of an operation in the event loop of asyncio.

The extension module has one descriptor for each endpoint. While an operation waits, the event loop watches it with
`add_reader`, and a timer stands for its next deadline. Nothing else runs: no thread, and no other event loop.
"""

from __future__ import annotations

import asyncio
from typing import Any, Callable, Optional, Tuple

from . import _sinew
from .errors import ClosedError

__all__ = ["Done", "Reader", "Waiter", "drive"]

Done = Optional[Tuple[Any]]
"""The result of an operation in a tuple; `None`: there is none yet."""


class Reader:
    """Watches the descriptor and the deadlines of an endpoint for the operation that waits.

    Waits that follow each other at once have one reader in the event loop, and one timer. Both are gone in the next turn
    of the event loop without a wait.
    """

    def __init__(self) -> None:
        self._loop: Optional[asyncio.AbstractEventLoop] = None
        """The event loop that has the reader now."""
        self._operation: Optional[_sinew.Operation] = None
        """Keeps the descriptor open as long as the reader is there. All operations of an endpoint have the same one."""
        self._step: Optional[Callable[[], None]] = None
        self.waiter: Optional[Waiter] = None
        """The wait for the operation, if one waits."""
        self._timer: Optional[asyncio.TimerHandle] = None

    def begin(self, operation: _sinew.Operation, step: Callable[[], None]) -> None:
        """Calls `step` after each event, and at the operation's deadline."""
        loop = asyncio.get_running_loop()
        if self._loop is not loop:
            loop.add_reader(operation.fileno(), self._on_event)
            self._loop, self._timer = loop, None
        self._operation, self._step = operation, step
        self.set_timer()

    def set_timer(self) -> None:
        """Follows the deadline of the operation. A timer that ends earlier stays: it causes one needless poll."""
        if self._loop is None or self._operation is None:
            return
        left = self._operation.wake_in()
        if left is None:
            return
        at = self._loop.time() + left
        if self._timer is not None:
            if self._timer.when() <= at:
                return
            self._timer.cancel()
        self._timer = self._loop.call_at(at, self._on_timer)

    def end(self) -> None:
        """Ends the wait."""
        self._step = self.waiter = None
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon(self.remove_if_idle)

    def _on_event(self) -> None:
        if self._step is not None:
            self._step()

    def _on_timer(self) -> None:
        self._timer = None
        self._on_event()

    def remove_if_idle(self) -> None:
        """Removes the reader, unless an operation waits."""
        if self._step is not None or self._loop is None or self._operation is None:
            return
        if not self._loop.is_closed():
            self._loop.remove_reader(self._operation.fileno())
        if self._timer is not None:
            self._timer.cancel()
        self._loop = self._operation = self._timer = None


class Waiter:
    """One operation that waits for its descriptor or its deadline, in the running event loop."""

    def __init__(self, operation: _sinew.Operation, reader: Reader) -> None:
        self._loop = asyncio.get_running_loop()
        self._operation = operation
        self._reader = reader
        self.ended: asyncio.Future[Done] = self._loop.create_future()

    async def wait(self, deadline: Optional[float] = None) -> Done:
        """Returns the result in a tuple; `None` at the deadline, or after `stop`."""
        limit = None if deadline is None else self._loop.call_at(deadline, self.stop)
        self._reader.begin(self._operation, self._step)
        self._reader.waiter = self
        try:
            return await self.ended
        finally:
            self._reader.end()
            if limit is not None:
                limit.cancel()

    def stop(self) -> None:
        """Ends the wait without a result."""
        if not self.ended.done():
            self.ended.set_result(None)

    def close(self) -> None:
        """Ends the operation and its wait, because the endpoint is closed."""
        self._operation.cancel()
        if not self.ended.done():
            self.ended.set_exception(ClosedError("this endpoint is unregistered; register a new one"))

    def _step(self) -> None:
        if self.ended.done():
            return
        try:
            done = self._operation.poll()
        except BaseException as error:  # it belongs to the task that waits
            self.ended.set_exception(error)
            return
        if done is None:
            self._reader.set_timer()
        else:
            self.ended.set_result(done)


async def drive(operation: _sinew.Operation, reader: Reader) -> Any:
    """Runs an operation to its end. Cancelling the task cancels it."""
    done = operation.poll()
    if done is None:
        try:
            done = await Waiter(operation, reader).wait()
        finally:
            operation.cancel()
    return None if done is None else done[0]
