"""The exceptions of `sinew`, all below `SinewError`. Each message says cause, place and remedy.

    SinewError
        NoNodeError               no node listens at the socket (also a ConnectionError)
        RefusedError              the node refused the registration
        WaitingError              a requirement was not ready at the deadline: `missing`
        DisconnectedError         the node has gone, the endpoint registers again by itself (also a ConnectionError)
        ClosedError               the endpoint has ended (also a ConnectionError)
        NoAnswerError             the node did not answer in time (also a TimeoutError)
        SendError                 the message was not sent
            StalledError          there was no room in time
            TooLongError          the payload is above the node's limit
            UnknownNameError      no application has the name: `name` (also a LookupError)
            BadNameError          the name breaks the grammar of names (also a ValueError)
        NotHandledError           a request ended without a reply: `outcome`
        NoReplyError              no reply came in time (also a TimeoutError)
        NotAskedError             the message requests no reply
        MalformedError            a payload is not what its type says (also a ValueError)
        TooManyGroupsError        the endpoint, or its node, has the maximum of memberships
        BarrierError              a wait at a barrier failed
            NotMetError           not all parties arrived in time: `missing`
            PartyLostError        a party was lost: `missing`
        ParameterError            the application refused a set of parameters
        GuardError                an output cannot be guarded
            NotGoodError          an output cannot be armed yet
        BusyError                 another call on the endpoint is under way
        ForkedError               the endpoint belongs to the parent process
        BagError                  a recording cannot be read (also an OSError)
"""

from __future__ import annotations

from typing import List, Tuple

from ._values import Outcome

__all__ = [
    "BadNameError",
    "BagError",
    "BarrierError",
    "BusyError",
    "ClosedError",
    "DisconnectedError",
    "ForkedError",
    "GuardError",
    "MalformedError",
    "NoAnswerError",
    "NoNodeError",
    "NoReplyError",
    "NotAskedError",
    "NotGoodError",
    "NotHandledError",
    "NotMetError",
    "ParameterError",
    "PartyLostError",
    "RefusedError",
    "SendError",
    "SinewError",
    "StalledError",
    "TooLongError",
    "TooManyGroupsError",
    "UnknownNameError",
    "WaitingError",
]


class SinewError(Exception):
    """The base of all exceptions of this package."""


class NoNodeError(SinewError, ConnectionError):
    """No node listens at the socket, or this user may not connect. Nothing was done."""


class RefusedError(SinewError):
    """The node refused the registration, with this reason. Nothing is registered."""


class WaitingError(SinewError):
    """A requirement was not ready at the deadline of the registration. Nothing is registered."""

    missing: List[str] = []
    """The missing requirements, each with the node's information about it."""


class DisconnectedError(SinewError, ConnectionError):
    """The connection has ended. The endpoint registers again by itself while it is used: continue with `receive`."""


class ClosedError(SinewError, ConnectionError):
    """The endpoint has ended, or was unregistered. Register a new one."""


class NoAnswerError(SinewError, TimeoutError):
    """The node did not answer in time. Whether it executed the request is unknown."""


class SendError(SinewError):
    """The message was not sent."""


class StalledError(SendError):
    """There was no room in time. The receiver gets nothing of the message."""


class TooLongError(SendError):
    """The payload is above the node's limit."""


class UnknownNameError(SendError, LookupError):
    """No application has the name now."""

    name: str = ""
    """The name."""
    nearest: List[str] = []
    """Similar names, if the node gave some."""


class BadNameError(SendError, ValueError):
    """The name breaks the grammar of names."""


class NotHandledError(SinewError):
    """A request was not handled, or the node refused it."""

    code: int = 4
    """The code of the outcome."""

    @property
    def outcome(self) -> Outcome:
        """The outcome, which states the reason."""
        return Outcome(self.code)


class NoReplyError(SinewError, TimeoutError):
    """No reply came in time. The request may have been handled."""


class NotAskedError(SinewError):
    """The message requests no reply, or its sender takes none from this endpoint. Nothing was sent."""


class MalformedError(SinewError, ValueError):
    """A payload is not what its type says."""


class TooManyGroupsError(SinewError):
    """The endpoint is a member of 256 groups, or its user or node has the maximum of memberships."""


class BarrierError(SinewError):
    """A wait at a barrier failed."""

    missing: List[Tuple[str, str]] = []
    """The parties that did not arrive, each with the reason."""


class NotMetError(BarrierError):
    """Not all parties arrived at the barrier in time. The others keep waiting."""


class PartyLostError(BarrierError):
    """A party of the barrier was lost."""


class ParameterError(SinewError):
    """The application refused a set of parameters, with this reason. No value was applied."""


class GuardError(SinewError):
    """An output cannot be guarded: the watchdog cannot be started, or this source is guarded already."""


class NotGoodError(GuardError):
    """The output cannot be armed yet: too few good messages in a row, or a stop of the system. It stays safe."""


class BusyError(SinewError):
    """Another call on this endpoint is under way. Register one endpoint for each thread."""


class ForkedError(SinewError):
    """The endpoint belongs to the process that this one was forked from. Register another one."""


class BagError(SinewError, OSError):
    """A recording cannot be read."""
