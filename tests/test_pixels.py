"""Frame models: their networks, losses and heads."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from parts import assert_close, assert_same

from jaxdyna import rollout
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    PixelConfig,
    PixelHParams,
    frame_probability,
    pixels,
)
from jaxdyna.networks import ClassReward, EncoderDecoder, JointReward, LocalDynamics, LocalReward
from jaxdyna.types import Transition

SIZE = 9
ENV = FrameStack(Maze(size=SIZE, num_obstacles=3))
PARAMS = MazeParams(max_steps=30)
LOCAL = LocalDynamics(3, (16, 16))
CODER = EncoderDecoder(3, widths=(8, 8, 8), kernels=(4, 3, 3), dense=32)
CONFIGS = {
    "local": PixelConfig(LOCAL),
    "coder": PixelConfig(CODER, threshold=0.2, reward=JointReward()),
    "ends": PixelConfig(LOCAL, terminates=True, reward=None),
    "l2": PixelConfig(LOCAL, loss=l2),
}


def act(obs, key):
    return jax.random.randint(key, (), 0, 5)


@pytest.fixture(scope="module")
def episodes():
    return jax.jit(lambda key: rollout(ENV, act, key, PARAMS, 6))(jax.random.key(1))


@cache
def make(name):
    model = pixels((SIZE, SIZE, 3), 5, CONFIGS[name])
    return model._replace(init=jax.jit(model.init), update=jax.jit(model.update))


@pytest.mark.parametrize("name", CONFIGS)
def test_a_prediction_is_a_stack_with_one_new_frame(name, episodes):
    model = make(name)
    params = model.init(jax.random.key(0), PixelHParams()).params
    obs = episodes.obs[0, 5]
    predict = jax.jit(model.predict)
    prediction = predict(params, obs, episodes.action[0, 5], jax.random.key(1))
    assert prediction.next_obs.shape == obs.shape and prediction.next_obs.dtype == jnp.uint8
    np.testing.assert_array_equal(prediction.next_obs[..., :9], obs[..., 3:])
    assert set(np.unique(prediction.next_obs[..., 9:])) <= {0, 255}
    assert prediction.reward.shape == prediction.terminated.shape == ()
    assert (prediction.terminated > 0) == (name == "ends")
    assert name != "ends" or prediction.reward == 0
    if name == "local":
        eager = model.predict(params, obs, episodes.action[0, 5], jax.random.key(1))
        assert_close(eager, prediction, 1e-4)


@pytest.mark.parametrize("name", CONFIGS)
def test_what_is_masked_does_not_teach(name, episodes):
    model, hparams, key = make(name), PixelHParams(), jax.random.key(2)
    state = model.init(jax.random.key(0), hparams)

    def update(transitions):
        return model.update(state, transitions, jax.random.clone(key), hparams)[0]

    some = episodes._replace(mask=episodes.mask.at[:, 10:].set(False))
    late = np.arange(30) >= 10
    blank = late[None, :, None, None, None]
    garbage = some._replace(
        reward=jnp.asarray(np.where(some.mask, some.reward, np.float32(99))),
        obs=jnp.asarray(np.where(blank, np.uint8(255), some.obs)),
        next_obs=jnp.asarray(np.where(blank, np.uint8(255), some.next_obs)),
    )
    assert_close(update(garbage), update(some), 1e-4)
    assert_same(update(episodes._replace(mask=episodes.mask & False)), state)


def test_losses_by_hand():
    raw, truth = jnp.array([0.0, 2.0, -1.0]), jnp.array([1.0, 0.5, 0.0])
    np.testing.assert_allclose(l1.error(raw, truth), [1, 1.5, 1])
    np.testing.assert_allclose(l2.error(raw, truth), [0.5, 1.125, 0.5])
    np.testing.assert_allclose(l1.probability(raw), [0, 1, 0])
    p = 1 / (1 + np.exp(-np.asarray(raw)))
    expected = -(truth * np.log(p) + (1 - truth) * np.log(1 - p))
    np.testing.assert_allclose(bce.error(raw, truth), expected, rtol=1e-6)
    np.testing.assert_allclose(bce.probability(raw), p, rtol=1e-6)


@jax.jit
def means_of():
    """What a frame model that knows nothing, but that each of 9 cells earns -0.5, makes of two
    steps and one of padding.
    """
    config = PixelConfig(
        LocalDynamics(3, (2,)), reward=LocalReward(2, price=2.0), reward_weight=3.0
    )
    model, hparams = pixels((3, 3, 3), 5, config), PixelHParams()
    state = model.init(jax.random.key(0), hparams)
    nothing = jax.tree.map(jnp.zeros_like, state.params)["params"]
    head = {"Dense_0": nothing["reward"]["Dense_0"] | {"bias": jnp.ones(2)},
            "Dense_1": {"kernel": jnp.full((2, 1), -0.25)}}  # fmt: skip
    opt_state = optax.tree.set(state.opt_state, count=jnp.int32(5))
    state = state.replace(params={"params": nothing | {"reward": head}}, opt_state=opt_state)
    stacks, no = jnp.full((3, 3, 3, 12), 255, jnp.uint8), jnp.zeros(3, bool)
    reward = jnp.array([-4.5, -2.5, 99.0])
    steps = Transition(stacks, jnp.zeros(3, int), reward, stacks, no, no, jnp.arange(3) < 2)
    new, means = model.update(state, steps, jax.random.key(1), hparams)
    return means | {"steps": optax.tree.get(new.opt_state, "count")}


def test_a_frame_models_loss_by_hand():
    means = means_of()
    frame, reward = 27 * np.log(2), (0 + 4) / 2 + 2 * 9 * 0.5
    np.testing.assert_allclose(means["frame_loss"], frame, rtol=1e-6)
    np.testing.assert_allclose(means["reward_loss"], reward, rtol=1e-6)
    np.testing.assert_allclose(means["loss"], frame + 3 * reward, rtol=1e-6)
    assert means["steps"] == 6  # of 5 before: by which Adam corrects its moments


def test_drawn_pixels_come_as_often_as_they_are_believed_in(episodes):
    config = PixelConfig(LOCAL, threshold=None)
    model = pixels((SIZE, SIZE, 3), 5, config)
    params = jax.jit(model.init)(jax.random.key(3), PixelHParams()).params
    obs, action = episodes.obs[0, 3], episodes.action[0, 3]
    keys = jax.random.split(jax.random.key(4), 2000)
    predict = jax.jit(jax.vmap(model.predict, (None, None, None, 0)))
    drawn = np.asarray(predict(params, obs, action, keys).next_obs)
    believed = jax.jit(frame_probability(5, config))(params, obs[None], action[None])[0]
    np.testing.assert_allclose((drawn[..., 9:] > 0).mean(0), believed, atol=0.05)


@pytest.mark.parametrize("threshold", [0.2, 0.5])
def test_a_model_says_how_many_pixels_it_expects_to_be_wrong(threshold, episodes):
    config = PixelConfig(LOCAL, threshold=threshold)
    model = pixels((SIZE, SIZE, 3), 5, config)
    params = jax.jit(model.init)(jax.random.key(3), PixelHParams()).params
    obs, action = episodes.obs[0, 3], episodes.action[0, 3]
    prediction = jax.jit(model.predict)(params, obs, action, jax.random.key(4))
    believe = jax.jit(frame_probability(5, config))
    believed = np.asarray(believe(params, obs[None], action[None])[0])
    wrong = np.where(believed > threshold, 1 - believed, believed).sum()
    np.testing.assert_allclose(prediction.uncertainty, wrong, rtol=1e-4)


def test_local_dynamics_see_the_edge_and_the_neighbourhood_only():
    blank = jnp.zeros((1, 8, 8, 12))
    params = jax.jit(lambda key: LOCAL.init(key, blank, jnp.zeros((1, 5)), False))(
        jax.random.key(0)
    )
    action = jax.nn.one_hot(jnp.array([2]), 5)

    def out(stack):
        return jax.jit(LOCAL.apply, static_argnums=3)(params, stack, action, False)[0][0]

    still = out(blank)
    np.testing.assert_allclose(still[3, 3], still[4, 4], atol=1e-6)
    assert np.abs(still[0, 3] - still[3, 3]).max() > 1e-3
    touched = np.abs(out(blank.at[0, 3, 3, 0].set(1.0)) - still).max(-1) > 1e-7
    rows, columns = np.nonzero(touched)
    assert rows.min() >= 1 and rows.max() <= 5 and columns.min() >= 1 and columns.max() <= 5


def test_the_encoder_decoder_is_symmetric_and_normalised():
    network = EncoderDecoder(3)
    variables = jax.eval_shape(
        lambda key: network.init(key, jnp.zeros((2, 16, 16, 12)), jnp.zeros((2, 5)), True),
        jax.random.key(0),
    )
    kernels = [
        leaf["kernel"].shape for name, leaf in sorted(variables["params"].items())
        if name.startswith("Convolution")
    ]  # fmt: skip
    assert [kernel[0] for kernel in kernels] == [5, 4, 4, 4, 4, 5]
    # 2 + 2 convolutions and the dense layer on either side of the product.
    assert len(variables["batch_stats"]) == 6
    raw, joint = jax.eval_shape(
        lambda v: network.apply(v, jnp.zeros((2, 16, 16, 12)), jnp.zeros((2, 5)), False), variables
    )
    assert raw.shape == (2, 16, 16, 3) and joint.shape == (2, 256)


@pytest.mark.slow  # test_the_end_is_learned learns too
@pytest.mark.parametrize("name", ["local", pytest.param("coder", marks=pytest.mark.slow)])
def test_it_learns_what_it_is_shown(name, episodes):
    """Trained on a few episodes, a model predicts their frames and rewards."""
    config = PixelConfig(
        CONFIGS[name].network, reward=CONFIGS[name].reward, optimizer=optax.adam, threshold=0.5
    )
    model, hparams = pixels((SIZE, SIZE, 3), 5, config), PixelHParams(1e-2)
    state = jax.jit(model.init)(jax.random.key(0), hparams)

    def step(state, _):
        return model.update(state, episodes, jax.random.key(0), hparams)

    state, losses = jax.jit(lambda s: jax.lax.scan(step, s, length=150))(state)
    assert losses["frame_loss"][-1] < 0.35 * losses["frame_loss"][0]
    assert losses["reward_loss"][-1] < 0.6 * losses["reward_loss"][0]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), episodes)
    keys = jax.random.split(jax.random.key(1), flat.action.shape[0])
    predict = jax.jit(jax.vmap(model.predict, (None, 0, 0, 0)))
    seen = predict(state.params, flat.obs, flat.action, keys)
    wrong = (np.asarray(seen.next_obs) != flat.next_obs)[..., 9:].sum((1, 2, 3))
    assert wrong.mean() < {"local": 2, "coder": 4}[name]  # all black is wrong in five


def test_a_reward_is_laid_where_it_is_earned():
    """Five obstacles, one goal and one agent are always there: only sums are seen. The charge
    leaves the reward on the cells where it is earned.
    """
    head = LocalReward()
    generator = np.random.default_rng(0)
    cells = generator.integers(0, 6, (512, 3))
    cells = np.where(generator.random((512, 1)) < 0.4, cells[:, :1], cells)
    frames = np.eye(6, dtype=np.float32)[cells].transpose(0, 2, 1)[
        :, :, None
    ]  # [N, 6, 1, channels]
    reward = -5.0 * (cells[:, 0] == cells[:, 2]) + (cells[:, 1] == cells[:, 2])
    reward = reward.astype(np.float32)
    params = jax.jit(head.init)(jax.random.key(0), None, frames)
    optimizer = optax.adam(1e-2)

    def loss(params):
        earned, charge = head.apply(params, None, frames)
        return (jnp.square(earned - reward) + charge).mean()

    def step(carry, _):
        params, opt_state = carry
        updates, opt_state = optimizer.update(jax.grad(loss)(params), opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    (params, _), _ = jax.jit(
        lambda params: jax.lax.scan(step, (params, optimizer.init(params)), length=2000)
    )(params)
    lights = jnp.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1.0]])
    earned = jax.jit(head.apply)(params, None, lights[:, None, None])[0]
    np.testing.assert_allclose(earned, [0, 0, 0, -5, 1, -4], atol=0.4)


def test_a_class_of_rewards_by_hand():
    """A head that knows nothing is as far from every class, what it predicts is the first, and what
    lies between two classes is the nearest's.
    """
    head, features = ClassReward((-5.0, 0.0, 1.0), (1.0, 0.1, 2.0), ()), jnp.ones((4, 2, 3))
    params = jax.tree.map(jnp.zeros_like, head.init(jax.random.key(0), features, features))
    reward, odds = head.apply(params, features, features)
    truth = jnp.array([-5.0, -4.0, 0.0, 1.0])
    assert odds.shape == (4, 3) and (reward == -5).all()
    error = head.error(reward, odds, truth)
    np.testing.assert_allclose(error, np.array([1, 1, 0.1, 2]) * np.log(3), rtol=1e-6)
    sure = head.error(reward, jnp.array([[9.0, 0, 0]] * 4), truth)
    np.testing.assert_allclose(sure, [2.5e-4, 2.5e-4, 0.9, 18], rtol=0.02)
    bias = {"params": params["params"] | {"Dense_0": {"kernel": jnp.zeros((6, 3)),
                                                      "bias": jnp.array([0, 0, 1.0])}}}  # fmt: skip
    assert (head.apply(bias, features, features)[0] == 1).all()


@jax.jit
def class_loss():
    """The reward's loss of a frame model whose weights are zero, of a collision and a goal."""
    head = ClassReward((-5.0, 0.0, 1.0), (1.0, 1.0, 3.0), ())
    model = pixels((3, 3, 3), 5, PixelConfig(LocalDynamics(3, (2,)), reward=head))
    state = model.init(jax.random.key(0), PixelHParams())
    state = state.replace(params=jax.tree.map(jnp.zeros_like, state.params))
    stacks, no = jnp.zeros((2, 3, 3, 12), jnp.uint8), jnp.zeros(2, bool)
    steps = Transition(stacks, jnp.zeros(2, int), jnp.array([-5.0, 1.0]), stacks, no, no, ~no)
    return model.update(state, steps, jax.random.key(1), PixelHParams())[1]["reward_loss"]


