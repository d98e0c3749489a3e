"""Presets and quality levels by name.

A preset says *which method* (``paper``: the appendix; ``code``: the authors' program; ``default``:
what measures best here), a quality level *how much work* (``draft``, ``standard``, ``high``). A
material prior says where roughness and metallic start. `make_config` combines them and applies
overrides written as ``section.field=value``.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from geosplat_jax.adapter import AdapterConstants
from geosplat_jax.core.settings import to_plain
from geosplat_jax.deferred import PerPixel
from geosplat_jax.fit.config import (
    Config,
    Rate,
    Stage,
    config_from_dict,
    merge,
    parse_override,
)
from geosplat_jax.fit.entering import FreshAlbedo
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.hashgrid import HashGridSpec
from geosplat_jax.io.start_mesh import digest_of
from geosplat_jax.losses import Objective, Schedule, term_names
from geosplat_jax.materials import MATERIAL_PRIORS, MaterialSpec
from geosplat_jax.refinement import FreeSplatSettings
from geosplat_jax.render import RasterSettings
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.split_sum import SplitSumSettings

PRESETS = ("default", "paper", "code")
QUALITIES = ("draft", "standard", "high")
PRESET_PRIORS = {"default": "satin", "paper": "hybrid", "code": "hybrid"}
"""The material prior of each preset, where none is asked for."""
BETWEEN = "between"
"""The label of settings that lie between the quality levels."""
SPLIT_SUM, MONTE_CARLO, REFINE = "split_sum", "monte_carlo", "refine"
"""Names of the stages of every preset."""

_SURFACE = ("sdf", "deform", "weights")
_NEVER = 1e9
"""Half-life, in steps, of rates that do not decay."""


def _rates(surface: float, *, surface_warmup: int = 0, **others: float | Rate) -> dict[str, Rate]:
    """Give the three groups of the isosurface one rate, and every other group its own."""
    rates = dict.fromkeys(_SURFACE, Rate(surface, surface_warmup))
    other_rates = {n: r if isinstance(r, Rate) else Rate(r) for n, r in others.items()}
    return rates | other_rates


def _weights(**weights: float | Schedule) -> dict[str, Schedule]:
    """Turn numbers into constant schedules; schedules stay as they are."""
    return {n: w if isinstance(w, Schedule) else Schedule(w) for n, w in weights.items()}


def _default() -> Config:
    """Return what measures best at standard quality (docs/quality.md, docs/ablations.md)."""
    photometric = {"l1": 0.8, "ssim": 0.2, "mask": 5.0}
    surface = {"deviation": 0.5, "weights": 0.1}
    smooth = {"smoothness_albedo": 0.03, "smoothness_roughness_metallic": 0.03}
    # Photographs of a matt object do not tell its colour from that of the light, which is what this
    # small weight decides (docs/quality.md, "The colour of the light").
    grey_light = {"light_cast": 0.003}
    split_sum = Stage(
        name=SPLIT_SUM,
        steps=500,
        rates=_rates(
            1e-2,
            albedo=3e-3,
            roughness_metallic=1.5e-3,
            roughness=5e-2,
            shift=3e-3,
            light=1e-2,
            exposure=5e-3,
        ),
        weights=_weights(
            **photometric, entropy=Schedule(0.2, 0.01, 0.5), **surface, **smooth, **grey_light
        ),
    )
    # Materials learn faster than the light. What they have absorbed, shadows included, the light no
    # longer has to explain; so their rates warm up. Few samples make noisy gradients, so the rate
    # of the surface is lower than the authors'.
    monte_carlo = Stage(
        name=MONTE_CARLO,
        steps=300,
        half_life=225.0,
        transport=MonteCarloSettings(
            light_count=2, diffuse_count=2, specular_count=2, residual_count=2, indirect="constant"
        ),
        enter=(FreshAlbedo("mean"),),
        rates=_rates(
            1e-3,
            surface_warmup=50,
            albedo=Rate(5e-3, 150),
            roughness_metallic=Rate(4e-3, 150),
            roughness=5e-2,
            shift=3e-3,
            indirect=1e-2,
            light=1e-2,
            exposure=5e-3,
        ),
        weights=_weights(
            **photometric, entropy=0.01, **surface, **smooth, **grey_light, indirect=0.001
        ),
    )
    refine = Stage(
        name=REFINE,
        steps=100,
        average=0.4,
        transport=monte_carlo.transport,
        splats=FreeSplatSettings(darkest_metal=0.2),
        rates=_refinement_rates(
            splat_scales=1e-2, splat_quats=2e-3, albedo=5e-4, roughness_metallic=2e-3
        ),
        weights=_weights(**photometric, albedo_smoothness=0.02, **smooth, indirect=0.001),
    )
    return Config(
        preset="default",
        material=MaterialSpec(shared=True, bias=True),
        objective=Objective(relative_albedo=0.5),
        stages=(split_sum, monte_carlo, refine),
    )


def _refinement_rates(
    *,
    albedo: float,
    roughness_metallic: float,
    splat_scales: float = 5e-3,
    splat_quats: float = 1e-3,
) -> dict[str, Rate]:
    """Return the rates of free splats, by default the authors', and those of the fields."""
    decaying = {
        "splat_means": 1.6e-4,
        "splat_normals": 1e-3,
        "light": 1e-3,
        "exposure": 5e-4,
    }
    steady = {
        "splat_scales": splat_scales,
        "splat_quats": splat_quats,
        "splat_opacities": 5e-2,
        "splat_albedo": 5e-3,
        "splat_indirect": 2.5e-3,
        "roughness_metallic": roughness_metallic,
        "roughness": 5e-3,
        "albedo": albedo,
    }
    rates = _rates(0.0, shift=0.0, indirect=0.0)
    rates |= {name: Rate(value, half_life=500.0) for name, value in decaying.items()}
    return rates | {name: Rate(value, half_life=_NEVER) for name, value in steady.items()}


