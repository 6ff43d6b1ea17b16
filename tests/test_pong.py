"""Pong against a recorded game of the Atari 2600, rule by rule, and what it looks like."""

from functools import partial
from operator import itemgetter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from parts import assert_same
from pong_plain import PlainPong
from tools.pong_trace import Script, play, record, samples, script

from jaxdyna import rollout
from jaxdyna.envs import CHANNELS, Pong, PongParams
from jaxdyna.envs.pong_rules import FIELD, advance, first_state
from jaxdyna.envs.pong_screen import masks_by_colour

TRACE = dict(np.load(Path(__file__).parent / "data" / "pong_trace.npz"))
BALL = np.stack([TRACE["ball_row"], TRACE["ball_column"]], axis=-1).astype(np.int32)
IN_PLAY = TRACE["ball_row"] > -48
PARAMS = PongParams()


def rallies():
    """``(first frame, last frame)`` of the recorded rallies, from serve to point."""
    serves = np.nonzero(IN_PLAY[1:] & ~IN_PLAY[:-1])[0] + 1
    points = np.nonzero(TRACE["reward"])[0]
    return [(serve, points[points > serve][0]) for serve in serves if (points > serve).any()]


def after_serve(frame, clock):
    """The game's state just after it has served, at a given phase of the opponent's rest."""
    return first_state(PARAMS).replace(
        ball=jnp.array(BALL[frame]),
        ball_velocity=jnp.array(BALL[frame + 1] - BALL[frame]),
        own=jnp.int32(TRACE["own"][frame]),
        opponent=jnp.int32(TRACE["opponent"][frame]),
        wait=jnp.int32(0),
        clock=jnp.int32(clock),
    )


@pytest.fixture(scope="module")
def replayed():
    """Each recorded rally played again with the recorded actions and own paddle: positions of the
    ball and of the opponent, for each of the 8 phases in which the opponent may rest.
    """

    @jax.jit
    def play(start, actions, own):
        def frame(state, now):
            action, own = now
            state = advance(jax.random.key(0), state, action, PARAMS).replace(own=own)
            return state, (state.ball, state.opponent, state.score)

        return jax.lax.scan(frame, start, (actions, own))[1]

    longest = 1 + max(last - first for first, last in rallies())
    played = []
    for first, last in rallies():
        later = np.minimum(np.arange(first + 1, first + longest), len(IN_PLAY) - 1)
        starts = [after_serve(first, clock) for clock in range(8)]
        actions, own = (TRACE[name].astype(np.int32)[later] for name in ("action", "own"))
        phases = jax.vmap(play, (0, None, None))(
            jax.tree.map(lambda *parts: jnp.stack(parts), *starts), actions, own
        )
        opponent = TRACE["opponent"][first + 1 : first + 80]
        best = (np.asarray(phases[1])[:, : len(opponent)] != opponent).sum(1).argmin()
        length = last - first
        played.append(tuple(np.asarray(part[best, :length]) for part in phases))
    return played


def test_the_ball_flies_and_bounces_as_in_the_real_game(replayed):
    """Frame by frame from the serve until the first pixel of difference."""
    right = total = 0
    for (first, last), (ball, _, _) in zip(rallies(), replayed, strict=True):
        wrong = (ball != BALL[first + 1 : last + 1]).any(-1)
        right += wrong.argmax() if wrong.any() else len(wrong)
        total += len(wrong)
    print(f"ball: {right / total:.3f} of {total} frames in {len(replayed)} rallies")
    assert total > 8_000
    assert right / total > 0.9


def test_the_opponent_moves_and_points_fall_as_in_the_real_game(replayed):
    same, exact = [], []
    for (first, last), (ball, opponent, score) in zip(rallies(), replayed, strict=True):
        if (ball == BALL[first + 1 : last + 1]).all():
            same.append((opponent == TRACE["opponent"][first + 1 : last + 1]).mean())
            exact.append(score[-1] == [TRACE["reward"][last] < 0, TRACE["reward"][last] > 0])
            assert not score[-2].any()
    assert len(same) > 0.7 * len(replayed)
    assert np.mean(same) > 0.95 and np.all(exact)


