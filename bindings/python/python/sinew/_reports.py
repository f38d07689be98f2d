"""Reports of a node: parameters, the stop of the system, events of nodes, messages that were not delivered."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Dict, List, Mapping, Optional, Union

from ._types import PayloadType, kind_id, kind_name, register_class
from ._values import Outcome, Tid
from .errors import MalformedError

__all__ = ["Applied", "NodeEvent", "Parameter", "ParameterList", "StopNode", "PartOutcome", "StopReport", "TransactionReport", "Undelivered"]

ParameterValue = Union[float, int, bool]


def value_to_wire(value: Any) -> Dict[str, Any]:
    """Returns a value of a parameter as it travels."""
    if isinstance(value, bool):
        return {"Flag": value}
    if isinstance(value, int):
        return {"Integer": value}
    if isinstance(value, float):
        return {"Number": value}
    raise TypeError(f"a parameter is a float, an int or a bool, not a {type(value).__name__}")


def value_from_wire(value: Any) -> ParameterValue:
    """Returns a value of a parameter."""
    if isinstance(value, dict) and len(value) == 1:
        ((_, found),) = value.items()
        if isinstance(found, (bool, int, float)):
            return found
    raise MalformedError("a value of a parameter has an unknown form; update this package")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter of an application."""

    name: str
    value: ParameterValue
    target: ParameterValue
    """The value to which it moves; equal to `value` if it does not move."""
    default: ParameterValue
    unit: str
    minimum: Optional[ParameterValue]
    maximum: Optional[ParameterValue]
    slope_per_s: Optional[float]
    """Maximum change in a second; `None`: a new value applies at once."""
    keep: bool
    """Whether the value survives a restart of its application."""
    description: str

    @classmethod
    def of(cls, wire: Mapping[str, Any]) -> Parameter:
        """Reads a report."""

        def limit(key: str) -> Optional[ParameterValue]:
            found = wire.get(key)
            return None if found is None else value_from_wire(found)

        return cls(
            name=wire["name"],
            value=value_from_wire(wire["value"]),
            target=value_from_wire(wire["target"]),
            default=value_from_wire(wire["default"]),
            unit=wire["unit"],
            minimum=limit("min"),
            maximum=limit("max"),
            slope_per_s=wire["slope_per_s"],
            keep=wire["keep"],
            description=wire["description"],
        )


class ParameterList(Mapping[str, Parameter]):
    """The parameters of an application, by their names."""

    def __init__(self, wire: Mapping[str, Any]) -> None:
        parameters = (Parameter.of(each) for each in wire["parameters"])
        self._parameters = {each.name: each for each in parameters}
        self.has_ticks: bool = wire["has_ticks"]
        """Whether sets are applied at the ticks of a periodic timer."""
        self.undoable: int = wire["undoable"]
        """Number of sets that can be undone."""

    def __getitem__(self, name: str) -> Parameter:
        return self._parameters[name]

    def __iter__(self) -> Any:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def __repr__(self) -> str:
        values = ", ".join(f"{each.name}={each.value!r}" for each in self._parameters.values())
        return f"ParameterList({values})"


@dataclasses.dataclass(frozen=True)
class Applied:
    """A set of parameters that was applied as a whole."""

    tick: int
    """The number of the tick; 0 if the application has no periodic timer."""
    at: float
    """When, in seconds of the application's clock."""
    values: Dict[str, ParameterValue]

    @classmethod
    def of(cls, wire: Mapping[str, Any]) -> Applied:
        """Reads an outcome."""
        values = {each["name"]: value_from_wire(each["value"]) for each in wire["values"]}
        return cls(tick=wire["tick"], at=wire["at_ns"] / 1e9, values=values)


@dataclasses.dataclass(frozen=True)
class PartOutcome:
    """The outcome of a transaction for one application."""

    what: str
    """ "Applied", "Repaired", "Agreed" (at its next tick), "Refused" or "Unknown"."""
    tick: int
    """The number of the tick; 0 without a periodic timer."""
    why: str
    """The reason of a refusal, or why the outcome is not known."""


