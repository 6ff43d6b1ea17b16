"""The same loop on pixels: DQN, a frame model, a replay of frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import assert_same

from jaxdyna.agents import DQNConfig, DQNHParams, dqn, real_memory
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams, make_train
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.models import LearnedEnvironment, LearnedParams, PixelConfig, PixelHParams, pixels
from jaxdyna.networks import GlimpseQ, LocalDynamics
from jaxdyna.planners import solve_maze
from jaxdyna.replay import frames as frame_replay, memory

SIZE, STEPS, EPISODES, FIRST = 4, 8, 5, 3
ENV = FrameStack(Maze(size=SIZE, num_obstacles=1))
NETWORK = GlimpseQ(5, size=3, hidden=(16,))
AGENT_CONFIG = DQNConfig(
    network=NETWORK, updates=2, fake_updates=2, batch=8, capacity=200, episodes=30,
    fake_capacity=90, fake_episodes=30,
)  # fmt: skip
AGENT = dqn((SIZE, SIZE, 3), 5, AGENT_CONFIG)
MODEL = pixels((SIZE, SIZE, 3), 5, PixelConfig(LocalDynamics(3, (8,))))


def start(key, held):
    return frame_replay.sample(held, key, ()).obs


def watch(real, states, params):
    begun = jax.tree.map(lambda leaf: leaf[:, 0], states)
    plan = jax.vmap(lambda state: solve_maze(ENV.env, state, params, STEPS))(begun)
    drawn = jax.vmap(ENV.env.frame)(begun)
    played = real.obs[:, 0, ..., -3:]
    return {"best": plan.best_return.mean(), "drawn": drawn, "played": played}


MEMORY = memory.frames(lambda rest: rest["reward"] != 0, shared=real_memory)
DREAM = Dream(
    LearnedEnvironment(ENV, MODEL.predict, start),
    lambda state, hparams: LearnedParams(state.model.params, MEMORY.of(state)),
)
DYNA = Dyna(
    ENV, AGENT, MODEL, DREAM, watch=watch, memory=MEMORY,
    record=lambda state, after, info: state.env,
)  # fmt: skip
CONFIG = DynaConfig(
    num_episodes=EPISODES, num_real_first=FIRST, num_steps=STEPS, model_updates=2, model_batch=8,
    dream_updates=2, dream_episodes=3, dream_steps=4, rare_share=0.5,
)  # fmt: skip
HPARAMS = DynaHParams(DQNHParams(), PixelHParams(), MazeParams(max_steps=STEPS))


@pytest.fixture(scope="module")
def run():
    return jax.jit(make_train(DYNA, CONFIG))(jax.random.key(0), HPARAMS)


def test_dreams_branch_off_from_real_frames(run):
    state, metrics = run
    assert state.replay is None and int(state.agent.real.size) == EPISODES * STEPS
    assert int(state.agent.fake.size) == (EPISODES - FIRST + 1) * 2 * 3 * 4
    dreaming = np.isfinite(np.asarray(metrics["fake_return"]))
    assert dreaming.tolist() == [number + 1 >= FIRST for number in range(EPISODES)]
    assert (metrics["fake_length"][dreaming] == 4).all()
    real, numbers = real_memory(state.agent), jnp.arange(EPISODES * STEPS)
    frames = {frame.tobytes() for frame in np.asarray(frame_replay.take(real, numbers).obs)}
    fake = state.agent.fake.memory
    firsts = np.flatnonzero(np.asarray(fake.time)[: int(fake.added)] == 0)
    begun = np.asarray(frame_replay.take(fake, jnp.asarray(firsts)).obs)
    assert all(stack.tobytes() in frames for stack in begun)


@pytest.mark.slow
def test_real_steps_that_the_model_keeps_itself_change_nothing(run):
    config = replace(CONFIG, replay_capacity=AGENT_CONFIG.capacity)
    whole, metrics = jax.jit(make_train(DYNA, config))(jax.random.key(0), HPARAMS)
    assert int(whole.replay.size) == EPISODES * STEPS
    assert_same((whole.agent, whole.model, metrics), (run[0].agent, run[0].model, run[1]))


def test_watching_sees_the_state_an_episode_began_in(run):
    """The optimal return is of the start that was really played."""
    _, metrics = run
    np.testing.assert_array_equal(metrics["drawn"], metrics["played"])
    assert len({frame.tobytes() for frame in np.asarray(metrics["played"])}) > 1
    assert (metrics["best"] >= metrics["real_return"] - 1e-4).all()


def test_arms_play_the_same_first_episodes(run):
    alone = DYNA._replace(model=None, dream=None)
    _, without = jax.jit(make_train(alone, CONFIG))(jax.random.key(0), HPARAMS)
    assert_same(without["real_return"][:FIRST], run[1]["real_return"][:FIRST])
    assert_same(without["best"], run[1]["best"])


def test_a_dream_has_at_least_one_step():
    with pytest.raises(ValueError, match="dream_steps"):
        DynaConfig(dream_steps=0)
