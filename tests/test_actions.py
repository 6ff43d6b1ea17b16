"""Actions as data: numbered ones and vectors in a Box, in policies, models and planners alike."""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium import spaces
from scipy.stats import norm

from jaxdyna import rollout
from jaxdyna.actions import Box, Discrete, actions_in, actions_of, as_actions
from jaxdyna.agents import DQNConfig, ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.agents.reinforce import over_batch
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams, make_init, make_train
from jaxdyna.dyna.frames import parts, true_dyna
from jaxdyna.envs import FrameStack, HostedParams, Pendulum, PendulumParams, from_gymnasium
from jaxdyna.envs.gymnasium import play
from jaxdyna.losses import clipped_policy_gradient, policy_gradient
from jaxdyna.models import PixelConfig, SupervisedConfig, SupervisedHParams, supervised
from jaxdyna.planners import (
    CrossEntropyConfig,
    Guide,
    SearchConfig,
    ShootingConfig,
    cross_entropy,
    muzero,
    random_shooting,
    rollout_value,
)
from jaxdyna.testing import (
    ContractError,
    check_agent,
    check_environment,
    check_model,
    check_planner,
)
from jaxdyna.types import Transition
from jaxdyna.watched import Side

BOX = Box((-2.0, 0.0), (2.0, 1.0))


class Time(NamedTuple):
    time: jax.Array


START = Time(jnp.int32(0))


class TargetParams(NamedTuple):
    max_steps: int = 3


@dataclass(frozen=True)
class Target:
    """Vectors near a target pay; nothing else matters."""

    target: tuple = (1.0, 0.25)
    default_params: TargetParams = TargetParams()

    def reset(self, key, params):
        return jax.random.uniform(key, (1,)), Time(jnp.int32(0))

    def step(self, key, state, action, params):
        off = jnp.clip(action, np.float32(BOX.low), np.float32(BOX.high)) - np.array(self.target)
        state = Time(state.time + 1)
        over = state.time >= params.max_steps
        return jnp.zeros(1), state, -jnp.square(off).sum(), jnp.bool_(False), over, {}

    def observation_space(self, params):
        return spaces.Box(0, 1, (1,), np.float32)

    def action_space(self, params):
        return spaces.Box(np.float32(BOX.low), np.float32(BOX.high))


OUTPUTS = np.array([0.5, -0.2, np.log(0.3), np.log(2.0)])
"""Of a policy in `BOX`: means 0.5 * 2 and 0.5 - 0.2 / 2, deviations 0.3 * 2 and 2 / 2."""
MEAN, STD = np.array([1.0, 0.4]), np.array([0.6, 1.0])


def test_log_densities_and_their_gradient_by_hand():
    action = np.array([[0.3, 1.7], [1.0, 0.4]])
    said = BOX.log_prob(jnp.array([OUTPUTS, OUTPUTS]), jnp.array(action))
    np.testing.assert_allclose(said, norm.logpdf(action, MEAN, STD).sum(-1), rtol=1e-5)
    by_hand = -np.log(0.6 * 1.0 * 2 * np.pi)  # at the mean
    np.testing.assert_allclose(said[1], by_hand, rtol=1e-5)
    gradient = jax.grad(BOX.log_prob)(jnp.array(OUTPUTS), jnp.array(action[0]))
    z = (action[0] - MEAN) / STD
    half = np.array([2.0, 0.5])
    np.testing.assert_allclose(gradient, [*(z * half / STD), *(z**2 - 1)], rtol=1e-5)


def test_the_policy_gradient_of_a_gaussian_by_hand():
    """-sum w A log pi; an action beyond the bounds counts as it was drawn."""
    outputs, action = jnp.array([OUTPUTS] * 2), jnp.array([[0.3, 1.7], [9.0, 0.4]])
    advantage, weight = jnp.array([2.0, -3.0]), jnp.array([1.0, 0.5])
    loss = policy_gradient(outputs, action, advantage, weight, BOX.log_prob)
    each = norm.logpdf(np.asarray(action), MEAN, STD).sum(-1)
    np.testing.assert_allclose(loss, -(2 * each[0] - 1.5 * each[1]), rtol=1e-5)
    clipped = partial(clipped_policy_gradient, log_prob=BOX.log_prob)
    same = jax.grad(clipped)(outputs, action, advantage, weight, outputs)
    plain = jax.grad(policy_gradient)(outputs, action, advantage, weight, BOX.log_prob)
    np.testing.assert_allclose(same, plain, rtol=1e-5)


