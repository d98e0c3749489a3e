"""Settings of a run: frozen, validated, serialisable; presets and quality levels by name.

A preset says *which method* (``paper``, ``code``, ``default``), a quality level *how much work*
(``draft``, ``standard``, ``high``). `make_config` combines them and applies overrides written as
``section.field=value``.
"""

import json
import tomllib
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from geosplat_jax import adapter as adapter_module
from geosplat_jax.adapter import AdapterConstants
from geosplat_jax.hashgrid import HashGridSpec
from geosplat_jax.losses import LossWeights, Objective
from geosplat_jax.materials import INITIAL_LOGITS, MaterialSpec
from geosplat_jax.model import Model
from geosplat_jax.transport.base import Transport
from geosplat_jax.transport.indirect import COEFFICIENTS

PRESETS = ("default", "paper", "code")
QUALITIES = ("draft", "standard", "high")


@dataclass(frozen=True)
class GeometryConfig:
    """The isosurface's grid and where it starts.

    Attributes
    ----------
    resolution : cells along the longest side of the box around the object.
    initial : ``"hull"`` (visual hull of the masks), ``"sphere"`` or ``"random"`` (the paper).
    vertex_fraction : share of the steps that sample vertices instead of faces (Eq. 12). It spares
        memory while a random first surface is rough; a visual hull needs none of it.
    max_quads : a surface with more quads than this is taken to have exploded.
    """

    resolution: int = 48
    initial: str = "hull"
    vertex_fraction: float = 0.0
    max_quads: int = 400_000

    def __post_init__(self) -> None:
        """Validate every field."""
        if self.resolution < 4:
            raise ValueError(f"geometry.resolution must be at least 4, got {self.resolution}")
        if self.initial not in ("hull", "sphere", "random"):
            raise ValueError(
                f'geometry.initial must be "hull", "sphere" or "random", got {self.initial!r}'
            )
        if not 0 <= self.vertex_fraction < 1:
            raise ValueError(
                f"geometry.vertex_fraction must lie in [0, 1), got {self.vertex_fraction}"
            )


