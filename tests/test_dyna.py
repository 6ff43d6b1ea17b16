"""The two-phase loop."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import AGENT, DYNA, ENV, MODEL_FREE, ORACLE, SMALL, assert_close, assert_same, hparams

from jaxdyna import sweep
from jaxdyna.agents import ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.dyna import DynaConfig, Expert, make_init, make_step, make_train, survived
from jaxdyna.replay import memory
from jaxdyna.types import Transition

WITHOUT_DREAMS = DYNA._replace(dream=None, diagnose=None)


@cache
def program(dyna, config):
    return jax.jit(make_train(dyna, config))


def train(dyna, config=SMALL, seed=0, **changes):
    return program(dyna, config)(jax.random.key(seed), hparams(**changes))


@pytest.fixture(scope="module")
def init():
    return jax.jit(make_init(DYNA, SMALL))


@pytest.fixture(scope="module")
def dyna_run():
    return train(DYNA)


def test_metrics_and_phases(dyna_run):
    state, metrics = dyna_run
    assert all(values.shape[0] == SMALL.num_episodes for values in metrics.values())
    # The first dream follows the second real episode: N = 2.
    np.testing.assert_array_equal(np.isnan(metrics["fake_return"]), [True] + [False] * 5)
    np.testing.assert_array_equal(metrics["real_return"], metrics["real_length"])
    assert state.replay.added == metrics["real_length"].sum()
    assert state.starts.added == SMALL.num_episodes
    np.testing.assert_array_equal(metrics["count"], metrics["real_length"])


def test_fake_weight_zero_is_the_model_free_arm_bit_for_bit(dyna_run):
    free, free_metrics = train(MODEL_FREE)
    state, metrics = train(DYNA, fake_weight=0.0)
    assert_same(state.agent, free.agent)
    np.testing.assert_array_equal(metrics["real_return"], free_metrics["real_return"])
    assert not np.array_equal(jax.tree.leaves(dyna_run[0].agent)[0], jax.tree.leaves(free.agent)[0])


def test_masked_real_first_is_a_later_start_of_dreams():
    later, late_metrics = train(DYNA, num_real_first=4)
    config = DynaConfig(**{**vars(SMALL), "num_real_first": 4})
    skipped, metrics = train(DYNA, config)
    assert_same(later.agent, skipped.agent)
    assert_same(later.model, skipped.model)
    np.testing.assert_array_equal(late_metrics["real_return"], metrics["real_return"])


def test_a_run_in_pieces_is_the_same_run(dyna_run, init):
    step = make_step(DYNA, SMALL)

    @jax.jit
    def piece(state, episodes, hparams):
        return jax.lax.scan(lambda state, one: step(state, one, hparams), state, episodes)

    state = init(jax.random.key(0), hparams())
    state, first = piece(state, jnp.arange(0, 3), hparams())
    state, second = piece(state, jnp.arange(3, 6), hparams())
    assert_same(state, dyna_run[0])
    assert_same(jax.tree.map(lambda *parts: jnp.concatenate(parts), first, second), dyna_run[1])


def test_a_placebo_computes_its_updates_and_discards_them(init):
    state, metrics = train(DYNA, model_trains=False)
    untrained = init(jax.random.key(0), hparams())
    assert_same(state.model, untrained.model)
    assert (metrics["model_loss"] > 0).all() and np.isfinite(metrics["fake_return"][1:]).all()


@pytest.mark.slow
def test_rest_when_safe():
    """After an episode that lasts to its horizon nothing is learned: in blocks, which skip the
    work, as alone, where it is discarded.
    """
    config = replace(SMALL, num_episodes=12, num_steps=12, dream_updates=8)
    resting = DYNA._replace(safe=survived)
    params = hparams(env=ENV.default_params.replace(max_steps=12), real_weight=0.0)
    keys = jax.random.split(jax.random.key(0), 5)
    state, metrics = sweep(make_train(resting, config), keys, params, block=2)
    full = metrics["real_length"] == 12
    rested = np.isnan(metrics["model_loss"])
    assert rested.any() and full[rested].all()  # a fall in the very last step is no rest
    np.testing.assert_array_equal(np.isnan(metrics["fake_return"])[..., 1:], rested[..., 1:])
    assert not np.isnan(metrics["model_loss"][~full]).any()
    for number, key in enumerate(jax.random.split(jax.random.key(0), 5)):
        alone, _ = program(resting, config)(key, params)
        assert_close(
            jax.tree.map(lambda leaf, at=number: leaf[0, at], state.agent), alone.agent, 1e-4
        )


@pytest.mark.parametrize(
    ("safe", "updates", "rests"),
    [("both", 2, True), ("both", 1, False), ("real", 2, False), ("fake", 2, False)],
)
def test_rests_where_real_episode_and_last_dreams_were_safe(safe, updates, rests):
    """Two safe updates in a row are needed: with a single one a run never rests."""

    def judged(episodes):  # a real episode comes alone
        return jnp.bool_(safe in ("both", "real" if len(episodes.mask) == 1 else "fake"))

    config = replace(SMALL, dream_updates=updates)
    state, metrics = train(DYNA._replace(safe=judged), config)
    idle = np.isnan(metrics["model_loss"])
    assert state.dreams_safe == (safe != "real" and updates == 2)
    np.testing.assert_array_equal(idle, [False] * 2 + [rests] * 4)  # N = 2 dreams first


def aged(acts):
    """DYNA whose agent only counts its updates; so old, it takes action ``acts(age)``."""
    return DYNA._replace(agent=AGENT._replace(
        init=lambda key, hparams: jnp.int32(0),
        act=lambda state, obs, key, hparams: jnp.int32(acts(state)),
        update=lambda state, *_: (state + 1, {"loss": jnp.float32(0)}),
    ))  # fmt: skip


def test_safe_updates_must_be_in_a_row():
    """Where every other update finds its dreams safe, none stops."""
    config = replace(SMALL, num_episodes=2, dream_updates=5)
    changing = aged(lambda age: age % 2)
    now_and_then = changing._replace(safe=lambda episodes: (episodes.action[:, 0] == 0).all())
    state, _ = train(now_and_then, config)
    assert not state.dreams_safe and state.agent == 2 + 5
    assert train(changing._replace(safe=lambda episodes: True), config)[0].agent == 2 + 2


def test_an_unsafe_real_episode_wakes():
    def safe(episodes):  # a real episode comes alone; dreams always are
        return (episodes.action[0, 0] == 0) | (len(episodes.mask) > 1)

    config = replace(SMALL, num_episodes=4, num_real_first=1, dream_updates=2)
    # Ages at the real episodes are 0, 3 after two dreams, 4 after none, 7.
    _, metrics = train(aged(lambda age: age == 4)._replace(safe=safe), config)
    np.testing.assert_array_equal(np.isnan(metrics["model_loss"]), [False, True, False, True])


def test_rare_share_decides_what_the_model_sees():
    def update(state, batch, key, hparams):
        return state, {"loss": batch.terminated.mean()}

    seeing = WITHOUT_DREAMS._replace(model=DYNA.model._replace(update=update))
    as_they_come, half, only = (
        np.asarray(train(seeing, replace(SMALL, rare_share=share))[1]["model_loss"])
        for share in (None, 0.5, 1.0)
    )
    assert 0 < as_they_come.mean() < 0.2
    assert half.mean() == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(only, 1)


def test_real_weight_zero_leaves_learning_to_the_dreams():
    state, _ = train(DYNA, real_weight=0.0, fake_weight=0.0)
    config = DynaConfig(**{**vars(SMALL), "num_episodes": 2})
    first_phase, _ = train(MODEL_FREE, config)
    assert_same(state.agent, first_phase.agent)


@pytest.mark.slow
def test_jit_is_eager():
    """Of the whole loop; of each of its parts `test_contract` says so."""
    few = {"num_episodes": 1, "num_real_first": 1, "num_steps": 2, "model_updates": 1}
    config = DynaConfig(**{**vars(SMALL), **few})
    compiled = train(DYNA, config)
    with jax.debug_key_reuse(False), jax.disable_jit():  # the checker is slow op by op
        eager = make_train(DYNA, config)(jax.random.key(0), hparams())
    assert_close(compiled[1], eager[1], 1e-4)
    assert_close(compiled[0].agent, eager[0].agent, 1e-4)


def test_dreams_improve_the_policy_where_the_dream_is_true():
    """With the true world for a dream, many dreams beat none on the same real episodes."""
    config = DynaConfig(
        num_episodes=30, num_real_first=2, num_steps=60, dream_updates=4, dream_episodes=8
    )
    params = hparams().env.replace(max_steps=60)
    _, oracle = train(ORACLE, config, env=params)
    _, free = train(ORACLE, config, env=params, fake_weight=0.0)
    assert oracle["real_return"][-10:].mean() > 1.3 * free["real_return"][-10:].mean()
    np.testing.assert_array_equal(oracle["real_return"][:2], free["real_return"][:2])


def test_forgetting_empties_the_replay():
    kept = memory.forgetting(memory.transitions(), 4)
    state, metrics = train(WITHOUT_DREAMS._replace(memory=kept))
    assert state.replay.added == metrics["real_length"][4:].sum()


def test_a_dreamed_world_knows_only_observed_starts(dyna_run):
    starts = np.asarray(dyna_run[0].starts.data)
    assert starts.shape == (6, 4) and (np.abs(starts) <= 0.05).all() and starts.std() > 0


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"num_episodes": -3}, "num_episodes is -3"),
        ({"model_updates": -1}, "model_updates is -1: it must be at least 0"),
        ({"num_episodes": 2.5}, "must be a whole number"),
        ({"num_episodes": True}, "must be a whole number"),
        ({"rare_share": 1.5}, "must be between 0 and 1, or None"),
        ({"replay_capacity": 3}, "at least one episode"),
    ],
)
def test_clear_errors(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        DynaConfig(**{**vars(SMALL), **changes})


def test_a_model_is_judged_before_it_learns(dyna_run):
    """Of the first episode it knows nothing, as one that never learns; of the second it does."""
    _, placebo = train(DYNA, model_trains=False)
    errors = np.asarray(dyna_run[1]["state_error"])
    np.testing.assert_array_equal(errors[0], placebo["state_error"][0])
    assert (errors[1] != placebo["state_error"][1]).all()


def called():
    """Which of an agent's functions a run with dreams asks."""
    names = set()

    def noted(name, function):
        return lambda *given: names.add(name) or function(*given)

    acting = {name: noted(name, AGENT.act) for name in ("act", "act_fake")}
    learning = {name: noted(name, AGENT.update) for name in ("update", "update_fake")}
    run = make_train(ORACLE._replace(agent=AGENT._replace(**acting, **learning)), SMALL)
    jax.eval_shape(run, jax.random.key(0), hparams())
    return names


