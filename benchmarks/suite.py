"""Run every benchmark; print ratios to the calibration kernels; compare with the baseline.

    python -m benchmarks.suite                  # table
    python -m benchmarks.suite --gate 1.6       # exit 1 if a ratio grew by a factor above 1.6
    python -m benchmarks.suite --save           # write benchmarks/baseline.json (--only: in part)

Machines differ and are shared. So the comparable figure is the ratio of a median to that of
``sum(exp(x))`` over 16M float32, timed right before and right after in the same process.
"""

import argparse
import json
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import jax

from benchmarks import bench_geometry, bench_hashgrid, bench_rasterize, bench_step, bench_trace
from benchmarks.calibration import calibrate
from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.runtime import enable_compilation_cache

BASELINE = Path(__file__).with_name("baseline.json")


def _flat(values: dict, prefix: str = "") -> dict[str, float]:
    """Flatten nested results to the entries that are median wall times in milliseconds."""
    medians = {}
    for name, value in values.items():
        if isinstance(value, dict):
            medians |= _flat(value, f"{prefix}{name}.")
        elif name.endswith("_ms") and not name.endswith(
            ("min_ms", "processor_ms", "exp_ms", "sort_ms", "yardstick_ms")
        ):
            medians[prefix + name] = float(value)
    return medians


def measure(name: str, benchmark: Callable[[], dict]) -> dict[str, dict[str, float]]:
    """Run one benchmark between two calibrations; milliseconds and ratio of each median."""
    first_exp_ms = calibrate()["exp_ms"]
    results = _flat(benchmark())
    reference = 0.5 * (first_exp_ms + calibrate()["exp_ms"])
    return {
        f"{name}.{key}": {"ms": round(value, 2), "ratio": round(value / reference, 2)}
        for key, value in results.items()
    }


def main() -> int:
    """Run the suite."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="run the benchmarks whose name contains this")
    parser.add_argument(
        "--gate", type=float, help="largest growth of a ratio that passes; both sides must be known"
    )
    parser.add_argument("--save", action="store_true", help="make this the baseline")
    parser.add_argument("--whole", action="store_true", help="time a whole draft run as well")
    options = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    benchmarks = {
        "rasterize": bench_rasterize.run,
        "geometry": bench_geometry.run,
        "hashgrid": bench_hashgrid.run,
        "step": bench_step.run,
        "trace": bench_trace.run,
    }
    if options.whole:
        benchmarks["run"] = bench_step.run_whole
    baseline = json.loads(BASELINE.read_text())["results"] if BASELINE.exists() else {}
    results, problems, other_results = {}, [], dict(baseline)
    print(f"{'benchmark':58s} {'ms':>10s} {'ratio':>9s} {'baseline':>9s}")
    for name, benchmark in benchmarks.items():
        if options.only and options.only not in name:
            continue
        other_results = {
            key: entry for key, entry in other_results.items() if key.split(".")[0] != name
        }
        for key, entry in measure(name, benchmark).items():
            results[key] = entry
            baseline_ratio = baseline.get(key, {}).get("ratio")
            print(f"{key:58s} {entry['ms']:10.1f} {entry['ratio']:9.2f} {baseline_ratio or '-':>9}")
            if options.gate and baseline_ratio is None:
                problems.append(f"{key} is not in the baseline; save a new one")
            elif options.gate and entry["ratio"] > options.gate * baseline_ratio:
                problems.append(f"{key} is slower: ratio {entry['ratio']} against {baseline_ratio}")
    if options.gate and not options.only:
        problems += [
            f"{key} is in the baseline only"
            for key in baseline
            if key.split(".")[0] in benchmarks and key not in results
        ]
    if options.save:
        results = other_results | results if options.only else results
        machine = {"jax": jax.__version__, "python": platform.python_version()}
        BASELINE.write_text(json.dumps({"machine": machine, "results": results}, indent=1) + "\n")
    for line in problems:
        print(line, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