@dataclass(frozen=True)
class RateConfig:
    """Adam's learning rates by parameter group; all halve every ``half_life`` steps.

    Adam is invariant to the scale of a gradient, so the gradient multipliers of the authors' code
    (hash tables x16, light x64) have no counterpart here.

    Attributes
    ----------
    sdf, deform, weights : the isosurface.
    albedo, shine, shift, indirect : heads and tables of albedo, of roughness and metallic, of the
        shift, of indirect light.
    light, exposure : radiometry.
    light_knee : radiance above which the light's steps grow with its brightness; 0 is never.
    half_life : steps after which all rates have halved.
    warmup : steps over which the isosurface's rates rise from zero, quadratically.
    albedo_warmup, shine_warmup : the same for materials: light is to explain first what it can.
    """

    sdf: float = 1e-2
    deform: float = 1e-2
    weights: float = 1e-2
    albedo: float = 3e-3
    shine: float = 1.5e-3
    shift: float = 3e-3
    indirect: float = 1e-2
    light: float = 1e-2
    light_knee: float = 0.5
    exposure: float = 5e-3
    half_life: float = 800.0
    warmup: int = 0
    albedo_warmup: int = 0
    shine_warmup: int = 0

    def __post_init__(self) -> None:
        """Validate every field."""
        for f in fields(self):
            value = getattr(self, f.name)
            if not value >= 0:
                raise ValueError(f"rates.{f.name} must not be negative, got {value}")
        if self.half_life <= 0:
            raise ValueError(f"rates.half_life must be positive, got {self.half_life}")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms (see `LossWeights`) at the first step, and the schedule of Eq. 14.

    Attributes
    ----------
    entropy, entropy_end : the entropy's weight falls linearly between them by
        ``entropy_end_fraction`` of the run and stays there.
    """

    l1: float = 0.8
    ssim: float = 0.2
    mask: float = 5.0
    entropy: float = 0.2
    entropy_end: float = 0.01
    entropy_end_fraction: float = 0.5
    deviation: float = 0.5
    weights: float = 0.1
    smoothness: float = 0.03
    light: float = 0.0
    indirect: float = 0.0

    def __post_init__(self) -> None:
        """Validate every field."""
        for f in fields(self):
            value = getattr(self, f.name)
            if not value >= 0:
                raise ValueError(f"loss.{f.name} must not be negative, got {value}")

    def at(self, progress: float) -> LossWeights:
        """Weights at ``progress`` in [0, 1] through the run."""
        blend = min(progress / max(self.entropy_end_fraction, 1e-9), 1.0)
        return LossWeights(
            l1=self.l1,
            ssim=self.ssim,
            mask=self.mask,
            entropy=self.entropy + blend * (self.entropy_end - self.entropy),
            deviation=self.deviation,
            weights=self.weights,
            smoothness=self.smoothness,
            light=self.light,
            indirect=self.indirect,
        )


@dataclass(frozen=True)
class RunConfig:
    """How long, how many views at a time, how often something is written.

    Attributes
    ----------
    steps : optimiser steps.
    batch_views : full views a step.
    seed : of every random choice.
    checkpoint_every, preview_every : steps; 0 turns previews off.
    initial_light : radiance of every texel at the start.
    smallest_light : texels are kept at or above this.
    """

    steps: int = 500
    batch_views: int = 4
    seed: int = 0
    checkpoint_every: int = 100
    preview_every: int = 100
    initial_light: float = 0.5
    smallest_light: float = 0.01

    def __post_init__(self) -> None:
        """Validate every field."""
        for name in ("steps", "batch_views", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"run.{name} must be at least 1, got {getattr(self, name)}")
        if self.preview_every < 0:
            raise ValueError(f"run.preview_every must not be negative, got {self.preview_every}")


def _stage_2_rates() -> RateConfig:
    """Rates of stage 2: a slower surface, and materials that wait for the light.

    Materials learn faster than light, and what they have explained, shadows included, light has no
    reason to explain again. The surface moves a third as fast as in REFERENCE 2.7: few samples make
    noisy gradients.
    """
    return RateConfig(
        sdf=1e-3,
        deform=1e-3,
        weights=1e-3,
        albedo=5e-3,
        shine=4e-3,
        half_life=225.0,
        warmup=50,
        albedo_warmup=150,
        shine_warmup=150,
    )


def _stage_2_loss() -> LossConfig:
    """Weights of stage 2."""
    return LossConfig(entropy=0.01, entropy_end=0.01, indirect=0.001)


@dataclass(frozen=True)
class TransportConfig:
    """Stage 2: what is light, what is material, by tracing shadows (Monte Carlo shading).

    Attributes
    ----------
    steps : optimiser steps after those of stage 1; 0 leaves the stage out. The half-life and the
        waits of ``rates`` are steps too and do not follow; half of the stage is usual for a wait.
    batch_views : full views a step.
    fresh_albedo : start with a new albedo field of one colour, the mean of stage 1; the preset
        `code` starts grey, since its stage 1 stores radiance there.
    shading : see `Transport`.
    rates, loss : as in stage 1, with Adam started afresh and schedules counted from here.
    """

    steps: int = 300
    batch_views: int = 4
    fresh_albedo: bool = True
    shading: Transport = Transport(
        method="monte_carlo", light=2, diffuse=2, specular=2, residual=2, indirect="constant"
    )
    rates: RateConfig = field(default_factory=_stage_2_rates)
    loss: LossConfig = field(default_factory=_stage_2_loss)

    def __post_init__(self) -> None:
        """Validate every field."""
        if self.steps < 0:
            raise ValueError(f"transport.steps must not be negative, got {self.steps}")
        if self.batch_views < 1:
            raise ValueError(f"transport.batch_views must be at least 1, got {self.batch_views}")


@dataclass(frozen=True)
class Config:
    """Everything a run depends on beside the scene.

    What stands outside ``transport`` is stage 1 (see `stage`).
    """

    preset: str = "default"
    quality: str = "standard"
    kind: str = "hybrid"
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    model: Model = field(default_factory=Model)
    objective: Objective = field(default_factory=Objective)
    loss: LossConfig = field(default_factory=LossConfig)
    rates: RateConfig = field(default_factory=RateConfig)
    run: RunConfig = field(default_factory=RunConfig)
    transport: TransportConfig = field(default_factory=TransportConfig)

    @property
    def total_steps(self) -> int:
        """Steps of all stages."""
        return self.run.steps + self.transport.steps

    def first_step(self, number: int) -> int:
        """Step that stage 1 or 2 starts at."""
        return 0 if number == 1 else self.run.steps

    def stage(self, number: int) -> "Config":
        """Return the settings of stage 1, or those of stage 2 in their places.

        Raises
        ------
        ValueError
            For another number.
        """
        if number not in (1, 2):
            raise ValueError(f"a run has stages 1 and 2, not {number}")
        if number == 1:
            with_light = self.objective.with_light or self.loss.light > 0
            return replace(self, objective=replace(self.objective, with_light=with_light))
        later = self.transport
        learned = COEFFICIENTS[later.shading.indirect]
        material = replace(self.model.material, indirect_outputs=learned)
        return replace(
            self,
            geometry=replace(self.geometry, vertex_fraction=0.0),
            model=replace(
                self.model, material=material, transport=later.shading, baked_diffuse=False
            ),
            objective=replace(self.objective, with_light=later.loss.light > 0),
            loss=later.loss,
            rates=later.rates,
            run=replace(self.run, steps=max(later.steps, 1), batch_views=later.batch_views),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON."""
        return asdict(self)


