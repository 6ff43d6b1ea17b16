"""Every test runs with JAX's key-reuse checker on, and on two devices, whatever the machine has.
Tests compile more than they compute, so XLA optimises as little as it can, and what a test process
has compiled is kept for its next tests (a run that is resumed is the same program).
"""

import os
from tempfile import TemporaryDirectory

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"

import jax

PROGRAMS = TemporaryDirectory(prefix="jaxdyna-tests-", ignore_cleanup_errors=True)

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_compilation_cache_dir", PROGRAMS.name)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
