"""The arms of learning to play, and what is judged of them. Dreams of all arms begin where those of
``dyna`` do and are as many and as long. In some the true game runs beside the model and shows some
of what is seen, where the question is which object's error does the harm.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.agents import DQNConfig, dqn
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams, DynaState, Metrics
from jaxdyna.dyna.frames import draw_state, frame_dyna, true_dyna, with_states
from jaxdyna.envs import CHANNELS, FrameStack, Palette, Replayed, ReplayedParams, StackState
from jaxdyna.envs.atari import AtariParams
from jaxdyna.envs.pong_screen import in_channels, mixture_of, shares_of
from jaxdyna.experiments.pong import world
from jaxdyna.experiments.pong.options import TRUE_OBJECTS, PongOptions
from jaxdyna.experiments.pong.trained import given
from jaxdyna.experiments.study import arms as study
from jaxdyna.models import AdversarialHParams
from jaxdyna.models.evaluation import Predict
from jaxdyna.networks import ConvolutionalQ, FeaturePointQ, PlainQ, SignedReward
from jaxdyna.rollout import rollout
from jaxdyna.types import Environment, Key, Transition

GREEDY_EPISODES, GAMES = 20, 5
SAID = study.SAID | {
    "dyna": "with fake episodes from our model: categories for the places of each object's edges, "
    "drawn in dreams.",
    "dyna_l2": "with the paper's: Fig. 4 on patches, squared error, in shades, the reward read off "
    "its joint features.",
    "dyna_adversarial": "`dyna_l2` with the adversarial loss beside it.",
    "placebo": "dreams in our model, never trained.",
} | {
    name: f"`dyna_l2` whose dreams show {' and '.join(things)} as the true game has it, which runs "
    "beside; rewards are the model's."
    for name, things in TRUE_OBJECTS.items()}  # fmt: skip


def arms(options: PongOptions) -> dict[str, study.Made]:
    """What makes each arm that can be had of this game."""
    game = world.game_of(options)
    agent = replace(study.sized(options.agent, options.dyna), network=network_of(options, game))
    hparams, rate = options.hparams, options.paper_rate
    if options.game == "ale":
        hparams = replace(hparams, env=AtariParams(options.steps))
    theirs = replace(hparams, model=AdversarialHParams(rate, options.adversarial_weight, rate))
    ours = world.our_model(options, options.weight_decay, draws=True)
    blurred = world.paper_model(options, reward=SignedReward(), reward_weight=options.reward_weight)
    dyna, l2 = parts(game, agent, ours), parts(game, agent, blurred)
    opposed = parts(game, agent, blurred, True)

    def hooks(name: str, dyna: Dyna) -> study.Hooks:
        known = given(options, name, dyna.model)
        return study.Hooks(judge, piece=10, block=options.block, given=known)

    blurring = partial(study.dyna_arm, config=options.dyna, hparams=theirs, hooks=hooks("l2", l2))
    return study.standard_arms(
        dyna, options.dyna, hparams, true_dyna(dyna), hooks("ours", dyna),
        busier=parts(game, study.busy(agent, options.dyna), ours).agent,
    ) | {
        "dyna_l2": partial(blurring, l2),
        "dyna_adversarial": partial(blurring, opposed, hooks=hooks("adversarial", opposed)),
    } | {
        name: partial(blurring, guided(l2, true)) for name, true in TRUE_OBJECTS.items()
    }  # fmt: skip


def network_of(options: PongOptions, game: Any) -> Any:
    """The agent's: told where objects are if each has a channel, else it sees pixels alone."""
    if options.frames == "objects":
        return FeaturePointQ(game.num_actions)
    sizes = game.num_actions, options.convolutions, options.agent_dense
    plain = options.network == "plain"
    return PlainQ(*sizes, patch=world.PATCH) if plain else ConvolutionalQ(*sizes)


@cache
def parts(game: Any, agent: DQNConfig, model: Any, opposed: bool = False) -> Dyna:
    """The parts of an arm that dreams: one object, and so one program, for the same settings."""
    learner = dqn(game.frame_shape, game.num_actions, agent)
    return frame_dyna(FrameStack(game), learner, world.model_of(game, model, opposed), points)


