"""The checks of `jaxdyna.testing` name what is wrong: parts with one mistake each."""

from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna import rollout
from jaxdyna.envs.gymnasium import spaces
from jaxdyna.planners import Decision, Guide
from jaxdyna.testing import (
    ContractError,
    check_agent,
    check_environment,
    check_model,
    check_planner,
)
from jaxdyna.types import Agent, DynamicsModel, Prediction


class WalkState(NamedTuple):
    place: jax.Array
    time: jax.Array


class WalkParams(NamedTuple):
    max_steps: int = 12


@dataclass(frozen=True)
class Walk:
    """Left or right on a line, pushed by chance; both ends terminate."""

    num_actions = 2
    default_params = WalkParams()

    def reset(self, key, params):
        state = WalkState(jax.random.uniform(key), jnp.int32(0))
        return self.see(state), state

    def see(self, state):
        return jnp.stack([state.place, jnp.square(state.place)])

    def step(self, key, state, action, params):
        pushed = state.place + action - 0.5 + 0.1 * jax.random.normal(key)
        state = WalkState(jnp.clip(pushed, -2, 2), state.time + 1)
        terminated = jnp.abs(state.place) >= 1
        truncated = ~terminated & (state.time >= params.max_steps)
        return self.see(state), state, state.place, terminated, truncated, {}

    def observation_space(self, params):
        return spaces.Box(-4, 4, (2,), np.float32)

    def action_space(self, params):
        return spaces.Discrete(2)


WALK = Walk()


OBS, STATE, REWARD, TERMINATED, TRUNCATED = range(5)


def walk(place, spoil):
    """The walk with something else at a place of a step's answer."""

    class Spoilt(Walk):
        def step(self, key, state, action, params):
            answer = super().step(key, state, action, params)
            spoilt = spoil(answer[place], answer[STATE], key, params)
            return (*answer[:place], spoilt, *answer[place + 1 :])

    return Spoilt()


class Seedless(Walk):
    def reset(self, key, params):
        return super().reset(jax.random.key(7), params)

    def step(self, key, state, action, params):
        return super().step(jax.random.key(7), state, action, params)


class Branching(Walk):
    def step(self, key, state, action, params):
        if action == 1:
            action = 2 * action
        return super().step(key, state, action, params)


class BranchingReset(Walk):
    def reset(self, key, params):
        obs, state = super().reset(key, params)
        return (obs, state) if state.place > 0.5 else (-obs, state)


class Unhashable(Walk):
    __hash__ = None


def largest(rows):
    """Of all rows at once: a callback that knows no batches."""
    return np.broadcast_to(np.float32(np.max(rows)), rows.shape[:-1])


def by_host(row):
    kind = jax.ShapeDtypeStruct((), np.float32)
    return jax.pure_callback(largest, kind, row, vmap_method="expand_dims")


class Untyped(Walk):
    def reset(self, key, params):
        obs, state = super().reset(key, params)
        return obs, state._replace(place=0.0)


class OldGym(Walk):
    def step(self, key, state, action, params):
        obs, state, reward, terminated, truncated, info = super().step(key, state, action, params)
        return obs, state, reward, terminated | truncated, info


ENVIRONMENTS = {
    "observation outside its space": (
        walk(OBS, lambda obs, *_: obs + 4), "outside its space", "clip"),
    "dtype that changes": (
        walk(OBS, lambda obs, *_: obs.astype(jnp.float16)), "observation is float16", "astype"),
    "shape that changes": (walk(OBS, lambda obs, *_: obs[:1]), "float32[1]", "reshape"),
    "state that changes type": (
        walk(STATE, lambda state, *_: state._replace(time=state.time * 1.0)),
        "state.time is float32", "astype"),
    "state that changes structure": (
        walk(STATE, lambda state, *_: (*state, 0)), "structure", "same pytree"),
    "reward of shape (1,)": (
        walk(REWARD, lambda reward, *_: reward[None]), "reward is float32 of shape (1,)", "scalar"),
    "reward that is NaN": (
        walk(REWARD, lambda reward, state, *_: jnp.where(state.time == 2, jnp.nan, reward)),
        "reward is NaN", "divide by 0"),
    "seed without effect": (Seedless(), "the seed changes nothing", "draw from the key"),
    "key used twice": (
        walk(REWARD, lambda reward, state, key, _: reward + jax.random.normal(key)),
        "random key twice", "jax.random.split"),
    "terminated and truncated at once": (
        walk(TRUNCATED, lambda _, state, *__: jnp.abs(state.place) >= 1),
        "at once", "~terminated"),
    "time limit in the step that terminates": (
        walk(TRUNCATED, lambda _, state, __, params: state.time >= params.max_steps),
        "at once", "~terminated"),
    "branch on a traced action": (Branching(), "step branches", "jnp.where"),
    "branch on a traced state": (BranchingReset(), "reset branches", "jax.lax.cond"),
    "flag that is a number": (
        walk(TRUNCATED, lambda truncated, *_: truncated * 1.0), "truncated is float32", "bool"),
    "no hash": (Unhashable(), "not hashable", "frozen dataclass"),
    "state begun by a Python number": (Untyped(), "retracing", "jnp.float32(0)"),
    "host's random numbers": (
        walk(REWARD, lambda reward, *_: reward + np.random.default_rng().random()),
        "differs under jit", "its key"),
    "callback that knows no batches": (
        walk(REWARD, lambda _, state, *__: by_host(WALK.see(state))),
        "differs under vmap", "vmap_method"),
    "no time limit": (
        walk(TRUNCATED, lambda truncated, *_: truncated & False), "goes on after params.max_steps",
        "truncated = ~terminated"),
    "answer of the old Gym": (OldGym(), "does not return 6 values", "truncated, info"),
}  # fmt: skip


