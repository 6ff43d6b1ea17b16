"""Gymnasium's worlds as environments: the bridge's other direction.

Episodes are played on the host, by one call for a whole batch. What is threaded through a program
holds no world but the name of where its episode stands: a digest of the seed and of all that has
happened since. The host keeps the worlds by these names. So the same state and action give the same
answer, whoever asks in whatever order, and equal episodes (of a swept setting) may change places.
"""

import threading
import weakref
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import blake2b
from struct import Struct
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import TransformAction, TransformObservation

from jaxdyna.actions import actions_in
from jaxdyna.fields import check_counts, setting
from jaxdyna.trees import anywhere, where
from jaxdyna.types import Key, Stepped

Make = str | Callable[[], gymnasium.Env | VectorEnv]
"""An id for ``gymnasium.make``, or what makes an environment or a vector of them."""
UNLIMITED = 1000  #: steps of an episode of a world that says no limit of its own
ANSWER = Struct("<8sfII")
"""The name of where an episode stands, the reward, whether it terminated, whether it was truncated.
"""
WRAP = "give a function that makes it with a wrapper around it, such as gymnasium.wrappers."


def from_gymnasium(make: Make, num_envs: int) -> "Hosted":
    """A Gymnasium world as a `jaxdyna.types.Environment`; `ValueError` where there is no such
    world, or its spaces are others.

    An episode begins with ``reset(seed=f(key))`` and so depends on its own key alone: where the
    world is deterministic by its seed, a resumed run equals the uninterrupted one (checkpoints lie
    between episodes), and `jaxdyna.testing.check_environment` passes; of another world it says that
    reset or step differs. Such a world can be played, but no run of it can be had again. A state
    cannot be restored once the world has gone on: dreams cannot begin in it, there is no oracle.

    Lanes of a `VectorEnv` are begun together, with a seed each, whatever its autoreset mode, and
    played together; one whose episode is over is left alone until the last of them is.

    Args:
        make: an id, or a callable that returns an ``Env`` or a ``VectorEnv``. Observations are
            vectors, or frames of bytes ``[height, width, channels]``; actions are discrete, or
            vectors in a bounded Box, to which they are clipped.
        num_envs: episodes that are played at a time, at the most; worlds are made as they are
            needed. Of runs that are computed together: of all of them.
    """
    check_counts(num_envs=num_envs)
    env = Hosted(make, num_envs)
    env.host.first.reset([0])  # where its lanes cannot be begun so, it is refused here
    return env


@struct.dataclass
class HostedParams:
    """What can be swept."""

    max_steps: int = setting(
        UNLIMITED, "Steps until truncation; what the world itself cuts off is truncated too.",
        at_least=1)  # fmt: skip


@struct.dataclass
class HostedState:
    """Where an episode stands."""

    name: jax.Array  #: uint32 ``[2]``, by which the host knows it
    time: jax.Array  #: int32, steps taken
    obs: jax.Array  #: what was seen last
    terminated: jax.Array  #: whether the world has ended
    truncated: jax.Array  #: whether it was broken off


