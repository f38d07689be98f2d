"""Parameters that an application in Python serves: values that are tuned while it runs.

    @sinew.parameters
    class Gains:
        assistance: float = sinew.parameter(0.3, unit="1", range=(0.0, 1.0), about="Share of the model's torque.")
        damped: bool = sinew.parameter(False, about="Whether the knee is damped.")

    gains = Gains()
    with sinew.register("knee", parameters=gains, period=0.01) as me: ...

Only messages change the values: `sinew param set`, `Endpoint.set_parameters`, the page of `sinew view`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Dict, List, Optional, Tuple, Type, TypeVar, Union

from . import _sinew

__all__ = ["parameter", "parameters"]

T = TypeVar("T")
V = TypeVar("V", bool, int, float)
Declaration = Tuple[str, str, str, Union[bool, int, float], Optional[Tuple[Any, Any]], Optional[float]]

INTEGER_MIN, INTEGER_MAX = -(2**63), 2**63 - 1


@dataclasses.dataclass(frozen=True)
class _Declared:
    default: Any
    unit: str
    range: Optional[Tuple[Any, Any]]
    slope: Optional[float]
    about: str


def parameter(
    default: V, *, unit: str = "", range: Optional[Tuple[V, V]] = None, slope: Optional[float] = None, about: str = ""
) -> V:
    """Declares a parameter of a class with `@sinew.parameters`.

    - `default`: the value at the start; it says the type, as the annotation does.
    - `unit`: as in "Nm"; "1" for a share or a count.
    - `range`: the least and the greatest legal value. A `float` needs one; a `bool` has none.
    - `slope`: maximum change of a `float` in a second. Without it a new value applies at once.
    - `about`: a sentence for `sinew param list`.
    """
    declared: Any = _Declared(default, unit, range, slope, about)
    value: V = declared
    return value


def parameters(cls: Type[T]) -> Type[T]:
    """Makes a class a set of parameters: its attributes are read from the current values.

    Each object of the class is for one endpoint: `sinew.register(..., parameters=Gains())`.

    >>> @parameters
    ... class Gains:
    ...     kp: float = parameter(40.0, unit="Nm/rad", range=(0.0, 400.0))
    >>> Gains().kp
    40.0
    """
    declared = {name: value for name, value in vars(cls).items() if isinstance(value, _Declared)}
    if not declared:
        raise TypeError(f"{cls.__name__} declares no parameter: write `kp: float = sinew.parameter(40.0, range=(0.0, 400.0))`")
    hints: Dict[str, Any] = getattr(cls, "__annotations__", {})
    declarations: List[Declaration] = [_declaration(name, hints.get(name), one) for name, one in declared.items()]
    native = _sinew.ParameterDeclarations(declarations)
    for index, name in enumerate(declared):
        setattr(cls, name, _reader(index, name, declared[name].about))
    former: Any = cls.__init__

    def begin(self: Any, *arguments: Any, **options: Any) -> None:
        self.__sinew_parameters__ = _sinew.ParameterSet(native)
        former(self, *arguments, **options)

    setattr(cls, "__init__", begin)
    return cls


def _declaration(name: str, hint: Any, one: _Declared) -> Declaration:
    default, legal, slope = one.default, one.range, one.slope
    if isinstance(default, bool):
        if legal is not None or slope is not None:
            raise ValueError(f"{name} is a flag, which has no range and no slope")
        return (name, one.about, one.unit, default, None, None)
    if isinstance(default, int) and hint not in (float, "float"):
        if slope is not None:
            raise ValueError(f"{name} is a whole number, which has no slope: give its default a fraction")
        low, high = legal if legal is not None else (INTEGER_MIN, INTEGER_MAX)
        return (name, one.about, one.unit or "1", default, (int(low), int(high)), None)
    if not isinstance(default, (int, float)):
        raise TypeError(f"{name} is a {type(default).__name__}: a parameter is a float, an int or a bool")
    if legal is None:
        raise ValueError(f"{name} is a number without a range: give range=(least, greatest), in its unit")
    low, high = legal
    return (name, one.about, one.unit or "1", float(default), (float(low), float(high)), slope)


def _reader(index: int, name: str, about: str) -> property:
    def read(self: Any) -> Any:
        return self.__sinew_parameters__.get(index)

    read.__name__, read.__doc__ = name, about
    return property(read)


def native_set(of: Any) -> _sinew.ParameterSet:
    """Returns the values of an object of a class with `@sinew.parameters`."""
    found = getattr(of, "__sinew_parameters__", None)
    if not isinstance(found, _sinew.ParameterSet):
        text = f"parameters is a {type(of).__name__}: give an object of a class with @sinew.parameters, as Gains()"
        raise TypeError(text)
    return found
