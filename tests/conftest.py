"""What every test runs under: the CPU, checked shapes and types, no rank promotion, kept compilations."""

from __future__ import annotations

import os

os.environ["JAX_PLATFORMS"] = "cpu"  # before anything imports jax

import jax
import pytest
from jaxtyping import install_import_hook

# Every function of the package checks its annotations, shapes included, while tests run. The hook only sees
# modules that are imported after it.
install_import_hook("foajax", "beartype.beartype")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config: pytest.Config) -> None:
    """Keeps compiled programs between test runs: most of the time of a first run is compilation."""
    jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
