"""Images are written and read back, and downscaling keeps light and edges."""

import io
import struct

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from geosplat_jax.io import images
from geosplat_jax.io.images import (
    ImageReadError,
    MissingFileError,
    SceneError,
    decode_srgb,
    downscale,
    encode_srgb,
    image_orientation,
    image_size,
    read_image,
    read_linear,
    read_stored,
    wide_color_profile,
    write_exr,
    write_hdr,
    write_png,
)

RGBE_TOLERANCE = 1 / 128  # Radiance HDR: 8-bit mantissas, and the exponent of the brightest channel


def random_pixels(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_returns_what_was_written_within_half_a_step(tmp_path, bits, channels):
    pixels = random_pixels(5, 7, channels)
    write_png(tmp_path / "a.png", pixels, bits=bits)
    image = read_image(tmp_path / "a.png")
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, pixels, atol=0.5001 / (2**bits - 1))


def test_png_keeps_straight_alpha_even_under_zero_alpha(tmp_path):
    pixels = np.full((2, 2, 4), 0.8, np.float32)
    pixels[..., 3] = [[0.0, 0.2], [0.6, 1.0]]
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), pixels, atol=1e-6)


def test_png_alpha_written_by_others_is_not_premultiplied(tmp_path):
    from PIL import Image

    integers = np.array([[[200, 100, 50, 51], [10, 20, 30, 0]]], np.uint8)
    Image.fromarray(integers).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), integers / np.float32(255))


def test_exr_is_exact_and_straight_alpha_returns(tmp_path):
    rgb = 100.0 * random_pixels(4, 3, 3)
    write_exr(tmp_path / "rgb.exr", rgb)
    np.testing.assert_array_equal(read_image(tmp_path / "rgb.exr"), rgb)
    rgba = random_pixels(4, 3, 4)
    write_exr(tmp_path / "rgba.exr", rgba)
    np.testing.assert_allclose(read_linear(tmp_path / "rgba.exr"), rgba, rtol=1e-6)
    stored_rgb = read_image(tmp_path / "rgba.exr")[..., :3]
    np.testing.assert_allclose(stored_rgb, rgba[..., :3] * rgba[..., 3:], rtol=1e-6)


def test_half_exr_is_within_half_precision(tmp_path):
    rgb = random_pixels(4, 3, 3)
    write_exr(tmp_path / "a.exr", rgb, half=True)
    np.testing.assert_allclose(read_linear(tmp_path / "a.exr"), rgb, rtol=1e-3)


def test_hdr_is_linear_within_its_shared_exponent(tmp_path):
    rgb = 1e4 * random_pixels(4, 16, 3)
    write_hdr(tmp_path / "a.hdr", rgb)
    image = read_linear(tmp_path / "a.hdr")
    assert np.all(np.abs(image - rgb) <= RGBE_TOLERANCE * rgb.max(-1, keepdims=True))


def test_the_transfer_curve_depends_on_the_format_and_can_be_overridden(tmp_path):
    rgba = np.full((1, 1, 4), 0.5, np.float32)
    write_png(tmp_path / "a.png", rgba, bits=16)
    linear = float(((0.5 + 0.055) / 1.055) ** 2.4)
    decoded, raw = (read_linear(tmp_path / "a.png", is_srgb=flag)[0, 0] for flag in (None, False))
    np.testing.assert_allclose(decoded, [linear] * 3 + [0.5], atol=2e-5)
    np.testing.assert_allclose(raw, [0.5] * 4, atol=2e-5)
    write_exr(tmp_path / "a.exr", rgba[..., :3])
    assert read_linear(tmp_path / "a.exr")[0, 0, 0] == np.float32(0.5)


def test_linear_values_survive_srgb_png(tmp_path):
    rgba = random_pixels(6, 5, 4)
    write_png(tmp_path / "a.png", rgba, bits=16, is_linear=True)
    np.testing.assert_allclose(read_linear(tmp_path / "a.png"), rgba, atol=3e-5)


