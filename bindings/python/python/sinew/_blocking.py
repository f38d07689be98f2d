"""The endpoint for threads: each call blocks its thread, without the GIL."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Callable, Iterable, Iterator, List, Mapping, Optional, Type, Union

from . import _sinew
from ._handlers import Handlers
from ._message import Message
from ._plans import _NOTHING, LEAD, WITHIN, Destination, Options, Plan, Plans, T, outgoing
from ._protection import Guard, Protected, make_guard
from ._reports import Applied, ParameterList, StopReport, TransactionReport, Undelivered
from ._values import MemberOutcome, MessageClass, Outcome, Tid
from .errors import ClosedError, DisconnectedError

__all__ = ["Endpoint"]


class Endpoint:
    """A registered transport address, for one thread at a time. `sinew.register` makes it.

    Iterating over it receives messages, also after a restart of the node. A message is delivered when the next one is
    asked for, unless it was settled before; a request is open until its last reference has gone.

        with sinew.register("logger") as me:
            for message in me:
                print(message.kind, message.value)
    """

    def __init__(self, core: _sinew.Core) -> None:
        self._core = core
        self._plans = Plans(core)
        self._handlers = Handlers()

    def _run(self, plan: Plan[T]) -> T:
        result: Any = None
        while True:
            try:
                start = plan.send(result)
            except StopIteration as end:
                value: T = end.value
                return value
            done = start().run()
            result = None if done is None else done[0]

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

    def send(
        self,
        to: Destination,
        what: Any,
        value: Any = _NOTHING,
        *,
        class_: Union[str, MessageClass, None] = None,
        room_within: Optional[float] = None,
        expires_after: Optional[float] = None,
    ) -> None:
        """Sends a message without a confirmation: `send("knee", Angle(12.5))` or `send("knee", "exo.angle", {...})`.

        Returns when the ring to the node has it. `class_`, `room_within` and `expires_after` (seconds) take the place of
        the settings of the type. With `room_within=0.0` it never waits, and raises `StalledError` without room.
        A name is looked up with each call: in a loop `resolve` it once.
        """
        options = Options(class_, room_within, expires_after)
        self._core.send_now(outgoing(to, what, value, options))

    def send_confirmed(
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
        return self._run(self._plans.send_confirmed(outgoing(to, what, value, options), within))

    def send_confirmed_by_each(
        self, to: Destination, what: Any, value: Any = _NOTHING, *, within: float = WITHIN
    ) -> List[MemberOutcome]:
        """Sends a message to a group or to all, and returns the outcome at each member."""
        return self._run(self._plans.send_confirmed_by_each(outgoing(to, what, value), within))

    def ask(self, to: Destination, what: Any, value: Any = _NOTHING, *, within: float = WITHIN) -> Message:
        """Sends a request and returns the reply.

        Raises `NotHandledError` with the outcome, or `NoReplyError` if there is no reply `within` this time.
        """
        return self._run(self._plans.ask(outgoing(to, what, value), within))

    def reply(self, request: Message, what: Any, value: Any = _NOTHING) -> None:
        """Answers a request."""
        self._run(self._plans.reply(request, outgoing(request.source, what, value)))

    # Receiving

    def receive(self, within: Optional[float] = None) -> Optional[Message]:
        """Waits for a message, at most `within` seconds; `None` if none arrived. With 0.0 it does not wait.

        Control messages are first, then Stream, of which only the newest value of each source and type is kept, then Bulk.
        Raises `DisconnectedError` once when the node has gone; later calls wait for its return.
        """
        received = self._core.receive_now(within)
        return None if received is None else Message(received)

    def __iter__(self) -> Iterator[Message]:
        while True:
            try:
                message = self.receive()
            except DisconnectedError:
                continue  # the next call waits for the node
            except ClosedError:
                return
            if message is not None:
                yield message
                message.settle_after_turn()
                del message

    def on(self, what: Union[str, type, None], handler: Callable[[Message], Any]) -> None:
        """Calls `handler` for each message of a type in `serve`; `None`: for those of all other types.

        A result other than `None` is the reply to a request: a value of a payload class, or a pair of name and value. The
        message is settled as delivered afterwards, and as failed after an exception, which `serve` raises.
        """
        self._handlers.add(what, handler)

    def serve(self, within: Optional[float] = None) -> None:
        """Receives messages and calls their handlers, for `within` seconds, else until the endpoint ends.

        Messages without a handler are rejected as of an unknown type.
        """
        for message in self._messages(within):
            handler = self._handlers.find(message)
            if handler is None:
                message.settle(Outcome.REJECTED_UNKNOWN_KIND)
                continue
            with message:
                answer = handler(message)
                if answer is not None and message.wants_reply:
                    self.reply(message, *self._handlers.parts(answer))

    def _messages(self, within: Optional[float]) -> Iterable[Message]:
        if within is None:
            yield from self
            return
        until = _sinew.now() + within
        while _sinew.now() < until:
            try:
                message = self.receive(max(0.0, until - _sinew.now()))
            except DisconnectedError:
                continue  # the next call waits for the node
            except ClosedError:
                return
            if message is not None:
                yield message

    def take_undelivered(self) -> Optional[Undelivered]:
        """Returns the next report of messages that were not delivered. Never waits."""
        report = self._core.take_undelivered()
        return None if report is None else Undelivered.of(report)

    # Names, groups, barriers, types

    def resolve(self, name: str, within: float = WITHIN) -> Optional[Tid]:
        """Returns the address of the application that has the name now, on any node, or `None`."""
        return self._run(self._plans.resolve(name, within))

    def join(self, group: str) -> None:
        """Joins a group: messages to `sinew.group(name)` reach this endpoint."""
        self._run(self._plans.set_member(group, True))

    def leave(self, group: str) -> None:
        """Leaves a group."""
        self._run(self._plans.set_member(group, False))

    def meet(
        self,
        barrier: str,
        parties: Iterable[str],
        *,
        within: float = 60.0,
        on_loss: str = "wait",
        phase: bool = False,
    ) -> int:
        """Waits until all parties have arrived at a barrier, and returns the number of its opening.

        `on_loss="fail"` ends the wait when a party is lost. A `phase` is a barrier that stays open once it has opened.
        Raises `NotMetError` or `PartyLostError`, which name the `missing` parties.
        """
        return self._run(self._plans.meet(barrier, list(parties), within, on_loss, phase))

    def type_of(self, name: str, within: float = WITHIN) -> Optional[type]:
        """Returns the class of a payload type: the declared one, else one made from the structure that the node has.

        `None` if no node knows the structure: values of the type are then a `dict`.
        """
        return self._run(self._plans.type_of(name, within))

    # Parameters, the stop of the system, protection

    def parameters(self, app: Destination, within: float = WITHIN) -> ParameterList:
        """Returns the parameters of an application, by their names."""
        return self._run(self._plans.parameters(app, within))

    def set_parameters(self, app: Destination, values: Mapping[str, Any], within: float = WITHIN) -> Applied:
        """Sets parameters of an application, all or none. Raises `ParameterError` with the reason if it refuses."""
        return self._run(self._plans.set_parameters(app, values, within))

    def tick(self) -> None:
        """Begins a turn of the loop that reads the parameters of this application: sets that wait are applied now.

        All values that the turn reads belong together. A program that serves parameters also receives, at least every
        20 ms if it takes part in transactions.
        """
        self._run(self._plans.tick())

    def set_together(
        self, sets: Mapping[str, Mapping[str, Any]], *, lead: float = LEAD, within: float = 2.0
    ) -> TransactionReport:
        """Sets parameters of several applications, on any nodes, all or none: `{"knee": {"kp": 1.0}, "hip": {"kp": 1.0}}`.

        All apply their values at their first tick at or after one stated time, `lead` seconds from now. Returns when each
        has reported, at the latest `within` seconds after that time.
        """
        return self._run(self._plans.set_together(sets, lead, within))

    def undo_parameters(self, app: Destination, within: float = WITHIN) -> Applied:
        """Undoes the last set that was applied and not undone."""
        return self._run(self._plans.undo_parameters(app, within))

    def press_stop(self, reason: str, within: float = WITHIN) -> StopReport:
        """Stops the whole system: every guarded output of every node becomes safe. Waits for the confirmations."""
        return self._run(self._plans.press_stop(reason, within))

    def release_stop(self, within: float = WITHIN) -> StopReport:
        """Releases the stop. Only an operator may."""
        return self._run(self._plans.release_stop(within))

    def stop_state(self, within: float = WITHIN) -> StopReport:
        """Returns the state of the stop."""
        return self._run(self._plans.stop_state(within))

    def acknowledge_stop(self, within: float = WITHIN) -> None:
        """Acknowledges a stop that is released: then the outputs of this process can be armed again."""
        self._run(self._plans.acknowledge_stop(within))

    def send_protected(self, to: Destination, protected: Protected, value: Any) -> None:
        """Sends a protected payload: `bytes`, or a value that is written as MessagePack."""
        data = value if isinstance(value, (bytes, bytearray)) else _sinew.encode(value)
        self._core.send_protected(to, protected._wire(), data).run()

    def guard(self, source: Tid, protected: Protected, safe: Callable[[str], object]) -> Guard:
        """Guards an output: it is live only while good messages of this type arrive from `source`.

        `safe` is called with the cause, on another thread, and makes the output safe. From now on `receive` returns only
        good messages of this type from this sender, while the output is live. With `direct="always"` the stop of the
        whole system does not reach the output. Raises `ForkedError` in the child of a process that has guards.
        """
        return make_guard(self._core, source, protected, safe)

    def ready(self) -> None:
        """Reports to the node that has started this program that it is ready.

        It has an effect where the node's `[[command]]` says `ready = "called"`. Other programs are ready when they have
        registered.
        """
        self._run(self._plans.ready())

    # The end

    def unregister(self) -> None:
        """Releases the address and waits for the node's confirmation: the name is free when this returns."""
        self._run(self._plans.unregister())

    def close(self) -> None:
        """Releases the address at once. Raises `BusyError` while another thread is in a call on this endpoint."""
        self._core.close()

    def __enter__(self) -> Endpoint:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        try:
            if kind is None:
                self.unregister()
        except (ConnectionError, TimeoutError):
            pass  # the address is released in any case
        finally:
            self.close()

    def __repr__(self) -> str:
        return f"<Endpoint {self.tid} at node {self.node_name}>"
