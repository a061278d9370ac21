"""An error names the function, the argument, the axis, what was expected and what came."""

import jax
import jax.numpy as jnp
import pytest

from zestjax.base.checks import check_option, check_shapes


def test_sizes_are_returned_by_axis_name():
    sizes = check_shapes("f", a=(jnp.zeros((2, 3, 4)), "... S C"), b=(jnp.zeros((5, 3)), "R S"))
    assert sizes == {"S": 3, "C": 4, "R": 5}


@pytest.mark.parametrize(
    "shape, spec, words",
    [
        ((2, 3), "... 2", ["`second` should be (... 2), got shape (2, 3)"]),
        ((5, 3, 4), "N 4 4", ["should be (N 4 4), got shape (5, 3, 4). A 3x4 pose needs the row 0 0 0 1 under it."]),
        ((2, 3), "N 3 3", ["shape (2, 3)", "N 3 3"]),
        ((2,), "", ["shape (2,)"]),
        ((4, 9), "... S C", ["axis S", "is 4", "expected 3", "from `first`"]),
    ],
)
def test_a_wrong_shape_is_refused_by_name(shape, spec, words):
    with pytest.raises(ValueError) as error:
        check_shapes("render", first=(jnp.zeros((7, 3, 9)), "... S C"), second=(jnp.zeros(shape), spec))
    assert all(word in str(error.value) for word in ["render: ", "`second`", *words])


def test_shapes_are_checked_while_tracing():
    with pytest.raises(ValueError, match=r"`x` should be \(... 3\), got shape \(2,\)"):
        jax.eval_shape(lambda x: check_shapes("f", x=(x, "... 3")), jnp.zeros(2))


def test_an_unknown_option_is_refused_with_the_valid_ones():
    check_option("f", mode=("a", ("a", "b")))
    with pytest.raises(ValueError, match="f: `mode` is 'c', expected one of 'a', 'b'"):
        check_option("f", mode=("c", ("a", "b")))


def test_batch_axes_need_only_broadcast_and_misfits_are_named():
    check_shapes("f", a=(jnp.ones((2, 1, 3)), "... S"), b=(jnp.ones((4, 3)), "... S"))
    with pytest.raises(ValueError, match=r"f: batch axes that do not broadcast: \(2,\) of `a`, \(3,\) of `b`"):
        check_shapes("f", a=(jnp.ones((2, 3)), "... S"), b=(jnp.ones((3, 3)), "... S"))