def test_what_is_drawn_is_what_is_said():
    drawn = BOX.sample(jax.random.key(0), jnp.array(OUTPUTS), (40_000,))
    assert drawn.shape == (40_000, 2) and drawn.dtype == jnp.float32
    np.testing.assert_allclose(drawn.mean(0), MEAN, atol=0.02)
    np.testing.assert_allclose(drawn.std(0), STD, rtol=0.02)
    assert drawn[:, 0].max() > 2  # nobody clips it but the world
    np.testing.assert_allclose(BOX.mode(jnp.array([7.0, 0.0, 0.0, 0.0])), [2.0, 0.5])
    anything = BOX.uniform(jax.random.key(1), (40_000,))
    np.testing.assert_allclose(anything.mean(0), [0, 0.5], atol=0.02)
    np.testing.assert_allclose([anything.min(0), anything.max(0)], [BOX.low, BOX.high], atol=0.01)
    again = BOX.like(drawn[:, None], 0.01)[0]
    clipped = np.clip(drawn, BOX.low, BOX.high)
    np.testing.assert_allclose(BOX.mode(again), clipped.mean(0), atol=1e-3)
    np.testing.assert_allclose(np.exp(again[2:]) * [2, 0.5], clipped.std(0), rtol=1e-3)


def test_models_are_told_of_actions_in_units_of_their_bounds():
    told = BOX.encode(jnp.array([[-2.0, 1.0], [0.0, 0.5], [50.0, -1.0]]), one_hot=True)
    np.testing.assert_allclose(told, [[-1, 1], [0, 0], [1, -1]])
    np.testing.assert_array_equal(Discrete(3).encode(jnp.array(1), one_hot=True), [0, 1, 0])
    np.testing.assert_array_equal(Discrete(3).encode(jnp.array(2), one_hot=False), [2])


@pytest.mark.parametrize("space", [
    spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(0, np.inf, (1,)), spaces.Box(-1, 1, (2, 2)),
    spaces.Box(-1, 1, ()), spaces.Box(1, 1, (2,)), spaces.Box(0, 5, (2,), np.int32),
    spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), spaces.Dict(a=spaces.Discrete(2)),
], ids=str)  # fmt: skip
def test_other_spaces_are_refused_in_one_line(space):
    class World(Target):
        def action_space(self, params):
            return space

    class Hosted(gymnasium.Env):
        observation_space, action_space = spaces.Box(0, 1, (1,)), space

    for ask in (lambda: actions_of(World()), lambda: from_gymnasium(Hosted, 1)):
        with pytest.raises(ValueError, match="give Discrete ones, or vectors") as caught:
            ask()
        assert "\n" not in str(caught.value) and str(space) in str(caught.value)


def test_a_world_says_what_can_be_done():
    assert actions_of(FrameStack(Target(), 2)) == BOX == actions_in(Target().action_space(None))
    assert actions_of(from_gymnasium("Pendulum-v1", 1)) == actions_of(Pendulum())
    assert actions_of(from_gymnasium("CartPole-v1", 1)) == Discrete(2)
    with pytest.raises(ValueError, match="num_actions, or an action_space"):
        actions_of(object())


@pytest.mark.parametrize("make", [
    lambda env: random_shooting(env, ShootingConfig(2, 16)),
    pytest.param(lambda env: cross_entropy(env, CrossEntropyConfig(2, 16, elites=4)),
                 marks=pytest.mark.slow),
], ids=["shooting", "cem"])  # fmt: skip
def test_planners_in_a_box_owe_the_same(make):
    check_planner(make(Target()), Target(), TargetParams())


def test_the_cross_entropy_method_finds_the_optimum_of_a_quadratic():
    """Random shooting comes near; a value of what follows changes nothing about either."""
    params, off = TargetParams(), {}
    planners = {
        "shooting": random_shooting(Target(), ShootingConfig(1, 64)),
        "cem": cross_entropy(Target(), CrossEntropyConfig(1, 64, iterations=6, floor=0.01)),
    }
    guide = Guide(value=rollout_value(Target(), params, 2))
    for name, planner in planners.items():
        plan = jax.vmap(lambda key, plan=planner: plan(params, jnp.zeros(1), START, key))
        keys = jax.random.split(jax.random.key(0), 20)
        found = jax.jit(plan)(keys)
        chex.assert_shape(found.action, (20, 2))
        off[name] = np.abs(np.asarray(found.action) - [1.0, 0.25]).max(1)
        worth = -np.square(np.asarray(found.action) - [1.0, 0.25]).sum(1)
        np.testing.assert_allclose(found.value, worth, atol=1e-6)
    assert off["cem"].max() < 0.02 < np.median(off["shooting"])
    guided = planners["cem"](params, jnp.zeros(1), START, jax.random.key(0), guide)
    assert guided.value < -0.05  # two random steps follow


