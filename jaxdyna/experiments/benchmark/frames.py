"""Learning from frames, one run on all cores: gradient steps, each batch drawn from the replay, and
a whole episode with its updates and dreams.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, make_init, make_step
from jaxdyna.dyna.loop import play_real, train_model
from jaxdyna.experiments.benchmark.others import by_threads, rival
from jaxdyna.experiments.benchmark.timing import OURS, compared, in_units
from jaxdyna.experiments.engine import Results
from jaxdyna.experiments.maze import arms as maze
from jaxdyna.experiments.maze.options import TUNED as MAZE
from jaxdyna.experiments.pong import arms as pong
from jaxdyna.experiments.pong.options import PAPER as PONG

#: settings, the arms, and which of them it is; Pong's sees RGB by convolutions
WORLDS: dict[str, Any] = {"Maze": (MAZE, maze.arms, "dyna"), "Pong": (PONG, pong.arms, "dyna_l2")}


def measure(options: Any) -> Iterable[Results]:
    """The Maze by `tuned`, Pong by `paper`."""
    theirs = rival("torch_frames")
    for name in options.worlds:
        preset, arms, arm = WORLDS[name]
        setup, other = preset.resolved(), theirs and theirs.Learner(getattr(theirs, name.upper()))
        dyna = arms(setup)[arm].args[0]  # the parts that it is made of
        ours = works(dyna, replace(setup.dyna, eval_every=0), setup.hparams, options.seed)
        units = setup.dyna.model_updates, setup.agent.updates, 1
        calls: Any = [None] * len(units)
        if other:
            other.real_episode()  # something to learn from
            calls = other.train_model, partial(other.learn, units[1]), other.episode
        for (what, work), count, call in zip(ours.items(), units, calls, strict=True):
            pair = {OURS: in_units(work, count), **by_threads(theirs, call, count)}
            yield from compared(f"{name}, {what}", "ms", pair, options.rounds)


def works(dyna: Dyna, config: DynaConfig, hparams: DynaHParams, seed: int) -> dict[str, Callable]:
    """What a run computes, without what is only looked at in it."""
    dyna, key = dyna._replace(watch=None, diagnose=None), jax.random.key(seed)
    first = jnp.int32(config.num_real_first)  # from here on there are dreams
    init = jax.jit(make_init(dyna, config))
    step = jax.jit(make_step(dyna, config), donate_argnums=0)
    train = jax.jit(partial(train_model, dyna, config))
    update = jax.jit(dyna.agent.update, donate_argnums=0)
    begun, _ = step(init(key, hparams), first, hparams)
    real, _ = play_real(dyna, config, begun.agent, key, hparams)

    def carried(state: Any, call: Callable[[Any], Any]) -> Callable[[], Any]:
        held = [state]

        def work() -> None:
            held[0], _ = jax.block_until_ready(call(held[0]))

        return work

    keys = jax.random.split(key)
    return {
        "model update": lambda: jax.block_until_ready(train(begun, *keys, hparams)),
        "DQN update": carried(
            init(key, hparams).agent, lambda state: update(state, real, key, hparams.agent)
        ),
        "whole episode": carried(init(key, hparams), lambda state: step(state, first, hparams)),
    }
