"""Gymnasium's worlds as environments: a world with a script, then CartPole both ways."""

import gc
from dataclasses import dataclass
from functools import cache, partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from parts import assert_same

from jaxdyna import rollout
from jaxdyna.agents import ReinforceConfig, ReinforceHParams
from jaxdyna.dyna import DynaConfig, DynaHParams, make_train
from jaxdyna.dyna.frames import parts
from jaxdyna.envs import CartPole, CartPoleParams, FrameStack, HostedParams, from_gymnasium
from jaxdyna.models import SupervisedConfig, SupervisedHParams
from jaxdyna.testing import ContractError, check_environment
from jaxdyna.watched import Scene

pytestmark = pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning")


class Script(gymnasium.Env):
    """Counts its steps from a number that the seed decides; ends after two to four of them, by
    itself or not as the seed says; action 3 pays 3, and what is seen tells the actions so far.
    """

    observation_space = spaces.Box(0, np.inf, (3,), np.float64)
    action_space = spaces.Discrete(3, start=2)
    resets = steps = 0
    past = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        Script.resets += 1
        self.first, self.time, self.sum, self.over = (seed or 0) % 1000, 0, 0, False
        return self._seen(), {}

    def step(self, action):
        assert not self.over
        Script.steps += 1
        self.time, self.sum = self.time + 1, 3 * self.sum + int(action)
        self.over = self.time == 2 + self.first % 3
        itself = self.first % 2 == 0
        return self._seen(), float(action), self.over and itself, self.over and not itself, {}

    def _seen(self):
        return np.array([self.first, self.time, self.sum + self.past], float)


class Moody(Script):
    """Not the same again."""

    def reset(self, **how):
        self.past = Script.resets
        return super().reset(**how)


class Closing(Script):
    closed = 0

    def close(self):
        Closing.closed += 1


def vector(mode, lanes=3):
    return SyncVectorEnv([Script] * lanes, autoreset_mode=mode)


def act(obs, key):
    return jax.random.randint(key, (), 0, 3)


def key(number=5):
    return jax.random.key(number)


def play(env, episodes, number=5, steps=7):
    played = jax.jit(lambda key: rollout(env, act, key, HostedParams(steps), episodes))
    return jax.tree.map(np.asarray, played(key(number)))


def test_it_keeps_to_what_environments_owe():
    """Eager, jitted and batched the same, whoever asks and how often."""
    check_environment(from_gymnasium(Script, 30), HostedParams(7), random=True)


def test_a_world_that_is_another_with_the_same_seed_is_found():
    with pytest.raises(ContractError, match=r"reset differs"):
        check_environment(from_gymnasium(Moody, 30), HostedParams(7))


def test_episodes_are_the_worlds_own_by_seeds_of_their_keys():
    played = play(from_gymnasium(Script, 8), 8)
    ends = set()
    for lane in range(8):
        length, first = played.mask[lane].sum(), played.obs[lane, 0, 0]
        assert length == 2 + first % 3
        last = (played.terminated[lane, length - 1], played.truncated[lane, length - 1])
        assert last == ((first % 2 == 0), (first % 2 == 1))
        np.testing.assert_array_equal(played.next_obs[lane, :length, 1], 1 + np.arange(length))
        paid = 2 + played.action[lane, :length]
        np.testing.assert_array_equal(played.reward[lane, :length], paid)
        ends.add(last)
    assert len({first for first, *_ in played.obs[:, 0]}) == 8 and len(ends) == 2


def test_no_world_is_stepped_after_its_end_nor_made_without_need():
    env = from_gymnasium(Script, 50)
    Script.resets = Script.steps = 0
    for number in range(3):
        played = play(env, 4, number)
    calls = []
    step = env.host.step
    env.host.__dict__["step"] = lambda asked: (calls.append(1), step(asked))[1]
    played = jax.block_until_ready(jax.jit(lambda key: rollout(
        env, act, key, HostedParams(60), 4))(key()))  # fmt: skip
    assert Script.resets == 16 and len(env.host.every) == 4
    assert len(calls) == played.mask.sum(1).max()  # when all are over the host is not asked
    assert not env.host.standing and len(env.host.said) <= 100


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_same_of_vectors_of_worlds_whatever_they_do_after_the_end(mode):
    together = from_gymnasium(partial(vector, mode), 9)
    Script.resets = 0
    assert_same(alone(), play(together, 7))
    assert len(together.host.every) == 3 and Script.resets > 9  # some by themselves
    assert_same(alone(), play(together, 7))


@cache
def alone():
    return play(from_gymnasium(Script, 8), 7)


def test_time_limits_truncate_the_worlds_and_those_of_params():
    limited = from_gymnasium(lambda: TimeLimit(Script(), 1), 4)
    for env, steps in ((limited, 7), (from_gymnasium(Script, 4), 1)):
        played = play(env, 4, steps=steps)
        assert played.mask.sum(1).max() == 1 and played.truncated[:, 0].all()
        assert not env.host.standing  # each of them is free again
    assert from_gymnasium("MountainCar-v0", 1).default_params.max_steps == 200
    assert from_gymnasium(Script, 1).default_params.max_steps == 1000


def test_too_few_worlds_are_said():
    with pytest.raises(Exception, match="num_envs is 2: more episodes are played at once"):
        play(from_gymnasium(Script, 2), 3)


