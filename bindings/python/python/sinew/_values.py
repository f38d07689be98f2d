"""Addresses, outcomes and classes of messages."""

from __future__ import annotations

import enum
from typing import Dict, Union

from . import _sinew

__all__ = ["BROADCAST", "MemberOutcome", "MessageClass", "Outcome", "Tid", "class_number", "group"]


class Tid(int):
    """A transport ID: the address of an application, `node/app`.

    It is the number with the node in the upper 32 bits and the application in the lower ones.

    >>> Tid.parse("0.0.0.1/00001000").app
    4096
    """

    __slots__ = ()

    @classmethod
    def parse(cls, text: str) -> Tid:
        """Reads the form that tools print."""
        return cls(_sinew.tid_of(text))

    @classmethod
    def of(cls, node: int, app: int) -> Tid:
        """Returns the TID of an application of a node."""
        return cls(node << 32 | app)

    @property
    def node(self) -> int:
        """The address of the node; 0 is the own node."""
        return int(self) >> 32

    @property
    def app(self) -> int:
        """The address of the application within its node."""
        return int(self) & 0xFFFF_FFFF

    def __str__(self) -> str:
        return _sinew.tid_text(int(self))

    def __repr__(self) -> str:
        return f"Tid({str(self)!r})"


BROADCAST = Tid(0xFFFF_FFFF_FFFF_FFFF)
"""All applications of all nodes."""


def group(name: str) -> Tid:
    """Returns the address of the group of this name, on all nodes."""
    return Tid(_sinew.group_tid(name))


class Outcome(enum.Enum):
    """What became of a confirmed message. The values are the codes of the protocol."""

    DELIVERED = 0
    """The handler took the message and returned."""
    EXPIRED = 1
    """Its time to live ended before it was handled."""
    FAILED = 2
    """The handler failed, or the application ended with the message in hand."""
    PEER_LOST = 3
    """The node was lost before the message was sent."""
    UNKNOWN = 4
    """It may have been handled."""
    REJECTED_NO_SUCH_APPLICATION = 16
    REJECTED_NO_SUCH_NODE = 17
    REJECTED_UNKNOWN_KIND = 18
    REJECTED_MALFORMED = 19
    REJECTED_QUEUE_FULL = 20
    REJECTED_TOO_LONG = 21
    REJECTED_CLOSED = 22
    REJECTED_FORGED_SOURCE = 23
    REJECTED_BY_HANDLER = 24
    REJECTED_UNSUPPORTED = 25
    REJECTED_DOWN = 26
    REJECTED_NOT_ALLOWED = 27
    REJECTED_TOO_MANY_MEMBERS = 28

    @property
    def is_delivered(self) -> bool:
        """Whether the message was handled."""
        return self is Outcome.DELIVERED

    @property
    def is_rejected(self) -> bool:
        """Whether the message was refused, and so not handled."""
        return self.value >= 16

    @property
    def text(self) -> str:
        """A sentence: for a rejection its cause and its remedy."""
        return _sinew.outcome_text(self.value)


class MessageClass(enum.Enum):
    """The urgency of a message, and the effect of a newer message on an older one."""

    CONTROL = "control"
    """In order, ahead of all other classes."""
    STREAM = "stream"
    """Only the newest value of each source and type. Cannot be confirmed."""
    BULK = "bulk"
    """In order, after the other classes."""


_NUMBERS: Dict[Union[str, MessageClass], int] = {}
for _number, _class in enumerate(MessageClass):
    _NUMBERS[_class] = _NUMBERS[_class.value] = _number


def class_number(name: Union[str, MessageClass]) -> int:
    """Returns the number of a class for the extension module."""
    number = _NUMBERS.get(name)
    if number is None:
        names = ", ".join(repr(each.value) for each in MessageClass)
        raise ValueError(f"{name!r} is no class of messages: take one of {names}")
    return number


def class_of_number(number: int) -> MessageClass:
    """Returns the class with a number of the extension module."""
    return list(MessageClass)[number]


class MemberOutcome:
    """The outcome of a message to many at one of its members."""

    __slots__ = ("outcome", "tid")

    def __init__(self, tid: Tid, outcome: Outcome) -> None:
        self.tid = tid
        self.outcome = outcome

    def __repr__(self) -> str:
        return f"MemberOutcome({self.tid}, {self.outcome.name})"