def _from_dict(kind: type, values: dict[str, Any], where: str) -> Any:
    """Build a dataclass from plain values; unknown keys and wrong types are errors."""
    default = kind()
    known = {f.name for f in fields(kind)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"unknown setting {where}{unknown[0]}; expected one of {sorted(known)}")
    made = {}
    for name, value in values.items():
        now = getattr(default, name)
        if is_dataclass(now):
            if not isinstance(value, dict):
                raise ValueError(f"{where}{name} is a section, got {value!r}")
            made[name] = _from_dict(type(now), value, f"{where}{name}.")
        else:
            made[name] = _coerce(value, now, f"{where}{name}")
    try:
        return kind(**made)
    except ValueError as error:
        raise ValueError(_located(str(error), where, known)) from None


def _located(message: str, where: str, known: set[str]) -> str:
    """Name a setting in a message by its whole path: both stages have settings of one class."""
    name, _, rest = message.partition(" ")
    name = name.rpartition(".")[2]
    if name in known:
        return f"{where}{name} {rest}"
    return f"{where.rstrip('.')}: {message}" if where else message


def _coerce(value: Any, like: Any, where: str) -> Any:
    """Return ``value`` with the type of the default ``like``, or raise."""
    if isinstance(like, bool):
        if isinstance(value, bool):
            return value
    elif isinstance(like, int):
        if isinstance(value, int) and not isinstance(value, bool):
            return value
    elif isinstance(like, float):
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    elif isinstance(like, tuple):
        # Tuples hold values of one kind; what lengths are legal is for the owner to say.
        if isinstance(value, list | tuple) and like:
            return tuple(_coerce(v, like[0], where) for v in value)
    elif isinstance(value, type(like)):
        return value
    raise ValueError(f"{where} must be of type {type(like).__name__} like {like!r}, got {value!r}")


def config_from_dict(values: dict[str, Any]) -> Config:
    """Rebuild a `Config` from `Config.to_dict` (after a trip through JSON)."""
    return _from_dict(Config, values, "")


