"""A run: what was trained from a scene, and everything that can be done with it.

`train` makes a run and returns it as a `Run`; ``Run(folder)`` opens an existing one. The command
``geosplat-jax`` makes the same runs as Python.
"""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from geosplat_jax.core.types import Batch, EnvLight
from geosplat_jax.fit.begin import ANEW, Begin
from geosplat_jax.fit.budget import Pacer, Plan, plan
from geosplat_jax.fit.cameras import CameraSettings, ViewProgress, refine_views, with_mean_balance
from geosplat_jax.fit.config import Budget, Config
from geosplat_jax.fit.costs import expected_costs, slowness_of_machine
from geosplat_jax.fit.devices import Devices, choose_devices
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.listener import NOBODY, Listener, Listeners
from geosplat_jax.fit.presets import make_config, with_mesh
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.stages import make_batch
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.fit.train import Trained, fit, load_trained
from geosplat_jax.io.cameras import RefinedSplit, write_cameras
from geosplat_jax.io.dataset import READING_OPTIONS, Dataset, load_recorded, photograph_size
from geosplat_jax.io.images import write_png
from geosplat_jax.io.views import Views
from geosplat_jax.io.windows import around_object
from geosplat_jax.model_choice import ChosenModel, ModelChoice, choose_model
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.report.assets import export_assets
from geosplat_jax.report.consistency import Consistency, body_of_run, measure, single_cameras
from geosplat_jax.report.evaluate import EvaluateOptions, Truth, evaluate_run
from geosplat_jax.report.facts import changed_from_preset
from geosplat_jax.report.pace import OnProgress, counted
from geosplat_jax.report.page import REPORT, RunResults, write_report
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.relight import RelightOptions, load_light, load_view_light, relight_views
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, Renderer
from geosplat_jax.report.sheets import preview_image
from geosplat_jax.report.shots import Cameras, Images, remove_later_frames

REFINEMENT_SAMPLES = 32
"""Rays per splat when cameras are refined: noise averages out over the pixels of a view."""

_PREVIEW_SECONDS = 60.0
"""Usual upper limit of a preview's time: its program may compile while a new stage trains."""


def _true_light(dataset: Dataset, lights: Mapping[str, EnvLight]) -> EnvLight | None:
    """Return the light of the training images: by its name, or as the first test view saw it."""
    light = lights.get(dataset.train_light or "")
    if light is not None:
        return light
    view_light = next(iter(dataset.test.lights.values()), None)
    return None if view_light is None else load_view_light(view_light)


def mesh_of_run(folder: RunFolder) -> MeshSettings | None:
    """Return settings that name the mesh a run started from; None without a run, or a mesh."""
    geometry = folder.config().geometry if folder.exists else None
    return geometry.file if isinstance(geometry, MeshSettings) else None