def test_the_own_paddle_answers_the_stick_as_in_the_real_game():
    """Two seconds ahead from rest; the real one is an analogue circuit and rounds otherwise."""
    rest = (np.diff(TRACE["own"]) == 0) & (TRACE["action"][1:] == 0)
    starts = [
        start
        for start in range(20, len(rest) - 120, 97)
        if rest[start - 12 : start].all() and start % 2 == 0
    ]
    assert len(starts) >= 3

    def play(own, actions):
        state = first_state(PARAMS).replace(own=own, own_target=own + 1.0, clock=jnp.int32(1))

        def frame(state, action):
            state = advance(jax.random.key(0), state, action, PARAMS)
            return state, state.own

        return jax.lax.scan(frame, state, actions)[1]

    windows = np.array(starts)[:, None] + np.arange(1, 121)
    own = jax.jit(jax.vmap(play))(
        TRACE["own"].astype(np.int32)[starts], TRACE["action"].astype(np.int32)[windows]
    )
    off = np.abs(np.asarray(own) - TRACE["own"][windows])
    print(f"own paddle: off by {off.mean():.2f} pixels")
    moved = np.abs(TRACE["own"][windows] - TRACE["own"][starts][:, None])
    assert off.mean() < 2 and off.mean() < 0.1 * moved.mean()


def test_a_bounce_is_counted_by_hand():
    """A serve, one hit by the own paddle's lower half that sends the ball down at 45 degrees, and
    a point won.
    """
    columns = [0, 137, 138, 139, 138, 137, 136, 0]
    rows = [-48, 60, 60, 60, 61, 62, 63, -48]
    trace = {"ball_row": rows, "ball_column": columns, "own": [52] * 8, "opponent": [20] * 8}
    trace |= {"reward": [0] * 6 + [1, 0]}
    found = samples({name: np.array(row, np.int16) for name, row in trace.items()})
    assert found["rally"].tolist() == [5] and found["point"].tolist() == [1]
    assert found["own_place"].tolist() == [8] and found["own_angle"].tolist() == [45]
    assert found["across"].tolist() == [1] * 5 and len(found["opponent_place"]) == 0


def test_the_recorded_player_plays_so_again():
    """Its script; and, with the emulator at hand, the recorded game's first frames."""
    again = script(12_000, 5)
    followed = again.action >= 0
    np.testing.assert_array_equal(TRACE["action"][followed], again.action[followed])
    pytest.importorskip("ale_py")
    few = record(Script(*(part[:300] for part in again)))
    assert_same(few, {name: TRACE[name][:300] for name in few})


def test_rallies_speeds_and_bounces_are_those_of_the_real_game():
    """The recorded player's 12,000 frames there beside 48,000 here: how fast balls fly, at which
    angle each part of a paddle sends them off, how long rallies last (8 there, so roughly).
    """
    real = samples(TRACE)
    pure = samples(play(script(48_000, 5), jax.random.key(5)))
    for speed in (1, 2, 3):
        assert abs(np.mean(real["across"] == speed) - np.mean(pure["across"] == speed)) < 0.05
    parts = 0
    for side in ("own", "opponent"):
        for low in range(-4, 16, 4):
            angles = []
            for game in (real, pure):
                hits = game[f"{side}_place"] // 4 == low // 4
                angles.append(game[f"{side}_angle"][hits])
            if min(map(len, angles)) >= 3:
                assert np.median(angles[0]) == pytest.approx(np.median(angles[1]), abs=1)
                parts += 1
    assert parts >= 6
    assert 0.5 < np.mean(real["rally"]) / np.mean(pure["rally"]) < 2
    assert abs(np.mean(pure["point"])) < 0.6


