"""The arms that every comparison is made of, each from the same parts."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax

from jaxdyna.agents import DQNConfig
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, DynaState, make_init, make_step
from jaxdyna.dyna.frames import parts, true_dyna
from jaxdyna.envs import FrameStack, Hosted
from jaxdyna.experiments.engine import Arm, Trained, Work
from jaxdyna.fields import LARGEST, SettingError
from jaxdyna.types import Agent, Key

Made = Callable[[], Arm]
#: ``(dyna, config, state, key, hparams) -> arrays`` of a run that is over
Judged = Callable[[Dyna, DynaConfig, DynaState, Key, DynaHParams], dict[str, jax.Array]]

#: what the standard arms are
SAID = {
    "model_free": "the agent alone.",
    "dyna": "with fake episodes from the model that it learns.",
    "placebo": "the same dreams from a model that is never trained.",
    "oracle": "the same dreams in the true environment, from where those of `dyna` begin.",
    "more_updates": "as many updates as `dyna` at the same times, all of them on real steps.",
    "max_updates": "`dyna`'s late rate of updates from the first episode on, on real steps alone.",
}


class Hooks(NamedTuple):
    """What an experiment wants to know of its arms' runs: of every one that is over, and of the
    first alone; ``piece``, ``block`` and ``level`` as in `Work`.
    """

    judge: Judged | None = None
    show: Judged | None = None
    piece: int = 50
    block: int = 1
    level: int = 3
    #: ``(runs) -> params [runs, ...]`` of models that were trained before, to which a run's is set
    #: before each episode; its ``check()`` raises a `ValueError` where there are none, before
    #: anything is played. None: a run's model learns from what the run plays.
    given: Any = None


@cache
def dyna_work(dyna: Dyna, config: DynaConfig, hooks: Hooks) -> Work:
    """A run of Dyna as work, whose unit is a real episode."""
    play = make_step(dyna, config)

    def told(judged: Judged | None) -> Any:
        return judged and (lambda state, _, *rest: judged(dyna, config, state, *rest))

    def step(state: DynaState, given: Any, episode: jax.Array, hparams: DynaHParams) -> Any:
        if hooks.given:
            state = replace(state, model=replace(state.model, params=given))
        return play(state, episode, hparams)

    def trained(state: DynaState, hparams: DynaHParams) -> Trained:
        dream = dyna.dream and (dyna.dream.env, dyna.dream.params(state, hparams))
        policy = greedy_policy(dyna, state, hparams)
        return Trained(policy, dyna.env, hparams.env, config.num_steps, *(dream or ()))

    plans = dyna.expert is not None and dyna.expert.episodes is None  # it has no policy
    return Work(
        make_init(dyna, config), step, collect=hooks.given, judge=told(hooks.judge),
        show=told(hooks.show), piece=hooks.piece, block=hooks.block, level=hooks.level,
        trained=None if plans else trained)  # fmt: skip


def dyna_arm(dyna: Dyna, config: DynaConfig, hparams: DynaHParams, hooks: Hooks) -> Arm:
    """An arm of Dyna; a model that does not train at all is not given either."""
    if dyna.model is None or not hparams.model_trains:
        hooks = hooks._replace(given=None)
    if hooks.given is not None:
        hooks.given.check()
    if dyna.dream and hparams.num_real_first > config.num_episodes:
        said = f"is {hparams.num_real_first}: there are only {config.num_episodes} episodes"
        raise SettingError("hparams.num_real_first", said)
    try:
        return Arm(dyna_work(dyna, config, hooks), hparams, config.num_episodes)
    except SettingError as error:  # of the configuration, which is the option `dyna`
        raise SettingError(f"dyna.{error.path}", error.said) from None


def standard_arms(
    dyna: Dyna, config: DynaConfig, hparams: DynaHParams, true: Dyna | None, hooks: Hooks, *,
    untrained: Mapping[str, Any] = {}, busier: Agent | None = None,
) -> dict[str, Made]:  # fmt: skip
    """What makes each of the standard arms, by name, see `SAID`: of the parts, counts and values of
    ``dyna``, and what is wanted of the runs.

    Args:
        true: the oracle's parts; None where the true environment cannot be had.
        untrained: what the placebo changes in the dream's hparams, whose model is as uncertain as
            it likes.
        busier: a DQN with the updates after dreams made after real episodes; None where the agent
            cannot learn from old steps.
    """
    make = partial(partial, dyna_arm, hooks=hooks)
    trusting = replace(hparams.dream, uncertainty_threshold=math.inf)
    dreaming = replace(hparams, model_trains=False, dream=replace(trusting, **untrained))
    learns_nothing: dict[str, Any] = {"model": None, "diagnose": None}
    alone = dyna._replace(dream=None, **learns_nothing)
    arms: dict[str, Made] = {
        "model_free": make(alone, config, hparams),
        "dyna": make(dyna, config, hparams),
        "placebo": make(dyna._replace(safe=None), config, dreaming),
    }
    if true is not None:
        arms["oracle"] = make(true._replace(**learns_nothing), config, hparams)
    if busier is not None:
        arms["more_updates"] = make(dyna._replace(diagnose=None), config, all_real(hparams))
        arms["max_updates"] = make(alone._replace(agent=busier), config, hparams)
    return arms


def world_arms(
    env: FrameStack, agent: Any, model: Any, config: DynaConfig, hparams: DynaHParams, hooks: Hooks
) -> dict[str, Made]:  # fmt: skip
    """The standard arms in a world that is seen as frames or vectors, for the arguments see
    `jaxdyna.dyna.frames.parts`: those of more updates of a DQN alone, the oracle where the world's
    states can be had again.
    """
    busier, replays = None, isinstance(agent, DQNConfig)
    if replays:
        agent = sized(agent, config)
        busier = parts(env, busy(agent, config), model).agent
    dyna = parts(env, agent, model)
    true = None if isinstance(env.env, Hosted) else true_dyna(dyna, first=not replays)
    return standard_arms(dyna, config, hparams, true, hooks, busier=busier)


def all_real(hparams: DynaHParams) -> DynaHParams:
    """Under which a DQN makes ``dyna``'s updates at ``dyna``'s times on real steps alone."""
    return replace(
        hparams, model_trains=False, agent=replace(hparams.agent, fake_share=0.0),
        dream=replace(hparams.dream, uncertainty_threshold=math.inf))  # fmt: skip


def greedy(hparams: Any) -> Any:
    """A DQN's hparams without exploration."""
    return replace(hparams, epsilon_first=0.0, epsilon_last=0.0)


