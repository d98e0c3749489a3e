"""Points without a derivative: projection, rasteriser, visibility, colour.

The gradient that the code returns at these points is compared with one-sided differences on both
sides. The points are listed in `docs/gradients.md`.
"""

from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_sided import (
    GRID,
    STEP,
    assert_smooth_at,
    direction_at,
    make_ball,
    material,
    one_sided,
    up,
)
from support import double_precision

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import linear_to_srgb, srgb_to_linear, tone_map
from geosplat_jax.core.ssim import ssim
from geosplat_jax.core.types import Box, Camera, EnvLight, Grid, Materials, Mesh, Splats
from geosplat_jax.geometry import FlexiCubes
from geosplat_jax.materials import Attributes, MaterialSpec, init_materials, smoothness
from geosplat_jax.render import Asset, Params, RenderPipeline
from geosplat_jax.splats.projection import Footprints, project
from geosplat_jax.splats.rasterize import (
    MAX_ALPHA,
    MIN_ALPHA,
    composite,
    find_visible,
    gather_visible,
)
from geosplat_jax.surface.base import Surface
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.environment import LightSpec, prefilter_operators
from geosplat_jax.transport.split_sum import SplitSum, fg_table

ROOM = Capacities(surface_cubes=256, dual_vertices=256, quads=256)


@pytest.fixture(autouse=True)
def _double():
    with double_precision():
        yield


# Projection


@jax.jit
def _projected(x, depth, quat):
    return project(
        jnp.stack([x, 0 * x, 0 * x])[None],
        quat[None],
        jnp.array([[0.1, 0.2, 0.05]]),
        world_to_camera=jnp.eye(4).at[2, 3].set(depth),
        intrinsics=jnp.array([[20.0, 0, 8.0], [0, 20.0, 8.0], [0, 0, 1]]),
        height=16,
        width=16,
        near=0.5,
    )


IDENTITY = jnp.array([1.0, 0.0, 0.0, 0.0], jnp.float32)


def _quat():
    return IDENTITY.astype(jnp.float64)


def test_the_near_plane_ends_a_splat_and_its_gradient():
    def mean(depth):
        return _projected(jnp.asarray(0.1), depth, _quat()).means2d[0, 0]

    is_in_front = [
        bool(_projected(jnp.asarray(0.1), jnp.asarray(d), _quat()).is_in_front[0])
        for d in (0.5 - 1e-9, 0.5, 0.5 + 1e-9)
    ]
    assert is_in_front == [False, False, True]
    # In front of the plane the slope is the true one. On the plane and behind it, the depth is 1
    # and has no slope.
    assert float(mean(0.5 + 1e-9)) == pytest.approx(8 + 20 * 0.1 / 0.5)
    assert float(mean(0.5)) == pytest.approx(8 + 20 * 0.1)
    assert float(jax.grad(mean)(0.5 + 1e-9)) == pytest.approx(-20 * 0.1 / 0.25)
    assert jax.grad(mean)(0.5) == jax.grad(mean)(0.4) == 0


def test_the_clamp_of_the_field_of_view_is_continuous_with_the_mean_of_both_slopes():
    def variance(x):
        # Clamping the slope in x changes the variance along x, but not the one along y.
        return _projected(x, jnp.asarray(2.0), _quat()).covariances2d[0, 0]

    edge = 1.3 * 8.0 / 20.0 * 2.0
    assert_smooth_at(variance, [edge - 1e-2, edge + 1e-2])
    left, right = (one_sided(variance, jnp.asarray(edge), s) for s in (-STEP, STEP))
    assert left > 1e-2
    assert right == pytest.approx(0, abs=1e-6)
    gradient = float(jax.grad(variance)(edge))
    # Rounding of x / z decides on which side it is; exactly on the edge the clamp passes half.
    assert min(abs(gradient - c * left) for c in (0.0, 0.5, 1.0)) < 1e-5
    # The mean itself is not clamped.
    assert_smooth_at(lambda x: _projected(x, jnp.asarray(2.0), _quat()).means2d[0, 0], [edge])


def test_a_zero_quaternion_is_a_point_without_limit():
    quaternion = jnp.array([0.6, 0.0, 0.0, 0.8])

    def conic(length):
        return _projected(jnp.asarray(0.1), jnp.asarray(2.0), length * quaternion).conics[0, 0]

    assert_smooth_at(conic, [1e-3, 1.0])
    assert float(conic(1e-9)) == pytest.approx(float(conic(1.0)))
    assert abs(float(conic(0.0) - conic(1e-9))) > 1e-2
    assert jax.grad(conic)(0.0) == 0


# Rasteriser

SMALL = Capacities(visible=128, hits=128, chunks=128)


