"""Shows docstrings as they are written: sections of numpydoc whose items read ``name : text``."""

import re
from typing import Any

import griffe

_RULE = re.compile(r"^-{3,}$")


def _items(lines: list[str]) -> list[str]:
    """Return the items of a section as a list of Markdown.

    A line continues an item if it is indented, or if both it and the item are prose without a name,
    as in sections that say in sentences what is returned.
    """
    items: list[list[str]] = []
    is_prose = False
    for line in filter(str.strip, lines):
        has_name = " : " in line
        if items and line.startswith(" "):
            items[-1].append(line.strip())
            is_prose = False
        elif items and is_prose and not has_name:
            items[-1][0] += " " + line.strip()
        else:
            items.append([line.strip()])
            is_prose = not has_name
    bullets = []
    for first_line, *more_lines in items:
        name, colon, text = first_line.partition(" : ")
        if colon:
            bullets.append(f"- `{name}`: {' '.join([text, *more_lines])}")
        elif more_lines:
            bullets.append(f"- `{first_line}`: {' '.join(more_lines)}")
        else:
            bullets.append(f"- {first_line}")
    return bullets


def as_markdown(text: str) -> str:
    """Turn a docstring into Markdown; what is in no section stays."""
    lines = text.splitlines()
    starts = [number for number in range(len(lines) - 1) if _RULE.match(lines[number + 1])]
    prose = lines[: starts[0]] if starts else lines
    markdown_lines = [re.sub(r"::$", ":", line) for line in prose]
    for start, end in zip(starts, [*starts, len(lines)][1:], strict=True):
        markdown_lines += ["", f"**{lines[start]}**", "", *_items(lines[start + 2 : end])]
    return "\n".join(markdown_lines)


class Docstrings(griffe.Extension):
    """Rewrites every docstring that the site shows."""

    def on_object(self, *, obj: griffe.Object, **unused: Any) -> None:
        """Rewrite the docstring of one object; griffe calls this for each."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
