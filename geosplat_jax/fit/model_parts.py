"""The optional parts of a model, and how each is removed from the settings.

The settings of a run describe its largest model. Every `Part` can remove itself from settings, so
that a smaller model is the largest one `without` some parts. A part that is left out has no
parameters and is not computed. `LADDER` lists the parts from the one that explains most to the one
that explains least.
"""

import abc
from collections.abc import Collection, Iterable
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from typing import ClassVar

from geosplat_jax.fit.config import Config, Stage
from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.paths import PathSettings
from geosplat_jax.transport.sampled import SampledSettings
from geosplat_jax.transport.split_sum import SplitSumSettings

_FEWER_CELLS = 2.0 / 3.0
"""Ratio of the cells along the box without `FinerCells` to those with it: 32 to 48."""

_FEWEST_CELLS = 5
_FEWEST_TEXELS = (4, 8)
"""Rows and columns of the smallest light."""


class Part(abc.ABC):
    """An optional part of a model.

    Attributes
    ----------
    name : name in files.
    title : name for people.
    settings : patterns of the paths of the settings that decide on the part. If one of them was set
        by hand, the part stays as it is.
    needs : names of the parts that it needs; they are added with it.
    follows : names of the parts without which it is not tried.
    shows_in_photographs : whether photographs under one light can show that it is missing.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    settings: ClassVar[tuple[str, ...]]
    needs: ClassVar[tuple[str, ...]] = ()
    follows: ClassVar[tuple[str, ...]] = ()
    shows_in_photographs: ClassVar[bool] = True

    @abc.abstractmethod
    def removed(self, config: Config) -> Config:
        """Return the settings without the part; the same where they have none of it."""

    def is_in(self, config: Config) -> bool:
        """Whether the settings have the part."""
        return self.removed(config) != config

    def is_decided_by(self, paths: Iterable[str]) -> bool:
        """Whether one of the settings at these paths decides the part."""
        return any(fnmatchcase(path, pattern) for path in paths for pattern in self.settings)


class Specular(Part):
    """A specular lobe; without it the surface is Lambertian."""

    name, title = "specular", "specular lobe, one roughness"
    settings = ("material.specular",)

    def removed(self, config: Config) -> Config:
        """Leave the diffuse base alone."""
        return replace(config, material=replace(config.material, specular="none"))


class RoughnessField(Part):
    """A roughness that varies over the surface."""

    name, title = "roughness", "roughness field"
    settings = ("material.specular",)
    needs = ("specular",)

    def removed(self, config: Config) -> Config:
        """Leave a single roughness."""
        if config.material.specular != "field":
            return config
        return replace(config, material=replace(config.material, specular="uniform"))


class Metallic(Part):
    """A metallic field."""

    name, title = "metallic", "metallic"
    settings = ("material.has_metallic",)
    needs = ("specular",)

    def removed(self, config: Config) -> Config:
        """Leave a dielectric."""
        if config.material.specular == "none":
            return config
        return replace(config, material=replace(config.material, has_metallic=False))


def _with_stages(config: Config, stages: Iterable[Stage]) -> Config:
    return replace(config, stages=tuple(stages))


def _without_rays(stage: Stage) -> Stage:
    return replace(stage, transport=SplitSumSettings(), domain=stage.domain.without_rays())


def _without_indirect_weight(stage: Stage) -> Stage:
    return replace(stage, weights={n: w for n, w in stage.weights.items() if n != "indirect"})


def _without_shadows(stage: Stage) -> Stage:
    """Return a stage of sampled light whose rays meet no surface; others as they are."""
    transport = stage.transport
    if isinstance(transport, PathSettings):
        common = {field.name: getattr(transport, field.name) for field in fields(SampledSettings)}
        transport = MonteCarloSettings(**common)
    if not isinstance(transport, MonteCarloSettings) or not (
        transport.occlusion or stage.domain.uses_rays
    ):
        return stage
    open_transport = replace(transport, occlusion=False, indirect="none")
    return _without_indirect_weight(
        replace(stage, transport=open_transport, domain=stage.domain.without_rays())
    )


class SampledLight(Part):
    """Light that is integrated by samples; without it all stages use the split sum.

    The split sum of a Lambertian surface without shadows approximates nothing but the light between
    texels. It does not stretch specular lobes at grazing angles (`transport.split_sum`).
    """

    name, title = "sampling", "sampled light"
    settings = ("stages.*.transport.kind", "stages.*.domain.points")
    follows = ("specular",)

    def removed(self, config: Config) -> Config:
        """Give every stage the split sum."""
        return _with_stages(
            config,
            (
                stage
                if isinstance(stage.transport, SplitSumSettings) or not stage.steps
                else _without_indirect_weight(_without_rays(stage))
                for stage in config.stages
            ),
        )


class Shadows(Part):
    """Shadows that are traced by rays; without them rays meet no surface.

    Photographs under one light do not decide: a darker albedo explains them as well, and is wrong
    under any other light. So the surface decides, by the share of a uniform sky's light that it
    blocks from itself.
    """

    name, title = "shadows", "traced shadows"
    settings = (
        "stages.*.transport.kind",
        "stages.*.transport.occlusion",
        "stages.*.domain.points",
    )
    needs = ("sampling",)
    shows_in_photographs = False

    def removed(self, config: Config) -> Config:
        """Let no surface block samples, except for a point's own face."""
        return _with_stages(
            config,
            (_without_shadows(stage) if stage.steps else stage for stage in config.stages),
        )


