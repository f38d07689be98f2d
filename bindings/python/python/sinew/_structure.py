"""The structure of a payload class, as nodes compare it with that of the other side.

A class has a structure if each of its annotations says one: `float`, `int`, `str`, `bool`, `bytes`, `Optional`, lists,
tuples, maps, other dataclasses, and enums of texts. `float` is 64 bits wide, and `int` is one with a sign. The names of
this module say another width: `degrees: Annotated[float, sinew.F32]`.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import enum
import typing
from typing import Annotated, Any, Dict, List, Optional, Tuple, Union

from . import _sinew

__all__ = ["F32", "I8", "I16", "I32", "U8", "U16", "U32", "U64", "structure_of"]


@dataclasses.dataclass(frozen=True)
class Width:
    """The exact type of a number, for `Annotated`: `degrees: Annotated[float, sinew.F32]`."""

    word: str
    """The type in Rust."""


F32 = Width("f32")
"""A number with a fraction of 32 bits: `f32` in Rust, `float` in C."""
I8 = Width("i8")
"""A whole number of 8 bits."""
I16 = Width("i16")
"""A whole number of 16 bits."""
I32 = Width("i32")
"""A whole number of 32 bits."""
U8 = Width("u8")
"""A whole number of 8 bits without a sign."""
U16 = Width("u16")
"""A whole number of 16 bits without a sign."""
U32 = Width("u32")
"""A whole number of 32 bits without a sign."""
U64 = Width("u64")
"""A whole number of 64 bits without a sign."""

_LEAVES = {bool: "bool", int: "i64", float: "f64", str: "str", bytes: "bytes"}
Shape = Tuple[Any, ...]


class _Unknown(Exception):
    """An annotation without a structure, as `Any`."""


def structure_of(cls: type) -> Optional[bytes]:
    """Returns the canonical bytes of the structure of a payload class; `None` if an annotation does not say it.

    Raises `TypeError` for a width that is not of its type: messages would differ from the structure.
    """
    given = cls.__dict__.get("__sinew_structure__")
    if given is not None:
        return typing.cast(bytes, given)
    maker = _Maker()
    try:
        root = maker.struct(cls)
        if cls.__name__ in maker.types:  # it contains itself
            maker.types[cls.__name__] = root
            root = ("named", cls.__name__)
        return _sinew.make_schema(root, maker.types)
    except (_Unknown, ValueError):  # a ValueError: it is larger than a structure may be
        return None


class _Maker:
    """Makes the structure of one class, and of the classes inside it."""

    def __init__(self) -> None:
        self.types: Dict[str, Shape] = {}
        self.classes: Dict[str, type] = {}

    def struct(self, cls: type) -> Shape:
        self.classes.setdefault(cls.__name__, cls)
        try:
            hints = typing.get_type_hints(cls, include_extras=True)
        except Exception:  # names of a function's scope, or the syntax of a later Python
            raise _Unknown from None
        fields = []
        for field in dataclasses.fields(cls):
            has_default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
            name = field.metadata.get("wire", field.name)
            fields.append((name, self.shape(hints.get(field.name)), has_default))
        return ("struct", fields)

    def shape(self, hint: Any) -> Shape:
        if typing.get_origin(hint) is Annotated:
            inner = typing.get_args(hint)[0]
            exact = [each.word for each in hint.__metadata__ if isinstance(each, Width)]
            if exact and inner is not (float if exact[0] == "f32" else int):
                text = f"{exact[0]} is no width of {inner}: write Annotated[float, sinew.F32] or Annotated[int, sinew.U8]"
                raise TypeError(f"{text}, inside of Optional and List")
            return (exact[0],) if exact else self.shape(inner)
        if hint in _LEAVES:
            return (_LEAVES[hint],)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            return self.named(hint)
        if isinstance(hint, type) and issubclass(hint, enum.Enum):
            return self.named(hint)
        return self.generic(typing.get_origin(hint), typing.get_args(hint))

    def generic(self, origin: Any, arguments: Tuple[Any, ...]) -> Shape:
        if origin is Union or getattr(origin, "__name__", "") == "UnionType":
            rest = [each for each in arguments if each is not type(None)]
            if len(rest) == 1 and len(arguments) == 2:
                return ("option", self.shape(rest[0]))
        elif origin in (list, set, frozenset, collections.abc.Sequence) and len(arguments) == 1:
            return ("list", self.shape(arguments[0]))
        elif origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
            return ("list", self.shape(arguments[0]))
        elif origin is tuple and arguments:
            return ("tuple", [self.shape(each) for each in arguments])
        elif origin is dict and len(arguments) == 2:
            return ("map", self.shape(arguments[0]), self.shape(arguments[1]))
        raise _Unknown

    def named(self, cls: Any) -> Shape:
        """Returns the name of a class inside the structure. Names do not travel in messages."""
        name: str = cls.__name__
        if self.classes.setdefault(name, cls) is not cls:
            raise _Unknown  # two classes of one name
        if name not in self.types:
            self.types[name] = ("unit",)  # until it is made: it may contain itself
            self.types[name] = self.enum(cls) if issubclass(cls, enum.Enum) else self.struct(cls)
        return ("named", name)

    def enum(self, cls: Any) -> Shape:
        values: List[Any] = [member.value for member in cls]
        if not all(isinstance(value, str) for value in values):
            raise _Unknown
        return ("enum", values)
