"""JSON files written by other programs: any fault in them becomes an error of one line."""

import json
import math
from typing import Any

_MOST_DIGITS = 300
"""Most characters of a whole number that is converted; the largest float has 309 digits."""


def _whole_number(text: str) -> int | float:
    """Read a whole number; one of more than `_MOST_DIGITS` characters becomes infinite."""
    if len(text) <= _MOST_DIGITS:
        return int(text)
    return -math.inf if text.startswith("-") else math.inf


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON document; whole numbers of more than 300 characters become infinite.

    Raises
    ------
    ValueError
        If the text is not JSON, not UTF-8, or nested too deeply for Python's parser.
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
