"""Milliseconds of the training steps of the Maze's networks, in JAX and in PyTorch, in turns; it
needs the ``bench`` extra.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.agents import DQNConfig, DQNHParams, dqn
from jaxdyna.experiments.benchmark.sweep import NOT_HERE
from jaxdyna.experiments.engine import Experiment, InputError, Options, Record, Results, Table
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.fields import setting
from jaxdyna.models import PixelConfig, PixelHParams, pixels
from jaxdyna.networks import ConvolutionalQ, GlimpseQ, LocalDynamics
from jaxdyna.types import Transition

SCANNED = 20
Q_BATCH = 32
FRAMES_TORCH, Q_TORCH = "PyTorch", "PyTorch, convolutions"


@dataclass(frozen=True, kw_only=True)
class StepOptions(Options):
    """Times training steps of the lean frame model and of DQN in JAX and in PyTorch, in turns."""

    decided: ClassVar = NOT_HERE | {"episodes": "what is measured"}

    preset: str = setting("lean", "whose networks are used")
    batch: int = setting(64, "transitions a step of the frame model", at_least=1, everyday=True)
    widths: tuple[int, ...] = setting(
        (32, 32, 32), "channels of the 3x3 convolutions", at_least=1, everyday=True
    )
    rounds: int = setting(
        15, "rounds of 20 steps each, after two to warm up", at_least=1, everyday=True
    )


def measure(options: StepOptions, say: Any) -> dict[str, dict[str, list[float]]]:
    """Milliseconds of a step, by contest and contender, in every round."""
    batch, small = random_batch(options.batch), random_batch(Q_BATCH)
    try:
        frames = {FRAMES_TORCH: torch_steps(batch, options.widths)}
        q = {Q_TORCH: torch_q_steps(small)}
    except ImportError:
        raise InputError("PyTorch is not installed: pip install 'jaxdyna[bench]'") from None
    frames |= jax_steps(batch, options.widths)
    q |= jax_q_steps(small)
    contests = {
        f"Lean frame model, batch of {options.batch}": frames, f"Double DQN, batch of {Q_BATCH}": q
    }  # fmt: skip
    taken = {}
    for title, contenders in contests.items():
        say(f"{title} ...")
        taken[title] = take_turns(contenders, options.rounds)
    return taken


def take_turns(contenders: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of a step, in every round but the first two, which warm up."""
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    names = list(contenders)
    for number in range(rounds + 2):
        names = [*names[1:], names[0]]  # whoever goes before may leave threads behind
        for name in names:
            began = time.perf_counter()
            contenders[name]()
            if number >= 2:
                taken[name].append(1000 * (time.perf_counter() - began) / SCANNED)
    return taken


def compared(taken: Mapping[str, Sequence[float]], base: str) -> Table:
    """Medians, where half of the rounds lie, and how that is to PyTorch's."""
    rows = []
    for name, values in taken.items():
        low, middle, high = np.percentile(values, [25, 50, 75])
        ratio = middle / np.median(taken[base])
        rows.append([name, f"{middle:.2f}", f"{low:.2f} to {high:.2f}", f"{ratio:.2f}"])
    return ["training step", "ms", "half of the rounds", "of PyTorch's"], rows


def random_batch(size: int) -> Transition:
    """A batch as the Maze's frames are: few pixels lit."""
    generator = np.random.default_rng(0)
    frames = (generator.random((size, 16, 16, 15)) < 0.02).astype(np.uint8) * 255
    flags = np.zeros(size, bool)
    fields: Any = {
        "obs": frames[..., :12],
        "action": generator.integers(0, 5, size),
        "reward": generator.integers(-1, 2, size).astype(np.float32),
        "next_obs": frames[..., 3:],
        "terminated": flags,
        "truncated": flags,
        "mask": ~flags,
    }
    return Transition(**fields)


def jax_steps(batch: Any, widths: tuple[int, ...]) -> dict[str, Callable[[], Any]]:
    """`SCANNED` steps, called one by one and as one scan."""
    model = pixels((16, 16, 3), 5, PixelConfig(LocalDynamics(3, widths)))
    hparams = PixelHParams()
    batch = jax.tree.map(jnp.asarray, batch)
    start = jax.jit(model.init)(jax.random.key(0), hparams)

    @jax.jit
    def step(state: Any, batch: Any, key: jax.Array) -> Any:
        return model.update(state, batch, key, hparams)[0]

    @jax.jit
    def scan(state: Any, batch: Any, keys: jax.Array) -> Any:
        return jax.lax.scan(lambda state, key: (step(state, batch, key), None), state, keys)[0]

    keys = jax.random.split(jax.random.key(1), SCANNED)

    def alone() -> None:
        state = start
        for key in keys:
            state = step(state, batch, key)
        jax.block_until_ready(state)

    return {
        "JAX, step by step": alone,
        "JAX, in a scan": lambda: jax.block_until_ready(scan(start, batch, keys)),
    }