class Run:
    """A run's folder, opened.

    Parameters
    ----------
    folder : folder of the run.
    scene : where the scene is now, if it has moved; the folder's record is updated.

    Raises
    ------
    RunError
        If the folder holds no run, or the scene is another one.
    """

    def __init__(self, folder: str | Path, *, scene: str | Path | None = None) -> None:
        self.folder = RunFolder(folder)
        record = self.folder.record()
        if scene is not None:
            dataset = load_recorded(scene, record["dataset"])
            with self.folder.locked():
                self.folder.repoint(dataset)
            self.dataset = dataset

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @cached_property
    def dataset(self) -> Dataset:
        """The scene, as it was read for the training."""
        record = self.folder.record()
        if not record["scene"] or not Path(record["scene"]).is_dir():
            raise RunError(
                f"the scene of {self.folder} is not at {record['scene']} any more; say where it is "
                "with --scene"
            )
        return load_recorded(record["scene"], record["dataset"])

    @cached_property
    def trained(self) -> Trained:
        """The last good checkpoint."""
        return load_trained(self.folder)

    @property
    def config(self) -> Config:
        """Settings of the run."""
        return self.folder.config()

    @property
    def params(self) -> Params:
        """Learned parameters."""
        return self.trained.params

    @property
    def pipeline(self) -> Pipeline:
        """The method as the last stage trained it: ``pipeline.loss(params, batch)``."""
        return self.trained.pipeline

    def batch(self, step: int = 0) -> Batch:
        """Return the views that a step of the training saw, or would see.

        Where photographs are cut to windows around the object (``run.window``), training multiplies
        the weights of terms that are means over pixels by the windows' share of the pixels;
        `pipeline` does not.
        """
        config = self.config
        views, _ = around_object(self.dataset.train, largest=config.run.window)
        return make_batch(views, step, config.stage_at(step), seed=config.run.seed)

    def renderer(self, *, samples: int = DEFAULT_SAMPLES) -> Renderer:
        """Return a renderer of the learned parameters; ``samples`` : rays per splat."""
        return Renderer.of(self.trained, samples=samples)

    def steps(self) -> list[dict[str, Any]]:
        """Read the metrics of every training step."""
        return self.folder.metric_lines()

    @property
    def metrics(self) -> dict[str, Any]:
        """What the last evaluation found.

        Raises
        ------
        RunError
            If there was none, or its file is damaged.
        """
        results = RunResults.of(self.folder).metrics()
        if not results:
            raise RunError(f"{self.folder} has not been evaluated; do so first")
        return results

    def _views(self, split: str) -> Views:
        """Return a split that has views."""
        views = self.dataset.test if split == "test" else self.dataset.train
        if not views.names:
            raise RunError(f"{self.dataset.root} has no {split} views")
        return views

    def _output(self, folder: str | Path | None, name: str) -> Path:
        path = self.folder.path / name if folder is None else Path(folder).expanduser()
        path.mkdir(parents=True, exist_ok=True)
        return path

    def evaluate(
        self,
        *,
        protocol: str = PROTOCOLS[0],
        samples: int = DEFAULT_SAMPLES,
        relight_indirect: str = "traced",
        stage: str | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, Any]:
        """Compare the test views with the truth; write metrics, sheets of pictures and a report.

        Parameters
        ----------
        protocol, samples, relight_indirect : see `evaluate.EvaluateOptions`.
        stage : evaluate the state that this stage ended with, and write to the folder of its
            checkpoint; by default the present state of the run.
        on_progress : called with a part of the work, how much of it is done, and how much there is.

        Returns
        -------
        The metrics, which are also written to ``metrics.json``.

        Raises
        ------
        RunError
            If the scene has no test views.
        SceneError
            If they have no masks.
        TrainingError
            If that stage has not ended.
        """
        views = self._views("test")
        self.dataset.require_masks("test")
        record, dataset = self.folder.record(), self.dataset
        trained = self.trained if stage is None else load_trained(self.folder, stage=stage)
        lights = {name: load_light(path) for name, path in dataset.lights.items()}
        peaks = [line["peak_memory_mb"] for line in self.steps() if "peak_memory_mb" in line]
        evaluation = RunResults.of(self.folder, stage=stage)
        metrics = evaluate_run(
            trained,
            Truth(views, lights, _true_light(dataset, lights), dataset.train),
            evaluation.results,
            EvaluateOptions(protocol, samples, relight_indirect),
            meta={
                "scene": record["scene"],
                "dataset": record["dataset"],
                "step": trained.step,
                "stage": trained.stage.name,
                "training": self.folder.training(),
                "training_peak_memory_mb": max(peaks, default=None),
            },
            on_progress=on_progress,
        )
        write_report(evaluation.results / REPORT, [evaluation])
        return metrics

    def report(self, output: str | Path | None = None, *, others: Sequence["Run"] = ()) -> Path:
        """Write ``report.html``, one self-contained page; return its path.

        The page is made from the files of the training and of the last evaluation; see
        `report.page`.

        Parameters
        ----------
        output : file (default: ``report.html`` in the run's folder).
        others : runs to compare with, on the same page.

        Raises
        ------
        RunError
            If a file of a run is damaged.
        """
        runs = [RunResults.of(run.folder) for run in (self, *others)]
        return write_report(Path(output or self.folder.path / REPORT).expanduser(), runs)

    def consistency(self, *, stage: str | None = None, size: int | None = None) -> Consistency:
        """Measure how well the splats represent the mesh, over the test views.

        Over the training views where there are no test views. See `report.consistency`.

        Parameters
        ----------
        stage : as for `evaluate`.
        size : pixels along the longer side of the views (default: those of the photographs).
        """
        trained = self.trained if stage is None else load_trained(self.folder, stage=stage)
        return measure(body_of_run(trained), single_cameras(self.dataset.views_to_show, size))

    def render(
        self,
        split: str = "test",
        output: str | Path | None = None,
        *,
        cameras: Cameras | None = None,
        images: Images | None = None,
        samples: int = DEFAULT_SAMPLES,
        on_progress: OnProgress | None = None,
    ) -> list[Path]:
        """Render views, or from any cameras, under the learned light; return the files.

        Parameters
        ----------
        split : ``test`` or ``train``; without effect where ``cameras`` are given.
        output : folder (default: ``renders`` in the run's folder).
        cameras : cameras to render from, see `shots.Cameras`.
        images : images to write, see `shots.Images`.
        samples : rays per splat.
        on_progress : as for `evaluate`.

        Raises
        ------
        RunError
            If the scene has no such views.
        ValueError
            If a size, an angle or an image is unusable.
        """
        cameras, images = cameras or Cameras(split), images or Images()
        cameras.check()
        images.check()
        renderer = self.renderer(samples=samples).with_aovs(*images.aovs)
        shots, files = cameras.shots(self.dataset, renderer.center()), []
        folder = self._output(output, "renders")
        remove_later_frames(folder, shots)
        for name, camera in counted(shots, "views", on_progress):
            files += images.write(folder, name, renderer(camera))
        return files

    def relight(
        self,
        env: str | Path,
        output: str | Path | None = None,
        *,
        options: RelightOptions | None = None,
        cameras: Cameras | None = None,
        images: Images | None = None,
        intensity: float = 1.0,
        albedo_scale: Sequence[float] = (1.0, 1.0, 1.0),
        samples: int = DEFAULT_SAMPLES,
        indirect: str = "traced",
        on_progress: OnProgress | None = None,
    ) -> list[Path]:
        """Render views, and movies, under another light; return the files.

        Parameters
        ----------
        env : file of a lat-long environment map.
        output : folder (default: ``relight_NAME`` in the run's folder).
        options : which movies to make, and what is behind the object.
        cameras : see `shots.Cameras` (default: the test views, or the training views without any).
        images : images to write besides, see `shots.Images`.
        intensity : factor of the light.
        albedo_scale : (3,) factors of the albedo.
        samples : rays per splat.
        indirect : see `Renderer.relit`.
        on_progress : as for `evaluate`.
        """
        options = options or RelightOptions()
        options.check()
        cameras = cameras or Cameras(views=None)
        cameras.check()
        light = EnvLight(intensity * load_light(env).radiance)
        relit_renderer = self.renderer(samples=samples).relit(
            light, albedo_scale=albedo_scale, indirect=indirect
        )
        shots = cameras.shots(self.dataset, relit_renderer.center())
        folder = self._output(output, f"relight_{Path(env).stem}")
        remove_later_frames(folder, shots)
        return relight_views(
            relit_renderer, light, shots, folder, options, images, on_progress=on_progress
        )

    def refine_cameras(
        self,
        output: str | Path | None = None,
        *,
        splits: Sequence[str] = ("train", "test"),
        how: CameraSettings | None = None,
        samples: int = REFINEMENT_SAMPLES,
        on_view: Callable[[str, ViewProgress], None] | None = None,
    ) -> dict[str, RefinedSplit]:
        """Refine pose, focal length and colour of every view; write them to a file.

        The asset stays as it was trained. `load_dataset` and `train` take the file.

        Parameters
        ----------
        output : file (default: ``cameras.json`` in the run's folder).
        splits : some of ``train`` and ``test``; those without views are left out.
        how : see `fit.cameras.CameraSettings`.
        samples : rays per splat of the light on the asset.
        on_view : called after every view, with the name of its split and the progress.

        Returns
        -------
        The refined splits by name, as they are written.

        Raises
        ------
        RunError
            If no split has views, or the run was trained with the cameras in ``output``.
        """
        path = Path(output or self.folder.path / "cameras.json").expanduser()
        own_cameras = self.dataset.options.get("cameras")
        if own_cameras is not None and Path(own_cameras) == path.resolve():
            raise RunError(
                f"{path} holds the cameras that {self.folder} was trained with; write to another "
                "file with --output"
            )
        split_names = [name for name in splits if getattr(self.dataset, name).names]
        if not split_names:
            raise RunError(f"{self.dataset.root} has no {' and no '.join(splits)} views")
        subject = self.renderer(samples=samples).subject()
        refined_splits: dict[str, RefinedSplit] = {}
        for split in split_names:
            callback = None if on_view is None else partial(on_view, split)
            refined_splits[split] = refine_views(subject, self._views(split), how, on_view=callback)
        refined_splits = with_mean_balance(refined_splits)
        write_cameras(path, refined_splits)
        return refined_splits

    def export(
        self,
        output: str | Path | None = None,
        *,
        vertex_colors: bool = False,
        texture_size: int = 1024,
        obj: bool = False,
        usd: bool = False,
        face_count: int | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, str]:
        """Write the mesh, Gaussians and light; return a line of text about each file.

        Parameters
        ----------
        output : folder (default: ``export`` in the run's folder).
        vertex_colors, texture_size, obj, usd, face_count : see `assets.export_assets`.
        on_progress : as for `evaluate`.
        """
        return export_assets(
            self.trained,
            self._output(output, "export"),
            vertex_colors=vertex_colors,
            texture_size=texture_size,
            obj=obj,
            usd=usd,
            face_count=face_count,
            on_progress=on_progress,
        )


