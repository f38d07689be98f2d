"""Applications in Python for Sinew: messages with outcomes, for asyncio and for threads; recordings for pandas.

    import asyncio, sinew

    @sinew.payload("exo.angle", class_="stream")
    class Angle:
        degrees: float

    async def main():
        async with sinew.register("tuner", requires=["knee.drive"]) as me:
            print(await me.send_confirmed("knee.drive", "exo.home", {}))
            async for message in me:
                if isinstance(message.value, Angle):
                    print(message.value.degrees, message.age)

    asyncio.run(main())

A Python process is an application apart: a pause of the GIL stalls this application, and nothing else.
"""

from __future__ import annotations

import os as _os

from . import _sinew, errors
from ._aio import AsyncEndpoint
from ._bag import Bag, BagMessage, bag
from ._blocking import Endpoint
from ._message import Message
from ._parameters import parameter, parameters
from ._protection import Guard, Protected
from ._register import Registration, register
from ._reports import (
    Applied,
    NodeEvent,
    Parameter,
    ParameterList,
    PartOutcome,
    StopNode,
    StopReport,
    TransactionReport,
    Undelivered,
)
from ._structure import F32, I8, I16, I32, U8, U16, U32, U64
from ._types import payload
from ._values import BROADCAST, MemberOutcome, MessageClass, Outcome, Tid, group
from .errors import (
    BadNameError,
    BagError,
    BarrierError,
    BusyError,
    ClosedError,
    DisconnectedError,
    ForkedError,
    GuardError,
    MalformedError,
    NoAnswerError,
    NoNodeError,
    NoReplyError,
    NotAskedError,
    NotGoodError,
    NotHandledError,
    NotMetError,
    ParameterError,
    PartyLostError,
    RefusedError,
    SendError,
    SinewError,
    StalledError,
    TooLongError,
    TooManyGroupsError,
    UnknownNameError,
    WaitingError,
)

__version__ = "0.1.0"

# The child has only copies of endpoints and messages.
_os.register_at_fork(after_in_child=_sinew.forked)

__all__ = [
    "BROADCAST",
    "F32",
    "I8",
    "I16",
    "I32",
    "U8",
    "U16",
    "U32",
    "U64",
    "Applied",
    "AsyncEndpoint",
    "BadNameError",
    "Bag",
    "BagError",
    "BagMessage",
    "BarrierError",
    "BusyError",
    "ClosedError",
    "DisconnectedError",
    "Endpoint",
    "ForkedError",
    "Guard",
    "GuardError",
    "MalformedError",
    "MemberOutcome",
    "Message",
    "MessageClass",
    "NoAnswerError",
    "NoNodeError",
    "NoReplyError",
    "NodeEvent",
    "NotAskedError",
    "NotGoodError",
    "NotHandledError",
    "NotMetError",
    "Outcome",
    "Parameter",
    "ParameterError",
    "ParameterList",
    "PartOutcome",
    "PartyLostError",
    "Protected",
    "RefusedError",
    "Registration",
    "SendError",
    "SinewError",
    "StalledError",
    "StopNode",
    "StopReport",
    "Tid",
    "TooLongError",
    "TooManyGroupsError",
    "TransactionReport",
    "Undelivered",
    "UnknownNameError",
    "WaitingError",
    "bag",
    "errors",
    "group",
    "parameter",
    "parameters",
    "payload",
    "register",
]
