"""What decisions cost and what they earn: a policy's forward pass beside planners of many budgets.

Every contender plays the same episodes of the real environment; its decisions are timed apart from
that, for one environment and for a batch of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdyna.envs import Revealed
from jaxdyna.experiments.report import Results
from jaxdyna.rollout import first_states, rollout
from jaxdyna.statistics import bootstrap_interval
from jaxdyna.types import Environment, Key

REPEATS, TIMED_SECONDS = 5, 0.3


class Contender(NamedTuple):
    """Who decides.

    Attributes:
        who: its kind: a policy, a planner.
        world: what it plans in, "-" where nothing is planned.
        steps: steps of that world a decision.
        act: ``(obs, state, key) -> action`` from what is seen and from the true state, which only
            planners in the true environment may look at.
    """

    who: str
    world: str
    steps: int
    act: Callable[[jax.Array, Any, Key], jax.Array]


class Ground(NamedTuple):
    """Where they play.

    Attributes:
        name: of the environment.
        env: the real environment.
        params: its parameters.
        num_steps: of an episode.
        best: ``(state, params) -> return``: the most that could be had from a start.
        key: random key of the episodes.
        episodes: how many.
        batch: environments that are decided for at once in the second timing.
    """

    name: str
    env: Environment
    params: Any
    num_steps: int
    best: Callable[[Any, Any], jax.Array]
    key: Key
    episodes: int
    batch: int


def measure(
    ground: Ground, contenders: Iterable[Contender], say: Callable[[str], None]
) -> list[Results]:
    """A row a contender: its returns, their share of what could be had, and milliseconds."""
    starts = first_states(ground.env, jax.random.clone(ground.key), ground.params, ground.episodes)
    best = np.asarray(jax.jit(jax.vmap(lambda start: ground.best(start, ground.params)))(starts))
    rows = []
    for contender in contenders:
        returns = play(ground, contender.act)
        pairs = np.stack([returns, best], axis=-1)
        said = f"{contender.who}, {contender.world} world, {contender.steps} steps"
        rows.append(
            {
                "environment": ground.name,
                "who": contender.who,
                "world": contender.world,
                "steps": contender.steps,
                "returns": returns.tolist(),
                "share": float(returns.sum() / best.sum()),
                "share_ci95": bootstrap_interval(
                    pairs, lambda rows: rows[..., 0].sum(-1) / rows[..., 1].sum(-1)
                ),
                "ms": milliseconds(ground, contender.act, 1),
                "batch": ground.batch,
                "ms_in_batch": milliseconds(ground, contender.act, ground.batch) / ground.batch,
            }
        )
        say(f"{ground.name}: {said}: share {rows[-1]['share']:.3f}, {rows[-1]['ms']:.3g} ms")
    return rows


def play(ground: Ground, act: Callable[[jax.Array, Any, Key], jax.Array]) -> np.ndarray:
    """Returns ``[episodes]``."""
    world = Revealed(ground.env)

    def whole(key: Key) -> jax.Array:
        def decide(seen: jax.Array, key: Key) -> jax.Array:
            return act(*world.read(seen, ground.params), key)

        played = rollout(
            world, decide, key, ground.params, ground.episodes, num_steps=ground.num_steps
        )
        return played.reward.sum(-1)

    return np.asarray(jax.jit(whole)(jax.random.clone(ground.key)))


def milliseconds(
    ground: Ground, act: Callable[[jax.Array, Any, Key], jax.Array], batch: int
) -> float:
    """Of one call that decides for so many environments: the median of several timings."""
    keys = jax.random.split(jax.random.fold_in(jax.random.clone(ground.key), batch), (2, batch))
    obs, state = jax.jit(jax.vmap(lambda key: ground.env.reset(key, ground.params)))(keys[0])
    decide: Any = jax.vmap(act)
    args = (obs, state, keys[1])
    if batch == 1:  # as who acts in one environment would call it
        decide, args = act, jax.tree.map(lambda leaf: leaf[0], args)
    call = jax.jit(decide).lower(*args).compile()
    jax.block_until_ready(call(*args))
    timings: list[float] = []
    began = time.perf_counter()
    while len(timings) < REPEATS or time.perf_counter() - began < TIMED_SECONDS:
        start = time.perf_counter()
        jax.block_until_ready(call(*args))
        timings.append(time.perf_counter() - start)
    return 1e3 * float(np.median(timings))
