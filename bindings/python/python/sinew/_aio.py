"""The endpoint for asyncio."""

from __future__ import annotations

import asyncio
import inspect
from collections import deque
from types import TracebackType
from typing import (
    Any,
    AsyncIterator,
    Awaitable,
    Callable,
    Deque,
    Iterable,
    List,
    Mapping,
    Optional,
    Type,
    Union,
    overload,
)

from . import _sinew
from ._handlers import Handlers
from ._message import Message
from ._plans import _NOTHING, LEAD, WITHIN, Destination, Options, Plan, Plans, Start, T, outgoing
from ._protection import Guard, Protected, make_guard
from ._reports import Applied, ParameterList, StopReport, TransactionReport, Undelivered
from ._values import MemberOutcome, MessageClass, Outcome, Tid
from ._wait import Done, Reader, Waiter, drive
from .errors import ClosedError, DisconnectedError

__all__ = ["AsyncEndpoint"]

CALLS_MAX = 32
"""Calls of an endpoint after which other tasks run, even if none of the calls has to wait."""


async def begin(registration: _sinew.Operation) -> AsyncEndpoint:
    """Runs a registration to its end."""
    reader = Reader()
    try:
        core = await drive(registration, reader)
    finally:
        # At once: the endpoint has the same descriptor, and a reader of its own.
        reader.remove_if_idle()
    return AsyncEndpoint(core)


