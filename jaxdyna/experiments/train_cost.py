"""Where the time of learning to act goes, beside what its operations would take at least."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.dyna import DynaState, play_dreams, play_real, train_model
from jaxdyna.experiments import report
from jaxdyna.experiments.run import Arm

PARTS = ("real episode", "model updates", "dreams", "agent updates")
REPEATS = 3
MATRIX = 2048


class Work(NamedTuple):
    """Something that happens after every real episode.

    Attributes:
        part: which of `PARTS` it is.
        steps: how often its loop goes round; XLA counts the operations in a loop once.
        call: what is timed.
        args: its arguments, arrays.
        again: whether what it returns is its next first argument, in whose memory it works.
    """

    part: str
    steps: int
    call: Callable[..., Any]
    args: tuple[Any, ...]
    again: bool = False


def cost_of_parts(
    arm: Arm, updates: tuple[int, int], state: DynaState, key: jax.Array
) -> dict[str, np.ndarray]:
    """What a real episode with its dreams costs a run that has the machine to itself.

    Args:
        arm: the arm.
        updates: gradient steps of the agent after real and after fake episodes.
        state: of one run.
        key: random key.

    Returns:
        ``cost_seconds`` and ``cost_operations`` (floating-point ones, as XLA counts them before it
        optimises), both ``[PARTS]``, 0 for what the arm does not do; ``cost_rate``, operations a
        second of this machine in a large matrix product.
    """
    seconds, operations = np.zeros(len(PARTS)), np.zeros(len(PARTS))
    for work in _works(arm, updates, state, key):
        number = PARTS.index(work.part)
        lowered = jax.jit(work.call, donate_argnums=[0] * work.again).lower(*work.args)
        operations[number] += work.steps * (lowered.cost_analysis() or {}).get("flops", 0.0)
        seconds[number] += _seconds(lowered.compile(), *work.args, again=work.again)
    rate = np.asarray(matrix_rate())
    return {"cost_seconds": seconds, "cost_operations": operations, "cost_rate": rate}


def _works(arm: Arm, updates: tuple[int, int], state: DynaState, key: jax.Array) -> list[Work]:
    dyna, config, hparams = arm
    world, learn_dreams = dyna.dream, dyna.agent.update_fake or dyna.agent.update
    keys = jax.random.split(key, 8)

    def real_episode(agent: Any, key: jax.Array) -> Any:
        return play_real(dyna, config, agent, key, hparams)

    def learn(agent: Any, real: Any, key: jax.Array) -> Any:
        return dyna.agent.update(agent, real, key, hparams.agent)[0]

    def train(state: DynaState, key_sample: jax.Array, key_update: jax.Array) -> Any:
        return train_model(dyna, config, state, key_sample, key_update, hparams)

    def dream(state: DynaState, key: jax.Array) -> Any:
        assert world is not None
        env_params = world.params(state, hparams)
        return play_dreams(dyna, config, state.agent, env_params, key, hparams)

    def learn_fake(agent: Any, fake: Any, key: jax.Array) -> Any:
        return learn_dreams(agent, fake, key, hparams.agent)[0]

    real = jax.jit(real_episode)(state.agent, keys[0])
    works = [
        Work("real episode", config.num_steps, real_episode, (state.agent, keys[1])),
        Work("agent updates", updates[0], learn, (state.agent, real, keys[2]), again=True),
    ]
    if dyna.model is not None:
        works.append(Work("model updates", config.model_updates, train, (state, *keys[3:5])))
    if world is not None:
        steps = config.dream_steps or config.num_steps
        fake = jax.jit(dream)(state, keys[5])
        args = (state.agent, fake, keys[6])
        learning = Work("agent updates", updates[1], learn_fake, args, again=True)
        dreaming = Work("dreams", steps, dream, (state, keys[7]))
        works += config.dream_updates * [dreaming, learning]
    return works


def describe_cost(curves: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """`cost_of_parts` as the entry ``cost`` of ``results.json``, per real episode of one run:
    ``seconds`` and ``floor_seconds`` (operations over the rate of a matrix product) by part.
    Nothing where nothing was measured.
    """
    if "cost_seconds" not in curves:
        return {}
    floors = curves["cost_operations"] / curves["cost_rate"]
    cost = {
        "seconds": dict(zip(PARTS, curves["cost_seconds"].tolist(), strict=True)),
        "floor_seconds": dict(zip(PARTS, floors.tolist(), strict=True)),
        "matrix_product_gflops": float(curves["cost_rate"]) / 1e9,
    }
    return {"cost": cost}


def cost_table(results: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """`describe_cost` of every arm as a table."""
    rows = []
    for name, arm in results["arms"].items():
        seconds, floors = arm["cost"]["seconds"], arm["cost"]["floor_seconds"]
        total = sum(seconds.values())
        for part in PARTS:
            if seconds[part]:
                row = [name, part, f"{1e3 * seconds[part]:.0f}", f"{seconds[part] / total:.0%}"]
                rows.append([*row, f"{1e3 * floors[part]:.0f}"])
    return ["arm", "part", "ms", "share", "floor (ms)"], rows


def cost_said(results: Mapping[str, Any]) -> list[str]:
    """`cost_table` and what it is, for a report; nothing where nothing was measured."""
    arms = results["arms"].values()
    if not all("cost" in arm for arm in arms):
        return []
    rate = max((arm["cost"]["matrix_product_gflops"] for arm in arms), default=0)
    return [
        "What a real episode takes once there are dreams, one run alone on the machine; the floor "
        "is the floating-point operations over the rate of a large matrix product "
        f"({rate:.0f} GFLOP/s here).",
        report.markdown_table(*cost_table(results)),
    ]


def matrix_rate() -> float:
    """Floating-point operations a second of this machine in a large matrix product."""
    square = jnp.ones((MATRIX, MATRIX))
    product = jax.jit(jnp.matmul).lower(square, square).compile()
    return 2 * MATRIX**3 / _seconds(product, square, square)


def _seconds(call: Callable[..., Any], *args: Any, again: bool = False) -> float:
    """The quickest of a few calls, after one to warm up; for ``again`` see `Work`."""
    first = jax.tree.map(jnp.copy, args[0]) if again else args[0]
    taken = []
    for _ in range(1 + REPEATS):
        began = time.perf_counter()
        result = jax.block_until_ready(call(first, *args[1:]))
        taken.append(time.perf_counter() - began)
        first = result if again else first
    return min(taken[1:])
