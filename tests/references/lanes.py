"""Numbers with lanes: vectors of them, decisions on them, and exact derivatives.

A number is an array of any shape, usually () or (lanes,); a vector has its components in front:
(3,) or (3, lanes). All lanes of a number share their real part, so a decision (a sign, a
threshold, an order) is the same in every lane.
"""

import numpy as np

STEP = 1e-30
LANES = 256


def real(number):
    """The value on which decisions are made: the common real part of all lanes."""
    return float(np.ravel(np.real(number))[0])


def magnitude(number):
    """The absolute value, continued analytically from the real axis."""
    return number if real(number) >= 0 else -number


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def length(a):
    return np.sqrt(dot(a, a))


def normalize(a):
    return a / length(a)


def contract(cotangents, outputs):
    """Sum of all outputs times their cotangents, a number."""
    total = 0.0
    for name, cotangent in cotangents.items():
        for index in np.ndindex(cotangent.shape):
            total = total + cotangent[index] * outputs[name][index]
    return total


def gradient(function, inputs):
    """Gradient of ``function(**inputs)``, a number, with respect to every input array.

    Complex step: ``Im f(x + i h) / h`` has no difference of close numbers in it, so ``h`` can be
    so small that the result is exact to rounding (Squire and Trapp 1998). It asks that ``f`` is
    analytic around the real axis: no ``abs``, no ``conj``; compare with `difference`.
    """
    result = {}
    for name, value in inputs.items():
        flat_gradient = []
        for start in range(0, value.size, LANES):
            count = min(LANES, value.size - start)
            complex_inputs = {
                key: np.repeat(x[..., None], count, axis=-1) for key, x in inputs.items()
            }
            step = np.zeros((value.size, count))
            step[start + np.arange(count), np.arange(count)] = STEP
            complex_inputs[name] = complex_inputs[name] + 1j * step.reshape(*value.shape, count)
            flat_gradient.append(np.imag(np.broadcast_to(function(**complex_inputs), count)) / STEP)
        result[name] = np.concatenate(flat_gradient).reshape(value.shape)
    return result


def difference(function, inputs, directions, *, step=1e-3):
    """Derivative along a direction by central differences, extrapolated twice (Richardson)."""

    def central(size):
        values = [
            function(**{k: x + sign * size * directions[k] for k, x in inputs.items()})
            for sign in (1, -1)
        ]
        return (values[0] - values[1]) / (2 * size)

    table = [central(step / 2**k) for k in range(3)]
    for order in (1, 2):
        factor = 4**order
        table = [(factor * b - a) / (factor - 1) for a, b in zip(table, table[1:], strict=False)]
    return float(table[0])