def _original(
    name: str, *, adapter: AdapterConstants, material: MaterialSpec, stages: tuple[Stage, ...]
) -> Config:
    """Return the settings that the paper and the authors' program share.

    These are 96 cells along every side of a cube, noise as the first surface, grid vertices that
    move by at most a quarter of a cell, no back-face culling, and two encodings, whose attributes
    pull on the geometry.
    """
    return Config(
        preset=name,
        geometry=FlexiCubesSettings(
            resolution=96, initial="random", cubic=True, reach=0.25, max_quads=1_200_000
        ),
        adapter=adapter,
        material=replace(material, shared=False, position_gradient=True),
        light=LightSpec(height=256, width=512),
        raster=RasterSettings(cull_backfaces=False),
        stages=stages,
    )


def _original_split_sum(weights: dict[str, Schedule], *, baked_diffuse: bool) -> Stage:
    return Stage(
        name=SPLIT_SUM,
        steps=500,
        batch_views=8,
        vertex_fraction=0.1,  # 5 % of the whole training
        light_knee=0.0,
        light_pyramid=0.0,
        transport=SplitSumSettings(baked_diffuse=baked_diffuse),
        rates=_rates(
            1e-2,
            albedo=3e-3,
            roughness_metallic=1.5e-3,
            roughness=5e-2,
            shift=3e-3,
            light=1e-2,
            exposure=5e-3,
        ),
        weights=weights,
    )


def _original_monte_carlo(
    weights: dict[str, Schedule],
    *,
    indirect: Literal["constant", "harmonics"],
    first_albedo: Literal["grey", "mean"],
) -> Stage:
    return Stage(
        name=MONTE_CARLO,
        steps=500,
        batch_views=8,
        light_knee=0.0,
        light_pyramid=0.0,
        transport=MonteCarloSettings(
            light_count=64, diffuse_count=32, specular_count=32, indirect=indirect
        ),
        enter=(FreshAlbedo(first_albedo),),
        rates=_rates(
            3e-3,
            surface_warmup=50,
            albedo=1e-2,
            roughness_metallic=2e-3,
            roughness=2e-2,
            shift=3e-3,
            indirect=1e-2,
            light=1e-2,
            exposure=5e-3,
        ),
        weights=weights,
    )


def _original_refinement(
    photometric: dict[str, Schedule],
    *,
    indirect: Literal["constant", "harmonics"],
    points: Literal["splats", "mesh"],
) -> Stage:
    return Stage(
        name=REFINE,
        steps=100,
        batch_views=8,
        light_knee=0.0,
        light_pyramid=0.0,
        transport=MonteCarloSettings(
            light_count=256, diffuse_count=128, specular_count=128, indirect=indirect
        ),
        splats=FreeSplatSettings(),
        domain=PerPixel(points=points),
        rates=_refinement_rates(albedo=0.0, roughness_metallic=5e-4),
        weights={
            **photometric,
            **_weights(albedo_smoothness=0.2 / 3, smoothness_roughness_metallic=0.05 / 2),
        },
    )