def test_candidates_drift_together():
    def spread(drift):
        sequences = BOX.sequences(jax.random.key(0), (200, 50), drift)
        assert (sequences >= np.array(BOX.low)).all() and (sequences <= np.array(BOX.high)).all()
        return np.asarray(sequences).mean(1).std(0)

    assert (spread(1.0) > 3 * spread(0.0)).all()


def test_tree_search_says_what_it_takes():
    with pytest.raises(ValueError, match=r"tree search takes numbered actions.*cross_entropy"):
        muzero(Pendulum(), SearchConfig())


def linear(obs, action):
    """A known world."""
    done = np.clip(action, BOX.low, BOX.high)
    return obs @ [[0.9, 0.2], [-0.2, 0.9]] + done * [0.5, 1], obs[..., 0] - 0.5 * done[..., 1]


def experience(seed, count):
    generator = np.random.default_rng(seed)
    obs = generator.normal(size=(count, 2)).astype(np.float32)
    action = generator.uniform([-3, -0.5], [3, 1.5], (count, 2)).astype(np.float32)
    next_obs, reward = (np.float32(one) for one in linear(obs, action))
    no = np.zeros(count, bool)
    return Transition(obs, action, reward, next_obs, no, no, ~no)


def test_a_model_learns_a_linear_world():
    """Of actions beyond the bounds too, which the world clips."""
    config = SupervisedConfig(
        hidden=(32,), sum_loss=False, delta=True, normalise=True, optimizer=optax.adam
    )
    model, hparams = supervised(2, BOX, config), SupervisedHParams(1e-2)
    data, key = experience(0, 256), jax.random.key(1)

    @jax.jit
    def learned(key):
        keys = jax.random.split(key, 1001)

        def step(state, key):
            return model.update(state, data, key, hparams)

        return jax.lax.scan(step, model.init(keys[0], hparams), keys[1:])[0]

    state, test = learned(key), experience(2, 500)
    predict = jax.vmap(model.predict, (None, 0, 0, None))
    said = predict(state.params, test.obs, test.action, jax.random.key(3))
    error = np.square(said.next_obs - test.next_obs).mean(0)
    assert (error < 0.02 * np.square(test.next_obs - test.obs).mean(0)).all()
    assert np.square(said.reward - test.reward).mean() < 0.02 * test.reward.var()
    shuffled = predict(state.params, test.obs, test.action[::-1], jax.random.key(3))
    assert np.square(shuffled.next_obs - test.next_obs).mean() > 10 * error.mean()


EPISODES = jax.jit(lambda: rollout(
    Target(), lambda obs, key: BOX.uniform(key), jax.random.key(0), TargetParams(), 3))  # fmt: skip


@pytest.mark.slow
def test_a_model_in_a_box_owes_the_same():
    model = supervised(1, BOX, SupervisedConfig(hidden=(8,), ensemble=2, sum_loss=False))
    check_model(model, SupervisedHParams(1e-3), EPISODES())


def test_a_policy_in_a_box_owes_the_same():
    agent = reinforce((1,), BOX)
    check_agent(agent, ReinforceHParams(), EPISODES(), BOX)
    with pytest.raises(ContractError, match=r"action.*unlike the action_space"):
        check_agent(agent, ReinforceHParams(), EPISODES(), Box((0.0,), (1.0,)))


def test_a_gaussian_policy_learns_where_the_target_is():
    """Its means go there, and its deviations, which no observation changes, shrink."""
    config = ReinforceConfig(advantage=over_batch, output_variance=1e-4)
    agent, hparams = reinforce((1,), BOX, config), ReinforceHParams(3e-2, 0.0)

    @jax.jit
    def learned(key):
        def step(state, key):
            key_play, key_update = jax.random.split(key)
            act = partial(agent.act, state, hparams=hparams)
            played = rollout(Target(), act, key_play, TargetParams(), 64)
            return agent.update(state, played, key_update, hparams)[0], None

        keys = jax.random.split(key, 301)
        return jax.lax.scan(step, agent.init(keys[0], hparams), keys[1:])[0]

    state = learned(jax.random.key(0))
    greedy = agent.act_greedy(state, jnp.array([0.5]), None, hparams)
    np.testing.assert_allclose(greedy, [1.0, 0.25], atol=0.06)
    free = state.params["params"]["free"]
    assert free.shape == (2,) and (np.exp(free) < 0.5).all()


