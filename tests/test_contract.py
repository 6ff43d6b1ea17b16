"""Every part of the package keeps the contract (`jaxdyna.testing`), and learners learn."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings, strategies as st
from parts import ENV, perfect_predict, random_act

from jaxdyna import rollout
from jaxdyna.agents import (
    CloningConfig,
    DQNConfig,
    DQNHParams,
    LinearRegulatorHParams,
    LinearSearchHParams,
    ReinforceConfig,
    ReinforceHParams,
    cloning,
    dqn,
    linear_regulator,
    linear_search,
    policy_logits,
    q_values,
    reinforce,
)
from jaxdyna.agents.reinforce import no_baseline, over_batch, per_step, within_episode
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, make_train
from jaxdyna.envs import (
    CartPole,
    CartPoleParams,
    Catch,
    CatchParams,
    FrameStack,
    Maze,
    MazeParams,
    Pendulum,
    PendulumParams,
    Pong,
    PongParams,
    Replayed,
    ReplayedParams,
)
from jaxdyna.models import (
    AdversarialHParams,
    LearnedEnvironment,
    LearnedParams,
    PixelConfig,
    PixelHParams,
    RectangleConfig,
    SupervisedConfig,
    SupervisedHParams,
    discriminator,
    pixels,
    rectangles,
    supervised,
    uniform_start,
)
from jaxdyna.models.evaluation import (
    change_error,
    frame_errors,
    one_step,
    one_step_sums,
    open_loop,
    r_squared,
)
from jaxdyna.models.supervised import Moments, _update_moments
from jaxdyna.networks import (
    ClassReward,
    EncoderDecoder,
    GlimpseQ,
    JointReward,
    LocalDynamics,
    PerceptronQ,
    Resolution,
)
from jaxdyna.planners import (
    CrossEntropyConfig,
    SearchConfig,
    ShootingConfig,
    cross_entropy,
    gumbel_muzero,
    muzero,
    random_shooting,
)
from jaxdyna.testing import check_agent, check_environment, check_model, check_planner
from jaxdyna.types import Agent, Prediction, Transition

SIZE = 8
FRAME = (SIZE, SIZE, 3)
STACK = FrameStack(Maze(size=SIZE, num_obstacles=1))
SHORT = MazeParams(max_steps=9)
GAME = PongParams(points_to_win=1, max_steps=40, first_serve_delay=1, serve_delay=1)


def drawn(key, start):
    """One of the starts."""
    row = jax.random.randint(key, (), 0, 4)
    return jax.tree.map(lambda leaf: leaf[row], start)


def replayed():
    keys = jax.random.split(jax.random.key(0), 4)
    obs, state = jax.jit(jax.vmap(STACK.reset, (0, None)))(keys, SHORT)
    return Replayed(STACK, drawn), ReplayedParams(SHORT, (obs, state.env), 9)


def learned():
    world = LearnedEnvironment(ENV, perfect_predict, uniform_start(-0.05, 0.05))
    return world, LearnedParams(CartPoleParams(), jnp.zeros(4))


WORLDS = {
    "cartpole": lambda: (CartPole(), None),
    "maze": lambda: (Maze(), SHORT),
    "catch": lambda: (Catch(), CatchParams()),
    "catch_frames": lambda: (Catch(rows=5, frames=True), None),
    "pong": lambda: (Pong(scale=8), GAME),
    "pendulum": lambda: (Pendulum(), PendulumParams(max_steps=9)),
    "stack": lambda: (STACK, SHORT),
    "replayed": replayed,
    "learned": learned,
}


@pytest.mark.parametrize("name", WORLDS)
def test_environment(name):
    check_environment(*WORLDS[name](), random=True)


ADAM = {"sum_loss": False, "optimizer": optax.adam, "normalise": True}
MODELS = {
    "paper": supervised(4, 2, SupervisedConfig()),
    "scaled": supervised(4, 2, SupervisedConfig(sum_loss=False, normalise=True, hidden=(32,))),
    "delta": supervised(4, 2, SupervisedConfig(**ADAM, delta=True, one_hot=True, hidden=(32,))),
    "ensemble": supervised(4, 2, SupervisedConfig(**ADAM, delta=True, ensemble=3, hidden=(32,))),
}
RULES = {
    rule.__name__: reinforce((4,), 2, ReinforceConfig(advantage=rule))
    for rule in (no_baseline, within_episode, over_batch, per_step)
}


@cache
def small_episodes(frames):
    """``[3, 9]``, of frames or of vectors."""
    world, params = (STACK, SHORT) if frames else (ENV, ENV.default_params)

    def act(obs, key):
        return jax.random.randint(key, (), 0, world.num_actions)

    return jax.jit(lambda key: rollout(world, act, key, params, 3, num_steps=9))(jax.random.key(1))


def q_learner(frames):
    network = GlimpseQ(5, size=3, hidden=(4,)) if frames else PerceptronQ(2, (4,))
    config = DQNConfig(
        network, updates=1, fake_updates=1, batch=4, capacity=64, episodes=8, fake_capacity=64,
        fake_episodes=8,
    )  # fmt: skip
    agent = dqn(FRAME, 5, config) if frames else dqn((4,), 2, config)
    return agent, lambda params, obs: q_values(network, params, obs[None])[0]


def imitating(agent, outputs, frames):
    obs = small_episodes(frames).obs[0, 0]
    config = CloningConfig(updates=2, batch=4, capacity=64)
    return cloning(agent, outputs, (obs, jnp.int32(0)), config)


def imitation_alone(frames):
    """The rest is the agent's own, and that this is passed on is seen with REINFORCE."""
    agent = imitating(*q_learner(frames), frames)
    return Agent(agent.init, agent.act, agent.update_expert)


