"""Free splats: they start as those of the mesh, then train on their own, resume and render."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import TWO_STAGES, ball, sphere_dataset, tiny_config

from geosplat_jax.core.types import Box
from geosplat_jax.fit.begin import Resume, TakeOver
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.stages import begin_stage, build_pipeline
from geosplat_jax.fit.train import fit, load_trained
from geosplat_jax.refinement import FreeSplats, FreeSplatSettings, free, possible_metal
from geosplat_jax.render import RenderPipeline
from geosplat_jax.report.assets import MaterialSampler
from geosplat_jax.report.renderer import Renderer

REFINE = (
    *TWO_STAGES,
    "stages.monte_carlo.steps=1",
    "stages.refine.steps=3",
    "stages.refine.batch_views=1",
    "stages.refine.transport.light_count=1",
    "stages.refine.transport.diffuse_count=1",
    "stages.refine.transport.specular_count=1",
    "stages.refine.transport.residual_count=0",
    "run.checkpoint_every=1",
)
"""A run of three stages, small enough for a test."""

build = jax.jit(RenderPipeline.reconstruct)


@pytest.fixture(scope="module")
def start():
    """Pipelines of a ball before and in refinement, and the initial parameters of the latter."""
    config = tiny_config("stages.refine.steps=3")
    pipeline, params = ball(config)
    mesh_asset = build(pipeline, params)
    stage = config.stage("refine")
    refine_pipeline = replace(
        build_pipeline(config, stage, pipeline.surface), capacities=pipeline.capacities
    )
    return mesh_asset, refine_pipeline, begin_stage(params, pipeline, config, stage)


def test_free_splats_begin_as_the_splats_of_the_mesh(start):
    mesh_asset, refine_pipeline, params = start
    refined_asset = build(refine_pipeline, params)
    is_real = np.asarray(mesh_asset.splats.mask)
    assert is_real.sum() > 500
    for name in ("means", "scales", "opacities", "normals", "outward", "anchors", "parents"):
        expected, actual = (
            np.asarray(getattr(a.splats, name)) for a in (mesh_asset, refined_asset)
        )
        np.testing.assert_allclose(actual[is_real], expected[is_real], atol=2e-6, err_msg=name)
    quats = [np.asarray(a.splats.quats)[is_real] for a in (mesh_asset, refined_asset)]
    np.testing.assert_allclose(np.abs(np.sum(quats[0] * quats[1], axis=1)), 1.0, atol=1e-6)
    np.testing.assert_array_equal(refined_asset.splats.mask, is_real)
    for a, b in zip(
        jax.tree.leaves(refined_asset.attributes.materials),
        jax.tree.leaves(mesh_asset.attributes.materials),
        strict=True,
    ):
        np.testing.assert_allclose(np.asarray(a)[is_real], np.asarray(b)[is_real], atol=1e-5)


def test_parameters_are_counted_in_half_sides_of_the_box(start):
    """The box of other tests has a half side of about one, which would hide a wrong unit."""
    splats, half_extent = start[0].splats, 2.5
    center = np.array([1.0, 2.0, 3.0])
    box = Box(jnp.asarray(center, jnp.float32), jnp.float32(half_extent))
    free_splats, is_real = free(splats, start[0].attributes, box), np.asarray(splats.mask)
    means, scales = (np.asarray(x)[is_real] for x in (splats.means, splats.scales))
    np.testing.assert_allclose(
        free_splats.means[is_real], (means - center) / half_extent, atol=1e-6
    )
    np.testing.assert_allclose(
        np.exp(free_splats.log_scales)[is_real], scales / half_extent, rtol=1e-4
    )


def test_a_splat_that_moves_along_its_face_takes_its_anchor_with_it(start):
    """A move along the normal leaves the anchor in place; a move within the face moves it too."""
    _, refine_pipeline, params = start
    asset = build(refine_pipeline, params)
    half_extent = float(refine_pipeline.surface.box.half_extent)
    shift = 0.01 * np.asarray(asset.splats.outward)
    moved_splats = replace(
        params.splats, means=params.splats.means + jnp.asarray(shift) / half_extent
    )
    lifted_asset = build(refine_pipeline, replace(params, splats=moved_splats))
    is_real = np.asarray(asset.splats.mask)
    np.testing.assert_allclose(lifted_asset.splats.anchors, asset.splats.anchors, atol=1e-6)
    displacements = np.asarray(lifted_asset.splats.means - asset.splats.means)
    np.testing.assert_allclose(displacements[is_real], shift[is_real], atol=1e-6)
    # A splat that moves a tenth of the way to the middle of its face is still on the face.
    faces = np.asarray(asset.mesh.faces)[np.asarray(asset.splats.parents)]
    middles = np.asarray(asset.mesh.vertices, float)[faces].mean(axis=1)
    anchors = np.asarray(asset.splats.anchors, float)
    tangential_shift = 0.1 * (middles - anchors)
    moved_splats = replace(
        params.splats,
        means=params.splats.means + jnp.asarray(tangential_shift / half_extent, jnp.float32),
    )
    followed_asset = build(refine_pipeline, replace(params, splats=moved_splats))
    displacements = np.asarray(followed_asset.splats.anchors) - anchors
    assert np.median(np.linalg.norm(tangential_shift[is_real], axis=1)) > 1e-4
    np.testing.assert_allclose(displacements[is_real], tangential_shift[is_real], atol=2e-6)


def test_a_splat_that_leaves_its_face_is_shaded_on_it(start):
    """Beyond an edge of the face, its plane may lie behind another face."""
    _, refine_pipeline, params = start
    rng = np.random.default_rng(3)
    moves = jnp.asarray(rng.normal(scale=0.05, size=params.splats.means.shape), jnp.float32)
    moved_splats = replace(params.splats, means=params.splats.means + moves)
    asset = build(refine_pipeline, replace(params, splats=moved_splats))
    is_real = np.asarray(asset.splats.mask)
    faces = np.asarray(asset.mesh.faces)[np.asarray(asset.splats.parents)[is_real]]
    corners = np.asarray(asset.mesh.vertices, float)[faces]
    means, anchors = (
        np.asarray(x, float)[is_real] for x in (asset.splats.means, asset.splats.anchors)
    )
    closest_points = trimesh.triangles.closest_point(corners, means)
    face_sizes = np.max(
        np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2), axis=1
    )
    assert np.all(np.linalg.norm(anchors - closest_points, axis=1) < 0.03 * face_sizes + 1e-6)
    has_area = face_sizes > 1e-3
    barycentrics = trimesh.triangles.points_to_barycentric(corners[has_area], anchors[has_area])
    assert np.min(barycentrics) > 1e-3
    assert np.mean(np.min(barycentrics, axis=1) < 0.01) > 0.3  # many had left their face


def test_padding_is_inert(start):
    _, refine_pipeline, params = start
    arbitrary_splats = jax.tree.map(lambda x: jnp.full_like(x, 7.0), params.splats)
    splats = build(refine_pipeline, replace(params, splats=arbitrary_splats)).splats
    padding = ~np.asarray(splats.mask)
    assert padding.sum() > 10
    np.testing.assert_array_equal(np.asarray(splats.opacities)[padding], 0.0)
    np.testing.assert_array_equal(np.asarray(splats.scales)[padding], 1.0)
    np.testing.assert_array_equal(np.asarray(splats.quats)[padding, 0], 1.0)


def test_albedo_beyond_its_range_is_shown_at_the_border_and_finds_back(start):
    _, refine_pipeline, params = start
    _, attributes = jax.jit(lambda p: (None, refine_pipeline.reconstruct(p).attributes))(params)

    def dressed(albedo):
        splats = replace(params.splats, albedo=albedo)
        return FreeSplats().dress(attributes, splats).materials.albedo

    albedo = jnp.full_like(params.splats.albedo, 1.4)
    np.testing.assert_allclose(dressed(albedo), 0.99)
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(dressed(x)))(albedo), 1.0)


def test_what_is_darker_than_metals_are_is_none():
    grey = np.array([0.0, 0.05, 0.1, 0.125, 0.15, 0.2, 0.7])[:, None] * [0.5, 1.0, 0.2]
    albedo = jnp.asarray(grey, jnp.float32)
    np.testing.assert_allclose(possible_metal(albedo, 0.2), [0, 0, 0, 5 / 32, 0.5, 1, 1], atol=1e-6)
    np.testing.assert_array_equal(possible_metal(albedo, 0.0), 1.0)
    np.testing.assert_array_equal(jax.grad(lambda x: possible_metal(x, 0.2).sum())(albedo), 0.0)


def test_a_dark_splat_is_no_metal_whatever_the_field_says(start):
    _, refine_pipeline, params = start
    assert refine_pipeline.splats == FreeSplats(0.2)
    is_dark = jnp.arange(params.splats.albedo.shape[0]) % 2 == 0
    albedo = jnp.where(is_dark[:, None], 0.05, params.splats.albedo)
    params = replace(params, splats=replace(params.splats, albedo=albedo))
    unlimited_pipeline = replace(refine_pipeline, splats=FreeSplats())
    limited_materials, unlimited_materials = (
        build(p, params).attributes.materials for p in (refine_pipeline, unlimited_pipeline)
    )
    np.testing.assert_array_equal(
        limited_materials.metallic, jnp.where(is_dark, 0.0, unlimited_materials.metallic)
    )
    assert float(jnp.min(unlimited_materials.metallic)) > 0
    np.testing.assert_array_equal(limited_materials.albedo, unlimited_materials.albedo)
    np.testing.assert_array_equal(limited_materials.roughness, unlimited_materials.roughness)


def test_opaque_splats_get_finite_logits(start):
    mesh_asset, refine_pipeline, _ = start
    opaque_splats = replace(mesh_asset.splats, opacities=jnp.ones_like(mesh_asset.splats.opacities))
    logits = free(opaque_splats, mesh_asset.attributes, refine_pipeline.surface.box).opacity_logits
    assert bool(jnp.all(jnp.isfinite(logits)))
    np.testing.assert_allclose(jax.nn.sigmoid(logits), 1.0, atol=2e-4)


def test_splats_of_vertices_cannot_be_freed(start):
    mesh_asset, refine_pipeline, _ = start
    partial_splats = jax.tree.map(lambda x: x[:7] if x.ndim else x, mesh_asset.splats)
    with pytest.raises(ValueError, match="six splats of every face"):
        FreeSplatSettings().begin(
            lambda: (partial_splats, mesh_asset.attributes), refine_pipeline.surface.box
        )


def test_splats_of_vertices_in_the_stage_before_are_refused_at_once():
    with pytest.raises(ValueError, match=r"stages\.monte_carlo\.splats: free splats"):
        make_config(overrides=('stages.monte_carlo.splats={kind="vertex"}',))
    make_config(overrides=('stages.split_sum.splats={kind="vertex"}',))
    make_config(overrides=('stages.monte_carlo.splats={kind="disc"}',))


def test_a_surface_that_moves_is_refused():
    with pytest.raises(ValueError, match=r"stages.refine.rates.deform to 0"):
        make_config(overrides=("stages.refine.steps=1", "stages.refine.rates.deform=0.1"))
    with pytest.raises(ValueError, match="need a stage before"):
        make_config(overrides=("stages.split_sum.splats.kind=free",))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An uninterrupted run of three stages, and one that was stopped in the last and resumed."""
    dataset, config = sphere_dataset(), tiny_config(*REFINE)
    whole_folder, parted_folder = (
        tmp_path_factory.mktemp(name) / "run" for name in ("whole", "parted")
    )
    state = fit(dataset, config, whole_folder)
    first_state = fit(
        dataset, config, parted_folder, begin=TakeOver(whole_folder, "refine"), stop_after=5
    )
    resumed_state = fit(dataset, config, parted_folder, begin=Resume())
    return dataset, whole_folder, (first_state, state, resumed_state)


