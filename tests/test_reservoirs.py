"""Reservoirs: means equal brute force with every kind of reuse, and known faults are detected."""

from dataclasses import replace
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import MONTE_CARLO as TRAINED
from support import sphere_dataset, tiny_config

from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.train import fit
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import reservoirs
from geosplat_jax.transport.environment import LightSpec, light_directions, texel_solid_angles
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.reservoirs import (
    ReservoirSettings,
    empty_store,
    resample,
    store_reservoirs,
)
from geosplat_jax.transport.sampling import OPEN, cast

KINDS, COPIES, COUNT = 4, 3000, 2
POINTS = KINDS * COPIES
STEPS, GROUPS = 4, 100  # copies in a group may share samples, groups hardly do
STANDARD_ERRORS = 5.0  # exceeded by chance in 6 of ten million comparisons
ROWS = 4

# Normals and x coordinates of four points that share a place; the normals are up to 80 degrees
# apart.
NORMALS = np.array([[0, 0, 1], [0.64, 0, 0.77], [-0.64, 0, 0.77], [0, 0.5, 0.866]])
PLACES = np.array([0.0, 0.35, -0.35, 0.1])


class Wall(RayIndex):
    """Directions whose x exceeds that of their start are blocked; places are chosen by hand."""

    usage: dict = eqx.field(default_factory=dict)

    @property
    def face_capacity(self):
        return POINTS

    @property
    def place_size(self):
        return jnp.float32(2.0)

    def places(self, positions, faces):
        return faces // KINDS

    def nearest(self, origins, directions, source, mask, *, two_sided=False):
        is_hit = self.occluded(origins, directions, source, mask)
        return jnp.where(is_hit, 1.0, jnp.inf), jnp.where(is_hit, 0, -1)

    def occluded(self, origins, directions, source, mask, *, two_sided=False):
        return mask & (directions[:, 0] > origins[:, 0])


def scene():
    """Copies of four points, one after the other; their own faces never block light."""
    normals = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)
    positions = np.zeros((KINDS, 3))
    positions[:, 0] = PLACES
    tiled = [np.tile(x, (COPIES, 1)) for x in (positions, normals)]
    positions, normals = (jnp.asarray(x, jnp.float32) for x in tiled)
    faces = jnp.arange(POINTS, dtype=jnp.int32)
    return SurfacePoints(positions, normals, normals, faces, jnp.ones(POINTS, bool))


def sky():
    """A dim map with some bright texels."""
    texels = np.random.default_rng(3).uniform(0, 1, (ROWS, 2 * ROWS, 3))
    return EnvLight(jnp.asarray(0.2 + 3 * texels**4, jnp.float32))


@lru_cache
def truth():
    """Irradiance / pi in green of the kinds of points, behind the wall."""
    points = scene()
    return irradiance(np.asarray(points.normals[:KINDS], float), PLACES)


def irradiance(normals, largest_x):
    """Irradiance / pi in green by brute force: 40 x 40 bilinear lookups per texel."""
    row_count = 40 * ROWS
    directions = np.asarray(light_directions(row_count, 2 * row_count), float).reshape(-1, 3)
    solid_angles = np.asarray(texel_solid_angles(row_count, 2 * row_count), float)
    solid_angles = np.broadcast_to(solid_angles, (row_count, 2 * row_count)).reshape(-1)
    radiance = reservoirs.lookup(sky().radiance, jnp.asarray(directions, jnp.float32))
    green = np.asarray(radiance, float)[:, 1]
    values = []
    for normal, largest in zip(normals, largest_x, strict=True):
        cosine = np.maximum(directions @ normal, 0)
        is_open = directions[:, 0] <= largest
        values.append(np.sum(green * cosine * is_open * solid_angles) / np.pi)
    return np.array(values)


@partial(jax.jit, static_argnames=("spec",))
def one_step(key, store, spec):
    """Return the estimates of one step, (points,), and the store that it leaves."""
    points, light, index = scene(), sky(), Wall()
    sampler = light_sampler(light)
    samples = resample(key, points, light, sampler, index, store, spec=spec, count=COUNT)
    hits = cast(points, jnp.moveaxis(samples.directions, 1, 0), index).T
    if store is not None:
        store = store_reservoirs(store, points, samples, hits, index, spec=spec)
    radiance = reservoirs.lookup(light.radiance, samples.directions.reshape(-1, 3))[:, 1]
    cosine = jnp.sum(points.normals[:, None] * samples.directions, axis=-1)
    value = radiance.reshape(POINTS, COUNT) * jnp.maximum(cosine, 0.0) * samples.weights
    return jnp.mean(jnp.where(hits == OPEN, value, 0.0), axis=1) / jnp.pi, store


