"""Received messages."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any, Optional, Tuple, Type, Union

from . import _sinew
from ._types import class_of_kind, from_wire, kind_id, kind_name, payload_type
from ._values import MessageClass, Outcome, Tid, class_of_number
from .errors import MalformedError

if TYPE_CHECKING:
    import numpy as _numpy

__all__ = ["Message"]

_MISSING = object()


class Message:
    """A received message.

    If its sender wants the outcome, it is reported when the last reference to the message has gone: delivered. `settle`
    reports another one, or reports it sooner. As a context manager it reports `FAILED` after an exception:

        with message:
            handle(message.value)
    """

    __slots__ = ("__weakref__", "_received", "_value")

    def __init__(self, received: _sinew.Received) -> None:
        self._received = received
        self._value: Any = _MISSING

    @property
    def kind(self) -> str:
        """The name of the type; its id as text if this program has not used the name."""
        return kind_name(self._received.kind)

    @property
    def kind_id(self) -> int:
        """The id of the type."""
        return self._received.kind

    def is_kind(self, of: Union[str, type]) -> bool:
        """Whether the message has this type, given by its name or its class."""
        if isinstance(of, str):
            return self._received.kind == kind_id(of)
        properties = payload_type(of)
        return properties is not None and properties.kind == self._received.kind

    @property
    def source(self) -> Tid:
        """The sender; its node guarantees it."""
        return Tid(self._received.source)

    @property
    def destination(self) -> Tid:
        """The destination: this endpoint, a group, or all applications."""
        return Tid(self._received.destination)

    @property
    def message_class(self) -> MessageClass:
        """The class."""
        return class_of_number(self._received.message_class)

    @property
    def sequence(self) -> int:
        """The number of the message among the source's messages, from 1."""
        return self._received.sequence

    @property
    def age(self) -> Optional[float]:
        """Seconds from the sending until now, with an error of up to `age_error`; `None` if unknown."""
        return self._received.age

    @property
    def age_error(self) -> Optional[float]:
        """Maximum error of the age in seconds: 0.0 for a message of this host; `None` if the age is unknown."""
        return self._received.age_error

    def is_older_than(self, seconds: float) -> bool:
        """Whether the message may be older. An unknown age counts as too old."""
        return self._received.is_older_than(seconds)

    @property
    def is_retained(self) -> bool:
        """Whether this value was sent to the group before this endpoint joined it."""
        return self._received.is_retained

    @property
    def wants_reply(self) -> bool:
        """Whether the sender waits for a reply."""
        return self._received.wants_reply

    @property
    def data(self) -> bytes:
        """The payload as it was sent, as a copy."""
        return self._received.data

    def __len__(self) -> int:
        return len(self._received)

    @property
    def value(self) -> Any:
        """The value of the payload: of the class of its type if there is one, else of `dict`, `list` and so on.

        Raises `MalformedError` if the payload is not what its type says; the sender then gets that outcome. For a payload
        that is no MessagePack use `data` or `array`.
        """
        if self._value is _MISSING:
            cls = class_of_kind(self._received.kind)
            self._value = self.decode(cls) if cls is not None else self._plain()
        return self._value

    def decode(self, cls: Type[Any]) -> Any:
        """Returns the value as one of this class. Raises `MalformedError` as `value` does."""
        plain = self._plain()
        try:
            return from_wire(cls, plain)
        except MalformedError:
            self.settle(Outcome.REJECTED_MALFORMED)
            raise

    def _plain(self) -> Any:
        try:
            return self._received.value()
        except MalformedError:
            self.settle(Outcome.REJECTED_MALFORMED)
            raise

    def array(self, dtype: Any = "uint8", shape: Optional[Tuple[int, ...]] = None) -> _numpy.ndarray[Any, Any]:
        """Returns a raw payload as an array of numpy, without a copy. It cannot be written.

        The array keeps the memory; it may outlive the message.
        """
        import numpy

        flat: numpy.ndarray[Any, Any] = numpy.asarray(self._received.memory()).view(dtype)
        return flat if shape is None else flat.reshape(shape)

    def settle(self, outcome: Outcome = Outcome.DELIVERED) -> None:
        """Reports the outcome, if the sender wants it and it was not reported yet."""
        self._received.settle(outcome.value)

    def settle_after_turn(self) -> None:
        """Reports that the message is delivered, unless it is a request, which may be replied later.

        An iteration calls it when the next message is asked for: the loop's variable keeps the message until then.
        """
        if not self._received.wants_reply:
            self.settle()

    def __enter__(self) -> Message:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self.settle(Outcome.DELIVERED if kind is None else Outcome.FAILED)

    def __repr__(self) -> str:
        return f"<Message {self.kind} from {self.source}, {len(self)} bytes>"
