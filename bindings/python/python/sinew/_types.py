"""Payload types: dataclasses that a program declares, and dataclasses made from the structures that a node has.

On the wire a payload is a MessagePack map of its fields. `to_wire` and `from_wire` convert; both are the inverse of
each other for the types of this module.
"""

from __future__ import annotations

import dataclasses
import enum
import keyword
import sys
import typing
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Mapping, Optional, Tuple, Type, TypeVar, Union

from . import _sinew
from ._values import class_number
from .errors import MalformedError

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_: Any) -> Callable[[Any], Any]:
        """Does nothing: this is for type checkers."""
        return lambda decorated: decorated


__all__ = ["PayloadType", "from_schema", "from_wire", "kind_id", "kind_name", "payload", "payload_type", "to_wire"]

T = TypeVar("T")
Converter = Callable[[Any], Any]

KINDS_MAX = 65_536
"""Maximum number of names of types that are kept."""


@dataclasses.dataclass(frozen=True)
class PayloadType:
    """The properties of a payload type."""

    name: str
    """The name, which each language uses: `exo.angle`."""
    kind: int
    """The id of the type in messages: a hash of the name."""
    message_class: int
    expires_after: Optional[float]


_CLASSES: Dict[int, type] = {}
_NAMES: Dict[int, str] = {}
_KINDS: Dict[str, int] = {}


def kind_id(name: str) -> int:
    """Returns the id of the type of this name, and keeps the name for messages of the type."""
    kind = _KINDS.get(name)
    if kind is None:
        kind = _sinew.kind_of(name)
        if len(_KINDS) < KINDS_MAX:
            _KINDS[name] = kind
            _NAMES.setdefault(kind, name)
    return kind


def kind_name(kind: int) -> str:
    """Returns the name of a type, or its id as text if this program has not used the name."""
    return _NAMES.get(kind, f"0x{kind:08x}")


def class_of_kind(kind: int) -> Optional[type]:
    """Returns the class for the payloads of a type, if there is one."""
    return _CLASSES.get(kind)


def payload_type(of: Any) -> Optional[PayloadType]:
    """Returns the properties of a payload class or of its value; `None` if it is none."""
    found = getattr(of, "__sinew__", None)
    return found if isinstance(found, PayloadType) else None


@dataclass_transform()
def payload(
    name: str, *, class_: str = "control", expires_after: Optional[float] = None
) -> Callable[[Type[T]], Type[T]]:
    """Declares a payload type: the class becomes a dataclass, and messages of this type have it as their `value`.

    `name` is the name of the type in each language, `class_` one of "control", "stream" and "bulk". After
    `expires_after` seconds a message expires in a queue.

    >>> @payload("demo.angle", class_="stream")
    ... class Angle:
    ...     degrees: float
    >>> Angle(12.5)
    Angle(degrees=12.5)
    """
    number = class_number(class_)

    def declare(cls: Type[T]) -> Type[T]:
        declared = cls if "__dataclass_fields__" in cls.__dict__ else dataclasses.dataclass(cls)
        return register_class(declared, PayloadType(name, kind_id(name), number, expires_after))

    return declare


def register_class(cls: Type[T], properties: PayloadType) -> Type[T]:
    """Makes a dataclass the class of a type."""
    former = _CLASSES.get(properties.kind)
    if former is not None:
        known = payload_type(former)
        if known is not None and known.name != properties.name:
            raise ValueError(f"{properties.name!r} hashes as {known.name!r} does; call one of them something else")
    cls.__sinew__ = properties  # type: ignore[attr-defined]
    _CLASSES[properties.kind] = cls
    return cls


# Values to the wire


