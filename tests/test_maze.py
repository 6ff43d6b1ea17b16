"""The Maze against a second implementation, and its exact oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maze_numpy import PlainMaze, best_return
from parts import assert_same

from jaxdyna import rollout
from jaxdyna.envs import CartPole, FrameStack, Maze, MazeParams, MazeState
from jaxdyna.envs.maze import MOVES, WAIT, enlarge
from jaxdyna.planners import solve_maze

ENV, PARAMS = Maze(), MazeParams()


def plain(state, max_steps=200, size=16):
    return PlainMaze(
        size, state.agent, state.goal, state.obstacles, state.directions, max_steps=max_steps
    )


@pytest.mark.parametrize(
    "env", [ENV, Maze(size=5, num_obstacles=9, goal=(4, 4)), Maze(size=2, num_obstacles=0)]
)
def test_whole_episodes_agree_with_the_second_implementation(env):
    params = MazeParams(collision_reward=-3.0, goal_reward=2.0, max_steps=60)
    step = jax.jit(env.step)
    for seed in range(8):
        obs, state = env.reset(jax.random.key(seed), params)
        other = plain(state, 60, env.size)
        np.testing.assert_array_equal(obs, other.frame())
        # Towards the goal rather than at random, or the corner is never left.
        actions = np.random.default_rng(seed).choice(
            [0, 1, 2, 3, 4], 60, p=[0.1, 0.3, 0.3, 0.1, 0.2]
        )
        for time, action in enumerate(actions, start=1):
            obs, state, reward, terminated, truncated, info = step(
                jax.random.key(9), state, jnp.int32(action), params
            )
            expected, ended = other.step(action, -3.0, 2.0)
            assert (float(reward), bool(truncated), bool(terminated)) == (expected, ended, False)
            assert bool(info["collision"]) == (tuple(map(int, state.agent)) in other.obstacles)
            np.testing.assert_array_equal(obs, other.frame())
            np.testing.assert_array_equal(state.directions, other.directions)
            assert state.time == time


def test_many_random_states_agree():
    """10,000 states anywhere on the grid, shared cells and corners included."""
    generator = np.random.default_rng(0)
    count = 10_000
    state = MazeState(
        agent=generator.integers(0, 16, (count, 2)),
        goal=np.where(
            generator.random((count, 1)) < 0.5, generator.integers(0, 16, (count, 2)), 15
        ),
        obstacles=generator.integers(0, 16, (count, 5, 2)),
        directions=generator.integers(0, 4, (count, 5)),
        time=generator.integers(0, 200, count),
    )
    state = jax.tree.map(lambda leaf: np.asarray(leaf, np.int32), state)
    actions = generator.integers(0, 5, count)
    keys = jax.random.split(jax.random.key(0), count)
    step = jax.jit(jax.vmap(ENV.step, (0, 0, 0, None)))
    answer = jax.tree.map(np.asarray, step(keys, state, actions, PARAMS))
    obs, _, reward, _, truncated, info = answer
    for number in range(count):
        other = plain(jax.tree.map(lambda leaf, at=number: leaf[at], state))
        expected, _ = other.step(actions[number])
        assert float(reward[number]) == expected
        np.testing.assert_array_equal(obs[number], other.frame())
    np.testing.assert_array_equal(truncated, state.time >= 199)
    np.testing.assert_array_equal(reward == -5 + info["at_goal"], info["collision"])
    assert 100 < info["collision"].sum() < 400


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
    for settings, words in (
        ({"size": 1}, "at least 2"),
        ({"num_obstacles": 255}, "0..254"),
        ({"goal": (0, 16)}, "goal is"),
        ({"start": (-1, 0)}, "start is"),
        ({"start": [3, 4]}, "must be a tuple"),
        ({"size": 4.5}, "a whole number"),
    ):
        with pytest.raises(ValueError, match=words):
            Maze(**settings)


def test_frames_for_people():
    obs, state = ENV.reset(jax.random.key(0), PARAMS)
    picture = ENV.render(state, PARAMS)
    assert picture.shape == (256, 256, 3) and picture.dtype == jnp.uint8
    np.testing.assert_array_equal(picture[8::16, 8::16], obs)
    assert_same(enlarge(obs, 1), obs)


def test_the_oracle_is_the_best_that_search_finds():
    solve = jax.jit(solve_maze, static_argnums=(0, 3))
    for env, steps in ((ENV, 60), (Maze(size=4, num_obstacles=6), 25)):
        for seed in range(4):
            params = MazeParams(max_steps=steps)
            _, state = env.reset(jax.random.key(seed), params)
            plan = solve(env, state, params, steps)
            assert plan.best_return == best_return(plain(state, steps, env.size), steps)


def test_of_equal_actions_the_oracle_takes_the_first():
    """To the upper right corner it goes right first, and in the end it does what comes first."""
    env, params = Maze(size=4, num_obstacles=0), MazeParams(max_steps=8)
    plan = jax.jit(lambda key: solve_maze(env, env.reset(key, params)[1], params, 8))(
        jax.random.key(0)
    )
    assert plan.action[0, 3, 0] == 1
    assert plan.action[-1, 3, 0] == 0


def test_following_the_oracle_earns_what_it_promises():
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
    """A random policy earns about -19.5, the oracle 167.8 (of 1,000 starts)."""

    def act(obs, key):
        return jax.random.randint(key, (), 0, len(MOVES))

    episodes = jax.jit(lambda key: rollout(ENV, act, key, PARAMS, 200))(jax.random.key(1))
    assert -23 < episodes.reward.sum(1).mean() < -16
    keys = jax.random.split(jax.random.key(2), 100)
    best = jax.jit(
        jax.vmap(lambda key: solve_maze(ENV, ENV.reset(key, PARAMS)[1], PARAMS, 200).best_return)
    )(keys)
    assert best.mean() == pytest.approx(167.8, abs=1.2)


def test_only_pictures_are_stacked():
    with pytest.raises(ValueError, match="observes pictures"):
        FrameStack(CartPole())
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