def test_games_with_other_settings_are_batched():
    """Whatever can be swept, one value a game, as if each were played alone."""
    env = Pong(scale=8)
    many = PARAMS.replace(
        first_serve_delay=jnp.array([1, 2, 9]),
        opponent_speed=jnp.array([0, 2, 5]),
        opponent_rest=jnp.array([1, 8, 3]),
        paddle_speed=jnp.array([0.0, 5.8, 9.0]),
        repeat_action_probability=jnp.array([0.0, 0.5, 1.0]),
        max_steps=jnp.array([5, 30, 40]),
    )

    def played(params):
        return rollout(
            env, lambda obs, key: jnp.int32(3), jax.random.key(7), params, 1, num_steps=40
        )

    axes = PARAMS.replace(
        **dict.fromkeys(vars(PARAMS))
        | {name: 0 for name, value in vars(many).items() if jnp.ndim(value)}
    )
    batch = jax.jit(jax.vmap(played, (axes,)))(many)
    for number in range(3):
        one = {name: value[number] for name, value in vars(many).items() if jnp.ndim(value)}
        alone = jax.jit(played)(PARAMS.replace(**one))
        assert_same(jax.tree.map(itemgetter(number), batch), alone)
    assert batch.mask.sum((1, 2)).tolist() == [5, 30, 40]


def test_a_random_player_loses_as_in_the_real_game():
    """12 random games of ``ALE/Pong-v5`` (frame skip 4, no sticky actions, seed 0): return -20.4,
    935 steps (standard deviation 80), 35 steps a point in the median.
    """
    env = Pong(scale=8, palette=CHANNELS)
    played = rollout(
        env,
        lambda obs, key: jax.random.randint(key, (), 0, env.num_actions),
        jax.random.key(0),
        PARAMS,
        24,
        num_steps=1_500,
    )
    score, steps = played.reward.sum(1).mean(), played.mask.sum(1).mean()
    print(f"random players: {score:.1f} points in {steps:.0f} steps")
    assert abs(score + 20.4) < 0.6
    assert abs(steps - 935) < 80
    points = [np.diff(np.nonzero(episode)[0]) for episode in np.asarray(played.reward)]
    assert np.median(np.concatenate(points)) == 35
    assert played.terminated.any(1).mean() > 0.9


@pytest.fixture(scope="module")
def states():
    """200 states of two games of random players."""
    env = Pong(frame_skip=1)

    def play(key):
        def frame(carry, _):
            state, key = carry
            key, key_act, key_step = jax.random.split(key, 3)
            action = jax.random.randint(key_act, (), 0, env.num_actions)
            state = advance(key_step, state, action, PARAMS)
            return (state, key), state

        states = jax.lax.scan(frame, (first_state(PARAMS), key), length=900)[1]
        return jax.tree.map(lambda part: part[::9], states)

    states = jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(1), 2))
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), states)


@pytest.mark.parametrize("scale", [1, pytest.param(2, marks=pytest.mark.slow), 4, 8])
def test_a_frame_shows_its_masks(scale, states):
    """The three objects, in their colours, and nothing else on the field; the same masks come from
    the picture of the whole screen by colour, as the real game's do.
    """
    env = Pong(scale=scale)
    frames = jax.jit(jax.vmap(env.frame))(states)
    masks = jax.jit(jax.vmap(env.object_masks))(states)
    assert frames.shape[1:] == env.frame_shape and frames.dtype == jnp.uint8
    # Where two share a pixel the ball is in front.
    masks = masks._replace(own=masks.own & ~masks.ball, opponent=masks.opponent & ~masks.ball)
    field = frames[:, 34:-16] if scale == 1 else frames
    inside = [mask[:, 34:-16] if scale == 1 else mask for mask in masks]
    for mask, colour in zip(inside, env.palette[1:], strict=True):
        assert mask.any() and (field[mask] == jnp.array(colour)).all()
    rest = ~np.any(inside, axis=0)
    assert (np.asarray(field)[rest] == env.palette.background).all()
    if scale > 1:
        screens = jax.vmap(Pong().frame)(states)
        seen = masks_by_colour(screens, scale, env.palette)
        everywhere = jax.vmap(env.object_masks)(states)
        np.testing.assert_array_equal(seen.ball, everywhere.ball)
        assert not (seen.own & ~everywhere.own).any()
        assert not (seen.opponent & ~everywhere.opponent).any()


def test_the_ball_never_vanishes_while_it_is_on_the_field(states):
    visible = (states.ball[:, 0] > -4) & (states.ball[:, 0] < FIELD)
    for scale in (5, 16):
        masks = jax.vmap(Pong(scale=scale).object_masks)(states)
        np.testing.assert_array_equal(masks.ball.any((1, 2)), visible)


