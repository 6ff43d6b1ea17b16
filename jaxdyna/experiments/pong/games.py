"""Whole games of the real Pong by final policies, beside what the literature has after as many
steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.tables import markdown_table, with_interval
from jaxdyna.types import Environment, Key

GAMES = 5
ANCHORS = {"SimPLe": 12.8, "IRIS": 14.6, "DIAMOND": 20.4, "DreamerV3": -5.0}
"""Mean score of a game after 100,000 of the agent's steps, in the repositories' own files."""
ANCHOR_STEPS = 100_000


def scores(
    env: Environment,
    act: Callable[[jax.Array, Key], jax.Array],
    key: Key,
    env_params: Any,
    games: int = GAMES,
) -> tuple[jax.Array, jax.Array]:
    """Points won less points lost of whole games, and whether they were played to their end, both
    ``[games]``; they are played side by side until the last one is over.

    Args:
        env: the game.
        act: ``(obs, key) -> action``.
        key: random key.
        env_params: the game's; ``max_steps`` cuts a game that does not end.
        games: how many.
    """
    key_reset, key_games = jax.random.split(key)
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(key_reset, games), env_params)

    def one(key, obs, state):
        key_act, key_step = jax.random.split(key)
        return env.step(key_step, state, act(obs, key_act), env_params)

    def step(carry):
        obs, state, score, over, ended, key = carry
        key, key_now = jax.random.split(key)
        keys = jax.random.split(key_now, games)
        obs, state, reward, terminated, truncated, _ = jax.vmap(one)(keys, obs, state)
        score = score + jnp.where(over, 0, reward)
        ended = ended | (~over & terminated)
        return obs, state, score, over | terminated | truncated, ended, key

    none = jnp.zeros(games, bool)
    start = (obs, state, jnp.zeros(games), none, none, key_games)
    _, _, score, _, ended, _ = jax.lax.while_loop(lambda carry: ~carry[3].all(), step, start)
    return score, ended


def games_said(record: Any) -> str:
    """The section of the report; nothing where no whole games were played."""
    played = {name: arm for name, arm in record.results["arms"].items() if "game_score" in arm}
    if not played:
        return ""
    rows = []
    for name, arm in played.items():
        cut = f"{1 - np.mean(arm['game_ended']['per_seed']):.0%}"
        rows.append([name, f"{arm['real_steps']:,.0f}", with_interval(arm["game_score"], 1), cut])
    rows += [[name, f"{ANCHOR_STEPS:,}", f"{score:.1f}", "-"] for name, score in ANCHORS.items()]
    return paragraphs(
        "## Whole games",
        f"Greedy, {GAMES} games to 21 points a run: points won less points lost, mean over runs "
        "and 95% interval; a game of half an hour is broken off, at its score. The literature's "
        "figures are those of its own repositories; its agents "
        "see grey or coloured pixels, ours a channel for each object's colour.",
        markdown_table(["policy", "real steps a run", "score of a game", "broken off"], rows),
    )
