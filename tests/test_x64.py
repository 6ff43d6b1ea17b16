"""Under x64, with 64 bits in all that is given, what a loop carries keeps its types."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import DYNA, MODEL, ORACLE, SMALL, hparams
from test_contract import AGENTS, FRAME_MODELS, MODELS, PLANNERS, learned, q_learner, small_episodes

from jaxdyna import rollout
from jaxdyna.agents import DQNHParams, LinearRegulatorHParams, LinearSearchHParams, ReinforceHParams
from jaxdyna.dyna import Expert, make_train
from jaxdyna.envs import Catch, CatchParams
from jaxdyna.losses import discounted_returns
from jaxdyna.models import AdversarialHParams, PixelHParams, SupervisedHParams
from jaxdyna.planners import Guide, rollout_value

pytestmark = pytest.mark.filterwarnings("error::FutureWarning")  # of what JAX will yet refuse


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def wide(tree):
    """With floats and signed integers of 64 bits, as NumPy and a user's world have them."""
    kinds = {"f": np.float64, "i": np.int64}
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda leaf: leaf.astype(kinds.get(leaf.dtype.kind, leaf.dtype)), arrays)


def types(tree):
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize("name", AGENTS | MODELS | FRAME_MODELS)
def test_learners(name):
    part, frames = (
        AGENTS[name]() if name in AGENTS
        else ((MODELS | FRAME_MODELS)[name], name in FRAME_MODELS)
    )  # fmt: skip
    kind = DQNHParams if "dqn" in name else ReinforceHParams if name in AGENTS else None
    kind = partial(LinearSearchHParams, 9.0) if name == "linear_search" else kind
    kind = LinearRegulatorHParams if name == "linear_regulator" else kind
    kind = kind or {"adversarial": AdversarialHParams, "local": PixelHParams}.get(name)
    settings, key = wide((kind or SupervisedHParams)()), jax.random.key(0)
    state, episodes = jax.eval_shape(part.init, key, settings), wide(small_episodes(frames))
    for update in ("update", "update_fake", "update_expert"):
        if learn := getattr(part, update, None):
            after, metrics = jax.eval_shape(learn, state, episodes, key, settings)
            assert types(after) == types(state), update
            assert all(jnp.issubdtype(each.dtype, jnp.floating) for each in metrics.values())
    if name not in AGENTS:
        obs = episodes.obs[0, 0]
        said = jax.eval_shape(part.predict, state.params, obs, episodes.action[0, 0], key)
        assert types(said.next_obs) == types(obs)


@pytest.mark.parametrize("name", PLANNERS)
def test_planners(name):
    if "muzero" in name:
        pytest.importorskip("mctx")
    key = jax.random.key(0)
    catch, (world, params) = Catch(rows=5, columns=3), learned()
    for env, given in ((catch, catch.default_params), (world, params)):
        obs, state = env.reset(jax.random.clone(key), given)
        value = rollout_value(env, given, 3, np.float64(0.9))
        for guide in (Guide(), Guide(lambda obs, n=env.num_actions: np.zeros(n), value)):
            plan = partial(PLANNERS[name](env), guide=guide)
            said = jax.eval_shape(plan, wide(given), wide(obs), state, key)
            assert said.action.dtype == jnp.int32 and said.value.dtype == jnp.float32


RUNS = {
    "reinforce": lambda: (DYNA, hparams()),
    "dqn": lambda: (DYNA._replace(agent=q_learner(False)[0]), hparams(agent=DQNHParams())),
    "oracle": lambda: (ORACLE, hparams()),
    "expert": lambda: (
        DYNA._replace(
            agent=AGENTS["cloned_reinforce"]()[0],
            expert=Expert(lambda state, obs, key, hparams: jnp.argmax(obs) % 2, 2),
        ),
        hparams(),
    ),
}


@pytest.mark.parametrize("name", RUNS)
def test_whole_runs(name):
    dyna, settings = RUNS[name]()
    state, metrics = jax.eval_shape(make_train(dyna, SMALL), jax.random.key(0), wide(settings))
    assert metrics["real_return"].shape == (SMALL.num_episodes,)
    own = state.agent.agent if name == "expert" else state.agent
    assert {leaf.dtype for leaf in jax.tree.leaves(own.params)} == {np.dtype("float32")}


def test_a_run_learns_from_numbers():
    """Not shapes alone: nothing on the way is NaN."""
    state, metrics = jax.jit(make_train(DYNA, SMALL))(jax.random.key(0), hparams())
    assert np.isfinite(metrics["real_return"]).all() and np.isfinite(metrics["agent_loss"]).all()
    predicted = MODEL.predict(state.model.params, jnp.zeros(4), jnp.int32(0), jax.random.key(1))
    assert np.isfinite(predicted.next_obs).all()


def test_returns_are_as_precise_as_what_they_are_made_of():
    assert discounted_returns(jnp.ones(3, jnp.float32), np.float64(0.5)).dtype == np.float64
    assert discounted_returns(jnp.ones(3, jnp.float32), 0.5).dtype == np.float32


def test_a_state_of_another_kind_is_still_refused():
    """A place that begins whole and becomes a fraction would be cut off without a word."""

    class Halves(Catch):
        def step(self, key, state, action, params):
            obs, state, *rest = super().step(key, state, action, params)
            return (obs, state.replace(paddle=state.paddle + 0.5), *rest)

    with pytest.raises(TypeError, match="carry"):
        rollout(Halves(), lambda obs, key: jnp.int32(0), jax.random.key(0), CatchParams(), 1)
