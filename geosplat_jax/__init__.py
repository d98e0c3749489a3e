"""Inverse rendering on any machine: photographs in; mesh, PBR materials and light out.

::

    import geosplat_jax as gs

    run = gs.train("examples/duck", "runs/duck", quality="draft")
    view = run.renderer()(run.dataset.test.camera([0]))
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geosplat_jax.core.types import Batch, Camera, EnvLight
    from geosplat_jax.fit.begin import Anew, Resume, TakeOver
    from geosplat_jax.fit.config import Budget, Config, Stage
    from geosplat_jax.fit.folder import RunError
    from geosplat_jax.fit.listener import Listener, Progress
    from geosplat_jax.fit.presets import make_config
    from geosplat_jax.fit.train import Interrupted, TrainingError
    from geosplat_jax.io.dataset import Dataset, load_dataset
    from geosplat_jax.io.images import SceneError
    from geosplat_jax.model_choice import ModelChoice
    from geosplat_jax.pipeline import Pipeline
    from geosplat_jax.render import Params
    from geosplat_jax.report.relight import load_light
    from geosplat_jax.report.renderer import Renderer
    from geosplat_jax.run import Run, train

__all__ = [
    "Anew",
    "Batch",
    "Budget",
    "Camera",
    "Config",
    "Dataset",
    "EnvLight",
    "Interrupted",
    "Listener",
    "ModelChoice",
    "Params",
    "Pipeline",
    "Progress",
    "Renderer",
    "Resume",
    "Run",
    "RunError",
    "SceneError",
    "Stage",
    "TakeOver",
    "TrainingError",
    "load_dataset",
    "load_light",
    "make_config",
    "train",
]

_WHERE = {
    "Batch": "core.types",
    "Camera": "core.types",
    "EnvLight": "core.types",
    "Anew": "fit.begin",
    "Resume": "fit.begin",
    "TakeOver": "fit.begin",
    "Budget": "fit.config",
    "Config": "fit.config",
    "Stage": "fit.config",
    "RunError": "fit.folder",
    "make_config": "fit.presets",
    "Listener": "fit.listener",
    "Progress": "fit.listener",
    "Interrupted": "fit.train",
    "TrainingError": "fit.train",
    "Dataset": "io.dataset",
    "load_dataset": "io.dataset",
    "SceneError": "io.images",
    "ModelChoice": "model_choice",
    "Pipeline": "pipeline",
    "Params": "render",
    "load_light": "report.relight",
    "Renderer": "report.renderer",
    "Run": "run",
    "train": "run",
}
"""Modules of the public names, which are imported when they are first asked for."""


def __getattr__(name: str) -> Any:
    """Import a public name: the command must not wait for all of them before it notices Ctrl-C."""
    if name in _WHERE:
        return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
    if find_spec(f"{__name__}.{name}") is not None:  # a module, such as ``geometry``
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
