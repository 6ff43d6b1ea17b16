"""The arms of CartPole: the standard ones, and planners on the learned model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import replay
from jaxdyna.agents import CloningConfig, ReinforceConfig, cloning, policy_logits, reinforce
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState
from jaxdyna.envs import CartPole, CartPoleParams
from jaxdyna.experiments.cartpole import model
from jaxdyna.experiments.cartpole.options import CartPoleOptions
from jaxdyna.experiments.study import arms as study
from jaxdyna.experiments.study.accuracy import on_common
from jaxdyna.experiments.study.planners import acting, showing, without_guide
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    SupervisedConfig,
    supervised,
    uniform_start,
)
from jaxdyna.models.evaluation import Predict, change_error
from jaxdyna.planners import (
    Guide,
    SearchConfig,
    ShootingConfig,
    muzero,
    random_shooting,
    rollout_value,
)
from jaxdyna.types import Key

IMITATES = (
    "`mpc` plays `shown_episodes`, which the policy imitates (Nagabandi et al. 2018); then it"
)
SAID = study.SAID | {
    "placebo": "the same dreams from a model that is never trained; they last to the horizon, "
    "where it would end each at once.",
    "mpc": "after the first N episodes random shooting in the model acts; no dreams.",
    "mcts": "likewise MuZero's tree search, random episodes in the model for the value of a leaf.",
    "mpc_init": f"{IMITATES} goes on model-free.",
    "mpc_init_dyna": f"{IMITATES} goes on with dreams like `dyna`.",
    "mpc_clone": f"{IMITATES} stays as it is.",
}


def arms(options: CartPoleOptions, judged: bool = True) -> dict[str, study.Made]:
    """What makes each arm; ``judged``: and judges its model in the end."""
    dreams = Dreams(options.dream_start, options.dream_noise, options.authors_bug)
    dyna = parts(options.agent, options.model, dreams, options.judged_on == "common")
    hooks = study.Hooks(
        model.judge if judged else None, model.show if judged else None, block=options.block
    )
    config, hparams = options.dyna, options.hparams
    truth = Dream(dyna.env, lambda _, hparams: hparams.env)
    made = study.standard_arms(
        dyna, config, hparams, truth, hooks, replays=False,
        untrained={"termination_threshold": 1.0},
    )  # fmt: skip

    def planned(make: Callable[..., Dyna], *settings: Any) -> study.Made:
        alone = replace(config, dream_updates=0)
        return lambda: study.dyna_arm(make(dyna, *settings), alone, hparams, hooks)

    shown = (options.mpc, options.agent, options.cloning, options.shown_episodes)
    late = replace(hparams, num_real_first=config.num_real_first + options.shown_episodes)
    return made | {
        "mpc": planned(mpc, options.mpc),
        "mcts": planned(mcts, options.mcts, options.mcts_rollout),
        "mpc_init": planned(mpc_init, *shown),
        "mpc_init_dyna": lambda: study.dyna_arm(mpc_shows(dyna, *shown), config, late, hooks),
        "mpc_clone": planned(mpc_clone, *shown),
    }


class Dreams(NamedTuple):
    """What decides the world of the dreams beside the model, see `CartPoleOptions`."""

    start: str
    noise: float
    authors_bug: bool


@cache
def parts(
    agent: ReinforceConfig, config: SupervisedConfig, dreams: Dreams, common: bool = False
) -> Dyna:
    """The parts of the ``dyna`` arm: one object, and so one program, for the same settings."""
    env = CartPole()
    learner = supervised(4, env.num_actions, config)
    predict = overwrite_angle(learner.predict) if dreams.authors_bug else learner.predict
    predict = add_noise(predict, dreams.noise) if dreams.noise else predict
    learned = LearnedEnvironment(env, predict, START_STATES[dreams.start])

    def learned_params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
        sources = {"observed": state.starts, "uniform": jnp.zeros(4), "branched": state.replay}
        return LearnedParams(
            model=state.model.params,
            start=sources[dreams.start],
            termination_threshold=hparams.termination_threshold,
            disagreement_threshold=hparams.disagreement_threshold,
            max_steps=hparams.env.max_steps,
        )

    policy = reinforce((4,), env.num_actions, agent)
    dyna = Dyna(env, policy, learner, Dream(learned, learned_params), change_error(predict))
    return on_common(dyna, model.common_transitions()) if common else dyna


def draw_observed(key: Key, starts: replay.Replay) -> jax.Array:
    """One of the first observations of real episodes."""
    return replay.sample(starts, key, ())


def draw_branched(key: Key, held: replay.Replay) -> jax.Array:
    """One of all real observations."""
    return replay.sample(held, key, ()).obs


START_STATES = {
    "observed": draw_observed,
    "uniform": uniform_start(-0.1, 0.1),
    "branched": draw_branched,
}


def add_noise(predict: Predict, scale: float) -> Predict:
    """Gaussian noise on the predicted state, in standard deviations of the model's targets."""

    def noisy(params, obs, action, key):
        key_predict, key_noise = jax.random.split(key)
        prediction = predict(params, obs, action, key_predict)
        noise = scale * params.targets.std * jax.random.normal(key_noise, obs.shape)
        return prediction._replace(next_obs=prediction.next_obs + noise)

    return noisy