class _Previews(Listener):
    """Writes photograph, render and normals of one view side by side, in the background.

    Under a budget no preview begins that the training would have to wait for at its end.
    """

    def __init__(self, dataset: Dataset, folder: RunFolder, pacer: Pacer | None = None) -> None:
        self._views = dataset.views_to_show
        self._folder = folder.previews
        self._pacer = pacer
        self._running: Future[None] | None = None

    def on_preview(self, trained: Trained) -> None:
        """Begin to render a preview; waits for the one before."""
        if self._pacer is not None and self._pacer.seconds_left < _PREVIEW_SECONDS:
            return
        self.finish()
        # A copy, since the next step consumes the buffers of the parameters.
        snapshot = replace(trained, params=jax.tree.map(jnp.array, trained.params))
        self._running = in_background(lambda: self._write(snapshot))

    def finish(self) -> None:
        """Wait for the preview that is being rendered; warn if it failed."""
        future, self._running = self._running, None
        if future is None:
            return
        error = future.exception()
        if isinstance(error, Exception):
            warnings.warn(f"a preview could not be made: {error}", stacklevel=2)
        elif error is not None:
            raise error

    def _write(self, trained: Trained) -> None:
        self._folder.mkdir(exist_ok=True)
        image = preview_image(trained, self._views)
        write_png(self._folder / f"step_{trained.step:06d}.png", image)


