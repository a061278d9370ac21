"""Checks for users: is a loss finite, is its gradient its slope, and where does it come from?

They take any function over pytrees:

    assert_finite(loss, params)
    assert_grads_match(loss, params)
    print(explain_gradient(lambda p: {"mine": loss(p), "theirs": other(p)}, params))
"""

from zestjax.testing.explain import Explanation, Origin, explain_gradient
from zestjax.testing.gradients import assert_finite, assert_grads_match, held, value_and_gradients

__all__ = [
    "Explanation",
    "Origin",
    "assert_finite",
    "assert_grads_match",
    "explain_gradient",
    "held",
    "value_and_gradients",
]