MODEL = SupervisedConfig(hidden=(8,), sum_loss=False, delta=True, normalise=True)


@pytest.mark.parametrize("name", ["dyna", pytest.param("oracle", marks=pytest.mark.slow)])
def test_dyna_dreams_in_a_box(name):
    dyna = parts(FrameStack(Pendulum(), 1), ReinforceConfig(), MODEL)
    dyna = true_dyna(dyna, first=True) if name == "oracle" else dyna
    config = DynaConfig(num_episodes=3, num_steps=9, num_real_first=1, model_updates=2)
    hparams = DynaHParams(ReinforceHParams(), SupervisedHParams(), PendulumParams(max_steps=9))
    state, curves = jax.jit(make_train(dyna, config))(jax.random.key(0), hparams)
    held = state.replay.rest["action"]
    assert held.shape == (27, 1) and held.dtype == jnp.float32 and len(np.unique(held)) == 27
    assert np.isfinite(curves["fake_return"]).all() and (curves["real_return"] < 0).all()


@pytest.mark.parametrize(("agent", "model", "said"), [
    (DQNConfig(), MODEL, "a DQN takes numbered actions"),
    (ReinforceConfig(), PixelConfig(None), "the model of frames takes numbered actions"),
])  # fmt: skip
def test_parts_that_take_numbers_say_so(agent, model, said):
    with pytest.raises(ValueError, match=said):
        parts(FrameStack(Pendulum(), 1), agent, model)


@pytest.mark.parametrize("actions", [2, Box((-1.0,), (1.0,)), BOX])
def test_a_policy_of_other_actions_is_refused(actions):
    agent = reinforce((3,), actions)
    with pytest.raises(ValueError, match=r"the agent has .* actions and Pendulum Box.*give it Box"):
        make_init(Dyna(Pendulum(), agent), DynaConfig(num_episodes=1))


def test_rollouts_want_vectors_of_the_right_length():
    with pytest.raises(ValueError, match=r"array \(\): make it one \(1,\)"):
        rollout(Pendulum(), lambda *_: 0.5, jax.random.key(0), PendulumParams(), 1, num_steps=2)


class Unclipped(Target):
    def step(self, key, state, action, params):
        *answer, _ = super().step(key, state, action, params)
        return (*answer[:2], -jnp.square(action).sum(), *answer[3:], {})


def test_a_world_that_does_not_clip_is_found():
    check_environment(Target())
    with pytest.raises(ContractError, match=r"beyond its action_space.*clip it"):
        check_environment(Unclipped())


class Script(gymnasium.Env):
    """Sees what it was last told to do."""

    observation_space = spaces.Box(-9, 9, (2,), np.float32)
    action_space = spaces.Box(np.float32(BOX.low), np.float32(BOX.high))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return action.copy(), float(action[0]), False, False, {}


def lanes():
    return gymnasium.vector.SyncVectorEnv([Script] * 2)


@pytest.mark.parametrize("make", [Script, lanes])
def test_gymnasiums_worlds_are_given_what_was_chosen_but_clipped(make):
    env = from_gymnasium(make, 4)

    def act(obs, key):
        return 3 * BOX.uniform(key) - 1

    played = jax.jit(lambda key: rollout(env, act, key, HostedParams(5), 3))(jax.random.key(0))
    assert (np.abs(played.action) > 2).any()
    np.testing.assert_allclose(played.next_obs, np.clip(played.action, BOX.low, BOX.high))
    np.testing.assert_allclose(played.reward, played.next_obs[..., 0])


