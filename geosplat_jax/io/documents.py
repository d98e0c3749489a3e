"""JSON that others wrote: whatever it holds, reading it fails with one line."""

import json
from typing import Any

_MOST_DIGITS = 300
"""Of a whole number; a longer one has no floating-point number near it."""


def _whole_number(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"a whole number has {len(text)} digits, {text[:20]}...")
    return int(text)


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON document.

    Raises
    ------
    ValueError
        If it is no JSON, not UTF-8, or nested more deeply than Python follows; if it holds a
        whole number that is larger than any floating-point number.
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