@jax.jit
@partial(jax.value_and_grad, argnums=(0, 1, 2))
def _composited(opacities, depths, width, chosen):
    """Weighted sum of the colour of pixel (1, 1) and the alpha of pixel (1, 3), of 4 x 4 pixels.

    Two splats lie on pixel (1, 1); ``chosen`` holds both weights.
    """
    ones = jnp.broadcast_to(jnp.array([1.0, 0.0, 1.0]), (2, 3))
    footprints = Footprints(
        means2d=jnp.full((2, 2), 1.5),
        covariances2d=ones * width,
        conics=ones / width,
        depths=depths,
        compensation=jnp.ones((2,)),
        is_in_front=depths > 0,
    )
    frame = {"height": 4, "width": 4, "tile_size": 4}
    lists = find_visible(footprints, opacities, jnp.ones((2,), bool), capacities=SMALL, **frame)
    image, alpha = composite(
        jax.tree.map(partial(gather_visible, lists.index), footprints),
        gather_visible(lists.index, opacities),
        gather_visible(lists.index, jnp.array([[1.0], [0.25]])),
        lists,
        **frame,
    )
    return chosen[0] * image[1, 1, 0] + chosen[1] * alpha[1, 3]


def seen(opacities, *, depths=(1.0, 2.0), width=1.0, chosen=(1.0, 0.0)):
    """Value and gradient in opacities, depths and width."""
    inputs = (jnp.asarray(x, jnp.float64) for x in (opacities, depths, width, chosen))
    value, slopes = _composited(*inputs)
    return float(value), tuple(np.asarray(slope) for slope in slopes)


def test_a_swap_in_depth_jumps_by_the_product_of_alphas_and_has_no_gradient():
    def at_depth(depth):
        return seen((0.7, 0.5), depths=(depth, 1.0))

    front, tie, back = (at_depth(1 + s)[0] for s in (-1e-9, 0.0, 1e-9))
    assert front == pytest.approx(0.7 * 1.0 + 0.3 * 0.5 * 0.25)
    assert front - back == pytest.approx(0.7 * 0.5 * (1.0 - 0.25))
    # Equal depths keep the order of the rows.
    assert tie == front
    for depth in (0.9, 1.0, 1.1):
        assert not np.any(at_depth(depth)[1][1])
    assert at_depth(0.9)[0] == front
    assert at_depth(1.1)[0] == back


def test_below_the_alpha_threshold_a_pixel_and_its_gradient_are_zero():
    def alone(opacity):
        value, (slope, _, _) = seen((opacity, 0.0))
        return value, slope[0]

    (above, slope), (below, slope_below) = (alone(MIN_ALPHA * (1 + s)) for s in (1e-9, -1e-9))
    assert above == pytest.approx(MIN_ALPHA)
    assert slope == pytest.approx(1.0)
    assert below == slope_below == 0
    # Exactly on the threshold, rounding of exp(log) decides between the two.
    on, slope_on = alone(MIN_ALPHA)
    assert (on, slope_on) == (0.0, 0.0) or (on, slope_on) == pytest.approx((MIN_ALPHA, 1.0))
    assert alone(0.0) == alone(1e-4) == (0.0, 0.0)


def test_a_splat_that_shrinks_leaves_a_pixel_by_a_jump_of_the_threshold():
    def neighbour(width):
        value, (_, _, slope) = seen((0.5, 0.0), width=width, chosen=(0.0, 1.0))
        return value, float(slope)

    # Two pixels away: 0.5 exp(-2 / width) = 1 / 255.
    edge = 2 / np.log(0.5 / MIN_ALPHA)
    expected = (MIN_ALPHA, MIN_ALPHA * 2 / edge**2)
    assert neighbour(edge * (1 + 1e-9)) == pytest.approx(expected, rel=1e-6)
    assert neighbour(edge * (1 - 1e-9)) == (0.0, 0.0)


def test_the_alpha_clamp_is_continuous_and_passes_nothing_above():
    def alone(opacity):
        value, (slope, _, _) = seen((opacity, 0.0))
        return value, slope[0]

    below, above = (alone(MAX_ALPHA * (1 + s)) for s in (-1e-9, 1e-9))
    assert below == pytest.approx((MAX_ALPHA, 1.0), abs=1e-8)
    assert above == (MAX_ALPHA, 0.0)
    # Exactly on the clamp, rounding of exp(log) decides between the two slopes.
    on, slope = alone(MAX_ALPHA)
    assert on == pytest.approx(MAX_ALPHA, abs=1e-12)
    assert min(slope, abs(slope - 1)) < 1e-9


# Visibility


def _split_sum():
    """The cheapest transport, with tables of a few entries."""
    light = LightSpec(height=4, width=8, roughness=(0.0, 1.0))
    table = fg_table(cosines=4, roughnesses=4).astype(jnp.float64)
    return SplitSum(prefilter_operators(light), table)