def test_srgb_on_the_host_inverts_itself():
    values = np.linspace(0.0, 1.0, 1001, dtype=np.float32)
    np.testing.assert_allclose(decode_srgb(encode_srgb(values)), values, atol=1e-6)


def test_jpeg_is_read_as_srgb_without_alpha(tmp_path):
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(tmp_path / "a.jpg", quality=95)
    image = read_linear(tmp_path / "a.jpg")
    assert image.shape == (8, 8, 3)
    np.testing.assert_allclose(image, 0.2159, atol=0.01)


def _jpeg(pixels, xmp=""):
    """Return the bytes of a JPEG, with XMP in its first segment if there is any."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95)
    content = file.getvalue()
    if not xmp:
        return content
    body = b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + content[2:]


def _xmp(attributes, content=""):
    """Return a packet of XMP with one description."""
    names = {
        "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
        "hdrgm": "http://ns.adobe.com/hdr-gain-map/1.0/",
        "Container": "http://ns.google.com/photos/1.0/container/",
        "Item": "http://ns.google.com/photos/1.0/container/item/",
    }
    spaces = " ".join(f'xmlns:{name}="{uri}"' for name, uri in names.items())
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {spaces}>'
        f"<rdf:Description {attributes}>{content}</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def _with_gain_map(pixels, gain):
    """Return the bytes of an Ultra HDR file: a JPEG, and a second one with factors up to 4."""
    limits = 'hdrgm:GainMapMin="0" hdrgm:GainMapMax="2" hdrgm:Gamma="1" hdrgm:OffsetSDR="0"'
    limits += ' hdrgm:OffsetHDR="0" hdrgm:HDRCapacityMin="0" hdrgm:HDRCapacityMax="2"'
    second = _jpeg(gain, _xmp(f'hdrgm:Version="1.0" {limits} hdrgm:BaseRenditionIsHDR="False"'))
    items = "".join(
        '<rdf:li rdf:parseType="Resource"><Container:Item Item:Mime="image/jpeg" '
        f"{attributes}/></rdf:li>"
        for attributes in (
            'Item:Semantic="Primary"',
            f'Item:Semantic="GainMap" Item:Length="{len(second)}"',
        )
    )
    directory = f"<Container:Directory><rdf:Seq>{items}</rdf:Seq></Container:Directory>"
    return _jpeg(pixels, _xmp('hdrgm:Version="1.0"', directory)) + second


def test_of_a_photograph_with_a_gain_map_the_ordinary_picture_is_read(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 96).astype(np.uint8)[None, :, None], (64, 1, 3))
    (tmp_path / "plain.jpg").write_bytes(_jpeg(ramp))
    path = tmp_path / "hdr.JPG"
    path.write_bytes(_with_gain_map(ramp, ramp[..., 0]))
    stored = read_stored(path)
    assert stored.dtype == np.uint8
    np.testing.assert_array_equal(stored, read_stored(tmp_path / "plain.jpg"))
    assert image_size(path) == (64, 96)
    assert image_orientation(path) == 1
    assert wide_color_profile(path) is None
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(ImageReadError, match="damaged or truncated"):
        read_stored(path)


def test_downscale_keeps_the_mean_of_premultiplied_colour():
    rgba = random_pixels(12, 9, 4)
    small = downscale(rgba, 3)
    assert small.shape == (4, 3, 4)
    premultiplied = lambda x: (x[..., :3] * x[..., 3:]).mean((0, 1))  # noqa: E731
    np.testing.assert_allclose(premultiplied(small), premultiplied(rgba), rtol=1e-5)
    np.testing.assert_allclose(small[..., 3].mean(), rgba[..., 3].mean(), rtol=1e-5)


def test_downscale_does_not_bleed_the_background_into_the_edge():
    rgba = np.zeros((4, 4, 4), np.float32)
    rgba[..., 1] = 1.0  # green behind the mask
    rgba[:, :3] = [1.0, 0.0, 0.0, 1.0]
    small = downscale(rgba, 2)
    np.testing.assert_allclose(small[:, :, :3], np.broadcast_to([1.0, 0.0, 0.0], (2, 2, 3)))
    np.testing.assert_allclose(small[:, :, 3], [[1.0, 0.5]] * 2)


def test_downscale_of_a_fully_transparent_block_is_zero():
    rgba = np.ones((2, 2, 4), np.float32)
    rgba[..., 3] = 0.0
    np.testing.assert_array_equal(downscale(rgba, 2), np.zeros((1, 1, 4)))


def test_downscale_cuts_what_does_not_fill_a_block():
    pixels = random_pixels(7, 5, 3)
    np.testing.assert_array_equal(downscale(pixels, 2), downscale(pixels[:6, :4], 2))


@pytest.mark.parametrize("factor", [0, -1, 6])
def test_downscale_refuses_impossible_factors(factor):
    with pytest.raises(SceneError, match="between 1 and the image size"):
        downscale(random_pixels(5, 9, 3), factor)


def test_a_missing_image_is_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"nowhere\.png does not exist") as error_info:
        read_image(tmp_path / "nowhere.png")
    assert isinstance(error_info.value, FileNotFoundError)


def test_a_folder_is_no_image(tmp_path):
    with pytest.raises(SceneError, match="is a folder; an image is expected"):
        read_image(tmp_path)


def test_text_is_no_image(tmp_path):
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(ImageReadError, match="not a readable image"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_half_a_file_is_an_error(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    (write_png if suffix == ".png" else write_exr)(path, random_pixels(64, 64, 3))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ImageReadError, match="damaged or truncated"):
        read_image(path)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, "not finite"),
        (np.inf, "not finite"),
        (-0.25, "negative"),
        (1e30, r"above 1e\+12"),
    ],
)
def test_light_that_is_no_light_is_located(tmp_path, value, message):
    pixels = random_pixels(4, 5, 3)
    pixels[2, 3, 1] = value
    spec = oiio.ImageSpec(5, 4, 3, oiio.FLOAT)
    sink = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert sink.open(str(tmp_path / "a.exr"), spec)
    assert sink.write_image(pixels)
    assert sink.close()
    with pytest.raises(SceneError, match=f"{message}.*row 2, column 3, channel 1"):
        read_linear(tmp_path / "a.exr")


def test_nothing_wrong_is_written(tmp_path):
    bad_pixels = np.full((2, 2, 3), np.nan, np.float32)
    for write, name in ((write_png, "a.png"), (write_exr, "a.exr"), (write_hdr, "a.hdr")):
        with pytest.raises(SceneError, match="not finite"):
            write(tmp_path / name, bad_pixels)
    with pytest.raises(SceneError, match="negative"):
        write_hdr(tmp_path / "a.hdr", -np.ones((2, 2, 3), np.float32))
    with pytest.raises(SceneError, match=r"must end in \.png"):
        write_png(tmp_path / "a.jpg", np.ones((2, 2, 3), np.float32))
    with pytest.raises(SceneError, match="8 or 16 bits"):
        write_png(tmp_path / "a.png", np.ones((2, 2, 3), np.float32), bits=12)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_keeps_the_previous_file(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    write_png(path, np.ones((2, 2, 3), np.float32))

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(images.os, "replace", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_png(path, np.zeros((2, 2, 3), np.float32))
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    assert read_image(path).min() == 1.0


def test_writing_makes_the_folder(tmp_path):
    write_png(tmp_path / "new" / "deep" / "a.png", np.ones((1, 1, 3), np.float32))
    assert read_image(tmp_path / "new" / "deep" / "a.png").shape == (1, 1, 3)


def _write_exr(path, pixels, names, *, frame=None):
    """Write an EXR with channels of any name, as a part of a larger frame if one is given."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.FLOAT)
    spec.channelnames = names
    if frame is not None:
        spec.full_width, spec.full_height = frame
    sink = oiio.ImageOutput.create(str(path))
    assert sink.open(str(path), spec)
    assert sink.write_image(pixels)
    assert sink.close()