class IndirectLight(Part):
    """Light from blocked directions."""

    name, title = "indirect", "indirect light"
    settings = ("stages.*.transport.indirect", "stages.*.weights.indirect*")
    needs, follows = ("sampling", "shadows"), ("shadows",)

    def removed(self, config: Config) -> Config:
        """Make blocked directions black."""

        def dark(stage: Stage) -> Stage:
            transport = stage.transport
            is_lit = isinstance(transport, MonteCarloSettings) and transport.indirect != "none"
            if not (is_lit and stage.steps):
                return stage
            return _without_indirect_weight(
                replace(stage, transport=replace(transport, indirect="none"))
            )

        return _with_stages(config, map(dark, config.stages))


class Shift(Part):
    """The learned inward shift of splats."""

    name, title = "shift", "inward shift"
    settings = ("material.has_shift",)

    def removed(self, config: Config) -> Config:
        """Leave splats on their faces, or where the adapter's constant puts them."""
        return replace(config, material=replace(config.material, has_shift=False))


class FinerHash(Part):
    """Fine levels of the encodings of the attribute fields."""

    name, title = "hash", "finer hash levels"
    settings = ("material.grid.*",)

    def removed(self, config: Config) -> Config:
        """Leave 3/4 of the levels, 1/4 of the finest resolution, and half of the table size.

        Returns the settings as they are where that would not make the encoding smaller.
        """
        grid = config.material.grid
        finest = max(grid.coarsest, grid.finest // 4)
        # A line of the finest grid may take at most half of the table, see `HashGridSpec`.
        smaller_grid = replace(
            grid,
            levels=max(1, round(0.75 * grid.levels)),
            finest=finest,
            log2_entries=max(grid.log2_entries - 1, (2 * finest).bit_length(), 1),
        )
        if smaller_grid.total_entries >= grid.total_entries:
            return config
        return replace(config, material=replace(config.material, grid=smaller_grid))


class LargerLight(Part):
    """An environment map of many texels."""

    name, title = "light", "larger light"
    settings = ("light.height", "light.width")

    def removed(self, config: Config) -> Config:
        """Leave a quarter of the rows and of the columns."""
        light, (rows, columns) = config.light, _FEWEST_TEXELS
        height, width = max(light.height // 4, rows), max(light.width // 8 * 2, columns)
        smaller_light = replace(
            light, height=min(height, light.height), width=min(width, light.width)
        )
        return replace(config, light=smaller_light)


class FinerCells(Part):
    """More cells of the surface's grid."""

    name, title = "cells", "finer cells"
    settings = ("geometry.resolution",)

    def removed(self, config: Config) -> Config:
        """Leave two thirds of the cells along the box."""
        geometry = config.geometry
        if not isinstance(geometry, FlexiCubesSettings):
            return config
        resolution = max(_FEWEST_CELLS, round(_FEWER_CELLS * geometry.resolution))
        return replace(config, geometry=replace(geometry, resolution=resolution))


LADDER: tuple[Part, ...] = (
    Specular(),
    RoughnessField(),
    Metallic(),
    SampledLight(),
    Shadows(),
    IndirectLight(),
    Shift(),
    FinerHash(),
    LargerLight(),
    FinerCells(),
)
"""Parts in the order in which they are tried."""


def offered_parts(config: Config, by_hand: Collection[str] = ()) -> tuple[Part, ...]:
    """Return the parts of the settings on which nothing was decided by hand, in order.

    Where a part was decided by hand, the parts that it needs are decided with it.

    Parameters
    ----------
    config : settings of the largest model.
    by_hand : paths of the settings that were set by hand.
    """
    present_parts = [part for part in LADDER if part.is_in(config)]
    decided_names = {part.name for part in present_parts if part.is_decided_by(by_hand)}
    for part in reversed(present_parts):  # what is needed stands before what needs it
        if part.name in decided_names:
            decided_names.update(part.needs)
    return tuple(part for part in present_parts if part.name not in decided_names)


def without(config: Config, parts: Iterable[Part]) -> Config:
    """Return settings without some parts; a part is removed before those that it needs."""
    names = {part.name for part in parts}
    for part in reversed(LADDER):
        if part.name in names:
            config = part.removed(config)
    return config
