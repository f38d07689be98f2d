"""Protected payloads: commands that are checked end to end, and outputs that are safe without them."""

from __future__ import annotations

import dataclasses
import signal
from typing import Any, Callable, Generic, NamedTuple, Optional, TypeVar

from . import _sinew
from ._options import ProtectedOptions
from ._values import class_number

__all__ = ["Guard", "Protected", "Tally"]

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Protected:
    """A type of protected payloads, and the limits of its receivers. Sender and receiver declare the same.

    `Protected.of_period` has usual limits for one message in each period.
    """

    name: str
    """The name of the type."""
    within: float
    """Maximum seconds from one good message to the next."""
    age_max: float
    """Maximum age of a message in seconds, measured with an echo."""
    lost_max: int = 2
    """Maximum number of consecutive messages that may be missing."""
    bad_max: int = 1
    """Maximum number of bad messages among the last 64."""
    good_min: int = 8
    """Consecutive good messages before the output may be armed."""
    length: int = 0
    """Bytes of each payload; 0: any number."""
    class_: str = "control"
    """The class of the messages."""

    @classmethod
    def of_period(cls, name: str, period: float, **others: Any) -> Protected:
        """Returns limits for one message in each `period` seconds: two may be late or missing."""
        return cls(name, within=3 * period, age_max=8 * period, **others)

    def _wire(self) -> ProtectedOptions:
        return {
            "name": self.name,
            "length": self.length,
            "within": self.within,
            "age_max": self.age_max,
            "lost_max": self.lost_max,
            "bad_max": self.bad_max,
            "good_min": self.good_min,
            "message_class": class_number(self.class_),
        }


class Tally(NamedTuple):
    """The counters of a guard."""

    good: int
    bad: int
    lost: int
    trips: int
    """How often the output was made safe."""


class Applied(Generic[T]):
    """The result of a command that reached the output."""

    __slots__ = ("value",)

    def __init__(self, value: T) -> None:
        self.value = value


class Guard:
    """The guard of an output: commands reach it only while good messages arrive.

    The safe function runs on a thread of its own and takes the GIL: it is as late as the longest pause of the GIL. An
    output that moves something belongs in Rust or C.
    """

    def __init__(self, guard: _sinew.OutputGuard) -> None:
        self._guard = guard

    def arm(self) -> None:
        """Lets commands reach the output. Raises `NotGoodError` if too few good messages have arrived."""
        self._guard.arm()

    def apply(self, command: Callable[[], T]) -> Optional[Applied[T]]:
        """Calls `command` if the output is live, and returns its result in an `Applied`; `None`: the output is safe.

        The output does not become safe while the command runs: keep it short.
        """
        result = self._guard.apply(command)
        return None if result is None else Applied(result[0])

    def trip(self) -> None:
        """Makes the output safe."""
        self._guard.trip()

    def release(self) -> None:
        """Makes the output safe permanently, as soon as no command uses it."""
        self._guard.release()

    def acknowledge_stop(self) -> None:
        """Acknowledges a stop of the system that is released. The output stays safe until it is armed."""
        self._guard.acknowledge_stop()

    @property
    def is_live(self) -> bool:
        """Whether commands reach the output."""
        return self._guard.is_live

    @property
    def cause(self) -> Optional[str]:
        """The cause for which the output is safe; `None` if it is live."""
        return self._guard.cause

    @property
    def tally(self) -> Tally:
        """The counters."""
        return Tally(*self._guard.tally())


def make_guard(core: _sinew.Core, source: int, protected: Protected, safe: Callable[[str], object]) -> Guard:
    """Guards an output. The thread that makes outputs safe takes no signals of the program."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        return Guard(core.guard(source, protected._wire(), safe))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