def test_a_fourth_channel_that_is_no_alpha_is_refused(tmp_path):
    pixels = np.full((4, 6, 4), 0.5, np.float32)
    _write_exr(tmp_path / "depth.exr", pixels, ("R", "G", "B", "Z"))
    with pytest.raises(ImageReadError, match="channels R, G, B, Z, which are not grey or RGB"):
        read_linear(tmp_path / "depth.exr")
    _write_exr(tmp_path / "alpha.exr", pixels, ("R", "G", "B", "A"))
    np.testing.assert_allclose(read_linear(tmp_path / "alpha.exr")[..., :3], 1.0)


@pytest.mark.parametrize("ending", ["exr", "tif"])
def test_channels_beside_colour_and_alpha_are_refused(tmp_path, ending):
    """Float files and integer files are both refused; the integer ones would be read as grey."""
    path, kind = tmp_path / f"five.{ending}", oiio.FLOAT if ending == "exr" else oiio.UINT8
    spec = oiio.ImageSpec(6, 4, 5, kind)
    spec.channelnames = ("R", "G", "B", "A", "selection")
    sink = oiio.ImageOutput.create(str(path))
    assert sink.open(str(path), spec)
    assert sink.write_image(np.full((4, 6, 5), 0.5, np.float32))
    assert sink.close()
    for reader in (read_linear, read_stored):
        with pytest.raises(ImageReadError, match=rf"five\.{ending} has the channels R, G, B, A, "):
            reader(path)


