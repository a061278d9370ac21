"""A function's program in float64, and what the check of gradients can do with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import normal, uniform

from zestjax.testing import assert_grads_match
from zestjax.testing.raised import raised, wide

ROWS = np.array([2, 0, 2])
BATCH = {"x": np.asarray(normal(0, 5, 3)), "y": np.asarray(normal(1, 5)), "row": np.arange(5)}


def in_float64(fn, *args):
    """What a raised function gives of float32 arguments, each entry as numpy has it."""
    again = raised(fn, *args)
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, again(*wide(args)))


def loop(x):
    return jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, jnp.sin(s[1])), (0, x))[1]


def branch(x):
    return jax.lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x)


def scanned(x):
    return jax.lax.scan(lambda total, row: (total + row, total * row), jnp.zeros(3), x, reverse=True)[1]


def scattered(x):
    return jnp.zeros((3, 3)).at[ROWS].add(jnp.sin(x[:3]))


def scattered_by_numpy(x):
    found = np.zeros((3, 3))
    np.add.at(found, ROWS, np.sin(x[:3]))
    return found


def scanned_by_numpy(x):
    return (np.cumsum(x[::-1], 0) - x[::-1])[::-1] * x


@pytest.mark.parametrize(
    "fn, expected",
    [
        (lambda x: x @ BATCH["x"].T, lambda x: x @ BATCH["x"].T.astype(np.float64)),
        (lambda x: x.astype(jnp.bfloat16).astype(jnp.float32) / 3, lambda x: x / 3),
        (jax.jit(jnp.tanh), np.tanh),
        (jax.checkpoint(jnp.tanh), np.tanh),
        (lambda x: jax.nn.relu(jnp.sin(x)), lambda x: np.maximum(np.sin(x), 0)),
        (loop, lambda x: np.sin(np.sin(np.sin(x)))),
        (branch, np.cos),
        (jax.vmap(loop), lambda x: np.sin(np.sin(np.sin(x)))),
        (scanned, scanned_by_numpy),
        (scattered, scattered_by_numpy),
        (lambda x: jax.lax.reduce_precision(x, 5, 2), lambda x: x),
        (lambda x: x * jnp.arange(3, dtype=jnp.float32)[None], lambda x: x * np.arange(3)),
        (jax.grad(lambda x: jnp.sum(jax.lax.map(jnp.sin, x))), np.cos),
        (lambda x: jnp.linalg.solve(x.T @ x, x.T), lambda x: np.linalg.solve(x.T @ x, x.T)),
        (lambda x: jnp.fft.ifft(jnp.fft.fft(jnp.sin(x), axis=0) * 2j, axis=0).imag, lambda x: 2 * np.sin(x)),
    ],
    ids=["closure", "casts", "jit", "checkpoint", "custom_jvp", "while", "cond", "vmap of while", "scan", "scatter",
         "reduce_precision", "iota", "grad of map", "solve", "complex"],
)  # fmt: skip
def test_a_raised_program_has_float64s_digits(fn, expected):
    x = uniform(2, 5, 3, low=-1, high=-0.1)
    found = in_float64(fn, x)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected(np.asarray(x, np.float64)), rtol=1e-12, atol=1e-14)


def test_random_numbers_are_the_same_ones():
    draw = lambda key: jax.random.uniform(key, (4,))
    np.testing.assert_array_equal(in_float64(draw, jax.random.key(3)), draw(jax.random.key(3)))


def mine(params, batch):
    return jnp.mean((jax.lax.dot(batch["x"], params["w"]) - batch["y"]) ** 2) + jnp.sum(params["w"][batch["row"] % 3])


def test_a_batch_may_be_closed_over_or_given_as_constant():
    params = {"w": normal(2, 3)}
    assert_grads_match(lambda p: mine(p, BATCH), params)
    assert_grads_match(mine, params, constant=(BATCH,))
    assert_grads_match(mine, params, BATCH)  # its integers stay as they are


def test_what_is_constant_does_not_move():
    """A function whose slope in its second argument is wrong is sound where that is constant."""

    @jax.custom_vjp
    def scaled(x, by):
        return x * by

    scaled.defvjp(lambda x, by: (x * by, (x, by)), lambda kept, d: (kept[1] * d, 2 * kept[0] * d))
    assert_grads_match(scaled, normal(0, 4), constant=(normal(1, 4),))
    with pytest.raises(AssertionError, match="is not the slope"):
        assert_grads_match(scaled, normal(0, 4), normal(1, 4))


def test_integers_bools_and_keys_stay_what_they_are():
    def loss(x, key, count, mask):
        assert (count.dtype, mask.dtype) == (jnp.int32, jnp.bool_)
        return jnp.sum(jnp.where(mask, jax.random.normal(key, x.shape) * x**2, 0.0)) + jnp.sum(x[count]), count

    given = jax.random.key(1), jnp.array([0, 2]), jnp.array([True, False, True])
    assert_grads_match(loss, normal(0, 3), constant=given)
    assert_grads_match(loss, normal(0, 3), *given)


def test_what_cannot_be_checked_says_what_to_do():
    called = lambda x: jnp.sum(
        x * jax.pure_callback(lambda: np.ones(3, np.float32), jax.ShapeDtypeStruct((3,), x.dtype))
    )
    with pytest.raises(NotImplementedError, match=r"`pure_callback` at .*test_raised.py.* pass that as `constant`"):
        assert_grads_match(called, normal(0, 3))
    with pytest.raises(ValueError, match="no argument has a floating-point leaf"):
        assert_grads_match(lambda n: n * 2.0, jnp.array([1]))


@pytest.mark.parametrize("how", ["constant", "closure"])
def test_the_gradient_of_a_training_step_in_float32_is_its_slope(how):
    """As users have it: neither the system, nor its parameters, nor the batch in float64."""
    objective = stage.objective(stage.STILL, dict(rec=1.0, static_rec=1.0))
    params, batch = stage.params_of(stage.STILL), stage.batch(stage.STILL)
    with jax.numpy_dtype_promotion("strict"):
        if how == "constant":
            assert_grads_match(
                lambda p, b: objective(p, b)[0], params, constant=(batch,), directions=1, step=1e-7, rtol=1e-4
            )
        else:
            assert_grads_match(lambda p: objective(p, batch)[0], params, directions=1, step=1e-7, rtol=1e-4)
