"""Train on the bundled scene, relight it, evaluate, export (`make demo`)."""

import argparse
import time
from pathlib import Path

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.begin import Anew
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, in_background
from geosplat_jax.report.relight import RelightOptions
from geosplat_jax.run import train

# Quality is between draft and standard: each point of the crown needs a cell of its own. The crown
# is recognised as metal if materials start between metals and dielectrics. In so few steps of Monte
# Carlo the light stays coloured unless its cast weighs more than by default.
MATERIAL_PRIOR = "neutral"
OVERRIDES = (
    "geometry.resolution=44",
    "stages.split_sum.steps=300",
    "stages.split_sum.half_life=300.0",
    "stages.monte_carlo.steps=120",
    "stages.split_sum.weights.light_cast=0.01",
    "stages.monte_carlo.weights.light_cast=0.01",
)
FRAMES = 36
# Metrics and movie have the same number of samples, so that they share compiled programs.
SAMPLES = 32
SCENE = Path(__file__).resolve().parents[1] / "examples" / "duck"


def main() -> None:
    """Run the demo; about eight minutes on two cores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("demo"))
    folder = parser.parse_args().output
    enable_compilation_cache()
    retain_freed_memory()
    began = time.perf_counter()
    config = make_config("default", "draft", material_prior=MATERIAL_PRIOR, overrides=OVERRIDES)
    run = train(SCENE, folder, config, begin=Anew(replace=True))
    # Evaluation runs beside the movie: both wait for the compiler, which uses one core.
    evaluation = in_background(lambda: run.evaluate(samples=SAMPLES))
    movie = RelightOptions(turntable=FRAMES, suffix=".gif", frames_per_second=12.0)
    run.relight(SCENE.parent / "sunset.hdr", options=movie, samples=SAMPLES)
    run.export()
    evaluation.result()
    print(
        f"\nDone in {time.perf_counter() - began:.0f} s. Look at:\n"
        f"  {folder / 'report.html'}  all of it as one page\n"
        f"  {folder / 'overview.png'}  test views: truth, render, normals, materials, mesh, light\n"
        f"  {folder / 'relight.png'}  the duck under two lights that are new, beside the truth\n"
        f"  {folder / 'materials.png'}  albedo, roughness, metallic, normals, beside the truth\n"
        f"  {folder / 'relight_sunset' / 'turntable.gif'}  once around, at sunset\n"
        f"  {folder / 'previews'}/  the first test view while training\n"
        f"  {folder / 'export' / 'mesh.glb'}  textured mesh for any glTF viewer"
    )


if __name__ == "__main__":
    main()