def points(real: Transition, begun: Any, params: Any) -> Metrics:
    """Points of either side in one real episode ``[1, T]``."""
    reward = real.reward * real.mask
    return {"won": (reward > 0).sum(dtype=jnp.float32), "lost": (reward < 0).sum(dtype=jnp.float32)}


def judge(dyna: Dyna, config: DynaConfig, state: Any, key: Key, hparams: Any) -> Metrics:
    """Greedy: ``greedy_return [episodes]``; of the real game ``game_score [games]``, whole ones."""
    key, key_games = jax.random.split(key)
    env, act = dyna.env, study.greedy_policy(dyna, state, hparams)
    played = rollout(env, act, key, hparams.env, GREEDY_EPISODES, num_steps=config.num_steps)
    kept = {"greedy_return": played.reward.sum(-1)}
    if isinstance(hparams.env, AtariParams):
        kept["game_score"] = scores(env, act, key_games, env.default_params)
    return kept


def scores(env: Environment, act: Any, key: Key, env_params: Any, games: int = GAMES) -> jax.Array:
    """Points won less points lost ``[games]`` in whole games by ``(obs, key) -> action``, side by
    side until the last one is over: the emulator's limit is ten times as long.
    """

    def step(carry: Any) -> Any:
        obs, state, score, _, key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        obs, state, reward, ended, cut, _ = env.step(key_step, state, act(obs, key_act), env_params)
        return obs, state, score + reward, ended | cut, key

    def one(key_reset: Key, key: Key) -> jax.Array:
        start = (*env.reset(key_reset, env_params), jnp.float32(0), False, key)
        return jax.lax.while_loop(lambda now: ~now[3], step, start)[2]

    key_reset, key_games = jax.random.split(key)
    return jax.vmap(one)(jax.random.split(key_reset, games), jax.random.split(key_games, games))


@struct.dataclass
class GuidedParams(ReplayedParams):
    """The model's beside."""

    model: Any = None


@dataclass(frozen=True)
class Guided(Replayed):
    """A dream from any real stack of frames with the true game beside it."""

    predict: Predict | None = None  #: a model's ``predict``
    #: channels of each frame, seen an object a channel, that are the true game's
    truth: tuple[int, ...] = ()
    #: the colours in which it is seen. Where they are the game's own, a predicted pixel is taken
    #: for a mixture of the background and one object (`shares_of`).
    palette: Palette = CHANNELS

    def step(self, key: Key, state: StackState, action: jax.Array, params: Any) -> Any:
        """One step of both; the reward is the model's."""
        key_game, key_predict = jax.random.split(key)
        stack, new, _, *ends = super().step(key_game, state, action, params)
        assert self.predict is not None
        said = self.predict(params.model, state.obs, action, key_predict)
        true = in_channels(stack[..., -3:], self.palette) / 255
        believed = shares_of(said.next_obs[..., -3:], self.palette)
        mended = jnp.where(np.isin(np.arange(3), self.truth), true, believed)
        frame = jnp.round(mixture_of(mended, self.palette)).astype(stack.dtype)
        obs = jnp.concatenate([state.obs[..., 3:], frame], axis=-1)
        return obs, replace(new, obs=obs), said.reward, *ends


@cache
def guided(dyna: Dyna, things: tuple[str, ...]) -> Dyna:
    """Dreams of the same model with these of the true game's objects."""
    env, model = dyna.env, dyna.model
    palette: Palette = env.env.palette  # type: ignore[attr-defined]
    assert model is not None

    def params(state: DynaState, hparams: DynaHParams) -> GuidedParams:
        return GuidedParams(hparams.env, state.replay, hparams.env.max_steps, state.model.params)

    truth = tuple(world.OBJECTS[thing] for thing in things)
    dream = Guided(env, draw_state, model.predict, truth, palette)  # type: ignore[arg-type]
    return with_states(dyna)._replace(dream=Dream(dream, params))