def to_wire(value: Any) -> Any:
    """Returns a value of MessagePack for a dataclass, an enum, or a value of numpy; others are returned as they are."""
    known = type(value).__dict__.get("__sinew_fields__")
    if known is not None:
        return {wire: getattr(value, name) for name, wire in known}
    variant = getattr(type(value), "__sinew_variant__", None)
    if variant is not None:
        name, is_one_value = variant
        return {name: value.value if is_one_value else _fields(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [(field.name, field.metadata.get("wire", field.name)) for field in dataclasses.fields(value)]
        type(value).__sinew_fields__ = fields  # type: ignore[attr-defined]
        return {wire: getattr(value, name) for name, wire in fields}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (set, frozenset)):
        return list(value)
    if isinstance(value, memoryview):
        return bytes(value)
    # numpy is not imported for that: its arrays have `tolist`, and so have its scalars.
    tolist = getattr(value, "tolist", None)
    return tolist() if callable(tolist) else value


def _fields(value: Any) -> Dict[str, Any]:
    return {field.metadata.get("wire", field.name): getattr(value, field.name) for field in dataclasses.fields(value)}


# Values from the wire


def from_wire(cls: Type[T], value: Any) -> T:
    """Returns the value of a payload class. Fields that the class does not have are left out.

    Raises `MalformedError` if the value does not fit: the message names the field.
    """
    converted = _converter(cls)(value)
    if _special(cls) is None and not isinstance(converted, cls):
        raise MalformedError(f"a payload of {cls.__name__} is a {type(value).__name__}; do both programs use one type?")
    return typing.cast(T, converted)


_CONVERTERS: Dict[Any, Converter] = {}


def _converter(hint: Any) -> Converter:
    """Returns the function that makes a value of a type, given as an annotation, from a value of the wire."""
    try:
        known = _CONVERTERS.get(hint)
    except TypeError:  # an annotation that cannot be a key
        return _make_converter(hint)
    if known is None:
        # A class that contains itself finds this one.
        _CONVERTERS[hint] = lambda value: _CONVERTERS[hint](value)
        known = _CONVERTERS[hint] = _make_converter(hint)
    return known


def _make_converter(hint: Any) -> Converter:
    special = _special(hint)
    if special is not None:
        return special
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _struct_converter(hint)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return hint
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Union or type(hint).__name__ == "UnionType":
        return _union_converter([each for each in arguments if each is not type(None)])
    if origin in (list, set, frozenset):
        element = _converter(arguments[0]) if arguments else _same
        return lambda value: _collected(origin, [element(each) for each in _expect(value, list)])
    if origin is tuple:
        return _tuple_converter(arguments)
    if origin is dict:
        key, content = (_converter(each) for each in arguments)
        return lambda value: {key(one): content(other) for one, other in _expect(value, dict).items()}
    if hint is float:
        return _number
    if hint in (int, str, bool, bytes):
        return lambda value: _expect(value, hint)
    return _same


def _special(hint: Any) -> Optional[Converter]:
    """Returns the converter that a type brings along. The variants of an enum do not inherit that of the enum."""
    if isinstance(hint, type) and "__sinew_from_wire__" not in vars(hint):
        return None
    return getattr(hint, "__sinew_from_wire__", None)


def _same(value: Any) -> Any:
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise MalformedError(f"a number is a {type(value).__name__}")
    return float(value)


def _expect(value: Any, wanted: type) -> Any:
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise MalformedError(f"a {wanted.__name__} is a {type(value).__name__}")
    return value


def _collected(origin: Any, elements: List[Any]) -> Any:
    try:
        return elements if origin is list else origin(elements)
    except TypeError:
        raise MalformedError("an element of a set is a list or a map") from None


def _union_converter(hints: List[Any]) -> Converter:
    """Takes the first type that fits. `None` is always allowed: an annotation `Optional[X]` is the usual union."""
    converters = [_converter(each) for each in hints]

    def convert(value: Any) -> Any:
        if value is None:
            return None
        for index, converter in enumerate(converters):
            try:
                return converter(value)
            except MalformedError:
                if index == len(converters) - 1:
                    raise
        return value

    return convert


def _tuple_converter(arguments: Tuple[Any, ...]) -> Converter:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        element = _converter(arguments[0])
        return lambda value: tuple(element(each) for each in _expect(value, list))
    elements = [_converter(each) for each in arguments]

    def convert(value: Any) -> Any:
        values = _expect(value, list)
        if len(values) != len(elements):
            raise MalformedError(f"a tuple of {len(elements)} values has {len(values)}")
        return tuple(element(each) for element, each in zip(elements, values))

    return convert


def _hints(cls: type) -> Mapping[str, Any]:
    made = cls.__dict__.get("__sinew_hints__")
    if made is not None:
        return typing.cast(Mapping[str, Any], made)
    try:
        return typing.get_type_hints(cls)
    except Exception:  # names of a function's scope, or the syntax of a later Python: fields stay as they are
        return {}


def _struct_converter(cls: type) -> Converter:
    hints = _hints(cls)
    fields = [
        (
            field.name,
            field.metadata.get("wire", field.name),
            _converter(hints.get(field.name, Any)),
            field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING,
        )
        for field in dataclasses.fields(cls)
        if field.init
    ]

    def convert(value: Any) -> Any:
        if isinstance(value, list) and len(value) == len(fields):
            # The compact form: the values in the order of the fields.
            value = {wire: each for (_, wire, _, _), each in zip(fields, value)}
        if not isinstance(value, dict):
            raise MalformedError(f"a {cls.__name__} is a {type(value).__name__}")
        found = {}
        for name, wire, converter, has_default in fields:
            if wire not in value:
                if has_default:
                    continue
                raise MalformedError(f"the field {wire!r} of {cls.__name__} is missing")
            try:
                found[name] = converter(value[wire])
            except (MalformedError, ValueError) as error:
                raise MalformedError(f"the field {wire!r} of {cls.__name__}: {error}") from None
        return cls(**found)

    return convert


# Classes from structures


def from_schema(name: str, root: Any, types: Mapping[str, Any]) -> Optional[type]:
    """Makes a dataclass from the structure of a type; `None` if the structure is no struct and no enum with values.

    `root` and `types` are as `_sinew.parse_schema` returns them. A field whose name is no name in Python gets an
    underscore: `class_`.
    """
    maker = _ClassMaker(types)
    if root[0] == "named":
        root = types[root[1]]
    if root[0] == "unit":
        root = ("struct", [])
    class_name = _class_name(name.rsplit(".", 1)[-1])
    if root[0] == "struct":
        return maker.struct(class_name, root[1])
    if root[0] == "enum":
        made = maker.enum(class_name, root[1])
        return None if made is str else typing.cast(type, made)
    return None


def _class_name(name: str) -> str:
    words = "".join(each if each.isalnum() else " " for each in name).split()
    joined = "".join(word[:1].upper() + word[1:] for word in words)
    return joined if joined.isidentifier() and not keyword.iskeyword(joined) else f"Type{joined}"


def _field_name(name: str) -> str:
    made = "".join(each if each.isalnum() or each == "_" else "_" for each in name)
    if not made.isidentifier():
        made = f"_{made}"
    # A dataclass has methods of its own, which begin with two underscores.
    return f"{made}_" if keyword.iskeyword(made) or made.startswith("__") else made


class _ClassMaker:
    """Makes the classes of one structure. Each type inside it is made once, when it is needed first."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self.types = types
        self.made: Dict[str, Any] = {}

    def hint(self, name: str, shape: Any) -> Any:
        """Returns the annotation for a shape. `name` is for a struct in place."""
        word = shape[0]
        if word == "named":
            return self.named(shape[1])
        if word == "option":
            return Optional[self.hint(name, shape[1])]
        if word in ("list", "array"):
            return List[self.hint(name, shape[1])]  # type: ignore[misc]
        if word == "map":
            return Dict[self.hint(name, shape[1]), self.hint(name, shape[2])]  # type: ignore[misc]
        if word == "tuple":
            return Tuple[tuple(self.hint(name, each) for each in shape[1])]
        if word == "struct":
            return self.struct(_class_name(name), shape[1])
        if word == "enum":
            return self.enum(_class_name(name), shape[1])
        return {"bool": bool, "int": int, "float": float, "str": str, "bytes": bytes}.get(word, Any)

    def named(self, name: str) -> Any:
        if name not in self.made:
            # A type that contains itself: its inner values are found when they are converted.
            self.made[name] = _Later(lambda: _converter(self.made[name]))
            self.made[name] = self.hint(name, self.types[name])
        return self.made[name]

    def struct(self, name: str, fields: Any, bases: Tuple[type, ...] = ()) -> type:
        required, optional, hints, used = [], [], {}, set()
        for wire, shape, is_optional in fields:
            field = _field_name(wire)
            while field in used:
                field += "_"
            used.add(field)
            hints[field] = self.hint(wire, shape)
            if is_optional:
                optional.append((field, hints[field], dataclasses.field(default=None, metadata={"wire": wire})))
            else:
                required.append((field, hints[field], dataclasses.field(metadata={"wire": wire})))
        namespace = {"__sinew_hints__": hints}
        cls = dataclasses.make_dataclass(name, required + optional, bases=bases, namespace=namespace)
        cls.__module__ = __name__
        return cls

    def enum(self, name: str, variants: Any) -> Any:
        """An enum without values is a `str`. Another one is a class with a subclass for each variant with values."""
        if all(content is None for _, content in variants):
            return str
        members: Dict[str, Any] = {}
        union = type(name, (), {"__module__": __name__})
        for wire, content in variants:
            if content is None:
                continue
            is_struct = content[0] == "struct"
            fields = content[1] if is_struct else [("value", content, False)]
            cls = self.struct(_class_name(wire), fields, (union,))
            cls.__sinew_variant__ = (wire, not is_struct)  # type: ignore[attr-defined]
            cls.__qualname__ = f"{name}.{cls.__name__}"
            members[wire] = cls
            setattr(union, _field_name(wire), cls)
        union.__sinew_from_wire__ = staticmethod(_variant_converter(members))  # type: ignore[attr-defined]
        return union


class _Later:
    """The annotation of a type that is being made."""

    def __init__(self, converter: Callable[[], Converter]) -> None:
        self.__sinew_from_wire__ = lambda value: converter()(value)


def _variant_converter(members: Mapping[str, type]) -> Converter:
    def convert(value: Any) -> Any:
        # A variant without values is its name; one that was added later stays as it is.
        if not isinstance(value, dict) or len(value) != 1:
            return value
        ((name, content),) = value.items()
        cls = members.get(name)
        if cls is None:
            return value
        _, is_one_value = cls.__sinew_variant__  # type: ignore[attr-defined]
        return _converter(cls)({"value": content} if is_one_value else content)

    return convert


if sys.version_info < (3, 9):  # pragma: no cover
    raise ImportError("sinew needs Python 3.9 or later")