def test_an_agent_may_act_and_learn_otherwise_in_dreams():
    assert called() == {"act", "act_fake", "update", "update_fake"}


def test_survived_by_hand():
    """Two episodes of three steps, of which one may fall in its last."""
    no = jnp.zeros((2, 3), bool)
    steps = Transition(no, no, no, no, no, no, ~no)
    assert survived(steps)
    assert not survived(steps._replace(terminated=no.at[1, 2].set(True)))


def test_only_who_waits_for_the_first_dream_needs_so_many_episodes():
    late = DynaConfig(**vars(SMALL) | {"num_real_first": 7})
    make_init(MODEL_FREE, late), make_init(WITHOUT_DREAMS, late)
    with pytest.raises(ValueError, match=r"num_real_first \(N\) is 7 but .* lower N or raise"):
        make_train(DYNA, late)


def test_evaluations_change_nothing_of_a_run(dyna_run):
    state, metrics = dyna_run
    judged, seen = train(DYNA, replace(SMALL, eval_every=3, eval_episodes=4))
    returns = np.asarray(seen.pop("frozen_return"))
    assert_same(judged, state)
    assert_same(seen, metrics)
    assert np.isfinite(returns).tolist() == [False, False, True] * 2
    assert ((returns[2::3] > 5) & (returns[2::3] <= 20)).all()


