"""Every test runs with JAX's key-reuse checker on, and on two devices, whatever the machine has.
What is compiled once is kept in pytest's cache for other tests, the other workers' and later runs'.
"""

from pathlib import Path

import jax

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update(
    "jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".pytest_cache" / "jax")
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
