"""A run under another light: orientation of the light, orbits of cameras, files and errors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image
from support import ball_of_one_material, tiny_config, views_from

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import EnvLight
from geosplat_jax.io.images import SceneError, encode_srgb, write_hdr, write_png
from geosplat_jax.report import relight
from geosplat_jax.report.relight import (
    BACKGROUNDS,
    RelightOptions,
    load_light,
    picture,
    relight_views,
)
from geosplat_jax.report.renderer import RenderedView, Renderer
from geosplat_jax.report.shots import about_z, orbit, shots_of
from geosplat_jax.transport import environment

pytestmark = pytest.mark.usefixtures("products_must_ask")

AMPLE = Capacities(
    surface_cubes=256,
    dual_vertices=256,
    quads=256,
    visible=4096,
    hits=8192,
    chunks=2048,
    cell_patches=4096,
)
RED, GREEN, BLUE, YELLOW = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0.0]])
SIDES = {"+x": RED, "-y": GREEN, "-x": BLUE, "+y": YELLOW}
AXES = {
    "+x": np.array([1.0, 0, 0]),
    "-y": np.array([0, -1.0, 0]),
    "-x": np.array([-1.0, 0, 0]),
    "+y": np.array([0, 1.0, 0]),
}
SIZE = 16
# In eager mode, each of their many small operations would be compiled on its own.
lookup = jax.jit(environment.lookup)
rotate_light = jax.jit(environment.rotate_light)


def four_colours(height=16):
    """Red at +x, green at -y, blue at -x, yellow at +y; white above and black below."""
    width = 2 * height
    polar = (np.arange(height) + 0.5) / height * np.pi
    # The convention is implemented again, so that the test does not rely on the code under test.
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    texels = np.zeros((height, width, 3))
    for column, angle in enumerate(azimuth):
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        side = max(AXES, key=lambda name, direction=direction: direction @ AXES[name])
        texels[:, column] = SIDES[side]
    texels[polar < np.pi / 6] = 1.0
    texels[polar > 5 * np.pi / 6] = 0.0
    return texels.astype(np.float32)


@pytest.fixture(scope="module")
def light():
    return EnvLight(jnp.asarray(four_colours()))


def relit_ball(light, **material):
    pipeline, params = ball_of_one_material(tiny_config("material.bias=true"), **material)
    # The light of the training is black, so that only the new light can show.
    params = replace(params, light=EnvLight(jnp.zeros_like(params.light.radiance)))
    renderer = Renderer(replace(pipeline, capacities=AMPLE), params, samples=64)
    # A ball only shadows its own far side, so rays are left out, which halves the programs.
    return renderer.relit(light, indirect="unshadowed")


@pytest.fixture(scope="module")
def matt(light):
    return relit_ball(light, albedo=0.95, roughness=1.0, metallic=0.0)


@pytest.fixture(scope="module")
def mirror(light):
    return relit_ball(light, albedo=0.98, roughness=0.1, metallic=1.0)


def hue(colour):
    """Colour without its white part, normalised to unit length."""
    chroma = np.asarray(colour, float) - np.min(colour)
    return chroma / np.linalg.norm(chroma)


def has_colour(found, expected, factor=1.7):
    """Whether the lit channels of a colour exceed all its other channels by a factor."""
    is_lit = np.asarray(expected) > 0.5
    return np.min(np.asarray(found)[is_lit]) > factor * np.max(np.asarray(found)[~is_lit])


def where_the_surface_faces(view, direction):
    """Straight colour of the two covered pixels whose normals are closest to a direction."""
    normal = view.aovs["normal"] @ direction
    score = np.where(view.alpha > 0.9, normal / np.maximum(view.alpha, 0.5), -np.inf)
    rows = np.argsort(score.reshape(-1))[-2:]
    assert np.all(score.reshape(-1)[rows] > 0.6)
    return np.mean(view.rgb.reshape(-1, 3)[rows] / view.alpha.reshape(-1)[rows, None], axis=0)


def camera_from(eye, **kwargs):
    return views_from([eye], size=SIZE, **kwargs).camera()


@pytest.mark.parametrize("kind", ["matt", "mirror"])
def test_every_side_of_a_ball_has_the_colour_that_shines_on_it(kind, request):
    """Each side is seen from the front: the ball's +x side is red, and so on."""
    relit = request.getfixturevalue(kind)
    for side, axis in AXES.items():
        view = relit(camera_from(3 * axis))
        colour = where_the_surface_faces(view, axis)
        assert has_colour(colour, SIDES[side]), side
        assert np.max(colour) > 0.4


