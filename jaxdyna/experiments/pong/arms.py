"""The arms of learning to play, and what is judged of them. Dreams of all arms begin where those of
``dyna`` do and are as many and as long.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.agents import DQNConfig, dqn
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, DynaState, Metrics
from jaxdyna.envs import AtariParams, AtariPong, FrameStack, Pong
from jaxdyna.experiments.pong.colours import in_colours
from jaxdyna.experiments.pong.games import scores
from jaxdyna.experiments.pong.guided import guided
from jaxdyna.experiments.pong.options import TRUE_OBJECTS, PongOptions
from jaxdyna.experiments.pong.world import (
    OBJECTS,
    discriminating,
    game_of,
    our_model,
    paper_model,
)
from jaxdyna.experiments.study import arms as study
from jaxdyna.experiments.study.frames import frame_dyna
from jaxdyna.models import (
    AdversarialHParams,
    AdversaryConfig,
    PixelConfig,
    RectangleConfig,
    discriminator,
    pixels,
    rectangles,
)
from jaxdyna.networks import ConvolutionalQ, GlimpseQ, PlaceQ, SignedReward
from jaxdyna.rollout import rollout
from jaxdyna.types import Key, Transition

GREEDY_EPISODES = 20
SAID = study.SAID | {
    "dyna": "with fake episodes from our model: categories for the places of each object's edges, "
    "drawn in dreams.",
    "dyna_l2": "with the paper's: Fig. 4 on patches, squared error, in shades, the reward read off "
    "its joint features.",
    "dyna_adversarial": "`dyna_l2` with the adversarial loss beside it.",
    "placebo": "dreams in our model, never trained.",
    "oracle": "the same dreams in the true game, from a state read off the same frames; what they "
    "cannot tell is drawn.",
} | {
    name: f"`dyna_l2` whose dreams show {' and '.join(things)} as the true game has it, which runs "
    "beside; rewards are the model's."
    for name, things in TRUE_OBJECTS.items()
}  # fmt: skip


def arms(options: PongOptions) -> dict[str, study.Made]:
    """What makes each arm that can be had of this game."""
    game = game_of(options)
    agent = study.sized(options.agent, options.dyna)
    longest = options.dyna.dream_steps or options.steps  # and none ends before
    agent = replace(agent, network=network_of(options),
                    fake_episodes=agent.fake_capacity // longest)  # fmt: skip
    reward: Any = {"reward": SignedReward(), "reward_weight": options.reward_weight}
    blurred = paper_model(options, **reward)
    ours = our_model(options, options.weight_decay, draws=True)
    hparams, rate = options.hparams, options.paper_rate
    if options.game == "ale":
        hparams = replace(hparams, env=AtariParams(options.steps))
    theirs = replace(hparams, model=AdversarialHParams(rate, options.adversarial_weight, rate))
    hooks = study.Hooks(judge, show, piece=10, block=options.block)
    make = partial(partial, study.dyna_arm, hooks=hooks)
    dyna, l2 = parts(game, agent, ours), parts(game, agent, blurred)
    seen_through = parts(game, agent, blurred, discriminating(game.frame_shape[0]))
    made = study.standard_arms(
        dyna, options.dyna, hparams, guided(dyna, None) if options.readable else None, hooks,
        real_only=study.real_steps, busier=parts(game, study.busy(agent), ours).agent,
    )  # fmt: skip
    made |= {
        "dyna_l2": make(l2, options.dyna, theirs),
        "dyna_adversarial": make(seen_through, options.dyna, theirs),
    }
    for name, things in TRUE_OBJECTS.items() if options.readable else ():
        truth = guided(l2, tuple(OBJECTS[thing] for thing in things))
        made[name] = make(l2._replace(dream=truth), options.dyna, theirs)
    return made


def network_of(options: PongOptions) -> Any:
    """The agent's network."""
    actions = game_of(options).num_actions
    return {
        "places": PlaceQ(actions),
        "glimpses": GlimpseQ(actions, size=options.glimpse),
        "convolutions": ConvolutionalQ(actions),
    }[options.look]


@cache
def parts(
    game: Pong | AtariPong,
    agent: DQNConfig,
    model: PixelConfig | RectangleConfig,
    adversary: AdversaryConfig | None = None,
) -> Dyna:
    """The parts of an arm that dreams: one object, and so one program, for the same settings."""
    env, shape = FrameStack(game), game.frame_shape
    if isinstance(model, RectangleConfig):
        learned = in_colours(rectangles(shape, env.num_actions, model), game.palette)
    else:
        other = None if adversary is None else discriminator(shape, adversary)
        learned = pixels(shape, env.num_actions, model, adversary=other)
    return frame_dyna(env, dqn(shape, env.num_actions, agent), learned, points)


def points(real: Transition, begun: Any, params: Any) -> Metrics:
    """Points of either side in one real episode ``[1, T]``."""
    del begun, params
    reward = real.reward * real.mask
    return {"won": (reward > 0).sum(dtype=jnp.float32), "lost": (reward < 0).sum(dtype=jnp.float32)}


def judge(
    dyna: Dyna, config: DynaConfig, state: DynaState, key: Key, hparams: DynaHParams
) -> Metrics:
    """The final greedy policy: ``greedy_return`` ``[episodes]`` of new ones; of the real game
    ``game_score`` and ``game_ended`` ``[games]`` of whole ones.
    """
    key, key_games = jax.random.split(key)
    env: Any = dyna.env
    played = _greedy(dyna, config, state, key, hparams, GREEDY_EPISODES)
    kept = {"greedy_return": played.reward.sum(-1)}
    if isinstance(env.env, AtariPong):
        act = _actor(dyna, state, hparams)
        score, ended = scores(env, act, key_games, env.default_params)
        kept |= {"game_score": score, "game_ended": ended.astype(jnp.float32)}
    return kept


def show(
    dyna: Dyna, config: DynaConfig, state: DynaState, key: Key, hparams: DynaHParams
) -> Metrics:
    """``greedy``: the frames of one episode of it."""
    return {"greedy": _greedy(dyna, config, state, key, hparams, 1).next_obs[0, ..., -3:]}


def _greedy(dyna, config, state, key, hparams, episodes) -> Transition:
    act = _actor(dyna, state, hparams)
    return rollout(dyna.env, act, key, hparams.env, episodes, num_steps=config.num_steps)


def _actor(dyna, state, hparams) -> Any:
    greedy = study.greedy(hparams.agent)
    return lambda obs, key: dyna.agent.act(state.agent, obs, key, greedy)
