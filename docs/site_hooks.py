"""Fills the page of settings from the table that `geosplat-jax settings` prints."""

import html

from geosplat_jax.core.settings import as_written
from geosplat_jax.fit.config import all_settings
from geosplat_jax.fit.presets import make_config

MARK = "<!-- table of settings -->"


def settings_table() -> str:
    """Return every setting of quality ``standard`` as Markdown, a section for each first part."""
    lines, section = [], ""
    for path, value, limits, meaning in all_settings(make_config()):
        heading = ".".join(path.split(".")[: 2 if path.startswith("stages.") else 1])
        if heading != section:
            section = heading
            lines += ["", f"## {section}", "", "| setting | value | range | meaning |"]
            lines.append("|---|---|---|---|")
        cells = (f"`{path}`", f"`{as_written(value)}`", html.escape(limits), html.escape(meaning))
        lines.append(f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |")
    return "\n".join(lines)


def on_page_markdown(markdown: str, **unused: object) -> str:
    """Put the table where a page asks for it; mkdocs calls this for every page."""
    return markdown.replace(MARK, settings_table()) if MARK in markdown else markdown
