"""The registration of an endpoint, for threads and for asyncio."""

from __future__ import annotations

import os
from types import TracebackType
from typing import Any, Generator, Iterable, Optional, Type, Union

from . import _sinew
from ._aio import AsyncEndpoint, begin
from ._blocking import Endpoint
from ._options import NamedType, RegisterOptions
from ._parameters import native_set
from ._structure import structure_of
from ._types import kind_id, payload_type
from .errors import NoNodeError

__all__ = ["Registration", "register"]

VARIABLE = "SINEW_SOCKET"
"""The environment variable with the socket of the node, as for the command `sinew`."""


class Registration:
    """A registration that has not begun. `async with`, or `await`, gives an `AsyncEndpoint`; `with` an `Endpoint`."""

    def __init__(self, socket: str, options: RegisterOptions) -> None:
        self._socket = socket
        self._options = options
        self._endpoint: Union[Endpoint, AsyncEndpoint, None] = None

    def open(self) -> Endpoint:
        """Registers, and blocks until all requirements are ready."""
        done = _sinew.register(self._socket, self._options).run()
        assert done is not None, "without a timeout it ends with a result"
        return Endpoint(done[0])

    async def open_async(self) -> AsyncEndpoint:
        """Registers in the running event loop, and waits until all requirements are ready."""
        return await begin(_sinew.register(self._socket, self._options))

    def __await__(self) -> Generator[Any, Any, AsyncEndpoint]:
        return self.open_async().__await__()

    def __enter__(self) -> Endpoint:
        endpoint = self.open()
        self._endpoint = endpoint
        return endpoint

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        assert isinstance(self._endpoint, Endpoint), "it was entered"
        self._endpoint.__exit__(kind, error, trace)

    async def __aenter__(self) -> AsyncEndpoint:
        endpoint = await self.open_async()
        self._endpoint = endpoint
        return endpoint

    async def __aexit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        assert isinstance(self._endpoint, AsyncEndpoint), "it was entered"
        await self._endpoint.__aexit__(kind, error, trace)


def register(
    name: Optional[str] = None,
    *,
    socket: Union[str, os.PathLike[str], None] = None,
    requires: Iterable[str] = (),
    handles: Iterable[Union[str, type]] = (),
    sends: Iterable[Union[str, type]] = (),
    parameters: Any = None,
    period: float = 0.0,
    events: Iterable[str] = (),
    deadline: float = 60.0,
    stall_timeout: float = 1.0,
    inbox_capacity: int = 256,
    address: Optional[int] = None,
    socket_only: bool = False,
    reconnect: bool = True,
    own_user_only: bool = False,
    direct: str = "automatic",
) -> Registration:
    """Registers an application at the node of this host.

    - `name`: unique on the node; without it the application has an address alone.
    - `socket`: the `lncl.socket` of the node's configuration. Without it, `$SINEW_SOCKET`.
    - `requires`: names, patterns and counts that have to be ready first, as in Rust: `["knee.drive", "camera ?2s"]`.
    - `handles`: the types that the application handles, by name or by class. Tools and recordings have their names and
      their structures from here.
    - `sends`: the types that it sends, in the same way. Nodes compare the structure of a class with that of each receiver.
    - `parameters`: an object of a class with `@sinew.parameters`, whose values the application serves.
    - `period`: seconds of the loop that reads them and calls `tick` in each turn. 0.0: there is no loop, and values
      change between two received messages.
    - `events`: "nodes" for messages of `sinew.NodeEvent`, "requirements" for those about its requirements.
    - `deadline`: seconds for the registration, with the wait for the requirements.
    - `stall_timeout`: seconds that a send waits while the node reads nothing.
    - `inbox_capacity`: messages that wait in this process before no more are read.
    - `address`: a fixed address, else a dynamic one.
    - `socket_only`: no rings in shared memory.
    - `reconnect`: whether the endpoint registers again when its node was restarted.
    - `direct`: links to other processes that bypass the node, in shared memory: "automatic" with frequent peers, "always"
      from the first message on, "never".
    - `own_user_only`: trust only a node of this user, or of root. For a socket in a folder that others can write.

        async with sinew.register("tuner", requires=["knee.drive"]) as me: ...
        with sinew.register("tuner", requires=["knee.drive"]) as me: ...
    """
    path = socket if socket is not None else os.environ.get(VARIABLE)
    if not path:
        text = f"no socket of a node is named; give socket='/run/sinew/NAME.sock', or set ${VARIABLE}"
        raise NoNodeError(text)
    wanted = set(events)
    if wanted - {"nodes", "requirements"}:
        raise ValueError(f"events is {sorted(wanted)}: take 'nodes' and 'requirements'")
    options: RegisterOptions = {
        "name": name,
        "requires": list(requires),
        "handles": [_named_type(each) for each in handles],
        "sends": [_named_type(each) for each in sends],
        "parameters": None if parameters is None else (native_set(parameters), float(period)),
        "node_events": "nodes" in wanted,
        "requirement_events": "requirements" in wanted,
        "deadline": float(deadline),
        "stall_timeout": float(stall_timeout),
        "inbox_capacity": inbox_capacity,
        "address": address,
        "socket_only": socket_only,
        "reconnect": reconnect,
        "own_user_only": own_user_only,
        "direct": direct,
    }
    return Registration(os.fspath(path), options)


def _named_type(of: Union[str, type]) -> NamedType:
    if isinstance(of, str):
        kind_id(of)
        return of, None
    properties = payload_type(of)
    if properties is None:
        raise TypeError(f"{of.__name__} is no payload class: declare it with @sinew.payload, or give a name")
    return properties.name, structure_of(of)
