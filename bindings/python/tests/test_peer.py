"""An application in Rust as the other side: types from structures, parameters; and the stop of the system."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest

import sinew
from helpers import LONG
from sinew import Outcome, _types


@pytest.fixture(autouse=True)
def forget_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test begins without classes of the peer's types."""
    monkeypatch.setattr(_types, "_CLASSES", dict(_types._CLASSES))


def test_class_is_made_from_the_structure_of_the_node(peer: Any) -> None:
    with peer.register(requires=["knee"]) as me:
        plain = me.ask("knee", "peer.get_report", {}, within=LONG).value
        assert isinstance(plain, dict) and plain["joints"][0]["name"] == "hinge"
        report_class: Any = me.type_of("peer.report", LONG)
        assert report_class.__name__ == "Report"
        move_class: Any = me.type_of("peer.move", LONG)
        assert me.send_confirmed("knee", move_class(degrees=30.0), within=LONG) is Outcome.DELIVERED
        assert me.send_confirmed("knee", move_class(degrees=300.0), within=LONG) is Outcome.REJECTED_BY_HANDLER
        report = me.ask("knee", "peer.get_report", {}, within=LONG).value
        assert isinstance(report, report_class)
        assert (report.degrees, report.class_, report.note, report.gait) == (30.0, 2, None, "Standing")
        assert report.joints[0].limits == [0.0, 120.0]
        assert report.last.degrees == 30.0
        me.send_confirmed("knee", move_class(degrees=0.0), within=LONG)
        assert me.ask("knee", "peer.get_report", {}, within=LONG).value.last.value == 0.5
        assert me.type_of("peer.nothing", LONG) is None


def test_payload_of_another_form_is_malformed_in_rust(peer: Any) -> None:
    with peer.register(requires=["knee"]) as me:
        outcome = me.send_confirmed("knee", "peer.move", {"degrees": "far"}, within=LONG)
        assert outcome is Outcome.REJECTED_MALFORMED
        assert me.send_confirmed("knee", "peer.no_such_type", {}, within=LONG) is Outcome.REJECTED_UNKNOWN_KIND


def test_parameters_are_listed_set_and_undone(peer: Any) -> None:
    with peer.register("tuner", requires=["knee"]) as me:
        parameters = me.parameters("knee", LONG)
        assistance = parameters["assistance"]
        assert (assistance.value, assistance.minimum, assistance.maximum, assistance.unit) == (0.3, 0.0, 1.0, "1")
        assert parameters["damped"].value is False and parameters["damped"].minimum is None
        assert "assistance=0.3" in repr(parameters)
        applied = me.set_parameters("knee", {"assistance": 0.5, "damped": True}, LONG)
        assert applied.values == {"assistance": 0.5, "damped": True}
        with pytest.raises(sinew.ParameterError, match=r"1\.4"):
            me.set_parameters("knee", {"assistance": 1.4, "damped": False}, LONG)
        assert me.parameters("knee", LONG)["damped"].value is True, "all or none"
        me.undo_parameters("knee", LONG)
        assert me.parameters("knee", LONG)["assistance"].value == 0.3
        with pytest.raises(TypeError, match="a parameter is a float"):
            me.set_parameters("knee", {"assistance": "much"}, LONG)


def test_parameters_of_several_are_set_together(peer: Any) -> None:
    with peer.register("tuner", requires=["knee"]) as me:
        report = me.set_together({"knee": {"assistance": 0.2, "damped": True}})
        assert report.is_applied and report.parts["knee"].what in ("Applied", "Agreed"), report
        assert me.parameters("knee", LONG)["assistance"].value == 0.2
        refused = me.set_together({"knee": {"assistance": 2.0}})
        assert refused.verdict == "None" and "2" in refused.parts["knee"].why, refused
        with pytest.raises(sinew.ParameterError, match="no application is called hip"):
            me.set_together({"hip": {"assistance": 0.2}})
        with pytest.raises(TypeError, match="a parameter is a float"):
            me.set_together({"knee": {"assistance": "much"}})


def test_parameters_are_set_from_asyncio(peer: Any) -> None:
    async def main() -> None:
        async with peer.register(requires=["knee"]) as me:
            assert (await me.set_together({"knee": {"assistance": 0.4}})).is_applied
            assert (await me.parameters("knee", LONG))["assistance"].value == 0.4
            await me.undo_parameters("knee", LONG)
            assert (await me.parameters("knee", LONG)).undoable == 0

    asyncio.run(main())


def test_stop_is_pressed_and_released(node: Any) -> None:
    with node.register("panel") as panel:
        assert panel.stop_state(LONG).presses == []
        report = panel.press_stop("a test", 1.0)
        assert report.state == "Stopped" and report.presses == ["a test"]
        assert [each.name for each in report.nodes] == ["knee"] and report.refused is None
        with pytest.raises(sinew.NotHandledError):
            panel.acknowledge_stop(LONG)
        released = panel.release_stop(LONG)
        assert released.presses == [] and released.refused is None, released
        # A node that has just started holds its outputs first.
        until = time.monotonic() + LONG
        while (state := panel.stop_state(LONG).state) != "Released":
            assert time.monotonic() < until, state
        panel.acknowledge_stop(LONG)


def test_stop_is_pressed_from_asyncio(node: Any) -> None:
    async def main() -> None:
        async with node.register("panel") as panel:
            assert (await panel.press_stop("a test", 1.0)).state == "Stopped"
            assert (await panel.stop_state(LONG)).presses == ["a test"]

    asyncio.run(main())