AGENTS = {
    **{rule: lambda rule=rule: (RULES[rule], False) for rule in RULES},
    "clipped": lambda: (reinforce((4,), 2, ReinforceConfig(advantage=per_step, epochs=3)), False),
    "linear_search": lambda: (linear_search((4,), 2), False),
    "linear_regulator": lambda: (linear_regulator((4,), 2), False),
    "dqn_vectors": lambda: (q_learner(False)[0], False),
    "dqn_frames": lambda: (q_learner(True)[0]._replace(act_fake=None, update_fake=None), True),
    "cloned_reinforce": lambda: (
        imitating(RULES["per_step"], policy_logits(2, ReinforceConfig()), False), False),
    "cloned_dqn_vectors": lambda: (imitation_alone(False), False),
    "cloned_dqn_frames": lambda: (imitation_alone(True), True),
}  # fmt: skip


SLOW = (
    "gumbel_muzero", "coder", "adversarial", "rectangles", "dqn_frames", "cloned_dqn_vectors",
    "cloned_dqn_frames",
)  # fmt: skip


def quick_first(names):
    """Those that compile for ten seconds, and are much like others, are apart."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in names]


@pytest.mark.parametrize("name", quick_first(AGENTS))
def test_agent(name):
    agent, frames = AGENTS[name]()
    hparams = DQNHParams() if "dqn" in name else ReinforceHParams()
    hparams = LinearSearchHParams(1e3) if name == "linear_search" else hparams
    hparams = LinearRegulatorHParams() if name == "linear_regulator" else hparams
    check_agent(agent, hparams, small_episodes(frames), 5 if frames else 2)


LOCAL = pixels(FRAME, 5, PixelConfig(LocalDynamics(3, (4,))))
CODER = EncoderDecoder(3, widths=(4, 4), kernels=(2, 2), dense=8)
CLASSES = ClassReward((-5.0, 0.0, 1.0), (1.0, 1.0, 1.0), (8,))
FRAME_MODELS = {
    "local": LOCAL,
    "coder": pixels(FRAME, 5, PixelConfig(CODER, reward=JointReward(), terminates=True)),
    "classes": pixels(FRAME, 5, PixelConfig(CODER, reward=CLASSES)),
    "adversarial": pixels(
        FRAME, 5, PixelConfig(LocalDynamics(3, (4,)), shades=True), adversary=discriminator(FRAME)
    ),
    "rectangles": rectangles(
        FRAME, 5, RectangleConfig(Resolution((1, 1)), ((0, 1, 2),), (8,), draws=True)
    ),
}


@pytest.mark.parametrize("name", quick_first(MODELS | FRAME_MODELS))
def test_model(name):
    if name in MODELS:
        check_model(MODELS[name], SupervisedHParams(1e-4), small_episodes(False))
    else:
        hparams = AdversarialHParams() if name == "adversarial" else PixelHParams()
        check_model(FRAME_MODELS[name], hparams, small_episodes(True))


MISTAKES = {
    "a float mask": lambda real: real._replace(mask=real.mask * 1.0),
    "float actions": lambda real: real._replace(action=real.action * 1.0),
    "rewards with an axis more": lambda real: real._replace(reward=real.reward[..., None]),
    "ends of one episode": lambda real: real._replace(terminated=real.terminated[:1]),
    "observations of fewer episodes": lambda real: real._replace(obs=real.obs[:1]),
    "steps without episodes": lambda real: jax.tree.map(lambda leaf: leaf[0], real),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_learners_refuse_what_are_no_transitions(mistake):
    """But for models, whose transitions have any leading axes."""
    wrong, key = MISTAKES[mistake](small_episodes(False)), jax.random.key(0)
    parts = [(AGENTS[name]()[0], DQNHParams()) for name in ("no_baseline", "dqn_vectors")]
    parts += [(imitation_alone(False), DQNHParams())]
    if mistake != "steps without episodes":
        parts += [
            (model, AdversarialHParams()) for model in (MODELS["paper"], *FRAME_MODELS.values())
        ]
    for part, hparams in parts:
        state = jax.eval_shape(part.init, key, hparams)
        for update in (part.update, getattr(part, "update_fake", None)):
            if update is not None:
                with pytest.raises(AssertionError, match=r"rank|type|shape"):
                    jax.eval_shape(update, state, wrong, key, hparams)


def test_one_observation_at_a_time():
    obs, action, key = jnp.zeros((2, 4)), jnp.int32(0), jax.random.key(0)
    agent, model = q_learner(False)[0], MODELS["paper"]
    state = jax.eval_shape(agent.init, key, DQNHParams())
    with pytest.raises(AssertionError, match="rank"):
        jax.eval_shape(agent.act, state, obs, key, DQNHParams())
    params = jax.eval_shape(model.init, key, SupervisedHParams()).params
    with pytest.raises(AssertionError, match="shape"):
        jax.eval_shape(model.predict, params, obs, action, key)
    stacks = jnp.zeros((2, *FRAME[:2], 12), jnp.uint8)
    for name in ("local", "rectangles"):
        params = jax.eval_shape(FRAME_MODELS[name].init, key, PixelHParams()).params
        with pytest.raises(AssertionError, match="rank"):
            jax.eval_shape(FRAME_MODELS[name].predict, params, stacks, action, key)


PLANNERS = {
    "random_shooting": lambda env: random_shooting(env, ShootingConfig(2, 4)),
    "cross_entropy": lambda env: cross_entropy(env, CrossEntropyConfig(2, 4, elites=2)),
    "muzero": lambda env: muzero(env, SearchConfig(4)),
    "gumbel_muzero": lambda env: gumbel_muzero(env, SearchConfig(4)),
}


@pytest.mark.parametrize("name", quick_first(PLANNERS))
def test_planner(name):
    searches = "muzero" in name
    if searches:
        pytest.importorskip("mctx")
    env = Catch(rows=5, columns=3)
    check_planner(PLANNERS[name](env), env, env.default_params, prior=searches)


@jax.jit
def play(key):
    return rollout(ENV, random_act, key, ENV.default_params, 40, num_steps=60)


@pytest.fixture(scope="module")
def episodes():
    return play(jax.random.key(1))


@pytest.mark.parametrize("name", RULES)
def test_half_the_weight_moves_a_policy_half_as_far(name, episodes):
    agent, hparams, key = RULES[name], ReinforceHParams(), jax.random.key(3)
    state = agent.init(jax.random.key(0), hparams)

    @jax.jit
    def moved(weight):
        weighed = episodes._replace(weight=jnp.full(episodes.mask.shape, weight))
        new, _ = agent.update(state, weighed, jax.random.clone(key), hparams)
        return jax.tree.map(jnp.subtract, new.params, state.params)

    for full, half in zip(*map(jax.tree.leaves, (moved(1.0), moved(0.5))), strict=True):
        np.testing.assert_allclose(half, full / 2, atol=2e-5)
        assert np.abs(full).max() > 1e-3


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("paper", "scaled") else name
        for name in MODELS
    ],
)
def test_model_learns_the_world(name, episodes):
    """Full-batch training beats its start, and the better ones the guess of a mean change."""
    model = MODELS[name]
    learning_rate = {"paper": 2e-5, "scaled": 0.02}.get(name, 5e-3)
    hparams = SupervisedHParams(learning_rate)

    @jax.jit
    def train(key):
        def step(carry, _):
            state, key = carry
            key, key_now = jax.random.split(key)
            state, metrics = model.update(state, episodes, key_now, hparams)
            return (state, key), metrics["loss"]

        key_init, key = jax.random.split(key)
        return jax.lax.scan(step, (model.init(key_init, hparams), key), length=300)

    (state, _), losses = train(jax.random.key(4))
    assert losses[-1] < 0.5 * losses[0]
    new = play(jax.random.key(5))
    sums = jax.jit(one_step_sums(model.predict))(state.params, new, jax.random.key(6))
    assert sums["count"] == new.mask.sum()
    target = "state" if name in ("paper", "scaled") else "change"
    assert r_squared(sums, target).min() > {"paper": 0.0, "scaled": 0.9}.get(name, 0.7)
    said = model.predict(state.params, new.obs[0, 0], new.action[0, 0], jax.random.key(7))
    assert (said.uncertainty > 0) == (name == "ensemble")


def saying(said, **changes):
    """A model of two variables whose members say these things of everything."""
    config = SupervisedConfig(hidden=(1,), ensemble=len(said), **changes)
    model = supervised(2, 2, config)
    state = jax.tree.map(jnp.zeros_like, model.init(jax.random.key(0), SupervisedHParams()))
    layers = state.params.network["params"]
    layers = layers | {"Dense_1": layers["Dense_1"] | {"bias": jnp.array(said)}}
    ones = Moments(jnp.zeros(2), jnp.ones(2), jnp.int32(0))
    params = state.params.replace(network={"params": layers}, inputs=ones, targets=ones)
    return model, state.replace(params=params)


@jax.jit
def committee():
    """Changes of 0, 2 and 4 of the first variable and 1 of the second, in units of two deviations;
    rewards of 1, 2 and 6; ends with probabilities of 1/2, 1/2 and 3/4.
    """
    said = [[0.0, 1, 1, 0], [2.0, 1, 2, 0], [4.0, 1, 6, np.log(3)]]
    model, state = saying(said, delta=True, normalise=True, spread=2.0)
    targets = Moments(jnp.array([10.0, 20.0]), jnp.array([9.0, 9.0]), jnp.int32(1))
    params = state.params.replace(targets=targets)
    return model.predict(params, jnp.ones(2), jnp.int32(0), jax.random.key(0))


def test_what_an_ensemble_says_by_hand():
    said = committee()
    np.testing.assert_allclose(said.next_obs, [1 + 10 + 2 * 2 * 3, 1 + 20 + 1 * 2 * 3])
    np.testing.assert_allclose([said.reward, said.terminated], [3, (0.5 + 0.5 + 0.75) / 3])
    np.testing.assert_allclose(said.uncertainty, 2 * np.std([0, 2, 4]), rtol=1e-6)


def test_one_member_at_a_time_speaks_for_the_ensemble():
    """All that it says is its own, each speaks about as often, and they disagree as before."""
    said = [[0.0, 1, 1, 0], [2.0, 1, 2, 0], [4.0, 1, 6, np.log(3)]]
    model, state = saying(said, delta=True, one_member=True)
    keys = jax.random.split(jax.random.key(0), 300)
    drawn = jax.jit(jax.vmap(model.predict, (None, None, None, 0)))(
        state.params, jnp.ones(2), jnp.int32(0), keys
    )
    whole = np.stack([drawn.next_obs[:, 0], drawn.reward, drawn.terminated], axis=1)
    of_members, counts = np.unique(whole.round(3), axis=0, return_counts=True)
    np.testing.assert_allclose(of_members, [[1, 1, 0.5], [3, 2, 0.5], [5, 6, 0.75]])
    assert counts.min() > 70
    np.testing.assert_allclose(drawn.uncertainty, np.std([0, 2, 4]), rtol=1e-6)


@partial(jax.jit, static_argnums=(0, 1, 2))
def taught(members, sum_loss, optimizer):
    """What members that say 0 of everything have learned of five steps, and Adam's count of steps,
    5 before. The states after are 0 to 4, the rewards 1.
    """
    zeros, no = jnp.zeros((members, 4)), jnp.zeros(5, bool)
    model, state = saying(zeros, sum_loss=sum_loss, optimizer=optimizer)
    if optimizer is optax.adam:
        state = state.replace(opt_state=optax.tree.set(state.opt_state, count=jnp.int32(5)))
    after = jnp.tile(jnp.arange(5.0)[:, None], 2)
    steps = Transition(0 * after, no.astype(int), jnp.ones(5), after, no, no, ~no)
    new, _ = model.update(state, steps, jax.random.key(2), SupervisedHParams())
    count = optax.tree.get(new.opt_state, "count", jnp.int32(0))
    return new.params.network["params"]["Dense_1"]["bias"], count


def test_eq_1_is_summed_over_the_batch():
    """The step of plain gradient descent, at a rate of 0.01; or averaged, a fifth of it."""
    step = 0.01 * np.array([2 * (0 + 1 + 2 + 3 + 4)] * 2 + [2 * 5, -0.5 * 5])
    np.testing.assert_allclose(taught(1, True, optax.sgd)[0][0], step, rtol=1e-5)
    np.testing.assert_allclose(taught(1, False, optax.sgd)[0][0], step / 5, rtol=1e-5)


def test_members_of_an_ensemble_see_resamplings_of_their_own():
    """Begun alike, they come to differ; each learns of five steps, some of them twice."""
    learned = np.asarray(taught(3, True, optax.sgd)[0])
    assert len({row.tobytes() for row in learned}) > 1
    np.testing.assert_allclose(learned[:, 2], 0.01 * 2 * 5, rtol=1e-5)


def test_the_models_optimiser_remembers():
    """Adam corrects its moments by the number of steps that were made."""
    assert taught(1, False, optax.adam)[1] == 6


@jax.jit
def reinforced():
    """The loss of a policy for which both actions are as likely, and its optimiser's count."""
    agent, hparams = reinforce((4,), 2, ReinforceConfig(hidden=(1,))), ReinforceHParams(0.01, 0.5)
    state = jax.tree.map(jnp.zeros_like, agent.init(jax.random.key(0), hparams))
    state = state.replace(opt_state=optax.tree.set(state.opt_state, count=jnp.int32(5)))
    no = jnp.zeros((1, 4), bool)
    real = Transition(jnp.zeros((1, 4, 4)), no.astype(int), jnp.ones((1, 4)), jnp.zeros((1, 4, 4)),
                      no, no, jnp.arange(4)[None] < 3)  # fmt: skip
    new, metrics = agent.update(state, real, jax.random.key(1), hparams)
    return metrics["loss"], optax.tree.get(new.opt_state, "count")


