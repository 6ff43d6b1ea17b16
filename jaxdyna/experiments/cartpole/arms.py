"""The arms of CartPole: the standard ones, and planners on the learned model."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import agents, models, networks, planners
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams, DynaState, survived
from jaxdyna.dyna.experts import acting, random_episodes, without_guide
from jaxdyna.dyna.frames import learned_params
from jaxdyna.envs import CartPole, CartPoleParams
from jaxdyna.experiments.cartpole import model
from jaxdyna.experiments.cartpole.options import CartPoleOptions, rule
from jaxdyna.experiments.study import arms as study
from jaxdyna.experiments.study.accuracy import on_common
from jaxdyna.models.evaluation import Predict, change_error
from jaxdyna.replay import memory, ring
from jaxdyna.trees import where
from jaxdyna.types import Agent

IMITATE = "`mpc` plays `shown_episodes`, which the policy imitates (Nagabandi et al. 2018); then it"
SAID = study.SAID | {
    "placebo": "the same dreams from a model that is never trained; they last to the horizon, "
    "where it would end each at once.",
    "max_updates": "as many updates after each real episode as `dyna` makes in all, all of them on "
    "that episode: from the second on they are clipped as PPO's are.",
    "dqn": "a deep Q-network on the four numbers, model-free: unlike REINFORCE it learns from old "
    "real steps again and again.",
    "mpc": "after the first N episodes random shooting in the model acts; no dreams.",
    "mcts": "likewise MuZero's tree search, random episodes in the model for the value of a leaf.",
    "mpc_init": f"{IMITATE} goes on model-free, with as many policy updates an episode as `dyna`: "
    "further ones on the same real episode, clipped as PPO's are; like `dyna` in `lean` it leaves "
    "alone what did not fall.",
    "mpc_init_dyna": f"{IMITATE} goes on with dreams like `dyna`.",
    "mpc_clone": f"{IMITATE} stays as it is.",
    "random_search": "nothing is learned: the action is the higher of two random linear functions "
    "of the state, which are drawn anew after every real episode below the rule's threshold.",
    "linear_model": "a linear model, fitted by least squares after every real episode, and the "
    "policy that keeps the squared state small in it (a linear-quadratic regulator), told that a "
    "small state is a good one; random actions in the first episode.",
}
#: the oracle's dreams, from the start
TRUTH: dict[str, Any] = {
    "dream": Dream(CartPole(), lambda _, hparams: hparams.env), "memory": None}  # fmt: skip
#: where dreams begin: how that is drawn, and from what of a run's state
STARTS: dict[str, Any] = {
    "observed": (lambda key, firsts: ring.sample(firsts, key, ()), lambda state: state.starts),
    "uniform": (models.uniform_start(-0.1, 0.1), lambda state: jnp.zeros(4)),
    "branched": (lambda key, held: ring.sample(held, key, ()).obs, lambda state: state.replay),
}


def arms(options: CartPoleOptions, judged: bool = True) -> dict[str, study.Made]:
    """What makes each arm; ``judged``: and judges its model in the end."""
    dyna, config, hparams = parts(options), options.dyna, options.hparams
    dream: Any = dyna.dream
    hooks = study.Hooks(model.judge, model.show, piece=25, block=options.block, level=2)
    if not judged:
        hooks = hooks._replace(judge=None, show=None)
    made = study.standard_arms(
        dyna, config, hparams, dyna._replace(**TRUTH), hooks,
        untrained={"termination_threshold": 1.0})  # fmt: skip
    late = replace(hparams, num_real_first=config.num_real_first + options.shown_episodes)

    def dreamless(dyna: Dyna) -> Any:
        dyna, fewer = dyna._replace(dream=None), replace(config, dream_updates=0)
        return study.dyna_arm(dyna, fewer, hparams, hooks)

    def linear(agent: Callable[..., Agent], values: Any) -> Any:
        return study.dyna_arm(alone(agent), config, replace(hparams, agent=values), hooks)

    def shown(agent: agents.ReinforceConfig = options.agent) -> Dyna:
        imitating = dyna._replace(agent=imitator(agent, options.cloning))
        return acting(imitating, shooting, options.mpc, without_guide, options.shown_episodes)

    busy = replace(options.agent, epochs=options.agent.epochs + config.dream_updates)
    busier = unless_safe(alone(agents.reinforce, busy)._replace(safe=dyna.safe))
    shooting, resting = planners.random_shooting, with_agent(dyna, update_expert=learn_nothing)
    at_leaves = random_episodes(dream.env, options.mcts.discount, options.mcts_rollout)
    return made | {
        "max_updates": lambda: study.dyna_arm(busier, config, hparams, hooks),
        "dqn": lambda: study.dyna_arm(*learner(options), hooks),
        "mpc": lambda: dreamless(acting(resting, shooting, options.mpc, without_guide)),
        "mcts": lambda: dreamless(acting(resting, planners.muzero, options.mcts, at_leaves)),
        "mpc_init": lambda: dreamless(unless_safe(shown(busy))),
        "mpc_init_dyna": lambda: study.dyna_arm(shown(), config, late, hooks),
        "mpc_clone": lambda: dreamless(with_agent(shown(), update=learn_nothing)),
        "random_search": lambda: linear(
            agents.linear_search, agents.LinearSearchHParams(rule(options).threshold)
        ),
        "linear_model": lambda: linear(agents.linear_regulator, agents.LinearRegulatorHParams()),
    }


def learner(options: CartPoleOptions) -> tuple[Dyna, DynaConfig, DynaHParams]:
    """What the arm ``dqn`` is made of."""
    dreamless = replace(options.dyna, dream_updates=0)
    network = networks.PerceptronQ(CartPole().num_actions, options.dqn_hidden)
    config = replace(study.sized(options.dqn, dreamless, "dqn"), network=network)
    hparams = replace(options.hparams, agent=options.dqn_hparams)
    return alone(agents.dqn, config), dreamless, hparams


@cache
def alone(make: Callable[..., Agent], *config: Any) -> Dyna:
    """An agent without a model: one object, and so one program, for the same settings."""
    env = CartPole()
    return Dyna(env, make((4,), env.num_actions, *config), memory=None)


def parts(options: CartPoleOptions) -> Dyna:
    """The parts of the ``dyna`` arm: one object, and so one program, whatever the hparams."""
    said = options.dream_start, options.dream_noise, options.authors_bug
    learned = options.judged_on == "common", options.rest_when_safe, options.forget_every
    return _parts(options.agent, options.model, *said, *learned)


@cache
def _parts(
    agent: agents.ReinforceConfig, config: models.SupervisedConfig, start: str, noise: float,
    authors_bug: bool, common: bool, rests: bool, forget_every: int,
) -> Dyna:  # fmt: skip
    env = CartPole()
    learner = models.supervised(4, env.num_actions, config)
    predict = overwrite_angle(learner.predict) if authors_bug else learner.predict
    predict = add_noise(predict, noise) if noise else predict
    draw, source = STARTS[start]

    def params(state: DynaState, hparams: DynaHParams) -> models.LearnedParams:
        return learned_params(state, hparams, source(state))

    policy = agents.reinforce((4,), env.num_actions, agent)
    dream = Dream(models.LearnedEnvironment(env, predict, draw), params)
    kept = memory.transitions()
    dyna = Dyna(
        env, policy, learner, dream, change_error(predict), safe=survived if rests else None,
        memory=memory.forgetting(kept, forget_every) if forget_every else kept)  # fmt: skip
    return on_common(dyna, model.common_transitions()) if common else dyna


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
def imitator(agent: agents.ReinforceConfig, imitation: agents.CloningConfig) -> Agent:
    """A policy that imitates what it is shown."""
    actions = CartPole().num_actions
    example = (jax.ShapeDtypeStruct((4,), np.float32), jax.ShapeDtypeStruct((), np.int32))
    policy, log_odds = agents.reinforce((4,), actions, agent), agents.policy_logits(actions, agent)
    return agents.cloning(policy, log_odds, example, imitation)


def with_agent(dyna: Dyna, **changes: Any) -> Dyna:
    """With other updates of the agent."""
    return dyna._replace(agent=dyna.agent._replace(**changes))


@cache
def unless_safe(dyna: Dyna) -> Dyna:
    """Its agent is left as it is after episodes that are `Dyna.safe`, where any are."""
    safe = dyna.safe
    if safe is None:
        return dyna

    def update(state: Any, transitions: Any, key: Any, hparams: Any) -> tuple[Any, Any]:
        new, metrics = dyna.agent.update(state, transitions, key, hparams)
        return where(safe(transitions), state, new), metrics

    return with_agent(dyna, update=update)


def learn_nothing(state: Any, transitions: Any, key: Any, hparams: Any) -> tuple[Any, Any]:
    """An agent's update that leaves it as it is."""
    return state, {"loss": jnp.float32(0)}
