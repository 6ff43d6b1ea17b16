"""Every test runs with JAX's key-reuse checker on, and on two devices, whatever the machine has."""

import jax

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)