def test_reinforce_by_hand():
    """Three steps of 1 at a discount of a half, each of log 2; the fourth is padding."""
    loss, count = reinforced()
    np.testing.assert_allclose(loss, (1.75 + 1.5 + 1) * np.log(2), rtol=1e-6)
    assert count == 6  # by which Adam corrects its moments


def fixed(params, obs, action, key):
    """Predicts that vectors grow by 1, and that frames stay; no reward."""
    zero = jnp.float32(0)
    return Prediction(obs if obs.dtype == jnp.uint8 else obs + 1, zero, zero, zero)


def two_steps(frames):
    """And one of padding. The first step changes the frame, the second does not."""
    vectors = jnp.array([[[0.0], [3.0], [9.0]]]), jnp.array([[[3.0], [4.0], [50.0]]])
    dark, half = jnp.zeros((1, 3, 1, 2, 1), jnp.uint8), jnp.uint8(200)
    obs, after = (dark, dark.at[0, ::2].set(half)) if frames else vectors
    no, reward = jnp.zeros((1, 3), bool), jnp.array([[0.4, -1.0, 5.0]])
    return Transition(
        obs, jnp.zeros((1, 3), int), reward, after, no, no, jnp.array([[1, 1, 0]]) > 0
    )


def test_a_model_is_judged_by_hand():
    def judge(diagnose, frames):
        return jax.jit(lambda key: diagnose(fixed)(None, two_steps(frames), key))(jax.random.key(0))

    sums = judge(one_step_sums, False)
    expected = {"count": 2, "state_error": 4, "state_spread": 0.5, "change_spread": 2,
                "change_square": 10}  # fmt: skip
    assert {name: float(value.squeeze()) for name, value in sums.items()} == expected
    np.testing.assert_allclose(judge(change_error, False)["model_error"], 4 / 10)
    assert judge(frame_errors, True) == {"wrong_frames": 0.5, "wrong_rewards": 0.5}


