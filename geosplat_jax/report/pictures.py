"""Pictures to look at: normals as colours, clay previews, and the overview sheet of a run.

Pictures are sRGB float32 in [0, 1], (H, W, 3), as `io.images.write_png` takes them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from geosplat_jax.io.images import encode_srgb
from geosplat_jax.report.scales import Scale

_SHEET_COLOR = (0.094, 0.098, 0.106)
_CELL_COLOR = (0.149, 0.153, 0.161)
_TEXT_COLOR = (208, 210, 214)
_FAINT_TEXT_COLOR = (134, 138, 146)
_LARGEST_CELL = 800
"""Most pixels of a picture's longer side on a sheet: sheets of full-size photographs would be too
large for programs to open, and take gigabytes to make."""

_GUTTER = 4
_MARGIN = 16
_TITLE_HEIGHT = 34
_LABEL_HEIGHT = 24
_LABEL_RISE = 8
_LABEL_GAP = 10
_TITLE_SIZE, _LABEL_SIZE = 17, 13
_LINE_HEIGHT = 20
_BAR_HEIGHT, _BAR_WIDTH = 14, 160
# The light is at most this many rows tall, so that it does not dwarf the views.
_LIGHT_ROWS = 2

# Clay preview in OpenCV camera axes: the key light comes from the upper left, behind the camera.
_KEY_DIRECTION = np.array([-0.45, -0.65, -0.61])
_CLAY_COLOR = np.array([0.60, 0.57, 0.54])
_KEY, _HEADLIGHT, _AMBIENT, _RIM = 0.62, 0.30, 0.10, 0.22

_SMALLEST_LENGTH = 1e-8
# The tone map's middle grey, and the percentile that becomes white.
_MIDDLE_GREY = 0.18
_WHITE_PERCENTILE = 99.5


@dataclass(frozen=True)
class _Text:
    """A text on the sheet: its words, position (x, y) in pixels, and Pillow's anchor."""

    words: str
    position: tuple[float | int, float | int]
    anchor: str
    size: int = _LABEL_SIZE
    color: tuple[int, int, int] = _TEXT_COLOR


