"""What outlives a run: its policy, and the world of its dreams.

Of a run's last state those leaves are kept that acting and dreaming read, so that no agent and no
model has to say which: weights are, optimisers and replays are not. Where dreams begin is drawn
beforehand.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from jaxdyna.envs import Drawn, ReplayedParams
from jaxdyna.experiments.engine.programs import optimised
from jaxdyna.experiments.engine.storage import read_arrays, write_arrays
from jaxdyna.rollout import rollout
from jaxdyna.trees import named, unlike, unnamed
from jaxdyna.types import Environment, Key

Arrays = Mapping[str, np.ndarray]
EPISODES, STARTS = 100, 256  #: in which a kept policy is judged; of kept dreams
#: where files are, and how the names of a run's arrays begin that go there
FOLDER, KEPT = "kept", "kept/"
#: what a kept policy earns, and what its run earned in each real episode
RETURN, REAL = WHOSE = "kept_return", "real_return"


class Trained(NamedTuple):
    """What a run has learned, and where."""

    #: ``(obs, key) -> action``, as it is evaluated: greedy where the agent can be
    policy: Callable[[jax.Array, Key], jax.Array]
    env: Environment  #: the true environment
    params: Any  #: its parameters
    num_steps: int  #: of an episode, at the most
    #: where fake episodes are played, such as a learned environment; None without
    dream: Environment | None = None
    dream_params: Any = None  #: its parameters, the model's weights among them


class Last(NamedTuple):
    """A run's last state, and ``(obs, state) [STARTS, ...]`` of its dreams, None without."""

    state: Any
    starts: Any


class Keeper:
    """Keeps what runs of a work have learned, plays it, and opens it again.

    Args:
        init: `Work.init`.
        trained: `Work.trained`.
        hparams: of one run; others are like them.
    """

    def __init__(self, init: Callable[..., Any], trained: Callable[..., Trained], hparams: Any):
        self.trained, self.key = trained, jax.eval_shape(jax.random.key, 0)
        self.like = jax.eval_shape(lambda: hparams)
        state = jax.eval_shape(init, self.key, self.like)
        self.shapes = jax.eval_shape(self._last, state, self.key, self.like)
        options = optimised(1, jax.devices()[0])
        self.play = jax.jit(self._played, static_argnums=3, compiler_options=options)

    def keep(self, state: Any, data: Any, key: Key, hparams: Any) -> dict[str, jax.Array]:
        """What is kept of a run that is over, as `Work.judge`."""
        leaves = named(self._last(state, jax.random.fold_in(key, 0), hparams))
        return {name: leaves[name] for name in self.names}

    def opened(self, kept: Arrays, hparams: Any) -> Trained:
        """What was kept, put together again; dreams begin in kept starts."""
        last = unnamed(jax.tree.map(jnp.asarray, dict(kept)), self.shapes)
        run = self.trained(last.state, hparams)
        if run.dream is None:
            return run
        params = ReplayedParams(run.dream_params, last.starts, run.dream_params.max_steps)
        return run._replace(dream=Drawn(run.dream), dream_params=params)

    def differs(self, kept: Arrays) -> str:
        """How that is not what would be kept today, in words; nothing where it is."""
        wanted = jax.eval_shape(self.keep, self.shapes.state, None, self.key, self.like)
        return unlike({name: kept[name] for name in wanted if name in kept}, wanted)

    @cached_property
    def names(self) -> list[str]:
        """Names of the leaves of `Last` that acting and dreaming read."""

        def step(last: Last, key: Key, hparams: Any) -> Any:
            run, keys = self.trained(last.state, hparams), jax.random.split(key, 3)
            obs, _ = run.env.reset(keys[0], run.params)
            action = run.policy(obs, keys[1])
            if run.dream is None:
                return action
            start = jax.tree.map(lambda leaf: leaf[0], last.starts)
            return start, run.dream.step(keys[2], start[1], action, run.dream_params)

        jaxpr = jax.make_jaxpr(step)(self.shapes, self.key, self.like).jaxpr
        _, read = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
        paths = [path for path, _ in jax.tree.leaves_with_path(self.shapes)]
        return [jax.tree_util.keystr(path) for path, is_ in zip(paths, read, strict=False) if is_]

    def _last(self, state: Any, key: Key, hparams: Any) -> Last:
        run = self.trained(state, hparams)
        reset = run.dream and jax.vmap(run.dream.reset, (0, None))
        return Last(state, reset and reset(jax.random.split(key, STARTS), run.dream_params))

    def _played(self, kept: Arrays, key: Key, hparams: Any, episodes: int) -> jax.Array:
        """Returns of the kept policy in new true episodes, ``[episodes]``; the same bits for the
        same arguments, in another process too.
        """
        run, key = self.opened(kept, hparams), jax.random.fold_in(key, 1)
        played = rollout(run.env, run.policy, key, run.params, episodes, num_steps=run.num_steps)
        return played.reward.sum(-1)


def told_of(kept: Arrays, returns: jax.Array) -> dict[str, Any]:
    """A run's curves of what is kept of it: by names that begin with `KEPT`, and `RETURN`."""
    earned = {RETURN: np.asarray(returns, np.float64).mean()}
    return {f"{KEPT}{name}": np.asarray(array) for name, array in kept.items()} | earned


def apart(run: Arrays) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What is kept of a run, and the rest of its curves."""
    kept = {name.removeprefix(KEPT): run[name] for name in run if name.startswith(KEPT)}
    return kept, {name: run[name] for name in run if not name.startswith(KEPT)}


def write(folder: Path, arm: str, seed: int, run: Arrays) -> dict[str, np.ndarray]:
    """Writes what is kept of a run into a file of its own below a record's folder, and returns the
    rest of its curves. `InputError` where it cannot be written.
    """
    kept, rest = apart(run)
    path = file_of(folder, arm, seed)
    if kept:
        with suppress(OSError):  # where it cannot be made, nor can the file
            path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, kept, compressed=True, whose=_whose(arm, seed, rest))
    return rest


def read(folder: Path, arm: str, seed: int, run: Arrays) -> Arrays:
    """What `write` wrote of a run with these curves, which may go on as NaN after its own end.
    `ValueError` where it is not there, damaged, or another run's.
    """
    return read_arrays(file_of(folder, arm, seed), whose=_whose(arm, seed, run))


def file_of(folder: Path, arm: str, seed: int) -> Path:
    """A run's file below a record's folder."""
    return folder / FOLDER / quote(arm, safe=" ,=@+()") / f"{seed}.npz"


def _whose(arm: str, seed: int, run: Arrays) -> str:
    """A hash of which run it is and what it earned: the same in shards, and by later settings."""
    earned = np.asarray(run[REAL], np.float32)
    said = json.dumps([arm, seed, float(run[RETURN])]).encode()
    return sha256(said + earned[np.isfinite(earned)].tobytes()).hexdigest()[:16]