def test_points_end_the_episode_and_nothing_moves_afterwards():
    env = Pong(scale=8)
    params = PARAMS.replace(points_to_win=1, first_serve_delay=0, max_steps=9_999)
    step = jax.jit(env.step)
    _, state = env.reset(jax.random.key(0), params)
    down = jnp.int32(3)
    for time in range(300):
        _, state, reward, terminated, truncated, _ = step(jax.random.key(time), state, down, params)
        assert not truncated
        if terminated:
            break
        assert reward == 0
    assert terminated and reward in (-1, 1) and state.score.max() == 1
    again = step(jax.random.key(0), state, down, params)
    np.testing.assert_array_equal(again[1].ball, state.ball)
    assert again[2] == 0 and again[3]
    short = params.replace(max_steps=2)
    _, state = env.reset(jax.random.key(0), short)
    ends = []
    for time in range(2):
        _, state, _, terminated, truncated, _ = step(jax.random.key(time), state, down, short)
        ends.append((bool(terminated), bool(truncated)))
    assert ends == [(False, False), (False, True)]


@partial(jax.jit, static_argnums=0)
def steps_of(env, state, actions, key, params):
    """The answers of `Pong.step` to some actions, and what is random in every frame of them."""

    def coin(key):
        key_sticky, key_serve = jax.random.split(key)
        sticks = jax.random.bernoulli(key_sticky, params.repeat_action_probability)
        return jax.random.bernoulli(key_serve), sticks

    def frame_keys(key, _):
        return tuple(jax.random.split(key))

    def step(carry, action):
        state, key = carry
        key, key_step = jax.random.split(key)
        _, keys = jax.lax.scan(frame_keys, jax.random.clone(key_step), length=env.frame_skip)
        answer = env.step(key_step, state, action, params)
        return (answer[1], key), (answer, jax.vmap(coin)(keys))

    return jax.lax.scan(step, (state, key), actions)[1]


GAMES = [Pong(scale=8, palette=CHANNELS), Pong(scale=10, frame_skip=1, palette=CHANNELS)]
START = jax.tree.map(np.asarray, first_state(PARAMS))
LENGTH = 30


@st.composite
def games(draw):
    """A game in the midst of play or before a serve, other settings, and actions held a while."""
    whole = st.integers
    rules = PongParams(
        points_to_win=draw(whole(1, 3)), max_steps=draw(whole(1, LENGTH)),
        first_serve_delay=draw(whole(0, 5)), serve_delay=draw(whole(0, 5)),
        opponent_speed=draw(whole(0, 5)), opponent_rest=draw(whole(1, 9)),
        paddle_speed=draw(st.sampled_from([0.0, 5.8, 9.5])),
        repeat_action_probability=draw(st.sampled_from([0.0, 0.25, 1.0])),
    )  # fmt: skip
    state = START.replace(wait=np.int32(max(rules.first_serve_delay, 1)))
    if draw(st.booleans()):
        place, speed = (draw(whole(-3, 158)), draw(whole(4, 155))), draw(whole(1, 3))
        flight = draw(whole(-3, 2)), draw(st.sampled_from([-speed, speed]))
        own, opponent = (place[0] + draw(whole(-30, 15)) for _ in range(2))
        own = min(max(own, -9), 156)
        state = state.replace(
            ball=np.int32(place), ball_velocity=np.int32(flight), own=np.int32(own),
            own_target=np.float32(own), opponent=np.int32(opponent), wait=np.int32(0),
            clock=np.int32(draw(whole(0, 9))),
        )  # fmt: skip
    held = draw(st.lists(st.tuples(whole(0, 5), whole(1, 12)), min_size=1))
    actions = np.resize(np.repeat(*map(np.int32, zip(*held, strict=True))), LENGTH)
    return draw(st.sampled_from(GAMES)), rules, state, actions, draw(whole(0, 2**31))


