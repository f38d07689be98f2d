"""What an application in Python declares of itself: the structures of its types, and parameters that it serves."""

from __future__ import annotations

import asyncio
import dataclasses
import enum
import threading
from typing import Annotated, Any, Callable, Dict, List, Optional, Tuple

import pytest

import sinew
from helpers import LONG, until
from sinew import Outcome, _sinew
from sinew._structure import structure_of
from sinew._types import from_schema


class Gait(enum.Enum):
    STANDING = "Standing"
    WALKING = "Walking"


@dataclasses.dataclass
class Joint:
    name: str
    limits: Tuple[Annotated[float, sinew.F32], float]
    parent: Optional[Joint] = None


@sinew.payload("declared.leg")
class Leg:
    degrees: float
    count: Annotated[int, sinew.U16]
    joints: List[Joint]
    raw: bytes
    notes: Dict[str, bool]
    gait: Gait = Gait.STANDING


@sinew.payload("peer.move")
class Move:
    degrees: float


@sinew.payload("peer.angle", class_="control")
class WideAngle:
    degrees: float


@sinew.payload("declared.tree")
class Tree:
    value: int
    children: List[Tree]


@sinew.payload("declared.anything")
class Anything:
    value: Any


def test_structure_has_each_annotation() -> None:
    structure = structure_of(Leg)
    assert structure is not None
    root, types = _sinew.parse_schema(structure)
    assert root == (
        "struct",
        [
            ("degrees", ("float",), False),
            ("count", ("int",), False),
            ("joints", ("list", ("named", "Joint")), False),
            ("raw", ("bytes",), False),
            ("notes", ("map", ("str",), ("bool",)), False),
            ("gait", ("named", "Gait"), True),
        ],
    )
    assert types["Gait"] == ("enum", [("Standing", None), ("Walking", None)])
    assert types["Joint"][1][1] == ("limits", ("tuple", [("float",), ("float",)]), False)
    assert types["Joint"][1][2] == ("parent", ("option", ("named", "Joint")), True)


def test_class_that_contains_itself_has_a_structure() -> None:
    structure = structure_of(Tree)
    assert structure is not None
    assert from_schema("declared.tree", *_sinew.parse_schema(structure)) is not None


def test_class_with_an_open_annotation_has_none() -> None:
    assert structure_of(Anything) is None


@pytest.mark.parametrize("hint", [Annotated[Optional[float], sinew.F32], Annotated[float, sinew.U8], Annotated[int, sinew.F32]])
def test_width_of_another_type_is_refused(hint: Any) -> None:
    wrong = dataclasses.make_dataclass("Wrong", [("value", hint)])
    with pytest.raises(TypeError, match="no width of"):
        structure_of(wrong)


@pytest.mark.parametrize("shape", [("word",), ("list", ("list",)), ("named", "absent"), ()])
def test_structure_without_a_form_is_refused(shape: Any) -> None:
    with pytest.raises((ValueError, IndexError)):
        _sinew.make_schema(shape, {})
    nested: Any = ("i8",)
    for _ in range(100):
        nested = ("list", nested)
    with pytest.raises(ValueError, match="nested deeper"):
        _sinew.make_schema(nested, {})


def test_node_has_the_structure_of_a_type_that_python_sends(node: Any) -> None:
    with node.register("leg", sends=[Leg], handles=[Tree, Anything, "declared.named"]) as leg:

        def schemas() -> Any:
            inspect = sinew.Tid.of(leg.tid.node, 5)
            asked = {"kind": _sinew.kind_of("declared.leg")}
            return leg.ask(inspect, "sinew.inspect.schemas", asked, within=LONG).value["schemas"]

        until(lambda: bool(schemas()), "the node has no structure")
        (found,) = schemas()
        assert found["schema"] == structure_of(Leg)
        assert [user["tid"]["app"] for user in found["sent_by"]] == [leg.tid.app] and found["handled_by"] == []


def test_receiver_in_rust_compares_the_type(peer: Any) -> None:
    with peer.register("fits", sends=[Move], requires=["knee"]) as me:
        assert me.send_confirmed("knee", Move(30.0), within=LONG) is Outcome.DELIVERED
    # 64 bits do not fit into the 32 of the receiver: refused, unless the class says the width.
    with peer.register("wide", sends=[WideAngle], requires=["knee"]) as me:
        until(
            lambda: me.send_confirmed("knee", WideAngle(30.0), within=LONG) is not Outcome.DELIVERED,
            "the types are not compared",
        )
        assert me.send_confirmed("knee", WideAngle(30.0), within=LONG).is_rejected
    with peer.register("undeclared", requires=["knee"]) as me:
        assert me.send_confirmed("knee", WideAngle(30.0), within=LONG) is Outcome.DELIVERED


# Parameters


@sinew.parameters
class Gains:
    """How the knee assists."""

    assistance: float = sinew.parameter(0.3, unit="1", range=(0.0, 1.0), about="Share of the model's torque.")
    steps: int = sinew.parameter(3, range=(0, 9))
    damped: bool = sinew.parameter(False, about="Whether the knee is damped.")
    angle: float = sinew.parameter(10.0, unit="deg", range=(0.0, 90.0), slope=1_000.0)


