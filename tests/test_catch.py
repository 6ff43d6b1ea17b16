"""Catch against its rules played by hand and once more in plain Python."""

import dataclasses
from functools import cache, partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings, strategies as st
from parts import assert_same, returns_of

from jaxdyna import rollout
from jaxdyna.agents import ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.agents.reinforce import within_episode
from jaxdyna.envs import Catch, CatchParams, FrameStack
from jaxdyna.experiments.catch.acting import LEAN, TUNED, agent_of, arms, model_of
from jaxdyna.experiments.maze import arms as maze
from jaxdyna.experiments.maze.options import LEAN as MAZE_LEAN
from jaxdyna.fields import changed, leaves
from jaxdyna.models import PixelConfig, PixelHParams, pixels
from jaxdyna.networks import LocalDynamics
from jaxdyna.sweep import over_runs

GAMES = [Catch(), Catch(2, 1), Catch(7, 4, frames=True), Catch(4, 9, frames=True)]


class PlainCatch:
    """One game, on a list of lists."""

    def __init__(self, rows, columns, ball):
        self.rows, self.columns = rows, columns
        self.row, self.ball, self.paddle = 0, ball, columns // 2

    def step(self, action):
        if action == 0 and self.paddle > 0:
            self.paddle -= 1
        if action == 2 and self.paddle < self.columns - 1:
            self.paddle += 1
        self.row += 1
        if self.row < self.rows - 1:
            return 0, False
        return (1 if self.ball == self.paddle else -1), True

    def board(self):
        board = [[0] * self.columns for _ in range(self.rows)]
        board[self.row][self.ball] = 1
        board[-1][self.paddle] = 1
        return np.array(board)

    def frame(self):
        frame = np.zeros((self.rows, self.columns, 3), np.uint8)
        frame[self.row, self.ball, 0] = 255
        frame[-1, self.paddle, 2] = 255
        return frame


@cache
def start(env, column):
    _, state = env.reset(jax.random.key(0), env.default_params)
    return state.replace(ball=jnp.array([0, column], jnp.int32))


@partial(jax.jit, static_argnums=0)
def play(env, params, state, actions):
    """The answers of `Catch.step` to some actions, with a leading axis of time."""

    def step(state, action):
        answer = env.step(jax.random.key(0), state, action, params)
        return answer[1], answer

    return jax.lax.scan(step, state, actions)[1]


def random_act(obs, key):
    return jax.random.randint(key, (), 0, 3)


def test_an_episode_by_hand():
    env = Catch(rows=4, columns=3)
    params = CatchParams(catch_reward=5.0, miss_reward=-2.0, max_steps=3)
    state = start(env, 2)
    boards, outcomes = [env.observe(state)], []
    for action in (0, 2, 2):
        obs, state, *outcome, info = env.step(jax.random.key(0), state, jnp.int32(action), params)
        boards.append(obs)
        outcomes.append((*map(float, outcome), bool(info["caught"])))
    drawn = [
        ["..o", "...", "...", ".x."],
        ["...", "..o", "...", "x.."],
        ["...", "...", "..o", ".x."],
        ["...", "...", "...", "..x"],
    ]
    lit = [[float(cell != ".") for cell in "".join(board)] for board in drawn]
    np.testing.assert_array_equal(boards, lit)
    assert outcomes == [(0, 0, 0, False), (0, 0, 0, False), (5, 1, 0, True)]
    np.testing.assert_array_equal(env.frame(state)[3, 2], [255, 0, 255])
    missed = play(env, params, start(env, 0), jnp.array([2, 2, 1]))
    assert missed[2].tolist() == [0, 0, -2] and not missed[5]["caught"].any()
    assert missed[1].paddle.tolist() == [2, 2, 2]


@st.composite
def games(draw):
    """A board, the ball's column, actions until it has landed, rewards, and a limit."""
    env = draw(st.sampled_from(GAMES))
    actions = st.lists(st.integers(0, 2), min_size=env.rows - 1, max_size=env.rows - 1)
    reward = st.integers(-9, 9).map(float)
    params = CatchParams(draw(reward), draw(reward), draw(st.integers(1, env.rows)))
    return env, draw(st.integers(0, env.columns - 1)), draw(actions), params


@given(game=games())
@settings(max_examples=80)
def test_any_game_agrees_with_the_second_implementation(game):
    env, column, actions, params = game
    answers = play(env, params, start(env, column), jnp.array(actions))
    obs, state, reward, terminated, truncated, info = jax.tree.map(np.asarray, answers)
    other, earned = PlainCatch(env.rows, env.columns, column), {0: 0.0}
    earned |= {1: params.catch_reward, -1: params.miss_reward}
    for time, action in enumerate(actions):
        outcome, ended = other.step(action)
        assert (reward[time], terminated[time]) == (earned[outcome], ended)
        assert truncated[time] == (not ended and time + 1 >= params.max_steps)
        assert info["caught"][time] == (outcome == 1)
        seen = other.frame() if env.frames else other.board().reshape(-1)
        np.testing.assert_array_equal(obs[time], seen)
        assert state.ball[time].tolist() == [other.row, other.ball]
        assert (state.paddle[time], state.time[time]) == (other.paddle, time + 1)


