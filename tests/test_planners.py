"""Planners against exact dynamic programming, in worlds small enough for it."""

import sys
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import ENV, LEARNED, MODEL, assert_close

from jaxdyna import rollout
from jaxdyna.envs import Maze, MazeParams
from jaxdyna.models import LearnedParams, LearnedState, SupervisedHParams
from jaxdyna.planners import (
    CrossEntropyConfig,
    Guide,
    SearchConfig,
    ShootingConfig,
    cross_entropy,
    gumbel_muzero,
    mpc,
    muzero,
    random_shooting,
    rollout_value,
    score,
    solve_maze,
)

DISCOUNT = 0.9
CELLS = 5


class Place(NamedTuple):
    cell: jax.Array
    time: jax.Array


class CorridorParams(NamedTuple):
    near: float = 0.3
    max_steps: int = 12


@dataclass(frozen=True)
class Corridor:
    """Cells in a row: left (0) or right (1). The left end pays a little and ends the episode, the
    right end pays 1 and ends it as well; staying off both costs 0.02 a step.
    """

    num_actions: int = 2
    default_params: CorridorParams = CorridorParams()

    def reset(self, key, params):
        state = Place(jnp.int32(2), jnp.int32(0))
        return self.see(state), state

    def see(self, state):
        return jax.nn.one_hot(state.cell, CELLS)

    def step(self, key, state, action, params):
        state = Place(state.cell + 2 * action - 1, state.time + 1)
        left, right = state.cell == 0, state.cell == CELLS - 1
        reward = jnp.where(right, 1.0, jnp.where(left, params.near, -0.02))
        truncated = state.time >= params.max_steps
        return self.see(state), state, reward, left | right, truncated, {}


def corridor_values(near):
    """``[cell, action]`` by value iteration, the episode's length apart."""
    values = np.zeros((CELLS, 2))
    for _ in range(100):
        best = values.max(1)
        for cell in range(1, CELLS - 1):
            for action, to in enumerate((cell - 1, cell + 1)):
                end = {0: near, CELLS - 1: 1.0}.get(to)
                values[cell, action] = -0.02 + DISCOUNT * best[to] if end is None else end
    return values


@dataclass(frozen=True)
class Bandit:
    """One pull of one of four arms, 1 with its own probability; or, without noise, that itself."""

    noisy: bool = True
    chances: tuple = (0.1, 0.3, 0.9, 0.5)
    default_params: CorridorParams = CorridorParams(max_steps=1)

    @property
    def num_actions(self):
        return len(self.chances)

    def reset(self, key, params):
        return jnp.zeros(1), jnp.int32(0)

    def step(self, key, state, action, params):
        chance = jnp.array(self.chances)[action]
        drawn = jax.random.bernoulli(key, chance).astype(jnp.float32)
        reward = drawn if self.noisy else chance
        return jnp.zeros(1), state + 1, reward, jnp.bool_(True), jnp.bool_(False), {}


WORLD = Corridor()
SEARCHES = ("muzero", "gumbel_muzero")
PLANNERS = {
    "shooting": random_shooting(WORLD, ShootingConfig(5, 128, DISCOUNT)),
    "drifting": random_shooting(WORLD, ShootingConfig(5, 64, DISCOUNT, drift=2.0)),
    "soft": random_shooting(WORLD, ShootingConfig(5, 128, DISCOUNT, temperature=0.02)),
    "cross_entropy": cross_entropy(WORLD, CrossEntropyConfig(5, 64, DISCOUNT)),
    "gumbel_muzero": gumbel_muzero(WORLD, SearchConfig(128, discount=DISCOUNT)),
    "muzero": muzero(WORLD, SearchConfig(128, discount=DISCOUNT)),
}
FEW = {
    "shooting": random_shooting(WORLD, ShootingConfig(1, 10, DISCOUNT)),
    "cross_entropy": cross_entropy(WORLD, CrossEntropyConfig(1, 10, DISCOUNT, elites=2)),
    "gumbel_muzero": gumbel_muzero(WORLD, SearchConfig(4, discount=DISCOUNT)),
    "muzero": muzero(WORLD, SearchConfig(4, discount=DISCOUNT)),
}


def searches_slow(names):
    """Both take many seconds to compile; in the corridor both are tested always."""
    return [pytest.param(name, marks=pytest.mark.slow) if "muzero" in name else name
            for name in names]  # fmt: skip