def test_objects_have_values_of_their_own() -> None:
    one, other = Gains(), Gains()
    assert (one.assistance, one.steps, one.damped, other.angle) == (0.3, 3, False, 10.0)
    assert type(one.steps) is int and type(one.damped) is bool
    with pytest.raises(AttributeError):
        one.assistance = 0.5  # only messages change it
    assert isinstance(Gains.__dict__["assistance"], property) and Gains.assistance.__doc__ == "Share of the model's torque."


@pytest.mark.parametrize(
    ("declared", "fault"),
    [
        (lambda: sinew.parameter(2.0, range=(0.0, 1.0)), "in its range"),
        (lambda: sinew.parameter(2.0), "without a range"),
        (lambda: sinew.parameter(0.0, range=(0.0, float("inf"))), "finite"),
        (lambda: sinew.parameter(0.0, range=(0.0, 1.0), slope=-1.0), "slope is greater than zero"),
        (lambda: sinew.parameter(10, range=(0, 1)), "in its range"),
        (lambda: sinew.parameter(1, slope=1.0), "no slope"),
        (lambda: sinew.parameter(True, range=(False, True)), "no range"),
        (lambda: sinew.parameter("text"), "a float, an int or a bool"),
    ],
)
def test_illegal_declaration_is_refused(declared: Callable[[], Any], fault: str) -> None:
    with pytest.raises((ValueError, TypeError), match=fault):
        sinew.parameters(type("Bad", (), {"value": declared()}))


def test_class_without_a_declaration_is_refused(node: Any) -> None:
    with pytest.raises(TypeError, match="declares no parameter"):
        sinew.parameters(type("Empty", (), {}))
    with pytest.raises(TypeError, match=r"@sinew\.parameters"):
        node.register("knee", parameters=object())
    with pytest.raises(ValueError, match="at most 64"):
        sinew.parameters(type("Many", (), {f"p{each}": sinew.parameter(each) for each in range(65)}))


def test_set_arrives_at_the_begin_of_a_turn(node: Any) -> None:
    gains, turns, seen = Gains(), 0, []
    with node.register("knee", parameters=gains, period=0.005) as knee:

        def tune() -> None:
            with node.register("tuner", requires=["knee"]) as tuner:
                listed = tuner.parameters("knee", LONG)
                seen.append((listed["assistance"].unit, listed["steps"].maximum, listed["angle"].slope_per_s))
                seen.append(listed["assistance"].description)
                seen.append(tuner.set_parameters("knee", {"assistance": 0.5, "damped": True}, LONG).values)
                with pytest.raises(sinew.ParameterError, match=r"1\.5.*is outside"):
                    tuner.set_parameters("knee", {"assistance": 1.5, "damped": False}, LONG)
                tuner.set_parameters("knee", {"angle": 80.0}, LONG)
                tuner.undo_parameters("knee", LONG)
                tuner.undo_parameters("knee", LONG)

        tuner = threading.Thread(target=tune)
        tuner.start()
        while tuner.is_alive():
            knee.tick()
            turns += 1
            before = (gains.assistance, gains.damped)
            assert before in ((0.3, False), (0.5, True)), "both belong together"
            assert knee.receive(0.005) is None, "messages about parameters are not for the program"
            assert (gains.assistance, gains.damped) == before, "nothing changes within a turn"
        tuner.join()
    assert seen == [("1", 9, 1_000.0), "Share of the model's torque.", {"assistance": 0.5, "damped": True}]
    assert turns > 3 and gains.assistance == 0.3


def test_without_a_loop_a_set_arrives_between_two_messages(node: Any) -> None:
    async def main() -> List[Any]:
        gains = Gains()
        async with node.register("knee", parameters=gains) as knee, node.register() as other:
            receiving = asyncio.create_task(knee.receive(LONG))
            applied = await other.set_parameters("knee", {"steps": 7}, LONG)
            with pytest.raises(sinew.ParameterError, match="slope"):
                await other.set_parameters("knee", {"angle": 20.0}, LONG)
            await other.send("knee", "declared.text", "hello")
            message = await receiving
            return [applied.tick, gains.steps, message.value]

    assert asyncio.run(main()) == [0, 7, "hello"]


def test_transaction_includes_an_application_in_python(node: Any) -> None:
    one, other, report = Gains(), Gains(), []
    with node.register("one", parameters=one, period=0.005) as first, node.register(
        "other", parameters=other, period=0.005
    ) as second:

        def tune() -> None:
            with node.register("tuner", requires=["one", "other"]) as tuner:
                report.append(tuner.set_together({"one": {"steps": 5}, "other": {"steps": 6}}, within=LONG))

        tuner = threading.Thread(target=tune)
        tuner.start()
        while tuner.is_alive():
            for endpoint in (first, second):
                endpoint.tick()
                endpoint.receive(0.002)
        tuner.join()
    assert (one.steps, other.steps) == (5, 6), report