@pytest.mark.parametrize("frames", [False, True])
def test_jitted_vmapped_and_looped_are_the_same(frames):
    env = Catch(frames=frames)
    params = env.default_params
    space = env.observation_space(params)

    def begin(seed):
        return env.reset(jax.random.key(seed), params)

    obs, states = jax.jit(jax.vmap(begin))(jnp.arange(6))
    actions = jnp.array([0, 1, 2, 2, 1, 0])
    many = jax.jit(jax.vmap(env.step, (None, 0, 0, None)))
    answers = many(jax.random.key(0), states, actions, params)
    for number in range(6):
        alone = begin(number)
        assert_same(jax.tree.map(lambda leaf, at=number: leaf[at], (obs, states)), alone)
        answer = env.step(jax.random.key(0), alone[1], actions[number], params)
        assert_same(jax.tree.map(lambda leaf, at=number: leaf[at], answers), answer)
        assert space.contains(np.asarray(alone[0])) and space.contains(np.asarray(answer[0]))


def test_balls_start_in_every_column_alike():
    env = Catch()
    keys = jax.random.split(jax.random.key(0), 5000)
    obs, state = jax.jit(jax.vmap(env.reset, (0, None)))(keys, env.default_params)
    np.testing.assert_allclose(np.bincount(state.ball[:, 1]), 1000, rtol=0.1)
    np.testing.assert_array_equal(obs[:, :5].argmax(1), state.ball[:, 1])
    assert (state.ball[:, 0] == 0).all() and (state.paddle == 2).all() and (state.time == 0).all()


def test_an_episode_terminates_or_is_truncated_never_both():
    env = Catch()

    @jax.jit
    def episodes(max_steps):
        params = env.default_params.replace(max_steps=max_steps)
        return rollout(env, random_act, jax.random.key(2), params, 20, num_steps=10)

    for max_steps in (1, 4, 8, 9, 10):
        played, terminates = episodes(max_steps), max_steps >= 9
        assert (played.mask.sum(1) == min(max_steps, 9)).all()
        assert (played.terminated.any(1) == terminates).all()
        assert (played.truncated.any(1) != terminates).all()
        assert (np.abs(played.reward.sum(1)) == terminates).all()


def test_a_paddle_that_follows_the_ball_catches_all():
    """Also through one vmap over rewards."""
    env = FrameStack(Catch(frames=True), 2)

    def act(obs, key):
        ball, paddle = (obs[..., layer].any(0).argmax() for layer in (3, 5))
        return jnp.sign(ball - paddle) + 1

    def returns(reward, key):
        params = env.default_params.replace(catch_reward=reward)
        return rollout(env, act, key, params, 50, num_steps=9).reward.sum(1)

    rewards = jnp.array([1.0, 3.0])
    earned = jax.jit(jax.vmap(returns))(rewards, jax.random.split(jax.random.key(4), 2))
    np.testing.assert_array_equal(earned, rewards[:, None].repeat(50, 1))


def test_stacks_are_of_the_last_frames():
    env = FrameStack(Catch(4, 3, frames=True), 2)
    params, step = env.default_params, jax.jit(env.step)
    obs, state = jax.jit(env.reset)(jax.random.key(0), params)
    seen = [obs[..., 3:]]
    np.testing.assert_array_equal(obs[..., :3], seen[0])
    for _ in range(3):
        obs, state, *_ = step(jax.random.key(0), state, jnp.int32(0), params)
        np.testing.assert_array_equal(obs[..., :3], seen[-1])
        seen.append(jax.jit(env.env.frame)(state.env))
        np.testing.assert_array_equal(obs[..., 3:], seen[-1])


def test_a_stack_is_of_the_environments_own_kind():
    """Shades from 0 to 1 are no bytes."""

    class Shades(Catch):
        def observation_space(self, params):
            return spaces.Box(-1, 1, (10, 5, 3), np.float32)

    stacked = FrameStack(Shades(frames=True), 2).observation_space(None)
    assert stacked == spaces.Box(-1, 1, (10, 5, 6), np.float32)
    bytes_ = FrameStack(Catch(frames=True), 2).observation_space(None)
    assert bytes_ == spaces.Box(0, 255, (10, 5, 6), np.uint8)


def test_stacked_frames_suit_a_frame_model():
    env = FrameStack(Catch(frames=True), 2)
    config = PixelConfig(LocalDynamics(3, (4,)), terminates=True)
    model = pixels((10, 5, 3), env.num_actions, config, num_frames=2)

    def predict(key):
        key_reset, key_init, key_predict = jax.random.split(key, 3)
        obs, _ = env.reset(key_reset, env.default_params)
        params = model.init(key_init, PixelHParams()).params
        return obs, model.predict(params, obs, jnp.int32(2), key_predict)

    obs, prediction = jax.eval_shape(predict, jax.random.key(0))
    assert prediction.next_obs.shape == obs.shape == (10, 5, 6)