def errors(spec, seed=0):
    """Return the relative bias of each kind of point after some steps, and its standard error."""
    store = empty_store(spec, COUNT) if spec.reuse_steps else None
    for step in range(STEPS):
        key = jax.random.fold_in(jax.random.key(seed), step)
        estimates, store = one_step(key, store, spec)
    estimates = np.asarray(estimates, float).reshape(GROUPS, -1, KINDS).mean(axis=1)
    expected = truth()
    error = estimates.std(axis=0) / np.sqrt(GROUPS)
    return (estimates.mean(axis=0) - expected) / expected, error / expected


PLAIN = ReservoirSettings(candidates=4, slots=32_768)
REUSE = {
    "candidates alone": PLAIN,
    "steps": replace(PLAIN, reuse_steps=True),
    "steps and neighbours": replace(PLAIN, reuse_steps=True, neighbors=2),
    "both, shadows traced": replace(PLAIN, reuse_steps=True, neighbors=1, visibility="traced"),
}


@pytest.mark.parametrize(
    "how",
    [
        pytest.param("candidates alone", marks=pytest.mark.slow),
        pytest.param("steps", marks=pytest.mark.slow),
        "steps and neighbours",
        pytest.param("both, shadows traced", marks=pytest.mark.slow),
    ],
)
def test_the_mean_over_seeds_is_brute_force(how):
    bias, error = errors(REUSE[how])
    assert np.all(error < 0.03)
    assert np.all(np.abs(bias) <= STANDARD_ERRORS * error), (bias, error)


def test_which_neighbour_is_asked_does_not_decide_what_is_chosen():
    # Two groups of points in a row, so that the side of a neighbour tells its group. With one
    # sample of one neighbour, both choices take equally many random bits.
    group_size, keys = 12, 20_000
    normals = np.repeat([[0, 0, 1], [0.77, 0, 0.64]], group_size, axis=0)
    normals = jnp.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), jnp.float32)
    count, light, largest_x = 2 * group_size, sky(), 0.3  # no target function knows the wall
    faces = jnp.arange(count, dtype=jnp.int32)
    points = SurfacePoints(jnp.zeros_like(normals), normals, normals, faces, faces >= 0)
    sampler, spec = light_sampler(light), replace(PLAIN, candidates=2, neighbors=1)

    def estimate(key):
        samples = resample(key, points, light, sampler, None, None, spec=spec, count=1)
        radiance = reservoirs.lookup(light.radiance, samples.directions[:, 0])[:, 1]
        cosine = jnp.maximum(jnp.sum(normals * samples.directions[:, 0], axis=-1), 0.0)
        is_open = samples.directions[:, 0, 0] <= largest_x
        return jnp.where(is_open, radiance * cosine * samples.weights[:, 0] / jnp.pi, 0.0)

    random_keys = jax.random.split(jax.random.key(0), keys)
    estimates = jax.jit(lambda keys: jax.lax.map(estimate, keys, batch_size=500))(random_keys)
    estimates = np.asarray(estimates, float)
    expected = irradiance(np.asarray(normals, float), np.full(count, largest_x))
    error = estimates.std(axis=0) / np.sqrt(keys) / expected
    bias = estimates.mean(axis=0) / expected - 1
    assert np.all(error < 0.03)
    assert np.all(np.abs(bias) <= STANDARD_ERRORS * error), bias / error


@pytest.mark.slow
def test_assumed_visibility_is_biased_as_it_says():
    spec = replace(PLAIN, reuse_steps=True, neighbors=2, visibility="assumed")
    bias, error = errors(spec)
    assert np.min(bias / error) < -2 * STANDARD_ERRORS, (bias, error)


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param("shares by confidence alone", marks=pytest.mark.slow),
        "wrong number of candidates",
    ],
)
def test_a_fault_shows(monkeypatch, fault):
    jax.clear_caches()
    if fault == "shares by confidence alone":
        equal = lambda terms: jnp.full_like(terms[0], 1 / len(terms))  # noqa: E731
        monkeypatch.setattr(reservoirs, "_balance", equal)
        spec = REUSE["steps and neighbours"]
    else:
        original_own = reservoirs._own

        def faulty(*args):
            directions, weights = original_own(*args)
            return directions, weights * (PLAIN.candidates / (PLAIN.candidates - 1))

        monkeypatch.setattr(reservoirs, "_own", faulty)
        spec = PLAIN
    bias, error = errors(spec)
    jax.clear_caches()
    assert np.max(np.abs(bias) / error) > 2 * STANDARD_ERRORS, (bias, error)


MONTE_CARLO = MonteCarloSettings(
    light_count=2, diffuse_count=2, specular_count=2, indirect="constant"
)