@dataclasses.dataclass(frozen=True)
class TransactionReport:
    """The result of a transaction of parameters over several applications."""

    verdict: str
    """ "All", "None", "Repaired" (all have the values now) or "Mixed"."""
    parts: Dict[str, PartOutcome]
    """The outcome of each application."""

    @property
    def is_applied(self) -> bool:
        """Whether all applications have the values, or have them at their next tick."""
        return self.verdict in ("All", "Repaired")


def _seconds(micros: Optional[int]) -> Optional[float]:
    return None if micros is None else micros / 1e6


@dataclasses.dataclass(frozen=True)
class StopNode:
    """The part of one node in the stop of the whole system."""

    node: int
    name: str
    state: Optional[str]
    """ "Released", "Held" or "Stopped", as last received; `None`: nothing was received."""
    confirmed: Optional[float]
    """Seconds from the press until the node's confirmation; `None`: it has not confirmed."""
    bound: Optional[float]
    """Seconds after the press within which its own watchdogs make its outputs safe; `None`: not known."""
    outputs: int
    """Number of guarded outputs in its process."""
    note: str


@dataclasses.dataclass(frozen=True)
class StopReport:
    """The state of the stop, as one node knows it."""

    state: str
    """ "Released", "Held" or "Stopped"."""
    nodes: List[StopNode]
    presses: List[str]
    """The reasons of the presses that are not released."""
    refused: Optional[str]
    """Why nothing was done; `None`: it was done, or nothing was asked."""

    @property
    def is_confirmed(self) -> bool:
        """Whether the system is stopped and every known node has confirmed that its outputs are safe."""
        return self.state == "Stopped" and all(node.confirmed is not None for node in self.nodes)

    @classmethod
    def of(cls, wire: Mapping[str, Any]) -> StopReport:
        """Reads a report."""
        nodes = [
            StopNode(
                node=each["node"],
                name=each["name"],
                state=each["state"],
                confirmed=_seconds(each["confirmed_us"]),
                bound=_seconds(each["bound_us"]),
                outputs=each["outputs"],
                note=each["note"],
            )
            for each in wire["nodes"]
        ]
        presses = [each["reason"] for each in wire["presses"]]
        return cls(state=wire["state"], nodes=nodes, presses=presses, refused=wire["refused"])


@dataclasses.dataclass(frozen=True)
class NodeEvent:
    """An event about a node: found, lost, restarted, or with a stalled application."""

    __sinew__: ClassVar[PayloadType]

    what: str
    """ "NodeFound", "NodeLost", "NodeRestarted", "AppStalled" or "AppResumed"."""
    node: int
    name: str
    """Name of the node."""
    why: Optional[str]
    """The cause of a loss, such as "Crashed", "Hung" or "LinkDown"."""
    app_name: Optional[str]
    """Name of a stalled layer or application."""
    silent: Optional[float]
    """Seconds since the last sign of life."""
    details: Dict[str, Any]
    """All fields, as they were sent."""

    @classmethod
    def __sinew_from_wire__(cls, wire: Any) -> NodeEvent:
        try:
            ((what, fields),) = wire.items()
            why = fields.get("why")
            if isinstance(why, dict):
                (why,) = why
            return cls(
                what=what,
                node=fields["node"],
                name=fields["name"],
                why=why,
                app_name=fields.get("app_name"),
                silent=_seconds(fields.get("silent_us")),
                details=fields,
            )
        except (AttributeError, KeyError, TypeError, ValueError):
            raise MalformedError("an event of a node has an unknown form; update this package") from None


register_class(NodeEvent, PayloadType("sinew.node_event", kind_id("sinew.node_event"), 0, None))


@dataclasses.dataclass(frozen=True)
class Undelivered:
    """Unconfirmed messages to one destination, of one type, that were not delivered for one reason."""

    destination: Tid
    name: Optional[str]
    """Name of the destination, if the node knows one."""
    kind: Optional[str]
    """Name of the type; `None`: several, or unknown."""
    outcome: Outcome
    count: int
    """Number of messages since the last report."""

    @classmethod
    def of(cls, report: Any) -> Undelivered:
        """Reads a report of the extension module."""
        destination, name, kind, code, count = report
        kind = None if kind is None else kind_name(kind)
        return cls(Tid(destination), name, kind, Outcome(code), count)