def test_it_plays_in_double_precision():
    with jax.enable_x64(True):
        env = Catch()
        params = env.default_params
        played = jax.eval_shape(
            lambda key: rollout(env, random_act, key, params, 3), jax.random.key(0)
        )
        assert played.action.dtype == np.int64
        assert (played.obs.dtype, played.reward.dtype) == (np.float32, np.float32)


@pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning")
@pytest.mark.parametrize("frames", [False, True])
def test_gymnasium_plays_it(frames):
    env = gymnasium.make("jaxdyna/Catch-v0", env=Catch(frames=frames), render_mode="rgb_array")
    check_env(env.unwrapped)
    obs, _ = env.reset(seed=0)
    assert obs.shape == ((10, 5, 3) if frames else (50,))
    ends = [env.step(1)[2:4] for _ in range(9)]
    assert ends == [(False, False)] * 8 + [(True, False)]
    assert gymnasium.spec("jaxdyna/Catch-v0").reward_threshold == 0.9


def test_frames_for_people():
    env = Catch()
    _, state = env.reset(jax.random.key(0), env.default_params)
    picture = env.render(state, env.default_params)
    assert picture.shape == (250, 125, 3) and picture.dtype == jnp.uint8
    np.testing.assert_array_equal(picture[12::25, 12::25], env.frame(state))


def test_clear_errors():
    for changes, words in (
        ({"rows": 1}, "rows is 1: it must be at least 2"),
        ({"columns": 0}, "columns is 0: it must be at least 1"),
        ({"rows": 2.5}, "whole number"),
    ):
        with pytest.raises(ValueError, match=words):
            Catch(**changes)
    assert hash(Catch()) == hash(Catch()) != hash(Catch(frames=True))


@pytest.mark.slow
def test_more_updates_learns_from_real_steps_alone():
    """Whatever is dreamed, its policy is the same; and by dyna's values it is not."""
    options = changed(TUNED, {
        "rows": 4, "columns": 2, "episodes": 4, "widths": (4,), "dyna.num_real_first": 2,
        "dyna.dream_steps": 2, "dyna.dream_episodes": 4, "dyna.model_updates": 1,
        "agent.updates": 2, "agent.fake_updates": 2, "agent.batch": 4, "agent.fake_capacity": 64,
    })  # fmt: skip
    made = arms(options.resolved())

    arm = made["more_updates"]()

    def play(key, hparams):
        def episode(number, state):
            return arm.work.step(state, None, number, hparams)[0]

        return jax.lax.fori_loop(0, 4, episode, arm.work.init(key, hparams))

    together = jax.jit(over_runs(play, 1))

    def policy(**changes):
        hparams = jax.tree.map(lambda leaf: np.array([leaf]), arm.hparams.replace(**changes))
        agent = together(jax.random.split(jax.random.key(0), 1), hparams).agent
        return agent.params, int(agent.steps[0])

    other, values = PixelHParams(1e-1), vars(made["dyna"]().hparams)
    assert policy()[1] == 4 * 2 + 3 * 2
    assert_same(policy(model=other, model_trains=True)[0], policy()[0])
    ways = [policy(**values | changes) for changes in ({}, {"model": other})]
    assert ways[0][1] == 4 * 2 + 3 * 2
    dreamed = zip(*(jax.tree.leaves(params) for params, _ in ways), strict=True)
    assert not all(bool((one == two).all()) for one, two in dreamed)


def test_lean_is_that_of_the_maze():
    """Nothing in it was chosen on Catch: but for the board's own, and for the end, which the Maze
    has not, whatever both worlds have is the same.
    """
    ours, theirs = ({leaf.path: leaf.value for leaf in leaves(each)} for each in (LEAN, MAZE_LEAN))
    common = ours.keys() & theirs.keys()
    assert {path for path in common if ours[path] != theirs[path]} == {"hparams.env.max_steps"}
    board = {"rows", "columns", "hparams.env.catch_reward", "hparams.env.miss_reward"}
    networks = {"glimpse", "hidden", "widths", "reward_around"}
    assert ours.keys() - common == board | networks
    agent, model = agent_of(LEAN), maze.model_of(MAZE_LEAN)
    assert agent.network.clone(num_actions=5) == maze.agent_of(MAZE_LEAN).network
    assert model_of(LEAN) == dataclasses.replace(model, terminates=True) != model_of(TUNED)


def test_reinforce_learns_where_one_reward_comes_at_the_end():
    """By its default; standardised within the episode, every end looks alike."""

    def last(config):
        agent = reinforce((12,), 3, config)
        return returns_of(Catch(4, 3), agent, ReinforceHParams(0.03), 3, 400)[-100:].mean()

    assert last(ReinforceConfig()) > 0.7
    assert last(ReinforceConfig(advantage=within_episode)) < 0.5
