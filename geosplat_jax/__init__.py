"""Inverse rendering on any machine: photographs in; mesh, PBR materials and light out.

::

    import geosplat_jax as gs

    run = gs.train("examples/duck", "runs/duck", quality="draft")
    view = run.renderer()(run.dataset.test.camera([0]))
"""

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