def test_a_matt_ball_shows_the_irradiance_of_the_map(matt):
    """The reference is a sum over texels: albedo / pi times radiance, cosine and solid angle."""
    texels = four_colours().astype(float)
    height, width, _ = texels.shape
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    polar, azimuth = np.meshgrid(polar, azimuth, indexing="ij")
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    weights = np.sin(polar) * (np.pi / height) * (2 * np.pi / width) / np.pi
    for axis in AXES.values():
        cosine = np.maximum(directions @ axis, 0)
        expected = 0.95 * np.sum((weights * cosine)[..., None] * texels, axis=(0, 1))
        colour = where_the_surface_faces(matt(camera_from(3 * axis)), axis)
        # A pixel mixes splats whose normals differ by some twenty degrees, and the specular lobe
        # adds 4 %.
        np.testing.assert_allclose(colour, expected, atol=0.08)


def test_a_camera_between_two_sides_sees_both_where_they_are(matt):
    """Sides belong to the world, not to the camera: in a view from -y, +x lies to the right."""
    for eye in ([2.2, -2.2, 0.5], [2.2, -2.2, 0.0]):
        view = matt(camera_from(eye))
        for side in ("+x", "-y"):
            colour = where_the_surface_faces(view, AXES[side])
            assert has_colour(colour, SIDES[side], 1.4), side
        right, left = view.rgb[:, SIZE // 2 :].sum((0, 1)), view.rgb[:, : SIZE // 2].sum((0, 1))
        assert right[0] > 1.3 * left[0]
        assert left[1] > 1.3 * right[1]


def test_a_mirror_shows_the_sky_above_and_the_dark_ground_below(mirror):
    view = mirror(camera_from([3.0, 0.01, 0.0]))
    is_covered = view.alpha > 0.9
    rows = np.flatnonzero(is_covered.any(axis=1))
    straight_rgb = view.rgb / np.maximum(view.alpha, 0.5)[..., None]
    middle = SIZE // 2

    # A surface whose normal leans upwards by 45 degrees reflects the zenith to a level camera.
    def at(lean):
        normal = np.array([np.cos(lean), 0.0, np.sin(lean)])
        score = np.where(is_covered, view.aovs["normal"] @ normal, -np.inf)
        return straight_rgb.reshape(-1, 3)[np.argmax(score)]

    assert rows[0] < middle < rows[-1]
    assert np.min(at(np.pi / 4)) > 0.6
    assert np.max(at(-np.pi / 4)) < 0.3


def test_turning_the_light_by_a_quarter_moves_red_from_x_to_y(light, matt):
    turned_light = rotate_light(light, jnp.asarray(about_z(np.pi / 2), jnp.float32))
    colours = lookup(turned_light.radiance, jnp.asarray(np.stack(list(AXES.values())), jnp.float32))
    for name, colour in zip(AXES, colours, strict=True):
        old_direction = about_z(-np.pi / 2) @ AXES[name]
        side = max(AXES, key=lambda n, d=old_direction: d @ AXES[n])
        np.testing.assert_allclose(colour, SIDES[side], atol=1e-3)
    np.testing.assert_allclose(colours[list(AXES).index("+y")], RED, atol=1e-3)
    view = matt.under(turned_light)(camera_from([0.0, 3.0, 0.0]))
    assert has_colour(where_the_surface_faces(view, AXES["+y"]), RED)
    # The renderer with the first light still shows yellow there.
    first_view = matt(camera_from([0.0, 3.0, 0.0]))
    assert has_colour(where_the_surface_faces(first_view, AXES["+y"]), YELLOW)


def nothing(size=SIZE):
    """A view without any object."""
    black = np.zeros((size, size, 3), np.float32)
    return RenderedView(black, np.zeros((size, size)), black, {})


@pytest.mark.parametrize("side", AXES)
def test_the_background_towards_a_side_has_its_colour(light, side):
    camera = camera_from(-3 * AXES[side], field_of_view=0.6)
    np.testing.assert_allclose(
        picture(nothing(), camera, light, "light"),
        np.broadcast_to(SIDES[side], (SIZE, SIZE, 3)),
        atol=2e-3,
    )


def test_the_background_is_upright_and_not_mirrored(light):
    """In a view of 120 degrees towards +x, yellow (+y) is left, green (-y) right, white above."""
    camera = camera_from([-3.0, 0.0, 0.0], field_of_view=2 * np.arctan(np.sqrt(3)))
    image = picture(nothing(), camera, light, "light")
    middle = SIZE // 2
    np.testing.assert_allclose(image[middle, 0], YELLOW, atol=2e-3)
    np.testing.assert_allclose(image[middle, -1], GREEN, atol=2e-3)
    np.testing.assert_allclose(image[middle, middle], RED, atol=2e-3)
    steep = camera_from([-0.5, 0.0, -3.0])
    np.testing.assert_allclose(picture(nothing(), steep, light, "light"), 1.0, atol=2e-3)


def test_the_background_is_the_environment_in_the_direction_of_every_pixel(light):
    camera = camera_from([1.0, -2.0, 0.7], field_of_view=1.2)
    image = picture(nothing(), camera, light, "light")
    pose = views_from([[1.0, -2.0, 0.7]], size=SIZE, field_of_view=1.2).camera_to_world[0]
    for row, column in ((0, 0), (3, 12), (15, 7)):
        focal = float(camera.intrinsics[0, 0, 0])
        ray = np.array([(column + 0.5 - SIZE / 2) / focal, -(row + 0.5 - SIZE / 2) / focal, -1.0])
        ray = pose[:3, :3] @ ray / np.linalg.norm(ray)
        expected = lookup(light.radiance, jnp.asarray(ray[None], jnp.float32))[0]
        np.testing.assert_allclose(image[row, column], encode_srgb(np.asarray(expected)), atol=2e-3)


def test_pictures_lie_over_white_and_black_and_refuse_other_names(light):
    camera = camera_from([3.0, 0.0, 0.0])
    grey = np.full((SIZE, SIZE, 3), 0.1, np.float32)
    view = RenderedView(grey, np.full((SIZE, SIZE), 0.5), grey, {})
    for name, value in (("white", 0.6), ("black", 0.1)):
        expected = encode_srgb(np.full((SIZE, SIZE, 3), value))
        np.testing.assert_allclose(picture(view, camera, light, name), expected, atol=1e-6)
    with pytest.raises(ValueError, match="background must be one of.*got 'grey'"):
        picture(view, camera, light, "grey")
    assert "light" in BACKGROUNDS


def test_a_written_map_is_read_back_the_right_way_round(tmp_path):
    write_hdr(tmp_path / "four.hdr", 3 * four_colours())
    radiance = load_light(tmp_path / "four.hdr").radiance
    assert radiance.dtype == jnp.float32
    colours = lookup(
        radiance, jnp.asarray(np.stack([*AXES.values(), [0, 0, 1.0], [0, 0, -1.0]]), "f4")
    )
    # RGBE has eight bits; radiance above one must survive.
    np.testing.assert_allclose(
        colours, 3 * np.stack([*SIDES.values(), np.ones(3), np.zeros(3)]), atol=0.05
    )


def test_large_maps_are_reduced_in_place_and_keep_their_flux(tmp_path):
    rng = np.random.default_rng(0)
    write_hdr(tmp_path / "four.hdr", four_colours(32) * rng.uniform(0.5, 1.5, (32, 64, 1)))
    full_map, small_map = (load_light(tmp_path / "four.hdr", largest=n).radiance for n in (32, 8))
    assert small_map.shape == (8, 16, 3)
    for side, axis in AXES.items():
        colour = np.asarray(lookup(small_map, jnp.asarray(axis[None], jnp.float32))[0])
        assert hue(colour) @ hue(SIDES[side]) > 0.999
    flux = [
        np.sum(
            np.asarray(x) * np.sin((np.arange(len(x)) + 0.5) * np.pi / len(x))[:, None, None],
            (0, 1),
        )
        * (np.pi / len(x)) ** 2
        for x in (full_map, small_map)
    ]
    np.testing.assert_allclose(flux[1], flux[0], rtol=0.02)


def test_a_map_that_cannot_be_an_environment_is_refused(tmp_path):
    write_hdr(tmp_path / "square.hdr", np.ones((4, 4, 3), np.float32))
    with pytest.raises(SceneError, match=r"square.hdr has shape \(4, 4, 3\).*twice as wide"):
        load_light(tmp_path / "square.hdr")
    write_png(tmp_path / "grey.png", np.ones((4, 8, 1), np.float32))
    with pytest.raises(SceneError, match="three channels"):
        load_light(tmp_path / "grey.png")
    with pytest.raises(SceneError, match=r"^there is no environment map .*absent\.hdr"):
        load_light(tmp_path / "absent.hdr")
    (tmp_path / "broken.hdr").write_bytes(b"no picture")
    with pytest.raises(SceneError, match="broken.hdr"):
        load_light(tmp_path / "broken.hdr")


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan])
def test_radiance_that_is_not_radiance_is_refused(tmp_path, monkeypatch, value):
    pixels = np.ones((4, 8, 3), np.float32)
    pixels[1, 2, 0] = value
    path = tmp_path / "any.exr"
    monkeypatch.setattr("geosplat_jax.report.relight.read_stored", lambda path: pixels.copy())
    with pytest.raises(SceneError, match=r"any\.exr has 1 .*values.* row 1, column 2, channel 0"):
        load_light(path)


