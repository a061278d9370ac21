"""zestjax: zero-shot novel views of dynamic video, as pure functions in JAX.

Modules are the namespaces: `from zestjax import cameras, rendering, losses`. A module is a stage of the
pipeline and imports only from stages below it (tests/test_layers.py lists them).

Importing it keeps JAX's CPU compiler from returning wrong sums (see `zestjax.base.backend`): import it before anything
computes. `BACKEND` is what was decided.
"""

from zestjax.base import backend as _backend

__version__ = "0.1.0"
BACKEND = _backend.decide()
