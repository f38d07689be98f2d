"""Recordings: their messages, as values and as data frames of pandas."""

from __future__ import annotations

import html
import os
from typing import TYPE_CHECKING, Any, Dict, Iterator, List, NamedTuple, Optional, Tuple, Union

from . import _sinew
from .errors import MalformedError

if TYPE_CHECKING:
    import pandas as _pandas

__all__ = ["Bag", "BagMessage", "bag"]

BATCH = 4_096
"""Payloads that are read at once."""
ELEMENTS_MAX = 64
"""A list of more elements stays one column of lists."""


class BagMessage(NamedTuple):
    """A message of a recording."""

    topic: str
    """`/{source}/{type}`, as in the file."""
    time: float
    """When it was handed over, in seconds since 1970 of the recording's clock."""
    sent: float
    """When it was sent, in the same clock."""
    sequence: int
    """The lower 32 bits of the number among the source's messages."""
    value: Any
    """The value of the payload; `bytes` if it is no MessagePack."""


class _Topic(NamedTuple):
    """The payloads of one topic, not decoded yet."""

    metadata: Dict[str, str]
    rows: List[Tuple[int, int, int, bytes]]


class Bag:
    """A recording, which is read once. Iterating over it gives each message, in the order of the file.

    >>> walk = sinew.bag("walk.mcap")                                    # doctest: +SKIP
    >>> walk.frame("/knee.drive/exo.angle").plot(y="degrees")            # doctest: +SKIP
    """

    def __init__(self, path: Union[str, os.PathLike[str]]) -> None:
        self.path = os.fspath(path)
        self._topics: Dict[str, _Topic] = {}
        self._order: List[Tuple[str, int]] = []
        reader = _sinew.BagReader(self.path)
        channels: Dict[int, _Topic] = {}
        names: Dict[int, str] = {}
        while True:
            batch = reader.next(BATCH)
            if not batch:
                break
            for number, topic, encoding, metadata in reader.channels():
                if number not in channels and encoding == "msgpack":
                    names[number] = topic
                    channels[number] = self._topics.setdefault(topic, _Topic(metadata, []))
            for number, arrived, sent, sequence, data in batch:
                found = channels.get(number)
                if found is not None:
                    self._order.append((names[number], len(found.rows)))
                    found.rows.append((arrived, sent, sequence, data))
        self.damage = reader.damage()
        """A line for each damaged record that was skipped, and one about a missing end."""

    @property
    def topics(self) -> Dict[str, int]:
        """The topics, and the number of messages of each."""
        return {name: len(topic.rows) for name, topic in self._topics.items()}

    def metadata(self, topic: str) -> Dict[str, str]:
        """The metadata of a topic: `sinew.type`, `sinew.source_name` and so on."""
        return dict(self._topic(topic).metadata)

    def __len__(self) -> int:
        return len(self._order)

    def __iter__(self) -> Iterator[BagMessage]:
        for name, index in self._order:
            arrived, sent, sequence, data = self._topics[name].rows[index]
            yield BagMessage(name, arrived / 1e9, sent / 1e9, sequence, _value(data))

    def _topic(self, name: str) -> _Topic:
        found = self._topics.get(name)
        if found is None:
            topics = ", ".join(sorted(self._topics)) or "none"
            raise KeyError(f"{self.path} has no topic {name!r}; it has {topics}")
        return found

    @property
    def _began(self) -> int:
        return min((topic.rows[0][0] for topic in self._topics.values() if topic.rows), default=0)

    def frame(self, topic: str, index: str = "seconds") -> _pandas.DataFrame:
        """Returns the messages of a topic as a data frame: a row for each, a column for each number or text.

        The index is `seconds` since the recording's first message, or the `time` of the wall clock. `age` is the time
        from sending to arrival, in seconds. Fields inside a field have a point in their column: `joint.degrees`, `joints.0`.
        A field that is called `sequence` or `age` itself is the column `payload.sequence` or `payload.age`.
        """
        import pandas

        rows, found = [], self._topic(topic).rows
        for arrived, sent, sequence, data in found:
            row: Dict[str, Any] = {}
            _flatten("", _value(data), row)
            for own in _OWN:
                if own in row:
                    row[f"payload.{own}"] = row.pop(own)
            rows.append({**row, "sequence": sequence, "age": (arrived - sent) / 1e9})
        times = [arrived for arrived, _, _, _ in found]
        if index == "time":
            labels: Any = pandas.DatetimeIndex(pandas.to_datetime(times, unit="ns", utc=True), name="time")
        elif index == "seconds":
            began = self._began
            labels = pandas.Index([(time - began) / 1e9 for time in times], name="seconds", dtype="float64")
        else:
            raise ValueError(f"index is {index!r}: take 'seconds' or 'time'")
        return pandas.DataFrame(rows, index=labels)

    def frames(self, index: str = "seconds") -> Dict[str, _pandas.DataFrame]:
        """Returns the data frame of each topic."""
        return {name: self.frame(name, index) for name in self._topics}

    def plot(self, *series: str, **options: Any) -> Any:
        """Plots fields over the time, in one picture: `plot("/knee.drive/exo.angle:degrees")`.

        A topic without a field plots all its numbers. `options` are those of `DataFrame.plot`. Needs matplotlib. Returns
        the axes.
        """
        axes: Any = options.pop("ax", None)
        for each in series:
            topic, _, field = each.partition(":")
            frame = self.frame(topic)
            columns = [field] if field else [name for name in frame.select_dtypes("number") if name not in _OWN]
            for column in columns:
                if column not in frame:
                    known = ", ".join(name for name in frame if name not in _OWN)
                    raise KeyError(f"{topic} has no field {column!r}; it has {known}")
                axes = frame[column].plot(ax=axes, label=f"{topic}:{column}", legend=True, **options)
        return axes

    def __repr__(self) -> str:
        return f"<Bag {self.path}: {len(self)} messages of {len(self._topics)} topics>"

    def _repr_html_(self) -> str:
        """Shows the topics in a notebook."""
        rows = "".join(f"<tr><td>{html.escape(name)}</td><td>{count}</td></tr>" for name, count in self.topics.items())
        return f"<table><tr><th>topic</th><th>messages</th></tr>{rows}</table>"


_OWN = ("sequence", "age")


def _value(data: bytes) -> Any:
    try:
        return _sinew.decode(data)
    except MalformedError:
        return data


def _flatten(prefix: str, value: Any, row: Dict[str, Any]) -> None:
    parts: Any = None
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list) and len(value) <= ELEMENTS_MAX:
        parts = enumerate(value)
    if parts is None:
        row[prefix or "value"] = value
        return
    for name, part in parts:
        _flatten(f"{prefix}.{name}" if prefix else str(name), part, row)


def bag(path: Union[str, os.PathLike[str]]) -> Bag:
    """Reads a recording that `sinew record` wrote, whole or cut off."""
    return Bag(path)