def _merge(base: dict[str, Any], changes: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Overlay nested ``changes`` on ``base``; a name that ``base`` lacks is an error."""
    merged = dict(base)
    for name, value in changes.items():
        if name not in base:
            raise ValueError(f"unknown setting {where}{name}; expected one of {sorted(base)}")
        if isinstance(base[name], dict) and isinstance(value, dict):
            merged[name] = _merge(base[name], value, f"{where}{name}.")
        else:
            merged[name] = value
    return merged


def parse_override(text: str) -> dict[str, Any]:
    """Turn ``section.field=value`` into a nested dictionary; the value is TOML, or a bare word."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"an override reads section.field=value, got {text!r}")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    nested: Any = parsed
    for part in reversed(name.strip().split(".")):
        nested = {part: nested}
    return nested


# What each quality level spends.
_QUALITY: dict[str, dict[str, Any]] = {
    "draft": {
        "geometry": {"resolution": 32},
        "run": {"steps": 200, "batch_views": 2, "checkpoint_every": 100},
        "rates": {"half_life": 100.0},
        "transport": {
            "steps": 150,
            "batch_views": 2,
            "rates": {
                "albedo": 1e-2,
                "shine": 8e-3,
                "half_life": 110.0,
                "warmup": 25,
                "albedo_warmup": 75,
                "shine_warmup": 75,
            },
        },
        "model": {
            "material": {"grid": {"levels": 6, "features": 4, "log2_entries": 14, "finest": 128}},
        },
    },
    "standard": {},
    "high": {
        "geometry": {"resolution": 80},
        "run": {"steps": 1000, "batch_views": 6},
        "rates": {"half_life": 400.0},
        "transport": {
            "steps": 500,
            "batch_views": 6,
            "shading": {"light": 8, "diffuse": 8, "residual": 4},
            "rates": {"half_life": 375.0, "albedo_warmup": 250, "shine_warmup": 250},
        },
    },
}


def _original(
    name: str,
    *,
    adapter: AdapterConstants,
    grid: HashGridSpec,
    vertex_fraction: float,
    has_shift: bool,
    baked_diffuse: bool,
) -> Config:
    """Return what the paper and the authors share: 96 cells, a random start, 8 views a step."""
    material = MaterialSpec(grid=grid, shared=False, has_shift=has_shift)
    return Config(
        preset=name,
        geometry=GeometryConfig(resolution=96, initial="random", vertex_fraction=vertex_fraction),
        model=Model(adapter=adapter, material=material, baked_diffuse=baked_diffuse),
        run=RunConfig(batch_views=8),
        rates=RateConfig(half_life=800.0, light_knee=0.0),
    )


def _original_transport(indirect: str, *, l1: float, light: float) -> TransportConfig:
    """Return what the paper and the authors share in stage 2: 64 samples of either kind."""
    shading = Transport(method="monte_carlo", light=64, diffuse=32, specular=32, indirect=indirect)
    rates = RateConfig(
        sdf=3e-3, deform=3e-3, weights=3e-3, warmup=50, albedo=1e-2, shine=2e-3, light_knee=0.0
    )
    return TransportConfig(
        steps=500,
        batch_views=8,
        shading=shading,
        rates=rates,
        loss=LossConfig(l1=l1, light=light, indirect=0.001),
    )


def _preset(name: str) -> Config:
    """Return the settings that define a preset, at standard quality."""
    if name == "paper":
        paper = _original(
            name,
            adapter=adapter_module.PAPER,
            grid=HashGridSpec(levels=16, features=2, log2_entries=19, coarsest=32, finest=4096),
            vertex_fraction=0.05,
            has_shift=False,
            baked_diffuse=False,
        )
        objective = Objective(entropy_reduction="sum")
        loss = LossConfig(l1=1.0)
        transport = _original_transport("harmonics", l1=loss.l1, light=0.15)
        return replace(paper, loss=loss, objective=objective, transport=transport)
    if name == "code":
        code = _original(
            name,
            adapter=adapter_module.CODE,
            grid=HashGridSpec(levels=16, features=2, log2_entries=18, coarsest=16, finest=4096),
            vertex_fraction=0.1,
            has_shift=True,
            baked_diffuse=True,
        )
        loss = LossConfig(entropy_end=0.12, entropy_end_fraction=1.0)
        transport = _original_transport("constant", l1=loss.l1, light=0.0)
        return replace(code, loss=loss, transport=transport)
    return Config(preset="default", model=Model(material=MaterialSpec(shared=True)))


def make_config(
    preset: str = "default",
    quality: str = "standard",
    *,
    kind: str = "hybrid",
    overrides: tuple[str, ...] = (),
) -> Config:
    """Combine a preset, a quality level and overrides into a validated `Config`.

    Parameters
    ----------
    preset : one of `PRESETS`.
    quality : one of `QUALITIES`; changes nothing of the presets ``paper`` and ``code`` but what
        ``overrides`` says, since their numbers are the point of them.
    kind : guess about the material (see `materials.INITIAL_LOGITS`).
    overrides : ``section.field=value`` strings, applied last.

    Raises
    ------
    ValueError
        On an unknown name, a value of the wrong type or out of range.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {PRESETS}, got {preset!r}")
    if quality not in QUALITIES:
        raise ValueError(f"quality must be one of {QUALITIES}, got {quality!r}")
    if kind not in INITIAL_LOGITS:
        raise ValueError(f"kind must be one of {sorted(INITIAL_LOGITS)}, got {kind!r}")
    roughness_logit, metallic_logit = INITIAL_LOGITS[kind]
    config = replace(_preset(preset), quality=quality, kind=kind)
    material = replace(
        config.model.material,
        initial_roughness_logit=float(roughness_logit),
        initial_metallic_logit=float(metallic_logit),
    )
    config = replace(config, model=replace(config.model, material=material))
    values = config.to_dict()
    if preset == "default":
        values = _merge(values, _QUALITY[quality])
    for override in overrides:
        values = _merge(values, parse_override(override))
    return config_from_dict(values)


def doubts(config: Config) -> list[str]:
    """Say what of a configuration has no effect, or hardly one, though it was asked for."""
    found = []
    stages = {"": 1, "transport.": 2} if config.transport.steps else {"": 1}
    for name, number in stages.items():
        stage, steps = config.stage(number), config.stage(number).run.steps
        for wait in ("albedo_warmup", "shine_warmup"):
            length = getattr(stage.rates, wait)
            if length > steps:
                found.append(
                    f"{name}rates.{wait} = {length} is longer than the stage's {steps} steps: the "
                    "material will not reach its full rate; half of the stage is usual"
                )
    if config.loss.indirect > 0 and config.model.material.indirect_outputs == 0:
        found.append("loss.indirect has no effect: stage 1 learns no indirect light")
    shading = config.transport.shading
    if shading.indirect == "traced" and not shading.occlusion:
        found.append(
            "transport.shading.indirect = traced has no effect without occlusion: blocked "
            "directions are black"
        )
    return found


def differences(first: Config, second: Config) -> list[str]:
    """Name every setting in which two configurations differ, with both values."""

    def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        found = {}
        for name, value in values.items():
            if isinstance(value, dict):
                found |= flat(value, f"{prefix}{name}.")
            else:
                found[prefix + name] = value
        return found

    one, two = (flat(json.loads(json.dumps(c.to_dict()))) for c in (first, second))
    names = sorted(set(one) | set(two))
    return [f"{n}: {one.get(n)!r} -> {two.get(n)!r}" for n in names if one.get(n) != two.get(n)]