def plan_training(
    scene: str | Path | Dataset,
    budget: Budget,
    *,
    material_prior: str | None = None,
    mesh: str | Path | MeshSettings | None = None,
    overrides: Sequence[str] = (),
    downscale: int | None = None,
    layout: str | None = None,
    light: str | None = None,
) -> Plan:
    """Choose settings for a budget on this machine, whose speed is measured first.

    Parameters
    ----------
    scene : folder, or a dataset; the photographs of a dataset are not reduced any further.
    budget, material_prior, mesh, overrides, downscale : see `budget.plan`.
    layout, light : see `load_dataset`.

    Raises
    ------
    SceneError
        See `load_dataset`.
    TrainingError
        See `budget.plan`.
    """
    if isinstance(scene, Dataset):
        size, downscale = (scene.train.height, scene.train.width), 1
    else:
        size = photograph_size(scene, layout=layout, light=light)
    return plan(
        budget,
        size,
        slowness=slowness_of_machine(),
        material_prior=material_prior,
        mesh=mesh,
        overrides=overrides,
        downscale=downscale,
    )


def train(
    scene: str | Path | Dataset,
    output: str | Path,
    config: Config | None = None,
    *,
    quality: str | None = None,
    mesh: str | Path | MeshSettings | None = None,
    begin: Begin = ANEW,
    budget: Budget | None = None,
    model: Literal["auto"] | ModelChoice | None = None,
    devices: int | Devices = 1,
    listener: Listener = NOBODY,
    began: float | None = None,
    **reading: Any,
) -> Run:
    """Train a scene into a run's folder.

    Parameters
    ----------
    scene : folder, or a dataset from `load_dataset`.
    output : folder of the run.
    config : settings, see `make_config`; by default those of ``quality``.
    quality : one of `QUALITIES`, by default ``standard``; not together with a config or a budget.
    mesh : file of a mesh to start from instead of a visual hull, see `fit.presets.with_mesh`. A run
        that is resumed keeps its mesh.
    begin : ``Resume()`` continues the run that the folder holds, ``Anew(replace=True)`` replaces
        it, and ``TakeOver(run, stage)`` takes the stages before ``stage`` from another run. By
        default the folder must hold no run.
    budget : time and memory that the training may take. Without ``config``, settings are chosen
        that fit both (`plan_training`). The numbers of steps are adapted during the training, so
        that it ends in time. A run that is resumed keeps its budget, less the time that it has
        used, and without ``config`` also its settings and how its scene was read; a run that began
        without a budget cannot get one.
    model : ``auto``, or a `ModelChoice`: train the smallest model that explains the scene, see
        `model_choice.choose_model`. Parts of ``config`` whose settings differ from its preset, or
        that `ModelChoice.by_hand` names, stay as they are. A run that is resumed keeps its model.
    devices : number of devices of this process that share the views of every step
        (docs/devices.md), or what `fit.devices.choose_devices` returned. All processes that
        `jax.distributed.initialize` connected take part, with the same number each.
    listener : receives every step, compilation, preview, and part of a model that was tried.
    began : `time.perf_counter` when the time of the training began to count; by default now.
    reading : how to read the scene: ``downscale``, ``light``, ``bounds`` (six numbers), ``cameras``
        (a file of `Run.refine_cameras`), and other options of `load_dataset`.

    Returns
    -------
    The run, opened.

    Raises
    ------
    TypeError
        On any other keyword, on options of reading together with a dataset, which has been read
        already, and on a quality together with a config, a budget or a run that keeps its settings.
    SceneError, RunError, TrainingError, CheckpointError, Interrupted
        See `load_dataset` and `fit.train.fit`.
    ValueError
        If the mesh cannot be used, see `io.start_mesh`, or is another than that of the settings; if
        a model is to be chosen under a budget, for stages of another run, by several hosts, or from
        too few views.
    """
    _require_consistent(scene, reading, chooses=model is not None, budget=budget, begin=begin)
    if quality is not None and not (config is None and budget is None):
        raise TypeError(
            "quality cannot be given with a config or a budget, which decide how much is spent; "
            "leave quality out"
        )
    start_time, folder = time.perf_counter() if began is None else began, RunFolder(output)
    if isinstance(devices, int):
        devices = choose_devices(devices)
    if model is not None and jax.process_count() > 1:  # asked after the devices were made
        raise ValueError("a model is chosen by one host; leave model out")
    is_resumed = begin.continues(folder)
    request = _Request(config, mesh, budget, reading)
    if is_resumed:
        request = _as_it_began(request, folder, chooses=model is not None)
        if quality is not None and request.config is not None:
            raise TypeError(
                f"the run in {folder} keeps the settings that were chosen for it; leave quality out"
            )
    config, budget, reading = _settled(request, scene, quality=quality or "standard")
    dataset = scene if isinstance(scene, Dataset) else load_recorded(scene, reading)
    evidence = None
    if model is not None and not is_resumed:
        how = ModelChoice() if model == "auto" else model
        choice = _chosen_model(dataset, config, folder, how, begin, listener)
        config, evidence = choice.config, choice.record()
        start_time = time.perf_counter()  # the time of the choice is reported separately
    earlier_seconds = (folder.training() or {}).get("seconds_total", 0.0) if is_resumed else 0.0
    used_seconds = folder.seconds_used() if is_resumed else 0.0
    pacer = None
    if budget is not None:
        planned_config = folder.planned() if is_resumed else config
        pacer = _pacer(budget, dataset, planned_config, began=start_time - used_seconds)
    previews = _Previews(dataset, folder, pacer)
    try:
        fit(
            dataset,
            config,
            folder.path,
            begin=begin,
            listener=Listeners(listener, previews),
            pacer=pacer,
            devices=devices,
            model=evidence,
        )
    finally:
        previews.finish()
    if devices.is_first_host:
        # Of an earlier, interrupted part of the training only the steps' seconds are known.
        seconds = max(earlier_seconds, used_seconds) + time.perf_counter() - start_time
        folder.write_training({"seconds_total": round(seconds, 2)})
    run = Run(folder.path)
    run.dataset = dataset
    return run


