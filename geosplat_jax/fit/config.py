"""Settings of a run: frozen, validated, serialisable.

`Config` holds what all stages share and the tuple of stages; `presets.make_config` fills it. Names
of single settings are paths, such as ``geometry.resolution`` or ``stages.monte_carlo.steps``.
"""

import json
import re
import tomllib
from collections.abc import Iterable
from dataclasses import field, fields
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field

from geosplat_jax.adapter import AdapterConstants, FaceSplatSettings, SplatSettings
from geosplat_jax.core.settings import (
    ANY_KIND,
    Count,
    NonNegative,
    Positive,
    PositiveCount,
    PositiveOrNone,
    from_plain,
    listed,
    settings,
    to_plain,
)
from geosplat_jax.core.types import RATE_GROUP, EnvLight
from geosplat_jax.deferred import PerPixel
from geosplat_jax.fit.entering import Entry
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.fit.surfaces import FlexiCubesSettings, SurfaceSettings
from geosplat_jax.losses import Objective, Schedule, term_names
from geosplat_jax.materials import MaterialField, MaterialSpec
from geosplat_jax.refinement import FreeSplatSettings
from geosplat_jax.render import Params, PerSplat, RasterSettings, ShadingDomain
from geosplat_jax.transport.base import TransportSettings
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.paths import PathSettings
from geosplat_jax.transport.split_sum import SplitSumSettings

_KNOWN_KINDS = (
    SplitSumSettings,
    MonteCarloSettings,
    PathSettings,
    FreeSplatSettings,
    MeshSettings,
    PerPixel,
)
"""Kinds of settings that a run may name: a kind can be read once its class is imported."""

LABELS = {"preset": "--preset", "quality": "--quality", "material_prior": "--material-prior"}
"""Fields of `Config` that only record what was requested, and the options that set them."""


@settings
class Rate:
    """Learning rate of one group of parameters; Adam is indifferent to the scale of a gradient."""

    value: NonNegative = 0.0
    """Adam's rate before any decay; 0 freezes the group."""
    warmup: Count = 0
    """Steps over which the rate rises from zero, quadratically."""
    half_life: PositiveOrNone = None
    """Steps after which the rate has halved; none: the half-life of the stage. Without effect where
    the stage decays linearly."""


@settings
class Pace:
    """A change of how fast a stage goes through its schedule."""

    step: Count = 0
    """Number of the stage's steps before the change."""
    speed: Positive = 1.0
    """Steps of the schedules per training step from then on."""


