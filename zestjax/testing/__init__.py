"""Checks for users: is a loss finite, is its gradient its slope, and where does it come from?

They take any function over pytrees:

    assert_finite(loss, params)
    assert_grads_match(loss, params)
    print(explain_gradient(lambda p: {"mine": loss(p), "theirs": other(p)}, params))
    jax.jit(jax.grad(loss), compiler_options=quick())  # compiles in a third of the time, for a few calls
    check_backend()  # in a suite's conftest.py: does JAX compute what it should on this machine?
"""

from zestjax.base.backend import quick
from zestjax.testing.backend import Check, backend_checks, check_backend
from zestjax.testing.explain import Explanation, explain_gradient
from zestjax.testing.gradients import assert_finite, assert_grads_match, held, value_and_gradients
from zestjax.testing.origin import Origin

__all__ = [
    "Check",
    "Explanation",
    "Origin",
    "assert_finite",
    "assert_grads_match",
    "backend_checks",
    "check_backend",
    "explain_gradient",
    "held",
    "quick",
    "value_and_gradients",
]
