"""Settings as frozen dataclasses that know the range and the meaning of every field.

`settings` makes such a class: values are checked on construction, the string below a field says
what it means, and instances are hashable where their fields are, so that they can be static fields
of a jitted module. A `Variant` is a base class of settings of which a field may hold any subclass:
a new way of doing something is a new class, in whatever file, and is written to JSON under its
``kind``.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, ClassVar, TypeVar, dataclass_transform, get_args

from annotated_types import Ge, Gt, Le, Lt
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass as _checked_dataclass
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

_CONFIG = ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

NONE = "none"
"""Word for a setting without a value on the command line and in TOML; JSON has null for it."""

_SMALLEST, _LARGEST = 1e-30, 1e30
"""Least and largest magnitude of a setting other than 0; both are well within the range of single
precision, in which settings are used."""


def _of_single_precision(value: float) -> float:
    """Refuse a number that single precision would round to 0 or to infinity."""
    if value and not _SMALLEST <= abs(value) <= _LARGEST:
        raise PydanticCustomError(
            "single_precision",
            "0, or between {smallest} and {largest} in size, for single precision",
            {"smallest": f"{_SMALLEST:g}", "largest": f"{_LARGEST:g}"},
        )
    return value


def _infinite_or_of_single_precision(value: float) -> float:
    """Accept infinity; refuse other numbers as `_of_single_precision` does."""
    return value if math.isinf(value) else _of_single_precision(value)


def _none_by_its_word(value: Any) -> Any:
    """Read the word ``none`` as None: TOML and ``--set`` have no other way to write it."""
    return None if value == NONE else value


def _of_32_bits(value: int) -> int:
    """Refuse a count that compiled programs cannot hold."""
    if value >= 2**31:
        raise PydanticCustomError("of_32_bits", "less than 2**31")
    return value


Count = Annotated[int, Field(ge=0), AfterValidator(_of_32_bits)]
"""0, 1, 2, ..."""
PositiveCount = Annotated[int, Field(ge=1), AfterValidator(_of_32_bits)]
"""1, 2, 3, ..."""
Number = Annotated[float, AfterValidator(_of_single_precision)]
"""A finite number."""
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_of_single_precision)]
"""A finite number that is not negative."""
Positive = Annotated[float, Field(gt=0), AfterValidator(_of_single_precision)]
"""A finite number above 0."""
NonNegativeOrNone = Annotated[NonNegative | None, BeforeValidator(_none_by_its_word)]
"""A finite number that is not negative, or none."""
PositiveOrNone = Annotated[Positive | None, BeforeValidator(_none_by_its_word)]
"""A finite number above 0, or none."""
PositiveOrInfinite = Annotated[
    float, Field(gt=0, allow_inf_nan=True), AfterValidator(_infinite_or_of_single_precision)
]
"""A number above 0, or infinity."""
Share = Annotated[float, Field(ge=0, le=1)]
"""A number from 0 to 1."""
PositiveShare = Annotated[float, Field(gt=0, le=1), AfterValidator(_of_single_precision)]
"""A number above 0, up to 1."""

_NESTED = "nested_settings"
"""Type of an error about nested settings, in whose text `_HERE` stands for their path."""

_HERE = "\0"
"""Placeholder for the path of nested settings in messages that are written before it is known."""

_Class = TypeVar("_Class")


@dataclass_transform(frozen_default=True)
def settings(kind: type[_Class]) -> type[_Class]:
    """Make a class of frozen, checked settings; see the module.

    Making an instance raises `ValueError` with one line for each value that is wrong.
    """
    checked_class: Any = _checked_dataclass(frozen=True, config=_CONFIG)(kind)
    initializer, names = checked_class.__init__, [field.name for field in fields(checked_class)]

    @wraps(initializer)
    def checked(self: Any, *values: Any, **named: Any) -> None:
        try:
            initializer(self, *values, **named)
        except ValidationError as error:
            raise ValueError(_problems(error, kind.__name__, names)) from None

    checked_class.__init__ = checked
    return checked_class


class Variant:
    """Base of settings of several kinds; ``class Mine(Base, kind="mine")`` adds one."""

    kinds: ClassVar[dict[str, type]]
    kind: ClassVar[str]

    def __init_subclass__(cls, kind: str | None = None, **others: Any) -> None:
        """Register a kind with the nearest base that is no kind itself."""
        super().__init_subclass__(**others)
        if kind is None:
            cls.kinds = {}
        else:
            cls.kind = kind
            cls.kinds[kind] = cls


class _AnyKind:
    """Marks a field that holds any kind of its type: ``Annotated[Base, ANY_KIND]``."""

    def __get_pydantic_core_schema__(self, base: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def choose(value: Any, check: Callable[[Any], Any]) -> Any:
            if isinstance(value, base) or not isinstance(value, dict):
                return check(value)
            plain_fields = dict(value)
            kind = plain_fields.pop("kind", None)
            if not isinstance(kind, str) or kind not in base.kinds:
                raise ValueError(f"kind must be one of {sorted(base.kinds)}, got {kind!r}")
            try:
                return from_plain(base.kinds[kind], plain_fields, _HERE)
            except ValueError as error:
                raise PydanticCustomError(_NESTED, "{text}", {"text": str(error)}) from None

        return core_schema.no_info_wrap_validator_function(choose, handler(base))


ANY_KIND = _AnyKind()


def to_plain(value: Any) -> Any:
    """Turn settings into nested dictionaries, lists and numbers, ready for JSON."""
    if is_dataclass(value) and not isinstance(value, type):
        plain = {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
        return {"kind": value.kind, **plain} if isinstance(value, Variant) else plain
    if isinstance(value, dict):
        return {name: to_plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return value


def from_plain(kind: type[_Class], values: Any, where: str = "") -> _Class:
    """Build settings from what `to_plain` returned, possibly after a trip through JSON.

    Parameters
    ----------
    kind : class of the settings.
    values : their plain values.
    where : path of these settings, with which the paths in messages begin.

    Raises
    ------
    ValueError
        One line for each setting that is wrong: its path, what is wrong, and its value.
    """
    try:
        return TypeAdapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise ValueError(_problems(error, where)) from None


def as_written(value: Any) -> str:
    """Write the plain value of a setting as ``--set`` takes it: in TOML, and None as ``none``."""
    if value is None:
        return NONE
    if isinstance(value, dict):
        present = {name: item for name, item in value.items() if item is not None}
        return f"{{{', '.join(f'{name} = {as_written(item)}' for name, item in present.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_written, value))}]"
    # JSON has another name for infinity.
    return str(value) if isinstance(value, float) else json.dumps(value)


def first_line(error: Exception) -> str:
    """Return the first line of an error's text, for messages of a single line."""
    return str(error).partition("\n")[0]


