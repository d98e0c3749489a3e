"""JSON files written by other programs: any fault in them becomes an error of one line."""

import json
import math
from typing import Any

_MOST_DIGITS = 300
"""Of a whole number; a longer one has no floating-point number near it."""


def _whole_number(text: str) -> int | float:
    """Read a whole number; one beyond all floating-point numbers is infinite."""
    if len(text) <= _MOST_DIGITS:
        return int(text)
    return -math.inf if text.startswith("-") else math.inf


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON document; whole numbers beyond all floating-point numbers are infinite.

    Raises
    ------
    ValueError
        If it is no JSON, not UTF-8, or nested more deeply than Python follows.
    """
    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
        return json.loads(decoded, parse_int=_whole_number)
    except RecursionError:
        raise ValueError("its lists or objects are nested too deeply") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"it is not UTF-8 at byte {error.start}") from None
    except ValueError as error:
        raise ValueError(f"it is not JSON: {error}") from None
