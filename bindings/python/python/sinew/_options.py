"""The options that the extension module takes as dictionaries."""

from __future__ import annotations

from typing import TYPE_CHECKING, List, Optional, Tuple, TypedDict

if TYPE_CHECKING:
    from ._sinew import ParameterSet

NamedType = Tuple[str, Optional[bytes]]
"""The name of a type, and the bytes of its structure if that is known."""


class RegisterOptions(TypedDict):
    """Those of a registration."""

    name: Optional[str]
    requires: List[str]
    handles: List[NamedType]
    sends: List[NamedType]
    parameters: Optional[Tuple[ParameterSet, float]]
    node_events: bool
    requirement_events: bool
    deadline: float
    stall_timeout: float
    inbox_capacity: int
    address: Optional[int]
    socket_only: bool
    reconnect: bool
    own_user_only: bool
    direct: str


class ProtectedOptions(TypedDict):
    """Those of a type of protected payloads."""

    name: str
    length: int
    within: float
    age_max: float
    lost_max: int
    bad_max: int
    good_min: int
    message_class: int
