"""Points without a derivative: surface, splats, fields and the loss's absolute values.

The gradient that the code returns at these points is compared with one-sided differences on both
sides. The points are listed in `docs/gradients.md`.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_sided import (
    GRID,
    STEP,
    TOLERANCE,
    assert_kink,
    assert_smooth_at,
    make_ball,
    one_sided,
)
from support import double_precision

from geosplat_jax.adapter import (
    AdapterConstants,
    face_splats,
    shift_inwards,
    vertex_splats,
)
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.mesh import face_normals_and_areas
from geosplat_jax.core.rotation import axes_to_quaternion, frame_from_normal, quaternion_to_matrix
from geosplat_jax.core.types import Box, Grid, Mesh
from geosplat_jax.geometry import (
    _SDF_EPSILON,
    _crossing_fraction,
    _deviations,
    isosurface,
    sdf_entropy,
    vertex_normals,
    weight_magnitude,
)
from geosplat_jax.hashgrid import apply_mlp, encode
from geosplat_jax.losses import image_l1, light_error, over_background
from geosplat_jax.materials import MaterialSpec, init_materials, smoothness, to_unit_cube
from geosplat_jax.splats.projection import project

AT_ZERO_OF_ABS = 0.0
"""Slope of `numerics.absolute` at 0, between those of both sides; JAX returns that of the right."""

ROOM = Capacities(surface_cubes=256, dual_vertices=256, quads=256)


@pytest.fixture(autouse=True)
def _double():
    with double_precision():
        yield


# Isosurface: topology and absolute values


@partial(jax.jit, static_argnames=("shape", "training"))
@partial(jax.value_and_grad, has_aux=True)
def _area(geometry, origin, cell, *, shape, training):
    grid = Grid(origin, cell, shape)
    surface = isosurface(geometry, grid, capacities=ROOM, training=training)
    _, area = face_normals_and_areas(surface.mesh)
    return jnp.sum(area), surface


class _Varied:
    """The area of the surface as a function of one entry of the geometry."""

    def __init__(self, grid, geometry, name, entry, *, training):
        self.grid, self.geometry, self.name, self.entry = grid, geometry, name, entry
        self.training = training

    def _at(self, value):
        array = getattr(self.geometry, self.name).at[self.entry].set(value)
        geometry = replace(self.geometry, **{self.name: array})
        placement = (self.grid.origin, self.grid.cell_size)
        return _area(geometry, *placement, shape=self.grid.shape, training=self.training)

    def area(self, value):
        return float(self._at(value)[0][0])

    def surface(self, value):
        return self._at(value)[0][1]

    def slope(self, value):
        return float(getattr(self._at(value)[1], self.name)[self.entry])


def _largest_gap(first, second):
    """Largest distance from a vertex of one mesh to the nearest of the other."""
    a, b = (np.asarray(m.vertices[: int(m.vertex_count)]) for m in (first, second))
    distance = np.sqrt(np.sum((a[:, None] - b[None]) ** 2, axis=-1))
    return max(distance.min(axis=0).max(), distance.min(axis=1).max())


def test_where_a_vertex_changes_sign_the_surface_jumps_by_less_than_a_cell():
    grid, geometry = make_ball()
    inside = np.flatnonzero(np.asarray(geometry.sdf) < 0)
    vertex = int(inside[np.argmax(np.asarray(geometry.sdf)[inside])])
    varied = _Varied(grid, geometry, "sdf", vertex, training=True)
    below, on, above = (varied.surface(v) for v in (-1e-9, 0.0, 1e-9))
    # Zero counts as outside, so at zero the surface is that of the outer side.
    np.testing.assert_array_equal(on.mesh.faces, above.mesh.faces)
    np.testing.assert_allclose(on.mesh.vertices, above.mesh.vertices, atol=1e-8)
    jump = varied.area(0.0) - varied.area(-1e-9)
    assert 1e-4 < abs(jump) < 6 * float(grid.cell_size) ** 2
    assert 0.05 < _largest_gap(below.mesh, on.mesh) / float(grid.cell_size) < 1.0
    # The gradient ignores the jump: it is the slope on the side of the point itself.
    for value, side in ((-1e-3, -1), (-1e-3, 1), (1e-3, -1), (1e-3, 1), (0.0, 1)):
        numeric_slope = one_sided(varied.area, value, side * STEP)
        np.testing.assert_allclose(varied.slope(value), numeric_slope, rtol=1e-4, atol=1e-6)
    assert varied.slope(0.0) != 0


def test_an_edge_without_size_is_cut_in_the_middle_and_does_not_pull():
    crosses = jnp.ones((12, 1), bool)

    def fraction(size):
        lower = jnp.full((12, 1), -1.0) * size
        return jnp.sum(_crossing_fraction(lower, jnp.full((12, 1), 1 / 3) * size, crosses)) / 12

    def by_upper(upper):
        lower = jnp.full((12, 1), -_SDF_EPSILON * 1.01)
        return jnp.sum(_crossing_fraction(lower, jnp.broadcast_to(upper, (12, 1)), crosses)) / 12

    assert fraction(_SDF_EPSILON * 1.01) == pytest.approx(0.75)
    assert fraction(_SDF_EPSILON) == fraction(_SDF_EPSILON * 0.99) == 0.5
    for size in (1.0, 0.99):
        slope = jax.grad(lambda s: fraction(s * _SDF_EPSILON))(jnp.asarray(size))
        assert slope == 0
    # Just above the threshold the slope is the true one, of order 1 / |sdf|.
    upper = jnp.asarray(_SDF_EPSILON / 3)
    numeric_slope = one_sided(by_upper, upper, 1e-6 * _SDF_EPSILON)
    np.testing.assert_allclose(jax.grad(by_upper)(upper), numeric_slope, rtol=1e-4)
    assert abs(numeric_slope) > 1e11


def test_the_choice_of_a_diagonal_jumps_and_has_no_gradient():
    grid, geometry = make_ball()
    cell = int(_Varied(grid, geometry, "sdf", 0, training=False).surface(1.0).vertex_cells[3])
    varied = _Varied(grid, geometry, "gamma", cell, training=False)
    # All weights start equal, so every quad is at the tie between its diagonals.
    assert not np.any(geometry.gamma)
    less, tie, more = (varied.surface(v).mesh for v in (-1e-9, 0.0, 1e-9))
    np.testing.assert_array_equal(less.vertices, tie.vertices)
    np.testing.assert_array_equal(more.vertices, tie.vertices)
    less, tie, more = (np.asarray(mesh.faces) for mesh in (less, tie, more))
    assert np.any(less != more)
    assert np.all(np.all(tie == less, axis=1) | np.all(tie == more, axis=1))
    assert abs(varied.area(1e-9) - varied.area(-1e-9)) > 1e-6
    assert varied.slope(0.0) == 0
    for value in (-1e-3, 1e-3):
        assert varied.slope(value) == one_sided(varied.area, value, np.copysign(STEP, value)) == 0
    # In training, the centre of a quad blends both diagonals, and gamma has its slope at the tie.
    blended = _Varied(grid, geometry, "gamma", cell, training=True)
    for side in (-STEP, STEP):
        numeric_slope = one_sided(blended.area, 0.0, side)
        np.testing.assert_allclose(blended.slope(0.0), numeric_slope, rtol=1e-2)
    assert blended.slope(0.0) != 0


def test_deviation_of_equal_lengths_has_a_gradient_between_its_slopes():
    crosses = jnp.zeros((12, 1), bool).at[:3].set(True)
    offsets = jnp.zeros((3, 12, 1)).at[:, :3, 0].set(jnp.eye(3))

    def deviation(change):
        return jnp.sum(_deviations(offsets.at[0, 0, 0].add(change), crosses))

    assert deviation(0.0) == 0
    # In compiled code the mean of three ones is one up to rounding, and the slope of each length
    # has the sign of that rounding.
    assert_kink(deviation, 0.0, left=-4 / 3, right=4 / 3, returned="between")


def test_raw_weights_start_on_the_kink_of_their_magnitude():
    grid, geometry = make_ball()
    count = geometry.alpha.size + geometry.beta.size
    assert weight_magnitude(geometry) == 0
    gradient = jax.grad(weight_magnitude)(geometry)
    for leaf in (gradient.alpha, gradient.beta):
        np.testing.assert_allclose(count * leaf, AT_ZERO_OF_ABS)
    np.testing.assert_array_equal(gradient.gamma, 0.0)  # the magnitude excludes gamma

    def magnitude(value):
        moved_geometry = replace(geometry, beta=geometry.beta.at[3, 2].set(value))
        return count * weight_magnitude(moved_geometry)

    assert_kink(magnitude, 0.0, left=-1.0, right=1.0, returned=AT_ZERO_OF_ABS)


def test_entropy_jumps_where_a_vertex_changes_sign_and_is_smooth_beside():
    grid, geometry = make_ball()
    inside = np.flatnonzero(np.asarray(geometry.sdf) < 0)
    vertex = int(inside[np.argmax(np.asarray(geometry.sdf)[inside])])

    @jax.jit
    def entropy(value):
        moved_geometry = replace(geometry, sdf=geometry.sdf.at[vertex].set(value))
        return sdf_entropy(moved_geometry, grid, reduction="sum")

    # The sum has one term per crossed edge, so it jumps with their number.
    assert abs(float(entropy(0.0) - entropy(-1e-9))) > 0.1
    assert entropy(0.0) == pytest.approx(float(entropy(1e-9)), abs=1e-8)
    assert_smooth_at(entropy, [-1e-3, 1e-3])
    right = one_sided(entropy, jnp.asarray(0.0), STEP)
    np.testing.assert_allclose(jax.grad(entropy)(0.0), right, rtol=TOLERANCE)


# Adapter


def _triangle(height):
    """One triangle of base 1 whose height may be zero or negative."""
    vertices = jnp.zeros((3, 3)).at[1, 0].set(1.0).at[2, 0].set(0.3).at[2, 1].set(height)
    return Mesh(vertices, jnp.array([[0, 1, 2]], jnp.int32), jnp.int32(3), jnp.int32(1))


def test_a_face_without_area_is_the_kink_of_its_area_and_has_no_gradient():
    def area(height):
        return face_normals_and_areas(_triangle(height))[1][0]

    assert_kink(area, 0.0, left=-0.5, right=0.5, returned=0.0)
    facing = jax.jit(lambda height: face_normals_and_areas(_triangle(height))[0][0, 2])
    normals = [facing(h) for h in (-1e-9, 0.0, 1e-9)]
    np.testing.assert_allclose(normals, [-1.0, 0.0, 1.0])

    @jax.jit
    def width(height):
        mesh = _triangle(height)
        constants = AdapterConstants()
        return face_splats(mesh, jnp.zeros((3, 3)).at[:, 2].set(1.0), constants=constants).scales[
            0, 1
        ]

    slope = one_sided(width, jnp.asarray(1e-3), STEP)
    assert_kink(width, 0.0, left=-slope, right=slope, returned=0.0)


def test_a_quaternion_may_change_its_sign_but_its_rotation_and_gradient_go_on():
    """About x, the formula changes at +-90 degrees, and at -90 the quaternion changes its sign."""

    def axes(angle):
        c, s, zero, one = jnp.cos(angle), jnp.sin(angle), 0 * angle, 0 * angle + 1
        return [jnp.stack(v) for v in ((one, zero, zero), (zero, c, s), (zero, -s, c))]

    def quaternion(angle):
        return axes_to_quaternion(*axes(angle))

    @jax.jit
    def rotation(angle):
        return quaternion_to_matrix(quaternion(angle))

    slope_of = jax.jit(jax.jacfwd(rotation))

    for angle, sign in ((-np.pi / 2, -1.0), (np.pi / 2, 1.0)):
        below, above = quaternion(jnp.asarray(angle - 1e-9)), quaternion(jnp.asarray(angle + 1e-9))
        np.testing.assert_allclose(above, sign * below, atol=1e-8)
        for turn in (-1e-9, 0.0, 1e-9):
            turned_angle = jnp.asarray(angle + turn)
            c, s = np.cos(angle + turn), np.sin(angle + turn)
            expected = [[1, 0, 0], [0, c, -s], [0, s, c]]
            slope = [[0, 0, 0], [0, -s, -c], [0, c, -s]]
            np.testing.assert_allclose(rotation(turned_angle), expected, atol=1e-12)
            np.testing.assert_allclose(slope_of(turned_angle), slope, atol=1e-12)


def test_the_tangent_frame_of_a_round_splat_jumps_and_its_image_does_not():
    def normal_at(tilt):
        cosine = jnp.sqrt(1 - tilt**2)
        return jnp.stack([0.6 * cosine, 0.8 * cosine, tilt])

    below, above = (frame_from_normal(normal_at(jnp.asarray(t)))[0] for t in (-1e-9, 1e-9))
    assert float(jnp.sum(below * above)) < 0.5
    scales = jnp.array([[0.3, 0.3, 0.02]])
    faces = jnp.array([[0, 1, 2]], jnp.int32)

    @jax.jit
    def conic(tilt):
        normals = jnp.broadcast_to(normal_at(tilt), (3, 3))
        mesh = Mesh(jnp.eye(3), faces, jnp.int32(3), jnp.int32(1))
        quats = vertex_splats(mesh, normals, constants=AdapterConstants()).quats[:1]
        footprints = project(
            jnp.zeros((1, 3)),
            quats,
            scales,
            world_to_camera=jnp.eye(4).at[2, 3].set(2.0).at[0, 3].set(0.3),
            intrinsics=jnp.diag(jnp.array([20.0, 20.0, 1.0])),
            height=16,
            width=16,
        )
        return jnp.concatenate([footprints.conics[0], footprints.compensation])

    conics = [conic(jnp.asarray(t)) for t in (-1e-9, 0.0, 1e-9)]
    np.testing.assert_allclose(conics[0], conics[1], atol=1e-7)
    np.testing.assert_allclose(conics[2], conics[1], atol=1e-7)
    slope = jax.jit(jax.jacfwd(conic))
    slopes = [slope(jnp.asarray(t)) for t in (-1e-9, 0.0, 1e-9)]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(slopes[2], slopes[1], rtol=1e-6, atol=1e-7)


# Hash grid and heads


def _feature(table, y=0.3, z=0.4):
    def feature(x):
        point = jnp.stack([x, 0 * x + y, 0 * x + z])[None]
        return encode(table, point, spec=GRID, position_gradient=True)[0, 0]

    return jax.jit(feature)


def test_a_border_of_hash_cells_is_a_kink_whose_gradient_is_that_of_the_upper_cell():
    table = jax.random.normal(jax.random.key(0), (GRID.total_entries, 2))
    feature = _feature(table)
    for border in (0.25, 0.5, 0.75):
        left, right = (float(jax.grad(feature)(border + s)) for s in (-0.1, 0.1))
        assert_kink(feature, border, left=left, right=right, returned="right")


def test_the_ends_of_the_hash_grid_have_the_inner_gradient_and_beyond_it_none():
    feature = _feature(jax.random.normal(jax.random.key(0), (GRID.total_entries, 2)))
    first, last = (float(jax.grad(feature)(x)) for x in (0.1, 0.9))
    assert_kink(feature, 0.0, left=0.0, right=first, returned="right")
    assert_kink(feature, 1.0, left=last, right=0.0, returned="left")
    assert jax.grad(feature)(-0.1) == jax.grad(feature)(1.1) == 0


def unit_box():
    return Box(jnp.zeros(3), jnp.asarray(1.0))


def test_the_faces_of_the_unit_cube_pass_half_the_gradient():
    def local(x):
        return to_unit_cube(jnp.stack([x, x, x])[None], unit_box())[0, 0]

    assert_kink(local, 1.0, left=0.5, right=0.0, returned="mean")
    assert_kink(local, -1.0, left=0.0, right=0.5, returned="mean")


def test_a_rectifier_at_zero_passes_nothing():
    field = init_materials(jax.random.key(0), MaterialSpec(grid=GRID, albedo_hidden=(4,)))
    head = jax.tree.map(lambda x: x.astype(jnp.float64), field.albedo_head)
    direction = jnp.array([1.0, 0.5])

    def output(x):
        return apply_mlp(head, (x * direction)[None])[0, 0]

    left, right = (one_sided(output, jnp.asarray(0.0), s) for s in (-STEP, STEP))
    assert_kink(output, 0.0, left=left, right=right, returned=0.0)
    assert_smooth_at(output, [-1e-3, 1e-3])


# Absolute values of the loss


def test_pixels_that_agree_stand_on_the_kink_of_l1():
    image = jnp.full((1, 12, 12, 4), 0.5).at[..., 3].set(1.0)
    rgb, alpha = image[..., :3], image[..., 3]

    @jax.jit
    def l1(change):
        moved_rgb = rgb.at[0, 3, 4, 1].add(change)
        images = over_background(moved_rgb, alpha, image, jnp.zeros_like(rgb), None, srgb=False)
        return rgb.size * image_l1(images)

    assert l1(0.0) == 0
    assert_kink(l1, 0.0, left=-1.0, right=1.0, returned=AT_ZERO_OF_ABS)


def test_light_equal_to_the_value_of_the_image_stands_on_a_kink():
    image = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (1, 2, 2, 4))
    diffuse = jnp.zeros((1, 2, 2, 3))

    def term(change):
        moved_diffuse = diffuse.at[0, 0, 1, 2].add(change)
        return 12 * light_error(moved_diffuse, 0 * diffuse, jnp.asarray(0.0), image)

    assert term(0.0) == 0
    assert jax.grad(term)(0.0) == AT_ZERO_OF_ABS
    # In compiled code the tone map of black is black up to rounding, and the slope has the sign of
    # that rounding.
    assert_kink(term, 0.0, left=-1.0, right=1.0, returned="between")


def test_smoothness_of_equal_attributes_has_no_gradient_between_its_slopes():
    spec = MaterialSpec(grid=GRID, albedo_hidden=(4,), surface_hidden=(4,), shared=True)
    field = jax.tree.map(lambda x: x.astype(jnp.float64), init_materials(jax.random.key(0), spec))
    empty_field = replace(field, albedo_table=jnp.zeros_like(field.albedo_table))
    points = jax.random.uniform(jax.random.key(1), (16, 3), jnp.float64)

    @jax.jit
    def term(change):
        # The features form a ramp over the rows of the table, so that neighbours differ.
        ramp = jnp.arange(empty_field.albedo_table.shape[0]) / empty_field.albedo_table.shape[0]
        moved_field = replace(empty_field, albedo_table=change * jnp.stack([ramp, ramp], axis=-1))
        mask, key, box = jnp.ones((16,), bool), jax.random.key(2), unit_box()
        return sum(smoothness(moved_field, points, mask, key, box, spec=spec, std=0.1))

    assert term(0.0) == 0
    # Features of zero are also at the kinks of the rectifiers, which pass no gradient.
    assert jax.grad(term)(0.0) == 0
    left, right = (one_sided(term, jnp.asarray(0.0), s) for s in (-1e-6, 1e-6))
    assert left < -1e-3 < 1e-3 < right


def test_the_inward_shift_pulls_through_its_share_and_not_through_the_face():
    grid, geometry = make_ball()
    mesh = _Varied(grid, geometry, "sdf", 0, training=True).surface(1.0).mesh
    splats = jax.jit(partial(face_splats, constants=AdapterConstants()))(mesh, vertex_normals(mesh))
    fraction = jnp.full((splats.means.shape[0],), 0.5)

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def moved(vertices, fraction):
        shifted = shift_inwards(splats, replace(mesh, vertices=vertices), fraction)
        return jnp.sum(shifted.means**2)

    value, (by_vertices, by_fraction) = moved(mesh.vertices, fraction)
    assert not np.any(by_vertices)
    assert np.any(by_fraction)
    # The true gradient is not zero, since the value depends on the area and on the normal.
    assert float(moved(1.1 * mesh.vertices, fraction)[0] - value) != 0
    assert float(moved(mesh.vertices[:, ::-1], fraction)[0] - value) != 0
