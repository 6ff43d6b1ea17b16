"""What the settings of learning to play Pong come to: the game, the agent, the models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from jaxdyna.agents import DQNConfig, dqn
from jaxdyna.dyna import DynaConfig
from jaxdyna.envs import AtariParams, AtariPong, GreyFrames, Pong, PongParams
from jaxdyna.experiments.pong_judge import OBJECTS
from jaxdyna.experiments.pong_options import PALETTES, config_of, game_of, params_of
from jaxdyna.experiments.pong_options import PAPER as PREDICTION
from jaxdyna.experiments.pong_options import Options as Frames
from jaxdyna.models import PixelConfig, RectangleConfig
from jaxdyna.networks import ConvolutionalQ, GlimpseQ, PlaceQ, SignedReward

TRUE_OBJECTS = {
    "true_ball": ("ball",),
    "true_own": ("own paddle",),
    "true_opponent": ("opponent",),
    "true_frames": tuple(OBJECTS),
}
MENDED = tuple(TRUE_OBJECTS)
NEED_STATE = ("oracle", *MENDED)
NEED_OBJECTS = ("dyna", "placebo")
DECIDED = ("points_to_win", "max_steps", "first_serve_delay", "serve_delay")

make_agent = cache(dqn)
"""One agent for the same settings."""


def check_sight(options: Any) -> None:
    """Whether the agent and the models can make something of the frames.

    Raises:
        ValueError: with what to change.
    """
    if options.frames == "objects":
        return
    if options.look != "convolutions":
        raise ValueError(
            f"--look {options.look} needs each object in a channel of its own: choose --look "
            f"convolutions, or leave out --frames {options.frames}"
        )
    blind = NEED_STATE if options.frames == "rgb" else NEED_STATE + NEED_OBJECTS
    named = [arm for arm in options.arms if arm in blind]
    if named:
        raise ValueError(
            f"--arms {' '.join(named)} cannot tell objects on {options.frames} frames: leave out, "
            f"or leave out --frames {options.frames}"
        )
    side = world_of(options).frame_shape[0]
    if side % options.patch:
        raise ValueError(f"--patch {options.patch} is no divisor of {side}, a frame's side")


def frames_of(options: Any) -> Frames:
    """What `pong_options` is to be told for the same game and models."""
    names = (
        "scale", "frame_skip", "steps", "serve_delay", "patch", "widths", "kernels", "dense",
        "hidden", "dropout",
    )  # fmt: skip
    same = {name: getattr(options, name) for name in names}
    if options.frames != "grey":
        same["frames"] = options.frames
    ours = replace(PREDICTION.ours, weight_decay=options.weight_decay)
    return replace(PREDICTION, **same, horizon=1, dreams=1, ours=ours)


def dyna_config(options: Any) -> DynaConfig:
    """The counts of a run."""
    return DynaConfig(
        num_episodes=options.episodes,
        num_real_first=options.real_first,
        num_steps=options.steps,
        model_updates=options.model_updates,
        model_batch=options.model_batch,
        dream_episodes=options.dream_episodes,
        dream_steps=options.dream_steps,
        rare_share=options.rare_share,
    )


def agent_config(options: Any) -> DQNConfig:
    """DQN's counts, with room for what this run can add to its replays and no more."""
    agent, fake = options.agent, options.dream_episodes * options.dream_steps
    actions = world_of(options).num_actions
    network: Any = {
        "places": PlaceQ(actions),
        "glimpses": GlimpseQ(actions, size=options.glimpse),
        "convolutions": ConvolutionalQ(actions),
    }[options.look]
    capacity = max(agent.fake_capacity, fake)
    return replace(
        agent,
        network=network,
        capacity=max(min(agent.capacity, options.episodes * options.steps), options.steps),
        episodes=min(agent.episodes, options.episodes),
        fake_capacity=capacity,
        fake_episodes=max(capacity // options.dream_steps, options.dream_episodes),
    )


def busier(agent: DQNConfig) -> DQNConfig:
    """Makes the updates after fake episodes after real ones as well (the arm ``more_updates``)."""
    return replace(agent, updates=agent.updates + agent.fake_updates)


def model_config(options: Any, model: str) -> PixelConfig | RectangleConfig:
    """The settings of a model of `pong_options.ModelName`, with a head for the reward."""
    config = config_of(frames_of(options), model, world_of(options).frame_shape[-1])
    if isinstance(config, RectangleConfig):
        return replace(config, draws=True)
    return replace(config, reward=SignedReward(), reward_weight=options.reward_weight)


def world_of(options: Any) -> Pong | AtariPong | GreyFrames:
    """The game that is played, and how it is seen."""
    if options.frames == "grey":
        whole = AtariPong if options.game == "ale" else Pong
        return GreyFrames(whole(options.frame_skip))
    if options.game == "ale":
        return AtariPong(options.frame_skip, options.scale, PALETTES[options.frames])
    return game_of(options)


def env_params(options: Any) -> PongParams | AtariParams:
    """The game's: episodes of so many steps, however many points; the rest as set."""
    if options.game == "ale":
        return AtariParams(options.steps)
    return params_of(options, options.hparams.env)


def check_env(options: Any) -> None:
    """Whether the game's own settings are possible and not decided by others.

    Raises:
        ValueError: with what to change.
    """
    given, default = options.hparams.env, PongParams()
    if options.game == "ale" and given != default:
        raise ValueError("--hparams.env is the pure game's: leave it out, or choose --game jax")
    for name in DECIDED:
        if getattr(given, name) != getattr(default, name):
            flag = name.replace("_", "-")
            raise ValueError(
                f"--hparams.env.{flag} is decided by --steps and --serve-delay: leave it out"
            )
    if given.opponent_speed < 0 or given.paddle_speed < 0:
        raise ValueError("--hparams.env: a speed must be at least 0")
    if given.opponent_rest < 1:
        raise ValueError("--hparams.env.opponent-rest must be at least 1")
    if not 0 <= given.repeat_action_probability <= 1:
        raise ValueError("--hparams.env.repeat-action-probability must lie between 0 and 1")