@cache
def decide(name):
    """From what the left end pays to decisions of 8 keys from each cell that is no end, ``[cells,
    8]``. Tree search takes what follows for a random episode: for nothing it clings to what pays at
    once.
    """
    return jax.jit(partial(_decisions, PLANNERS[name], lambda params: Guide()))


def _decisions(planner, guide, near):
    params = CorridorParams(near, max_steps=100)
    told = guide(params)

    def from_cell(cell, keys):
        state = Place(cell, jnp.int32(0))
        return jax.vmap(lambda key: planner(params, WORLD.see(state), state, key, told))(keys)

    keys = jax.random.split(jax.random.key(0), (CELLS - 2, 8))
    return jax.vmap(from_cell)(jnp.arange(1, CELLS - 1), keys)


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("near", [0.3, pytest.param(0.8, marks=pytest.mark.slow)])
def test_the_corridor_is_solved_as_by_dynamic_programming(name, near):
    exact = corridor_values(near)[1:-1]
    found = decide(name)(near)
    right = (np.asarray(found.action) == exact.argmax(1)[:, None]).mean()
    assert right >= (0.75 if name in SEARCHES else 1.0)  # a search clings to what paid first
    if name not in (*SEARCHES, "soft"):  # those expect a mean of what they tried
        np.testing.assert_allclose(found.value, np.repeat(exact.max(1)[:, None], 8, 1), atol=1e-5)
    else:
        value = np.asarray(found.value)
        assert (value <= exact.max(1)[:, None] + 1e-5).all()
        assert (value > exact.min(1)[:, None] - 0.1).mean() >= 0.9


@pytest.mark.parametrize("name", PLANNERS)
def test_where_nothing_pays_on_the_way_all_find_the_far_end(name):
    np.testing.assert_array_equal(decide(name)(-0.5).action, 1)


@pytest.mark.parametrize("name", searches_slow(FEW))
def test_a_value_makes_up_for_a_short_horizon(name):
    """A single step, or four nodes: not enough for the far end, unless told."""
    exact = corridor_values(0.3)
    best = jnp.asarray(exact.max(1), jnp.float32)

    def value(obs, state, key):
        return best[state.cell]

    def right(guide):
        actions = np.asarray(jax.jit(partial(_decisions, FEW[name], lambda _: guide))(0.3).action)
        return (actions == exact[1:-1].argmax(1)[:, None]).mean()

    assert right(Guide()) < 0.9 < right(Guide(value=value))


def test_what_follows_a_tree_is_a_random_episode_unless_told():
    def decided(guide):
        return jax.jit(partial(_decisions, FEW["gumbel_muzero"], guide))(0.3)

    def random(params):
        return Guide(value=rollout_value(WORLD, params, discount=DISCOUNT))

    by_default = decided(lambda params: Guide())
    chex.assert_trees_all_equal(by_default, decided(random))
    nothing = decided(lambda params: Guide(value=lambda *seen: 0.0))
    assert (by_default.value != nothing.value).any()


def test_a_prior_decides_where_nothing_else_does():
    prior = Guide(prior=lambda obs: jnp.array([0.0, 5.0]))
    for name in SEARCHES:
        state = Place(jnp.int32(2), jnp.int32(0))
        few = {"muzero": muzero, "gumbel_muzero": gumbel_muzero}[name]
        planner = few(WORLD, SearchConfig(1, discount=DISCOUNT))
        plan = jax.jit(partial(planner, guide=prior))
        found = plan(CorridorParams(), WORLD.see(state), state, jax.random.key(0))
        assert found.action == 1


def test_the_best_arm_of_a_bandit():
    """mctx keeps one outcome of each edge and believes a lucky pull for ever: it gets no noise."""
    env, sure = Bandit(), Bandit(noisy=False)
    obs, state = env.reset(jax.random.key(0), env.default_params)
    planners = {
        "shooting": random_shooting(env, ShootingConfig(1, 16, particles=64)),
        "soft": random_shooting(env, ShootingConfig(1, 400, temperature=float("inf"))),
        "cross_entropy": cross_entropy(env, CrossEntropyConfig(1, 16, particles=64, elites=4)),
        "muzero": muzero(sure, SearchConfig(32)),
        "gumbel_muzero": gumbel_muzero(sure, SearchConfig(32)),
    }
    for name, planner in planners.items():
        keys = jax.random.split(jax.random.key(1), 10)
        found = jax.jit(jax.vmap(lambda key, plan=planner: plan(None, obs, state, key)))(keys)
        np.testing.assert_array_equal(found.action, 2, err_msg=name)
        np.testing.assert_allclose(found.value, 0.9, atol=0.15)