class _Request(NamedTuple):
    """Arguments of `train` that the record of a resumed run may complete; None if not given."""

    config: Config | None
    mesh: str | Path | MeshSettings | None
    budget: Budget | None
    reading: dict[str, Any]


def _require_consistent(
    scene: str | Path | Dataset,
    reading: dict[str, Any],
    *,
    chooses: bool,
    budget: Budget | None,
    begin: Begin,
) -> None:
    """Raise TypeError or ValueError, see `train`, if its arguments do not go together."""
    if unknown_options := sorted(set(reading) - set(READING_OPTIONS)):
        raise TypeError(
            f"train takes no {', '.join(unknown_options)}; a scene is read by "
            f"{', '.join(sorted(READING_OPTIONS))}, and settings belong in the config"
        )
    if isinstance(scene, Dataset) and reading:
        raise TypeError(
            f"a dataset has been read already; give {', '.join(sorted(reading))} to load_dataset, "
            "or the scene's folder to train"
        )
    if chooses and (budget is not None or begin.takes_over):
        raise ValueError("a model is chosen for a whole training without a budget; leave model out")


def _as_it_began(request: _Request, folder: RunFolder, *, chooses: bool) -> _Request:
    """Complete a request to resume a run by the record of that run.

    A run whose model was chosen keeps its settings if the request has none, or asks to choose
    again. A run with a budget keeps its settings if the request has none, or has the planned ones
    or the present ones, whose steps the pacer may have changed. Both then keep the budget and how
    the scene was read. Other settings stay as requested; `resumed_loop` refuses them if they are
    not those of the run. A start mesh that is not given is that of the run.
    """
    if chooses and not folder.has_chosen_model:
        raise RunError(
            f"the run in {folder} was begun without choosing a model; leave the choice out, or "
            "begin anew with --force"
        )
    config, mesh, budget, reading = request
    if budget is not None and folder.budget() is None:
        raise RunError(f"the run in {folder} was begun without a budget; leave the budget out")
    keeps_model = folder.has_chosen_model and (config is None or chooses)
    has_budget = folder.budget() is not None
    if keeps_model or (has_budget and config in (None, folder.planned(), folder.config())):
        config, reading = folder.config(), folder.record()["dataset"]
        budget = folder.budget() or budget
    has_own_mesh = config is not None and isinstance(config.geometry, MeshSettings)
    if mesh is None and not has_own_mesh:
        mesh = mesh_of_run(folder)
    return _Request(config, mesh, budget, reading)