def test_a_little_negative_radiance_is_set_to_zero(monkeypatch):
    """As filters leave it that resized the map."""
    pixels = np.full((4, 8, 3), 100.0, np.float32)
    pixels[1, 2] = -1.0
    monkeypatch.setattr("geosplat_jax.report.relight.read_stored", lambda path: pixels.copy())
    with pytest.warns(RuntimeWarning, match=r"3 values of any\.exr are negative and are set to"):
        radiance = load_light("any.exr").radiance
    np.testing.assert_array_equal(radiance, np.maximum(pixels, 0))


def test_alpha_of_a_map_means_nothing(tmp_path):
    pixels = np.full((4, 8, 4), 2.0, np.float32)
    pixels[..., 3] = 0.0
    path = str(tmp_path / "map.exr")
    sink = oiio.ImageOutput.create(path)
    assert sink.open(path, oiio.ImageSpec(8, 4, 4, oiio.FLOAT))
    assert sink.write_image(pixels)
    assert sink.close()
    np.testing.assert_array_equal(load_light(tmp_path / "map.exr").radiance, 2.0)


def test_a_black_light_is_told(tmp_path):
    write_hdr(tmp_path / "night.hdr", np.zeros((4, 8, 3), np.float32))
    with pytest.warns(RuntimeWarning, match=r"night\.hdr is black all over"):
        load_light(tmp_path / "night.hdr")