@dataclass(frozen=True)
class Hosted:
    """What `from_gymnasium` returns."""

    make: Make
    num_envs: int

    @cached_property
    def host(self) -> "Host":
        """The worlds."""
        return Host(self.make, self.num_envs)

    @property
    def default_params(self) -> HostedParams:
        """With the world's own time limit, or without one `UNLIMITED`."""
        return HostedParams(getattr(self.host.first.spec, "max_episode_steps", None) or UNLIMITED)

    @property
    def num_actions(self) -> int:
        """The number of discrete actions; the first is 0, whatever the world calls it."""
        return int(self.host.first.actions.n)

    def action_space(self, params: HostedParams) -> spaces.Space:
        """The world's; of discrete actions the first is 0."""
        given = self.host.first.actions
        return spaces.Discrete(given.n) if isinstance(given, spaces.Discrete) else given

    @property
    def reward_threshold(self) -> float | None:
        """The mean return at which Gymnasium calls it solved; None where it does not say."""
        return getattr(self.host.first.spec, "reward_threshold", None)

    def observation_space(self, params: HostedParams) -> spaces.Box:
        """The world's; of vectors float32."""
        return self.host.first.space

    def drawn(self) -> gymnasium.Env:
        """A world, seen and acted in as here, that draws for people; `ValueError` if it cannot."""
        make: Any = partial(gymnasium.make, self.make) if isinstance(self.make, str) else self.make
        try:
            env = make(render_mode="rgb_array")
            env.reset(seed=0)
            env.render()
        except (gymnasium.error.Error, NotImplementedError, TypeError) as error:
            raise ValueError(f"the world draws nothing: {error}") from error
        first = self.host.first
        env = TransformAction(
            env, lambda action: first._chosen(np.asarray(action, first.kind.dtype).tobytes()),
            self.action_space(self.default_params))  # fmt: skip
        return TransformObservation(env, first._seen, first.space)

    def reset(self, key: Key, params: HostedParams) -> tuple[jax.Array, HostedState]:
        """Begins an episode."""
        said, obs = self._called(self.host.begin, jax.random.bits(key, dtype=jnp.uint32) >> 1)
        no = jnp.bool_(False)
        return obs, HostedState(said[:2], jnp.int32(0), obs, no, no)

    def step(
        self, key: Key, state: HostedState, action: jax.Array, params: HostedParams
    ) -> Stepped:
        """One step of the world. After the end nothing moves and nothing is paid, and where that is
        so of all that are computed together the host is not called.
        """
        over = state.terminated | state.truncated
        flags = jnp.stack([state.time + 1 >= params.max_steps, over]).astype(jnp.uint32)
        chosen = jnp.atleast_1d(jnp.asarray(action, self.host.first.kind.dtype))
        words = jax.lax.bitcast_convert_type(chosen, jnp.uint32)
        asked = jnp.concatenate([state.name, flags, words])
        idle = jnp.zeros(5, jnp.uint32), state.obs
        said, obs = jax.lax.cond(
            anywhere(~over), lambda: self._called(self.host.step, asked), lambda: idle
        )
        new = HostedState(said[:2], state.time + 1, obs, said[3] == 1, said[4] == 1)
        new = where(over, state, new)
        reward = jnp.where(over, 0, jax.lax.bitcast_convert_type(said[2], jnp.float32))
        return new.obs, new, reward, new.terminated, new.truncated, {}

    def _called(self, host: Callable, asked: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What the host answers: `ANSWER`, and what is seen. One array is asked, since each costs
        as much as a step of a small world.
        """
        seen = jax.ShapeDtypeStruct(self.host.first.space.shape, self.host.first.space.dtype)
        shapes = jax.ShapeDtypeStruct((5,), jnp.uint32), seen
        return jax.pure_callback(host, shapes, asked, vmap_method="broadcast_all")


class Worlds:
    """A Gymnasium environment, or a vector of them, as lanes that are played together.

    Attributes:
        names: where the episode of each lane stands, None where there is none or it is over.
    """

    def __init__(self, env: Any):
        self.env, self.vector = env, isinstance(env, VectorEnv)
        prefix = "single_" if self.vector else ""
        self.actions = getattr(env, f"{prefix}action_space")
        self.space = _observed(getattr(env, f"{prefix}observation_space"))
        self.kind = actions_in(self.actions)
        self.mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self.names: list[bytes | None] = [None] * (env.num_envs if self.vector else 1)
        self.spec = getattr(env, "spec", None) or getattr((*getattr(env, "envs", ()), env)[0],
                                                          "spec", None)  # fmt: skip

    def reset(self, seeds: Sequence[int]) -> list[np.ndarray]:
        """First observations of as many lanes as there are seeds."""
        if not self.vector:
            return [self._seen(self.env.reset(seed=seeds[0])[0])]
        others = [0] * (len(self.names) - len(seeds))
        try:
            obs, _ = self.env.reset(seed=[*seeds, *others])
        except gymnasium.error.Error as error:
            raise ValueError(
                f"lanes cannot have seeds of their own ({error}): make them by gymnasium.make_vec "
                'with vectorization_mode="sync"'
            ) from None
        return list(self._seen(obs))[: len(seeds)]

    def step(self, actions: Mapping[int, bytes]) -> list[tuple[np.ndarray, float, bool, bool]]:
        """``obs, reward, terminated, truncated`` of each lane; one without an action does any."""
        if not self.vector:
            obs, *ends, _ = self.env.step(self._chosen(actions[0]))
            return [(self._seen(obs), *ends)]
        anything = np.zeros(self.kind.shape or 1, self.kind.dtype).tobytes()
        lanes = range(len(self.names))
        chosen = [self._chosen(actions.get(lane, anything)) for lane in lanes]
        obs, reward, terminated, truncated, info = self.env.step(np.array(chosen))
        rows, over = list(self._seen(obs)), np.asarray(terminated | truncated)
        if self.mode == AutoresetMode.SAME_STEP:  # what is seen is of a new episode
            for lane in np.flatnonzero(over):
                rows[lane] = self._seen(info["final_obs"][lane])
        if self.mode == AutoresetMode.DISABLED and over.any():  # or the others could not go on
            self.env.reset(seed=[0] * len(rows), options={"reset_mask": over})
        return list(zip(rows, reward, terminated, truncated, strict=True))

    def _chosen(self, words: bytes) -> Any:
        """An action as the world takes it."""
        chosen = np.frombuffer(words, self.kind.dtype)
        if isinstance(self.actions, spaces.Discrete):
            return int(self.actions.start + chosen[0])
        return np.clip(chosen, self.actions.low, self.actions.high).astype(self.actions.dtype)

    def _seen(self, obs: Any) -> np.ndarray:
        return np.array(obs, self.space.dtype)


class Host:
    """All worlds of an environment, for any number of threads."""

    def __init__(self, make: Make, num_envs: int):
        self.make, self.num_envs, self.lock = make, num_envs, threading.Lock()
        self.first = self._made()
        self.every = [self.first]  # what was begun longest ago first
        self.standing: dict[bytes, list[tuple[Worlds, int]]] = {}
        self.said: dict[bytes, tuple[bytes, np.ndarray]] = {}
        weakref.finalize(self, _close, self.every)  # with the process, at the latest

    def begin(self, seeds: Any) -> tuple[np.ndarray, np.ndarray]:
        """Episodes of these seeds ``[...]``: `ANSWER`, whose names count, and what is seen."""
        flat, lanes = np.asarray(seeds).ravel().tolist(), len(self.first.names)
        answers = []
        with self.lock:
            for some in (flat[at : at + lanes] for at in range(0, len(flat), lanes)):
                worlds = self._free()
                for lane, obs in enumerate(worlds.reset(some)):
                    name = _digest(some[lane].to_bytes(4), obs)
                    self._stand(worlds, lane, name)
                    answers.append((ANSWER.pack(name, 0, False, False), obs))
        return self._arrays(answers, seeds.shape)

    def step(self, asked: Any) -> tuple[np.ndarray, np.ndarray]:
        """A step of each episode ``[..., 4 + n]``: its name, whether it is the last, whether it is
        over, and the action. `RuntimeError` where the world of one is in use by another.
        """
        rows = np.asarray(asked).reshape(-1, asked.shape[-1])
        nothing = bytes(ANSWER.size), np.zeros(self.first.space.shape, self.first.space.dtype)
        answers = dict.fromkeys(range(len(rows)), nothing)
        with self.lock:
            answers |= self._played({n: row.tobytes() for n, row in enumerate(rows) if not row[3]})
        return self._arrays([*answers.values()], asked.shape[:-1])

    def _played(self, asked: Mapping[int, bytes]) -> dict[int, tuple[bytes, np.ndarray]]:
        """The answer to each; what came of the same action, where the world has gone on since."""
        moves: defaultdict[Worlds, dict[int, int]] = defaultdict(dict)
        names = {row[:8] for row in asked.values()}
        for number, row in asked.items():
            if found := self.standing.get(row[:8]):
                # equal episodes may stand in several vectors: one that is asked for as a whole
                worlds, lane = max(found, key=lambda one: {*one[0].names} <= {None, *names})
                self._stand(worlds, lane, None)
                moves[worlds][lane] = number
        answers = {}
        for worlds, lanes in moves.items():
            if any(worlds.names):
                raise RuntimeError("lanes of a VectorEnv are stepped together: leave none out")
            played = worlds.step({lane: asked[n][16:] for lane, n in lanes.items()})
            for lane, number in lanes.items():
                row, (obs, reward, ends, truncated) = asked[number], played[lane]
                terminated = bool(ends)
                cut = not terminated and bool(truncated or row[8])
                name = _digest(row + ANSWER.pack(b"", reward, terminated, cut), obs)
                answers[number] = ANSWER.pack(name, reward, terminated, cut), obs
                self.said[row] = answers[number]
                self._stand(worlds, lane, None if terminated or cut else name)
        if any(row not in self.said for number, row in asked.items() if number not in answers):
            said = f"num_envs is {self.num_envs}: more episodes are played at once; raise it"
            raise RuntimeError(said)
        answers |= {n: self.said[row] for n, row in asked.items() if n not in answers}
        most = max(2 * len(self.every) * len(self.first.names), len(asked))
        while len(self.said) > most:
            del self.said[next(iter(self.said))]
        return answers

    def _made(self) -> Worlds:
        name = self.make if isinstance(self.make, str) else getattr(self.make, "__name__", "make")
        try:
            made = gymnasium.make(self.make) if isinstance(self.make, str) else self.make()
            return Worlds(made)
        except (gymnasium.error.Error, ValueError) as error:
            raise ValueError(f"{name}: {error}") from error

    def _free(self) -> Worlds:
        """Worlds that nobody plays in, or new ones; of too many, those begun longest ago."""
        free = next((worlds for worlds in self.every if not any(worlds.names)), None)
        if free is None and (len(self.every) + 1) * len(self.first.names) <= self.num_envs:
            free = self._made()
        else:
            free = free or self.every[0]
            self.every.remove(free)
        self.every.append(free)
        for lane in range(len(free.names)):
            self._stand(free, lane, None)
        return free

    def _stand(self, worlds: Worlds, lane: int, name: bytes | None) -> None:
        """From now on the lane's episode stands there, or nowhere."""
        before, worlds.names[lane] = worlds.names[lane], name
        if before is not None:
            self.standing[before].remove((worlds, lane))
            if not self.standing[before]:
                del self.standing[before]
        if name is not None:
            self.standing.setdefault(name, []).append((worlds, lane))

    def _arrays(self, answers: Sequence[Any], lead: tuple) -> tuple[np.ndarray, np.ndarray]:
        said, obs = zip(*answers, strict=True)
        packed = np.frombuffer(b"".join(said), np.uint32).reshape((*lead, 5))
        return packed, np.stack(obs).reshape((*lead, *self.first.space.shape))


def _close(every: Sequence[Worlds]) -> None:
    for worlds in every:
        with suppress(Exception):  # or the others would stay open
            worlds.env.close()


def _digest(what: bytes, obs: np.ndarray) -> bytes:
    return blake2b(what + obs.tobytes(), digest_size=8).digest()


def _observed(space: Any) -> spaces.Box:
    """How observations are given on; `ValueError` where they are neither vectors nor frames."""
    axes = len(space.shape) if isinstance(space, spaces.Box) else 0
    if axes == 1:
        return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32))
    if axes == 3 and space.dtype == np.uint8:
        return space
    kinds = "neither vectors nor frames of bytes [height, width, channels]"
    raise ValueError(f"observations are {space}, {kinds}: {WRAP}FlattenObservation")
