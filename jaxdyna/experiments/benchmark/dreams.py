"""Steps a second of the learned CartPole model in `rollout`, beside what its products allow."""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import CartPole
from jaxdyna.experiments.benchmark.others import by_threads, rival
from jaxdyna.experiments.benchmark.timing import OURS, compared, jitted, product
from jaxdyna.experiments.cartpole.arms import parts
from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import Results
from jaxdyna.models import DreamHParams, LearnedEnvironment, LearnedParams, uniform_start
from jaxdyna.rollout import rollout
from jaxdyna.types import Key

STEPS = 32


def measure(options: Any) -> Iterable[Results]:
    """Episodes of a model and a policy as `tuned` has them, untrained; none of them ends early."""
    dyna: Any = parts(TUNED)
    hparams, theirs = TUNED.hparams, rival("torch_cartpole")
    keys = jax.random.split(jax.random.key(options.seed), 3)
    agent = dyna.agent.init(keys[0], hparams.agent)
    model = dyna.model.init(keys[1], hparams.model).params
    env = LearnedEnvironment(CartPole(), dyna.model.predict, uniform_start(-0.05, 0.05))
    known = LearnedParams(model, jnp.zeros(4), DreamHParams(termination_threshold=1.0), STEPS)
    hidden, policy = TUNED.model.hidden, TUNED.agent.hidden
    layers = *pairwise((5, *hidden, 6)), *pairwise((4, *policy, env.num_actions))
    operations = sum(2 * inputs * outputs for inputs, outputs in layers)

    def play(batch: int, agent: Any, known: Any, key: Key) -> Any:
        def act(obs: jax.Array, key: Key) -> jax.Array:
            return dyna.agent.act(agent, obs, key, hparams.agent)

        return rollout(env, act, key, known, batch, num_steps=STEPS)

    for batch in options.batches:
        units = batch * STEPS
        works = {
            OURS: jitted(partial(play, batch), agent, known, keys[2], units=units),
            **by_threads(theirs, theirs and torchs(theirs, batch), units),
        }
        ceiling = product(1, batch, hidden[0], options.rounds) / operations
        yield from compared(f"{batch:,} dreams", "steps/s", works, options.rounds, ceiling)


def torchs(theirs: Any, batch: int) -> Callable[[], Any]:
    """So many dreams of PyTorch's together."""
    run = theirs.Run(seed=0, ends_above=1.0)
    run.starts = [np.zeros(4, np.float32)]
    return partial(run.dream, batch, STEPS)