@settings
class Stage:
    """A part of a run with its own settings; Adam and all schedules start anew with it.

    A stage with 0 steps is left out.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")] = "stage"
    """How commands and files call it."""
    steps: Count = 500
    """Optimiser steps. Half-lives and warm-ups are counted in steps, too, and are not changed along
    with them."""
    batch_views: PositiveCount = 4
    """Full views per step."""
    half_life: Positive = 800.0
    """Steps after which rates have halved."""
    decay: Literal["exponential", "linear"] = "exponential"
    """How rates decay: by half-lives, or linearly to zero at the end of the stage."""
    average: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the stage's steps, the last ones, over which all parameters are averaged. The stage
    ends with this mean, which holds less of the noise of high rates. 0: with its last step."""
    vertex_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the stage, from its start, in which splats are sampled at vertices instead of faces
    (Eq. 12). This saves memory while a random first surface is rough; a visual hull does not need
    it."""
    light_knee: NonNegative = 0.5
    """Radiance at which the steps of a texel of the light double: they grow with its brightness, by
    a factor of 1 + radiance / light_knee. 0: they do not grow."""
    light_pyramid: Annotated[float, Field(ge=0, le=1)] = 0.4
    """Share of its own step that every level of the light's pyramid contributes: regions then learn
    together, and single texels hold less noise. 0 turns the pyramid off."""
    transport: Annotated[TransportSettings, ANY_KIND] = SplitSumSettings()
    """Light transport: how the light that reaches a point is computed."""
    splats: Annotated[SplatSettings, ANY_KIND] = FaceSplatSettings()
    """Which splats represent the surface."""
    domain: Annotated[ShadingDomain, ANY_KIND] = PerSplat()
    """Where light transport is evaluated: per splat or per pixel."""
    enter: tuple[Annotated[Entry, ANY_KIND], ...] = ()
    """Changes of the parameters at the start of the stage, in order."""
    rates: dict[str, Rate] = field(default_factory=dict)
    """Learning rates by group of parameters."""
    weights: dict[str, Schedule] = field(default_factory=dict)
    """Weights of the loss by term."""
    pace: tuple[Pace, ...] = ()
    """Changes of speed that a time budget made during the training (`budget.Pacer`), in order."""

    def position(self, step: int) -> float:
        """Return how far the schedules have come, ``step`` steps after the stage's start.

        Counted in the steps of a stage without changes of pace; half-lives and warm-ups are counted
        in the same unit.
        """
        segment_start, schedule_steps, speed = 0, 0.0, 1.0
        for change in self.pace:
            if step <= change.step:
                break
            schedule_steps += (change.step - segment_start) * speed
            segment_start, speed = change.step, change.speed
        return schedule_steps + (step - segment_start) * speed

    def progress(self, step: int) -> float:
        """Return the share of the schedules that is done after ``step`` steps, from 0 to 1."""
        return self.position(step) / max(self.position(self.steps), 1.0)

    def samples_vertices(self, step: int) -> bool:
        """Whether the stage samples vertices (Eq. 12) ``step`` steps after its start."""
        return self.progress(step) < self.vertex_fraction

    def averages(self, step: int) -> bool:
        """Whether what the step makes, ``step`` steps after the start, counts for the average."""
        return self.average > 0 and self.progress(step) >= 1.0 - self.average

    @property
    def ends_with_vertices(self) -> bool:
        """Whether even the last step samples vertices."""
        return self.samples_vertices(self.steps - 1)

    def weights_at(self, step: int) -> dict[str, float]:
        """Weights by term, ``step`` steps after the stage's start.

        Terms whose weight is always 0 are left out.
        """
        progress = self.progress(step)
        return {
            name: schedule.at(progress)
            for name, schedule in self.weights.items()
            if not schedule.is_zero
        }

    def rates_at(self, step: int) -> dict[str, float]:
        """Learning rates of all groups, ``step`` steps after the stage's start."""
        position = self.position(step)
        return {
            name: rate.value
            * self._decayed(step, rate)
            * (min((position + 1) / rate.warmup, 1.0) ** 2 if rate.warmup else 1.0)
            for name, rate in self.rates.items()
        }

    def _decayed(self, step: int, rate: Rate) -> float:
        """Return the factor in [0, 1] by which a rate has decayed."""
        if self.decay == "linear":
            return max(1.0 - self.progress(step), 0.0)
        return 0.5 ** (self.position(step) / (rate.half_life or self.half_life))

    @property
    def frozen(self) -> tuple[str, ...]:
        """Groups whose rate is zero."""
        return tuple(sorted(name for name, rate in self.rates.items() if rate.value == 0))


@settings
class Budget:
    """What a training may take, see `budget.plan`."""

    seconds: Positive
    """Seconds from the start of the command to the last checkpoint, compilation included."""
    memory: PositiveOrNone = None
    """Largest resident memory in bytes; none: as much as the machine has."""


@settings
class RunSettings:
    """What belongs to no part of the method."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of every random choice; random streams distinguish 2**32 seeds."""
    checkpoint_every: PositiveCount = 100
    """Steps between checkpoints."""
    preview_every: Count = 100
    """Steps between previews; 0 turns them off."""
    window: Annotated[float, Field(ge=0, le=1)] = 0.4
    """Training uses only a window around the object in every photograph if the window holds at most
    this share of the pixels; 0 always uses whole photographs."""
    initial_light: NonNegative = 0.5
    """Radiance of every texel at the start."""
    smallest_light: NonNegative = 0.01
    """Lower bound of the radiance of every texel of the light."""