def test_open_loop_feeds_predictions_back(episodes):
    model = MODELS["delta"]
    params = model.init(jax.random.key(0), SupervisedHParams()).params
    obs, action = episodes.obs[0, 0], episodes.action[0, :5]
    predict = jax.jit(model.predict)
    free = jax.jit(lambda key: open_loop(predict, params, obs, action, key))(jax.random.key(1))
    for time in range(5):
        expected = predict(params, obs, action[time], jax.random.key(2))
        np.testing.assert_allclose(free.next_obs[time], expected.next_obs, rtol=1e-5, atol=1e-6)
        obs = expected.next_obs
    first = jax.jit(lambda key: one_step(predict, params, episodes, key))(jax.random.key(3))
    assert first.next_obs.shape == episodes.obs.shape
    np.testing.assert_allclose(first.next_obs[0, 0], free.next_obs[0], rtol=1e-5, atol=1e-6)


def test_reinforce_learns_cartpole():
    """A few dozen updates from batches of real episodes more than double the return."""
    agent, hparams = RULES["per_step"], ReinforceHParams(learning_rate=0.02)

    @jax.jit
    def train(key):
        def step(carry, _):
            state, key = carry
            key, key_play, key_update = jax.random.split(key, 3)

            def act(obs, key):
                return agent.act(state, obs, key, hparams)

            played = rollout(ENV, act, key_play, ENV.default_params, 16)
            state, _ = agent.update(state, played, key_update, hparams)
            return (state, key), (played.reward * played.mask).sum(1).mean()

        key_init, key = jax.random.split(key)
        return jax.lax.scan(step, (agent.init(key_init, hparams), key), length=60)[1]

    returns = train(jax.random.key(0))
    assert returns[-5:].mean() > 2.5 * returns[:5].mean()


