"""The Maze against a second implementation, and its exact optimum."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from maze_numpy import PlainMaze, best_return
from parts import assert_same

from jaxdyna import rollout
from jaxdyna.envs import FrameStack, Maze, MazeParams, MazeState
from jaxdyna.envs.maze import MOVES, WAIT, enlarge
from jaxdyna.planners import solve_maze

ENV, PARAMS = Maze(), MazeParams()


def plain(state, max_steps=200, size=16):
    return PlainMaze(
        size, state.agent, state.goal, state.obstacles, state.directions, max_steps=max_steps
    )


BOARDS = [ENV, Maze(size=5, num_obstacles=9, goal=(4, 4)), Maze(size=2, num_obstacles=0)]
STEPS = 40


@partial(jax.jit, static_argnums=0)
def play(env, state, actions, params):
    """The first frame, and the answers of `Maze.step` to some actions, with an axis of time."""

    def step(state, action):
        answer = env.step(jax.random.key(0), state, action, params)
        return answer[1], answer

    return env.frame(state), jax.lax.scan(step, state, actions)[1]


@st.composite
def games(draw):
    """A board, a state anywhere on it, shared cells and corners included, actions and rewards."""
    env = draw(st.sampled_from(BOARDS))
    cell = st.tuples(*[st.integers(0, env.size - 1)] * 2)
    obstacles = draw(st.tuples(*[st.tuples(cell, st.integers(0, 3))] * env.num_obstacles))
    cells = np.reshape([cell for cell, _ in obstacles], (-1, 2))
    directions = [direction for _, direction in obstacles]
    parts = draw(cell), draw(cell), cells, directions, draw(st.integers(0, 60))
    actions = draw(st.lists(st.integers(0, 4), min_size=STEPS, max_size=STEPS))
    reward = st.integers(-9, 9).map(float)
    params = MazeParams(draw(reward), draw(reward), draw(st.integers(1, 60)))
    return env, MazeState(*(np.asarray(part, np.int32) for part in parts)), actions, params


@given(game=games())
@settings(max_examples=100)
def test_any_game_agrees_with_the_second_implementation(game):
    env, start, actions, params = game
    first, answers = jax.tree.map(np.asarray, play(env, start, np.int32(actions), params))
    obs, state, reward, terminated, truncated, info = answers
    other = plain(start, params.max_steps, env.size)
    other.time = int(start.time)
    np.testing.assert_array_equal(first, other.frame())
    rewards, ends, frames, turned = [], [], [], []
    for action in actions:
        earned, ended = other.step(action, params.collision_reward, params.goal_reward)
        rewards.append(earned)
        ends.append(ended)
        frames.append(other.frame())
        turned.append(list(other.directions))
    np.testing.assert_array_equal(reward, rewards)
    np.testing.assert_array_equal(truncated, ends)
    np.testing.assert_array_equal(obs, frames)
    np.testing.assert_array_equal(state.directions, turned)
    np.testing.assert_array_equal(info["collision"], (obs[..., 0] & obs[..., 2]).any((1, 2)))
    np.testing.assert_array_equal(state.time, start.time + 1 + np.arange(STEPS))
    assert not terminated.any() and obs.dtype == np.uint8 and reward.dtype == np.float32


def test_a_turn_takes_the_whole_tick_and_exchanging_cells_is_no_collision():
    def state(agent, obstacle, direction):
        parts = (agent, (0, 15), [obstacle], [direction], 0)
        return MazeState(*(jnp.asarray(part, jnp.int32) for part in parts))

    env = Maze(num_obstacles=1)
    _, after, *_ = env.step(jax.random.key(0), state((15, 0), (4, 0), 0), WAIT, PARAMS)
    assert after.obstacles.tolist() == [[4, 0]] and after.directions.tolist() == [1]
    _, after, *_ = env.step(jax.random.key(0), after, WAIT, PARAMS)
    assert after.obstacles.tolist() == [[4, 1]]
    _, after, reward, *_ = env.step(jax.random.key(0), state((8, 8), (8, 9), 0), 1, PARAMS)
    assert after.agent.tolist() == [8, 9] and after.obstacles.tolist() == [[8, 8]] and reward == 0
    _, _, reward, *_ = env.step(jax.random.key(0), state((0, 14), (0, 14), 1), 1, PARAMS)
    assert reward == -4  # on the goal and hit: both count


def test_the_last_step_and_a_crowded_cell_by_hand():
    def step(time):
        cells = (1, 1), (3, 3), [(1, 2), (1, 2)]
        parts = (*cells, [0, 0], time)
        state = MazeState(*(jnp.asarray(part, jnp.int32) for part in parts))
        params = MazeParams(max_steps=5)
        return Maze(4, 2).step(jax.random.key(0), state, WAIT, params)[2:5]

    assert [[float(part) for part in step(time)] for time in (3, 4)] == [[-5, 0, 0], [-5, 0, 1]]


def test_starts_are_distinct_uniform_and_free():
    env = Maze(size=4, num_obstacles=5)
    keys = jax.random.split(jax.random.key(0), 4000)
    _, state = jax.jit(jax.vmap(env.reset, (0, None)))(keys, PARAMS)
    cells = np.asarray(state.obstacles @ jnp.array([4, 1]))
    assert all(len(set(row)) == 5 for row in cells)
    counts = np.bincount(cells.ravel(), minlength=16)
    assert counts[12] == counts[3] == 0  # the agent's and the goal's
    np.testing.assert_allclose(np.delete(counts, [3, 12]), 20000 / 14, rtol=0.1)
    np.testing.assert_allclose(np.bincount(state.directions.ravel()), 5000, rtol=0.08)


def test_clear_errors():
    for changes, words in (
        ({"size": 1}, "at least 2"),
        ({"num_obstacles": 255}, "0..254"),
        ({"goal": (0, 16)}, "goal is"),
        ({"start": (-1, 0)}, "start is"),
        ({"start": [3, 4]}, "must be a tuple"),
        ({"size": 4.5}, "a whole number"),
    ):
        with pytest.raises(ValueError, match=words):
            Maze(**changes)


def test_frames_for_people():
    obs, state = ENV.reset(jax.random.key(0), PARAMS)
    picture = ENV.render(state, PARAMS)
    assert picture.shape == (256, 256, 3) and picture.dtype == jnp.uint8
    np.testing.assert_array_equal(picture[8::16, 8::16], obs)
    assert_same(enlarge(obs, 1), obs)


def test_the_optimum_is_the_best_that_search_finds():
    solve = jax.jit(solve_maze, static_argnums=(0, 3))
    for env, steps in ((ENV, 60), (Maze(size=4, num_obstacles=6), 25)):
        for seed in range(4):
            params = MazeParams(max_steps=steps)
            _, state = env.reset(jax.random.key(seed), params)
            plan = solve(env, state, params, steps)
            assert plan.best_return == best_return(plain(state, steps, env.size), steps)


def test_of_equal_actions_the_plan_takes_the_first():
    """To the upper right corner it goes right first, and in the end it does what comes first."""
    env, params = Maze(size=4, num_obstacles=0), MazeParams(max_steps=8)
    plan = jax.jit(lambda key: solve_maze(env, env.reset(key, params)[1], params, 8))(
        jax.random.key(0)
    )
    assert plan.action[0, 3, 0] == 1
    assert plan.action[-1, 3, 0] == 0


def test_following_the_plan_earns_what_it_promises():
    keys = jax.random.split(jax.random.key(0), 20)

    @jax.jit
    @jax.vmap
    def follow(key):
        _, state = ENV.reset(key, PARAMS)
        plan = solve_maze(ENV, state, PARAMS, 200)

        def step(state, time):
            action = plan.action[time, state.agent[0], state.agent[1]]
            _, state, reward, *_ = ENV.step(jax.random.key(0), state, action, PARAMS)
            return state, reward

        return plan.best_return, jax.lax.scan(step, state, jnp.arange(200))[1].sum()

    promised, earned = follow(keys)
    np.testing.assert_array_equal(promised, earned)
    assert 160 < promised.mean() < 171  # 30 steps are the shortest way


def test_a_horizon_shorter_than_the_plan_earns_nothing_after_it():
    _, state = ENV.reset(jax.random.key(0), PARAMS)
    short = solve_maze(ENV, state, MazeParams(max_steps=50), 50)
    long = solve_maze(ENV, state, MazeParams(max_steps=50), 80)
    assert short.best_return == long.best_return
    np.testing.assert_array_equal(short.value, long.value[:51])


def test_the_measured_means_of_the_rules():
    """A random policy earns about -19.5, the optimum 167.8 (of 1,000 starts)."""

    def act(obs, key):
        return jax.random.randint(key, (), 0, len(MOVES))

    episodes = jax.jit(lambda key: rollout(ENV, act, key, PARAMS, 200))(jax.random.key(1))
    assert -23 < episodes.reward.sum(1).mean() < -16
    keys = jax.random.split(jax.random.key(2), 100)
    best = jax.jit(
        jax.vmap(lambda key: solve_maze(ENV, ENV.reset(key, PARAMS)[1], PARAMS, 200).best_return)
    )(keys)
    assert best.mean() == pytest.approx(167.8, abs=1.2)


def test_only_pictures_and_vectors_are_stacked():
    matrix = SimpleNamespace(shape=(3, 4))
    world = SimpleNamespace(default_params=None, observation_space=lambda params: matrix)
    with pytest.raises(ValueError, match="observe pictures"):
        FrameStack(world)
    with pytest.raises(ValueError, match="num_frames is 0"):
        FrameStack(Maze(), 0)


def test_it_plays_and_plans_in_double_precision():
    with jax.enable_x64(True):
        maze = Maze(4, 2)
        env = FrameStack(maze)
        params = env.default_params

        def act(obs, key):
            return jax.random.randint(key, (), 0, 5)

        play = jax.jit(lambda key: rollout(env, act, key, params, 3, num_steps=6))
        played = play(jax.random.key(0))
        assert played.reward.shape == (3, 6)
        _, start = maze.reset(jax.random.key(1), params)
        assert {leaf.dtype for leaf in jax.tree.leaves(start)} == {np.dtype(np.int32)}
        plan = jax.jit(lambda start: solve_maze(maze, start, params, 6))(start)
        assert plan.action.shape == (6, 4, 4)