def overwrite_angle(predict: Predict) -> Predict:
    """The slip in the authors' code behind "it struggled to make correct predictions for pole
    angle": after every fake step the angle becomes the cart's velocity, clipped to the angles that
    can be observed.
    """

    def slipped(params, obs, action, key):
        prediction = predict(params, obs, action, key)
        limit = 2 * CartPoleParams().theta_threshold
        angle = jnp.clip(prediction.next_obs[1], -limit, limit)
        return prediction._replace(next_obs=prediction.next_obs.at[2].set(angle))

    return slipped


@cache
def mpc(dyna: Dyna, config: ShootingConfig) -> Dyna:
    """Random shooting acts."""
    return acting(resting(dyna), random_shooting(world(dyna), config), without_guide)


@cache
def mcts(dyna: Dyna, config: SearchConfig, rollout_steps: int) -> Dyna:
    """Tree search acts; a leaf is worth what a random episode from it earns in the model."""
    guide = random_episodes(dyna, config.discount, rollout_steps)
    return acting(resting(dyna), muzero(world(dyna), config), guide)


@cache
def mpc_shows(
    dyna: Dyna, config: ShootingConfig, agent: ReinforceConfig, imitation: CloningConfig, shown: int
) -> Dyna:
    """Random shooting shows the policy what to do; ``dyna`` goes on."""
    num_actions = dyna.env.num_actions
    example = (jax.ShapeDtypeStruct((4,), np.float32), jax.ShapeDtypeStruct((), np.int32))
    logits = policy_logits(num_actions, agent)
    imitator = cloning(reinforce((4,), num_actions, agent), logits, example, imitation)
    return showing(dyna, random_shooting(world(dyna), config), without_guide, imitator, shown)


@cache
def mpc_init(dyna: Dyna, *shown: Any) -> Dyna:
    """As `mpc_shows`; model-free learning goes on."""
    return mpc_shows(dyna, *shown)._replace(dream=None)


@cache
def mpc_clone(dyna: Dyna, *shown: Any) -> Dyna:
    """As `mpc_shows`; the policy stays as it is from then on."""
    imitator = mpc_init(dyna, *shown)
    return imitator._replace(agent=imitator.agent._replace(update=learn_nothing))


def world(dyna: Dyna) -> Any:
    """The environment that ``dyna`` dreams in."""
    assert dyna.dream is not None
    return dyna.dream.env


def random_episodes(dyna: Dyna, discount: float, steps: int) -> Any:
    """Guides a planner by random episodes in the model."""

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        return Guide(value=rollout_value(world(dyna), env_params, steps, discount))

    return guide


def resting(dyna: Dyna) -> Dyna:
    """With an agent that learns nothing from the episodes that a planner plays."""
    return dyna._replace(agent=dyna.agent._replace(update_expert=learn_nothing))


def learn_nothing(state: Any, transitions: Any, key: Any, hparams: Any) -> tuple[Any, Any]:
    """An agent's update that leaves it as it is."""
    return state, {"loss": jnp.float32(0)}