@settings
class Config:
    """All settings of a run."""

    preset: str = "default"
    """Name of the requested preset."""
    quality: str = "standard"
    """Name of the requested quality level."""
    material_prior: str = "hybrid"
    """Name of the requested material prior."""
    geometry: Annotated[SurfaceSettings, ANY_KIND] = FlexiCubesSettings()
    """The surface and where it starts."""
    adapter: AdapterConstants = AdapterConstants()
    """Constants of the splats on faces and vertices."""
    material: MaterialSpec = MaterialSpec()
    """Shape of the attribute fields."""
    light: LightSpec = LightSpec()
    """Shape of the environment map."""
    raster: RasterSettings = RasterSettings()
    """How splats become pixels."""
    objective: Objective = Objective()
    """How render and photograph are compared."""
    run: RunSettings = RunSettings()
    """Seed, checkpoints, previews."""
    stages: tuple[Stage, ...] = ()
    """What is trained, one after the other."""

    def __post_init__(self) -> None:
        """Refuse stages of the same name, too many steps, and unknown weights or rates."""
        names = [stage.name for stage in self.stages]
        if len(set(names)) < len(names):
            raise ValueError(f"stages need names of their own, got {names}")
        if self.total_steps >= 2**31:
            raise ValueError(
                f"all stages together must have less than 2**31 steps, got {self.total_steps}"
            )
        terms = (*term_names(), *self.geometry.penalty_names)
        groups = self.rate_groups
        for number, stage in enumerate(self.stages):
            self._check_splats(stage, number)
            for table, entries, allowed_names in (
                ("weights", stage.weights, terms),
                ("rates", stage.rates, groups),
            ):
                unknown = sorted(set(entries) - set(allowed_names))
                if unknown:
                    raise ValueError(
                        f"unknown setting stages.{stage.name}.{table}.{unknown[0]}; expected some "
                        f"of {sorted(allowed_names)}"
                    )

    def _check_splats(self, stage: Stage, number: int) -> None:
        """Refuse free splats where the stage before or the surface does not allow them."""
        if not stage.splats.takes_over or not stage.steps:
            return
        earlier_stages = [earlier for earlier in self.stages[:number] if earlier.steps]
        if not earlier_stages:
            raise ValueError(
                f"stages.{stage.name}.splats: {stage.splats.kind} splats need a stage before"
            )
        if not earlier_stages[-1].splats.is_six_per_face:
            raise ValueError(
                f"stages.{earlier_stages[-1].name}.splats: {stage.splats.kind} splats, which "
                f"stages.{stage.name} has, start from the six splats of every face; set it to face"
            )
        if earlier_stages[-1].ends_with_vertices:
            raise ValueError(
                f"stages.{earlier_stages[-1].name}.vertex_fraction: no step samples faces, but "
                f"{stage.splats.kind} splats, which stages.{stage.name} has, start from those of "
                "the last step; lower it"
            )
        if stage.vertex_fraction:
            raise ValueError(
                f"stages.{stage.name}.vertex_fraction: {stage.splats.kind} splats are no samples "
                "of vertices or faces; set it to 0"
            )
        learned_groups = sorted(set(self.geometry.rate_groups) - set(stage.frozen))
        if learned_groups:
            raise ValueError(
                f"stages.{stage.name}.splats: {stage.splats.kind} splats need a frozen surface; "
                f"set stages.{stage.name}.rates.{learned_groups[0]} to 0"
            )

    @property
    def rate_groups(self) -> tuple[str, ...]:
        """Names that a learning rate may have."""
        field_groups = {
            f.metadata[RATE_GROUP]
            for kind in (Params, MaterialField, EnvLight)
            for f in fields(kind)
            if RATE_GROUP in f.metadata
        }
        splat_groups = (group for stage in self.stages for group in stage.splats.rate_groups)
        return tuple(sorted({*field_groups, *self.geometry.rate_groups, *splat_groups}))

    @property
    def active_stages(self) -> tuple[Stage, ...]:
        """Stages that have steps, in order."""
        return tuple(stage for stage in self.stages if stage.steps)

    @property
    def total_steps(self) -> int:
        """Steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    def stage(self, name: str) -> Stage:
        """Return a stage by name.

        Raises
        ------
        ValueError
            If there is none.
        """
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise ValueError(f"there is no stage {name!r}; expected one of {self.stage_names}")

    @property
    def stage_names(self) -> list[str]:
        """Names of all stages, in order."""
        return [stage.name for stage in self.stages]

    def first_step(self, name: str) -> int:
        """Return the step of the run at which a stage starts; ValueError for an unknown name."""
        earlier_stages = self.stages[: self.stage_names.index(self.stage(name).name)]
        return sum(stage.steps for stage in earlier_stages)

    def stage_at(self, step: int) -> Stage:
        """Return the stage that makes step ``step``; the last one for any later step."""
        end = 0
        for stage in self.active_stages:
            end += stage.steps
            if step < end:
                return stage
        return self.active_stages[-1]

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON; stages by name, in order."""
        values = to_plain(self)
        values["stages"] = {stage.pop("name"): stage for stage in values["stages"]}
        return values