def _original_stages(
    *,
    split_sum_weights: dict[str, Schedule],
    monte_carlo_weights: dict[str, Schedule],
    baked_diffuse: bool,
    indirect: Literal["constant", "harmonics"],
    points: Literal["splats", "mesh"],
) -> tuple[Stage, ...]:
    """Return the stages that the paper and the authors share: 8 views, 128 rays per splat.

    The refinement is that of the authors' program: 512 rays per pixel and no mask loss. Its weights
    of smoothness are divided by the number of channels, since terms are sums over channels here and
    means there.
    """
    surface = _weights(deviation=0.5, weights=0.1)
    photometric = {name: split_sum_weights[name] for name in ("l1", "ssim")}
    return (
        _original_split_sum({**split_sum_weights, **surface}, baked_diffuse=baked_diffuse),
        _original_monte_carlo(
            {**monte_carlo_weights, **surface, **_weights(indirect=0.001)},
            indirect=indirect,
            first_albedo="grey" if baked_diffuse else "mean",
        ),
        _original_refinement(photometric, indirect=indirect, points=points),
    )


def _paper() -> Config:
    """Return the settings of the paper's appendix; its stages are those of the authors' program."""
    photometric = {"l1": 1.0, "ssim": 0.2, "mask": 5.0}
    other_weights = {
        "smoothness_albedo": 0.03,
        "smoothness_roughness_metallic": 0.03,
        "light": 0.15,
    }
    # The weight of the entropy falls in one ramp, which ends in the middle of the whole training.
    stages = _original_stages(
        split_sum_weights=_weights(**photometric, entropy=Schedule(0.2, 0.01), **other_weights),
        monte_carlo_weights=_weights(**photometric, entropy=0.01, **other_weights),
        baked_diffuse=False,
        indirect="harmonics",
        points="splats",
    )
    material = MaterialSpec(
        grid=HashGridSpec(levels=16, features=2, log2_entries=19, coarsest=32, finest=4096),
        has_shift=False,
    )
    adapter = AdapterConstants(opacity=1.0, shading_frame=True)
    return _original("paper", adapter=adapter, material=material, stages=stages)


def _code(material_prior: str) -> Config:
    """Return the settings of the authors' program.

    Weights of smoothness are divided by the number of channels, since terms are sums over channels
    here and means there.
    """
    photometric = {"l1": 0.8, "ssim": 0.2, "mask": 5.0}
    is_specular = material_prior == "specular"
    stages = _original_stages(
        split_sum_weights=_weights(
            **photometric,
            entropy=Schedule(0.2, 0.12),
            smoothness_albedo=Schedule(0.5 / 3 if is_specular else 0.0, 0.03 / 3),
            smoothness_roughness_metallic=Schedule(0.1 / 2 if is_specular else 0.0, 0.001 / 2),
            white_balance=0.002,
        ),
        monte_carlo_weights=_weights(
            **photometric,
            entropy=Schedule(0.2, 0.01),
            smoothness_albedo=0.03 / 3,
            smoothness_roughness_metallic=0.03 / 2,
            # The authors smooth normals as colours, n / 2 + 1 / 2, which halves the weight.
            normal_smoothness=0.03 / 3 / 2 if is_specular else 0.0,
        ),
        baked_diffuse=True,
        indirect="constant",
        points="mesh",
    )
    split_sum, monte_carlo, refine = stages
    rates = dict(split_sum.rates)
    if is_specular:
        rates |= {name: Rate(5e-2) for name in _SURFACE}
        monte_carlo = replace(monte_carlo, steps=1000)
    if material_prior in ("specular", "glossy"):
        rates |= {"light": Rate(3e-2), "exposure": Rate(1.5e-2)}
    material = MaterialSpec(
        grid=HashGridSpec(levels=16, features=2, log2_entries=18, coarsest=16, finest=4096)
    )
    return _original(
        "code",
        adapter=AdapterConstants(u=1 / 9 - 1 / 24, v=2 / 9),
        material=material,
        stages=(replace(split_sum, rates=rates), monte_carlo, refine),
    )


_MESH_RATE = 0.3
"""Ratio of the rate of a mesh's vertices to the largest rate of an isosurface's groups
(docs/meshes.md)."""

_MESH_RATE_ORIGINAL = 1e-4
"""Rate of a mesh's vertices in appendix H, in half extents of the box."""