@partial(jax.jit, static_argnames=("settings",))
def shaded(key, carry, settings):
    """Diffuse light, specular colour and carry of one step of a whole transport."""
    points, transport = scene(), settings.build(LightSpec())
    materials = Materials(jnp.full((POINTS, 3), 0.5), jnp.full(POINTS, 0.6), jnp.ones(POINTS))
    # Blocked directions have a radiance of sigmoid(2 - 3); the default would be sigmoid(0 - 3).
    attributes = Attributes(materials, None, jnp.full((POINTS, 6), 2.0))
    prepare_key, shade_key = jax.random.split(key)
    lights, carry = transport.prepare(prepare_key, points, attributes, sky(), Wall(), carry)
    wo = points.normals
    shading = transport.shade(shade_key, points, attributes, wo, lights, Wall())
    return shading.diffuse_light, shading.specular, carry


@pytest.mark.slow
def test_blocked_directions_are_counted_once_when_reservoirs_leave_them_out():
    """Both lobes, with light from blocked directions, agree with plain samples on average."""
    reservoir_settings = replace(REUSE["both, shadows traced"], neighbors=0)
    transport_settings = replace(MONTE_CARLO, reservoirs=reservoir_settings)
    plain_colours = shaded(jax.random.key(5), None, MONTE_CARLO)[:2]
    carry = transport_settings.build(LightSpec()).first_carry()
    for step in range(3):
        *reused_colours, carry = shaded(jax.random.key(step), carry, transport_settings)
    for plain_means, reused_means in zip(plain_colours, reused_colours, strict=True):
        plain_means, reused_means = (
            np.asarray(x, float)[:, 1].reshape(GROUPS, -1, KINDS).mean(axis=1)
            for x in (plain_means, reused_means)
        )
        error = np.sqrt((plain_means.var(axis=0) + reused_means.var(axis=0)) / GROUPS)
        assert np.all(error < 0.02 * plain_means.mean(axis=0))
        assert np.all(
            np.abs(plain_means.mean(axis=0) - reused_means.mean(axis=0)) < STANDARD_ERRORS * error
        )


def test_normals_that_face_away_lose_no_highlight_to_reservoirs():
    """Samples are above the normal, but the specular lobe needs those above the flipped normal."""
    count = 4000

    def rows(angle):
        vector = [np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))]
        return jnp.tile(jnp.asarray([vector], jnp.float32), (count, 1))

    no_faces = jnp.full((count,), -1, jnp.int32)
    points = SurfacePoints(0 * rows(0), rows(0), rows(10), no_faces, jnp.ones(count, bool))
    metal = Materials(jnp.full((count, 3), 0.8), jnp.full(count, 0.6), jnp.ones(count))
    attributes, light = Attributes(metal, None, None), EnvLight(jnp.ones((8, 16, 3)))

    def specular(candidates):
        spec = ReservoirSettings(candidates=candidates)
        counts = {"light_count": 4, "diffuse_count": 4, "specular_count": 4}
        transport = MonteCarloSettings(**counts, reservoirs=spec).build(LightSpec(8, 16))

        @jax.jit
        def shade(key):
            lights, _ = transport.prepare(key, points, attributes, light, None)
            return transport.shade(key, points, attributes, rows(93), lights, None).specular

        values = np.asarray(shade(jax.random.key(1)), float)[:, 0]
        return values.mean(), values.std() / np.sqrt(count)

    (plain_mean, plain_error), (resampled_mean, resampled_error) = specular(0), specular(8)
    assert abs(plain_mean - resampled_mean) < STANDARD_ERRORS * np.hypot(
        plain_error, resampled_error
    )
    assert plain_mean > 10 * np.hypot(plain_error, resampled_error)


@pytest.mark.parametrize("brightness", [0.0, 1.0])
def test_a_black_sky_has_samples_for_what_is_sent_back(brightness):
    """Weights times cosine add up to the integral of the cosine, which is pi."""
    points, light = scene(), EnvLight(jnp.full((8, 16, 3), brightness))
    samples = jax.jit(
        lambda key: resample(
            key, points, light, light_sampler(light), None, None, spec=PLAIN, count=COUNT
        )
    )(jax.random.key(0))
    cosine = np.sum(np.asarray(points.normals)[:, None] * samples.directions, axis=-1)
    estimates = np.asarray(np.maximum(cosine, 0.0) * samples.weights, float).mean(axis=1)
    error = estimates.std() / np.sqrt(POINTS)
    assert abs(estimates.mean() - np.pi) < STANDARD_ERRORS * error < 0.2