def test_score_by_hand():
    """Rewards stop at the end, a value counts where the world has not ended there."""

    def worth(cell, actions, max_steps=100, value=None):
        state = Place(jnp.int32(cell), jnp.int32(0))
        params = CorridorParams(max_steps=max_steps)
        actions = jnp.array(actions)
        return score(WORLD, params, WORLD.see(state), state, actions, jax.random.key(0), 0.5, value)

    def two(obs, state, key):
        return 2.0 + 0 * obs.sum()

    np.testing.assert_allclose(worth(1, [0, 1, 1]), 0.3)
    np.testing.assert_allclose(worth(1, [0, 1, 1], value=two), 0.3)
    np.testing.assert_allclose(worth(1, [1, 1]), -0.02 - 0.01, rtol=1e-6)
    np.testing.assert_allclose(worth(1, [1, 1], value=two), -0.03 + 0.25 * 2, rtol=1e-6)
    np.testing.assert_allclose(worth(1, [1, 1], max_steps=1, value=two), -0.02 + 0.5 * 2, rtol=1e-6)


def test_a_random_episode_says_what_a_state_is_worth():
    state = Place(jnp.int32(1), jnp.int32(0))
    value = jax.jit(rollout_value(WORLD, CorridorParams(max_steps=100), 40))
    keys = jax.random.split(jax.random.key(0), 500)
    mean = jax.vmap(lambda key: value(WORLD.see(state), state, key))(keys).mean()
    # A fair walk from cell 1 of 0..4 reaches the right end 1 time in 4, after 3 steps on average.
    assert mean == pytest.approx(3 / 4 * 0.3 + 1 / 4 - 0.02 * 2, abs=0.05)


def test_what_a_world_does_after_its_end_counts_for_nothing():
    @dataclass(frozen=True)
    class Diverging(Corridor):
        """Leaves all numbers behind once an episode is over, as a learned model may."""

        def step(self, key, state, action, params):
            found = super().step(key, state, action, params)
            over = (state.cell == 0) | (state.cell == CELLS - 1)
            return (*found[:2], jnp.where(over, jnp.nan, found[2]), *found[3:])

    state, params = Place(jnp.int32(1), jnp.int32(0)), CorridorParams()
    values = [
        rollout_value(env, params, 60)(WORLD.see(state), state, jax.random.key(0))
        for env in (WORLD, Diverging())
    ]
    assert values[0] == values[1]


@dataclass(frozen=True)
class Levers:
    """Each action pays its own, until the world ends after ``near`` steps."""

    pays: tuple = (0.0, 1.0)

    @property
    def num_actions(self):
        return len(self.pays)

    def step(self, key, state, action, params):
        reward, state = jnp.array(self.pays)[action], state + 1
        over = state >= params.near
        return jnp.zeros(1), state, reward, over, ~over & (state >= params.max_steps), {}


def test_a_random_episode_is_discounted():
    value = rollout_value(Levers((1.0, 1.0)), CorridorParams(near=9), 4, 0.5)
    assert value(None, jnp.int32(0), jax.random.key(0)) == 1 + 1 / 2 + 1 / 4 + 1 / 8


@partial(jax.jit, static_argnums=0)
def pulled(config, keys):
    """The values of decisions of the cross-entropy method."""
    plan = cross_entropy(Levers(), config)
    params = CorridorParams(near=99)
    return jax.vmap(lambda key: plan(params, jnp.zeros(1), jnp.int32(0), key).value)(keys)


def best_of_rounds(rounds, candidates=2, elites=1, horizon=4, floor=0.1):
    config = CrossEntropyConfig(horizon, candidates, iterations=rounds, elites=elites, floor=floor)
    return pulled(config, jax.random.split(jax.random.key(0), 40))


def test_later_rounds_never_lose_the_best_so_far():
    """The first round is the same; what it has found is never given up for less."""
    assert (best_of_rounds(3, floor=0.9) >= best_of_rounds(1, floor=0.9)).all()


