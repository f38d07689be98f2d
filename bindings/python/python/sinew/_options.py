"""The options that the extension module takes as dictionaries."""

from __future__ import annotations

from typing import List, Optional, TypedDict


class RegisterOptions(TypedDict):
    """Those of a registration."""

    name: Optional[str]
    requires: List[str]
    handles: List[str]
    node_events: bool
    requirement_events: bool
    deadline: float
    stall_timeout: float
    inbox_capacity: int
    address: Optional[int]
    socket_only: bool
    reconnect: bool
    own_user_only: bool


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