def test_a_right_environment_passes():
    check_environment(WALK, random=True)


@pytest.mark.parametrize("fault", ENVIRONMENTS)
def test_a_wrong_environment_is_told(fault):
    env, named, remedy = ENVIRONMENTS[fault]
    is_told(named, remedy, partial(check_environment, env, random=True))


def is_told(named, remedy, check):
    with pytest.raises(ContractError) as error:
        check()
    wrong, _, mending = str(error.value).partition(": ")
    assert named in wrong and remedy in mending, error.value


@cache
def walked():
    def act(obs, key):
        return jax.random.randint(key, (), 0, 2)

    return jax.jit(lambda key: rollout(WALK, act, key, WalkParams(), 3))(jax.random.key(0))


class Learned(NamedTuple):
    params: jax.Array
    steps: jax.Array


def learner(
    losses,
    prepared=lambda transitions: transitions.blanked(),
    weights=lambda transitions: transitions.weights,
    mean=lambda loss, weight: (weight * loss).sum() / jnp.maximum(weight.sum(), 1e-6),
    idle=lambda new, old, weight: jnp.where(weight.sum() > 0, new, old),
    finished=lambda state, loss, key: (state, {"loss": loss}),
):
    """A gradient step on the losses ``[...]`` of transitions."""

    def update(state, transitions, key, hparams):
        batch, weight = prepared(transitions), weights(transitions)
        loss, grads = jax.value_and_grad(lambda p: mean(losses(p, batch), weight))(state.params)
        new = Learned(state.params - hparams * grads, state.steps + 1)
        new = jax.tree.map(lambda new, old: idle(new, old, weight), new, state)
        return finished(new, loss, key)

    return update


def init(key, hparams):
    return Learned(jax.random.normal(key, (2, 2)), jnp.int32(0))


def act(state, obs, key, hparams):
    return jax.random.categorical(key, obs @ state.params)


def imitate(params, batch):
    odds = jax.nn.log_softmax(batch.obs @ params)
    chosen = jnp.take_along_axis(odds, batch.action[..., None], -1)[..., 0]
    return -batch.reward * chosen


COUNTER = count()


def alternating(state, obs, key, hparams):
    return jnp.int32(next(COUNTER) % 2)


def twice(state, obs, key, hparams):
    explores = jax.random.uniform(key) < 0.1
    return jnp.where(explores, jax.random.randint(key, (), 0, 2), act(state, obs, key, hparams))


def greedy_by_python(state, obs, key, hparams):
    left, right = obs @ state.params
    return 0 if left > right else 1


