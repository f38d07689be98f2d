"""The calls that take several operations, written once for both forms of an endpoint.

A plan is a generator: it yields functions that begin an operation, and gets the result of each. The blocking endpoint
runs the operations, and the one of asyncio awaits them.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Generator, List, Mapping, Optional, Tuple, TypeVar, Union

from . import _sinew
from ._message import Message
from ._reports import Applied, ParameterList, PartOutcome, StopReport, TransactionReport, value_to_wire
from ._types import PayloadType, class_of_kind, from_schema, kind_id, payload_type, register_class
from ._values import MemberOutcome, MessageClass, Outcome, Tid, class_number
from .errors import MalformedError, NotHandledError, ParameterError, SinewError

T = TypeVar("T")
Start = Callable[[], _sinew.Operation]
Plan = Generator[Start, Any, T]
Destination = Union[Tid, int, str]

INSPECT = 5
"""The application of a node that answers questions of tools."""
STOP = 6
"""The application of a node that has the stop of the whole system."""
WITHIN = 1.0
"""Default of `within`, in seconds."""
LEAD = 0.25
"""Default of `lead`, in seconds."""
STOP_MARGIN = 0.5
"""Seconds beyond the wait for confirmations in which a node answers."""

_NOTHING: Any = object()

Outgoing = Tuple[Union[int, str], int, int, Union[bytes, bytearray], Optional[float], Optional[float]]


class Options:
    """What one message has in place of the settings of its type."""

    __slots__ = ("class_", "expires_after", "room_within")

    def __init__(
        self,
        class_: Union[str, MessageClass, None] = None,
        room_within: Optional[float] = None,
        expires_after: Optional[float] = None,
    ) -> None:
        self.class_ = class_
        self.room_within = room_within
        self.expires_after = expires_after


DEFAULT = Options()


def outgoing(to: Destination, what: Any, value: Any, options: Options = DEFAULT) -> Outgoing:
    """Returns a message for the extension module.

    `what` is the value of a payload class, or the name of a type with its `value`. `bytes` are a raw payload, and each
    other value is MessagePack.
    """
    properties: Optional[PayloadType] = None
    if isinstance(what, str):
        kind, number, expires = kind_id(what), 0, None
        content = {} if value is _NOTHING else value
        cls = class_of_kind(kind)
        properties = None if cls is None else payload_type(cls)
    else:
        if value is not _NOTHING:
            raise TypeError("give the name of a type and its value, or one value of a payload class")
        properties, content = payload_type(what), what
        if properties is None:
            text = f"{type(what).__name__} is no payload class: declare it with @sinew.payload, or give the name of a type"
            raise TypeError(text)
        kind = properties.kind
    if properties is not None:
        number, expires = properties.message_class, properties.expires_after
    if options.class_ is not None:
        number = class_number(options.class_)
    if options.expires_after is not None:
        expires = options.expires_after
    data = content if isinstance(content, (bytes, bytearray)) else _sinew.encode(content)
    return (to, kind, number, data, options.room_within, expires)


class Plans:
    """The calls of one endpoint as plans."""

    def __init__(self, core: _sinew.Core) -> None:
        self.core = core

    def _service(self, app: int) -> Tid:
        return Tid.of(Tid(self.core.tid).node, app)

    def send(self, message: Outgoing) -> Plan[None]:
        yield lambda: self.core.send(message)

    def send_confirmed(self, message: Outgoing, within: float) -> Plan[Outcome]:
        return Outcome((yield lambda: self.core.send_confirmed(message, within)))

    def send_confirmed_by_each(self, message: Outgoing, within: float) -> Plan[List[MemberOutcome]]:
        pairs = yield lambda: self.core.send_confirmed_by_each(message, within)
        return [MemberOutcome(Tid(tid), Outcome(code)) for tid, code in pairs]

    def ask(self, message: Outgoing, within: float) -> Plan[Message]:
        return Message((yield lambda: self.core.ask(message, within)))

    def reply(self, request: Message, message: Outgoing) -> Plan[None]:
        received = request._received
        yield lambda: self.core.reply(received, message)

    def resolve(self, name: str, within: float) -> Plan[Optional[Tid]]:
        bits = yield lambda: self.core.resolve(name, within)
        return None if bits is None else Tid(bits)

    def tick(self) -> Plan[None]:
        yield lambda: self.core.tick()

    def set_member(self, group: str, is_member: bool) -> Plan[None]:
        yield lambda: self.core.set_member(group, is_member)

    def meet(self, name: str, parties: List[str], within: float, on_loss: str, is_phase: bool) -> Plan[int]:
        if on_loss not in ("wait", "fail"):
            raise ValueError(f"on_loss is {on_loss!r}: take 'wait' or 'fail'")
        options = (on_loss == "fail", is_phase)
        generation = yield lambda: self.core.meet(name, parties, within, options)
        return int(generation)

    def ready(self) -> Plan[None]:
        yield self.core.ready

    def unregister(self) -> Plan[None]:
        yield self.core.unregister

    # Parameters

    def parameters(self, app: Destination, within: float) -> Plan[ParameterList]:
        reply = yield from self.ask(outgoing(app, "sinew.param.ask", {}), within)
        return _read(ParameterList, reply)

    def set_parameters(self, app: Destination, values: Mapping[str, Any], within: float) -> Plan[Applied]:
        named = [{"name": name, "value": value_to_wire(value)} for name, value in values.items()]
        return (yield from self._set(app, {"Values": named}, within))

    def set_together(
        self, sets: Mapping[str, Mapping[str, Any]], lead: float, within: float
    ) -> Plan[TransactionReport]:
        listed = []
        for app, values in sets.items():
            for value in values.values():
                value_to_wire(value)  # raises TypeError
            listed.append((app, list(values.items())))
        verdict, parts = yield lambda: self.core.set_together(listed, lead, within)
        return TransactionReport(verdict, {app: PartOutcome(*outcome) for app, outcome in parts})

    def undo_parameters(self, app: Destination, within: float) -> Plan[Applied]:
        return (yield from self._set(app, "Undo", within))

    def _set(self, app: Destination, order: Any, within: float) -> Plan[Applied]:
        reply = yield from self.ask(outgoing(app, "sinew.param.set", order), within)
        return _read(_applied, reply)

    # The stop of the whole system

    def press_stop(self, reason: str, within: float) -> Plan[StopReport]:
        order = {"reason": reason, "within_ms": _millis(within)}
        return (yield from self._ask_stop("sinew.stop.press", order, within + STOP_MARGIN))

    def release_stop(self, within: float) -> Plan[StopReport]:
        order = {"within_ms": _millis(within)}
        return (yield from self._ask_stop("sinew.stop.release", order, within + STOP_MARGIN))

    def stop_state(self, within: float) -> Plan[StopReport]:
        return (yield from self._ask_stop("sinew.stop.ask", {}, within))

    def _ask_stop(self, kind: str, order: Dict[str, Any], within: float) -> Plan[StopReport]:
        reply = yield from self.ask(outgoing(self._service(STOP), kind, order), within)
        return _read(StopReport.of, reply)

    def acknowledge_stop(self, within: float) -> Plan[None]:
        message = outgoing(self._service(STOP), "sinew.stop.acknowledge", {})
        outcome = yield from self.send_confirmed(message, within)
        if outcome is not Outcome.DELIVERED:
            error = NotHandledError(f"the stop cannot be acknowledged: {outcome.text}; release it first")
            error.code = outcome.value
            raise error

    # Types

    def type_of(self, name: str, within: float) -> Plan[Optional[type]]:
        known = class_of_kind(kind_id(name))
        if known is not None:
            return known
        schema = yield from self._schema(name, within)
        if schema is None:
            return None
        root, types = _sinew.parse_schema(schema)
        cls = from_schema(name, root, types)
        if cls is None:
            return None
        cls.__sinew_structure__ = schema  # type: ignore[attr-defined]
        # The class of messages is no part of a structure.
        return register_class(cls, PayloadType(name, kind_id(name), 0, None))

    def _schema(self, name: str, within: float) -> Plan[Optional[bytes]]:
        """Asks the own node for the structure of a type, and the node of a user that has it, if the own one has not."""
        nodes: List[int] = [Tid(self.core.tid).node]
        found: List[bytes] = []
        for node in nodes:  # it grows
            message = outgoing(Tid.of(node, INSPECT), "sinew.inspect.schemas", {"kind": kind_id(name)})
            found, users = _read(_schemas, (yield from self.ask(message, within)))
            if found:
                break
            others = [user for user in dict.fromkeys(users) if user not in nodes]
            nodes.extend(others[: NODES_ASKED_MAX - len(nodes)])
        if len(set(found)) > 1:
            text = f"{name!r} has {len(set(found))} structures in this system; build all programs with one, or use dicts"
            raise SinewError(text)
        return found[0] if found else None


NODES_ASKED_MAX = 8
"""Maximum number of nodes that are asked for one structure."""


def _read(read: Callable[[Any], T], reply: Message) -> T:
    try:
        return read(reply.value)
    except (KeyError, TypeError, AttributeError) as error:
        text = f"the answer of {reply.source} has an unknown form ({error!r}); update this package or the node"
        raise MalformedError(text) from None


def _applied(wire: Any) -> Applied:
    """Reads the outcome of a set. Raises `ParameterError` if the application has refused it."""
    if "Refused" in wire:
        raise ParameterError(wire["Refused"]["why"])
    return Applied.of(wire["Applied"])


def _schemas(wire: Any) -> Tuple[List[bytes], List[int]]:
    """Reads the structures of a type, and the nodes with its users if a structure is missing."""
    found = [bytes(each["schema"]) for each in wire["schemas"] if each["schema"] is not None]
    lacking = [each for each in wire["schemas"] if each["schema"] is None]
    users = [user for each in lacking for user in each["sent_by"] + each["handled_by"]]
    return found, [int(user["tid"]["node"]) for user in users]


def _millis(seconds: float) -> int:
    return max(0, min(int(seconds * 1000), 60_000))
