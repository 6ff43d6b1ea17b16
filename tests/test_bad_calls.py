"""Calls that cannot be meant, of every room of the package: each is refused where it is made, by
one line that says what to change.
"""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import AGENT, DYNA, ENV, LEARNED, MODEL, MODEL_FREE, SMALL, hparams, random_act

from jaxdyna import fields, losses, rollout, statistics, sweep, testing
from jaxdyna.agents import (
    CloningConfig,
    DQNConfig,
    DQNHParams,
    ReinforceConfig,
    ReinforceHParams,
    cloning,
    dqn,
    policy_logits,
    reinforce,
)
from jaxdyna.dyna import Dream, DynaConfig, make_init, make_train
from jaxdyna.envs import (
    CartPole,
    Catch,
    FrameStack,
    HostEnv,
    HostVectorEnv,
    Maze,
    MazeParams,
    Pong,
    Replayed,
    register,
)
from jaxdyna.envs.atari import AtariPong
from jaxdyna.models import (
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
from jaxdyna.networks import (
    MLP,
    ClassReward,
    Convolution,
    ConvolutionalQ,
    Discriminator,
    EncoderDecoder,
    FeaturePointQ,
    GlimpseQ,
    LocalDynamics,
    LocalReward,
    Patched,
    PerceptronQ,
    PlainQ,
    from_patches,
    glimpses,
    to_patches,
)
from jaxdyna.networks.convolution import convolve
from jaxdyna.planners import CrossEntropyConfig, SearchConfig, ShootingConfig, rollout_value
from jaxdyna.replay import frames as frame_replay, memory, ring
from jaxdyna.statistics import SolveRule
from jaxdyna.sweep import over_runs
from jaxdyna.types import Transition

PARAMS = ENV.default_params
FRAME = (8, 8, 3)
RULE = SolveRule(2, 1.0)
CURVE = np.ones((2, 4))
STACK, NO = jnp.zeros((8, 8, 12), jnp.uint8), jnp.bool_(False)
EXAMPLE = Transition(STACK, jnp.int32(0), jnp.float32(0), STACK, NO, NO, NO)
RING, BYTES = ring.init(2, jnp.zeros(4)), ring.init(2, jnp.zeros(4, jnp.uint8))
ONE, PATCH, KERNEL = jnp.ones(1, bool), jnp.zeros((1, 4, 4, 1)), jnp.zeros((3, 3, 1, 1))


def key():
    return jax.random.key(0)


def keys():
    return jax.random.split(key(), 2)


def play(env=ENV, act=random_act, params=PARAMS, episodes=1, **more):
    given = {"key": key(), "num_steps": 2, **more}
    return rollout(env, act, given.pop("key"), params, episodes, **given)


def begin(dyna, config=SMALL, key=key, **changes):
    """The check of a run's parts against each other: nothing is computed."""
    return jax.eval_shape(lambda: make_init(dyna, config)(key(), hparams(**changes)))


def run_of(dyna=DYNA, config=SMALL, **changes):
    return sweep(make_train(dyna, config), keys(), hparams(**changes))


def grown(x, hparams):
    return x


def host():
    env = HostEnv(Catch(rows=4))
    env.reset(seed=0)
    return env


def hosts():
    envs = HostVectorEnv(Catch(rows=4), num_envs=2)
    envs.reset(seed=0)
    return envs


def of_actions(count):
    return DYNA._replace(agent=reinforce((4,), count))


def configs(kind, **wrong):
    """A row for each setting of a configuration."""
    name = kind.__name__
    return {
        f"{name}({setting}={value!r})": (partial(kind, **{setting: value}), setting)
        for setting, values in wrong.items()
        for value in values
    }


BAD = {
    # settings
    **configs(
        DynaConfig, num_episodes=(2.5, True, 0, "3"), num_real_first=(-1, None), num_steps=(0,),
        model_updates=(-1,), model_batch=(0,), dream_updates=(1.5,), dream_episodes=(0,),
        dream_steps=(0,), replay_capacity=(3,), rare_share=(1.5, math.nan),
    ),
    **configs(
        DQNConfig, batch=(2.5, 0), updates=(math.inf, -1), n_step=(0, 10**6), target_period=(0,),
        capacity=(0,), episodes=(0,), drift=(-1, math.nan), double=(1,), optimizer=("adam", 0.1),
        network=(GlimpseQ,), updates_per_step=(-1, math.nan), reset_every=(-1, 1.5),
    ),
    **configs(ReinforceConfig, hidden=((0,), 8, (8.5,)), advantage=("mean", None)),
    **configs(ReinforceConfig, output_variance=(0,), epochs=(0,)),
    **configs(CloningConfig, updates=(0,), batch=(0,), learning_rate=(0, math.nan), loss=("l2",)),
    **configs(
        Maze, size=(4.5, 1), num_obstacles=(1.5, -1, 255), start=((16, 0), (0, 15), (1,)),
        goal=((-1, 0),),
    ),
    **configs(Catch, rows=(1, 2.5), columns=(0,), frames=("yes",)),
    **configs(Pong, frame_skip=(2.5, 0), scale=(3, 0)),
    **configs(AtariPong, frame_skip=(0,), scale=(7,)),
    **configs(
        SupervisedConfig, hidden=((0,), [8]), ensemble=(0,), spread=(0,), weight_variance=(0,),
    ),
    **configs(
        PixelConfig, threshold=(1.0,), loss=("l3",), reward_weight=(-1,), network=(LocalDynamics,),
        reward=(LocalReward,),
    ),
    **configs(RectangleConfig, dropout=(1,), hidden=((0,),), groups=((), ((-1,),)), rewards=((),)),
    **configs(
        ShootingConfig, horizon=(0,), candidates=(0,), discount=(1.1,), particles=(0,),
        temperature=(math.nan,),
    ),
    **configs(CrossEntropyConfig, elites=(65, 0), iterations=(0,), floor=(0,)),
    **configs(SearchConfig, simulations=(0,), max_depth=(0,), considered=(0,), discount=(-1,)),
    **{
        f"SolveRule({window}, {threshold})": (partial(SolveRule, window, threshold), name)
        for window, threshold, name in (
            (-1, 1.0, "window"), (2.5, 1.0, "window"), (1, math.nan, "threshold"),
            (1, math.inf, "threshold"), (1, None, "threshold"),
        )
    },
    # environments
    "reset with a legacy key": (lambda: play(key=jax.random.PRNGKey(0)), "jax.random.key"),
    "FrameStack of no frames": (lambda: FrameStack(Maze(4), 0), "num_frames"),
    "FrameStack of a class": (lambda: FrameStack(Maze), "env"),
    "Replayed of a class": (lambda: Replayed(Maze, lambda key, start: start), "env"),
    "Replayed without a function": (lambda: Replayed(ENV, None), "draw"),
    "LearnedEnvironment without functions": (lambda: replace(LEARNED, predict=None), "predict"),
    "LearnedEnvironment of a class": (lambda: replace(LEARNED, real=CartPole), "real"),
    "uniform_start(1, -1)": (lambda: uniform_start(1, -1), "low"),
    "uniform_start(0, nan)": (lambda: uniform_start(0, math.nan), "high"),
    # rollout
    "rollout of no episodes": (lambda: play(episodes=0), "num_episodes is 0"),
    "rollout of half an episode": (lambda: play(episodes=2.5), "num_episodes"),
    "rollout of True episodes": (lambda: play(episodes=True), "num_episodes"),
    "rollout of no steps": (lambda: play(num_steps=0), "num_steps is 0"),
    "rollout of half a step": (lambda: play(num_steps=2.5), "num_steps"),
    "rollout with an int for a key": (lambda: play(key=0), "jax.random.key"),
    "rollout with many keys": (lambda: play(key=keys()), "key"),
    "rollout without params": (lambda: play(params=None, num_steps=None), "CartPoleParams"),
    "rollout with no such params": (lambda: play(params=MazeParams()), "params"),
    "rollout with impossible params": (lambda: play(params=PARAMS.replace(length=-1.0)), "length"),
    "rollout to max_steps 0": (
        lambda: play(params=PARAMS.replace(max_steps=0), num_steps=None), "max_steps"),
    "rollout of a class": (lambda: play(CartPole), "CartPole"),
    "rollout with an agent for act": (lambda: play(act=AGENT), "act"),
    "rollout with an action of floats": (lambda: play(act=lambda obs, key: 0.5), "type"),
    "rollout with an action out of range": (lambda: play(act=lambda obs, key: 7), "within 0 to 1"),
    "rollout with a negative action": (lambda: play(act=lambda obs, key: -1), "within 0 to 1"),
    "rollout with an action drawn out of range": (
        lambda: play(act=lambda obs, key: jax.random.randint(key, (), 3, 5)), "within 0 to 1"),
    "rollout with several actions": (
        lambda: play(act=lambda obs, key: jnp.zeros(3, int)), "scalar"),
    # sweep
    "sweep of no settings": (lambda: sweep(grown, keys(), jnp.zeros(0)), "setting"),
    "sweep of no keys": (lambda: sweep(grown, keys()[:0], 1.0), "keys"),
    "sweep of a single key": (lambda: sweep(grown, key(), 1.0), "keys"),
    "sweep of legacy keys": (lambda: sweep(grown, jax.random.PRNGKey(0), 1.0), "jax.random.key"),
    "sweep of ints": (lambda: sweep(grown, [0, 1], 1.0), "jax.random.key"),
    "sweep of a 2-d leaf": (lambda: sweep(grown, keys(), jnp.zeros((2, 3))), "one value"),
    "sweep of unequal leaves": (
        lambda: sweep(grown, keys(), (jnp.ones(2), jnp.ones(3))), "lengths"),
    "sweep of a list": (lambda: run_of(agent=ReinforceHParams([0.1, 0.2])), "learning_rate"),
    "sweep in blocks of 0": (lambda: sweep(grown, keys(), 1.0, block=0), "block"),
    "sweep in blocks of 1.5": (lambda: sweep(grown, keys(), 1.0, block=1.5), "block"),
    "sweep over an impossible value": (
        lambda: run_of(agent=ReinforceHParams(discount=jnp.array([0.5, 1.5]))), "discount"),
    "sweep over NaN": (lambda: run_of(real_weight=jnp.array([jnp.nan])), "real_weight"),
    "over_runs of no runs": (lambda: over_runs(grown, 0), "size"),
    # the parts of a run against each other
    "an agent with 3 actions on CartPole": (
        lambda: make_train(of_actions(3), SMALL), "3 actions.* 2"),
    "a model of 5 actions of CartPole": (
        lambda: make_train(DYNA._replace(model=supervised(4, 5)), SMALL), "5 actions.* 2"),
    "a dream in Catch": (
        lambda: make_train(DYNA._replace(dream=Dream(Catch(), None)), SMALL), "3 actions.* 2"),
    "more real episodes first than there are": (
        lambda: make_train(DYNA, replace(SMALL, num_real_first=7)), "num_real_first"),
    "a dream without a model": (lambda: begin(DYNA._replace(model=None, diagnose=None)), "model"),
    "a dream from starts without a memory": (lambda: begin(DYNA._replace(memory=None)), "memory"),
    "a dream of other observations": (
        lambda: begin(DYNA._replace(dream=Dream(Blind(), lambda *given: None))), "begin with"),
    "a model without a memory": (
        lambda: begin(DYNA._replace(memory=None, dream=None)), "memory"),
    "an agent of other observations": (
        lambda: begin(MODEL_FREE._replace(agent=reinforce((3,), 2))), "observations"),
    "an agent of other observations, which dreams": (
        lambda: begin(DYNA._replace(agent=reinforce((3,), 2))), "the agent does not take"),
    "an agent of frames": (
        lambda: begin(MODEL_FREE._replace(agent=dqn(FRAME, 2)), agent=DQNHParams()), "observ"),
    "a model of other observations": (
        lambda: begin(DYNA._replace(model=supervised(3, 2))), "model"),
    "a model of frames": (
        lambda: begin(DYNA._replace(model=pixels(FRAME, 2)), model=PixelHParams()), "model"),
    "hparams of DQN for REINFORCE": (
        lambda: begin(MODEL_FREE, agent=DQNHParams()), "ReinforceHParams"),
    "hparams of REINFORCE for DQN": (
        lambda: begin(MODEL_FREE._replace(agent=dqn((4,), 2))), "DQNHParams"),
    "no hparams for the agent": (lambda: begin(MODEL_FREE, agent=None), "ReinforceHParams"),
    "hparams of the agent for the model": (
        lambda: begin(DYNA, model=ReinforceHParams()), "SupervisedHParams"),
    "params of another world": (lambda: begin(MODEL_FREE, env=MazeParams(max_steps=20)), "env"),
    "no params of the world": (lambda: begin(MODEL_FREE, env=None), "env"),
    "no hparams at all": (lambda: make_init(MODEL_FREE, SMALL)(key(), None), "DynaHParams"),
    "hparams of the agent alone": (
        lambda: make_init(MODEL_FREE, SMALL)(key(), ReinforceHParams()), "DynaHParams"),
    "an impossible learning rate": (
        lambda: begin(DYNA, agent=ReinforceHParams(-1.0)), "learning_rate"),
    "an impossible weight": (lambda: begin(DYNA, fake_weight=-1.0), "fake_weight"),
    "an impossible mass": (
        lambda: begin(DYNA, env=PARAMS.replace(masscart=0.0, max_steps=20)), "masscart"),
    "episodes longer than num_steps": (
        lambda: begin(DYNA, env=PARAMS.replace(max_steps=500)), "num_steps"),
    "swept episodes longer than num_steps": (
        lambda: run_of(env=PARAMS.replace(max_steps=jnp.array([10, 500]))), "num_steps"),
    "a run with a legacy key": (
        lambda: begin(DYNA, key=lambda: jax.random.PRNGKey(0)), "jax.random.key"),
    "an environment for the agent": (lambda: make_train(DYNA._replace(agent=ENV), SMALL), "agent"),
    "a class for the environment": (lambda: make_train(DYNA._replace(env=CartPole), SMALL), "env"),
    # agents and models
    "reinforce of no actions": (lambda: reinforce((4,), 0), "num_actions"),
    "reinforce of half an action": (lambda: reinforce((4,), 2.5), "num_actions"),
    "reinforce of a number": (lambda: reinforce(4, 2), "obs_shape"),
    "reinforce of nothing": (lambda: reinforce((0,), 2), "obs_shape"),
    "policy_logits of no actions": (lambda: policy_logits(0, ReinforceConfig()), "num_actions"),
    "dqn of no actions": (lambda: dqn(FRAME, 0), "num_actions"),
    "dqn of True actions": (lambda: dqn(FRAME, True), "num_actions"),
    "dqn of a 2-d frame": (lambda: dqn((8, 8), 2), "frame_shape"),
    "dqn of half a pixel": (lambda: dqn((8.5, 8, 3), 2), "frame_shape"),
    "dqn of a number": (lambda: dqn(4, 2), "frame_shape"),
    "dqn of no frames": (lambda: dqn(FRAME, 2, num_frames=0), "num_frames"),
    "dqn with a network of other actions": (
        lambda: dqn(FRAME, 2, DQNConfig(network=GlimpseQ(5))), "network.* 2 values"),
    "dqn with a network of vectors": (
        lambda: dqn((8,), 2, DQNConfig(network=GlimpseQ(2))), "network"),
    "dqn with a glimpse of no middle": (
        lambda: dqn(FRAME, 2, DQNConfig(network=GlimpseQ(2, size=4))), "odd"),
    "dqn with a number for a network": (lambda: dqn(FRAME, 2, DQNConfig(network=5)), "network"),
    "dqn with a name for a network": (
        lambda: dqn(FRAME, 2, DQNConfig(network="glimpse")), "network"),
    "pixels without a network": (lambda: pixels(FRAME, 2, PixelConfig(network=None)), "NoneType"),
    "pixels with a name for a head": (
        lambda: pixels(FRAME, 2, PixelConfig(reward="local")), "pictures"),
    "cloning without an agent": (lambda: cloning(None, None, None, CloningConfig()), "agent"),
    "supervised of no variables": (lambda: supervised(0, 2), "obs_size"),
    "supervised of a shape": (lambda: supervised((4,), 2), "obs_size"),
    "supervised of no actions": (lambda: supervised(4, 0), "num_actions"),
    "pixels of a 2-d frame": (lambda: pixels((8, 8), 2), "frame_shape"),
    "pixels of no actions": (lambda: pixels(FRAME, 0), "num_actions"),
    "pixels of no frames": (lambda: pixels(FRAME, 2, num_frames=0), "num_frames"),
    "pixels of other channels": (lambda: pixels((8, 8, 1), 2), "channels"),
    "pixels of too small a frame": (
        lambda: pixels((4, 4, 3), 2, PixelConfig(EncoderDecoder(3))), "kernels"),
    "rectangles of a 2-d frame": (lambda: rectangles((8, 8), 2, RectangleConfig()), "frame_shape"),
    "rectangles of no actions": (lambda: rectangles(FRAME, 0, RectangleConfig()), "num_actions"),
    "rectangles of other channels": (lambda: rectangles((8, 8, 2), 2, RectangleConfig()), "groups"),
    "discriminator of a 2-d frame": (lambda: discriminator((8, 8)), "frame_shape"),
    # networks
    **{
        f"{network.__name__}({given})": (partial(network, *given), word)
        for network, given, word in (
            (MLP, ((),), "features"), (MLP, ((0,),), "features"), (MLP, (8,), "features"),
            (Convolution, (0, 3, 1), "features"), (Convolution, (8, 3, -1), "padding"),
            (ConvolutionalQ, (0,), "num_actions"),
            (ConvolutionalQ, (2, ()), "widths"), (ConvolutionalQ, (2, (8, 0, 8)), "widths"),
            (GlimpseQ, (2.5,), "num_actions"), (GlimpseQ, (2, 0), "heads"),
            (PlainQ, (2, (8, 0)), "widths"), (ClassReward, ((0.0,), (1.0,), (0,)), "hidden"),
            (PerceptronQ, (0,), "num_actions"), (PerceptronQ, (2, (8, -1)), "hidden"),
            (FeaturePointQ, (2, 0), "channels"), (LocalDynamics, (0,), "channels"),
            (LocalDynamics, (3, (0,)), "widths"), (LocalReward, (0,), "width"),
            (EncoderDecoder, (3, ()), "widths"),
            (Discriminator, ((0,), (8,)), "strides"),
            (Patched, (LocalDynamics(3), 0), "size"),
        )
    },
    "to_patches that do not fit": (lambda: to_patches(jnp.zeros((9, 8, 3)), 4), "patches"),
    "from_patches that are none": (lambda: from_patches(jnp.zeros((2, 2, 10)), 4), "patches"),
    "glimpses of no size": (
        lambda: glimpses(PATCH, jnp.zeros((1, 4, 1)), jnp.zeros((1, 4, 1)), 4), "odd"),
    "convolve with too much padding": (
        lambda: convolve(PATCH, KERNEL, 3), "padding"),
    "convolve with a negative padding": (
        lambda: convolve(PATCH, KERNEL, -1), "padding"),
    # replay
    "ring of no capacity": (lambda: ring.init(0, jnp.zeros(4)), "capacity"),
    "ring of half a capacity": (lambda: ring.init(2.5, jnp.zeros(4)), "capacity"),
    "ring given too much": (
        lambda: ring.add(RING, jnp.zeros((3, 4)), jnp.ones(3, bool)), "capacity"),
    "ring given a float mask": (
        lambda: ring.add(RING, jnp.zeros((1, 4)), jnp.ones(1)), "type"),
    "ring given another shape": (
        lambda: ring.add(RING, jnp.zeros((1, 3)), ONE), "example"),
    "ring given floats for bytes": (
        lambda: ring.add(BYTES, jnp.zeros((1, 4)), ONE), "bytes"),
    "sample of an empty ring": (
        lambda: ring.sample(RING, key(), (2,)), "empty"),
    "draw of weights of another length": (
        lambda: ring.draw_positions(RING, key(), (), jnp.ones(3)), "weight is"),
    "frames of no episodes": (lambda: frame_replay.init(8, 0, EXAMPLE), "episode"),
    "frames of less than a stack": (lambda: frame_replay.init(3, 2, EXAMPLE), "stack"),
    "frames that do not divide": (lambda: frame_replay.init(8, 2, EXAMPLE, 5), "channels"),
    "frames of half a capacity": (lambda: frame_replay.init(8.5, 2, EXAMPLE), "capacity"),
    "forgetting every 0 episodes": (lambda: memory.forgetting(memory.transitions(), 0), "every"),
    # statistics
    "holm of a table": (lambda: statistics.holm(CURVE), "p_values"),
    "holm of an unknown p": (lambda: statistics.holm([0.1, math.nan]), "p_values"),
    "summarise([])": (lambda: statistics.summarise([]), "run"),
    "summarise of a table": (lambda: statistics.summarise(CURVE), "seeds"),
    "running_mean of no window": (lambda: statistics.running_mean(CURVE, 0), "window"),
    "last_mean of half a window": (lambda: statistics.last_mean(CURVE, 1.5), "window"),
    # losses
    "discounted_returns of episodes": (
        lambda: losses.discounted_returns(jnp.zeros((2, 3)), 0.9), "rank"),
    "standardise by a float mask": (lambda: losses.standardise(jnp.zeros(2), jnp.ones(2)), "type"),
    "standardise by another mask": (
        lambda: losses.standardise(jnp.zeros(2), jnp.ones(3, bool)), "shape"),
    "policy_gradient of float actions": (
        lambda: losses.policy_gradient(jnp.zeros((2, 3)), *[jnp.zeros(2)] * 3), "type"),
    "td_error of unequal values": (
        lambda: losses.td_error(jnp.zeros(2), 0, 0.0, 1.0, jnp.zeros(3), jnp.zeros(3)), "shape"),
    "transition_loss of unequal states": (
        lambda: losses.transition_loss(jnp.zeros(2), 0.0, 0.0, jnp.zeros(3), 0.0, 0.0), "shape"),
    "discern of unequal batches": (lambda: losses.discern(jnp.zeros(2), jnp.zeros(3)), "shape"),
    # planners
    "rollout_value of no steps": (lambda: rollout_value(ENV, PARAMS, 0), "num_steps"),
    # settings by name
    "changed by a wrong name": (lambda: fields.changed(SMALL, {"num_episode": 3}), "num_episodes"),
    "changed to a wrong value": (
        lambda: fields.changed(SMALL, {"num_episodes": 0}), "num_episodes"),
    "value_at a wrong name": (lambda: fields.value_at(SMALL, "steps"), "name of no setting"),
    "restored from a wrong name": (
        lambda: fields.restored(SMALL, {"steps": 3}), "name of no setting"),
    "check of no settings": (lambda: fields.check({"num_steps": 3}), "dataclass"),
    # testing
    "check_environment of a class": (lambda: testing.check_environment(CartPole), "CartPole"),
    "check_agent of an environment": (
        lambda: testing.check_agent(ENV, None, EXAMPLE, 2), "CartPole.* init"),
    "check_agent on no episodes": (
        lambda: testing.check_agent(AGENT, ReinforceHParams(), EXAMPLE, 2), "episodes"),
    "check_model of an agent": (
        lambda: testing.check_model(AGENT, None, EXAMPLE), "Agent.* predict"),
    "check_model on no episodes": (
        lambda: testing.check_model(MODEL, SupervisedHParams(), EXAMPLE), "episodes"),
    "check_planner of nothing": (lambda: testing.check_planner(None, ENV, PARAMS), "planner"),
    # the bridge to Gymnasium
    "HostEnv of a class": (lambda: HostEnv(CartPole), "CartPole"),
    "HostEnv to be shown to people": (lambda: HostEnv(ENV, render_mode="human"), "render_mode"),
    "HostEnv with no such params": (lambda: HostEnv(ENV, MazeParams()), "params"),
    "HostEnv with impossible params": (
        lambda: HostEnv(ENV, PARAMS.replace(max_steps=0)), "max_steps"),
    "a step before a reset": (lambda: HostEnv(ENV).step(0), "reset"),
    "an action out of the space": (lambda: host().step(3), "action"),
    "an action of floats": (lambda: host().step(0.5), "action"),
    "no environments": (lambda: HostVectorEnv(ENV, num_envs=0), "num_envs"),
    "half an environment": (lambda: HostVectorEnv(ENV, num_envs=1.5), "num_envs"),
    "actions of fewer environments": (lambda: hosts().step([0]), "action"),
    "register a class": (lambda: register("jaxdyna/Mine-v0", CartPole, PARAMS), "CartPole"),
}  # fmt: skip


class Blind(CartPole):
    """Seen otherwise."""

    def reset(self, key, params):
        obs, state = super().reset(key, PARAMS)
        return obs[:3], state


@pytest.mark.parametrize("call", BAD)
def test_it_is_refused(call):
    bad, word = BAD[call]
    with pytest.raises((ValueError, TypeError, AssertionError), match=word) as caught:
        bad()
    assert "\n" not in str(caught.value)