_MESH_WEIGHTS: dict[str, dict[str, float]] = {
    "default": {"laplacian": 0.3, "normal_consistency": 0.1, "edge_length": 0.01, "offset": 0.0},
    "paper": {"laplacian": 1e-3, "normal_consistency": 3e-4, "edge_length": 0.1, "offset": 0.1},
}
_MESH_WEIGHTS["code"] = _MESH_WEIGHTS["paper"]
"""Weights of `surface.triangle_mesh`. Those of the paper are appendix H's, whose unit of length is
not known."""

_MESH_EDGES = {"draft": 3.0, "standard": 2.0, "high": 1.5}
"""Mean edge length of a mesh in pixels, by quality level; `between_qualities` interpolates between
them. Settings between two levels that get their mesh only afterwards have that of `standard`."""

_MESH_SHIFT_LOGIT = -1.0
"""Logit from which the inward shift of splats starts on a mesh: about a quarter of the square root
of a face's area (docs/meshes.md)."""

_MESH_VIEWS = 6
"""Views per step in appendix H."""


def mesh_settings(mesh: str | Path | MeshSettings) -> MeshSettings:
    """Return settings that name a mesh file by its path and digest; settings stay as they are.

    Raises
    ------
    ValueError
        If there is no such file.
    """
    if isinstance(mesh, MeshSettings):
        return mesh
    return MeshSettings(path=str(Path(mesh).resolve()), digest=digest_of(mesh))


def with_mesh(config: Config, mesh: str | Path | MeshSettings) -> Config:
    """Return a configuration that starts from a mesh file instead of an isosurface (appendix H).

    The surface's own rates and weights are replaced by those of a mesh, and the inward shift of
    splats starts smaller, unless its start was set. Back-facing splats are culled, as an open mesh
    requires. The presets ``paper`` and ``code`` also take six views per step from appendix H, no
    vertex sampling, and its weight of the smoothness of roughness and metallic while the mesh
    moves; the start of their shift does not change.

    Parameters
    ----------
    config : settings of an isosurface. Settings that start from this mesh already stay as they are.
    mesh : file, or settings of the surface, whose file is not read. An edge length that is not the
        default one is kept; otherwise the quality level gives it.

    Raises
    ------
    ValueError
        If there is no such file, or the configuration starts from another mesh.
    """
    new_mesh = mesh_settings(mesh)
    if isinstance(config.geometry, MeshSettings):
        if config.geometry.digest != new_mesh.digest:
            raise ValueError(
                f"the settings start from the mesh {config.geometry.path}, but {new_mesh.path} was "
                "given as well; give only one of the two"
            )
        return config
    geometry = new_mesh
    if new_mesh.edge_pixels == MeshSettings().edge_pixels:
        edge_pixels = _MESH_EDGES.get(config.quality, _MESH_EDGES["standard"])
        geometry = replace(new_mesh, edge_pixels=edge_pixels)
    old_geometry, is_original = config.geometry, config.preset != "default"
    stages = []
    for stage in config.stages:
        rates = {n: r for n, r in stage.rates.items() if n not in old_geometry.rate_groups}
        weights = {n: w for n, w in stage.weights.items() if n not in old_geometry.penalty_names}
        old_rates = [stage.rates[name] for name in old_geometry.rate_groups if name in stage.rates]
        is_frozen = not old_rates or all(rate.value == 0 for rate in old_rates)
        rate = Rate(0.0)
        if not is_frozen:
            value = _MESH_RATE * max(rate.value for rate in old_rates)
            warmup = max(rate.warmup for rate in old_rates)
            rate = Rate(_MESH_RATE_ORIGINAL if is_original else value, warmup)
            weights |= _weights(**_MESH_WEIGHTS[config.preset])
        if is_original and not is_frozen:
            weights |= _weights(smoothness_roughness_metallic=0.01)
        stage = replace(stage, rates={**rates, "vertices": rate}, weights=weights)
        if is_original:
            stage = replace(stage, vertex_fraction=0.0, batch_views=_MESH_VIEWS)
        stages.append(stage)
    raster, material = replace(config.raster, cull_backfaces=True), config.material
    if not is_original and material.initial_shift_logit == MaterialSpec().initial_shift_logit:
        material = replace(material, initial_shift_logit=_MESH_SHIFT_LOGIT)
    return replace(
        config, geometry=geometry, raster=raster, material=material, stages=tuple(stages)
    )


