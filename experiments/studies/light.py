"""Learn the light alone before Monte Carlo, to see whether this improves the result.

After the split-sum stage, light and materials were separated by means of an approximation. This
study takes over that stage of a run, learns only light and exposure for some Monte Carlo steps,
with the materials of the split sum, and then trains `monte_carlo` and the later stages as usual.
Compare the result with the run itself by ``geosplat-jax evaluate``::

    python experiments/studies/light.py RUN --output OTHER [--steps 60] [--rate 0.02]
"""

import argparse
from dataclasses import replace
from pathlib import Path

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.begin import TakeOver
from geosplat_jax.fit.config import Config, Rate
from geosplat_jax.fit.listener import Listener, Progress
from geosplat_jax.fit.presets import MONTE_CARLO
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.train import fit
from geosplat_jax.run import Run


class _Printed(Listener):
    """Prints every fiftieth step."""

    def on_step(self, progress: Progress) -> None:
        """Print where the training is."""
        if progress.step % 50 == 0:
            print(progress.step, progress.stage, f"{progress.psnr:.2f} dB")


def with_light_stage(config: Config, *, steps: int, rate: float) -> Config:
    """Return the settings of a run with a stage that learns the light alone before Monte Carlo.

    Parameters
    ----------
    config : settings of the run; its other stages are not changed.
    steps : number of steps of the new stage.
    rate : learning rate of the light; that of the exposure is half of it.
    """
    next_stage = config.stage(MONTE_CARLO)
    position = config.stages.index(next_stage)
    learned_rates = {"light": Rate(rate), "exposure": Rate(0.5 * rate)}
    light = replace(
        next_stage,
        name="light",
        steps=steps,
        enter=(),
        rates={name: learned_rates.get(name, Rate(0.0)) for name in next_stage.rates},
    )
    return replace(config, stages=(*config.stages[:position], light, *config.stages[position:]))


def main() -> None:
    """Train with a stage of light alone before Monte Carlo."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--rate", type=float, default=0.02)
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    run = Run(arguments.run)
    config = with_light_stage(run.config, steps=arguments.steps, rate=arguments.rate)
    begin = TakeOver(arguments.run, "light")
    fit(run.dataset, config, arguments.output, begin=begin, listener=_Printed())


if __name__ == "__main__":
    main()