def test_the_stage_resumes_bit_for_bit(run):
    _, _, (_, state, resumed_state) = run
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(resumed_state), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_mesh_stays_and_all_that_splats_have_moves(run):
    _, folder, (first_state, last_state, _) = run
    trained_before = load_trained(folder, stage="monte_carlo")
    assert trained_before.params.splats is None
    for a, b in zip(
        jax.tree.leaves(last_state.params.geometry),
        jax.tree.leaves(trained_before.params.geometry),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    for name, value in vars(last_state.params.splats).items():
        largest_change = np.max(
            np.abs(np.asarray(value - getattr(first_state.params.splats, name)))
        )
        assert 0 < largest_change < 0.5, name


@pytest.mark.slow
def test_refined_splats_are_rendered_and_relit(run):
    dataset, folder, _ = run
    trained = load_trained(folder)
    assert trained.stage.name == "refine"
    # Some places are too dark for a metal.
    is_dark = trained.params.splats.means[:, :1] > 0
    splats = trained.params.splats
    splats = replace(splats, albedo=jnp.where(is_dark, 0.05, splats.albedo))
    trained = replace(trained, params=replace(trained.params, splats=splats))
    renderer = Renderer.of(trained, samples=8)
    image = renderer(dataset.train.camera([0]))
    assert image.alpha.max() > 0.9
    assert np.all(np.isfinite(image.rgb))
    # Textures are baked from the materials that the splats have learned.
    asset = renderer.asset()
    count = int(asset.splats.count)
    anchors = np.asarray(asset.splats.anchors)[:count]
    albedo, roughness, metallic = MaterialSampler(trained, asset)(anchors)
    materials = asset.attributes.materials
    np.testing.assert_allclose(albedo, np.asarray(materials.albedo)[:count], atol=1e-3)
    np.testing.assert_allclose(roughness, np.asarray(materials.roughness)[:count], atol=1e-4)
    np.testing.assert_allclose(metallic, np.asarray(materials.metallic)[:count], atol=1e-3)
    assert 0.1 < np.mean(metallic < 1e-3) < 0.9
    field_albedo = MaterialSampler(
        replace(trained, params=replace(trained.params, splats=None)), asset
    )(anchors)[0]
    assert np.abs(albedo - field_albedo).max() > 1e-3
    relit = renderer.relit(trained.params.light)(dataset.train.camera([0]))
    assert np.all(np.isfinite(relit.rgb))
    assert relit.rgb.max() > 0