def torch_steps(batch: Any, widths: tuple[int, ...]) -> Callable[[], None]:
    """The same steps in PyTorch: same layers, losses and optimiser."""
    import torch  # noqa: PLC0415  (the bench extra's)
    from torch import nn  # noqa: PLC0415

    sizes = [13, *widths]
    layers = nn.ModuleList(
        [nn.Conv2d(a, b, 3, padding=1) for a, b in zip(sizes, widths, strict=False)]
    )
    by_action, last = nn.Linear(5, widths[0]), nn.Conv2d(widths[-1], 3, 1)
    head = nn.Sequential(nn.Conv2d(3, 16, 1), nn.ReLU(), nn.Conv2d(16, 1, 1, bias=False))
    parts = nn.ModuleList([layers, by_action, last, head])
    optimizer = torch.optim.Adam(parts.parameters(), lr=5e-3)

    def picture(frames: np.ndarray) -> Any:
        return torch.from_numpy(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)))

    obs, truth = picture(batch.obs), picture(batch.next_obs[..., -3:])
    action = torch.from_numpy(np.eye(5, dtype=np.float32)[batch.action])
    reward = torch.from_numpy(batch.reward)

    def steps() -> None:
        for _ in range(SCANNED):
            seen, target = obs.float() / 255, truth.float() / 255
            x = torch.cat([seen, torch.ones_like(seen[:, :1])], 1)
            for number, layer in enumerate(layers):
                x = layer(x)
                x = x * by_action(action)[:, :, None, None] if number == 0 else x
                x = torch.relu(x)
            raw = last(x)
            cells = head(target)[:, 0]
            loss = nn.functional.binary_cross_entropy_with_logits(raw, target, reduction="none")
            charge = 0.1 * cells.abs().sum((1, 2))
            error = (cells.sum((1, 2)) - reward) ** 2
            (loss.sum((1, 2, 3)) + error + charge).mean().backward()
            optimizer.step()
            optimizer.zero_grad()

    return steps


def jax_q_steps(batch: Any) -> dict[str, Callable[[], Any]]:
    """`SCANNED` steps of Q-learning in a scan, each drawing its batch from a replay by priority."""

    def of(network: Any) -> Callable[[], Any]:
        config = DQNConfig(network, updates=SCANNED, batch=len(batch.action), capacity=2**14)
        agent, hparams = dqn((16, 16, 3), 5, config), DQNHParams()
        episode = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], batch)
        start = jax.jit(agent.init)(jax.random.key(0), hparams)
        learn = jax.jit(lambda state, key: agent.update(state, episode, key, hparams)[0])
        return lambda: jax.block_until_ready(learn(start, jax.random.key(1)))

    return {"JAX, convolutions": of(ConvolutionalQ(5)), "JAX, glimpses": of(GlimpseQ(5))}


def torch_q_steps(batch: Any) -> Callable[[], None]:
    """The same with the convolutions in PyTorch, where each step is handed its batch."""
    import torch  # noqa: PLC0415  (the bench extra's)
    from torch import nn  # noqa: PLC0415

    def network() -> Any:
        layers: list[Any] = [nn.Conv2d(12, 16, 2, stride=2), nn.ReLU()]
        for features in (16, 32):
            layers += [nn.Conv2d(16, features, 3, padding=1), nn.ReLU()]
        return nn.Sequential(
            *layers,
            nn.Flatten(),
            nn.Linear(2048, 128),
            nn.LayerNorm(128),
            nn.ReLU(),
            nn.Linear(128, 6),
        )

    online, target = network(), network()
    optimizer = torch.optim.Adam(online.parameters(), lr=1e-3)

    def picture(frames: np.ndarray) -> Any:
        return torch.from_numpy(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)))

    after = np.concatenate([batch.obs[..., 3:], batch.next_obs[..., -3:]], -1)
    obs, last, reward = picture(batch.obs), picture(after), torch.from_numpy(batch.reward)
    action = torch.from_numpy(batch.action)[:, None]

    def values(net: Any, frames: Any) -> Any:
        out = net(frames.float() / 255)
        return out[:, :1] + out[:, 1:] - out[:, 1:].mean(1, keepdim=True)

    def steps() -> None:
        for _ in range(SCANNED):
            with torch.no_grad():
                choice = values(online, last).argmax(1, keepdim=True)
                goal = reward + 0.95 * values(target, last).gather(1, choice)[:, 0]
            nn.functional.huber_loss(values(online, obs).gather(1, action)[:, 0], goal).backward()
            optimizer.step()
            optimizer.zero_grad()
            with torch.no_grad():
                for old, new in zip(target.parameters(), online.parameters(), strict=True):
                    old.lerp_(new, 0.005)

    return steps


def tables(results: Results) -> list[tuple[str, Table]]:
    """A table a contest, by title."""
    milliseconds = results["milliseconds"]
    return [
        (title, compared(taken, next(name for name in taken if "PyTorch" in name)))
        for title, taken in milliseconds.items()
    ]


def section(record: Record) -> str:
    """The tables."""
    cores = record.results["device"]["cpu_cores"]
    parts = [f"## {title}\n\n{markdown_table(*table)}" for title, table in tables(record.results)]
    return sections.paragraphs(
        f"{cores} cores; {record.options.rounds} rounds of {SCANNED} steps in turns. In JAX "
        "Q-learning also draws its batches by priority; PyTorch is handed them.",
        *parts,
    )


STEPS = Experiment(
    name="steps",
    title="Training steps of the Maze's networks",
    presets={"lean": StepOptions()},
    arms=lambda options: {},
    measures={"milliseconds": measure},
    sections=(section,),
    summary=lambda record: tables(record.results),
)