class AsyncEndpoint:
    """A registered transport address, for the tasks of one event loop. `sinew.register` makes it.

    Iterating over it receives messages, also after a restart of the node. A message is delivered when the next one is
    asked for, unless it was settled before; a request is open until its last reference has gone.

        async with sinew.register("logger") as me:
            async for message in me:
                print(message.kind, message.value)

    Each call may be cancelled at any time; no received message is lost by that. Calls of several tasks run one after the
    other. A `receive` that waits gives way to them.
    """

    def __init__(self, core: _sinew.Core) -> None:
        self._core = core
        self._plans = Plans(core)
        self._handlers = Handlers()
        self._lock = asyncio.Lock()
        self._waiting = 0
        """Calls that wait for the end of a `receive`."""
        self._reader = Reader()
        self._receiving: Optional[Waiter] = None
        self._kept: Deque[Message] = deque()
        """Messages that arrived in the moment in which their `receive` was cancelled."""
        self._calls = 0

    async def _let_others_run(self) -> None:
        """A flood of messages would otherwise keep the timers and the other tasks of the event loop from running."""
        self._calls += 1
        if self._calls % CALLS_MAX == 0:
            await asyncio.sleep(0)

    async def _operate(self, start: Start) -> Any:
        """Runs one operation, when no other one runs."""
        await self._let_others_run()
        self._waiting += 1
        if self._receiving is not None:
            self._receiving.stop()
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        try:
            return await drive(start(), self._reader)
        finally:
            self._lock.release()

    async def _run(self, plan: Plan[T]) -> T:
        result: Any = None
        while True:
            try:
                start = plan.send(result)
            except StopIteration as end:
                value: T = end.value
                return value
            result = await self._operate(start)

    @property
    def tid(self) -> Tid:
        """The address. It may change when the endpoint registers again."""
        return Tid(self._core.tid)

    @property
    def node_name(self) -> str:
        """The name of the node."""
        return self._core.node_name

    @property
    def payload_max(self) -> int:
        """The longest payload that the node accepts, in bytes."""
        return self._core.payload_max

    @property
    def registrations(self) -> int:
        """How often the endpoint has registered: 1, and one more for each reconnection."""
        return self._core.registrations

    # Sending

    async def send(
        self,
        to: Destination,
        what: Any,
        value: Any = _NOTHING,
        *,
        class_: Union[str, MessageClass, None] = None,
        room_within: Optional[float] = None,
        expires_after: Optional[float] = None,
    ) -> None:
        """Sends a message without a confirmation, like `Endpoint.send`."""
        options = Options(class_, room_within, expires_after)
        await self._run(self._plans.send(outgoing(to, what, value, options)))

    async def send_confirmed(
        self,
        to: Destination,
        what: Any,
        value: Any = _NOTHING,
        *,
        within: float = WITHIN,
        class_: Union[str, MessageClass, None] = None,
        room_within: Optional[float] = None,
    ) -> Outcome:
        """Sends a message and returns its outcome: `Outcome.UNKNOWN` if none arrives `within` this time."""
        options = Options(class_, room_within)
        return await self._run(self._plans.send_confirmed(outgoing(to, what, value, options), within))

    async def send_confirmed_by_each(
        self, to: Destination, what: Any, value: Any = _NOTHING, *, within: float = WITHIN
    ) -> List[MemberOutcome]:
        """Sends a message to a group or to all, and returns the outcome at each member."""
        return await self._run(self._plans.send_confirmed_by_each(outgoing(to, what, value), within))

    async def ask(self, to: Destination, what: Any, value: Any = _NOTHING, *, within: float = WITHIN) -> Message:
        """Sends a request and returns the reply.

        Raises `NotHandledError` with the outcome, or `NoReplyError` if there is no reply `within` this time.
        """
        return await self._run(self._plans.ask(outgoing(to, what, value), within))

    async def reply(self, request: Message, what: Any, value: Any = _NOTHING) -> None:
        """Answers a request."""
        await self._run(self._plans.reply(request, outgoing(request.source, what, value)))

    # Receiving

    @overload
    async def receive(self) -> Message: ...

    @overload
    async def receive(self, within: Optional[float]) -> Optional[Message]: ...

    async def receive(self, within: Optional[float] = None) -> Optional[Message]:
        """Waits for a message, at most `within` seconds; `None` if none arrived.

        Control messages are first, then Stream, of which only the newest value of each source and type is kept, then Bulk.
        Raises `DisconnectedError` once when the node has gone; later calls wait for its return. While another task is in
        `receive`, this one waits for its end, also beyond `within`.
        """
        loop = asyncio.get_running_loop()
        deadline = None if within is None else loop.time() + within
        await self._let_others_run()
        while True:
            async with self._lock:
                # Here: the `receive` that kept one had the lock.
                if self._kept:
                    return self._kept.popleft()
                if not self._waiting:
                    done = await self._receive(deadline)
                    if done is not None:
                        return Message(done[0])
            if deadline is not None and loop.time() >= deadline:
                return None

    async def _receive(self, deadline: Optional[float]) -> Done:
        operation = self._core.receive()
        done = operation.poll()
        if done is not None:
            return done
        waiter = self._receiving = Waiter(operation, self._reader)
        try:
            return await waiter.wait(deadline)
        except asyncio.CancelledError:
            if waiter.ended.done() and not waiter.ended.cancelled() and waiter.ended.exception() is None:
                arrived = waiter.ended.result()
                if arrived is not None:
                    self._kept.append(Message(arrived[0]))
            raise
        finally:
            self._receiving = None
            operation.cancel()

    async def __aiter__(self) -> AsyncIterator[Message]:
        while True:
            try:
                message = await self.receive()
            except DisconnectedError:
                continue  # the next call waits for the node
            except ClosedError:
                return
            yield message
            message.settle_after_turn()
            del message

    def on(self, what: Union[str, type, None], handler: Callable[[Message], Any]) -> None:
        """Calls `handler`, a function or a coroutine function, for each message of a type in `serve`.

        Like `Endpoint.on`. The next message is received when the handler has ended.
        """
        self._handlers.add(what, handler)

    async def serve(self) -> None:
        """Receives messages and calls their handlers, until the task is cancelled or the endpoint ends.

        Messages without a handler are rejected as of an unknown type.
        """
        async for message in self:
            handler = self._handlers.find(message)
            if handler is None:
                message.settle(Outcome.REJECTED_UNKNOWN_KIND)
                continue
            with message:
                answer = handler(message)
                if inspect.isawaitable(answer):
                    awaitable: Awaitable[Any] = answer
                    answer = await awaitable
                if answer is not None and message.wants_reply:
                    await self.reply(message, *self._handlers.parts(answer))

    def take_undelivered(self) -> Optional[Undelivered]:
        """Returns the next report of messages that were not delivered. Never waits; `None` while another call runs."""
        if self._lock.locked():
            return None
        report = self._core.take_undelivered()
        return None if report is None else Undelivered.of(report)

    # Names, groups, barriers, types

    async def resolve(self, name: str, within: float = WITHIN) -> Optional[Tid]:
        """Returns the address of the application that has the name now, on any node, or `None`."""
        return await self._run(self._plans.resolve(name, within))

    async def join(self, group: str) -> None:
        """Joins a group: messages to `sinew.group(name)` reach this endpoint."""
        await self._run(self._plans.set_member(group, True))

    async def leave(self, group: str) -> None:
        """Leaves a group."""
        await self._run(self._plans.set_member(group, False))

    async def meet(
        self,
        barrier: str,
        parties: Iterable[str],
        *,
        within: float = 60.0,
        on_loss: str = "wait",
        phase: bool = False,
    ) -> int:
        """Waits until all parties have arrived at a barrier, like `Endpoint.meet`. Cancelling it leaves the barrier."""
        return await self._run(self._plans.meet(barrier, list(parties), within, on_loss, phase))

    async def type_of(self, name: str, within: float = WITHIN) -> Optional[type]:
        """Returns the class of a payload type: the declared one, else one made from the structure that the node has.

        `None` if no node knows the structure: values of the type are then a `dict`.
        """
        return await self._run(self._plans.type_of(name, within))

    # Parameters, the stop of the system, protection

    async def parameters(self, app: Destination, within: float = WITHIN) -> ParameterList:
        """Returns the parameters of an application, by their names."""
        return await self._run(self._plans.parameters(app, within))

    async def set_parameters(self, app: Destination, values: Mapping[str, Any], within: float = WITHIN) -> Applied:
        """Sets parameters of an application, all or none. Raises `ParameterError` with the reason if it refuses."""
        return await self._run(self._plans.set_parameters(app, values, within))

    async def tick(self) -> None:
        """Begins a turn of the loop that reads the parameters of this application, like `Endpoint.tick`."""
        await self._run(self._plans.tick())

    async def set_together(
        self, sets: Mapping[str, Mapping[str, Any]], *, lead: float = LEAD, within: float = 2.0
    ) -> TransactionReport:
        """Sets parameters of several applications, on any nodes, all or none: `{"knee": {"kp": 1.0}, "hip": {"kp": 1.0}}`.

        All apply their values at their first tick at or after one stated time, `lead` seconds from now. Returns when each
        has reported, at the latest `within` seconds after that time.
        """
        return await self._run(self._plans.set_together(sets, lead, within))

    async def undo_parameters(self, app: Destination, within: float = WITHIN) -> Applied:
        """Undoes the last set that was applied and not undone."""
        return await self._run(self._plans.undo_parameters(app, within))

    async def press_stop(self, reason: str, within: float = WITHIN) -> StopReport:
        """Stops the whole system: every guarded output of every node becomes safe. Waits for the confirmations."""
        return await self._run(self._plans.press_stop(reason, within))

    async def release_stop(self, within: float = WITHIN) -> StopReport:
        """Releases the stop. Only an operator may."""
        return await self._run(self._plans.release_stop(within))

    async def stop_state(self, within: float = WITHIN) -> StopReport:
        """Returns the state of the stop."""
        return await self._run(self._plans.stop_state(within))

    async def acknowledge_stop(self, within: float = WITHIN) -> None:
        """Acknowledges a stop that is released: then the outputs of this process can be armed again."""
        await self._run(self._plans.acknowledge_stop(within))

    async def send_protected(self, to: Destination, protected: Protected, value: Any) -> None:
        """Sends a protected payload: `bytes`, or a value that is written as MessagePack."""
        data = value if isinstance(value, (bytes, bytearray)) else _sinew.encode(value)
        await self._operate(lambda: self._core.send_protected(to, protected._wire(), data))

    async def guard(self, source: Tid, protected: Protected, safe: Callable[[str], object]) -> Guard:
        """Guards an output, like `Endpoint.guard`."""
        self._waiting += 1
        if self._receiving is not None:
            self._receiving.stop()
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        try:
            return make_guard(self._core, source, protected, safe)
        finally:
            self._lock.release()

    async def ready(self) -> None:
        """Reports to the node that has started this program that it is ready.

        It has an effect where the node's `[[command]]` says `ready = "called"`. Other programs are ready when they have
        registered.
        """
        await self._run(self._plans.ready())

    # The end

    async def unregister(self) -> None:
        """Releases the address and waits for the node's confirmation: the name is free when this returns."""
        await self._run(self._plans.unregister())

    def close(self) -> None:
        """Releases the address at once. A call that waits on this endpoint raises `ClosedError`."""
        if self._reader.waiter is not None:
            self._reader.waiter.close()
        self._core.close()

    async def __aenter__(self) -> AsyncEndpoint:
        return self

    async def __aexit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        try:
            if kind is None:
                await self.unregister()
        except (ConnectionError, TimeoutError):
            pass  # the address is released in any case
        finally:
            self.close()

    def __repr__(self) -> str:
        return f"<AsyncEndpoint {self.tid} at node {self.node_name}>"
