"""Values, types and MessagePack, without a node."""

from __future__ import annotations

import dataclasses
import enum
import math
from typing import Any, Dict, List, Optional, Set, Tuple, Union

import numpy
import pytest

import sinew
from sinew import _sinew, _types
from sinew._types import from_schema, from_wire, to_wire

PLAIN = [
    None,
    True,
    False,
    0,
    -1,
    127,
    128,
    -32,
    -33,
    2**31,
    -(2**31) - 1,
    2**63 - 1,
    -(2**63),
    2**64 - 1,
    0.0,
    -1.5,
    math.inf,
    "",
    "knie\u00e4",
    "x" * 70_000,
    b"",
    b"\x00" * 300,
    [],
    [1, [2, [3]]],
    list(range(70_000)),
    {},
    {"a": {"b": [1, None]}, 7: b"x"},
    {str(each): each for each in range(70_000)},
]


@pytest.mark.parametrize("value", PLAIN, ids=lambda value: repr(value)[:20])
def test_plain_value_is_read_as_it_was_written(value: Any) -> None:
    data = _sinew.encode(value)
    read = _sinew.decode(data)
    assert read == value and type(read) is type(value)


def test_nan_stays_nan() -> None:
    assert math.isnan(_sinew.decode(_sinew.encode(math.nan)))


def test_values_of_numpy_are_written() -> None:
    value = {"angle": numpy.float32(0.5), "count": numpy.int16(-3), "row": numpy.arange(3), "on": numpy.bool_(True)}
    assert _sinew.decode(_sinew.encode(value)) == {"angle": 0.5, "count": -3, "row": [0, 1, 2], "on": True}


@pytest.mark.parametrize("value", [2**64, -(2**63) - 1])
def test_too_large_a_number_is_refused(value: int) -> None:
    with pytest.raises(OverflowError, match="64 bits"):
        _sinew.encode(value)


def test_value_that_contains_itself_is_refused() -> None:
    endless: List[Any] = []
    endless.append(endless)
    with pytest.raises(ValueError, match="contain itself"):
        _sinew.encode(endless)


def test_list_that_changes_while_it_is_written_is_refused() -> None:
    class Grows:
        def tolist(self) -> int:
            values.append(1)
            return 0

    values: List[Any] = [Grows(), 2]
    with pytest.raises(ValueError, match="changed its length"):
        _sinew.encode(values)


def test_value_without_a_form_is_refused() -> None:
    with pytest.raises(TypeError, match="cannot hold a object"):
        _sinew.encode({"a": object()})


@pytest.mark.parametrize(
    "data",
    [
        b"",  # nothing
        b"\x01\x01",  # a second value
        b"\xdd\xff\xff\xff\xff",  # a list of 2^32 elements that are not there
        b"\xdf\xff\xff\xff\xff\x01",  # a map of them
        b"\xdb\xff\xff\xff\xff",  # a text of 4 GiB
        b"\xc6\xff\xff\xff\xff",  # bytes of 4 GiB
        b"\xa1\xff",  # a text that is no UTF-8
        b"\xd4\x01\x02",  # an extension
        b"\xc1",  # reserved
        b"\x81\x90\x01",  # a list as a key
        b"\xcb\x00",  # half a number
        b"\x91" * 100 + b"\xc0",  # nested too deeply
        b"\x91" * 100_000,
    ],
)
def test_hostile_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(sinew.MalformedError, match="no MessagePack"):
        _sinew.decode(data)


def test_any_bytes_are_a_value_or_refused() -> None:
    generator = numpy.random.default_rng(7)
    for _ in range(20_000):
        data = generator.integers(0, 256, generator.integers(0, 40), dtype=numpy.uint8).tobytes()
        try:
            value = _sinew.decode(data)
        except sinew.MalformedError:
            continue
        # A text may be shorter than it was, a number too; the value is the same.
        again = _sinew.decode(_sinew.encode(value))
        assert repr(again) == repr(value)