def test_clear_errors():
    with pytest.raises(ValueError, match="at least 1"):
        SupervisedConfig(ensemble=0)


def test_moments_far_from_zero():
    """Of 300 batches of 10,000 + N(0, 1)."""
    values = 10_000 + jax.random.normal(jax.random.key(0), (300, 32, 1))
    still = Moments(jnp.zeros(1), jnp.ones(1), jnp.int32(0))
    take_in = jax.jit(lambda all: jax.lax.scan(
        lambda held, batch: (_update_moments(held, batch, jnp.ones(32)), None), still, all
    )[0])  # fmt: skip
    moments = take_in(values)
    np.testing.assert_allclose(moments.mean, values.mean(), rtol=1e-6)
    np.testing.assert_allclose(moments.std, 1, rtol=0.05)
    apart = values + 4 * (jnp.arange(300) % 2)[:, None, None]  # and of batches that differ
    np.testing.assert_allclose(take_in(apart).std, np.sqrt(1 + 2**2), rtol=0.05)


BATCHES, ROWS = 4, 6
SCALED = supervised(2, 2, SupervisedConfig(hidden=(2,), delta=True, normalise=True))


@jax.jit
def scales_after(obs, next_obs, masks):
    """The moments of a model after batches ``[BATCHES, ROWS, 2]``."""
    hparams = SupervisedHParams()

    def update(state, batch):
        obs, next_obs, mask = batch
        no = jnp.zeros(ROWS, bool)
        seen = Transition(obs, no.astype(int), jnp.zeros(ROWS), next_obs, no, no, mask)
        return SCALED.update(state, seen, jax.random.key(0), hparams)[0], None

    start = SCALED.init(jax.random.key(0), hparams)
    params = jax.lax.scan(update, start, (obs, next_obs, masks))[0].params
    return params.inputs, params.inputs.std, params.targets, params.targets.std