def test_what_a_place_kept_is_used_only_nearby_and_on_a_surface_of_that_direction():
    """It counts at most half as much as the four candidates of the step, as the setting says."""
    spec = replace(REUSE["steps"], candidates=4, confidence=0.5)
    points, light, index = scene(), sky(), Wall()
    store = empty_store(spec, COUNT)
    options = {"spec": spec, "count": COUNT}
    run = jax.jit(
        lambda key, points, store: resample(
            key, points, light, light_sampler(light), index, store, **options
        )
    )
    first_samples = run(jax.random.key(0), points, store)
    np.testing.assert_array_equal(first_samples.confidences, 4.0)
    hits = jnp.full((POINTS, COUNT), OPEN, jnp.int32)
    store = jax.jit(partial(store_reservoirs, spec=spec))(store, points, first_samples, hits, index)
    moved_points = replace(points, positions=points.positions.at[:, 1].add(1.0))
    far_points = replace(points, positions=points.positions.at[:, 1].add(5.0))
    turned_points = replace(points, normals=-points.normals)
    for current_points, is_used in (
        (points, True),
        (moved_points, True),
        (far_points, False),
        (turned_points, False),
    ):
        confidences = np.asarray(run(jax.random.key(1), current_points, store).confidences)
        # Because of lanes and collisions, some places lie in slots that other places took.
        assert (np.mean(confidences == 6.0) > 0.5) == is_used
        assert set(np.unique(confidences)) <= ({4.0, 6.0} if is_used else {4.0})
    # A step that sees no point leaves the store as it is.
    unseen_points = replace(points, mask=jnp.zeros(POINTS, bool))
    same_store = jax.jit(partial(store_reservoirs, spec=spec))(
        store, unseen_points, first_samples, hits, index
    )
    for leaf, other_leaf in zip(jax.tree.leaves(store), jax.tree.leaves(same_store), strict=True):
        np.testing.assert_array_equal(leaf, other_leaf)


def test_settings_refuse_what_would_lose_light():
    traced_settings = ReservoirSettings(candidates=2, visibility="traced")
    with pytest.raises(ValueError, match="raise diffuse_count and specular_count"):
        MonteCarloSettings(diffuse_count=0, specular_count=0, reservoirs=traced_settings)
    assert MonteCarloSettings(reservoirs=PLAIN).build(LightSpec()).first_carry() is None
    transport = MonteCarloSettings(reservoirs=REUSE["steps"], light_count=3).build(LightSpec())
    assert transport.first_carry().reservoirs.directions.shape == (32_768, 3, 3)
    assert transport.for_each_view().first_carry() is None
    assert transport.for_images(4).settings.reservoirs == ReservoirSettings()


def test_samples_are_plain_where_views_share_none():
    """Traced indirect light draws samples for the faces even then."""
    points, light = jax.tree.map(lambda leaf: leaf[:KINDS], scene()), sky()

    def samples(spec):
        settings = MonteCarloSettings(shares_views=False, reservoirs=spec)
        transport = settings.build(LightSpec())
        options = {"carry": None, "finds_nearest": False}
        key, sampler = jax.random.key(0), light_sampler(light)
        return transport._draw_shared(key, points, light, sampler, None, **options)[0]

    plain_samples, other_samples = samples(ReservoirSettings()), samples(PLAIN)
    for leaf, other_leaf in zip(
        jax.tree.leaves(plain_samples), jax.tree.leaves(other_samples), strict=True
    ):
        np.testing.assert_array_equal(leaf, other_leaf)


@pytest.mark.slow
@pytest.mark.long
def test_a_run_with_paths_and_reservoirs_resumes_bit_for_bit(tmp_path):
    config = tiny_config(
        *TRAINED,
        "stages.split_sum.steps=0",
        "stages.monte_carlo.transport.kind=paths",
        "stages.monte_carlo.transport.reservoirs.candidates=3",
        "stages.monte_carlo.transport.reservoirs.reuse_steps=true",
        "stages.monte_carlo.transport.reservoirs.neighbors=1",
        "stages.monte_carlo.transport.reservoirs.slots=512",
        "run.checkpoint_every=1",
    )
    dataset = sphere_dataset(count=3, size=12)
    whole_state = fit(dataset, config, tmp_path / "whole")
    fit(dataset, config, tmp_path / "parts", stop_after=2)
    resumed_state = fit(dataset, config, tmp_path / "parts", begin=Resume())
    assert float(jnp.max(whole_state.carry.reservoirs.confidences)) > 3
    assert jax.tree.structure(whole_state) == jax.tree.structure(resumed_state)
    for leaf, other_leaf in zip(
        jax.tree.leaves(whole_state), jax.tree.leaves(resumed_state), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(leaf), np.asarray(other_leaf))
