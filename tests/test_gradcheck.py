"""The gradient check: every part passes it, and planted faults do not."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax import cli
from geosplat_jax.gradcheck import report
from geosplat_jax.gradcheck.differences import STEPS, Problem, compare, double_precision
from geosplat_jax.gradcheck.geometry_parts import adapter_problems
from geosplat_jax.gradcheck.report import PARTS, check_part, passes, summary, table

SLOW_PARTS = {
    "denoiser",
    "mesh",
    "adapter",
    "isosurface",
    "loss",
    "refinement",
    "materials",
    "models",
    "paths",
    "projection",
    "rasterizer",
    "transport",
}


LONG_PARTS = {"loss", "refinement"}
"""Parts whose check takes minutes; `make test-long` runs them."""


def marks(part):
    """Return the marks of a part: how long its check takes."""
    slow = [pytest.mark.slow, pytest.mark.computes] if part in SLOW_PARTS else []
    return [*slow, pytest.mark.long] if part in LONG_PARTS else slow


@pytest.mark.parametrize(
    "part",
    [pytest.param(p, marks=marks(p)) for p in PARTS],
)
def test_every_gradient_agrees_with_differences(part):
    rows = check_part(part)
    failing_rows = [row for row in rows if not passes(row)]
    assert rows
    assert not failing_rows, table(failing_rows)
    # A table of zeros would pass, so many of the pairs must truly depend on each other.
    assert np.mean([row.norm > 0 for row in rows]) > 0.4


def test_splats_whose_scales_are_differentiated_have_a_size():
    """Splats on vertices that see their faces from behind would have none, and no gradient."""
    with double_precision():
        for problem in adapter_problems(np.random.default_rng(0)):
            inputs = jax.tree.map(jnp.asarray, problem.inputs)
            outputs = problem.function(inputs, jax.tree.map(jnp.asarray, problem.constants))
            if "scales" in outputs:
                is_real = outputs["opacities"] > 0
                assert (outputs["scales"][is_real][:, :2] > 1e-2).all()


@jax.custom_vjp
def _faulty_square(x, factor):
    return x * x


_faulty_square.defvjp(
    lambda x, factor: (x * x, (x, factor)), lambda kept, c: (2 * kept[0] * kept[1] * c, None)
)


def _square_problem(factor):
    """Return ``x^2`` with a gradient that is wrong by ``factor``, an array with one per entry."""

    def function(inputs, constants):
        factors = jnp.asarray(factor, inputs["x"].dtype)
        return {"y": _faulty_square(inputs["x"], factors)}

    return Problem("square", function, {"x": np.linspace(0.5, 2.0, 6)})


def _only(problem, **kwargs):
    with double_precision():
        (row,) = compare(problem, **kwargs)
    return row


def test_a_right_gradient_is_proved_to_ten_digits():
    row = _only(_square_problem(np.ones(6)))
    assert row.is_full
    assert row.checked == row.total == 6
    assert max(row.relative, row.along_gradient, row.random_direction) < 1e-10
    assert row.uncertainty < 1e-9
    assert row.norm == pytest.approx(np.sqrt(np.sum((2 * np.linspace(0.5, 2.0, 6)) ** 2)))


@pytest.mark.parametrize("fault", [1 + 1e-5, -1.0, 0.0, 2.0])
def test_a_fault_in_one_entry_is_found_and_located(fault):
    factors = np.ones(6)
    factors[4] = fault
    row = _only(_square_problem(factors))
    assert not passes(row)
    assert row.worst == "d y[4] / d x[4]"
    numeric, analytic = row.worst_values
    assert analytic == pytest.approx(fault * numeric, rel=1e-8)
    assert row.one_minus_cosine > 1e-13


def test_a_missing_dependence_is_a_failure_and_not_a_zero():
    def function(inputs, constants):
        return {"y": jnp.sum(jax.lax.stop_gradient(inputs["x"]) ** 2)[None]}

    row = _only(Problem("detached", function, {"x": np.array([1.0, 2.0])}))
    assert row.norm == 0
    assert not passes(row)
    assert row.relative == pytest.approx(np.sqrt(20.0))


def test_pairs_that_carry_no_gradient_by_contract_are_left_out():
    def function(inputs, constants):
        return {"y": jax.lax.stop_gradient(inputs["x"]) * inputs["z"]}

    problem = Problem("skip", function, {"x": np.ones(2), "z": np.ones(2)})
    with double_precision():
        assert {row.group for row in compare(problem)} == {"x", "z"}
        (row,) = compare(replace(problem, skip=frozenset({("y", "x")})))
    assert row.group == "z"
    assert passes(row)


def test_a_fault_in_a_sampled_group_is_found():
    """The entries are too many to try each; the combination along the gradient shows the fault."""
    factors = np.ones(4000)
    factors[:400] = 1.01
    weights = np.random.default_rng(0).uniform(0.5, 1.5, 4000)

    def problem(factor):
        def function(inputs, constants):
            return {"y": _faulty_square(inputs["x"], jnp.asarray(factor, inputs["x"].dtype))}

        return Problem("large", function, {"x": weights}, full=100)

    right_row, wrong_row = _only(problem(np.ones(4000))), _only(problem(factors))
    assert passes(right_row)
    assert right_row.checked < right_row.total == 4000
    assert not right_row.is_full
    assert not passes(wrong_row)
    assert wrong_row.along_gradient > 1e-4


def test_steps_tell_truncation_from_rounding():
    def curved(inputs, constants):
        return {"y": jnp.sin(3000 * inputs["x"])}

    def offset(inputs, constants):
        return {"y": 1e6 + jnp.sin(inputs["x"])}

    x = {"x": np.linspace(0.1, 1.0, 4)}
    sharp, blurred = _only(Problem("c", curved, x)), _only(Problem("o", offset, x))
    assert sharp.sweep[2] > 1e-3  # truncation dominates at large steps,
    assert sharp.sweep[3] / sharp.sweep[4] == pytest.approx(16, rel=0.05)  # and falls as h^2;
    assert blurred.sweep[-1] > 1e-5  # rounding dominates at small ones.
    assert sharp.step < blurred.step
    assert sharp.relative < 1e-7
    # The row says how little these differences prove.
    assert blurred.uncertainty > blurred.relative
    assert len(sharp.sweep) == len(STEPS)


def test_loss_of_digits_in_float32_is_a_failure():
    def function(inputs, constants):
        return {"y": jnp.sin(1e6 * inputs["x"])}

    row = _only(
        Problem("steep", function, {"x": np.array([0.31234567, 0.71234567])}, scales={"x": 1e-6})
    )
    assert row.relative < 1e-6
    assert row.single > 1e-3
    assert not passes(row)
    row = _only(
        Problem("steep", function, {"x": np.array([0.31234567, 0.71234567])}, scales={"x": 1e-6}),
        single=False,
    )
    assert passes(row)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_gradient_that_is_not_a_number_fails(precision):
    def function(inputs, constants):
        x = inputs["x"]
        bad = jnp.sqrt(0 * x) if x.dtype == precision else jnp.zeros_like(x)
        return {"y": x + bad}

    row = _only(Problem("nan", function, {"x": np.array([1.0, 2.0])}))
    assert not passes(row)
    assert "FAILS" in table([row])


def test_nested_groups_are_named_by_their_leaves():
    def function(inputs, constants):
        return {"y": inputs["net"]["bias"] * 2 + inputs["net"]["layers"][0][0] * constants}

    net = {"bias": np.zeros(2), "layers": [np.array([[1.0, 2.0]])]}
    row = _only(Problem("names", function, {"net": net}, constants=np.array([1.0, 5.0])))
    assert passes(row)
    assert row.total == 4
    assert row.worst.startswith("d y[")


def test_the_table_shows_failures_worst_entries_and_zeros():
    def function(inputs, constants):
        factors = jnp.asarray([1.0, 1.1], inputs["x"].dtype)
        return {"y": _faulty_square(inputs["x"], factors)}

    problem = Problem("shown", function, {"x": np.array([1.0, 2.0]), "unused": np.ones(3)})
    with double_precision():
        rows = compare(problem)
    text = table(rows, sweep=True)
    assert "FAILS" in text
    assert "d y[1] / d x[1]" in text
    assert "zero in both: y <- unused" in text
    assert "plain differences by step" in text
    assert "FAILS" in summary({"shown": rows})


def test_the_summary_hides_no_number_that_is_none():
    def function(inputs, constants):
        return {"y": inputs["x"] ** 2, "z": inputs["x"] ** 3}

    with double_precision():
        good, bad = compare(Problem("shown", function, {"x": np.array([1.0, 2.0])}))
    bad = replace(bad, relative=np.nan, one_minus_cosine=np.nan, random_direction=np.nan)
    assert summary({"shown": [good, bad]}).splitlines()[1].count("nan") == 3


def test_an_unknown_part_is_refused():
    with pytest.raises(ValueError, match="unknown part 'teapot'; expected some of isosurface"):
        check_part("teapot")


def test_the_command_prints_the_table_and_writes_the_records(capsys, tmp_path):
    path = tmp_path / "rows.json"
    assert cli.main(["gradcheck", "light", "--json", str(path)]) == 0
    output = capsys.readouterr().out
    assert "specular <- roughness" in output
    assert "float32" in output
    records = json.loads(path.read_text())
    assert {record["part"] for record in records} == {"light"}
    assert all(record["relative"] < 1e-6 for record in records)


def test_the_command_fails_when_a_gradient_does(capsys, monkeypatch):
    factors = np.ones(6)
    factors[2] = 1.5
    monkeypatch.setitem(report.PARTS, "light", lambda rng: [_square_problem(factors)])
    assert cli.main(["gradcheck", "light"]) == 1
    captured = capsys.readouterr()
    assert "FAILS" in captured.out
    assert "d y[2] / d x[2]" in captured.err


def test_the_command_names_the_parts_when_one_is_unknown(capsys):
    assert cli.main(["gradcheck", "teapot"]) == 2
    assert "rasterizer" in capsys.readouterr().err