def test_number_of_values_is_limited() -> None:
    data = b"\xdd\x00\x10\x00\x01" + b"\xc0" * (2**20 + 1)
    with pytest.raises(sinew.MalformedError, match="more than 1048576 values"):
        _sinew.decode(data)


class Gait(enum.Enum):
    STANDING = "Standing"
    WALKING = "Walking"


@dataclasses.dataclass
class Joint:
    name: str
    limits: Tuple[float, float]
    parent: Optional[Joint] = None


@sinew.payload("test.leg", class_="stream", expires_after=0.5)
class Leg:
    degrees: float
    joints: List[Joint]
    gait: Gait = Gait.STANDING
    notes: Dict[str, int] = dataclasses.field(default_factory=dict)
    mark: Union[int, str, None] = None


def test_dataclass_is_read_as_it_was_written() -> None:
    hinge = Joint("hinge", (0.0, 120.0), Joint("hip", (-10.0, 90.0)))
    leg = Leg(12.5, [hinge], Gait.WALKING, {"a": 1}, "x")
    wire = _sinew.decode(_sinew.encode(leg))
    assert wire["joints"][0]["limits"] == [0.0, 120.0] and wire["gait"] == "Walking"
    assert from_wire(Leg, wire) == leg


def test_missing_and_unknown_fields_follow_the_class() -> None:
    leg = from_wire(Leg, {"degrees": 1, "joints": [], "added_later": 3})
    assert leg == Leg(1.0, []) and isinstance(leg.degrees, float)
    with pytest.raises(sinew.MalformedError, match="'joints' of Leg is missing"):
        from_wire(Leg, {"degrees": 1.0})


@pytest.mark.parametrize(
    ("wire", "fault"),
    [
        ({"degrees": "x", "joints": []}, "'degrees' of Leg"),
        ({"degrees": True, "joints": []}, "'degrees' of Leg"),
        ({"degrees": 1.0, "joints": {}}, "'joints' of Leg"),
        ({"degrees": 1.0, "joints": [{"name": 3, "limits": [0, 1]}]}, "'name' of Joint"),
        ({"degrees": 1.0, "joints": [{"name": "a", "limits": [0]}]}, "'limits' of Joint"),
        ({"degrees": 1.0, "joints": [], "gait": "Running"}, "'gait' of Leg"),
        ("no map", "a Leg is a str"),
    ],
)
def test_value_that_does_not_fit_names_the_field(wire: Any, fault: str) -> None:
    with pytest.raises(sinew.MalformedError, match=fault):
        from_wire(Leg, wire)


@dataclasses.dataclass
class Marks:
    marks: Set[Any]


def test_set_of_lists_is_malformed() -> None:
    assert from_wire(Marks, {"marks": [1, 2, 1]}) == Marks({1, 2})
    with pytest.raises(sinew.MalformedError, match="'marks' of Marks: an element of a set"):
        from_wire(Marks, {"marks": [[1]]})


@pytest.mark.parametrize(
    "wire",
    [
        7,
        {},
        {"NodeFound": 3},
        {"NodeFound": {"node": 1}},
        {"NodeLost": {"node": 1, "name": "knee", "why": {}}},
        {"AppStalled": {"node": 1, "name": "knee", "silent_us": "long"}},
    ],
)
def test_event_of_a_node_in_another_form_is_malformed(wire: Any) -> None:
    with pytest.raises(sinew.MalformedError, match="event of a node"):
        from_wire(sinew.NodeEvent, wire)


def test_unknown_class_of_messages_is_refused() -> None:
    with pytest.raises(ValueError, match="is no class of messages"):
        sinew.payload("test.other", class_="urgent")


def test_two_names_of_one_hash_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for table in ("_CLASSES", "_KINDS", "_NAMES"):
        monkeypatch.setattr(_types, table, {})
    monkeypatch.setattr(_sinew, "kind_of", lambda name: 7)
    one = sinew.payload("test.one")(dataclasses.make_dataclass("One", ["value"]))
    assert _types.class_of_kind(7) is one
    with pytest.raises(ValueError, match="hashes as 'test.one' does"):
        sinew.payload("test.two")(dataclasses.make_dataclass("Two", ["value"]))