def test_a_heads_own_loss_counts():
    np.testing.assert_allclose(class_loss(), 2 * np.log(3), rtol=1e-6)


def test_a_dreamed_maze_is_an_environment(episodes):
    model = make("local")
    world = LearnedEnvironment(ENV, model.predict, lambda key, start: start)
    params = LearnedParams(
        model.init(jax.random.key(0), PixelHParams()).params, episodes.obs[0, 9], max_steps=7
    )
    dreams = jax.jit(lambda key: rollout(world, act, key, params, 3))(jax.random.key(2))
    assert dreams.obs.shape == (3, 7, SIZE, SIZE, 12) and dreams.obs.dtype == jnp.uint8
    assert dreams.truncated[:, -1].all()


def test_the_end_is_learned():
    """A maze that ends on the goal: held-out ends are found, and others are not taken for one."""
    env, params = FrameStack(Maze(size=3, num_obstacles=1)), MazeParams(max_steps=12)

    @jax.jit
    def ending(key):
        played = rollout(env, act, key, params, 60)
        home = (played.next_obs[..., -2] & played.next_obs[..., -1]).any((-1, -2))
        before = jnp.cumsum(home, axis=1) - home == 0
        return played._replace(terminated=home & before, mask=before)

    model = pixels((3, 3, 3), 5, PixelConfig(LOCAL, terminates=True))
    state = jax.jit(model.init)(jax.random.key(0), PixelHParams(1e-2))
    seen = ending(jax.random.key(1))

    def step(state, _):
        return model.update(state, seen, jax.random.key(0), PixelHParams(1e-2))

    state, losses = jax.jit(lambda s: jax.lax.scan(step, s, length=150))(state)
    assert losses["end_loss"][-1] < 0.1 * losses["end_loss"][0]
    new = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ending(jax.random.key(2)))
    keys = jax.random.split(jax.random.key(3), new.action.shape[0])
    predict = jax.jit(jax.vmap(model.predict, (None, 0, 0, 0)))
    ends = predict(state.params, new.obs, new.action, keys)
    right = ((ends.terminated > 0.5) == new.terminated)[new.mask]
    assert new.terminated.sum() > 10 and right.mean() > 0.97


def test_clear_errors():
    with pytest.raises(ValueError, match="number of channels"):
        pixels((9, 9, 1), 5)
    with pytest.raises(ValueError, match="kernels that fit"):
        pixels((9, 9, 3), 5, PixelConfig(EncoderDecoder(3)))
    with pytest.raises(ValueError, match=r"threshold is 1\.5"):
        PixelConfig(threshold=1.5)
    with pytest.raises(ValueError, match="reward_weight"):
        PixelConfig(reward_weight=-1.0)