def config_from_dict(values: Any) -> Config:
    """Rebuild a `Config` from `Config.to_dict` (after a trip through JSON).

    Raises
    ------
    ValueError
        With one line for each setting that is unknown or has an invalid value. For settings of an
        earlier version: with one line that counts them, and says where the first one is now.
    """
    _require_current(values)
    stages, problems = [], []
    for name, stage in _stages_of(values).items():
        try:
            stages.append(to_plain(from_plain(Stage, {"name": name, **stage}, f"stages.{name}")))
        except ValueError as error:
            problems.append(str(error))
    try:
        config = from_plain(Config, {**values, "stages": stages})
    except ValueError as error:
        problems.append(str(error))
    else:
        if not problems:
            return config
    raise ValueError("\n".join(problems))


def _stages_of(values: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the sections of the stages by name.

    Raises
    ------
    ValueError
        If ``stages``, or one of them, is not a section.
    """
    stages = values.get("stages", {})
    if not isinstance(stages, dict):
        raise ValueError(f"stages must be an object with one section per stage, got {stages!r}")
    for name, stage in stages.items():
        if not isinstance(stage, dict):
            raise ValueError(f"stages.{name} must be an object, got {stage!r}")
    return stages


def all_settings(config: Config) -> list[tuple[str, Any, str, str]]:
    """Path, value, range and meaning of every setting, for people to read."""
    return [line for line in listed(config) if line[0] not in LABELS]


_MOVED = (
    (r"run\.(steps|batch_views)", r"stages.split_sum.\1"),
    (r"rates\.(half_life|light_knee)", r"stages.split_sum.\1"),
    (r"rates\.warmup", r"stages.split_sum.rates.sdf.warmup"),
    (r"rates\.shine_warmup", r"stages.split_sum.rates.roughness_metallic.warmup"),
    (r"rates\.(\w+)_warmup", r"stages.split_sum.rates.\1.warmup"),
    (r"rates\.shine", r"stages.split_sum.rates.roughness_metallic"),
    (r"rates\.(\w+)", r"stages.split_sum.rates.\1"),
    (r"loss\.entropy_end_fraction", r"stages.split_sum.weights.entropy.until"),
    (r"loss\.entropy_end", r"stages.split_sum.weights.entropy.end"),
    (r"loss\.smoothness", r"stages.split_sum.weights.smoothness_albedo"),
    (r"loss\.(\w+)", r"stages.split_sum.weights.\1"),
    (r"geometry\.vertex_fraction", r"stages.split_sum.vertex_fraction"),
    (r"transport\.(steps|batch_views)", r"stages.monte_carlo.\1"),
    (r"transport\.fresh_albedo", r"stages.monte_carlo.enter"),
    (
        r"transport\.shading\.(light|diffuse|specular|residual)",
        r"stages.monte_carlo.transport.\1_count",
    ),
    (r"transport\.shading\.method", r"stages.monte_carlo.transport"),
    (r"transport\.shading(\..+)?", r"stages.monte_carlo.transport\1"),
    (r"model\.baked_diffuse", r"stages.split_sum.transport.baked_diffuse"),
    (r"model\.attribute_gradient", r"material.position_gradient"),
    (r"model\.(cull_backfaces|tile_size|near)", r"raster.\1"),
    (r"model\.material\.indirect_outputs", r"stages.monte_carlo.transport.indirect"),
    (r"model\.transport(\..+)?", r"stages.split_sum.transport\1"),
    (r"model\.(.+)", r"\1"),
    (r"objective\.entropy_reduction", r"geometry.entropy_reduction"),
    (r"objective\.smooth_shine", r"stages.split_sum.weights.smoothness_roughness_metallic"),
    (r"objective\.with_light", r"stages.split_sum.weights.light"),
    (r"kind", r"material_prior"),
)
"""Patterns of the paths that settings had in earlier versions, and their paths now."""


def moved_setting(path: str) -> str | None:
    """Return the present path of a setting of an earlier version; None for any other path."""
    if re.match(r"transport\.(rates|loss)\.", path):
        split_sum_path = moved_setting(path.removeprefix("transport."))
        return split_sum_path and split_sum_path.replace("split_sum", "monte_carlo")
    for pattern, replacement in _MOVED:
        match = re.fullmatch(pattern, path)
        if match:
            return match.expand(replacement)
    return None


def _require_current(values: Any) -> None:
    """Refuse settings of an earlier version, and say where the first one is now."""
    if not isinstance(values, dict):
        raise ValueError(f"settings must be an object with sections, got {values!r}")
    paths = [path for path in _flat(values) if not path.startswith("stages.")]
    moves = {path: target for path in paths if (target := moved_setting(path)) and target != path}
    if moves:
        path, target = next(iter(moves.items()))
        raise ValueError(
            f"{len(moves)} settings are of an earlier version, the first: {path} is now {target}; "
            "train the scene anew"
        )


def parse_override(text: str) -> dict[str, Any]:
    """Turn ``section.field=value`` into a nested dictionary; the value is TOML, or a bare word.

    Raises
    ------
    ValueError
        If the text has no such form, names a label that an option sets, or a setting that moved.
    """
    name, equals, value = text.partition("=")
    name = name.strip()
    if not equals or not all(name.split(".")):
        raise ValueError(f"an override has the form section.field=value, got {text!r}")
    if name in LABELS:
        raise ValueError(f"{name} is chosen with {LABELS[name]}, not with --set")
    new_path = moved_setting(name)
    if new_path is not None:
        raise ValueError(f"the setting {name} is now {new_path}")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
        # Dates and times, which JSON lacks, become text.
        parsed = json.loads(json.dumps(parsed, default=str))
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    nested: Any = parsed
    for key in reversed(name.split(".")):
        nested = {key: nested}
    return nested


def override_paths(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the path of every single setting that overrides change, each once.

    ``a.b=1`` and ``a={b=1}`` both change ``a.b``. `ValueError` as for `parse_override`.
    """
    return tuple(dict.fromkeys(path for text in texts for path in _flat(parse_override(text))))


_OPEN = re.compile(r"stages\.\w+\.(rates|weights)\.")
"""Sections in which overrides may add names to those of the preset; `Config` checks the names."""


def merge(base: dict[str, Any], changes: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Overlay nested ``changes`` on ``base``.

    A number in the place of a section with a ``value`` replaces that value, and keeps the rest of
    the section. A section of another ``kind`` replaces the whole section.

    Raises
    ------
    ValueError
        If ``base`` lacks a name, except in the rates and weights of a stage.
    """
    merged = dict(base)
    for name, value in changes.items():
        base_value = base.get(name)
        kind = base_value.get("kind") if isinstance(base_value, dict) else None
        if name not in base and not _OPEN.fullmatch(where):
            raise ValueError(f"unknown setting {where}{name}; expected one of {sorted(base)}")
        if isinstance(value, dict) and value.get("kind", kind) != kind:
            merged[name] = value
        elif isinstance(value, dict) and isinstance(base_value, dict):
            merged[name] = merge(base_value, value, f"{where}{name}.")
        elif isinstance(base_value, dict) and "value" in base_value:
            merged[name] = {**base_value, "value": value}
        elif base_value is None and _OPEN.fullmatch(where) and not isinstance(value, dict):
            merged[name] = {"value": value}
        else:
            merged[name] = value
    return merged


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Map the path of every single setting to its value."""
    if not isinstance(values, dict) or not values:
        return {prefix.removesuffix("."): values}
    flat = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.")
    return flat


def changed_settings(
    first: Config, second: Config, *, stages: list[str] | None = None
) -> dict[str, tuple[Any, Any]]:
    """Map every setting in which two configurations differ to both values.

    Start meshes with the same content are the same, wherever their files are. A term of the loss
    that a stage leaves out has the weight 0.

    ``stages`` : names of the stages to compare, by default all. What all stages share is always
    compared.
    """
    terms: dict[str, set[str]] = {}
    for stage in (*first.stages, *second.stages):
        terms.setdefault(stage.name, set()).update(stage.weights)
    no_weight = to_plain(Schedule())

    def flat(config: Config) -> dict[str, Any]:
        values = json.loads(json.dumps(config.to_dict()))
        if stages is not None:
            values["stages"] = {n: s for n, s in values["stages"].items() if n in stages}
        for name, stage in values["stages"].items():
            stage["weights"] = dict.fromkeys(terms[name], no_weight) | stage["weights"]
        return _flat(values)

    left, right = flat(first), flat(second)
    if left.get("geometry.digest") and left["geometry.digest"] == right.get("geometry.digest"):
        left["geometry.path"] = right["geometry.path"]
    names = sorted(set(left) | set(right))
    return {n: (left.get(n), right.get(n)) for n in names if left.get(n) != right.get(n)}


def differences(first: Config, second: Config, *, stages: list[str] | None = None) -> list[str]:
    """Name every setting in which two configurations differ, with both values.

    ``stages`` : see `changed_settings`.
    """
    changes = changed_settings(first, second, stages=stages)
    return [f"{name}: {old!r} -> {new!r}" for name, (old, new) in changes.items()]


def config_warnings(config: Config) -> list[str]:
    """Return warnings about settings without effect, or with one that is hardly intended."""
    warnings = []
    if config.adapter.shift != 0 and config.material.has_shift:
        warnings.append(
            "adapter.shift has no effect: the inward shift is learned; set material.has_shift=false"
        )
    for stage in config.active_stages:
        for name, rate in stage.rates.items():
            if rate.value > 0 and rate.warmup > stage.position(stage.steps):
                warnings.append(
                    f"stages.{stage.name}.rates.{name}.warmup = {rate.warmup} is longer than the "
                    f"stage's {stage.steps} steps: the full rate will not be reached; half of the "
                    "stage is usual"
                )
        schedule = stage.weights.get("indirect", Schedule())
        if not schedule.is_zero and stage.transport.indirect_outputs == 0:
            warnings.append(
                f"stages.{stage.name}.weights.indirect has no effect: the stage learns no indirect "
                "light"
            )
        schedule = stage.weights.get("radiometric", Schedule())
        if not schedule.is_zero and not stage.transport.is_radiometric:
            warnings.append(
                f"stages.{stage.name}.weights.radiometric has no effect: set "
                f"stages.{stage.name}.transport.indirect=radiometric"
            )
        if schedule.is_zero and stage.transport.is_radiometric:
            warnings.append(
                f"stages.{stage.name}.transport.indirect=radiometric learns radiance that no loss "
                "compares with what the surface reflects, so surfaces may glow; set "
                f"stages.{stage.name}.weights.radiometric=1"
            )
        has_other_points = not stage.splats.is_six_per_face or stage.vertex_fraction > 0
        if stage.transport.reads_faces and has_other_points:
            warnings.append(
                f"stages.{stage.name}: splats sampled at vertices belong to no face, so the "
                f"surfaces that rays hit look black to {stage.transport.blocked_light}; use splats "
                "of faces"
            )
        if stage.domain.uses_rays and stage.transport.blocked_light is None:
            warnings.append(
                f"stages.{stage.name}.domain.points has no effect in training: the stage traces no "
                "rays from points"
            )
        if stage.transport.chooses_samples and not stage.domain.shades_splats:
            warnings.append(
                f"stages.{stage.name}.transport.reservoirs have no effect where pixels are shaded: "
                "no two views share a point"
            )
        warnings += [f"stages.{stage.name}.transport.{text}" for text in stage.transport.warnings()]
    return warnings + _changes_of_blocked_light(config)


def _changes_of_blocked_light(config: Config) -> list[str]:
    """Describe where a stage drops the indirect light that the stage before it has learned."""
    stages, warnings = config.active_stages, []
    tracing_stages = [stage for stage in stages if stage.transport.blocked_light]
    for before, after in pairwise(tracing_stages):
        lost_light = f"the indirect light that {before.name} learned, if any, is dropped"
        if before.transport.blocked_light != after.transport.blocked_light:
            warnings.append(
                f"stages.{after.name}.transport.{after.transport.blocked_light} takes the place of "
                f"stages.{before.name}.transport.{before.transport.blocked_light}: {lost_light}; "
                "give both stages the same setting"
            )
        elif before.transport.indirect_outputs and stages.index(after) > stages.index(before) + 1:
            between = stages[stages.index(before) + 1].name
            warnings.append(
                f"stages.{between} has no indirect light: {lost_light}, and {after.name} learns "
                "it anew; give both stages the same setting"
            )
    return warnings
