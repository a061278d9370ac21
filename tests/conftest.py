"""The suite runs stricter than users do, and in their precision. What is compiled is shared by its workers on disk.

`ZESTJAX_FAST_COMPILING` asks for code that compiles fast instead of running fast, as most of it runs once.
"""

import ctypes
import gc
import importlib.metadata
import os
import shutil
import sys
import tempfile

import pytest

if os.environ.get("ZESTJAX_FAST_COMPILING"):  # a training step: 20 CPU seconds instead of 51
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
    if importlib.metadata.version("jaxlib").startswith("0.10."):  # later ones have no older emitters, and no flag
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()

import jax  # noqa: E402

import zestjax  # noqa: E402  # before anything computes: it decides what the compiler may fuse

assert zestjax.BACKEND.state != "running", "JAX computed before zestjax was imported: the suite's sums may be wrong"
jax.devices()  # from here on no test can change the compiler's flags for the others
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

COMPILED = "ZESTJAX_TEST_COMPILED"  # where the programs of this run lie: workers inherit it


def pytest_configure(config):
    """One folder of compiled programs a run: a step that several modules take is compiled once."""
    if COMPILED not in os.environ:
        os.environ[COMPILED] = config.compiled_here = tempfile.mkdtemp(prefix="zestjax-compiled-")
    jax.config.update("jax_compilation_cache_dir", os.environ[COMPILED])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)


def pytest_unconfigure(config):
    if folder := getattr(config, "compiled_here", None):
        shutil.rmtree(folder, ignore_errors=True)
        del os.environ[COMPILED]


@pytest.fixture(autouse=True, scope="module")
def nothing_compiled_is_kept():
    """A worker would hold some GB of programs that no later module runs."""
    yield
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's: what is free goes back to the system
        if trim is not None:
            trim(0)


@pytest.fixture
def x64():
    """float64 for one test; the suite otherwise runs in the float32 users get."""
    with jax.enable_x64(True):
        yield
