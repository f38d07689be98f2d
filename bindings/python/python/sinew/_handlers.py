"""The handlers of an endpoint's messages, by their types."""

from __future__ import annotations

from typing import Any, Callable, Dict, Optional, Tuple, Union

from ._message import Message
from ._types import kind_id, payload_type

Handler = Callable[[Message], Any]


class Handlers:
    """One handler for each type, and one for all others."""

    def __init__(self) -> None:
        self._by_kind: Dict[int, Handler] = {}
        self._other: Optional[Handler] = None

    def add(self, what: Union[str, type, None], handler: Handler) -> None:
        """Takes the place of a former handler of the type."""
        if what is None:
            self._other = handler
            return
        if isinstance(what, str):
            self._by_kind[kind_id(what)] = handler
            return
        properties = payload_type(what)
        if properties is None:
            raise TypeError(f"{what.__name__} is no payload class: declare it with @sinew.payload, or give a name")
        self._by_kind[properties.kind] = handler

    def find(self, message: Message) -> Optional[Handler]:
        """Returns the handler of a message."""
        return self._by_kind.get(message.kind_id, self._other)

    @staticmethod
    def parts(answer: Any) -> Tuple[Any, ...]:
        """Returns the arguments of `reply` for the result of a handler."""
        if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], str):
            return answer
        return (answer,)
