"""Every test runs with JAX's key-reuse checker on, and on two devices, whatever the machine has.
Tests compile more than they compute, so XLA optimises as little as it can and in the way that is
quickest to compile, what one test process has compiled is kept for those that begin later (a run
that is resumed is the same program), and the garbage collector leaves out what was imported, which
it would else go through again and again while programs are traced.
"""

import atexit
import gc
import os
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ["XLA_FLAGS"] = " ".join(
    [os.environ.get("XLA_FLAGS", ""), Path(__file__).with_name("xla_flags").read_text().strip()]
)
if "JAXDYNA_CACHE" not in os.environ:  # processes that this one starts find it set
    PROGRAMS = TemporaryDirectory(prefix="jaxdyna-tests-", ignore_cleanup_errors=True)
    os.environ["JAXDYNA_CACHE"] = PROGRAMS.name

import jax
import pytest
from hypothesis import settings

from jaxdyna.experiments.engine import programs

gc.collect()
gc.freeze()
jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)
settings.register_profile("same", derandomize=True, database=None, deadline=None)
settings.load_profile("same")  # the same examples on every run
process = ExitStack()
atexit.register(process.close)
share = process.enter_context(programs.kept())
MANY = 8_000
"""Maps of memory, about 30 to 120 a program: with many more a process compiles ever more slowly,
and at 65,530, where Linux has no more, it ends.
"""


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Lets go of what is compiled, between two files, once there is much of it."""
    yield
    share()
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MANY:
        jax.clear_caches()
        gc.collect()