FORMS = {  # mistakes of an update, the same for agents and models
    "dtype of the state": (
        {"finished": lambda state, loss, key: (
            state._replace(steps=state.steps * 1.0), {"loss": loss})},
        "state.steps is float32", "astype"),
    "structure of the state": (
        {"finished": lambda state, loss, key: (tuple(state), {"loss": loss})},
        "structure", "same pytree"),
    "nothing learned": (
        {"idle": lambda new, old, weight: old}, "learns nothing", "the new one"),
    "no loss": (
        {"finished": lambda state, loss, key: (state, {})}, "does not return a loss", "loss"),
    "loss of each transition": (
        {"finished": lambda state, loss, key: (state, {"loss": loss[None]})},
        "loss is float32 of shape (1,)", "scalar"),
    "masked steps poison": (
        {"prepared": lambda transitions: transitions}, "learns from masked steps", "blanked()"),
    "all masked is counted": (
        {"idle": lambda new, old, weight: new}, "every step is masked", "jnp.where"),
    "weight ignored": (
        {"weights": lambda transitions: transitions.mask * 1.0},
        "ignores the weight", "transitions.weights"),
    "branch on the loss": (
        {"finished": lambda state, loss, key: (state, {"loss": loss if loss > 0 else -loss})},
        "branches in Python", "jnp.where"),
    "key used twice": (
        {"finished": lambda state, loss, key: (
            state, {"loss": loss + 0 * jax.random.normal(key) * jax.random.uniform(key)})},
        "random key twice", "jax.random.split"),
    "gradient of a root at 0": (
        {"mean": lambda loss, weight: jnp.sqrt((0 * weight * loss).sum())},
        "state is NaN", "gradients finite"),
    "host's number": (
        {"finished": lambda state, loss, key: (state, {"loss": jnp.float32(float(loss))})},
        "Python number", "jax.numpy"),
}  # fmt: skip
AGENT = Agent(init, act, learner(imitate))
AGENTS = {
    "action that is a float": (
        {"act": lambda *args: act(*args) * 1.0}, "action is float32", "integer"),
    "action of shape (1,)": ({"act": lambda *args: act(*args)[None]}, "shape (1,)", "scalar"),
    "action that there is not": (
        {"act": lambda *args: act(*args) + 1}, "action is 2", "within [0, 1]"),
    "host's counter": ({"act": alternating}, "differs under jit", "in arguments"),
    "key used twice to act": ({"act": twice}, "random key twice", "jax.random.split"),
    "branch on values": ({"act": greedy_by_python}, "act branches", "jnp.where"),
    "dreams' action": (
        {"act_fake": lambda *args: act(*args) * 1.0}, "act_fake's action is float32", "integer"),
    "padding counted": (
        {"update": learner(imitate, mean=lambda loss, weight: (weight * loss).mean())},
        "depends on the padding", "divide by their sum"),
} | {
    name: ({"update": learner(imitate, **how)}, *said) for name, (how, *said) in FORMS.items()
}  # fmt: skip


def test_a_right_agent_passes():
    check_agent(AGENT, 0.1, walked(), 2)


@pytest.mark.parametrize("fault", AGENTS)
def test_a_wrong_agent_is_told(fault):
    change, named, remedy = AGENTS[fault]
    is_told(named, remedy, partial(check_agent, AGENT._replace(**change), 0.1, walked(), 2))


def predict(params, obs, action, key):
    return Prediction(
        obs + params[action], obs @ params[0], jax.nn.sigmoid(obs @ params[1]), jnp.float32(0)
    )


def squares(params, batch):
    return jnp.square(batch.obs + params[batch.action] - batch.next_obs).sum(-1)


def predicting(**spoil):
    """The prediction with something else in a field: ``(field, obs, key) -> field``."""

    def spoilt(params, obs, action, key):
        said = predict(params, obs, action, key)
        changes = {name: how(getattr(said, name), obs, key) for name, how in spoil.items()}
        return said._replace(**changes)

    return {"predict": spoilt}


def clipped_by_python(params, obs, action, key):
    return predict(params, obs if obs[0] < 1 else obs / 2, action, key)


