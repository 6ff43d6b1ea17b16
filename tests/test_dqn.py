"""DQN: its equations by hand, its two replays, and that it learns."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from parts import assert_close, assert_same, returns_of

from jaxdyna import rollout
from jaxdyna.agents import DQNConfig, DQNHParams, dqn, exploration, q_values
from jaxdyna.agents.dqn import BEGUN, _descend, _mixed
from jaxdyna.envs import Catch, FrameStack, Maze, MazeParams
from jaxdyna.losses import td_error
from jaxdyna.networks import GlimpseQ, PerceptronQ, PlainQ, to_patches
from jaxdyna.replay import prioritized
from jaxdyna.types import Transition

SIZE = 4
ENV = FrameStack(Maze(size=SIZE, num_obstacles=1))
NETWORK = GlimpseQ(5, size=3, hidden=(16,))
SMALL = DQNConfig(
    network=NETWORK, updates=3, fake_updates=2, batch=8, capacity=200, episodes=30,
    fake_capacity=60, fake_episodes=20,
)  # fmt: skip
HPARAMS = DQNHParams()


@cache
def make(**changes):
    agent = dqn((SIZE, SIZE, 3), 5, replace(SMALL, **changes))
    return agent._replace(
        init=jax.jit(agent.init),
        update=jax.jit(agent.update),
        update_fake=jax.jit(agent.update_fake),
    )


@cache
def play(seed, count=2, steps=6):
    return _played(jax.random.key(seed), MazeParams(max_steps=steps), count)


@partial(jax.jit, static_argnums=2)
def _played(key, params, count):
    def act(obs, key):
        return jax.random.randint(key, (), 0, 5)

    return rollout(ENV, act, key, params, count, num_steps=6)


def test_td_error_by_hand():
    values, target, online = (jnp.array(row) for row in ([1.0, 2.0], [5.0, 3.0], [0.0, 9.0]))
    plain = td_error(values, 0, 10.0, 0.5, target, target)
    double = td_error(values, 0, 10.0, 0.5, target, online)
    assert plain == 10 + 0.5 * 5 - 1 and double == 10 + 0.5 * 3 - 1
    assert td_error(values, 1, 10.0, 0.0, target, online) == 8


def test_nothing_flows_into_the_target():
    slope = jax.grad(lambda x: td_error(x, 0, 1.0, 0.5, 3 * x, x))(jnp.array([1.0, 2.0]))
    np.testing.assert_array_equal(slope, [-1, 0])


class Linear:
    """Values of two actions from a vector of two, by a matrix."""

    def init(self, key, x):
        return jnp.zeros((2, 2))

    def apply(self, params, x):
        return x @ params


LINEAR = Linear()
SIMPLE = DQNConfig(
    network=LINEAR, batch=4000, capacity=8, episodes=4, fake_capacity=8, fake_episodes=4
)


def known(config, reward, terminated, weight=1.0):
    """A learner that holds two real and two fake steps from [1, 0] to [0, 1]. The values there are
    1 and 2 before, 0 and 9 after, or by the target network 5 and 3. It has made 5 steps.
    """
    state, shape = dqn((2,), 2, config).init(jax.random.key(0), HPARAMS), (2, 1)
    before, after = (jnp.broadcast_to(row, (*shape, 2)) for row in jnp.eye(2))
    ends, ones = jnp.full(shape, terminated), jnp.ones(shape)
    steps = Transition(
        before,
        jnp.zeros(shape, jnp.int32),
        reward * ones,
        after,
        ends,
        ~ends,
        ones > 0,
        weight * ones,
    )
    return state.replace(
        params=jnp.array([[1.0, 2.0], [0.0, 9.0]]), target=jnp.array([[7.0, 7.0], [5.0, 3.0]]),
        opt_state=optax.tree.set(state.opt_state, count=jnp.int32(5)),
        real=prioritized.add(state.real, steps), fake=prioritized.add(state.fake, steps),
    )  # fmt: skip


def descent(key, hparams, config, reward=2.0, terminated=False, weight=1.0, priority=1.0):
    """One gradient step of it: the new state, and the loss. Its first real step is drawn so many
    times as often as the other.
    """
    return _one_step(key, hparams, config, reward, terminated, weight, priority)


@partial(jax.jit, static_argnums=2)
def _one_step(key, hparams, config, reward, terminated, weight, priority):
    state = known(config, reward, terminated, weight)
    first = state.real.priority.at[0].set(priority)
    state = state.replace(real=state.real.replace(priority=first))
    return _descend(partial(q_values, LINEAR), config, state, key, hparams)


HALVES = DQNHParams(discount=0.5, reward_scale=0.5)


def test_the_loss_by_hand():
    """Of Huber: half of the square up to 1, linear beyond."""
    double = descent(jax.random.key(0), HALVES, SIMPLE)[1]
    np.testing.assert_allclose(double, (1 + 0.5 * 3 - 1) - 0.5)
    half = descent(jax.random.key(0), HALVES, SIMPLE, weight=0.5)[1]
    np.testing.assert_allclose(half, double / 2)
    ended = descent(jax.random.key(0), HALVES, SIMPLE, 3.0, True)[1]
    np.testing.assert_allclose(ended, 0.5 * (1.5 - 1) ** 2)


def test_the_squared_loss_by_hand():
    squared = descent(jax.random.key(0), HALVES, replace(SIMPLE, loss=optax.l2_loss))[1]
    np.testing.assert_allclose(squared, 0.5 * (1 + 0.5 * 3 - 1) ** 2)


@pytest.mark.slow
def test_the_loss_without_double_by_hand():
    single = descent(jax.random.key(0), HALVES, replace(SIMPLE, double=False))[1]
    np.testing.assert_allclose(single, (1 + 0.5 * 5 - 1) - 0.5)


def weighed(key):
    """The loss of two equal steps, 1 each, of which the first is drawn three times as often."""
    hparams = HALVES.replace(fake_share=0.0, importance_exponent=1.0)
    return descent(key, hparams, SIMPLE, priority=3.0)[1]


def test_importance_weights_by_hand():
    """What is drawn three times as often weighs a third, and the other 1."""
    np.testing.assert_allclose(weighed(jax.random.key(0)), 3 / 4 * 1 / 3 + 1 / 4, atol=0.02)


def test_priorities_by_hand():
    hparams = HALVES.replace(fake_share=1.0, priority_exponent=0.5)
    learned, _ = descent(jax.random.key(0), hparams, SIMPLE)
    assert learned.real.priority[0] == 1
    np.testing.assert_allclose(learned.fake.priority[0], np.sqrt(1.5 + 0.001), rtol=1e-6)


def test_the_optimiser_remembers():
    """Adam corrects its moments by the number of steps that were made."""
    learned, _ = descent(jax.random.key(0), HALVES, SIMPLE)
    assert optax.tree.get(learned.opt_state, "count") == 6


@partial(jax.jit, static_argnums=(0, 1))
def chosen(config, fake, hparams):
    """How often it does each of its actions, where it explores by doing the second."""
    agent, state = dqn((2,), 2, config), known(config, 0.0, False)
    drift, obs = jnp.array([0.0, 99.0]), jnp.array([0.0, 1.0])
    state = state.replace(exploration=state.exploration.replace(drift=drift))
    act, keys = agent.act_fake if fake else agent.act, jax.random.split(jax.random.key(5), 200)
    actions = jax.vmap(lambda key: act(state, obs, key, hparams))(keys)
    return jnp.bincount(actions, length=2)


def test_who_acts():
    """The target network, or the online one."""
    by_online = replace(SIMPLE, act_by_target=False)
    assert chosen(SIMPLE, False, DQNHParams(epsilon_first=0.0)).tolist() == [200, 0]
    assert chosen(by_online, False, DQNHParams(epsilon_first=0.0)).tolist() == [0, 200]
    assert chosen(SIMPLE, False, DQNHParams(epsilon_first=1.0)).tolist() == [0, 200]


def test_dreams_explore_without_direction():
    assert chosen(SIMPLE, True, DQNHParams(epsilon_fake=1.0)).min() > 70
    assert chosen(SIMPLE, True, DQNHParams(epsilon_fake=0.0)).tolist() == [200, 0]


def test_dreams_explore_as_real_episodes_where_they_are_told():
    """By the same share, of which nothing is left here."""
    hparams = DQNHParams(epsilon_first=0.0, epsilon_fake=None)
    assert chosen(SIMPLE, True, hparams).tolist() == [200, 0]
    assert chosen(SIMPLE, True, hparams.replace(epsilon_first=1.0)).min() > 70


def test_a_plain_network_is_that_of_the_authors():
    """6,400 features of the last convolution go into the dense layer. What the convolutions see is
    normalised over the pictures at hand: brightness is no matter, company is.
    """
    shapes = jax.eval_shape(PlainQ(5).init, jax.random.key(0), jnp.zeros((1, 16, 16, 12)))["params"]
    assert shapes["Dense_0"]["kernel"].shape == (6400, 512)
    assert shapes["Dense_1"]["kernel"].shape == (512, 5)
    network = PlainQ(5, (4, 4), 8)
    pictures = jax.random.uniform(jax.random.key(1), (3, 7, 7, 12))
    params, values = jax.jit(network.init)(jax.random.key(2), pictures), jax.jit(network.apply)
    one, three = values(params, pictures[:1]), values(params, pictures)
    np.testing.assert_allclose(values(params, 3 * pictures[:1]), one, rtol=1e-3, atol=1e-4)
    assert one.shape == (1, 5) and not np.allclose(three[:1], one, atol=1e-3)


def test_a_plain_network_on_patches_sees_them_as_cells():
    pictures = jax.random.uniform(jax.random.key(0), (2, 14, 14, 3))
    pixels, patches = (PlainQ(5, (2, 2, 2), 4, patch=size) for size in (1, 2))
    params = patches.init(jax.random.key(1), pictures)
    cells = pixels.apply(params, to_patches(pictures, 2))
    np.testing.assert_array_equal(patches.apply(params, pictures), cells)


def test_values_are_of_shades():
    bytes_, shades = jnp.array([[255, 51]], jnp.uint8), jnp.array([[1.0, 0.2]])
    np.testing.assert_allclose(q_values(LINEAR, jnp.eye(2), bytes_), shades)


def test_real_and_fake_are_kept_apart():
    agent = make()
    state = agent.init(jax.random.key(0), HPARAMS)
    state, _ = agent.update(state, play(0), jax.random.key(1), HPARAMS)
    assert (int(state.real.size), int(state.fake.size), int(state.exploration.episodes)) == (
        12,
        0,
        2,
    )
    assert int(state.steps) == 3
    state, metrics = agent.update_fake(state, play(1, 3), jax.random.key(2), HPARAMS)
    assert (int(state.real.size), int(state.fake.size), int(state.exploration.episodes)) == (
        12,
        18,
        2,
    )
    assert int(state.steps) == 5 and np.isfinite(metrics["loss"])


@partial(jax.jit, static_argnums=1)
def mean_reward(share, dreamed):
    """Of a batch, where real steps earn 1 and fake ones 2."""
    real, fake = (known(SIMPLE, reward, False) for reward in (1.0, 2.0))
    held = fake.fake if dreamed else jax.tree.map(jnp.zeros_like, fake.fake)
    hparams = DQNHParams(fake_share=share)
    mixed = _mixed(real.replace(fake=held), jax.random.key(0), hparams, SIMPLE)[0]
    return mixed.reward.mean()


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0, None])
def test_a_batch_is_mixed_as_it_is_told(share):
    """Without any dream all of it is real; None is as in one replay, which here holds as many fake
    steps as real ones.
    """
    assert mean_reward(share, False) == 1
    assert mean_reward(share, True) == pytest.approx(
        1 + (0.5 if share is None else share), abs=0.05
    )


def test_what_weighs_nothing_changes_nothing():
    agent = make()
    state = agent.init(jax.random.key(0), HPARAMS)
    state, _ = agent.update(state, play(0), jax.random.key(1), HPARAMS)
    nothing = play(1)._replace(mask=np.zeros((2, 6), bool))
    for learn in (agent.update, agent.update_fake):
        assert_same(learn(state, nothing, jax.random.key(2), HPARAMS)[0], state)
    fresh = agent.init(jax.random.key(0), HPARAMS)
    halves = [
        agent.update(
            fresh,
            play(0)._replace(weight=np.full((2, 6), w, np.float32)),
            jax.random.key(1),
            HPARAMS,
        )
        for w in (1.0, 0.5)
    ]
    assert float(halves[1][1]["loss"]) < float(halves[0][1]["loss"])
    light = play(1)._replace(weight=np.zeros((2, 6), np.float32))
    kept = agent.update(state, light, jax.random.key(3), HPARAMS)[0]
    assert kept.real.size > state.real.size  # remembered, for who else asks
    assert_same((kept.params, kept.opt_state), (state.params, state.opt_state))
    assert_same(agent.update_fake(state, light, jax.random.key(4), HPARAMS)[0], state)


def learn(key, episodes):
    config = replace(SMALL, optimizer=optax.sgd)  # Adam would magnify rounding
    agent = dqn((SIZE, SIZE, 3), 5, config)
    key_init, key_update = jax.random.split(key)
    state = agent.init(key_init, HPARAMS)
    return agent.update(state, episodes, key_update, HPARAMS)[0].params


def test_vmap_is_a_loop():
    keys, compiled = jax.random.split(jax.random.key(3), 2), jax.jit(learn)
    together = jax.jit(jax.vmap(learn, (0, None)))(jax.random.clone(keys), play(0))
    for number, key in enumerate(jax.random.clone(keys)):
        assert_close(
            jax.tree.map(lambda leaf, n=number: leaf[n], together), compiled(key, play(0)), 1e-4
        )


@pytest.mark.slow
def test_jit_is_eager():
    compiled = jax.jit(learn)(jax.random.key(3), play(0))
    assert_close(learn(jax.random.key(3), play(0)), compiled, 1e-4)


@partial(jax.jit, static_argnums=0)
def actions_of(act, state, obs, keys, hparams):
    return jax.vmap(lambda key: act(state, obs, key, hparams))(keys)


def test_exploration():
    hparams = DQNHParams(epsilon_first=1, epsilon_last=0.2, epsilon_hold=2, epsilon_episodes=4)
    before = exploration.init(5)
    shares = [
        float(exploration.epsilon(before.replace(episodes=jnp.int32(n)), hparams))
        for n in (0, 2, 4, 6, 9)
    ]
    np.testing.assert_allclose(shares, [1, 1, 0.6, 0.2, 0.2], rtol=1e-6)
    agent = make(drift=3.0, updates=0)
    state = agent.init(jax.random.key(0), hparams)
    obs = play(0).obs[0, 0]

    def actions(state, hparams, act=agent.act):
        keys = jax.random.split(jax.random.key(5), 400)
        return actions_of(act, state, obs, keys, hparams)

    even = jnp.bincount(actions(state, hparams), length=5)
    assert even.min() > 50
    state, _ = agent.update(state, play(0), jax.random.key(1), hparams)
    drifting = at_episode(state, 0)
    uneven = jnp.bincount(actions(drifting, hparams), length=5)
    assert uneven.max() > 200
    greedy = hparams.replace(epsilon_last=0.0)
    assert len(set(np.asarray(actions(at_episode(state, 9), greedy)))) == 1
    awake = actions(state, hparams.replace(epsilon_fake=1.0), agent.act_fake)
    assert len(set(np.asarray(awake))) > 1


def at_episode(state, number):
    return state.replace(exploration=state.exploration.replace(episodes=jnp.int32(number)))


def test_exploration_lasts_until_something_was_earned():
    hparams = DQNHParams(epsilon_hold=2.0, epsilon_episodes=4.0)
    nothing = play(0)._replace(reward=-jnp.ones_like(play(0).reward))
    unseen = play(0)._replace(reward=jnp.ones_like(play(0).reward), mask=play(0).mask & False)
    once = nothing._replace(reward=nothing.reward.at[0, 1].set(1.0))
    shares = {}
    for until_rewarded in (False, True):
        state = exploration.init(5)
        for number, real in enumerate([nothing] * 4 + [unseen, once] + [nothing] * 2):
            state = exploration.count(state, real, hparams, until_rewarded)
            shares[until_rewarded, number] = float(exploration.epsilon(state, hparams))
    assert [shares[True, n] for n in range(8)] == [1.0] * 5 + [0.5, 0.0, 0.0]
    assert [shares[False, n] for n in range(4)] == [1.0, 0.5, 0.0, 0.0]


def test_target_network():
    hparams, episodes = DQNHParams(target_rate=1.0), play(0)
    agent = make(target_period=2, updates=3)
    before = agent.init(jax.random.key(0), hparams)
    after, _ = agent.update(before, episodes, jax.random.key(1), hparams)
    two = make(target_period=2, updates=2).update(before, episodes, jax.random.key(1), hparams)[0]
    assert_same(two.target, two.params)
    assert_close(after.target, two.params)
    slow, _ = make(updates=1).update(before, episodes, jax.random.key(1), DQNHParams())
    for target, new, old in zip(
        *map(jax.tree.leaves, (slow.target, slow.params, before.params)), strict=True
    ):
        np.testing.assert_allclose(target, 0.005 * new + 0.995 * old, atol=1e-6)


class Drawn(Linear):
    """That begins at random."""

    def init(self, key, x):
        return jax.random.normal(key, (2, 2))


BRIEF = DQNConfig(
    network=Drawn(), updates=3, batch=8, capacity=40, episodes=9, fake_capacity=8,
    fake_episodes=4, optimizer=optax.sgd,
)  # fmt: skip


@cache
def brief(together=False, **changes):
    """A learner's init and update, of several runs' episodes where it is ``together``."""
    agent = dqn((2,), 2, replace(BRIEF, **changes))
    update = jax.vmap(agent.update, (0, 0, None, None)) if together else agent.update
    return agent.init, jax.jit(update)


def walk(seed, steps=6):
    """Two episodes of a random walk, the second of so many steps."""
    draw = np.random.default_rng(seed)
    obs = draw.normal(size=(2, 7, 2)).cumsum(1).astype(np.float32)
    mask = np.arange(6) < np.array([[6], [steps]])
    ends, reward = np.zeros((2, 6), bool), draw.normal(size=(2, 6)).astype(np.float32)
    action = draw.integers(2, size=(2, 6)).astype(np.int32)
    return Transition(obs[:, :-1], action, reward, obs[:, 1:], ends, ends, mask)


def both(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def test_networks_begin_anew():
    """Once they have made 6 gradient steps, before the next; what is replayed, with its priorities,
    and how much is explored stay. Runs that are vmapped do so each in its time.
    """
    (init, plain), (_, resets) = brief(), brief(reset_every=6)
    first = plain(init(jax.random.key(0), HPARAMS), walk(0), jax.random.key(1), HPARAMS)[0]
    before, due = (first.replace(steps=jnp.int32(steps)) for steps in (5, 6))

    def after(update, state):
        return update(state, walk(1), jax.random.key(2), HPARAMS)[0]

    going_on = after(resets, before)
    assert_close(going_on, after(plain, before), 1e-6)
    new = init(jax.random.split(jax.random.key(2), 3)[2], HPARAMS)
    begun = due.replace(**{name: getattr(new, name) for name in BEGUN})
    anew = after(resets, due)
    assert_close(anew, after(plain, begun), 1e-6)
    assert (going_on.steps, anew.steps, anew.real.size) == (8, 3, 24)
    assert np.abs(anew.params - new.params).max() < np.abs(first.params - new.params).max()
    vmapped = brief(True, reset_every=6)[1]
    together, _ = vmapped(both(before, due), both(walk(1), walk(1)), jax.random.key(2), HPARAMS)
    assert_close(together, both(going_on, anew), 1e-4)


def test_updates_for_each_step():
    """12 steps make a quarter as many gradient steps, beside the one after each update; 9 make 2.25
    of them, rounded.
    """
    ratio = {"updates": 1, "updates_per_step": 0.25}
    (init, by_ratio), (_, four) = brief(**ratio), brief(updates=4)
    start = init(jax.random.key(0), HPARAMS)
    after = by_ratio(start, walk(0), jax.random.key(1), HPARAMS)
    assert after[0].steps == 4
    assert_close(after, four(start, walk(0), jax.random.key(1), HPARAMS), 1e-6)
    shorter = by_ratio(start, walk(0, 3), jax.random.key(1), HPARAMS)
    assert shorter[0].steps == 3
    episodes = both(walk(0), walk(0, 3))
    together = brief(True, **ratio)[1](both(start, start), episodes, jax.random.key(1), HPARAMS)
    assert_close(together, both(after, shorter), 1e-4)


@pytest.mark.parametrize(
    "bad",
    [
        {"batch": 2.5},
        {"batch": 999_999_999},
        {"n_step": 0},
        {"n_step": 9, "capacity": 8},
        {"updates": -1},
        {"drift": -1.0},
    ],
)
def test_clear_errors(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        DQNConfig(**bad)


@pytest.mark.slow  # what it learns from is checked by hand
def test_it_finds_the_goal():
    """Without obstacles on a small board the greedy way to the goal is the shortest."""
    agent = make(
        network=GlimpseQ(5, size=3, hidden=(64,)), updates=25, batch=32, capacity=2000, episodes=200
    )
    hparams = DQNHParams(
        epsilon_hold=40.0, epsilon_episodes=20.0, target_rate=0.02, reward_scale=1.0
    )
    returns = returns_of(FrameStack(Maze(size=SIZE, num_obstacles=0)), agent, hparams, 12, 80)
    assert returns[-10:].mean() >= 0.95 * (12 - 2 * (SIZE - 1) + 1)


@pytest.mark.slow  # of its parts `test_contract` says that they are right
def test_it_learns_from_vectors():
    """Catch as bsuite's board, and not as frames."""
    config = DQNConfig(PerceptronQ(3, (32,)), updates=40, n_step=3, capacity=900, drift=0.0)
    agent = dqn((12,), 3, config)
    hparams = DQNHParams(5e-3, epsilon_hold=20.0, epsilon_episodes=20.0, target_rate=0.05)
    returns = returns_of(Catch(rows=4, columns=3), agent, hparams, 3, 80)
    assert returns[:20].mean() < 0.7 and returns[-20:].mean() > 0.9


@pytest.mark.parametrize("shape", [(4, 4), (), (2, 2, 2, 2)])
def test_what_is_neither_frame_nor_vector_is_refused(shape):
    with pytest.raises(ValueError, match=r"frame_shape is .* of 3, of 1"):
        dqn(shape, 2)


def test_runs_vmapped_together_skip_what_none_of_them_needs():
    """What was a ``cond`` for one run has to stay one for many, not become a choice afterwards."""
    agent = dqn((SIZE, SIZE, 3), 5, SMALL)
    state = jax.eval_shape(agent.init, jax.random.key(0), HPARAMS)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), play(0), play(1))
    for learn in (agent.update, agent.update_fake):
        program = jax.make_jaxpr(jax.vmap(learn, (None, 0, 0, None)))(
            state, both, jax.random.split(jax.random.key(0), 2), HPARAMS
        )
        assert "cond" in {equation.primitive.name for equation in program.eqns}