# What each quality level spends.
_QUALITY: dict[str, dict[str, Any]] = {
    "draft": {
        "geometry": {"resolution": 32},
        "material": {"grid": {"levels": 6, "features": 4, "log2_entries": 14, "finest": 128}},
        "stages": {
            SPLIT_SUM: {
                "steps": 400,
                "batch_views": 2,
                "half_life": 400.0,
                "rates": {"light": {"value": 2e-2}},
            },
            MONTE_CARLO: {
                "steps": 150,
                "batch_views": 2,
                "half_life": 110.0,
                "rates": {
                    **dict.fromkeys(_SURFACE, {"warmup": 25}),
                    "albedo": {"value": 1e-2, "warmup": 75},
                    "roughness_metallic": {"value": 8e-3, "warmup": 75},
                },
            },
            REFINE: {
                "batch_views": 2,
                "rates": {
                    "splat_normals": {"value": 3e-3},
                    "splat_scales": {"value": 1.5e-2},
                    "splat_quats": {"value": 3e-3},
                },
            },
        },
    },
    "standard": {},
    "high": {
        "geometry": {"resolution": 80},
        "stages": {
            SPLIT_SUM: {"steps": 1000, "batch_views": 6, "half_life": 400.0},
            MONTE_CARLO: {
                "steps": 500,
                "batch_views": 6,
                "half_life": 375.0,
                "transport": {"light_count": 8, "diffuse_count": 8, "residual_count": 4},
                "rates": {"albedo": {"warmup": 250}, "roughness_metallic": {"warmup": 250}},
            },
            REFINE: {
                "batch_views": 6,
                "transport": {"light_count": 8, "diffuse_count": 8, "residual_count": 4},
            },
        },
    },
}

# A draft of the presets `paper` and `code`: their numbers, with less of everything.
_ORIGINAL_DRAFT: dict[str, Any] = {
    "geometry": {"resolution": 32},
    "material": {"grid": {"levels": 8, "log2_entries": 15, "coarsest": 16, "finest": 256}},
    "light": {"height": 64, "width": 128},
    "stages": {
        SPLIT_SUM: {"steps": 200, "batch_views": 2, "half_life": 320.0},
        MONTE_CARLO: {
            "steps": 150,
            "batch_views": 2,
            "half_life": 320.0,
            "transport": {"light_count": 8, "diffuse_count": 4, "specular_count": 4},
            "rates": dict.fromkeys(_SURFACE, {"warmup": 15}),
        },
        REFINE: {
            "steps": 0,
            "batch_views": 2,
            "transport": {"light_count": 8, "diffuse_count": 4, "specular_count": 4},
        },
    },
}


def between_qualities(
    place: float,
    *,
    material_prior: str | None = None,
    mesh: str | Path | MeshSettings | None = None,
    overrides: tuple[str, ...] = (),
) -> Config:
    """Return settings of the preset ``default`` between its quality levels.

    Positive numbers are interpolated in their logarithms. Everything else has the lower level's
    value until the higher level is reached; a stage without steps in the lower level is left out
    until then.

    Parameters
    ----------
    place : 0 for the first of `QUALITIES`, 1 for the second, 2 for the third, or between them.
    material_prior, mesh, overrides : see `make_config`.
    """
    level = min(int(place), len(QUALITIES) - 2)
    low, high = (
        make_config("default", quality, material_prior=material_prior, mesh=mesh).to_dict()
        for quality in QUALITIES[level : level + 2]
    )
    values = {**_interpolated(low, high, place - level), "quality": BETWEEN}
    return _finished(values, mesh, overrides)


def _interpolated(low: Any, high: Any, share: float) -> Any:
    """Interpolate the positive numbers of two nested dictionaries; all else is that of ``low``."""
    if isinstance(low, dict):
        # A mapping of names, such as rates, may lack some on one side.
        return {
            name: _interpolated(value, high[name], share) if name in high else value
            for name, value in low.items()
        }
    if share >= 1.0 or low == high:
        return high if share >= 1.0 else low
    is_number = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (low, high))
    if not is_number or min(low, high) <= 0:
        return low
    value = low * (high / low) ** share
    return round(value) if isinstance(low, int) else value


