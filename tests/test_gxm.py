"""gxm's worlds as environments: a suite with a script, then real ones where they are installed."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from jaxdyna import rollout
from jaxdyna.envs import from_gxm
from jaxdyna.envs.named import module_of, named
from jaxdyna.experiments import any as any_world
from jaxdyna.testing import check_environment


@struct.dataclass
class Params:
    max_timesteps: int = 6


@struct.dataclass
class State:
    cell: jax.Array
    timestep: int = 0


class Discrete(SimpleNamespace):
    def sample(self, key):
        return jax.random.randint(key, (), 0, self.n)


class Box(SimpleNamespace):
    def sample(self, key):
        return jax.random.uniform(key, self.shape, minval=self.low, maxval=self.high)


class Suite:
    """A walk that pays its action and ends beyond cell 9, or by the suite's own limit. It begins at
    cell 0 to 2, by a key that is used twice; what is seen is the cell, in an array of a shape.
    """

    def __init__(self, shape):
        self.shape = shape

    def reset_env(self, key, params):
        cell = jax.random.randint(key, (), 0, 3) + 0 * jax.random.randint(key, (), 0, 3)
        return self.see(cell), State(cell)

    def step_env(self, key, state, action, params):
        state = State(state.cell + jnp.int32(action).sum(), state.timestep + 1)
        done = self.is_terminal(state, params)
        return self.see(state.cell), state, jnp.sum(action), done, {}

    def is_terminal(self, state, params):
        return (state.cell > 9) | (state.timestep >= params.max_timesteps)

    def see(self, cell):
        return jnp.full(self.shape, cell / 15)


NUMBERED, BOXED = (
    Discrete(n=4),
    Box(low=np.zeros(2, np.float32), high=np.full(2, 2, np.float32), shape=(2,)),
)
WORLDS = {"Walk": ((3,), NUMBERED), "Board": ((2, 3), NUMBERED), "Picture": ((4, 4, 1), NUMBERED),
          "Pushed": ((3,), BOXED)}  # fmt: skip


def make(world):
    suite, name = world.split("/")
    shape, actions = WORLDS[name]
    env = object() if suite == "Resets" else Suite(shape)
    seen = Box(low=np.zeros(shape), high=np.ones(shape), shape=shape)
    return SimpleNamespace(env=env, env_params=Params(), action_space=actions,
                           observation_space=seen)  # fmt: skip


@pytest.fixture
def scripted(monkeypatch):
    spaces = SimpleNamespace(Discrete=Discrete, Box=Box)
    monkeypatch.setitem(sys.modules, "gxm", SimpleNamespace(make=make, spaces=spaces))
    yield
    named.cache_clear()


@pytest.mark.parametrize("name", WORLDS)
def test_keeps_the_contract(scripted, name):
    env = from_gxm(f"Script/{name}")
    check_environment(env, random=True)
    assert hasattr(env, "num_actions") == (name != "Pushed")


def test_how_a_world_is_seen(scripted):
    spaces = {name: from_gxm(f"Script/{name}").observation_space(None) for name in WORLDS}
    assert {name: (space.shape, space.dtype.name) for name, space in spaces.items()} == {
        "Walk": ((3,), "float32"), "Board": ((6,), "float32"), "Pushed": ((3,), "float32"),
        "Picture": ((4, 4, 1), "uint8"),
    }  # fmt: skip
    env = from_gxm("Script/Picture")
    _, state = env.reset(jax.random.key(0), env.default_params)
    obs, state, *_ = env.step(jax.random.key(1), state, jnp.int32(3), env.default_params)
    assert (obs == 255 * state.suite.cell // 15).all()


@pytest.mark.parametrize(("pace", "limit", "steps", "terminated"), [
    (3, 6, 3, True),  # the world's own end, and what was seen there
    (1, 6, 6, False),  # its time limit is none
    (2, 4, 4, True),  # an end at the limit is an end
    (1, 20, 8, True),  # a limit of ours beyond its own
    (0, 20, 20, False),
])  # fmt: skip
def test_ends_and_limits(scripted, pace, limit, steps, terminated):
    env = from_gxm("Script/Walk")
    assert env.default_params.max_steps == 6
    params, act = env.default_params.replace(max_steps=limit), lambda obs, key: jnp.int32(pace)
    played = jax.tree.map(
        np.asarray, rollout(env, act, jax.random.key(0), params, 12, num_steps=20)
    )
    begun = np.round(15 * played.obs[:, 0, 0])
    row = int(np.flatnonzero(begun == 2)[0])
    last = played.mask[row].sum() - 1
    assert last + 1 == steps
    assert (played.terminated[row, last], played.truncated[row, last]) == (
        terminated,
        not terminated,
    )
    np.testing.assert_allclose(15 * played.next_obs[row, last], 2 + pace * steps, rtol=1e-6)
    assert played.reward[row, last] == pace


def test_any_plays_it(scripted):
    options = any_world.defaults("gxm:Script/Walk")
    assert options.learner == "dqn" and options.hparams.env.max_steps == 6
    assert options.home == module_of("gxm:Script/Walk") == "jaxdyna.envs"
    made = any_world.arms(options.resolved())
    assert "oracle" in made
    assert any_world.defaults("gxm:Script/Pushed").learner == "reinforce"


@pytest.mark.parametrize(("world", "answer"), [
    ("Resets/Walk", "its step resets, and what was seen last is lost"),
    ("Script/Run", "Script/Run cannot be played (KeyError('Run'))"),
    ("Walk", "as gxm calls it"),
    (None, "gxm's worlds need gxm"),
])  # fmt: skip
def test_others_are_refused_in_one_line(scripted, world, answer, monkeypatch, capsys):
    if world is None:
        monkeypatch.setitem(sys.modules, "gxm", None)
    with pytest.raises(SystemExit, match="2"):
        any_world.main(["--env", f"gxm:{world}"])
    (line,) = capsys.readouterr().err.splitlines()
    assert answer in line and "pip install 'jaxdyna[gxm]' 'gymnax<1' 'craftax<1.6'" in line


def test_beside_gxm_itself():
    """Step by step what gxm's own step says, but at the end, where that begins anew."""
    gxm = pytest.importorskip("gxm")
    pytest.importorskip("gymnax")
    env, theirs, key = (
        from_gxm("Gymnax/CartPole-v1"),
        gxm.make("Gymnax/CartPole-v1"),
        jax.random.key,
    )
    params, step, own = env.default_params, jax.jit(env.step), jax.jit(theirs.step)
    obs, state = env.reset(key(3), params)
    (theirs_state, first), steps = theirs.init(jax.random.key_data(key(3))), 0
    np.testing.assert_array_equal(obs, first.next_obs)
    terminated = False
    while not terminated:
        steps += 1
        obs, state, reward, terminated, truncated, _ = step(key(steps), state, 1, params)
        theirs_state, said = own(jax.random.key_data(key(steps)), theirs_state, 1)
        assert (reward, terminated, truncated) == (said.reward, said.terminated, False)
        same = np.allclose(obs, said.next_obs)
        assert same != terminated
    assert 5 < steps < 20 and np.abs(obs[2]) > 0.209 > np.abs(said.next_obs[2])
    check_environment(env, random=True)


@pytest.mark.slow
def test_craftax():
    pytest.importorskip("gxm"), pytest.importorskip("craftax")
    env = from_gxm("Craftax/Craftax-Classic-Symbolic-v1")
    assert env.num_actions == 17 and env.default_params.max_steps == 10000
    check_environment(env, random=True)
