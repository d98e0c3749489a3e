"""Whether a larger model explains held-back views better than a smaller one; plain NumPy.

Both models are measured on the same views, in decibels. What makes one view harder than another is
the same for both models and cancels in the difference of each view, so gains are *paired*.
Neighbouring views see the same part of the object and have similar errors, so they are grouped into
blocks. A training with another seed also ends with another result: a gain must exceed the standard
deviation over seeds, which is a low hurdle (docs/models.md).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Evidence:
    """A larger model against a smaller one.

    Attributes
    ----------
    gain : mean over views, and over the seeds of both models, of the larger model's decibels minus
        the smaller one's.
    standard_error : of the gain, over blocks of views; infinite for fewer than two blocks.
    spread : standard deviation over seeds of the smaller model's mean, divided by the root of the
        number of seeds that the gain is a mean of; 0 where the smaller model has one seed.
    seeds : number of seeds that the gain is a mean of.
    """

    gain: float
    standard_error: float
    spread: float = 0.0
    seeds: int = 1

    @property
    def is_kept(self) -> bool:
        """Whether the gain exceeds both its standard error and the spread over seeds."""
        return self.exceeds_error and self.gain > self.spread

    @property
    def exceeds_error(self) -> bool:
        """Whether the gain exceeds its standard error over views."""
        return self.gain > self.standard_error


@dataclass(frozen=True)
class Rung:
    """Result of trying a part of a model.

    Attributes
    ----------
    part, title : name of the part in files, and its name for people.
    smaller : mean decibels of the held-back views without the part; None where that training
        failed.
    larger : the same with the part; None where its training failed, and for a part that is not
        chosen by its gain (`Part.shows_in_photographs`) or that no trial contains.
    found : the gain and its errors; None where there are not both.
    is_kept : whether the part was kept.
    note : why there is no gain to compare, or which other parts were added with this one.
    """

    part: str
    title: str
    smaller: float | None
    larger: float | None
    found: Evidence | None
    is_kept: bool
    note: str = ""


def every_nth(count: int, step: int) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " H"]]:
    """Split view numbers into those to train on and every ``step``-th one, which is held back.

    The first number that is held back is ``step // 2``.

    Returns
    -------
    used : (T,) numbers of the views to train on.
    held : (H,) numbers of the views that are held back.
    """
    numbers = np.arange(count)
    is_held = numbers % step == step // 2
    return numbers[~is_held], numbers[is_held]


def neighbouring_blocks(directions: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """Group views into blocks of neighbours.

    A path leads from each view to the nearest one that it has not visited yet; it is cut into about
    ``sqrt(2 V)`` blocks of equal length.

    Parameters
    ----------
    directions : (V, 3) unit, from the object towards the cameras.

    Returns
    -------
    (V,) number of the block of every view, from 0.
    """
    count = len(directions)
    unvisited = set(range(1, count))
    order = [0] if count else []
    while unvisited:
        last_direction = directions[order[-1]]
        order.append(
            min(unvisited, key=lambda view: (-float(directions[view] @ last_direction), view))
        )
        unvisited.remove(order[-1])
    blocks = np.zeros(count, int)
    block_count = min(count, max(round(math.sqrt(2 * count)), 1))
    for block, views in enumerate(np.array_split(np.asarray(order, int), max(block_count, 1))):
        blocks[views] = block
    return blocks


def clustered_error(values: Float[np.ndarray, " V"], blocks: Int[np.ndarray, " V"]) -> float:
    """Return the standard error of the mean of values that are correlated within blocks.

    ``SE^2 = B / (B - 1) sum_b (sum_{v in b} (x_v - mean))^2 / V^2`` over B blocks (Liang and Zeger
    1986, for a mean). With blocks of one view it is the usual standard error. Infinite for fewer
    than two blocks.

    Parameters
    ----------
    values : (V,) values of the views.
    blocks : (V,) block of each view.
    """
    _, block_indices = np.unique(blocks, return_inverse=True)
    count = int(block_indices.max(initial=-1)) + 1
    if count < 2:
        return math.inf
    sums = np.bincount(block_indices, weights=values - values.mean())
    return float(np.sqrt(count / (count - 1) * np.sum(sums**2)) / len(values))


def compare(
    larger: Mapping[int, Float[np.ndarray, " V"]],
    smaller: Mapping[int, Float[np.ndarray, " V"]],
    blocks: Int[np.ndarray, " V"],
) -> Evidence:
    """Compare two models on the same V views.

    Models are compared seed by seed; a seed that only the smaller model has counts for the spread.

    Parameters
    ----------
    larger : (V,) decibels of the larger model, by seed.
    smaller : (V,) decibels of the smaller model, by seed.
    blocks : (V,) block of each view.

    Raises
    ------
    ValueError
        If no seed is common to both models.
    """
    seeds = larger.keys() & smaller.keys()
    if not seeds:
        raise ValueError("models are compared seed by seed, and these have no seed in common")
    gains = np.mean([larger[seed] - smaller[seed] for seed in sorted(seeds)], axis=0)
    means = [float(np.mean(decibels)) for decibels in smaller.values()]
    spread = float(np.std(means, ddof=1)) / math.sqrt(len(seeds)) if len(means) > 1 else 0.0
    return Evidence(float(gains.mean()), clustered_error(gains, blocks), spread, len(seeds))