def make_config(
    preset: str = "default",
    quality: str = "standard",
    *,
    material_prior: str | None = None,
    mesh: str | Path | MeshSettings | None = None,
    overrides: tuple[str, ...] = (),
) -> Config:
    """Combine a preset, a quality level and overrides into a validated `Config`.

    Parameters
    ----------
    preset : one of `PRESETS`.
    quality : one of `QUALITIES`. For the presets ``paper`` and ``code``, ``draft`` is a smaller
        version, and ``standard`` and ``high`` both stand for the original numbers.
    material_prior : where roughness and metallic start, one of `materials.MATERIAL_PRIORS`; by
        default that of the preset, see `PRESET_PRIORS`.
    mesh : file of a mesh to start from, see `with_mesh`.
    overrides : ``section.field=value`` strings, applied last.

    Raises
    ------
    ValueError
        On an unknown name, a value of the wrong type or out of range, or a mesh file that is
        missing.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {PRESETS}, got {preset!r}")
    if quality not in QUALITIES:
        raise ValueError(f"quality must be one of {QUALITIES}, got {quality!r}")
    material_prior = PRESET_PRIORS[preset] if material_prior is None else material_prior
    if material_prior not in MATERIAL_PRIORS:
        raise ValueError(
            f"material_prior must be one of {sorted(MATERIAL_PRIORS)}, got {material_prior!r}"
        )
    if preset == "default":
        config, changes = _default(), _QUALITY[quality]
    else:
        config = _paper() if preset == "paper" else _code(material_prior)
        changes = _ORIGINAL_DRAFT if quality == "draft" else {}
    roughness_logit, metallic_logit = MATERIAL_PRIORS[material_prior]
    material = replace(
        config.material,
        initial_roughness_logit=float(roughness_logit),
        initial_metallic_logit=float(metallic_logit),
    )
    config = replace(config, quality=quality, material_prior=material_prior, material=material)
    return _finished(merge(config.to_dict(), changes), mesh, overrides)


def _of_kinds(values: dict[str, Any], preset: Config) -> Config:
    """Return the settings of a preset with other kinds of parts.

    A new kind keeps the values of the old one for those settings that both have. Rates and weights
    of parts that the new kinds do not have are left out. Where the surface of the preset was
    frozen, that of another kind is frozen as well; elsewhere its rates are to be given.
    """
    bare_stages = {
        name: {**stage, "steps": 0, "rates": {}, "weights": {}}
        for name, stage in values["stages"].items()
    }
    bare_config = config_from_dict({**values, "stages": bare_stages})
    values = _keeping(preset.to_dict(), bare_config.to_dict(), values)
    stages = values["stages"]
    weight_names = (*term_names(), *bare_config.geometry.penalty_names)
    surface_groups = preset.geometry.rate_groups
    new_groups = set(bare_config.geometry.rate_groups) - set(surface_groups)
    fitting_stages = {}
    for name, stage in stages.items():
        is_frozen = set(surface_groups) <= set(preset.stage(name).frozen)
        new_rates = {group: to_plain(Rate(0.0)) for group in new_groups if is_frozen}
        rates = {name: x for name, x in stage["rates"].items() if name in bare_config.rate_groups}
        weights = {name: x for name, x in stage["weights"].items() if name in weight_names}
        fitting_stages[name] = {**stage, "rates": rates | new_rates, "weights": weights}
    return config_from_dict({**values, "stages": fitting_stages})


def _keeping(old: Any, new: Any, given: Any) -> Any:
    """Complete settings of another kind by the values that the old kind has for the same settings.

    Parameters
    ----------
    old : settings of the preset.
    new : all settings, with the kinds of ``given`` and their defaults.
    given : settings to complete, in which a section of another kind may hold its kind alone.
    """
    if not all(isinstance(values, dict) for values in (old, new, given)):
        return given
    if old.get("kind") == given.get("kind", old.get("kind")):
        return {name: _keeping(old.get(name), new.get(name), x) for name, x in given.items()}
    return {name: x for name, x in old.items() if name in new} | given


def _finished(
    values: dict[str, Any],
    mesh: str | Path | MeshSettings | None,
    overrides: tuple[str, ...],
) -> Config:
    """Apply a mesh, and then overrides, to the values of a preset."""
    if mesh is not None:
        values = with_mesh(config_from_dict(values), mesh).to_dict()
    # Overrides of kinds are applied first, so that others may set single values of these kinds.
    # Overrides of steps are applied with them, because a stage with 0 steps is checked less
    # strictly.
    names = [text.partition("=")[0].strip() for text in overrides]
    if any(name.endswith(".kind") for name in names):
        preset = config_from_dict(values)
        for name, override in zip(names, overrides, strict=True):
            if name.endswith((".kind", ".steps")):
                values = merge(values, parse_override(override))
        values = _of_kinds(values, preset).to_dict()
    for override in overrides:
        values = merge(values, parse_override(override))
    return config_from_dict(values)
