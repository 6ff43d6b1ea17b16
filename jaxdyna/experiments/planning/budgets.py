"""What decisions cost and what they earn: a policy's forward pass beside planners of many budgets.

Every contender plays the same episodes of the real environment; its decisions are timed apart from
that, for one environment and for a batch of them.
"""

import timeit
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdyna.experiments.engine import Results
from jaxdyna.rollout import rollout
from jaxdyna.statistics import share_of_sums
from jaxdyna.types import Environment, Key

REPEATS = 5  #: timings of a decision, of as many calls as take 0.2 seconds in all
#: ``(learned, obs, state, key) -> action`` from what one run has learned, what is seen, and the
#: true state, which only planners in the true environment may look at
Act = Callable[[Any, jax.Array, Any, Key], jax.Array]


class Contender(NamedTuple):
    """Who decides."""

    who: str  #: its kind: a policy, a planner
    world: str  #: what it plans in, "-" where nothing is planned
    steps: int  #: steps of that world a decision
    act: Act  #: how it decides

    @property
    def label(self) -> str:
        """Its kind and its world."""
        return self.who if self.world == "-" else f"{self.who} ({self.world} world)"


class Ground(NamedTuple):
    """Where they play."""

    name: str  #: of the environment
    env: Environment  #: the real environment
    params: Any  #: its parameters
    learned: Any  #: what runs have learned, ``[runs, ...]``
    num_steps: int  #: of an episode
    #: ``(state, params) -> return``: the most that could be had from a start
    best: Callable[[Any, Any], jax.Array]
    key: Key  #: random key of the episodes
    episodes: int  #: how many with what each run has learned
    batch: int  #: environments that are decided for at once in the second timing


def measure(ground: Ground, contenders: Iterable[Contender], say: Any) -> list[Results]:
    """A row a contender: returns, share of what could be had, gain on the first's, milliseconds."""
    rows: list[Results] = []
    for contender in contenders:
        who, world, steps, act = contender
        returns, starts = play(ground, act)
        if not rows:
            first, best = returns, best_returns(ground, starts)
        row = {
            "environment": ground.name, "label": contender.label, "who": who, "world": world,
            "steps": steps, "returns": returns.tolist(),
            **_share("share", returns, best), **_share("gain", returns - first, best),
            "ms": milliseconds(ground, act, 1), "batch": ground.batch,
            "ms_in_batch": milliseconds(ground, act, ground.batch) / ground.batch}  # fmt: skip
        said = f"{contender.label}, {steps} steps: share {row['share']:.3f}, {row['ms']:.3g} ms"
        say(f"{ground.name}: {said}")
        rows.append(row)
    return rows


def _share(name: str, earned: np.ndarray, best: np.ndarray) -> Results:
    """With its interval over the runs; over the episodes where there are one or two."""
    earned, best = (one.sum(1) if len(one) > 2 else one.ravel() for one in (earned, best))
    said = share_of_sums(earned, best)
    return {name: said["share"], f"{name}_ci95": said["ci95"]}


def best_returns(ground: Ground, starts: Any) -> np.ndarray:
    """The most that could be had in each episode, ``[runs, episodes]``, by their first states."""
    best = jax.vmap(jax.vmap(lambda start: ground.best(start, ground.params)))
    return np.asarray(jax.jit(best)(starts))


def play(ground: Ground, act: Act) -> tuple[np.ndarray, Any]:
    """Returns and first states ``[runs, episodes]``."""

    def whole(run: tuple[Any, Key]) -> tuple[jax.Array, Any]:
        learned, key = run

        def decide(obs: jax.Array, key: Key, state: Any) -> jax.Array:
            return act(learned, obs, state, key)

        played, states = rollout(
            ground.env, decide, key, ground.params, ground.episodes, num_steps=ground.num_steps,
            record=lambda state, *_: state, sees_state=True)  # fmt: skip
        return played.reward.sum(-1), jax.tree.map(lambda leaf: leaf[:, 0], states)

    runs = jax.tree.leaves(ground.learned)[0].shape[0]
    keys = jax.random.split(jax.random.clone(ground.key), runs)
    returns, starts = jax.jit(partial(jax.lax.map, whole))((ground.learned, keys))
    return np.asarray(returns), starts


def milliseconds(ground: Ground, act: Act, batch: int) -> float:
    """Of one call that decides for so many environments by the first run: the median of several."""
    keys = jax.random.split(jax.random.fold_in(jax.random.clone(ground.key), batch), (2, batch))
    seen = jax.jit(jax.vmap(lambda key: ground.env.reset(key, ground.params)))(keys[0])
    one = partial(act, jax.tree.map(lambda leaf: leaf[0], ground.learned))
    decide: Any = jax.vmap(one)
    args = (*seen, keys[1])
    if batch == 1:  # as who acts in one environment would call it
        decide, args = one, jax.tree.map(lambda leaf: leaf[0], args)
    call = jax.jit(decide).lower(*args).compile()
    timer = timeit.Timer(lambda: jax.block_until_ready(call(*args)))
    calls = max(1, timer.autorange()[0] // REPEATS)
    return 1e3 * float(np.median(timer.repeat(REPEATS, calls))) / calls