@given(game=games())
@settings(max_examples=60)
def test_any_game_agrees_with_the_second_implementation(game):
    env, rules, state, actions, seed = game
    limit = rules.max_steps
    played = steps_of(env, state, actions, jax.random.key(seed), rules)
    answers, (upwards, sticks) = jax.tree.map(np.asarray, played)
    obs, after, reward, terminated, truncated, _ = answers
    names = [name for name in vars(state) if name != "time"]
    begun = {name: getattr(state, name).tolist() for name in names}
    pairs = {name: tuple(begun[name]) for name in ("ball", "ball_velocity", "score")}
    other, expected = PlainPong(**begun | pairs, params=rules), []
    for time, action in enumerate(actions.tolist(), start=1):
        behind = other.score[0] - other.score[1]
        for coins in zip(upwards[time - 1], sticks[time - 1], strict=True):
            if max(other.score) < rules.points_to_win:
                other.frame(action, *coins)
        over = max(other.score) >= rules.points_to_win
        outcome = behind - (other.score[0] - other.score[1]), over, not over and time >= limit
        now = {name: getattr(other, name) for name in names}
        expected.append((other.picture(env.scale), now, *outcome))
        row, column = other.ball
        assert row == -48 or (-7 < row < 163 and 0 <= column < 160)
    frames, states, *outcomes = zip(*expected, strict=True)
    np.testing.assert_array_equal([reward, terminated, truncated], outcomes)
    for name in names:
        theirs, here = getattr(after, name), [one[name] for one in states]
        np.testing.assert_array_equal(theirs, here, err_msg=name)
        assert theirs.dtype == getattr(START, name).dtype
    np.testing.assert_array_equal(obs, frames)
    np.testing.assert_array_equal(after.time, 1 + np.arange(LENGTH))


def test_fire_makes_a_hit_faster_up_to_three_pixels():
    state = first_state(PARAMS).replace(
        wait=jnp.int32(0), own=jnp.int32(60), own_target=jnp.float32(61)
    )
    frame = jax.jit(advance)
    for before, fires, after in [(1, 1, 2), (2, 1, 3), (3, 1, 3), (1, 0, 1), (2, 0, 2)]:
        hit = state.replace(
            ball=jnp.array([66, 139], jnp.int32),
            ball_velocity=jnp.array([1, before], jnp.int32),
            last_action=jnp.int32(fires),
        )
        new = frame(jax.random.key(0), hit, jnp.int32(0), PARAMS)
        assert new.ball_velocity[1] == -after
        assert new.ball_velocity[0] == 0  # in the middle of the paddle


def test_sticky_actions_repeat_the_last_one():
    """With probability 1 the first frame's action, none, is held for ever."""
    env, params = Pong(scale=8), PARAMS.replace(repeat_action_probability=1.0)
    _, state = env.reset(jax.random.key(0), params)
    step = jax.jit(env.step)
    for time in range(10):
        _, stuck, *_ = step(jax.random.key(time), state, jnp.int32(3), params)
        _, free, *_ = step(jax.random.key(time), state, jnp.int32(3), PARAMS)
        assert stuck.own == state.own and free.own > state.own
        state = stuck


def test_serves_go_up_and_down_alike_and_to_the_loser():
    env, params = Pong(frame_skip=1), PARAMS.replace(serve_delay=0)
    out = first_state(params).replace(wait=jnp.int32(0), ball=jnp.array([80, 156], jnp.int32))

    def serve(key, column):
        state = out.replace(ball=out.ball.at[1].set(column))
        for key_frame in jax.random.split(key, 2):
            state = advance(key_frame, state, jnp.int32(0), params)
        return state.ball_velocity

    keys = jax.random.split(jax.random.key(0), 400)
    serves = jax.jit(jax.vmap(serve, (0, None)))
    lost = serves(keys, 156)
    won = serves(jax.random.split(jax.random.key(1), 400), 3)
    assert (lost[:, 1] == 1).all() and (won[:, 1] == -1).all()
    assert set(np.unique(lost[:, 0])) == {-1, 1} and abs(lost[:, 0].mean()) < 0.2
    assert env.frame_shape == (210, 160, 3)


@pytest.mark.parametrize(
    ("settings", "words"), [({"frame_skip": 0}, "at least 1"), ({"scale": 3}, "divisor of 160")]
)
def test_clear_errors(settings, words):
    with pytest.raises(ValueError, match=words):
        Pong(**settings)