def test_an_image_of_eight_bits_is_taken_as_srgb(tmp_path):
    write_png(tmp_path / "grey.png", np.full((4, 8, 3), 0.5, np.float32))
    radiance = load_light(tmp_path / "grey.png").radiance
    np.testing.assert_allclose(radiance, (0.502 + 0.055) ** 2.4 / 1.055**2.4, atol=1e-3)


def test_movies_that_cannot_be_written_are_refused_before_anything_is_rendered():
    options = RelightOptions(turntable=3, suffix=".gif", frames_per_second=60.0)
    with pytest.raises(SceneError, match="50 frames per second, got 60"):
        options.check()
    replace(options, turntable=0).check()
    with pytest.raises(ValueError, match="a turn of the light has from 0 to 10000 pictures"):
        RelightOptions(rotate_env=10**9).check()


def test_the_orbit_goes_counter_clockwise_and_keeps_distance_and_view():
    center = np.array([0.2, -0.1, 0.3])
    eye = center + [2.0, 0.0, 1.0]
    camera = camera_from(eye)
    for angle in (0.0, 0.3, np.pi / 2, np.pi):
        moved_camera = orbit(camera, center, angle)
        expected = center + about_z(angle) @ (eye - center)
        np.testing.assert_allclose(moved_camera.centers[0], expected, atol=1e-5)
        assert np.linalg.norm(moved_camera.centers[0] - center) == pytest.approx(
            np.sqrt(5), rel=1e-5
        )
        # The centre of the orbit keeps its place in camera axes.
        center_point = np.asarray([*center, 1.0], np.float32)
        moved_point, original_point = (
            np.asarray(x.world_to_camera[0]) @ center_point for x in (moved_camera, camera)
        )
        np.testing.assert_allclose(moved_point, original_point, atol=1e-5)
    # A quarter turn moves the camera from +x to +y.
    quarter = orbit(camera_from([3.0, 0.0, 0.0]), np.zeros(3), np.pi / 2)
    np.testing.assert_allclose(quarter.centers[0], [0, 3, 0], atol=1e-5)


