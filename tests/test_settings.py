"""Settings know their ranges, survive JSON, and take new kinds without a change elsewhere."""

import json
import re
from typing import Annotated

import pytest
from pydantic import Field

from geosplat_jax.core.settings import (
    ANY_KIND,
    Count,
    NonNegative,
    Variant,
    from_plain,
    listed,
    settings,
    to_plain,
)


@settings
class Lamp(Variant):
    """A base of settings."""


@settings
class Bulb(Lamp, kind="bulb"):
    """One kind."""

    watts: NonNegative = 40.0
    """Power."""

    def __post_init__(self) -> None:
        """Refuse a bulb that no socket takes."""
        if self.watts == 13.0:
            raise ValueError("no socket takes 13 watts")


@settings
class Strip(Lamp, kind="strip"):
    """Another kind."""

    lengths: tuple[NonNegative, ...] = (1.0, 2.0)
    """Lengths in metres."""


@settings
class Room:
    """What holds any kind of lamp."""

    lamp: Annotated[Lamp, ANY_KIND] = Bulb()
    """The lamp."""
    doors: Count = 1
    """Number of doors."""


@settings
class Shelf:
    """What holds a number of things."""

    size: tuple[NonNegative, NonNegative] = (3.0, 4.0)
    """Sides in metres."""
    tags: Annotated[tuple[str, ...], Field(min_length=1)] = ("plain",)
    """What it is called."""


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"size": [1.0]}, "size.1 is missing"),
        ({"size": [1.0, 2.0, 3.0]}, "size must have at most 2 items"),
        ({"tags": []}, "tags must have at least 1 items"),
    ],
)
def test_lists_of_the_wrong_length_are_refused(values, message):
    with pytest.raises(ValueError, match=rf"^{re.escape(message)}$"):
        from_plain(Shelf, values)


@pytest.mark.parametrize("room", [Room(), Room(Bulb(3.0), 0), Room(Strip((0.5,)), 2)])
def test_settings_of_every_kind_survive_json(room):
    assert from_plain(Room, json.loads(json.dumps(to_plain(room)))) == room
    assert hash(room) == hash(from_plain(Room, to_plain(room)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"doors": -1}, "doors must be greater than or equal to 0, got -1"),
        ({"doors": 1.5}, "doors must be a valid integer, got 1.5"),
        ({"doors": True}, "doors must be a valid integer, got True"),
        ({"windows": 1}, "unknown setting windows"),
        ({"lamp": {"kind": "fire"}}, "lamp: kind must be one of ['bulb', 'strip'], got 'fire'"),
        ({"lamp": {"kind": ["bulb"]}}, "lamp: kind must be one of ['bulb', 'strip'], got ['bulb']"),
        ({"lamp": {"kind": "bulb", "watts": 13.0}}, "lamp: no socket takes 13 watts"),
        ({"lamp": {"kind": "bulb", "watts": -2.0}}, "lamp.watts must be greater than or equal"),
        ({"lamp": {"kind": "bulb", "volts": 3}}, "unknown setting lamp.volts"),
        ({"lamp": {"kind": "bulb", "watts": float("nan")}}, "lamp.watts must be a finite number"),
        ({"lamp": {"kind": "bulb", "watts": float("inf")}}, "lamp.watts must be a finite number"),
        ({"lamp": {"kind": "strip", "lengths": [1, "a"]}}, "lamp.lengths.1 must be a valid number"),
        ({"lamp": 3}, "lamp must be"),
    ],
)
def test_the_first_mistake_is_named_by_its_path_in_one_line(values, message):
    with pytest.raises(ValueError, match=".") as error_info:
        from_plain(Room, values)
    assert str(error_info.value).startswith(message)
    assert "\n" not in str(error_info.value)


def test_every_mistake_has_a_line_of_its_own():
    lamp = {"kind": "strip", "lengths": [1.0, -1.0, 1e31]}
    with pytest.raises(ValueError, match=".") as error_info:
        from_plain(Room, {"doors": 2**31, "windows": 1, "lamp": lamp}, "house")
    assert sorted(str(error_info.value).splitlines()) == [
        "house.doors must be less than 2**31, got 2147483648",
        "house.lamp.lengths.1 must be greater than or equal to 0, got -1.0",
        "house.lamp.lengths.2 must be 0, or between 1e-30 and 1e+30 in size, for single "
        "precision, got 1e+31",
        "unknown setting house.windows",
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Bulb(watts=-1.0), "Bulb.watts must be greater than or equal to 0, got -1.0"),
        (lambda: Bulb(-1.0), "Bulb.watts must be greater than or equal to 0, got -1.0"),
        (lambda: Bulb(1e-40), "Bulb.watts must be 0, or between 1e-30 and 1e+30 in size, for "),
        (lambda: Room(doors=-1), "Room.doors must be greater than or equal to 0, got -1"),
        (lambda: Room(windows=1), "unknown setting Room.windows"),
        (lambda: Room(doors="x" * 9999), "Room.doors must be a valid integer, unable to parse"),
    ],
)
def test_values_are_checked_in_one_line_wherever_settings_are_made(make, message):
    with pytest.raises(ValueError, match=".") as error_info:
        make()
    assert str(error_info.value).startswith(message)
    assert "\n" not in str(error_info.value)
    assert len(str(error_info.value)) < 400


@settings
class Street:
    """What holds several lamps, which have no names."""

    lamps: tuple[Annotated[Lamp, ANY_KIND], ...] = (Bulb(3.0), Strip((0.5,)))
    """From one end to the other."""


def test_settings_without_names_are_listed_as_one_value():
    lamps = [{"kind": "bulb", "watts": 3.0}, {"kind": "strip", "lengths": [0.5]}]
    assert list(listed(Street())) == [("lamps", lamps, "", "From one end to the other.")]


def test_every_setting_is_listed_with_its_value_range_and_meaning():
    assert list(listed(Room(Bulb(3.0)))) == [
        ("lamp.watts", 3.0, ">= 0", "Power."),
        ("doors", 1, ">= 0", "Number of doors."),
    ]
