"""zestjax: zero-shot novel views of dynamic video, as pure functions in JAX.

Modules are the namespaces: `from zestjax import cameras, rendering, losses`. A module is a stage of the
pipeline and imports only from stages below it (tests/test_layers.py lists them).
"""

__version__ = "0.1.0"