def greedy_policy(dyna: Dyna, state: DynaState, hparams: DynaHParams) -> Callable[..., jax.Array]:
    """``(obs, key) -> action`` of a run's agent without exploration, where it can."""
    act = dyna.agent.act_greedy or dyna.agent.act
    return lambda obs, key: act(state.agent, obs, key, hparams.agent)


def busy(config: Any, dyna: DynaConfig) -> Any:
    """A DQN's config that makes the updates after fake episodes after real ones as well."""
    return replace(config, updates=config.updates + dyna.dream_updates * config.fake_updates)


def sized(config: Any, dyna: DynaConfig, path: str = "agent") -> Any:
    """A DQN's config, the option of that path, with room for what a run can add to its replays and
    no more. `SettingError` where that is more than can be counted.
    """
    if config.n_step > dyna.num_steps:
        said = f"is {config.n_step}: an episode has {dyna.num_steps} steps at the most"
        raise SettingError(f"{path}.n_step", said)
    steps = dyna.dream_steps or dyna.num_steps
    dreams = dyna.dream_updates * dyna.dream_episodes
    fake = max(config.fake_capacity, dreams * steps)
    if fake > LARGEST:
        said = f"makes {dreams * steps:,} dreamed steps after each real episode: lower it, "
        said += "dyna.dream_episodes or dyna.dream_steps"
        raise SettingError("dyna.dream_updates", said)
    return replace(
        config,
        capacity=max(min(config.capacity, dyna.num_episodes * dyna.num_steps), dyna.num_steps),
        episodes=min(config.episodes, dyna.num_episodes),
        fake_capacity=fake,
        fake_episodes=max(config.fake_episodes, fake // steps, dreams),
    )