@given(
    noise=st.integers(0, 99), offset=st.sampled_from([0.0, -3.0, 1e4]), moves=st.booleans(),
    kept=st.lists(st.integers(0, 2**ROWS - 1), min_size=BATCHES, max_size=BATCHES),
    poison=st.sampled_from([np.nan, np.inf, 1e30]),
)  # fmt: skip
@settings(max_examples=50)
def test_moments_are_those_of_all_batches(noise, offset, moves, kept, poison):
    """Wherever the values lie; a batch counts once, however few of its rows are not masked."""
    masks = (np.array(kept)[:, None] >> np.arange(ROWS)) % 2 == 1
    shape = (BATCHES, ROWS, 2)
    drawn = np.random.default_rng(noise).normal(size=(2, *shape))
    obs = np.float32(offset + moves * drawn[0])
    next_obs = np.float32(obs + 1 + moves * drawn[1])
    change = (next_obs - obs).astype(np.float64)
    rows = [(batch, mask) for batch, mask in enumerate(masks) if mask.any()]
    wrong = np.where(masks[..., None], 0, np.float32(poison))
    inputs, input_std, targets, target_std = scales_after(obs + wrong, next_obs + wrong, masks)
    for moments, std, values in ((inputs, input_std, obs), (targets, target_std, change)):
        assert moments.batches == len(rows)
        parts = [values[batch, mask].astype(np.float64) for batch, mask in rows]
        mean = np.mean([part.mean(0) for part in parts], 0) if parts else np.zeros(2)
        squares = [np.square(part - mean).mean(0) for part in parts] or [np.ones(2)]
        expected = np.sqrt(np.mean(squares, 0))
        np.testing.assert_allclose(moments.mean, mean, rtol=1e-6, atol=1e-5)
        expected = np.where(expected > 0, expected, 1)  # of what never moved nothing is known
        np.testing.assert_allclose(std, expected, rtol=2e-2 if offset == 1e4 else 1e-4)


