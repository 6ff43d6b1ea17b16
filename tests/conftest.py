"""Every test runs with JAX's key-reuse checker on, and on two devices, whatever the machine has.
Tests compile more than they compute, so XLA optimises as little as it can.
"""

import os

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"

import jax

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)