def test_rounds_are_drawn_like_the_best_of_the_one_before():
    """Twelve levers: all are pulled after a few rounds, by chance about ten."""
    assert best_of_rounds(6, 16, 4, 12).mean() > 11.5


def test_worth_by_hand():
    """By the best, by the mean, and in between, of the sequences that begin with an action."""
    action, returns = jnp.array([0, 0, 1]), jnp.array([1.0, 3.0, 2.5])
    worth = {t: mpc._worth(jnp.arange(2), action, returns, t) for t in (0.0, 1.0, float("inf"))}
    np.testing.assert_allclose(worth[0.0], [3, 2.5])
    np.testing.assert_allclose(worth[1.0], [np.log((np.e + np.e**3) / 2), 2.5], rtol=1e-6)
    np.testing.assert_allclose(worth[float("inf")], [2, 2.5])


@jax.jit
def searched(ends, max_steps, value):
    """What a search of two nodes expects of the only lever, which pays 1 at a time."""
    guide = Guide(value=lambda obs, state, key: value)
    plan = muzero(Levers((1.0,)), SearchConfig(2, discount=0.5))
    params = CorridorParams(ends, max_steps)
    return plan(params, jnp.zeros(1), jnp.int32(0), jax.random.key(0), guide).value


def test_a_search_by_hand():
    """A node is worth the mean of what it was thought to be and what was found behind it."""
    goes_on = searched(99, 99, 5.0)
    np.testing.assert_allclose(goes_on, 1 + 0.5 * (5 + (1 + 0.5 * 5)) / 2)
    np.testing.assert_allclose(searched(1, 99, 5.0), 1)
    np.testing.assert_allclose(searched(99, 1, 5.0), 1 + 0.5 * 5)
    np.testing.assert_allclose(searched(2, 99, 5.0), 1 + 0.5 * (5 + 1) / 2)


def from_the_middle(name):
    """A decision, of a key."""
    obs, state = WORLD.reset(jax.random.key(0), CorridorParams())
    return lambda key: FEW[name](CorridorParams(), obs, state, key)


@pytest.mark.slow  # as check_planner in test_contract
@pytest.mark.parametrize("name", FEW)
def test_vmap_is_a_loop(name):
    plan = from_the_middle(name)
    batched = jax.jit(jax.vmap(plan))(jax.random.split(jax.random.key(1), 3))
    jitted = jax.jit(plan)
    for row, key in enumerate(jax.random.split(jax.random.key(1), 3)):
        one = jitted(key)
        assert_close(jax.tree.map(lambda leaf, row=row: leaf[row], batched), one)
    assert one.action.dtype == jnp.int32 and one.action.shape == one.value.shape == ()


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_jit_is_eager(name):
    plan = from_the_middle(name)
    compiled = jax.jit(plan)(jax.random.key(1))
    with jax.debug_key_reuse(False), jax.disable_jit():
        assert_close(plan(jax.random.key(1)), compiled)


MAZE, SMALL = Maze(size=2, num_obstacles=1), MazeParams(max_steps=6)


@cache
def best_returns(episodes):
    @jax.jit
    def best(key):
        _, states = rollout(
            MAZE,
            lambda obs, key: jnp.int32(0),
            key,
            SMALL,
            episodes,
            record=lambda state, *_: state,
        )
        starts = jax.tree.map(lambda leaf: leaf[:, 0], states)
        return jax.vmap(lambda start: solve_maze(MAZE, start, SMALL, 6).best_return)(starts)

    return best(jax.random.key(0))


def share_of_optimum(planner, episodes=12):
    """Of what could be had in as many episodes."""

    @jax.jit
    def play(key):
        def act(obs, key, state):
            return planner(SMALL, obs, state, key).action

        return rollout(MAZE, act, key, SMALL, episodes, sees_state=True).reward.sum()

    return float(play(jax.random.key(0)) / best_returns(episodes).sum())