@lru_cache
def _card():
    """Make a scene of one white splat that faces the camera, to be tilted about the y axis."""
    grid = Grid(jnp.full((3,), -1.0), jnp.asarray(0.5), (4, 4, 4))
    pipeline = RenderPipeline(FlexiCubes(grid), _split_sum(), MaterialSpec(), capacities=SMALL)
    pose = jnp.eye(4).at[2, 3].set(3.0)
    camera = Camera(
        pose[None], jnp.array([[[12.0, 0, 4.5], [0, 12.0, 4.5], [0, 0, 1]]]), height=8, width=8
    )
    mesh = Mesh(jnp.zeros((3, 3)), jnp.zeros((1, 3), jnp.int32), jnp.int32(3), jnp.int32(1))
    light = EnvLight(jnp.ones((4, 8, 3)))

    @jax.jit
    @partial(jax.value_and_grad, argnums=2)
    def coverage(thickness, tilt, extra):
        # The culling normal turns by ``extra`` more than the splat.
        c, s = jnp.cos(0.5 * tilt), jnp.sin(0.5 * tilt)
        normal = jnp.stack([jnp.sin(tilt), 0 * tilt, -jnp.cos(tilt)])[None]
        outward = jnp.stack([jnp.sin(tilt + extra), 0 * tilt, -jnp.cos(tilt + extra)])[None]
        splats = Splats(
            means=jnp.zeros((1, 3)),
            quats=jnp.stack([c, 0 * c, -s, 0 * c])[None],
            scales=jnp.stack([0.3 + 0 * tilt, 0.3 + 0 * tilt, thickness])[None],
            opacities=jnp.array([0.99]),
            normals=normal,
            outward=outward,
            anchors=jnp.zeros((1, 3)),
            parents=jnp.array([0], jnp.int32),
            count=jnp.int32(1),
        )
        materials = Materials(jnp.ones((1, 3)), jnp.ones((1,)), jnp.zeros((1,)))
        attributes = Attributes(materials, None, None)
        asset = Asset(Surface(mesh, {}), splats, attributes, None, {})
        output = pipeline.render_views(asset, light, camera)
        return jnp.sum(output.alpha)

    return coverage


RIGHT_ANGLE = np.pi / 2


def test_culling_a_flat_splat_at_right_angles_changes_nothing_that_was_seen():
    """A splat without thickness fades below the threshold before it is seen exactly edge-on."""

    def flat(tilt):
        return _card()(jnp.asarray(1e-9), jnp.asarray(tilt), jnp.asarray(0.0))[0]

    assert float(flat(0.0)) > 5
    assert float(flat(RIGHT_ANGLE - 0.2)) > 0.5
    # Coverage falls continuously, except for a last step of one alpha threshold per pixel.
    tilts = RIGHT_ANGLE - np.logspace(-1, -6, 60)
    coverages = np.array([float(flat(t)) for t in tilts])
    assert coverages[-1] == 0
    assert np.all(-np.diff(coverages) < 0.5)
    assert [float(flat(RIGHT_ANGLE + t)) for t in (-1e-3, 0.0, 1e-3)] == [0.0, 0.0, 0.0]


def test_culling_a_thick_splat_jumps_and_its_normal_has_no_gradient():
    def thick(tilt, extra=0.0):
        return _card()(jnp.asarray(0.3), jnp.asarray(tilt), jnp.asarray(extra))

    front, back = (float(thick(RIGHT_ANGLE + t)[0]) for t in (-1e-6, 1e-6))
    assert front > 5
    assert back == 0
    # The normal that decides about culling carries no gradient.
    for extra in (-0.1, 0.0, 0.1):
        assert thick(RIGHT_ANGLE - 0.5, extra)[1] == 0
    # Exactly edge-on counts as turned away.
    assert thick(0.0, np.pi)[0] == 0


# Colour and similarity


def test_the_tone_map_has_no_kink():
    def exposed(radiance):
        return tone_map(jnp.broadcast_to(radiance, (3,)), jnp.asarray(0.0))[0]

    def slope(radiance):
        return jax.grad(exposed)(radiance)

    assert_smooth_at(exposed, [0.5, 0.99, 1.0, 1.01, 1.5])
    assert_smooth_at(slope, [0.99, 1.0, 1.01], tolerance=1e-4)
    assert float(slope(jnp.asarray(1.0))) == pytest.approx(0.5)


def test_the_knee_of_srgb_is_continuous_and_its_slopes_differ_by_two_percent():
    knee = 0.0031308
    left, right = 12.92, 1.055 / 2.4 * knee ** (1 / 2.4 - 1)
    assert right / left == pytest.approx(0.983, abs=1e-3)
    below, above = (float(linear_to_srgb(jnp.asarray(knee + s))) for s in (0.0, 1e-12))
    assert 0 < abs(above - below) < 3e-8
    for x, slope in ((knee - 1e-9, left), (knee, left), (knee + 1e-9, right)):
        assert float(jax.grad(linear_to_srgb)(x)) == pytest.approx(slope, rel=1e-5)
    assert_smooth_at(linear_to_srgb, [knee - 1e-4, knee + 1e-4])
    encoded = 0.04045
    below, above = (float(srgb_to_linear(jnp.asarray(encoded + s))) for s in (0.0, 1e-12))
    assert abs(above - below) < 3e-8


