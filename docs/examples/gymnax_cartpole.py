"""gymnax's CartPole by random actions, so many environments for so many steps at each line that is
sent: ``python gymnax_cartpole.py ENVIRONMENTS STEPS``, in an environment with gymnax 1.0.

It is what `python -m jaxdyna.experiments.benchmark --gymnax PYTHON` runs by that interpreter.
"""

import sys

import gymnax
import jax

count, steps = map(int, sys.argv[1:])
env, params = gymnax.make("CartPole-v1")
split = jax.random.split


def step(carry, _):
    """One step of all, which gymnax resets where they are over."""
    key, _, state = carry
    key, key_action, key_step = split(key, 3)
    action = jax.random.randint(key_action, (count,), 0, 2)
    played = jax.vmap(env.step, (0, 0, 0, None))(split(key_step, count), state, action, params)
    return (key, *played[:2]), played[2:-1]


@jax.jit
def play(key):
    """What is seen in the end ``[N, 4]``, and earned on the way ``[T, N]``."""
    key, key_reset = split(key)
    started = jax.vmap(env.reset, (0, None))(split(key_reset, count), params)
    return jax.lax.scan(step, (key, *started), length=steps)


for _ in sys.stdin:
    jax.block_until_ready(play(jax.random.key(0)))
    print(flush=True)