def test_worlds_are_closed_with_their_environment():
    env, Closing.closed = from_gymnasium(Closing, 8), 0
    env.host.begin(np.arange(3))
    assert len(env.host.every) == 3 and not Closing.closed
    del env
    gc.collect()
    assert Closing.closed == 3


def test_lanes_of_a_vector_are_not_left_behind():
    env = from_gymnasium(partial(vector, AutoresetMode.NEXT_STEP), 3)
    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(key(), 2), HostedParams(7))
    one = jax.tree.map(lambda leaf: leaf[0], state)
    with pytest.raises(Exception, match="lanes of a VectorEnv are stepped together"):
        jax.block_until_ready(env.step(key(), one, 0, HostedParams(7)))


def test_equal_episodes_may_part():
    """As those of swept settings, whose runs have the same keys."""
    env, params = from_gymnasium(Script, 8), HostedParams(7)
    keys = jax.vmap(lambda _: key())(jnp.arange(3))
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    step = jax.vmap(env.step, (None, 0, 0, None))
    for actions in ([0, 0, 0], [1, 1, 2]):
        obs, state, *_ = step(key(), state, jnp.array(actions), params)
    assert obs[0, 2] == obs[1, 2] == obs[2, 2] - 1


def test_episodes_that_differ_in_spite_of_their_seed_stay_apart():
    env, params = from_gymnasium(Moody, 8), HostedParams(7)
    obs, state = jax.vmap(env.reset, (0, None))(jax.vmap(lambda _: key())(jnp.arange(2)), params)
    after, *_ = jax.vmap(env.step, (None, 0, None, None))(key(), state, 0, params)
    assert obs[0, 2] != obs[1, 2] and (after[:, 2] - obs[:, 2] == 2).all()


def test_frames_are_seen_as_they_are():
    class Frames(Script):
        observation_space = spaces.Box(0, 255, (2, 2, 1), np.uint8)

        def _seen(self):
            return np.full((2, 2, 1), self.time, np.uint8)

    env = FrameStack(from_gymnasium(Frames, 2), 2)
    obs, state = env.reset(key(), HostedParams(7))
    obs, *_ = env.step(key(), state, 1, HostedParams(7))
    assert obs.dtype == jnp.uint8 and obs[0, 0].tolist() == [0, 1]


class Continuous(Script):
    action_space = spaces.Box(-1, 1, (2, 2))


class Parted(Script):
    observation_space = spaces.Dict(a=spaces.Discrete(2))


@pytest.mark.parametrize(("make", "said"), [
    (Continuous, r"Continuous: actions are Box.*TransformAction"),
    (Parted, r"Parted: observations are Dict.*FlattenObservation"),
    ("CartPol-v1", r"Did you mean: `CartPole`"),
])  # fmt: skip
def test_what_does_not_fit_is_said(make, said):
    with pytest.raises(ValueError, match=said):
        from_gymnasium(make, 1)


def begun(seed):
    """Where a CartPole of this seed begins."""
    return 0.05 * ((seed % np.array([97, 89, 83, 79])) / 50 - 1)


@dataclass(frozen=True)
class Native(CartPole):
    """Ours, begun where the other begins."""

    def reset(self, key, params):
        seed = (jax.random.bits(key, dtype=jnp.uint32) >> 1).astype(jnp.int32)
        obs = begun(seed).astype(jnp.float32)
        return obs, self.state_of(obs)


class Seeded(gymnasium.Wrapper):
    """Gymnasium's, likewise."""

    def reset(self, *, seed=None, options=None):
        self.env.reset(seed=seed)
        self.unwrapped.state = begun(seed)
        return np.array(begun(seed), np.float32), {}


def test_the_same_run_learns_the_same_by_either_cartpole():
    """Agent and model; Gymnasium computes in double precision."""
    there = from_gymnasium(lambda: Seeded(gymnasium.make("CartPole-v1", max_episode_steps=50)), 4)
    config = DynaConfig(num_episodes=25, num_steps=50, model_updates=3)
    model = SupervisedConfig(hidden=(16,), normalise=True, delta=True, sum_loss=False)
    curves = {}
    for env, params in ((Native(), CartPoleParams(max_steps=50)), (there, HostedParams(50))):
        dyna = parts(FrameStack(env, 1), ReinforceConfig(), model)._replace(dream=None)
        hparams = DynaHParams(ReinforceHParams(), SupervisedHParams(), params)
        curves[type(env).__name__] = jax.jit(make_train(dyna, config))(key(), hparams)[1]
    ours, theirs = curves.values()
    assert len(set(ours["real_return"].tolist())) > 5
    for name, curve in ours.items():
        np.testing.assert_allclose(curve, theirs[name], rtol=1e-3, atol=1e-5, err_msg=name)


class Painted(Script):
    """Draws its time."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def render(self):
        assert self.render_mode == "rgb_array"
        return np.full((8, 6, 3), self.time, np.uint8)


def test_a_world_is_watched_as_it_draws_itself():
    env = FrameStack(from_gymnasium(Painted, 3), 1)
    scene = Scene(env, env.default_params)
    shots = scene.played(lambda obs, key: 1, 2, 10)
    length = 2 + 2 % 3
    assert [shot["true"][0].mean() for shot in shots] == [*range(length + 1)]
    assert shots[-1]["true"][1] == f"step {length}, return {3 * length}, over"
    obs = scene.sides["true"].obs
    assert obs.dtype == np.float32 and obs[1] == length
    blind = from_gymnasium(Script, 3)
    with pytest.raises(ValueError, match="the world draws nothing"):
        Scene(blind, blind.default_params)