def _problems(error: ValidationError, where: str, names: Sequence[str] = ()) -> str:
    """Describe everything that pydantic refused, one line each.

    ``names`` : the fields in their order, for values that were given by position.
    """
    details = error.errors(include_url=False)
    return "\n".join(line for detail in details for line in _lines(detail, where, names))


def _lines(detail: Any, where: str, names: Sequence[str]) -> list[str]:
    """Describe one error of pydantic; an error about a `Variant` may take several lines."""
    location = list(detail["loc"])
    if location and isinstance(location[0], int) and location[0] < len(names):
        location[0] = names[location[0]]
    path = ".".join(filter(None, [where, *map(str, location)]))
    if detail["type"] == "unexpected_keyword_argument":
        return [f"unknown setting {path}"]
    if detail["type"] == _NESTED:
        return detail["msg"].replace(_HERE, path).splitlines()
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "value_error":
        return [f"{path}: {message}" if path else message]
    if detail["type"] == "missing":
        return [f"{path} is missing"]
    if detail["type"] in ("too_long", "too_short"):
        bound, length = _BOUNDS_OF_LENGTH[detail["type"]]
        return [f"{path} must have {bound} {detail['ctx'][length]} items"]
    message = message.removeprefix("Input should be ")
    return [f"{path} must be {message}, got {_short(detail.get('input'))}"]


_BOUNDS_OF_LENGTH = {"too_long": ("at most", "max_length"), "too_short": ("at least", "min_length")}

_LONGEST_VALUE = 200
"""Characters of a value that a message shows."""


def _short(value: Any) -> str:
    """Write a value, cut off after `_LONGEST_VALUE` characters."""
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]} ..."


def listed(value: Any, where: str = "") -> Iterator[tuple[str, Any, str, str]]:
    """Yield path, value, range and meaning of every single setting in ``value``."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from listed(item, f"{where}{name}.")
        return
    for name, field in value.__pydantic_fields__.items():
        item, path = getattr(value, name), f"{where}{name}"
        if is_dataclass(item) or (isinstance(item, dict) and item):
            yield from listed(item, f"{path}.")
        elif isinstance(item, tuple) and item and hasattr(item[0], "name"):
            for entry in item:
                yield from listed(entry, f"{path}.{entry.name}.")
        else:
            yield path, to_plain(item), _range(field), _meaning(type(value), name)


def _meaning(kind: type, name: str) -> str:
    """Return the docstring of a field, from the class itself or from the base that declares it."""
    for base in kind.__mro__:
        field = getattr(base, "__pydantic_fields__", {}).get(name)
        if field is not None and field.description:
            return " ".join(field.description.split())
    return ""


_LIMITS = ((">=", Ge, "ge"), (">", Gt, "gt"), ("<=", Le, "le"), ("<", Lt, "lt"))


def _range(field: Any) -> str:
    """Write the limits of a field, and whether it may have no value."""
    members = get_args(field.annotation)
    marks = [mark for member in members for mark in getattr(member, "__metadata__", ())]
    inner_limits = [limit for mark in marks for limit in getattr(mark, "metadata", ())]
    limits = [
        f"{sign} {getattr(limit, name)}"
        for limit in (*field.metadata, *inner_limits)
        for sign, kind, name in _LIMITS
        if isinstance(limit, kind)
    ]
    alternatives = [", ".join(limits)] + [NONE] * (type(None) in members)
    return " or ".join(filter(None, alternatives))
