"""The fastest variant of Mitsuba that renders on this machine."""

import subprocess
import sys

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
"""Variants to try, the fastest first."""

# Run in another process, since an LLVM that lacks an instruction aborts instead of raising.
_PROBE = """
import sys, mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
light = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
ball = {"type": "sphere", "center": [0, 0, 5], "bsdf": {"type": "principled", "metallic": 1.0}}
sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
parts = {"integrator": {"type": "path"}, "sensor": sensor, "light": light, "ball": ball}
assert np.isfinite(np.array(mi.render(mi.load_dict({"type": "scene", **parts}), spp=4))).all()
"""


def choose_variant(requested: str = "auto") -> str:
    """Set a variant of Mitsuba and name it.

    Parameters
    ----------
    requested
        A variant, or `auto`: the first of `VARIANTS` that renders.

    Raises
    ------
    RuntimeError
        If none renders; the message holds what the last one printed.
    """
    import mitsuba

    if requested != "auto":
        mitsuba.set_variant(requested)
        return requested
    last_error = ""
    for variant in VARIANTS:
        if variant not in mitsuba.variants():
            continue
        command = [sys.executable, "-c", _PROBE, variant]
        process = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if process.returncode == 0:
            mitsuba.set_variant(variant)
            return variant
        last_error = process.stderr[-2000:]
    raise RuntimeError(f"no variant of {VARIANTS} renders here; the last one said: {last_error}")