MODEL = DynamicsModel(init, predict, learner(squares))
MODELS = {
    "shape of next_obs": (
        predicting(next_obs=lambda next_obs, *_: next_obs[None]), "float32[1, 2]", "reshape"),
    "dtype of next_obs": (
        predicting(next_obs=lambda next_obs, *_: next_obs.astype(jnp.float16)),
        "next_obs is float16", "astype"),
    "log odds for a probability": (
        predicting(terminated=lambda terminated, obs, _: 3 + obs[0]),
        "a probability, is", "within [0, 1]"),
    "reward of shape (1,)": (
        predicting(reward=lambda reward, *_: reward[None]),
        "reward is float32 of shape (1,)", "scalar"),
    "end that is a flag": (
        predicting(terminated=lambda terminated, *_: terminated > 0.5),
        "is bool", "floating"),
    "uncertainty that is NaN": (
        predicting(uncertainty=lambda *_: jnp.float32(jnp.nan)), "uncertainty is nan", "finite"),
    "callback that knows no batches": (
        predicting(reward=lambda _, obs, __: by_host(obs)), "differs under vmap", "vmap_method"),
    "key used twice to predict": (
        predicting(reward=lambda reward, _, key: (
            reward + jax.random.normal(key) * jax.random.uniform(key))),
        "random key twice", "jax.random.split"),
    "branch on an observation": ({"predict": clipped_by_python}, "predict branches", "jnp.where"),
    "tuple too short": (
        {"predict": lambda *args: predict(*args)[:3]}, "does not return 4 values", "uncertainty"),
    "state without params": (
        {"init": lambda key, hparams: init(key, hparams)._asdict()}, "no params", "call what"),
    "one leading axis taken for granted": (
        {"update": learner(squares, mean=lambda loss, weight: (
            (weight * loss).sum(-1) / jnp.maximum(weight.sum(-1), 1e-6)).sum())},
        "leading axes", "flatten"),
} | {
    name: ({"update": learner(squares, **how)}, *said)
    for name, (how, *said) in FORMS.items()
    if name in ("structure of the state", "masked steps poison", "weight ignored")
}  # fmt: skip


def test_a_right_model_passes():
    check_model(MODEL, 0.1, walked())


@pytest.mark.parametrize("fault", MODELS)
def test_a_wrong_model_is_told(fault):
    change, named, remedy = MODELS[fault]
    is_told(named, remedy, partial(check_model, MODEL._replace(**change), 0.1, walked()))


def planner(params, obs, state, key, guide=Guide()):
    """Looks one step ahead; the prior decides between what is worth the same."""

    def worth(action, key):
        key_step, key_value = jax.random.split(key)
        seen, after, reward, terminated, *_ = WALK.step(key_step, state, action, params)
        rest = guide.value(seen, after, key_value) if guide.value else 0.0
        return reward + jnp.where(terminated, 0.0, rest)

    values = jax.vmap(worth)(jnp.arange(2), jax.random.split(key))
    odds = guide.prior(obs) if guide.prior else jnp.zeros(2)
    action = jnp.argmax(values + odds)
    return Decision(action, values[action])


def deciding(spoil):
    """The planner with another decision: ``(decision, obs, key) -> decision``."""

    def spoilt(params, obs, state, key, guide=Guide()):
        return spoil(planner(params, obs, state, key, guide), obs, key)

    return spoilt


def blind(field):
    """The planner without something of its guide."""

    def planned(params, obs, state, key, guide=Guide()):
        return planner(params, obs, state, key, guide._replace(**{field: None}))

    return planned


def lazy(params, obs, state, key, guide=Guide()):
    if state.time > 3:
        return Decision(jnp.int32(0), jnp.float32(0))
    return planner(params, obs, state, key, guide)


PLANNERS = {
    "action that is a float": (
        deciding(lambda said, *_: said._replace(action=said.action * 1.0)),
        "action is float32", "integer"),
    "action of shape (1,)": (
        deciding(lambda said, *_: said._replace(action=said.action[None])), "shape (1,)", "scalar"),
    "action that there is not": (
        deciding(lambda said, *_: said._replace(action=said.action + 2)),
        "action is", "within [0, 1]"),
    "value that is infinite": (
        deciding(lambda said, *_: said._replace(value=said.value / 0)), "value is", "finite"),
    "guide's value ignored": (blind("value"), "ignores its guide", "guide.value"),
    "guide's prior ignored": (blind("prior"), "ignores its guide", "guide.prior"),
    "key used twice": (
        deciding(lambda said, obs, key: said._replace(action=jax.random.randint(key, (), 0, 2))),
        "random key twice", "jax.random.split"),
    "branch on a state": (lazy, "planner branches", "jnp.where"),
    "action alone": (
        deciding(lambda said, *_: said.action), "does not return 2 values", "action, value"),
    "callback that knows no batches": (
        deciding(lambda said, obs, _: said._replace(value=by_host(obs))),
        "differs under vmap", "vmap_method"),
    "host's random numbers": (
        deciding(lambda said, *_: said._replace(
            value=said.value + np.random.default_rng().random())),
        "differs under jit", "its key"),
}  # fmt: skip


def test_a_right_planner_passes():
    check_planner(planner, WALK, WalkParams(), prior=True)


@pytest.mark.parametrize("fault", PLANNERS)
def test_a_wrong_planner_is_told(fault):
    spoilt, named, remedy = PLANNERS[fault]
    is_told(named, remedy, partial(check_planner, spoilt, WALK, WalkParams(), prior=True))