BUDGETS = {
    "shooting": lambda n: random_shooting(MAZE, ShootingConfig(4, n)),
    "drifting and soft": lambda n: random_shooting(
        MAZE, ShootingConfig(4, n, drift=1.0, temperature=0.05)
    ),
    "cross_entropy": lambda n: cross_entropy(MAZE, CrossEntropyConfig(4, n // 2, elites=n // 8)),
    "muzero": lambda n: muzero(MAZE, SearchConfig(n, discount=0.95)),
    "gumbel_muzero": lambda n: gumbel_muzero(MAZE, SearchConfig(n, discount=0.95)),
}


@pytest.mark.parametrize("name", searches_slow(BUDGETS))
def test_planners_approach_the_optimum_as_their_budget_grows(name):
    few, many = (share_of_optimum(BUDGETS[name](budget)) for budget in (8, 256))
    assert few < many and many > 0.9


def test_planning_in_a_learned_model_is_the_same_call():
    weights = MODEL.init(jax.random.key(0), SupervisedHParams()).params
    params = LearnedParams(weights, max_steps=9)
    obs, _ = ENV.reset(jax.random.key(1), ENV.default_params)
    planner = random_shooting(LEARNED, ShootingConfig(4, 8))
    found = planner(params, obs, LearnedState(obs, jnp.int32(0)), jax.random.key(2))
    assert 0 <= found.action < 2 and np.isfinite(found.value)


@pytest.mark.parametrize(
    ("make", "changes", "complaint"),
    [
        (ShootingConfig, {"horizon": 0}, "horizon is 0"),
        (ShootingConfig, {"discount": 2.0}, "between 0 and 1"),
        (ShootingConfig, {"temperature": -1.0}, "temperature is -1.0: it must be at least 0"),
        (CrossEntropyConfig, {"elites": 100}, "elites is 100"),
        (CrossEntropyConfig, {"iterations": 0}, "iterations is 0"),
        (CrossEntropyConfig, {"floor": 0.0}, "floor is 0"),
        (SearchConfig, {"simulations": 0}, "simulations is 0"),
        (SearchConfig, {"dirichlet_fraction": 2.0}, "between 0 and 1"),
        (SearchConfig, {"gumbel_scale": -1.0}, "gumbel_scale is -1.0"),
    ],
)
def test_clear_errors(make, changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        replace(make(), **changes)


def test_without_mctx_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mctx", None)
    for make in (muzero, gumbel_muzero):
        with pytest.raises(ImportError, match=r"pip install 'jaxdyna\[planning\]'"):
            make(WORLD, SearchConfig())


@pytest.mark.parametrize("temperature", [0.0, 5.0, float("inf")])
def test_an_action_that_no_sequence_begins_with_is_not_chosen(temperature):
    worth = mpc._worth(jnp.arange(2), jnp.zeros(8, int), jnp.full(8, 30.0), temperature)
    np.testing.assert_allclose(worth, [30.0, -np.inf], rtol=1e-6)


@pytest.mark.parametrize("nothing", [jnp.nan, jnp.inf, -jnp.inf])
def test_what_is_no_number_is_worst(nothing):
    """Every sequence that begins with left ends in no number: right is chosen."""

    class Broken(Corridor):
        def step(self, key, state, action, params):
            found = super().step(key, state, action, params)
            return (*found[:2], jnp.where(action == 0, nothing, found[2]), *found[3:])

    obs, state = WORLD.reset(jax.random.key(0), CorridorParams())
    plan = random_shooting(Broken(), ShootingConfig(candidates=64, horizon=1))
    keys = jax.random.split(jax.random.key(1), 20)
    decide = jax.jit(jax.vmap(lambda key: plan(CorridorParams(), obs, state, key).action))
    assert (decide(keys) == 1).all()
    tree = muzero(Broken(), SearchConfig(simulations=8))
    decide = jax.jit(jax.vmap(lambda key: tree(CorridorParams(), obs, state, key)))
    decided = decide(jax.random.split(jax.random.key(2), 8))
    assert (decided.action == 1).all() and jnp.isfinite(decided.value).all()


def test_a_value_is_not_asked_for_where_the_world_has_ended():
    """In the tree as in the sequences: what it says there need be no number."""
    state, params = Place(jnp.int32(CELLS - 2), jnp.int32(0)), CorridorParams(near=0.0)

    def value(obs, state, key):
        return jnp.where((state.cell == 0) | (state.cell == CELLS - 1), jnp.nan, 0.0)

    decide = jax.jit(
        lambda key: FEW["muzero"](params, WORLD.see(state), state, key, Guide(value=value))
    )
    decision = decide(jax.random.key(0))
    assert decision.action == 1 and jnp.isfinite(decision.value)
