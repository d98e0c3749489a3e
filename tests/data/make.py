"""Write the oracles of the tests, from the slow references alone: `python tests/data/make.py`."""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from references.cases import CASES  # noqa: E402


def main():
    for name, case in CASES.items():
        path = HERE / f"{name}.npz"
        np.savez_compressed(path, **case())
        print(f"{path.name:28s} {path.stat().st_size / 1000:6.1f} kB")


if __name__ == "__main__":
    main()
