"""Recordings of a real node, as values and as data frames."""

from __future__ import annotations

import pathlib
from typing import Any, Callable

import pytest

import sinew

pandas = pytest.importorskip("pandas")


@sinew.payload("bag.angle")
class Angle:
    degrees: float
    joints: list  # type: ignore[type-arg]
    age: int = 7


@pytest.fixture
def recording(start_node: Callable[..., Any], tmp_path: pathlib.Path) -> str:
    """A recording of ten angles and five texts."""
    node = start_node(settings=f"[record]\nfile = '{tmp_path}/walk.mcap'\n")
    with node.register("sensor") as sensor, node.register("drive") as drive:
        for number in range(10):
            sensor.send(drive.tid, Angle(number / 2, [number, -number]))
            if number % 2:
                sensor.send(drive.tid, "bag.text", f"step {number}")
        for _ in range(15):
            assert drive.receive(20.0) is not None
    node.stop()
    # The time of the start is in its name.
    (path,) = tmp_path.glob("walk*.mcap")
    return str(path)


def topic(walk: sinew.Bag, messages: int) -> str:
    """Returns the topic with so many messages. Its name has that of its type only if the recorder could still ask for it."""
    (found,) = (name for name, count in walk.topics.items() if count == messages)
    return found


def test_recording_is_read_as_data_frames(recording: str) -> None:
    walk = sinew.bag(recording)
    angles, texts = topic(walk, 10), topic(walk, 5)
    assert walk.damage == [] and walk.metadata(angles)["sinew.role"] == "raw"
    frame = walk.frame(angles)
    assert list(frame["degrees"]) == [number / 2 for number in range(10)]
    assert list(frame["joints.1"]) == [-number for number in range(10)]
    assert list(frame["payload.age"]) == [7] * 10, "the column `age` is that of the message"
    assert frame["degrees"].dtype == float and frame.index.name == "seconds"
    assert frame.index.is_monotonic_increasing and (frame["age"] >= 0).all()
    assert str(walk.frame(angles, "time").index.dtype).startswith("datetime64[ns")
    assert list(walk.frames()[texts]["value"]) == [f"step {number}" for number in range(1, 10, 2)]
    values = [message.value for message in walk if message.topic == angles]
    assert values[3] == {"degrees": 1.5, "joints": [3, -3], "age": 7}
    assert len(walk) >= 15 and angles in walk._repr_html_() and "messages" in repr(walk)
    with pytest.raises(KeyError, match="has no topic"):
        walk.frame("/nothing")
    with pytest.raises(ValueError, match="'seconds' or 'time'"):
        walk.frame(angles, "hours")


def test_fields_are_plotted(recording: str) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    walk = sinew.bag(recording)
    angles = topic(walk, 10)
    axes = walk.plot(f"{angles}:degrees")
    assert [line.get_label() for line in axes.get_lines()] == [f"{angles}:degrees"]
    assert list(axes.get_lines()[0].get_ydata()) == [number / 2 for number in range(10)]
    assert len(walk.plot(angles, ax=axes).get_lines()) == 5
    with pytest.raises(KeyError, match="has no field"):
        walk.plot(f"{angles}:radians")
    from matplotlib import pyplot

    pyplot.close("all")


def test_cut_recording_is_read_up_to_its_end(recording: str, tmp_path: pathlib.Path) -> None:
    data = pathlib.Path(recording).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert any("unfinished" in line for line in sinew.bag(cut).damage)


def test_file_that_is_no_recording_is_refused(tmp_path: pathlib.Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(b"no recording")
    with pytest.raises(sinew.BagError, match=r"other\.mcap"):
        sinew.bag(other)
    with pytest.raises(OSError, match="check the path"):
        sinew.bag(tmp_path / "absent.mcap")