def test_either_pendulum_is_the_same_through_the_bridge():
    """And Gymnasium's own, played by a policy of ours, earns what it does there."""
    env = from_gymnasium("Pendulum-v1", 4)

    def act(obs, key):
        return 2.5 * obs[2:] / 8

    played = jax.jit(lambda key: rollout(env, act, key, HostedParams(30), 4))(jax.random.key(0))
    states = jax.vmap(jax.vmap(Pendulum().state_of))(played.obs)
    step = jax.vmap(jax.vmap(Pendulum().step, (None, 0, 0, None)), (None, 0, 0, None))
    obs, _, reward, *_ = step(jax.random.key(0), states, played.action, PendulumParams())
    np.testing.assert_allclose(obs, played.next_obs, atol=1e-4)
    np.testing.assert_allclose(reward, played.reward, atol=1e-4)
    earned = play("Pendulum-v1", act, 0, 3, 30)
    assert earned.shape == (3,) and (earned < 0).all()


def test_a_policy_that_is_nearly_sure_stays_finite():
    """Where nothing was done the density of what stands there may be anything."""
    space, before = Box((0.0,), (1.0,)), jnp.array([[0.6, jnp.log(0.05)]] * 2)
    weight, action = jnp.array([1.0, 0.0]), jnp.array([[0.9], [0.0]])

    def loss(mean, advantage):
        outputs = before.at[:, 0].set(mean)
        told = advantage * jnp.array([1.0, 0.0])
        return clipped_policy_gradient(
            outputs, action, told, weight, before, log_prob=space.log_prob
        )

    for mean, advantage in ((0.2, 1.0), (0.2, -1.0), (-3.0, 1.0), (3.0, -1.0)):
        value, gradient = jax.value_and_grad(loss)(mean, advantage)
        assert jnp.isfinite(value) and jnp.isfinite(gradient)


def test_deviations_have_a_least_and_a_most():
    space = Box((-1.0,), (1.0,))
    for said, is_ in ((-50.0, jnp.exp(-5.0)), (50.0, jnp.exp(2.0)), (0.5, jnp.exp(0.5))):
        drawn = space.sample(jax.random.key(0), jnp.array([0.0, said]), (20_000,))
        np.testing.assert_allclose(drawn.std(), is_, rtol=0.02)


@pytest.mark.parametrize(
    ("low", "high"),
    [((1.0,), (-1.0,)), ((-1.0, 0.0), (1.0,)), ((), ()), ((-np.inf,), (1.0,)), ((-3e38,), (3e38,))],
)
def test_bounds_that_are_none_are_refused(low, high):
    with pytest.raises(ValueError, match="give as many finite bounds"):
        Box(low, high)


@pytest.mark.parametrize("low", [-np.inf, -3e38])
def test_a_space_without_ends_is_refused(low):
    with pytest.raises(ValueError, match="bounded Box"):
        as_actions(spaces.Box(low, -low, (1,)))


def test_a_space_says_what_actions_there_are():
    assert as_actions(spaces.Box(-2.0, 2.0, (1,))) == Box([-2.0], [2.0]) == Box(-2.0, 2.0)
    assert as_actions(spaces.Discrete(3)) == as_actions(3)


def test_a_dream_of_another_box_is_refused():
    agent = reinforce((3,), Box(-2.0, 2.0))
    other = Dream(Pendulum(max_torque=9.0), lambda *given: None)
    with pytest.raises(ValueError, match="the dream has"):
        make_train(Dyna(Pendulum(), agent, None, other), DynaConfig(num_real_first=0))


def test_in_a_box_the_best_sequence_wins_at_any_temperature():
    """Though many are clipped to the same first action."""
    config = ShootingConfig(horizon=2, candidates=64, drift=3.0)
    for temperature in (0.0, 1.0, np.inf):
        plan = random_shooting(Target(), replace(config, temperature=temperature))
        obs, state = Target().reset(jax.random.key(1), Target().default_params)
        decided = plan(Target().default_params, obs, state, jax.random.key(2))
        if temperature == 0:
            best = decided
        np.testing.assert_array_equal(decided.action, best.action)


class Pushed(gymnasium.Env):
    """Draws the last push, from 0 to 10, as a grey level."""

    metadata: ClassVar = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Box(0.0, 10.0, (1,))
    render_mode, pushed = "rgb_array", 0.0

    def __init__(self, render_mode=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.pushed = float(action[0])
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        return np.full((2, 2, 3), self.pushed, np.uint8)


def test_a_world_of_gymnasium_in_a_box_is_watched():
    side = Side(FrameStack(from_gymnasium(Pushed, 1), 1), HostedParams(5), 1)
    side.begin(seed=0)
    for push, grey in ((7.0, 7), (99.0, 10)):
        side.step(np.array([push], np.float32))
        assert (side.shot()[0] == grey).all()