def _unit(vectors: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Scale vectors to unit length; those shorter than 1e-8 become zero."""
    length = np.sqrt((vectors.astype(np.float32) ** 2).sum(-1, keepdims=True))
    has_length = length > _SMALLEST_LENGTH
    return np.where(has_length, vectors / np.where(has_length, length, 1.0), 0.0).astype(np.float32)


def _over_cell(
    picture: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"] | None
) -> Float[np.ndarray, "H W 3"]:
    """Lay a picture over the colour of an empty cell."""
    if alpha is None:
        return picture.astype(np.float32)
    coverage = np.clip(alpha, 0.0, 1.0)[..., None]
    mixed = coverage * picture + (1.0 - coverage) * np.asarray(_CELL_COLOR)
    return mixed.astype(np.float32)


def normals_to_rgb(
    normals: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"] | None = None
) -> Float[np.ndarray, "H W 3"]:
    """Show normals as colour, ``(n + 1) / 2``, over the dark colour of a cell.

    Parameters
    ----------
    normals : (H, W, 3) of any length (premultiplied by alpha or not), any frame.
    alpha : (H, W) coverage; by default a pixel is covered where its normal has a length.
    """
    unit = _unit(normals)
    if alpha is None:
        alpha = np.any(unit != 0, axis=-1).astype(np.float32)
    return _over_cell(0.5 + 0.5 * unit, alpha)


def shade_mesh_preview(
    normals: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W 3"]:
    """Shade normals as clay with a key light, a headlight and a faint rim, over a dark cell.

    Parameters
    ----------
    normals : (H, W, 3) in OpenCV camera axes, as `meshes.render_mesh_normals` gives them.
    alpha : (H, W) coverage.
    """
    unit = _unit(normals)
    key_direction = _KEY_DIRECTION / np.sqrt((_KEY_DIRECTION**2).sum())
    facing = np.clip(-unit[..., 2], 0.0, 1.0)
    key = np.clip(unit @ key_direction, 0.0, 1.0)
    rim = _RIM * (1.0 - facing) ** 3
    light = _AMBIENT + _KEY * key + _HEADLIGHT * facing + rim
    clay = encode_srgb((light[..., None] * _CLAY_COLOR).astype(np.float32))
    return _over_cell(np.clip(clay, 0.0, 1.0), alpha)


def tone_map_light(radiance: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Tone map linear radiance of any range to sRGB: log-average exposure, then a soft white point.

    Reinhard et al. 2002, Eq. 1 and 4, applied to the largest channel, so that hues are preserved.
    Black stays black.
    """
    radiance = np.maximum(np.asarray(radiance, np.float32), 0.0)
    value = radiance.max(axis=-1, keepdims=True)
    is_lit = value > 0
    if not is_lit.any():
        return np.zeros_like(radiance)
    average = np.exp(np.log(value[is_lit]).mean())
    exposed = value * (_MIDDLE_GREY / average)
    white = max(float(np.percentile(exposed, _WHITE_PERCENTILE)), 1.0)
    mapped = exposed * (1.0 + exposed / white**2) / (1.0 + exposed)
    ratio = mapped / np.where(is_lit, value, 1.0)
    return np.clip(encode_srgb((radiance * ratio).astype(np.float32)), 0.0, 1.0)


def _as_picture(image: np.ndarray, name: str) -> Float[np.ndarray, "H W 3"]:
    """Return float32 colour in [0, 1] of a grey or colour, float or 8-bit image."""
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[-1] not in (1, 3):
        raise ValueError(
            f"image {name!r} must be (H, W), (H, W, 1) or (H, W, 3), got {image.shape}"
        )
    scale = 255.0 if image.dtype == np.uint8 else 1.0
    picture = np.clip(image.astype(np.float32) / np.float32(scale), 0.0, 1.0)
    return np.broadcast_to(picture, (*picture.shape[:2], 3))


def _resized(
    picture: Float[np.ndarray, "H W 3"], height: int, width: int
) -> Float[np.ndarray, "h w 3"]:
    """Resize a picture with Pillow's bicubic filter; one of that size is returned as it is."""
    if picture.shape[:2] == (height, width):
        return picture
    channels = [
        np.asarray(
            Image.fromarray(np.ascontiguousarray(picture[..., k])).resize(
                (width, height), Image.Resampling.BICUBIC
            )
        )
        for k in range(3)
    ]
    return np.clip(np.stack(channels, axis=-1), 0.0, 1.0)


def _write_texts(
    sheet: Float[np.ndarray, "H W 3"], texts: Sequence[_Text]
) -> Float[np.ndarray, "H W 3"]:
    """Draw texts with Pillow's own font."""
    eight_bits = np.round(sheet * 255.0).astype(np.uint8)
    canvas = Image.fromarray(eight_bits)
    draw = ImageDraw.Draw(canvas)
    for text in texts:
        font = ImageFont.load_default(text.size)
        draw.text(text.position, text.words, fill=text.color, font=font, anchor=text.anchor)
    text_pixels = np.asarray(canvas)
    # Pixels without text keep their full precision.
    is_written = np.any(text_pixels != eight_bits, axis=-1, keepdims=True)
    return np.where(is_written, text_pixels.astype(np.float32) / 255.0, sheet)


def _reduced(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "h w 3"]:
    """Reduce a picture to at most `_LARGEST_CELL` pixels along its longer side."""
    size = picture.shape[:2]
    factor = _LARGEST_CELL / max(size)
    if factor >= 1.0:
        return picture
    return _resized(picture, *(max(1, round(factor * extent)) for extent in size))


def _place(cell: Float[np.ndarray, "h w 3"], picture: Float[np.ndarray, "H W 3"]) -> None:
    """Draw a picture into a cell in place: as large as fits, centred, with its aspect ratio."""
    height, width = cell.shape[:2]
    factor = min(height / picture.shape[0], width / picture.shape[1])
    h, w = (max(1, round(factor * extent)) for extent in picture.shape[:2])
    y, x = (height - h) // 2, (width - w) // 2
    cell[y : y + h, x : x + w] = _resized(picture, h, w)


def _grid_of_cells(
    rows: Sequence[Mapping[str, np.ndarray]], names: Sequence[str]
) -> tuple[Float[np.ndarray, "H W 3"], int, int]:
    """Lay out all cells with gutters; also return the height and width of one cell."""
    height, width = next(iter(next(row for row in rows if row).values())).shape[:2]
    shape = (
        len(rows) * (height + _GUTTER) - _GUTTER,
        len(names) * (width + _GUTTER) - _GUTTER,
        3,
    )
    grid = np.broadcast_to(np.asarray(_SHEET_COLOR, np.float32), shape).copy()
    for row, cells in enumerate(rows):
        for column, name in enumerate(names):
            y, x = row * (height + _GUTTER), column * (width + _GUTTER)
            cell = grid[y : y + height, x : x + width]
            cell[:] = _CELL_COLOR
            if name in cells:
                _place(cell, cells[name])
    return grid, height, width


def _light_strip(
    light: Float[np.ndarray, "h w 3"], cell_height: int, cell_width: int, columns: int
) -> Float[np.ndarray, "H W 3"]:
    """Tone map a light, and resize it to as many whole columns as its largest height allows."""
    aspect = light.shape[0] / light.shape[1]
    largest_height = _LIGHT_ROWS * (cell_height + _GUTTER) - _GUTTER
    widths = [n * (cell_width + _GUTTER) - _GUTTER for n in range(1, columns + 1)]
    fitting_widths = [width for width in widths if width * aspect <= largest_height]
    width = fitting_widths[-1] if fitting_widths else widths[0]
    return _resized(tone_map_light(light), max(1, round(width * aspect)), width)


def _enlarged(
    rows: Sequence[Mapping[str, np.ndarray]], names: Sequence[str]
) -> list[Mapping[str, np.ndarray]]:
    """Repeat the pixels of small pictures until every name fits above its column."""
    font = ImageFont.load_default(_LABEL_SIZE)
    label_width = max(font.getlength(name) for name in names)
    width = next(iter(next(row for row in rows if row).values())).shape[1]
    repeats = max(1, math.ceil(label_width / width))
    if repeats == 1:
        return list(rows)
    return [{n: im.repeat(repeats, 0).repeat(repeats, 1) for n, im in row.items()} for row in rows]


def _captions(
    names: Sequence[str],
    labels: Sequence[str],
    left: int,
    top: int,
    cell_height: int,
    cell_width: int,
) -> list[_Text]:
    """Put the names above the columns and the labels before the rows."""
    texts = []
    for column, name in enumerate(names):
        x = left + column * (cell_width + _GUTTER) + cell_width / 2
        texts.append(_Text(name, (x, top - _LABEL_RISE), "ms"))
    for row, label in enumerate(labels):
        y = top + row * (cell_height + _GUTTER) + cell_height / 2
        texts.append(_Text(label, (left - _LABEL_GAP, y), "rm", color=_FAINT_TEXT_COLOR))
    return texts


class _Footer(NamedTuple):
    """The part of the sheet below the views: pictures at (y, x), total height, and texts."""

    parts: list[tuple[int, int, np.ndarray]]
    height: int
    texts: list[_Text]


def _footer(
    lights: Sequence[tuple[str, np.ndarray]],
    scales: Sequence[Scale],
    notes: Sequence[str],
    left: int,
    top: int,
) -> _Footer:
    """Place lights side by side, notes to their right, and the scales of colours below.

    ``lights`` : titles and tone-mapped lights. ``left, top`` : corner of the footer, pixels.
    """
    parts: list[tuple[int, int, np.ndarray]] = []
    texts, x, y = [], left, top
    if lights or notes:
        y += _LABEL_HEIGHT
    for name, strip in lights:
        parts.append((y, x, strip))
        texts.append(_Text(name, (x, y - _LABEL_RISE), "ls"))
        x += strip.shape[1] + _MARGIN
    for line, note in enumerate(notes):
        position = (x, y + line * _LINE_HEIGHT)
        texts.append(_Text(note, position, "lt", color=_FAINT_TEXT_COLOR))
    y += max([len(notes) * _LINE_HEIGHT, *(strip.shape[0] for _, strip in lights)])
    for scale in scales:
        y += _LABEL_RISE
        parts.append((y, left, scale.bar(_BAR_HEIGHT, _BAR_WIDTH)))
        low, high = scale.ends
        words = f"{low} to {high}   {scale.name}"
        position = (left + _BAR_WIDTH + _LABEL_GAP, y + _BAR_HEIGHT // 2)
        texts.append(_Text(words, position, "lm", color=_FAINT_TEXT_COLOR))
        y += _BAR_HEIGHT
    return _Footer(parts, y - top, texts)


def _text_width(text: str, size: int = _LABEL_SIZE) -> int:
    """Width of the widest line, pixels."""
    font = ImageFont.load_default(size)
    return math.ceil(max(font.getlength(line) for line in text.split("\n")))


def overview_sheet(
    rows: Sequence[Mapping[str, np.ndarray]],
    *,
    lights: Mapping[str, Float[np.ndarray, "h w 3"]] | None = None,
    scales: Sequence[Scale] = (),
    title: str | None = None,
    row_labels: Sequence[str] | None = None,
    notes: Sequence[str] = (),
) -> Float[np.ndarray, "H W 3"]:
    """Compose labelled pictures into one sheet, with a row per view and lights below the rows.

    Columns are the titles in all rows, in order of first appearance; a cell whose row has no such
    picture stays empty. Cells have the size of the first picture, and others are fitted into it.
    Pictures whose longer side exceeds `_LARGEST_CELL` pixels are reduced. Pictures that are
    narrower than a column's title are enlarged by repeating pixels.

    Parameters
    ----------
    rows : one mapping per view, from the title of a column to a picture: (H, W), (H, W, 1) or
        (H, W, 3); sRGB floats in [0, 1], or 8-bit.
    lights : lat-long maps of *linear* radiance by title, each tone mapped separately, and drawn
        below the views.
    scales : colour scales of the pictures, drawn at the bottom.
    title : heading of the sheet.
    row_labels : one text per row, drawn to its left; it may have several lines.
    notes : lines of text beside the lights, such as metrics of the run.

    Returns
    -------
    (H, W, 3) float32 in [0, 1].

    Raises
    ------
    ValueError
        If there is no picture, or an image or the labels have the wrong shape or number.
    """
    pictures = [{name: _reduced(_as_picture(im, name)) for name, im in row.items()} for row in rows]
    names = list(dict.fromkeys(name for row in pictures for name in row))
    labels = list(row_labels or ())
    if not names:
        raise ValueError("the sheet needs at least one row with at least one picture, got none")
    if row_labels is not None and len(labels) != len(rows):
        raise ValueError(f"row_labels must be one a row, got {len(labels)} for {len(rows)} rows")
    grid, cell_height, cell_width = _grid_of_cells(_enlarged(pictures, names), names)
    left = _MARGIN + (max(map(_text_width, labels)) + _LABEL_GAP if labels else 0)
    top = _MARGIN + (_TITLE_HEIGHT if title else 0) + _LABEL_HEIGHT
    texts = _captions(names, labels, left, top, cell_height, cell_width)
    if title:
        texts.append(_Text(title, (_MARGIN, _MARGIN), "lt", _TITLE_SIZE))
    columns = max(1, len(names) // max(len(lights or {}), 1))
    strips = [
        (name, _light_strip(light, cell_height, cell_width, columns))
        for name, light in (lights or {}).items()
    ]
    footer = _footer(strips, scales, notes, left, top + grid.shape[0] + _GUTTER)
    texts += footer.texts
    blocks = [(top, left, grid), *footer.parts]
    right_ends = [x + block.shape[1] for _, x, block in blocks]
    # Left-aligned texts may extend beyond the pictures.
    right_ends += [
        int(text.position[0]) + _text_width(text.words, text.size)
        for text in texts
        if text.anchor.startswith("l")
    ]
    height = top + grid.shape[0] + (_GUTTER + footer.height if footer.height else 0)
    size = (height + _MARGIN, max(right_ends) + _MARGIN, 3)
    sheet = np.broadcast_to(np.asarray(_SHEET_COLOR, np.float32), size).copy()
    for y, x, block in blocks:
        sheet[y : y + block.shape[0], x : x + block.shape[1]] = block
    return _write_texts(sheet, texts)