def test_the_floor_of_variances_is_no_kink_of_the_similarity():
    """The variance of a flat image is at the floor, where its own slope is zero as well."""
    rng = np.random.default_rng(0)
    direction = jnp.asarray(rng.standard_normal((12, 12, 3)))
    flat = jnp.full((12, 12, 3), 0.4)
    textured = jnp.asarray(rng.uniform(size=(12, 12, 3)))
    for target in (flat, flat + 0.2, textured):

        @jax.jit
        def similarity(change, target=target):
            return ssim(flat + change * direction, target)

        assert_smooth_at(similarity, [0.0, 1e-3], step=1e-8, tolerance=1e-4)


# Detached on purpose


@lru_cache
def _varied_field():
    """A field of attributes that changes from place to place, in float64."""
    spec = MaterialSpec(grid=GRID, albedo_hidden=(4,), surface_hidden=(4,), shared=True)
    start = partial(init_materials, spec=spec, indirect_outputs=6)
    field = jax.tree.map(lambda x: x.astype(jnp.float64), jax.jit(start)(jax.random.key(0)))
    table = jax.random.normal(jax.random.key(1), field.albedo_table.shape, jnp.float64)
    return spec, replace(field, albedo_table=table)


@pytest.mark.parametrize("which", ["materials", "indirect"])
@pytest.mark.parametrize("position_gradient", [False, True])
def test_attributes_pull_on_the_geometry_only_when_asked(position_gradient, which):
    spec, field = _varied_field()
    spec = replace(spec, position_gradient=position_gradient)
    grid, geometry = make_ball()
    pipeline = RenderPipeline(FlexiCubes(grid), _split_sum(), spec, capacities=ROOM)
    light = EnvLight(jnp.ones((4, 8, 3)))

    @jax.jit
    @jax.grad
    def pull(geometry):
        params = Params(geometry, field, light, jnp.asarray(0.0))
        attributes = pipeline.reconstruct(params).attributes
        return sum(map(jnp.sum, jax.tree.leaves(getattr(attributes, which))))

    gradient = pull(geometry)
    is_pulled = [bool(np.any(np.asarray(leaf))) for leaf in (gradient.sdf, gradient.deform)]
    assert is_pulled == [position_gradient, position_gradient]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_lists_carry_no_gradient_from_any_of_their_inputs():
    """Lists are integers; values that are gathered through them still have their gradient."""

    def through(scale):
        footprints = Footprints(
            means2d=jnp.full((2, 2), 1.5) * scale,
            covariances2d=jnp.ones((2, 3)) * scale,
            conics=jnp.ones((2, 3)),
            depths=jnp.array([2.0, 1.0]) * scale,
            compensation=jnp.ones((2,)),
            is_in_front=jnp.ones((2,), bool),
        )
        lists = find_visible(
            footprints,
            jnp.full((2,), 0.5) * scale,
            jnp.ones((2,), bool),
            height=4,
            width=4,
            tile_size=4,
            capacities=SMALL,
        )
        values = gather_visible(lists.index, jnp.array([3.0, 5.0]))
        return values[0] + lists.index[0].astype(values.dtype)

    value, slope = jax.jit(jax.value_and_grad(through))(1.0)
    assert slope == 0
    assert value == 6.0  # the nearer row, 1, with value 5


def test_random_picks_move_with_the_count_and_carry_no_gradient():
    """The picks are sampled directions of a lobe, and points where smoothness is measured."""
    uniforms = jnp.array([[0.3, 0.4, 0.6]])

    def drawn(cosine):
        return jnp.sum(bsdf.sample(material(), up(), direction_at(cosine), uniforms))

    assert jax.grad(drawn)(0.5) == 0
    assert float(drawn(jnp.asarray(0.5)) - drawn(jnp.asarray(0.6))) != 0
    spec, field = _varied_field()
    box = Box(jnp.zeros(3), jnp.asarray(2.0))

    @partial(jax.jit, static_argnums=1)
    @jax.grad
    def slope(shift, position_gradient):
        points = jax.random.uniform(jax.random.key(3), (16, 3), jnp.float64) + shift
        mask, key = jnp.ones((16,), bool), jax.random.key(2)
        field_spec = replace(spec, position_gradient=position_gradient)
        return sum(smoothness(field, points, mask, key, box, spec=field_spec))

    assert slope(0.0, False) == 0
    assert slope(0.0, True) != 0