STRUCT = (
    "struct",
    [
        ("degrees", ("float",), False),
        ("class", ("int",), False),
        ("note", ("option", ("str",)), True),
        ("joint", ("struct", [("a-b", ("bool",), False)]), False),
        ("tree", ("named", "Tree"), False),
        ("gait", ("enum", [("Standing", None), ("Walking", None)]), False),
        ("step", ("enum", [("None", None), ("Metres", ("float",)), ("Turn", ("struct", [("by", ("float",), False)]))]), False),
    ],
)
TYPES = {"Tree": ("struct", [("value", ("int",), False), ("children", ("list", ("named", "Tree")), False)])}


def test_structure_of_a_node_makes_a_class() -> None:
    cls: Any = from_schema("test.some_leg", STRUCT, TYPES)
    assert cls.__name__ == "SomeLeg"
    assert [field.name for field in dataclasses.fields(cls)][:2] == ["degrees", "class_"]
    wire = {
        "degrees": 1.5,
        "class": 3,
        "joint": {"a-b": True},
        "tree": {"value": 1, "children": [{"value": 2, "children": []}]},
        "gait": "Walking",
        "step": {"Turn": {"by": 2.0}},
    }
    value = cls and from_wire(cls, wire)
    assert (value.class_, value.note, value.joint.a_b, value.gait) == (3, None, True, "Walking")
    assert value.tree.children[0].value == 2
    assert value.step.by == 2.0
    assert _sinew.decode(_sinew.encode(value)) == {**wire, "note": None}
    assert from_wire(cls, {**wire, "step": {"Metres": 0.5}}).step.value == 0.5
    assert from_wire(cls, {**wire, "step": "None"}).step == "None"
    assert from_wire(cls, {**wire, "step": {"Later": 1}}).step == {"Later": 1}


def test_structure_of_one_value_makes_no_class() -> None:
    assert from_schema("test.number", ("float",), {}) is None
    assert from_schema("test.gait", ("enum", [("Standing", None)]), {}) is None


def test_other_values_stay_as_they_are() -> None:
    value = object()
    assert to_wire(value) is value


def test_tid_has_the_form_of_the_tools() -> None:
    tid = sinew.Tid.of(0x0A00_0001, 0x1001)
    assert (tid.node, tid.app) == (0x0A00_0001, 0x1001)
    assert sinew.Tid.parse(str(tid)) == tid
    assert repr(tid).startswith("Tid('10.0.0.1/")
    with pytest.raises(ValueError):
        sinew.Tid.parse("knee")
    assert sinew.group("drives") == sinew.group("drives") != sinew.group("lamps")


def test_every_outcome_has_a_text() -> None:
    for outcome in sinew.Outcome:
        assert len(outcome.text) > 5, outcome
    assert sinew.Outcome(0).is_delivered and not sinew.Outcome(0).is_rejected
    assert sinew.Outcome(20).is_rejected


def test_every_exception_is_below_the_base() -> None:
    for name in sinew.errors.__all__:
        cls = getattr(sinew.errors, name)
        assert issubclass(cls, sinew.SinewError), name
        assert cls.__doc__, name
        assert name in (sinew.errors.__doc__ or ""), name


def test_missing_socket_is_named() -> None:
    with pytest.raises(sinew.NoNodeError, match="does it run"):
        sinew.register(socket="/tmp/sinew-no-such-node.sock").open()
    with pytest.raises(sinew.NoNodeError, match="not the path"):
        sinew.register(socket="x" * 200).open()


@pytest.mark.parametrize("options", [{"deadline": -1.0}, {"deadline": math.nan}, {"inbox_capacity": 0}])
def test_illegal_option_is_refused(options: Dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        sinew.register(socket="/tmp/sinew-no-such-node.sock", **options).open()
    with pytest.raises(ValueError, match="take 'nodes'"):
        sinew.register(socket="/tmp/x", events=["all"])