def test_an_evaluation_is_of_the_greedy_policy():
    config = replace(SMALL, num_episodes=1, eval_every=1, eval_episodes=3)
    agent = AGENT._replace(act_greedy=lambda state, obs, key, hparams: jnp.int32(obs[2] > 0))
    worse = AGENT._replace(act_greedy=lambda state, obs, key, hparams: jnp.int32(obs[2] <= 0))
    returns = [
        float(train(MODEL_FREE._replace(agent=one), config)[1]["frozen_return"][0])
        for one in (agent, worse)
    ]
    assert returns[0] == 20 > returns[1] + 5


@pytest.mark.parametrize("episodes", [None, 2])
def test_whose_acting_an_expert_does_for_good_has_no_policy_to_evaluate(episodes):
    expert = Expert(lambda state, obs, key, hparams: jnp.int32(0), episodes)
    dyna = MODEL_FREE._replace(expert=expert)
    _, metrics = train(dyna, replace(SMALL, eval_every=1, eval_episodes=2))
    assert ("frozen_return" in metrics) == (episodes is not None)


def test_a_greedy_action_is_the_likeliest():
    state = AGENT.init(jax.random.key(0), ReinforceHParams())
    for number, obs in enumerate(2 * jax.random.normal(jax.random.key(1), (5, 4))):
        keys = jax.random.split(jax.random.key(2 + number), 2000)
        drawn = jax.vmap(lambda key, obs=obs: AGENT.act(state, obs, key, None))(keys)
        greedy = int(AGENT.act_greedy(state, obs, jax.random.key(0), None))
        assert float((drawn == greedy).mean()) > 0.47


def test_a_small_output_variance_begins_with_all_actions_alike():
    even = reinforce((4,), 2, ReinforceConfig(output_variance=1e-4))
    states = [agent.init(jax.random.key(0), ReinforceHParams()) for agent in (AGENT, even)]
    kernels = [state.params["params"]["Dense_1"]["kernel"] for state in states]
    np.testing.assert_allclose(kernels[1], 0.01 * kernels[0], rtol=1e-5)
    hidden = [state.params["params"]["Dense_0"]["kernel"] for state in states]
    np.testing.assert_array_equal(*hidden)