def test_the_orbit_of_camera_and_light_together_changes_no_background(light):
    camera = camera_from([2.0, 1.0, 0.4], field_of_view=1.0)
    angle = np.pi / 4  # four columns of the map: nothing is interpolated
    turned_light = rotate_light(light, jnp.asarray(about_z(angle), jnp.float32))
    first_picture = picture(nothing(), camera, light, "light")
    second_picture = picture(nothing(), orbit(camera, np.zeros(3), angle), turned_light, "light")
    np.testing.assert_allclose(second_picture, first_picture, atol=5e-3)


def test_movies_of_small_views_are_enlarged_and_those_of_large_ones_are_not():
    small_camera = relight._for_movies(camera_from([3.0, 0.0, 0.0]))
    assert max(small_camera.width, small_camera.height) == 384
    large_camera = replace(camera_from([3.0, 0.0, 0.0]), width=500)
    assert relight._for_movies(large_camera) is large_camera


def test_relighting_writes_stills_and_movies(light, matt, tmp_path, monkeypatch):
    monkeypatch.setattr(relight, "SMALLEST_MOVIE", SIZE)
    views = replace(
        views_from([[3.0, 0.0, 0.5], [0.0, 3.0, 0.5]], size=SIZE), names=("a/first", "second")
    )
    options = RelightOptions(turntable=2, rotate_env=2, suffix=".gif", frames_per_second=10.0)
    paths = relight_views(matt, light, shots_of(views), tmp_path, options)
    assert [path.name for path in paths] == [
        "a_first_rgba.png",
        "a_first.png",
        "second_rgba.png",
        "second.png",
        "turntable.gif",
        "rotate_env.gif",
    ]
    assert all(path.parent == tmp_path for path in paths)
    rgba = np.asarray(Image.open(paths[0]))
    still = np.asarray(Image.open(paths[1]), float) / 255
    assert rgba.shape == (SIZE, SIZE, 4)
    assert rgba[0, 0, 3] == 0
    assert rgba[SIZE // 2, SIZE // 2, 3] > 200
    # In this view towards -x, the background is blue, and the front of the ball is red.
    assert hue(still[0, 0]) @ hue(BLUE) > 0.97
    assert has_colour(still[SIZE // 2, SIZE // 2], RED, 1.2)
    for path in paths[4:]:
        with Image.open(path) as film:
            assert film.n_frames == 2
            frames = []
            for k in range(2):
                film.seek(k)
                frames.append(np.asarray(film.convert("RGB"), float) / 255)
        # Half a turn of the camera shows the blue side of the ball; half a turn of the light brings
        # blue light to the side in view.
        first_colour, second_colour = (frame[SIZE // 2, SIZE // 2] for frame in frames)
        assert has_colour(first_colour, RED, 1.2)
        assert has_colour(second_colour, BLUE, 1.2)


def test_without_movies_only_stills_are_written(light, matt, tmp_path):
    views = views_from([[3.0, 0.0, 0.5]], size=SIZE)
    paths = relight_views(
        matt, light, shots_of(views), tmp_path, RelightOptions(background="white")
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(p.name for p in paths)
    assert len(paths) == 2
    assert np.all(np.asarray(Image.open(paths[1]))[0, 0] == 255)


def test_the_movie_is_an_mp4_only_where_one_can_be_made(monkeypatch):
    for is_available, expected in ((True, ".mp4"), (False, ".gif")):
        monkeypatch.setattr(
            "geosplat_jax.report.relight.has_encoder", lambda suffix, f=is_available: f
        )
        assert RelightOptions().movie_suffix() == expected
    assert RelightOptions(suffix=".gif").movie_suffix() == ".gif"


def test_turning_by_a_full_circle_changes_nothing():
    np.testing.assert_allclose(about_z(2 * np.pi), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(about_z(np.pi / 2) @ [1.0, 0, 0], [0, 1, 0], atol=1e-12)