def test_a_part_of_a_frame_is_refused(tmp_path):
    pixels = np.full((4, 6, 3), 0.5, np.float32)
    _write_exr(tmp_path / "part.exr", pixels, ("R", "G", "B"), frame=(12, 8))
    with pytest.raises(ImageReadError, match=r"the part \(0, 0, 6, 4\) .* frame \(0, 0, 12, 8\)"):
        read_linear(tmp_path / "part.exr")


def write_tiff(path, pixels, numbers, *, associated=False):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], numbers)
    if not associated:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    sink = oiio.ImageOutput.create(str(path))
    assert sink.open(str(path), spec)
    assert sink.write_image(pixels)
    sink.close()


@pytest.mark.parametrize("numbers", [oiio.HALF, oiio.FLOAT, oiio.DOUBLE])
def test_floats_of_any_format_are_linear_light(tmp_path, numbers):
    pixels = random_pixels(4, 5, 3)
    write_tiff(tmp_path / "a.tif", pixels, numbers)
    np.testing.assert_allclose(read_linear(tmp_path / "a.tif"), pixels, atol=1e-3)


@pytest.mark.parametrize("numbers", ["uint8", "uint16", "uint32"])
def test_integers_of_tiff_are_srgb_of_any_depth(tmp_path, numbers):
    pixels = random_pixels(4, 5, 3)
    write_tiff(tmp_path / "a.tif", pixels, numbers)
    np.testing.assert_allclose(read_linear(tmp_path / "a.tif"), decode_srgb(pixels), atol=5e-3)


@pytest.mark.parametrize("numbers", ["uint8", "uint16", "float"])
def test_colour_that_a_tiff_stores_multiplied_by_alpha_comes_back_straight(tmp_path, numbers):
    rgba = 0.2 + 0.8 * random_pixels(6, 5, 4)
    rgba[0, 0] = 0.0
    stored_rgba = np.concatenate([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1)
    write_tiff(tmp_path / "a.tif", stored_rgba, numbers, associated=True)
    image = read_image(tmp_path / "a.tif")
    np.testing.assert_allclose(image, rgba, atol=2e-2 if numbers == "uint8" else 1e-4)
    write_tiff(tmp_path / "b.tif", rgba, numbers)
    np.testing.assert_allclose(read_image(tmp_path / "b.tif"), rgba, atol=2e-3)