def _settled(
    request: _Request, scene: str | Path | Dataset, *, quality: str
) -> tuple[Config, Budget | None, dict[str, Any]]:
    """Return settings, budget and how to read the scene: as requested, chosen, or by default."""
    config, mesh, budget, reading = request
    if config is None and budget is not None:
        training_plan = plan_training(
            scene,
            budget,
            mesh=mesh,
            downscale=reading.get("downscale"),
            layout=reading.get("layout"),
            light=reading.get("light"),
        )
        return training_plan.config, budget, {**reading, "downscale": training_plan.downscale}
    config = config or make_config(quality=quality)
    return (config if mesh is None else with_mesh(config, mesh)), budget, reading


def _chosen_model(
    dataset: Dataset,
    config: Config,
    folder: RunFolder,
    how: ModelChoice,
    begin: Begin,
    listener: Listener,
) -> ChosenModel:
    """Choose the model of a new run; what its settings change of their preset counts as by hand."""
    folder.require_free(replace=begin.replace)
    dataset.require_masks("train")
    by_hand = tuple(dict.fromkeys((*how.by_hand, *changed_from_preset(config))))
    how = replace(how, by_hand=by_hand)
    return choose_model(dataset, config, folder.path, how, begin=begin, listener=listener)


def _pacer(budget: Budget, dataset: Dataset, config: Config, *, began: float) -> Pacer:
    """Return the pacer that keeps a training within its budget on this machine."""
    pixels = float(dataset.train.height * dataset.train.width)
    costs = expected_costs(config, pixels, slowness=slowness_of_machine())
    return Pacer(budget, config, costs, began=began)