def test_padding_has_no_moments():
    still = Moments(jnp.zeros(1), jnp.ones(1), jnp.int32(0))
    held = _update_moments(still, jnp.array([[2.0], [6.0], [99.0]]), jnp.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose([held.mean[0], held.std[0]], [4, 2])


def test_a_variable_that_never_moved_has_no_scale():
    moments = _update_moments(
        Moments(jnp.zeros(1), jnp.ones(1), jnp.int32(0)), jnp.full((8, 1), 100.1), jnp.ones(8)
    )
    np.testing.assert_array_equal(moments.std, 1)


def test_changes_of_bytes_do_not_wrap():
    model = supervised(1, 2, SupervisedConfig(hidden=(4,), delta=True, normalise=True))
    obs = jnp.full((8, 1), 100, jnp.uint8)
    flags = jnp.zeros(8, bool)
    down = Transition(obs, jnp.zeros(8, int), jnp.zeros(8), obs - 1, flags, flags, ~flags)
    hparams = SupervisedHParams()
    state, _ = model.update(
        model.init(jax.random.key(0), hparams), down, jax.random.key(1), hparams
    )
    np.testing.assert_allclose(state.params.targets.mean, -1)


def test_a_random_search_keeps_what_is_enough_and_learns_nothing_else():
    """By hand: episodes of 9 and, after masking, 4 steps of reward 1 are 6.5 on average."""
    agent = linear_search((4,), 2)
    real = jax.tree.map(lambda leaf: leaf[:2], small_episodes(False))
    real = real._replace(reward=np.ones((2, 9)), mask=np.arange(9) < [[9], [4]])
    state = agent.init(jax.random.key(0), LinearSearchHParams(6.5))
    for enough, kept in ((6.5, True), (6.6, False)):
        new, metrics = agent.update(state, real, jax.random.key(1), LinearSearchHParams(enough))
        assert (new.params == state.params).all() == kept and metrics["loss"] == -6.5
    obs = np.array([1.0, -2.0, 0.5, 3.0])
    chosen = agent.act(state, jnp.array(obs), jax.random.key(2), None)
    assert chosen == np.argmax(np.asarray(state.params) @ obs)


def test_a_random_search_balances_the_pole_as_soon_as_it_is_said_to():
    """Ten in a row at 195 begin after some twenty episodes and 1,000 steps, in the median run."""
    env = CartPole()
    agent, hparams = linear_search((4,), 2), LinearSearchHParams(195.0)
    dyna = Dyna(env, agent)
    config = DynaConfig(num_episodes=100, num_steps=200)
    values = DynaHParams(hparams, None, env.default_params)
    train = jax.jit(jax.vmap(make_train(dyna, config), (0, None)))
    lengths = np.asarray(train(jax.random.split(jax.random.key(0), 60), values)[1]["real_length"])
    row = np.lib.stride_tricks.sliding_window_view(lengths, 10, axis=1).min(-1) >= 195
    first = np.where(row.any(1), row.argmax(1), np.inf)
    steps = [one[: int(at)].sum() if np.isfinite(at) else np.inf
             for one, at in zip(lengths, first, strict=True)]  # fmt: skip
    assert 12 <= np.median(first) <= 35 and 500 <= np.median(steps) <= 1600
